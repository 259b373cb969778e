"""The status flags of 2101h (TMCM-1636 manual, table 85)."""

from __future__ import annotations

from drive_env import cia402
from drive_env.firmware.common import fsa, start_up
from mechanics.kernels.compiled import stage

# Bits of 2101h; the faults' bits are set by the protection.
FLAG_HALTED, FLAG_STOP, FLAG_VELOCITY, FLAG_POSITION, FLAG_TORQUE = 1 << 4, 1 << 8, 1 << 9, 1 << 10, 1 << 11
FLAG_POSITION_END, FLAG_INITIALIZED, FLAG_BRAKE = 1 << 14, 1 << 15, 1 << 18


@stage
def tell_status(drive, lane):
    """Write 2101h: the motor's state, and the flags of present causes."""
    flags = FLAG_INITIALIZED if drive.fsa[lane] != fsa.NOT_READY else 0
    if abs(drive.omega_slow[lane]) <= drive.standstill[lane]:
        flags |= FLAG_HALTED
    stops = drive.drive_function[lane] == 0.0 or drive.stopping[lane] == 1 or drive.braking[lane] == 1
    # While the encoder is aligned the motor is not in any mode.
    if stops or start_up.is_busy(drive, lane):
        flags |= FLAG_STOP
    elif drive.loop_level[lane] == 2.0:
        flags |= FLAG_POSITION
    elif drive.loop_level[lane] == 1.0:
        flags |= FLAG_VELOCITY
    else:
        flags |= FLAG_TORQUE
    if drive.mode_display[lane] == cia402.PP and drive.target_reached[lane] == 1:
        flags |= FLAG_POSITION_END
    if drive.chopper[lane] > 0.0:
        flags |= FLAG_BRAKE
    drive.status_flags[lane] = flags | drive.cause_flags[lane]
