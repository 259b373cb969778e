"""The step of a commissioning that homes the axes by a method of the drive, and moves each back to its old place."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np

from drive_env import cia402, motion
from drive_env.cia402 import Key
from drive_env.devices.commissioning import HOMING_SPEED, ROTORS, SLOW_SPEED, TORQUE
from drive_env.dictionary.homing_methods import HERE, method_text
from drive_env.drives.homing import ACCELERATION, EDGE, SEARCH, methods_of, missing_speeds
from drive_env.drives.interface import Drives, Observer
from drive_env.drives.observed import ObservedDrives
from drive_env.drives.speeds import per_increment
from drive_env.fieldbus.description import describe
from drive_env.trials.positioning import wrapped
from mechanics.arrays import Floats, Mask
from tuning.commissioning.axis_limits import LIMITS
from tuning.identify.working_state import ALIGNMENT_TIME, is_aligning

if TYPE_CHECKING:
    from drive_env.drives.trace import Trace
    from drive_env.fieldbus.description import Description
    from tuning.commissioning.bench import CommissioningBench
    from tuning.target import Target

HOMING_OBJECTS: tuple[Key, ...] = ((cia402.HOMING_METHOD, 0), SEARCH, EDGE, ACCELERATION)
LONGEST = 60.0  # s
FASTEST, NOISE = 4.0, 0.002  # times the homing speed, and turns: a larger change of a sample is a new zero
MOVED = 0.01  # turns: a shorter way is not moved back
READY = 0.05  # s at rest before and after homing: samples are mapped before an axis is enabled


class WayWatch(Observer):
    """Adds up how far rotors turn while the zero of their positions changes.

    Args:
        speeds: Greatest possible speed of each axis [inc/s], shape (num_axes,).
        noise: Greatest difference of samples at rest [inc], shape (num_axes,).

    Attributes:
        way: Sum so far [inc], shape (num_axes,).
    """

    objects = (cia402.POSITION_ACTUAL,)

    def __init__(self, speeds: Floats, noise: Floats) -> None:
        self.way = np.zeros(len(speeds))
        self._speeds, self._noise = speeds, noise
        self._last: Any = None
        self._at = 0.0

    def passed(self, below: Drives, duration: float, trace: Trace, asked: Any, play: Any) -> None:
        """Add the changes of position except those of the zero; in real time, samples may be missing before it."""
        rows, now = np.asarray(trace[cia402.POSITION_ACTUAL], float), time.monotonic()
        spans = np.full((len(rows), 1), duration / len(rows))
        if self._last is not None:
            spans[0] += 0.0 if below.time_waits else max(now - duration - self._at, 0.0)
            rows = np.vstack([self._last, rows])
        steps = wrapped(np.diff(rows, axis=0))
        is_way = np.abs(steps) <= self._speeds * spans[-len(steps) :] + self._noise
        self.way += np.where(is_way, steps, 0.0).sum(axis=0)
        self._last, self._at = rows[-1], now


def unfit_for_homing(target: Target) -> str:
    """Return why axes cannot be homed here; "" if they can."""
    if not target.device.new_dictionary().has(cia402.HOMING_METHOD):
        return "the drive has no homing: it lacks 6098h"
    return "the axes pull at one thing: none is homed without the others" if target.linked else ""


def check_method(target: Target, method: int | None) -> None:
    """Raise ValueError for a homing method that the drives do not have; None, the drive's own method, is accepted."""
    if method is not None and method not in (there := offered_methods(target)):
        raise ValueError(f"homing method {method}: the drive has {', '.join(map(str, there)) or 'none'}")


def offered_methods(target: Target) -> dict[int, str]:
    """Return the homing methods of the drives, each with its description."""
    known = _description(target)
    return {number: method_text(number, is_known=True) for number in methods_of(target.drives, known, 0)}


def no_method(target: Target) -> str:
    """Return the message that no method is chosen, with the methods that exist."""
    listed = "; ".join(f"{number}: {text}" for number, text in offered_methods(target).items())
    return f"no homing method is chosen (6098h is 0); those of the drive are {listed}"


def has_no_method(bench: CommissioningBench) -> bool:
    """Return whether the user must choose a method before homing."""
    chosen = bench.plan.method is not None or bool(bench.target.drives.read(cia402.HOMING_METHOD).any())
    return not chosen and not any(LIMITS[name].is_place for name in bench.plan.limits)


def home_axes(bench: CommissioningBench) -> list[str]:
    """Home the axes one after the other, and move each back to its old place; return lines with the results.

    Raises:
        ValueError: For a method that the drive does not have.
        RuntimeError, TimeoutError: If no method is chosen, or an axis does not reach home.
    """
    target, drives = bench.target, bench.target.drives
    own, wanted = drives.read(cia402.HOMING_METHOD), bench.plan.method
    if wanted is None and not own.any():
        if has_no_method(bench):
            raise RuntimeError(f"{no_method(target)}. Choose one that fits the machine's switches, or leave homing out")
        return ["not homed: no method is chosen (6098h is 0), so positions count from where they do now"]
    check_method(target, wanted)
    if wanted is not None:
        drives.write(cia402.HOMING_METHOD, wanted)
    lines = []
    for axis, method in enumerate(drives.read(cia402.HOMING_METHOD).tolist()):
        if method:
            lines += _give_speeds(target, axis, method)
            lines.append(_home(bench, axis, method))
    return lines


def _give_speeds(target: Target, axis: int, method: int) -> list[str]:
    """Write speeds and acceleration of a method where they are 0, from the motor's rated values; return the lines."""
    drives, motor = target.drives, target.motor
    values = {
        SEARCH: HOMING_SPEED * motor.rated_speed,
        EDGE: SLOW_SPEED * motor.rated_speed,
        ACCELERATION: TORQUE * motor.rated_torque / (ROTORS * motor.inertia),
    }
    lines = []
    for key in missing_speeds(drives, axis, method):
        raw = np.rint(values[key] * target.increments() * per_increment(drives, key)).astype(np.int64)
        drives.write(key, raw, where=_only(target, axis))
        lines.append(f"{key[0]:04X}h:{key[1]:02X} is {raw[axis]}, and was 0")
    return lines


def _home(bench: CommissioningBench, axis: int, method: int) -> str:
    """Home an axis, move it back to its old place, and switch it off; return the line with the result."""
    target, where = bench.target, _only(bench.target, axis)
    turn = 2.0 * np.pi * target.increments()
    speeds = target.drives.read(SEARCH) / per_increment(target.drives, SEARCH)
    watch = WayWatch(FASTEST * np.asarray(speeds, float), NOISE * turn)
    drives = ObservedDrives(target.drives, watch)
    drives.advance(READY)
    motion.enable(drives, mode="hm", where=where)
    _settle(target, drives, where)  # methods that take the present position as home take this one
    motion.home(drives, where=where, timeout=LONGEST)
    _settle(target, drives, where)
    way, at = np.where(where, watch.way, 0.0), int(drives.read(cia402.POSITION_ACTUAL)[axis]) / turn[axis]
    bench.note_way(watch.way / target.increments())
    told = f"axis {target.axis_numbers[axis]}: home by method {method}: {method_text(method, is_known=True)}"
    if method in HERE or abs(way[axis]) < MOVED * turn[axis]:
        motion.disable(drives, where=where)
        return f"{told}; it stands at {at:.4g} rev"
    motion.select_mode(drives, "pp", where)
    motion.move_to(drives, np.rint(-way).astype(np.int64), relative=True, where=where, timeout=LONGEST)
    _settle(target, drives, where)
    motion.disable(drives, where=where)
    return f"{told}; that is {way[axis] / turn[axis]:.4g} turns from where it stood, and it is back there"


def _settle(target: Target, drives: Drives, where: Mask) -> None:
    """Wait until an axis is at rest and its encoder aligned, which some drives do when they are first enabled."""
    drives.advance(READY)
    waited = 0.0
    while waited < ALIGNMENT_TIME and (np.any(where & is_aligning(target)) or motion.is_turning(drives, where, READY)):
        drives.advance(READY)
        waited += 2.0 * READY


def _only(target: Target, axis: int) -> Mask:
    return np.asarray(np.arange(target.num_axes) == axis)


def _description(target: Target) -> Description:
    return describe(target.device.name, None)
