"""Enable, move, stop: written once, on the Drives interface, for emulated and real drives alike."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Mask = NDArray[np.bool_]

# Numbers of 6060h (CiA 402).
MODES = {"pp": 1, "pv": 3, "hm": 6, "csp": 8, "csv": 9, "cst": 10}

# Statusword patterns: mask, value (CiA 402, state coding).
SWITCH_ON_DISABLED = (0x4F, 0x40)
READY_TO_SWITCH_ON = (0x6F, 0x21)
SWITCHED_ON = (0x6F, 0x23)
OPERATION_ENABLED = (0x6F, 0x27)
QUICK_STOP_ACTIVE = (0x6F, 0x07)
FAULT = (0x4F, 0x08)
FAULT_BIT = (0x08, 0x08)  # fault or fault reaction active
FAULT_REACTION_ACTIVE = (0x4F, 0x0F)
# States in which a drive may turn its motor.
LIVE = (OPERATION_ENABLED, QUICK_STOP_ACTIVE, FAULT_REACTION_ACTIVE)
TARGET_REACHED = (0x0400, 0x0400)
SET_POINT_ACKNOWLEDGED = (0x1000, 0x1000)
SET_POINT_TAKEN_BACK = (0x1000, 0x0000)
# Homing: bits 13 (error), 12 (attained) and 10 (at rest); 13 stays 0 on drives that do not support it.
HOMING_BITS = 0x3400
HOMED, HOMING_UNDER_WAY = 0x1400, (0x0000, 0x1000)

STEP = 0.001  # time between two looks at the statusword [s]


class Drives(Protocol):
    """What this module needs of drives."""

    num_axes: int

    def read(self, name: Any) -> NDArray[np.int64]:
        """Return an object of every axis."""

    def write(self, name: Any, value: ArrayLike, where: Mask | None = None) -> None:
        """Write an object."""

    def advance(self, duration: float) -> None:
        """Let time pass [s]."""


def is_enabling(controlword: int) -> bool:
    """Return whether a controlword may enable an axis, or go on with one that is: bits 0 to 3 (CiA 402)."""
    return controlword & 0x0F == 0x0F


def is_live(statusword: int) -> bool:
    """Return whether a drive in the state that 6041h shows may turn its motor."""
    return any(statusword & mask == value for mask, value in LIVE)


def wait_for(drives: Drives, pattern: tuple[int, int], timeout: float, what: str, where: Mask | None = None) -> None:
    """Let time pass until the statusword of every axis matches.

    Args:
        drives: The drives.
        pattern: Mask and value of the statusword.
        timeout: Longest wait [s].
        what: What is waited for, for the message.
        where: Axes that count; all by default.

    Raises:
        TimeoutError: If an axis does not get there, with its statusword; RuntimeError if one is in fault.
    """
    mask, value = pattern
    axes = np.ones(drives.num_axes, bool) if where is None else where
    waited = 0.0
    while True:
        status = drives.read(0x6041)
        late = axes & (status & mask != value)
        if not late.any():
            return
        fault = axes & (status & FAULT[0] == FAULT[1])
        if fault.any() and pattern != FAULT:
            axis = int(np.flatnonzero(fault)[0])
            raise RuntimeError(
                f"axis {axis} is in fault while waiting for {what}; see emergencies(), then reset_fault()"
            )
        if waited >= timeout:
            axis = int(np.flatnonzero(late)[0])
            raise TimeoutError(f"axis {axis} did not reach {what} in {timeout:g} s: statusword {status[axis]:04X}h")
        drives.advance(STEP)
        waited += STEP


def select_mode(drives: Drives, mode: str, where: Mask | None = None) -> None:
    """Select a mode of operation by abbreviation on the axes that are not in it yet."""
    if mode not in MODES:
        raise ValueError(f"no mode is named {mode!r}; there are {', '.join(MODES)}")
    axes = np.ones(drives.num_axes, bool) if where is None else where
    other = axes & (drives.read(0x6060) != MODES[mode])
    if other.any():
        drives.write(0x6060, MODES[mode], where=other)


def enable(drives: Drives, mode: str | None = None, where: Mask | None = None, timeout: float = 1.0) -> None:
    """Take drives to operation enabled, a fault being reset first; `mode` is selected before.

    Raises:
        TimeoutError: If a state is not reached within `timeout` [s].
    """
    status = drives.read(0x6041)
    axes = np.ones(drives.num_axes, bool) if where is None else where
    in_fault = axes & (status & FAULT[0] == FAULT[1])
    if in_fault.any():
        reset_fault(drives, where=in_fault, timeout=timeout)
    if mode is not None:
        select_mode(drives, mode, where)
    stopped = axes & (drives.read(0x6041) & QUICK_STOP_ACTIVE[0] == QUICK_STOP_ACTIVE[1])
    if stopped.any():
        drives.write(0x6040, 0x0F, where=stopped)
        wait_for(drives, OPERATION_ENABLED, timeout, "operation enabled after the quick stop", stopped)
    not_enabled = axes & (drives.read(0x6041) & OPERATION_ENABLED[0] != OPERATION_ENABLED[1])
    if not not_enabled.any():
        return
    for word, state, name in (
        (0x06, READY_TO_SWITCH_ON, "ready to switch on"),
        (0x07, SWITCHED_ON, "switched on"),
        (0x0F, OPERATION_ENABLED, "operation enabled"),
    ):
        drives.write(0x6040, word, where=not_enabled)
        wait_for(drives, state, timeout, name, not_enabled)


def disable(drives: Drives, where: Mask | None = None, timeout: float = 1.0) -> None:
    """Switch the voltage off; the axis coasts."""
    drives.write(0x6040, 0x00, where=where)
    wait_for(drives, SWITCH_ON_DISABLED, timeout, "switch on disabled", where)


def quick_stop(drives: Drives, where: Mask | None = None) -> None:
    """Command a quick stop; what follows the ramp is 605Ah's."""
    drives.write(0x6040, 0x02, where=where)


def reset_fault(drives: Drives, where: Mask | None = None, timeout: float = 1.0) -> None:
    """Reset a fault by the rising edge of controlword bit 7.

    Raises:
        TimeoutError: If the cause is still there.
    """
    drives.write(0x6040, 0x00, where=where)
    drives.write(0x6040, 0x80, where=where)
    axes = np.ones(drives.num_axes, bool) if where is None else where
    waited = 0.0
    while True:
        late = axes & (drives.read(0x6041) & FAULT[0] == FAULT[1])
        if not late.any():
            break
        if waited >= timeout:
            axis = int(np.flatnonzero(late)[0])
            raise TimeoutError(f"axis {axis} stays in fault: the cause is still there; see 2101h and emergencies()")
        drives.advance(STEP)
        waited += STEP
    drives.write(0x6040, 0x00, where=where)


def start_move(
    drives: Drives, position: ArrayLike, *, relative: bool = False, where: Mask | None = None, timeout: float = 1.0
) -> None:
    """Start a move in pp to a position [inc], with the set-point handshake of bits 4 and 12.

    Raises:
        RuntimeError: If an axis is not enabled, or not in pp; nothing is written.
        TimeoutError: If the drive does not take the set-point within `timeout` [s].
    """
    _check_can_move(drives, where)
    word = 0x4F if relative else 0x0F
    drives.write(0x607A, position, where=where)
    drives.write(0x6040, word | 0x10, where=where)
    wait_for(drives, SET_POINT_ACKNOWLEDGED, timeout, "set-point acknowledge", where)
    drives.write(0x6040, word, where=where)
    wait_for(drives, SET_POINT_TAKEN_BACK, timeout, "end of set-point acknowledge", where)


def move_to(
    drives: Drives, position: ArrayLike, *, relative: bool = False, where: Mask | None = None, timeout: float = 30.0
) -> None:
    """Move in pp to a position [inc] and wait until it is reached.

    Raises:
        RuntimeError: If an axis is not enabled, or not in pp; nothing is written.
        TimeoutError: If the target is not reached within `timeout` [s].
    """
    start_move(drives, position, relative=relative, where=where)
    wait_for(drives, TARGET_REACHED, timeout, "target reached", where)


def _check_can_move(drives: Drives, where: Mask | None) -> None:
    axes = np.ones(drives.num_axes, bool) if where is None else where
    status, mode = drives.read(0x6041), drives.read(0x6061)
    off = axes & (status & OPERATION_ENABLED[0] != OPERATION_ENABLED[1])
    other = axes & (mode != MODES["pp"])
    for wrong, what in ((off, "is not enabled"), (other, "is not in pp")):
        if wrong.any():
            axis = int(np.flatnonzero(wrong)[0])
            raise RuntimeError(
                f"axis {axis} {what} and cannot move: statusword {status[axis]:04X}h, mode {mode[axis]}; "
                'motion.enable(drives, mode="pp") first'
            )


def home(drives: Drives, where: Mask | None = None, timeout: float = 60.0) -> None:
    """Run the homing method of 6098h and wait until home is attained; the axes are enabled, in hm, afterwards.

    Raises:
        RuntimeError: If an axis gives up, or ends in fault.
        TimeoutError: If home is not attained within `timeout` [s].
    """
    axes = np.ones(drives.num_axes, bool) if where is None else where
    enable(drives, mode="hm", where=where)
    drives.write(0x6040, 0x0F, where=where)  # bit 4 must rise
    drives.write(0x6040, 0x1F, where=where)
    waited = 0.0
    while True:
        drives.advance(2 * STEP)  # the first look comes after the drive has begun
        waited += 2 * STEP
        status = drives.read(0x6041)
        fault = axes & (status & FAULT_BIT[0] == FAULT_BIT[1])
        bits = status & HOMING_BITS
        failed = axes & ~fault & (bits != HOMED) & ~np.isin(bits, HOMING_UNDER_WAY)
        if fault.any() or failed.any():
            axis = int(np.flatnonzero(fault | failed)[0])
            what = "is in fault while homing; see emergencies()" if fault[axis] else "gave up homing"
            raise RuntimeError(
                f"axis {axis} {what}: statusword {status[axis]:04X}h; check the method 6098h, its switches and speeds"
            )
        if not np.any(axes & (bits != HOMED)):
            break
        if waited >= timeout:
            axis = int(np.flatnonzero(axes & (bits != HOMED))[0])
            raise TimeoutError(f"axis {axis} did not attain home in {timeout:g} s: statusword {status[axis]:04X}h")
    drives.write(0x6040, 0x0F, where=where)
