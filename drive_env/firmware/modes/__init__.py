"""Modes of operation: the table of modes, and the stage that turns the present mode's targets into demands."""

from __future__ import annotations

from typing import NamedTuple

from drive_env.firmware import fsa, profiles
from drive_env.firmware.modes import cst, idle, pp, pv
from mechanics.compiled import stage


class Mode(NamedTuple):
    """A row: value of 6060h, abbreviation, name, bit of 6502h (None for no mode), innermost loop with a set-point."""

    number: int
    abbreviation: str
    name: str
    supported_bit: int | None
    loop_level: int


MODES = (
    Mode(0, "no", "No mode", None, 1),
    Mode(1, "pp", "Profile position mode", 0, 2),
    Mode(3, "pv", "Profile velocity mode", 2, 1),
    Mode(10, "cst", "Cyclic synchronous torque mode", 9, 0),
)
PP, PV, CST = 1, 3, 10


@stage
def slow_down_ramp(drive, lane):
    """Return the deceleration [rad/s^2] of the mode in use; 0 where it is not set, which stops at once.

    pv has one ramp for both ways (manual, 6083h); cst and no mode have none of their own and take 6084h.
    """
    rate = drive.deceleration[lane]
    if drive.mode_display[lane] == PV or rate == 0.0:
        rate = drive.acceleration[lane]
    return rate


@stage
def stop_ramp(drive, lane):
    """Return the deceleration of the stop that runs: by 605Ah or 605Eh on the quick stop ramp, else the mode's."""
    state = drive.fsa[lane]
    option = drive.quick_stop_option[lane]
    if state == fsa.REACTING or (state == fsa.STOPPING and (option == 2 or option == 6)):
        return drive.quick_stop_deceleration[lane]
    return slow_down_ramp(drive, lane)


@stage
def brake(drive, lane, rate, dt):
    """Bring the demand to standstill; a torque mode is braked by the velocity loop."""
    if drive.loop_level[lane] == 0:
        drive.loop_level[lane] = 1
        drive.velocity_demand[lane] = drive.omega_meas[lane]
        drive.position_demand[lane] = drive.theta_meas[lane]
    x, v = profiles.stop(drive.position_demand[lane], drive.velocity_demand[lane], rate, dt)
    drive.position_demand[lane] = x
    drive.velocity_demand[lane] = v


@stage
def change_mode(drive, lane):
    """Make the requested mode the present one, without a jump: demands start from the motion there is."""
    before = drive.loop_level[lane]
    if before == 0:
        drive.velocity_demand[lane] = drive.omega_meas[lane]
    if before != 2:
        drive.position_demand[lane] = drive.theta_meas[lane]
    drive.mode_display[lane] = drive.mode[lane]
    drive.set_point_valid[lane] = 0
    drive.set_point_acknowledged[lane] = 0
    drive.target_reached[lane] = 0
    drive.in_window_time[lane] = 0.0


@stage
def generate_demand(drive, lane, dt):
    """Run the mode for one period of dt [s]: reads targets; writes position, velocity or torque demand and bit 10."""
    if drive.mode[lane] != drive.mode_display[lane]:
        change_mode(drive, lane)
    mode = drive.mode_display[lane]
    if drive.drive_function[lane] == 0.0:
        drive.position_demand[lane] = drive.theta_meas[lane]
        drive.velocity_demand[lane] = 0.0
        drive.torque_demand[lane] = 0.0
        drive.target_reached[lane] = 0
        return
    halted = (drive.controlword[lane] & fsa.BIT_HALT) != 0
    if drive.stopping[lane] == 1:
        brake(drive, lane, stop_ramp(drive, lane), dt)
        drive.target_reached[lane] = 1 if drive.velocity_demand[lane] == 0.0 else 0
    elif halted and mode != 0:
        brake(drive, lane, slow_down_ramp(drive, lane), dt)
        # CiA 402: with halt set, bit 10 tells that the axis has come to rest.
        drive.target_reached[lane] = 1 if drive.velocity_demand[lane] == 0.0 else 0
    elif mode == PP:
        pp.generate(drive, lane, slow_down_ramp(drive, lane), dt)
    elif mode == PV:
        pv.generate(drive, lane, dt)
    elif mode == CST:
        cst.generate(drive, lane)
    else:
        idle.generate(drive, lane, slow_down_ramp(drive, lane), dt)


@stage
def bit_12(drive, lane):
    """Return bit 12 of the statusword as the present mode documents it."""
    mode = drive.mode_display[lane]
    if mode == PP:
        return drive.set_point_acknowledged[lane] == 1
    if mode == CST:
        # Table 283: 1 while the target torque is the input of the control loop.
        return (
            drive.fsa[lane] == fsa.ENABLED
            and drive.stopping[lane] == 0
            and (drive.controlword[lane] & fsa.BIT_HALT) == 0
        )
    return False


# Bits of 2101h (table 85); those of the faults are the protection's.
FLAG_HALTED, FLAG_STOP, FLAG_VELOCITY, FLAG_POSITION, FLAG_TORQUE = 1 << 4, 1 << 8, 1 << 9, 1 << 10, 1 << 11
FLAG_POSITION_END, FLAG_INITIALIZED = 1 << 14, 1 << 15


@stage
def status_flags(drive, lane):
    """Return the bits of 2101h that tell what the motor does."""
    flags = FLAG_INITIALIZED
    if abs(drive.omega_slow[lane]) <= drive.standstill[lane]:
        flags |= FLAG_HALTED
    if drive.drive_function[lane] == 0.0 or drive.stopping[lane] == 1:
        flags |= FLAG_STOP
    elif drive.loop_level[lane] == 2.0:
        flags |= FLAG_POSITION
    elif drive.loop_level[lane] == 1.0:
        flags |= FLAG_VELOCITY
    else:
        flags |= FLAG_TORQUE
    if drive.mode_display[lane] == PP and drive.target_reached[lane] == 1:
        flags |= FLAG_POSITION_END
    return flags
