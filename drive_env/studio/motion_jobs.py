"""The jobs of the page Axes, which run in the drives' thread."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from typing import TYPE_CHECKING

import numpy as np

from drive_env import cia402
from drive_env.dictionary import quantities
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.dictionary.access import check_limits
from drive_env.dictionary.homing_methods import METHODS, method_text
from drive_env.drives import motion
from drive_env.drives.homing import methods_of
from drive_env.drives.interface import Drives
from drive_env.drives.lent_object import lent
from mechanics.arrays import Mask

if TYPE_CHECKING:
    from drive_env.dictionary.entries import ObjectName
    from drive_env.fieldbus.description import Description
    from drive_env.studio.session import Session

MotionJob = Callable[[Drives], None]
AxisNumbers = int | Sequence[int]

LONGEST_MOVE, LONGEST_STOP = 600.0, 5.0  # s


def masks_of(num_axes: int, axes: AxisNumbers) -> Mask:
    """Return the mask of one or several axes among `num_axes`."""
    return np.isin(np.arange(num_axes), axes)


def turned_round(speed: str, direction: int) -> str:
    """Return a speed as text, with its sign reversed for direction -1."""
    text = speed.strip()
    if direction >= 0:
        return text
    return text[1:] if text.startswith("-") else f"-{text.removeprefix('+')}"


def only(drives: Drives, axes: AxisNumbers) -> Mask:
    """Return the mask of one or several axes of the drives."""
    return masks_of(drives.num_axes, axes)


def enable(axes: AxisNumbers, mode: str) -> MotionJob:
    """Return the job that enables axes in a mode."""

    def job(drives: Drives) -> None:
        motion.enable(drives, mode=mode, where=only(drives, axes), timeout=3.0)

    return job


def disable(axes: AxisNumbers) -> MotionJob:
    """Return the job that brings axes to rest and switches them off."""

    def job(drives: Drives) -> None:
        where = only(drives, axes)
        if (on := _enabled(drives, where)).any():
            motion.quick_stop(drives, where=on)
            _await_rest(drives, on)
        motion.disable(drives, where=where, timeout=3.0)

    return job


def reset_fault(axis: int) -> MotionJob:
    """Return the job that resets the fault of an axis."""
    return lambda drives: motion.reset_fault(drives, where=only(drives, axis))


def start_node(axis: int) -> MotionJob:
    """Return the job that starts the node of an axis, which stays off."""
    return lambda drives: drives.start_node(only(drives, axis))


def command(axis: int, word: int) -> MotionJob:
    """Return the job that writes a controlword of the state machine; enabling does not move to an old target."""

    def job(drives: Drives) -> None:
        if word == cia402.FAULT_RESET:
            motion.reset_fault(drives, where=only(drives, axis))
        else:
            motion.take_command(drives, where=only(drives, axis))
            if word == cia402.ENABLE_OPERATION:
                motion.stay(drives, mode_of(drives, axis), only(drives, axis))
            drives.write(cia402.CONTROLWORD, word, where=only(drives, axis))

    return job


def select_mode(axis: int, mode: str) -> MotionJob:
    """Return the job that selects a mode of operation; an enabled axis does not move."""
    return lambda drives: motion.select_mode(drives, mode, where=only(drives, axis))


def home(axis: int, method: int) -> MotionJob:
    """Return the job that homes an axis; a method is in 6098h during it, 0 means the one that 6098h has."""

    def job(drives: Drives) -> None:
        where, own = only(drives, axis), int(drives.read(cia402.HOMING_METHOD)[axis])
        with nullcontext() if method in (0, own) else lent(drives, cia402.HOMING_METHOD, method, where):
            motion.home(drives, where=where)

    return job


def homing_methods(known: Description, axis: int) -> Callable[[Drives], tuple[int, dict[int, str]]]:
    """Return the job that reads 6098h, and the homing methods of an axis, each with its description.

    For a drive that does not list its methods these are those of CiA 402.
    """

    def job(drives: Drives) -> tuple[int, dict[int, str]]:
        if not known.has(cia402.HOMING_METHOD):
            return 0, {}
        numbers = methods_of(drives, known, axis) or list(METHODS)
        texts = {number: method_text(number, is_known=known.device is not None) for number in numbers}
        return int(drives.read(cia402.HOMING_METHOD)[axis]), texts

    return job


def move(session: Session, axis: int, goal: str, speed: str, *, relative: bool) -> MotionJob:
    """Return the job that moves an axis in pp.

    Args:
        session: Provides the units.
        axis: Number of the axis.
        goal: Position or distance: "1 rev", "90 deg", or an integer in the drive's unit.
        speed: Profile velocity; "" keeps the drive's.
        relative: Whether the goal is a distance from the present position.
    """

    def job(drives: Drives) -> None:
        where = only(drives, axis)
        target = parsed(session, axis, goal, cia402.TARGET_POSITION)
        rate = parsed(session, axis, speed, cia402.PROFILE_VELOCITY) if speed.strip() else None
        check_enabled(drives, axis)
        motion.select_mode(drives, "pp", where=where)
        if rate is not None and rate <= 0:
            raise ValueError(f"a speed of {speed} moves nothing; give one above 0")
        with nullcontext() if rate is None else lent(drives, cia402.PROFILE_VELOCITY, rate, where):
            motion.move_to(drives, target, relative=relative, where=where, timeout=LONGEST_MOVE)

    return job


def turn(session: Session, axes: AxisNumbers, speed: str, number: int) -> MotionJob:
    """Return the job that turns axes in pv, or vl for drives without it, as long as a page's motion lasts.

    Several axes begin together, or none if one is not enabled; later all are stopped if one is lost.

    Args:
        session: Provides units and motions.
        axes: One or several axes.
        speed: Signed speed as text.
        number: Number of the motion.
    """

    def job(drives: Drives) -> None:
        where = only(drives, axes)
        mode = motion.turning_mode(drives)
        if not where.any():
            raise ValueError("no axis is in the group; choose some in the table")
        rate = np.zeros(drives.num_axes, np.int64)
        for axis in np.flatnonzero(where).tolist():
            rate[axis] = parsed(session, axis, speed, motion.FOLLOWED[mode][0])
            check_enabled(drives, axis)
        if not session.presence.is_on(number):
            return  # released before it began
        motion.stay(drives, mode, where)
        motion.select_mode(drives, mode, where=where)
        if session.presence.is_on(number):
            motion.turn(drives, rate, where)
            session.presence.couple(number)

    return job


def end_turn(axes: AxisNumbers) -> MotionJob:
    """Return the job that stops axes by their own ramps, after a button was released."""

    def job(drives: Drives) -> None:
        if (on := _enabled(drives, only(drives, axes))).any():
            motion.stay(drives, motion.turning_mode(drives), on)

    return job


def parsed(session: Session, axis: int, text: str, name: ObjectName) -> int:
    """Parse a text as an object's integer of an axis; ValueError for an invalid text, or a value out of range."""
    known: Description = session.description
    entry = known.dictionary.find(name)
    raw = quantities.parse(text, entry, session.scales[axis])
    check_limits(entry, raw)
    return raw


def check_enabled(drives: Drives, axis: int) -> None:
    """Raise RuntimeError for an axis that is not in "operation enabled"."""
    status = int(drives.read(cia402.STATUSWORD)[axis])
    if not cia402.matches(status, cia402.OPERATION_ENABLED):
        raise RuntimeError(f"axis {axis} is not enabled and cannot move: statusword {status:04X}h; enable it first")


def mode_of(drives: Drives, axis: int) -> str:
    """Return the abbreviation of an axis' mode of operation; "" without one."""
    try:
        number = int(drives.read(cia402.MODE_DISPLAY)[axis])
    except ObjectAccessError:  # a drive without 6061h
        number = int(drives.read(cia402.MODE)[axis])
    return next((name for name, one in cia402.MODES.items() if one == number), "")


def _enabled(drives: Drives, where: Mask) -> Mask:
    """Return which of some axes are in "operation enabled"."""
    return np.asarray(where & cia402.matches(drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED))


def _await_rest(drives: Drives, where: Mask) -> None:
    """Let time pass until the quick stop of axes is complete, or they have left its state."""
    waited = 0.0
    while waited < LONGEST_STOP and motion.is_turning(drives, where, 0.02):
        waited += 0.02
        if not np.any(where & cia402.is_live(drives.read(cia402.STATUSWORD))):
            return
