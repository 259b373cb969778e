"""Drives during experiments: cautious settings, with the old ones restored at the end.

A drive may have factory settings, with all gains 0, or gains with which it oscillates: before anything turns, it gets
gains from the data sheet that are slow enough for any load, and profile, limits and windows for the experiments.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from drive_env import cia402, motion
from drive_env.devices.gains import bandwidth_gains
from drive_env.dictionary.entries import ObjectName
from drive_env.dictionary.roles import Role
from drive_env.drives.currents import ampere_per_count, read_current_limit, to_counts, write_current_limit
from drive_env.drives.interface import CYCLE, Drives, axis_number
from drive_env.drives.raw_gains import write_gains
from drive_env.drives.speeds import per_increment
from drive_env.motors import Motor
from mechanics.arrays import Floats, Integers, Mask
from tuning.identify.wiring import FINDINGS
from tuning.stop_causes import told_causes
from tuning.target import Target, check_measurable

if TYPE_CHECKING:
    from drive_env.devices import Device


BOTH_ENDS = 3  # bits of 60FDh, and the value of 2005h that disables both limit switches
MODES = ("pp", "csp", "csv", "cst")  # in which axes are identified
STOP_MODE = 1 << 8  # of 2101h: enabled, but not in a mode yet, since the encoder is being aligned


def borrowed(device: Device) -> tuple[ObjectName, ...]:
    """Return the objects of a device that experiments change, in the order of restoring."""
    names: tuple[ObjectName, ...] = (
    Role.CURRENT_LIMIT, Role.CURRENT_LIMIT_NEGATIVE, Role.OPEN_LOOP_CURRENT, *device.gains.keys, Role.MOTOR_TYPE,
    Role.COMMUTATION, Role.POLE_PAIRS, Role.ENCODER_STEPS, *FINDINGS,
    cia402.PROFILE_ACCELERATION, cia402.PROFILE_DECELERATION, cia402.QUICK_STOP_DECELERATION, cia402.FOLLOWING_WINDOW,
    Role.LIMIT_SWITCHES, cia402.TARGET_VELOCITY, cia402.TARGET_POSITION, cia402.TARGET_TORQUE,
    (cia402.INTERPOLATION_PERIOD, 1), (cia402.INTERPOLATION_PERIOD, 2),
)  # fmt: skip
    return tuple(name for name in names if not isinstance(name, Role) or name in device.roles)


def check_identifiable(device: Device, modes: Iterable[str] = MODES) -> None:
    """Raise ValueError unless a device has the linear model, modes and objects of experiments."""
    numbers = (name for name in borrowed(device) if not isinstance(name, Role | str))
    check_measurable(device, modes, [(name, 0) if isinstance(name, int) else name for name in numbers])


def read_role(target: Target, role: Role) -> Integers:
    """Read an object by its role, shape (num_axes,); 0 if the drive lacks it, which means unused.

    A drive without a setting of the shaft's direction does not reverse it, and one without flags aligns no encoder.
    """
    return target.drives.read(role) if role in target.device.roles else np.zeros(target.num_axes, np.int64)


BRUSHED, BRUSHLESS = 1, 3  # 2050h
BY_FIELD, BY_HALLS, BY_ENCODER = 1, 2, 3  # 2055h
ALIGNED_BY_HALLS = 2  # 2080h:03

CURRENT_HZ, VELOCITY_HZ, POSITION_HZ = 300.0, 20.0, 5.0  # cautious bandwidths, computed from data sheet values
INTEGRATION = 5.0  # T_i as a multiple of 1/w_v
# Above its resonance an elastic load decouples from the rotor, whose inertia and P then determine the crossover.
ROTOR_HZ = 100.0
BASE_MARGIN, BASE_SHARE = 0.5, 0.4  # rad from the ends of the travel, or share of the travel if that is less
RETURN_SPEED, REST = 0.1, 60  # of the speed limit, on the way back; cycles at rest afterwards
GUESS = 3.0  # assumed total inertia over the rotor's, until it is identified
ENABLE_TIME, ALIGNMENT_TIME = 1.0, 8.0  # s, longest waits: for the states, and for an encoder that is first aligned


@dataclass
class Working:
    """Drives in their working state.

    Attributes:
        target: The target to identify.
        where: Axes under experiment.
        origin: Position of every axis at the beginning of the experiments [inc].
        increments: Position increments per radian.
        current: Greatest current that may be commanded to every axis [A]: the target's limit, or the drive's own if
            lower.
        fresh: Axes whose drives were factory-fresh (motor type 0).
    """

    target: Target
    where: Mask
    origin: Integers
    increments: Floats
    current: Floats
    fresh: Mask

    @property
    def base(self) -> Floats:
        """Angles at which experiments begin and end [rad from the origin]: 0, or a little inside a near limit."""
        low, high = self.target.low, self.target.high
        margin = np.minimum(BASE_MARGIN, BASE_SHARE * (high - low))
        return np.clip(np.zeros(len(low)), low + margin, high - margin)

    def angle(self, position: ArrayLike) -> Floats:
        """Return positions [inc] as angles from the origin [rad]; the counter wraps at 2^31."""
        away = np.asarray(position, float) - self.origin
        return np.asarray(((away + 2.0**31) % 2.0**32 - 2.0**31) / self.increments)

    def speed_counts(self) -> Floats:
        """Return the counts of 606Ch and 60FFh per rad/s, shape (num_axes,)."""
        return np.asarray(self.increments * per_increment(self.target.drives, cia402.VELOCITY_ACTUAL))

    def room(self) -> tuple[Floats, Floats]:
        """Return the signed angles that the rotors may turn from here [rad], down and up."""
        here = self.angle(self.target.drives.read(cia402.POSITION_ACTUAL))
        return self.target.low - here, self.target.high - here


def cautious_gains(target: Target, inertia: ArrayLike) -> Integers:
    """Return raw gains, (num_axes, count), for total inertias [kg*m^2], slow enough for rigid and elastic loads."""
    J = np.broadcast_to(np.asarray(inertia, float), (target.num_axes,))
    return np.array([
        bandwidth_gains(
            target.device, target.motor, float(J[k]), current_hz=CURRENT_HZ,
            velocity_hz=cautious_bandwidth(target.motor, float(J[k])), position_hz=POSITION_HZ,
            supply=float(target.supply[k]), integration=INTEGRATION,
        )
        for k in range(target.num_axes)
    ], np.int64)  # fmt: skip


def cautious_bandwidth(motor: Motor, inertia: float, wanted: float = VELOCITY_HZ) -> float:
    """Return the bandwidth of a velocity loop [Hz] that is stable with the whole inertia and with the rotor alone."""
    return min(wanted, ROTOR_HZ * motor.inertia / inertia)


@contextmanager
def working_state(target: Target, where: Mask | None = None) -> Iterator[Working]:
    """Yield drives that are commissioned, cautious and off; restore their settings at the end and switch them off.

    Raises:
        RuntimeError: If a drive is enabled, moves, or refuses a setting.
    """
    drives = target.drives
    axes = np.ones(target.num_axes, bool) if where is None else where
    status = drives.read(cia402.STATUSWORD)
    enabled = axes & cia402.matches(status, cia402.OPERATION_ENABLED)
    if enabled.any():
        number = axis_number(drives, int(np.flatnonzero(enabled)[0]))
        raise RuntimeError(f"axis {number} is enabled: disable it, identification begins with a drive at rest")
    before = {key: drives.read(key) for key in borrowed(target.device)}
    mode = drives.read(cia402.MODE)
    try:
        yield _prepare(target, axes, before)
    finally:
        _give_back(target, axes, before, mode)


def _prepare(target: Target, axes: Mask, before: Mapping[Any, Integers]) -> Working:
    drives, motor = target.drives, target.motor
    increments = target.increments()
    write_gains(drives, cautious_gains(target, GUESS * motor.inertia), axes)
    # A factory-fresh drive has no motor data; the data of a commissioned one are used and checked.
    fresh = axes & (before[Role.MOTOR_TYPE] == 0)
    if fresh.any():
        drives.write(Role.MOTOR_TYPE, BRUSHED if motor.kind == "dc" else BRUSHLESS, where=fresh)
        drives.write(Role.POLE_PAIRS, motor.n_p, where=fresh)
        drives.write(Role.ENCODER_STEPS, motor.encoder_counts, where=fresh)
        drives.write(Role.COMMUTATION, BY_ENCODER, where=fresh)
        # No axis can be at both ends: the switches are not connected.
        unwired = fresh & (drives.read(cia402.DIGITAL_INPUTS) & BOTH_ENDS == BOTH_ENDS)
        if Role.LIMIT_SWITCHES in target.device.roles:
            drives.write(Role.LIMIT_SWITCHES, BOTH_ENDS, where=unwired)
    own = read_current_limit(drives)
    current = np.where(own > 0.0, np.minimum(own, target.current), target.current)
    write_current_limit(drives, current, axes)
    # A limit may have coarser units than torques: commanded currents stay within it also when rounded to 6071h.
    limit = read_current_limit(drives)
    counts, ampere = to_counts(drives, limit), ampere_per_count(drives)
    limit = np.where(counts * ampere > limit * (1.0 + 1e-9), (counts - 1) * ampere, limit)
    current = np.where(axes, np.minimum(current, limit), current)
    scale = increments
    for ramp in (cia402.PROFILE_ACCELERATION, cia402.PROFILE_DECELERATION, cia402.QUICK_STOP_DECELERATION):
        drives.write(ramp, _raw(10.0 * target.speed * scale * per_increment(drives, ramp)), where=axes)
    # Slow loops may lag by turns: the experiments check their own limits, so this window is wide.
    drives.write(cia402.FOLLOWING_WINDOW, _raw(200.0 * math.pi * scale), where=axes)
    drives.write((cia402.INTERPOLATION_PERIOD, 1), 1, where=axes)
    drives.write((cia402.INTERPOLATION_PERIOD, 2), -3, where=axes)
    return Working(target, axes, drives.read(cia402.POSITION_ACTUAL), increments, current, fresh)


def _give_back(target: Target, axes: Mask, before: Mapping[Any, Integers], mode: Integers) -> None:
    drives = target.drives
    switch_off(drives, axes)
    for key in borrowed(target.device):
        changed = axes & (drives.read(key) != before[key])
        if changed.any():
            drives.write(key, before[key], where=changed)
    other = axes & (drives.read(cia402.MODE) != mode)
    if other.any():
        drives.write(cia402.MODE, mode, where=other)


def enable(working: Working, mode: str, where: Mask | None = None) -> None:
    """Enable axes in a cyclic mode with set-points of 0.

    Raises:
        RuntimeError: If an axis is not enabled in time.
    """
    drives = working.target.drives
    axes = working.where if where is None else where
    drives.write(cia402.TARGET_VELOCITY, 0, where=axes)
    drives.write(cia402.TARGET_TORQUE, 0, where=axes)
    try:
        motion.enable(drives, mode=mode, where=axes, timeout=ENABLE_TIME)
        waited = 0.0
        aligns = axes & (drives.read(Role.COMMUTATION) == BY_ENCODER) & (drives.read(Role.MOTOR_TYPE) == BRUSHLESS)
        if aligns.any():  # the flags are one millisecond old; and the rotor must come to rest
            drives.advance(50 * CYCLE)
            waited += 50 * CYCLE
        while waited < ALIGNMENT_TIME and np.any(aligns & is_aligning(working.target)):
            drives.advance(50 * CYCLE)
            waited += 50 * CYCLE
    except (TimeoutError, RuntimeError) as error:
        causes = ", ".join(sorted({told for told in told_causes(drives) if told}))
        raise RuntimeError(f"{error}{f' ({causes})' if causes else ''}") from error


def is_aligning(target: Target) -> Mask:
    """Return which axes are enabled but still turn to align their encoder."""
    return np.asarray(read_role(target, Role.MOTOR_FLAGS) & STOP_MODE != 0)


def go_back(working: Working, mode: str, to: ArrayLike | None = None) -> None:
    """Bring enabled axes to their base, or to an angle [rad], in csp, and change to a mode at rest."""
    target, drives = working.target, working.target.drives
    motion.select_mode(drives, "csp", working.where)
    goal = working.base if to is None else np.asarray(to, float)
    here = working.angle(drives.read(cia402.POSITION_ACTUAL)) - goal
    # The axis farthest away determines the time: the path's peak speed is twice its mean.
    cycles = int(
        np.clip(np.ceil(2.0 * np.abs(here[working.where]).max() / (RETURN_SPEED * target.speed) / CYCLE), 60, 2000)
    )
    left = 0.5 + 0.5 * np.cos(np.pi * (np.arange(cycles) + 1.0) / cycles)
    path = working.origin + (goal + here * np.concatenate([left, np.zeros(REST)])[:, None]) * working.increments
    raw = ((np.rint(path) + 2.0**31) % 2.0**32 - 2.0**31).astype(np.int64)
    drives.record([cia402.POSITION_ACTUAL], len(raw) * CYCLE, play={cia402.TARGET_POSITION: raw})
    drives.write(cia402.TARGET_VELOCITY, 0, where=working.where)
    motion.select_mode(drives, mode, working.where)


def switch_off(drives: Drives, where: Mask) -> None:
    """Switch axes off; one in fault is already off, and its fault remains for the caller to read and reset."""
    fault = cia402.matches(drives.read(cia402.STATUSWORD), cia402.FAULT_BIT)
    motion.disable(drives, where & ~fault)


def still_enabled(status: Integers) -> Mask:
    """Return which axes are in "operation enabled" by their statuswords."""
    return np.asarray(cia402.matches(status, cia402.OPERATION_ENABLED))


def _raw(values: Floats) -> Integers:
    return np.clip(np.rint(values), 1, 2**31 - 1).astype(np.int64)
