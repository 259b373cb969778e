"""Enable, move, stop: on the Drives interface, for emulated and real drives."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from drive_env import cia402
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.dictionary.axis_objects import read_if_there
from drive_env.dictionary.roles import Role
from drive_env.drives.homing import zero_speeds
from drive_env.drives.interface import CYCLE, BasicDrives, axis_number
from mechanics.arrays import Integers, Mask

if TYPE_CHECKING:
    from drive_env.devices import Device

WIDEST = 2**31  # increments: a larger window means that it is switched off

MODE_PATIENCE = 0.25  # s to wait for a mode before halting or giving up
TAKEN_BACK = 0.05  # s after which a set-point whose acknowledge stays is in a drive's buffer
REST = 0.25  # s at the target or at home after which a drive without bit 10 has arrived
NEAR = 10  # increments around a target, for a drive without a window
STOP_TIMEOUT = 5.0  # s for the stop of an axis whose manufacturer's mode was changed while it was enabled
# For each mode that follows a target as soon as it is enabled: the target, and the object that is added to it. ip and
# tq act like csp and cst on drives that have them (TGZ manual); pp and hm move only at a rising edge of bit 4.
FOLLOWED = {
    "vl": (cia402.VL_TARGET_VELOCITY, None),
    "pv": (cia402.TARGET_VELOCITY, None),
    "tq": (cia402.TARGET_TORQUE, cia402.TORQUE_OFFSET),
    "ip": (cia402.TARGET_POSITION, cia402.POSITION_OFFSET),
    "csp": (cia402.TARGET_POSITION, cia402.POSITION_OFFSET),
    "csv": (cia402.TARGET_VELOCITY, cia402.VELOCITY_OFFSET),
    "cst": (cia402.TARGET_TORQUE, cia402.TORQUE_OFFSET),
}


def wait_for(
    drives: BasicDrives,
    pattern: tuple[int, int],
    timeout: float,
    what: str,
    where: Mask | None = None,
    *,
    or_else: tuple[int, int] | None = None,
    waited: float = 0.0,
) -> None:
    """Let time pass until the statusword of every axis matches.

    Args:
        drives: The drives.
        pattern: Mask and value of the statusword.
        timeout: Longest wait [s].
        what: The awaited state, for the message.
        where: Axes that count; all by default.
        or_else: Another mask and value that end the wait of an axis.
        waited: The part of the timeout that has passed already [s].

    Raises:
        TimeoutError: If an axis does not reach it, with its statusword; RuntimeError if one is in fault.
    """
    axes = np.ones(drives.num_axes, bool) if where is None else where
    while True:
        status = drives.read(cia402.STATUSWORD)
        late = axes & ~cia402.matches(status, pattern)
        if or_else is not None:
            late &= ~cia402.matches(status, or_else)
        if not late.any():
            return
        fault = axes & cia402.matches(status, cia402.FAULT)
        if fault.any() and pattern != cia402.FAULT:
            axis = int(np.flatnonzero(fault)[0])
            number = axis_number(drives, axis)
            raise RuntimeError(
                f"axis {number} is in fault while waiting for {what}; see emergencies(), then reset_fault()"
            )
        if waited >= timeout:
            axis = int(np.flatnonzero(late)[0])
            number = axis_number(drives, axis)
            raise TimeoutError(
                f"axis {number} did not reach {what} in {timeout:g} s: statusword {status[axis]:04X}h"
                + _why_not_heard(drives, int(status[axis]))
            )
        drives.advance(CYCLE)
        waited += CYCLE


def _why_not_heard(drives: BasicDrives, status: int) -> str:
    """Return the text of a message on a drive that ignores commands; "" unless the manufacturer's mode is why."""
    if not _own_modes(drives) or cia402.matches(status, cia402.REMOTE):
        return ""
    return (
        "; it takes no commands (bit 9 is 0), since another program has changed its own mode or its mode of operation"
    )


def select_mode(drives: BasicDrives, mode: str, where: Mask | None = None) -> None:
    """Select a mode of operation by abbreviation on the axes not in it yet; ValueError for an unknown one.

    An enabled axis keeps its position: the mode's target is written first, as by `stay`. If the drive has a
    manufacturer's mode that must match, that is written, too. On a bus the drive may see one mode without the other and
    stop an enabled axis; such an axis is enabled again.
    """
    if mode not in cia402.MODES:
        raise ValueError(f"no mode is named {mode!r}; there are {', '.join(cia402.MODES)}")
    axes = np.ones(drives.num_axes, bool) if where is None else where
    number = cia402.MODES[mode]
    other = axes & (drives.read(cia402.MODE) != number)
    needed = _own_modes(drives).get(number)
    closed = axes & False if needed is None else axes & (drives.read(Role.MODE_GATE) != needed)
    was_on = closed
    if (changed := closed | other).any():
        on = changed & cia402.matches(drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED)
        was_on = closed & on
        if on.any():
            stay(drives, mode, on)
    if other.any():
        drives.write(cia402.MODE, number, where=other)
    if needed is not None and closed.any():
        drives.write(Role.MODE_GATE, needed, where=closed)
    if was_on.any():
        _enable_again(drives, was_on)
    _await_mode(drives, mode, axes)


def stay(drives: BasicDrives, mode: str, where: Mask | None = None) -> None:
    """Write the target by which axes keep their position in a mode, whatever target a program has left there.

    It is the present position, zero speed, or zero torque, minus the offset that the drive adds. Modes that move only
    at an edge of the controlword need none.
    """
    if mode not in FOLLOWED:
        return
    name, added = FOLLOWED[mode]
    still = drives.read(cia402.POSITION_ACTUAL) if name == cia402.TARGET_POSITION else 0
    offset = None if added is None else read_if_there(drives, added)
    drives.write(name, still if offset is None else still - offset, where=where)
    device: Device | None = getattr(drives, "device", None)
    if name == cia402.TARGET_POSITION and device is not None and Role.TARGET_INSIDE in device.roles:
        # It doubles 607Ah: an image that carries it would restore its old value.
        drives.write(Role.TARGET_INSIDE, drives.read(Role.POSITION_INSIDE), where=where)


def _stay_in_own_mode(drives: BasicDrives, axes: Mask, mode: str | None) -> None:
    """Keep axes in place once they are enabled: in a mode, or, for None, in each axis' present mode."""
    if mode is not None:
        stay(drives, mode, axes)
        return
    # A drive may show a mode only once it is enabled: the requested mode counts, too.
    asked, shown = drives.read(cia402.MODE), _shown_modes(drives)
    for name in FOLLOWED:
        number = cia402.MODES[name]
        of_mode = axes & ((asked == number) | (False if shown is None else shown == number))
        if of_mode.any():
            stay(drives, name, of_mode)


def _await_mode(drives: BasicDrives, mode: str, axes: Mask, timeout: float = 1.0) -> None:
    """Let time pass until 6061h shows a mode.

    A drive may be slow; it may change modes only at a halt, so enabled axes that do not show the mode are halted until
    they do; and it may show a mode only once it is enabled, so the wait for disabled axes is short.

    Raises:
        TimeoutError: If an enabled axis does not get into the mode; it is halted then.
    """
    late = _not_in_mode(drives, mode, axes)
    waited = 0.0
    while late.any() and waited < MODE_PATIENCE:
        drives.advance(CYCLE)
        waited += CYCLE
        late = _not_in_mode(drives, mode, late)
    halted = late & cia402.matches(drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED) if late.any() else late
    if not halted.any():
        return
    drives.write(cia402.CONTROLWORD, cia402.ENABLE_OPERATION | cia402.HALT, where=halted)
    waited, late = 0.0, halted
    while late.any():
        if waited >= timeout:
            axis = int(np.flatnonzero(late)[0])
            number = axis_number(drives, axis)
            raise TimeoutError(
                f"axis {number} did not change to {mode} in {timeout:g} s, at a halt neither: 6061h shows another "
                "mode, and the axis is halted; disable it, then select the mode"
            )
        drives.advance(CYCLE)
        waited += CYCLE
        late = _not_in_mode(drives, mode, late)
    drives.write(cia402.CONTROLWORD, cia402.ENABLE_OPERATION, where=halted)


def _not_in_mode(drives: BasicDrives, mode: str, axes: Mask) -> Mask:
    """Return the axes that show another mode; an all-false mask if the drives do not show their mode."""
    shown = _shown_modes(drives)
    return np.zeros_like(axes) if shown is None else np.asarray(axes & (shown != cia402.MODES[mode]))


def _shown_modes(drives: BasicDrives) -> Integers | None:
    """Return the mode in 6061h, None for drives without 6061h."""
    try:
        return drives.read(cia402.MODE_DISPLAY)
    except ObjectAccessError:
        return None


def _own_modes(drives: BasicDrives) -> Mapping[int, int]:
    """Return the manufacturer's mode that each mode of operation needs; empty for drives without one."""
    device: Device | None = getattr(drives, "device", None)  # BasicDrives may lack it
    return {} if device is None else device.mode_gate


def _enable_again(drives: BasicDrives, axes: Mask) -> None:
    """Enable axes that the change of the manufacturer's mode has stopped."""
    drives.advance(CYCLE)
    lost = axes & ~cia402.matches(drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED)
    if lost.any():
        wait_for(drives, cia402.SWITCH_ON_DISABLED, STOP_TIMEOUT, "the end of the stop for its own mode", lost)
        enable(drives, where=lost)


def take_command(drives: BasicDrives, where: Mask | None = None) -> None:
    """Have axes take commands again that ignore them because the manufacturer's mode does not match.

    Every function that stops axes calls it first, since an ignored command stops nothing.
    """
    own_modes = _own_modes(drives)
    if not own_modes:
        return
    axes = np.ones(drives.num_axes, bool) if where is None else where
    ignores = axes & ~cia402.matches(drives.read(cia402.STATUSWORD), cia402.REMOTE)
    if not ignores.any():
        return
    needed = np.array([own_modes.get(int(mode), -1) for mode in drives.read(cia402.MODE)])
    known = ignores & (needed >= 0)
    if known.any():
        drives.write(Role.MODE_GATE, np.maximum(needed, 0), where=known)
        drives.advance(CYCLE)  # the drive checks it once per period


def enable(drives: BasicDrives, mode: str | None = None, where: Mask | None = None, timeout: float = 1.0) -> None:
    """Reset faults, select `mode`, and take drives to operation enabled.

    Axes that were not enabled keep their position, whatever target a program has left. Write targets afterwards. Axes
    that are enabled already go on.

    Args:
        drives: The drives.
        mode: Abbreviation of a mode; None: unchanged.
        where: Axes; all by default.
        timeout: Longest wait for each state [s]; a drive with a brake needs more than the brake's delays.

    Raises:
        TimeoutError: If a state, or the mode, is not reached in time. A late axis is disabled again.
    """
    status = drives.read(cia402.STATUSWORD)
    axes = np.ones(drives.num_axes, bool) if where is None else where
    in_fault = axes & cia402.matches(status, cia402.FAULT)
    if in_fault.any():
        reset_fault(drives, where=in_fault, timeout=timeout)
    if mode is None:
        take_command(drives, where)
    else:
        select_mode(drives, mode, where)
    stopped = axes & cia402.matches(drives.read(cia402.STATUSWORD), cia402.QUICK_STOP_ACTIVE)
    if stopped.any():
        _stay_in_own_mode(drives, stopped, mode)
        drives.write(cia402.CONTROLWORD, cia402.ENABLE_OPERATION, where=stopped)
        # By 605Ah the drive takes transition 16, or goes on to switch on disabled by itself, from where it is enabled.
        wait_for(drives, cia402.OPERATION_ENABLED, timeout, "the end of the quick stop", stopped,
                 or_else=cia402.SWITCH_ON_DISABLED)  # fmt: skip
    not_enabled = axes & ~cia402.matches(drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED)
    if not not_enabled.any():
        return
    for word, state, name in (
        (cia402.SHUTDOWN, cia402.READY_TO_SWITCH_ON, "ready to switch on"),
        (cia402.SWITCH_ON, cia402.SWITCHED_ON, "switched on"),
        (cia402.ENABLE_OPERATION, cia402.OPERATION_ENABLED, "operation enabled"),
    ):
        if word == cia402.ENABLE_OPERATION:
            _stay_in_own_mode(drives, not_enabled, mode)
        drives.write(cia402.CONTROLWORD, word, where=not_enabled)
        try:
            wait_for(drives, state, timeout, name, not_enabled)
        except TimeoutError:
            # A drive that waits for its brake would be enabled later, unexpectedly.
            late = not_enabled & ~cia402.matches(drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED)
            drives.write(cia402.CONTROLWORD, cia402.SHUTDOWN, where=late)
            raise
    if mode is not None:
        try:
            _await_mode(drives, mode, not_enabled)
        except TimeoutError:
            drives.write(cia402.CONTROLWORD, cia402.SHUTDOWN, where=not_enabled)
            raise


def disable(drives: BasicDrives, where: Mask | None = None, timeout: float = 1.0) -> None:
    """Switch the voltage off; the axis coasts."""
    _command_stop(drives, cia402.DISABLE_VOLTAGE, where)
    wait_for(drives, cia402.SWITCH_ON_DISABLED, timeout, "switch on disabled", where)


def quick_stop(drives: BasicDrives, where: Mask | None = None) -> None:
    """Command a quick stop; 605Ah decides what follows the ramp."""
    _command_stop(drives, cia402.QUICK_STOP, where)


def _command_stop(drives: BasicDrives, word: int, where: Mask | None) -> None:
    """Write a controlword that stops axes; twice if an axis turns out to have ignored it."""
    take_command(drives, where)
    drives.write(cia402.CONTROLWORD, word, where=where)
    if not _own_modes(drives):
        return
    drives.advance(CYCLE)  # a statusword may be older than another program's change of the manufacturer's mode
    ignored = ~cia402.matches(drives.read(cia402.STATUSWORD), cia402.REMOTE)
    ignored = ignored if where is None else ignored & where
    if ignored.any():
        take_command(drives, ignored)
        drives.write(cia402.CONTROLWORD, word, where=ignored)


def reset_fault(drives: BasicDrives, where: Mask | None = None, timeout: float = 1.0) -> None:
    """Reset a fault by the rising edge of controlword bit 7.

    Raises:
        TimeoutError: If the cause is still there.
    """
    take_command(drives, where)
    drives.write(cia402.CONTROLWORD, cia402.DISABLE_VOLTAGE, where=where)
    drives.write(cia402.CONTROLWORD, cia402.FAULT_RESET, where=where)
    axes = np.ones(drives.num_axes, bool) if where is None else where
    waited = 0.0
    while True:
        late = axes & cia402.matches(drives.read(cia402.STATUSWORD), cia402.FAULT)
        if not late.any():
            break
        if waited >= timeout:
            axis = int(np.flatnonzero(late)[0])
            number = axis_number(drives, axis)
            raise TimeoutError(f"axis {number} stays in fault: the cause is still there; see emergencies()")
        drives.advance(CYCLE)
        waited += CYCLE
    drives.write(cia402.CONTROLWORD, cia402.DISABLE_VOLTAGE, where=where)


def start_move(
    drives: BasicDrives, position: ArrayLike, *, relative: bool = False, where: Mask | None = None, timeout: float = 1.0
) -> None:
    """Start a move in pp to a position [inc], with the set-point handshake of bits 4 and 12.

    If a drive would buffer the set-point until the previous move has ended, bit 5 makes it act at once.

    Raises:
        RuntimeError: If an axis is not enabled, or not in pp; nothing is written.
        TimeoutError: If the drive does not accept the set-point within `timeout` [s].
    """
    _check_can_move(drives, where)
    axes = np.ones(drives.num_axes, bool) if where is None else where
    word = cia402.ENABLE_OPERATION | (cia402.RELATIVE if relative else 0)
    drives.write(cia402.TARGET_POSITION, position, where=where)
    with _bit_4_is_low(drives, word, where):
        kept = _still_acknowledged(drives, where)
        if relative and kept.any():
            # The buffer is full: an edge would be ignored, and the previous move's acknowledge mistaken for its own.
            wait_for(drives, cia402.SET_POINT_TAKEN_BACK, timeout, "room for another relative move", kept)
            kept = np.zeros_like(kept)
        if (others := axes & ~kept).any():
            _raise_bit_4(drives, word, others, timeout)
            kept = kept | _still_acknowledged(drives, others)
        if kept.any() and not relative:  # a relative move ends there from the buffer, too, and must not be sent twice
            # Bit 12 is already 1 here: its fall afterwards shows that the set-point was accepted.
            _raise_bit_4(drives, word, kept, timeout, cia402.CHANGE_AT_ONCE)
        wait_for(drives, cia402.SET_POINT_TAKEN_BACK, timeout, "end of set-point acknowledge", where)


def _raise_bit_4(drives: BasicDrives, word: int, where: Mask, timeout: float, more: int = 0) -> None:
    """Make axes accept their set-point at a rising edge, and lower the bit again."""
    drives.write(cia402.CONTROLWORD, word | more | cia402.NEW_SET_POINT, where=where)
    wait_for(drives, cia402.SET_POINT_ACKNOWLEDGED, timeout, "set-point acknowledge", where)
    drives.write(cia402.CONTROLWORD, word, where=where)


@contextlib.contextmanager
def _bit_4_is_low(drives: BasicDrives, word: int, where: Mask | None) -> Iterator[None]:
    """Lower bit 4 of the controlword, whose rising edge begins a move; and again if the block fails.

    Left high it would prevent every move and homing until the axis is disabled.
    """
    drives.write(cia402.CONTROLWORD, word, where=where)
    try:
        yield
    except BaseException:
        with contextlib.suppress(Exception):  # the first error is more informative than this one
            # A stopped axis must not be enabled by it.
            on = np.asarray(cia402.matches(drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED))
            if (left := on if where is None else on & where).any():
                drives.write(cia402.CONTROLWORD, word, where=left)
        raise


def _still_acknowledged(drives: BasicDrives, where: Mask | None) -> Mask:
    """Return the axes whose acknowledge stays although bit 4 of the controlword is low again."""
    axes = np.ones(drives.num_axes, bool) if where is None else where
    waited = 0.0
    while True:
        kept = axes & cia402.matches(drives.read(cia402.STATUSWORD), cia402.SET_POINT_ACKNOWLEDGED)
        if not kept.any() or waited >= TAKEN_BACK:
            return np.asarray(kept)
        drives.advance(CYCLE)
        waited += CYCLE


def move_to(
    drives: BasicDrives,
    position: ArrayLike,
    *,
    relative: bool = False,
    where: Mask | None = None,
    timeout: float = 30.0,
) -> None:
    """Move in pp to a position [inc] and wait until it is reached.

    A drive without bit 10 has arrived once it has stood at its target for a while.

    Raises:
        RuntimeError: If an axis is not enabled, or not in pp; nothing is written.
        TimeoutError: If the target is not reached within `timeout` [s].
    """
    axes = np.ones(drives.num_axes, bool) if where is None else where
    goal = np.broadcast_to(np.asarray(position), (drives.num_axes,))
    if relative:
        goal = goal + drives.read(cia402.POSITION_ACTUAL)
    start_move(drives, position, relative=relative, where=where)
    waited = 0.0
    while axes.any() and waited < timeout:
        step = min(REST, timeout - waited)
        try:
            wait_for(drives, cia402.TARGET_REACHED, step, "its target", axes)
            return
        except TimeoutError:
            waited += step
        axes = axes & ~_stands_at(drives, goal, axes)
    wait_for(drives, cia402.TARGET_REACHED, timeout, "its target", axes, waited=waited)


def _stands_at(drives: BasicDrives, goal: Integers, axes: Mask) -> Mask:
    """Let a while pass, and return the axes that stand at their target without bit 10; all False if one moves."""
    before = drives.read(cia402.POSITION_ACTUAL)
    near = max(NEAR, _window(drives))
    if not np.any(axes & (np.abs(before - goal) <= near)):
        return np.zeros_like(axes)
    drives.advance(REST)
    after = drives.read(cia402.POSITION_ACTUAL)
    reached = cia402.matches(drives.read(cia402.STATUSWORD), cia402.TARGET_REACHED)
    stands = (np.abs(after - goal) <= near) & (np.abs(after - before) <= NEAR)
    return np.asarray(axes & (reached | stands))


def _window(drives: BasicDrives) -> int:
    """Return the widest position window of the axes [inc]; 0 without a window, or if it is switched off."""
    try:
        window = int(drives.read(cia402.POSITION_WINDOW).max())
    except ObjectAccessError:
        return 0
    return window if window < WIDEST else 0


def _check_can_move(drives: BasicDrives, where: Mask | None, modes: tuple[str, ...] = ("pp",)) -> Integers:
    """Return the mode of every axis; RuntimeError for one that is not enabled in one of the modes."""
    axes = np.ones(drives.num_axes, bool) if where is None else where
    status, shown = drives.read(cia402.STATUSWORD), _shown_modes(drives)
    mode = drives.read(cia402.MODE) if shown is None else shown
    off = axes & ~cia402.matches(status, cia402.OPERATION_ENABLED)
    other = axes & ~np.isin(mode, [cia402.MODES[name] for name in modes])
    for wrong, what in ((off, "is not enabled"), (other, f"is not in {' or '.join(modes)}")):
        if wrong.any():
            axis = int(np.flatnonzero(wrong)[0])
            number = axis_number(drives, axis)
            raise RuntimeError(
                f"axis {number} {what} and cannot move: statusword {status[axis]:04X}h, mode {mode[axis]}; "
                f'motion.enable(drives, mode="{modes[0]}") first'
            )
    return mode


def turn(drives: BasicDrives, velocity: ArrayLike, where: Mask | None = None) -> None:
    """Have enabled axes turn at a velocity, in vl (6042h, and bits 4 to 6 of the controlword) or pv (60FFh).

    In vl these bits enable the ramp; `enable` leaves them 0, and without them the axis comes to rest.

    Args:
        drives: The drives.
        velocity: In the unit of 6042h (rpm unless 604Bh and 604Ch define another) or of 60FFh.
        where: Axes; all by default.

    Raises:
        RuntimeError: If an axis is not enabled, or in neither mode; nothing is written.
    """
    in_vl = _check_can_move(drives, where, ("vl", "pv")) == cia402.VL
    axes = np.ones(drives.num_axes, bool) if where is None else where
    if (others := axes & ~in_vl).any():
        drives.write(cia402.TARGET_VELOCITY, velocity, where=others)
    if (axes & in_vl).any():
        drives.write(cia402.VL_TARGET_VELOCITY, velocity, where=axes & in_vl)
        drives.write(cia402.CONTROLWORD, cia402.FOLLOW_RAMP, where=axes & in_vl)


def turning_mode(drives: BasicDrives) -> str:
    """Return the mode for turning at a velocity: pv, or vl for drives without pv by 6502h, otherwise by 60FFh."""
    supported = read_if_there(drives, cia402.SUPPORTED_MODES)
    if supported is None or not supported.all():  # a drive that does not report its modes
        return "vl" if read_if_there(drives, cia402.TARGET_VELOCITY) is None else "pv"
    has_vl, has_pv = (supported >> (cia402.MODES[name] - 1) & 1 for name in ("vl", "pv"))
    return "vl" if np.any(has_vl & ~has_pv) else "pv"


def is_turning(drives: BasicDrives, axes: Mask, period: float) -> bool:
    """Let a time [s] pass; return whether an axis moved by more than NEAR, or without 6064h is faster by 6044h."""
    before = read_if_there(drives, cia402.POSITION_ACTUAL)
    drives.advance(period)
    here = drives.read(cia402.VL_VELOCITY_ACTUAL if before is None else cia402.POSITION_ACTUAL)
    return bool(np.any(np.abs(here - (0 if before is None else before))[axes] > NEAR))


def home(drives: BasicDrives, where: Mask | None = None, timeout: float = 60.0) -> None:
    """Run the homing method of 6098h and wait until home is attained; the axes are enabled, in hm, afterwards.

    Raises:
        RuntimeError: If an axis aborts homing, or ends in fault.
        TimeoutError: If home is not attained within `timeout` [s].
    """
    axes = np.ones(drives.num_axes, bool) if where is None else where
    method = read_if_there(drives, cia402.HOMING_METHOD)
    if method is not None and (none := axes & (method == 0)).any():
        number = axis_number(drives, int(np.flatnonzero(none)[0]))
        raise RuntimeError(
            f"axis {number} cannot home: no homing method is chosen (6098h is 0); write the number of "
            "the one that fits the machine's switches"
        )
    for number in np.unique(method[axes]) if method is not None else ():
        for (index, sub), example, is_zero in zero_speeds(drives, int(number)):
            if (stuck := axes & (method == number) & is_zero).any():
                raise RuntimeError(
                    f"axis {axis_number(drives, int(np.flatnonzero(stuck)[0]))} cannot home: {index:04X}h:{sub:02X} is "
                    f"0, so method {number} would not move the axis; set it, for example to {example}"
                )
    enable(drives, mode="hm", where=where)
    with _bit_4_is_low(drives, cia402.ENABLE_OPERATION, where):
        drives.write(cia402.CONTROLWORD, cia402.ENABLE_OPERATION | cia402.NEW_SET_POINT, where=where)
        _await_home(drives, axes, timeout)
    drives.write(cia402.CONTROLWORD, cia402.ENABLE_OPERATION, where=where)


def _await_home(drives: BasicDrives, axes: Mask, timeout: float) -> None:
    """Let time pass until axes have homed; RuntimeError if one fails, TimeoutError after `timeout` [s]."""
    waited, silent = 0.0, 0
    while True:
        drives.advance(2 * CYCLE)  # the first look must come after the drive has begun
        waited += 2 * CYCLE
        status = drives.read(cia402.STATUSWORD)
        fault = axes & cia402.matches(status, cia402.FAULT_BIT)
        bits = status & cia402.HOMING_BITS
        failed = axes & ~fault & (bits != cia402.HOMED) & ~np.isin(bits, cia402.HOMING_UNDER_WAY)
        if fault.any() or failed.any():
            axis = int(np.flatnonzero(fault | failed)[0])
            number = axis_number(drives, axis)
            told = f"statusword {status[axis]:04X}h; check the method 6098h, its switches and speeds"
            if fault[axis]:
                raise RuntimeError(f"axis {number} is in fault while homing; see emergencies(): {told}")
            raise RuntimeError(f"axis {number} did not complete homing: {told}")
        still = axes & (bits != cia402.HOMED)
        if not still.any():
            break
        # Bit 12 alone: home was left again for the resting position, or the drive has no bit 10.
        silent = silent + 1 if np.all(bits[still] == cia402.HOMING_UNDER_WAY[1]) else 0
        if silent * 2 * CYCLE >= REST and _rests(drives, still):
            break
        if waited >= timeout:
            axis = int(np.flatnonzero(axes & (bits != cia402.HOMED))[0])
            number = axis_number(drives, axis)
            raise TimeoutError(f"axis {number} did not attain home in {timeout:g} s: statusword {status[axis]:04X}h")


def _rests(drives: BasicDrives, axes: Mask) -> bool:
    """Let a while pass, and return whether axes have stood all that time."""
    before = drives.read(cia402.POSITION_ACTUAL)
    drives.advance(REST)
    return bool(np.all(np.abs(drives.read(cia402.POSITION_ACTUAL) - before)[axes] <= NEAR))
