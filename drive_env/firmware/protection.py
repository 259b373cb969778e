"""Protection: the causes that this drive watches, once per millisecond, and what each does.

A cause is a physical condition of the axis; its emergency code and bytes are the device's data (by name).
"""

from __future__ import annotations

from typing import NamedTuple

from drive_env.firmware import fsa
from mechanics.compiled import stage


class Cause(NamedTuple):
    """A row: name as in the device's emergency table, whether the stage is cut at once, bits of 1001h and 2101h."""

    name: str
    cut: bool
    error_register: int
    status_flag: int


# Row 0 is the answer to a fault reset, which every device sends with code 0000h.
CAUSES = (
    Cause("fault_reset", False, 0x00, 0x0),
    Cause("overcurrent", True, 0x02, 0x1),
    Cause("undervoltage", True, 0x04, 0x2),
    Cause("overvoltage", True, 0x04, 0x4),
    Cause("following_error", False, 0x20, 0x0),
)
GENERIC_ERROR = 0x01  # bit 0 of 1001h is set with every error
OVERCURRENT, UNDERVOLTAGE, OVERVOLTAGE, FOLLOWING_ERROR = 1, 2, 3, 4
_FLAGS = tuple(cause.status_flag for cause in CAUSES)
_CUT = tuple(cause.cut for cause in CAUSES)
_REGISTER = tuple(cause.error_register for cause in CAUSES)


@stage
def is_present(drive, lane, cause):
    """Return whether a cause's condition holds now."""
    if cause == OVERCURRENT:
        limit = drive.overcurrent[lane]
        return drive.i_d_meas[lane] ** 2 + drive.i_q_meas[lane] ** 2 > limit * limit
    if cause == UNDERVOLTAGE:
        return drive.u_dc[lane] < drive.undervoltage[lane]
    if cause == OVERVOLTAGE:
        return drive.u_dc[lane] > drive.overvoltage[lane]
    if cause == FOLLOWING_ERROR:
        window = drive.following_error_window[lane]
        return (
            window > 0.0
            and drive.loop_level[lane] > 0
            and drive.drive_function[lane] > 0.0
            and abs(drive.position_demand[lane] - drive.theta_meas[lane]) > window
        )
    return False


@stage
def causes_gone(drive, lane):
    """Return whether the cause that holds the drive in fault is gone."""
    return drive.fault[lane] == 0 or not is_present(drive, lane, drive.fault[lane] - 1)


@stage
def protect(drive, lane):
    """Look at every cause; the first that appears takes the drive into fault and queues its emergency."""
    # A drive whose supply is missing is no fault before anybody switches it on: voltage is watched once it is.
    if drive.fsa[lane] < fsa.SWITCHED or drive.fsa[lane] == fsa.FAULTED:
        return
    for cause in range(1, len(_CUT)):
        if drive.fault[lane] == cause + 1 or not is_present(drive, lane, cause):
            continue
        drive.fault[lane] = cause + 1
        drive.error_register[lane] |= GENERIC_ERROR | _REGISTER[cause]
        fsa.push_emergency(drive, lane, cause)
        fsa.fault(drive, lane, _CUT[cause])
        if drive.fsa[lane] == fsa.FAULTED:
            return


@stage
def fault_flags(drive, lane):
    """Return the bits of 2101h that tell which fault the drive is in."""
    return _FLAGS[drive.fault[lane] - 1] if drive.fault[lane] > 0 else 0
