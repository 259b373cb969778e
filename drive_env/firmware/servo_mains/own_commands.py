"""Commands beyond CiA 402: control of the native image, and K-Command of the service modes.

The native image's control (bit 0 clear errors, bit 1 enable the power stage) acts at its edges, like the same commands
of a controlword; with D-Mode 3 it sets 6060h to 8 when it enables, since such a master knows no mode of operation. If
csv needs D-Mode 10, that sets it to 9, and the image's set-points are speeds as long as its control enables. A
controlword that stops an axis overrides an edge that enables it in the same period; it needs another edge then.

K-Command (bits 1 and 0 are 01: enable; bit 3: clear errors) is that of the maker's service program. It acts while the
master is disconnected or has no mode (6060h is 0), in the modes of the D-Mode: K-I, K-V or K-P_Angle and K-P_Revol are
the set-point in 1, 2 and 3, Speed of the profile generator in 6, and DPosAngle and DPosRevol in 7 (Speed, with its Mode
0). An axis enabled in this way makes a quick stop, and its power goes off, when K-Command, the D-Mode, or a matching
mode demands it; only after that is the master connected. It is enabled again by another 0 to 01 of K-Command, never by
one from before an error or power-on.
"""

from __future__ import annotations

from drive_env import cia402
from drive_env.firmware.common import fsa, modes
from drive_env.firmware.common.modes import CSP, CST, CSV, PP, PV, pp
from drive_env.firmware.servo_mains.causes import FAULTS
from drive_env.firmware.servo_mains.d_mode import QUICK_STOP
from mechanics.kernels.compiled import stage

CURRENT_MODE, VELOCITY_MODE, POSITION_MODE, SPEED_PROFILE, POSITION_PROFILE = 1, 2, 3, 6, 7  # D-Mode
FIELDBUS_SPEED = 10  # of firmware whose csv needs it
CLEAR, ENABLE = 0x01, 0x02  # bits of the native image's control
SERVICE_MASK, SERVICE_ENABLE, SERVICE_CLEAR = 0x03, 0x01, 0x08  # of K-Command
SHUTDOWN, SWITCH_ON, OPERATE = (
    int(cia402.COMMANDS[name].value) for name in ("shutdown", "switch on", "enable operation")
)
NEW_SET_POINT = int(cia402.NEW_SET_POINT)


@stage
def clear_errors(drive, lane):
    """Leave fault if no cause is present."""
    fsa.reset_fault(drive, lane, drive.present[lane] & FAULTS == 0)


@stage
def step_up(drive, lane):
    """Give the next command on the way to operation enabled; return whether the axis is in it."""
    state = drive.fsa[lane]
    if state == fsa.ENABLED:
        return True
    word = SHUTDOWN if state == fsa.DISABLED else (OPERATE if state == fsa.SWITCHED else SWITCH_ON)
    drive.controlword[lane] = OPERATE if drive.transition_pending[lane] == 4 else word
    fsa.command(drive, lane)
    return False


@stage
def native_mode(drive, lane):
    """Return the mode of operation of a D-Mode for the native image; 0 if it has none."""
    if drive.d_mode[lane] == POSITION_MODE:
        return CSP
    speed = drive.d_mode[lane] == FIELDBUS_SPEED and drive.d_mode_needed[CSV, lane] == FIELDBUS_SPEED
    return CSV if speed else 0


@stage
def is_stopped(drive, lane):
    """Return whether a command took the axis down a state, or into a quick stop, since the previous period."""
    before, now = drive.native_fsa[lane], drive.fsa[lane]
    return fsa.DISABLED < before <= fsa.ENABLED and (now < before or now > fsa.ENABLED)


@stage
def obey_native_control(drive, lane, dt):
    """Act on the edges of the native image's control."""
    control = int(drive.native_control[lane]) & (CLEAR | ENABLE)
    before = drive.native_before[lane]
    drive.native_before[lane] = control
    if is_stopped(drive, lane):
        drive.native_wants[lane] = 0
        before |= ENABLE & control
    if control & ~before & CLEAR:
        clear_errors(drive, lane)
    if control & ~before & ENABLE:
        drive.native_wants[lane] = 1
        mode = native_mode(drive, lane)
        if mode != 0 and drive.mode[lane] != mode:
            modes.request_mode(drive, lane, mode)
            drive.disconnected[lane] = 0
    if control & ENABLE and drive.mode[lane] == CSV and native_mode(drive, lane) == CSV:
        # 2^32 of the set-point are 1 rpm, while for a position they are a revolution.
        drive.target_velocity[lane] = drive.target_position[lane] / 60.0
    if before & ~control & ENABLE:
        drive.native_wants[lane] = 0
        drive.controlword[lane] = SHUTDOWN
        fsa.command(drive, lane)
    failed = drive.fsa[lane] == fsa.FAULTED or drive.fsa[lane] == fsa.REACTING or drive.disconnected[lane] == 1
    if drive.native_wants[lane] == 1 and (failed or step_up(drive, lane)):
        drive.native_wants[lane] = 0
    drive.native_fsa[lane] = drive.fsa[lane]


@stage
def service_mode(drive, lane):
    """Return the mode of operation of a D-Mode for K-Command; 0 if it has none."""
    own = drive.d_mode[lane]
    if own == CURRENT_MODE:
        return CST
    if own == VELOCITY_MODE:
        return CSV
    if own == POSITION_MODE:
        return CSP
    if own == SPEED_PROFILE or (own == POSITION_PROFILE and drive.profile_mode[lane] == 0):
        return PV
    return PP if own == POSITION_PROFILE else 0


@stage
def obey_service(drive, lane, dt):
    """Enable, stop and command an axis by K-Command; writes `service`: 0 off, 1 on, 2 stopping."""
    wants = drive.service_command[lane] & SERVICE_MASK == SERVICE_ENABLE
    clears = drive.service_command[lane] & SERVICE_CLEAR
    if clears and not drive.service_before[lane] & SERVICE_CLEAR and drive.gate_fits[lane] == 0:
        clear_errors(drive, lane)
    rises = wants and drive.service_before[lane] & SERVICE_MASK != SERVICE_ENABLE
    drive.service_before[lane] = drive.service_command[lane]
    mode = service_mode(drive, lane)
    faulted = drive.fsa[lane] == fsa.FAULTED or drive.fsa[lane] == fsa.REACTING
    alone = drive.disconnected[lane] == 1 or drive.mode[lane] == 0
    is_off = drive.drive_function[lane] == 0.0 and not faulted
    if drive.service[lane] == 0 and rises and alone and is_off and mode != 0:
        drive.service[lane] = 1
        drive.service_mode[lane] = mode
        drive.disconnected[lane] = 1
    if drive.service[lane] == 1 and faulted:
        drive.service[lane] = 2
    if drive.service[lane] == 1:
        if not wants or mode != drive.service_mode[lane] or drive.gate_fits[lane] == 1:
            drive.service[lane] = 2
            drive.controlword[lane] = QUICK_STOP
            fsa.command(drive, lane)
        else:
            step_up(drive, lane)
    if drive.service[lane] == 2 and drive.drive_function[lane] == 0.0:
        drive.service[lane] = 0
    if drive.service[lane] == 1 and drive.fsa[lane] == fsa.ENABLED:
        if drive.service_leads[lane] == 0:  # an earlier position must not move it
            drive.service_leads[lane] = 1
            drive.service_position[lane] = drive.theta_meas[lane]
            drive.profile_position[lane] = drive.theta_meas[lane]
        lead(drive, lane, mode)
    else:
        drive.service_leads[lane] = 0


@stage
def lead(drive, lane, mode):
    """Replace the master's mode and set-points by those of the service, for this period."""
    drive.masters_mode[lane] = drive.mode[lane]
    drive.masters_torque[lane] = drive.target_torque[lane]
    drive.masters_velocity[lane] = drive.target_velocity[lane]
    drive.masters_position[lane] = drive.target_position[lane]
    drive.masters_is_whole[lane] = drive.target_is_whole[lane]
    drive.leads[lane] = 1
    drive.mode[lane] = mode
    drive.target_is_whole[lane] = 1
    drive.target_torque[lane] = drive.service_current[lane] - drive.torque_offset[lane] if mode == CST else 0.0
    if mode == CSV:
        drive.target_velocity[lane] = drive.service_velocity[lane]
    elif mode == CSP:
        drive.target_position[lane] = drive.service_position[lane]
    elif mode == PP:
        drive.target_position[lane] = drive.profile_position[lane]
        new = drive.set_point_valid[lane] == 0 or drive.profile_position[lane] != drive.profile_taken[lane]
        if drive.mode_display[lane] == PP and new:
            drive.profile_taken[lane] = drive.profile_position[lane]
            drive.controlword[lane] = OPERATE | NEW_SET_POINT
            pp.new_set_point(drive, lane, OPERATE)
            drive.controlword[lane] = OPERATE
    if mode in (CSV, CSP):
        drive.set_point_fresh[lane] = 1


@stage
def give_back(drive, lane):
    """Restore the mode and set-points written by the master."""
    if drive.leads[lane] == 1:
        drive.leads[lane] = 0
        drive.mode[lane] = drive.masters_mode[lane]
        drive.target_torque[lane] = drive.masters_torque[lane]
        drive.target_velocity[lane] = drive.masters_velocity[lane]
        drive.target_position[lane] = drive.masters_position[lane]
        drive.target_is_whole[lane] = drive.masters_is_whole[lane]


@stage
def forget_commands(drive, lane):
    """Reset: no earlier command acts."""
    drive.native_before[lane] = int(drive.native_control[lane]) & (CLEAR | ENABLE)
    drive.native_wants[lane] = 0
    drive.native_fsa[lane] = drive.fsa[lane]
    drive.service_before[lane] = drive.service_command[lane]
    drive.service[lane] = 0
    drive.leads[lane] = 0
