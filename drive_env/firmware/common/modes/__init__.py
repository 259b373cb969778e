"""Modes of operation: the table of modes, and the stage that converts the present mode's targets to demands."""

from __future__ import annotations

from typing import NamedTuple

from drive_env import cia402
from drive_env.firmware.common import fsa, profiles, protection, start_up
from drive_env.firmware.common.modes import csp, cst, csv, cyclic, hm, idle, pp, pv, vl
from mechanics.kernels.compiled import stage


class Mode(NamedTuple):
    """A row: value of 6060h, abbreviation, name, bit of 6502h (None for "no mode"), innermost loop with a set-point."""

    number: int
    abbreviation: str
    name: str
    supported_bit: int | None
    loop_level: int


MODES = (
    Mode(0, "no", "No mode", None, 1),
    Mode(cia402.PP, "pp", "Profile position mode", 0, 2),
    Mode(cia402.VL, "vl", "Velocity mode", 1, 1),
    Mode(cia402.PV, "pv", "Profile velocity mode", 2, 1),
    Mode(cia402.TQ, "tq", "Profile torque mode", 3, 0),
    Mode(cia402.HM, "hm", "Homing mode", 5, 2),
    Mode(cia402.IP, "ip", "Interpolated position mode", 6, 2),
    Mode(cia402.CSP, "csp", "Cyclic synchronous position mode", 7, 2),
    Mode(cia402.CSV, "csv", "Cyclic synchronous velocity mode", 8, 1),
    Mode(cia402.CST, "cst", "Cyclic synchronous torque mode", 9, 0),
)
PP, PV, HM, CSP, CSV, CST = cia402.PP, cia402.PV, cia402.HM, cia402.CSP, cia402.CSV, cia402.CST
TQ, IP, VL = cia402.TQ, cia402.IP, cia402.VL


@stage
def acts_as(mode):
    """Return the mode whose generator a mode uses: csp for ip, cst for tq (TGZ manual)."""
    if mode == IP:
        return CSP
    return CST if mode == TQ else mode


@stage
def slow_down_ramp(drive, lane):
    """Return the deceleration [rad/s^2] of the mode in use; 0 if it is not set, which stops at once.

    pv uses 6083h for both directions (TMCM-1636 manual), except on drives that slow down with 6084h; hm uses 609Ah; cst
    and "no mode" use 6084h.
    """
    rate = drive.homing_acceleration[lane] if drive.mode_display[lane] == HM else 0.0
    if rate == 0.0:
        rate = drive.deceleration[lane]
    if drive.mode_display[lane] == PV:
        return pv.slow_down_ramp(drive, lane)
    if drive.mode_display[lane] == VL:
        return vl.slow_down_ramp(drive, lane)
    return rate if rate > 0.0 else drive.acceleration[lane]


@stage
def quick_stop_ramp(drive, lane):
    """Return the deceleration of a quick stop [rad/s^2] in the mode in use."""
    return vl.quick_stop_ramp(drive, lane) if drive.mode_display[lane] == VL else drive.quick_stop_deceleration[lane]


@stage
def stop_ramp(drive, lane):
    """Return the deceleration of the present stop: the quick stop's if 605Ah or 605Eh say so, else the mode's."""
    state = drive.fsa[lane]
    option = drive.quick_stop_option[lane]
    if state == fsa.REACTING or (state == fsa.STOPPING and (option == 2 or option == 6)):
        return quick_stop_ramp(drive, lane)
    return slow_down_ramp(drive, lane)


@stage
def lag_of_demand(drive, lane):
    """Return the position loop's lag behind its demand at the demanded speed; its gain must not be 0."""
    return drive.velocity_demand[lane] * (1.0 - drive.feed_forward[lane]) / drive.position_p[lane]


@stage
def start_braking(drive, lane):
    """Let a stop begin with the actual motion, if that differs from the demand.

    A torque mode has no speed demand; a set-point of csp may jump; and after a following error the axis is not at its
    demand.
    """
    level = drive.loop_level[lane]
    if level != 0 and acts_as(drive.mode_display[lane]) != CSP and drive.fsa[lane] != fsa.REACTING:
        return
    drive.velocity_demand[lane] = drive.omega_meas[lane]
    drive.position_demand[lane] = drive.theta_meas[lane]
    if level == 0:
        drive.loop_level[lane] = 1
    elif level == 2 and drive.position_p[lane] > 0.0:
        drive.position_demand[lane] += lag_of_demand(drive, lane)


@stage
def brake(drive, lane, rate, dt):
    """Bring the demand to standstill; a torque mode is braked by the velocity loop."""
    if drive.braking[lane] == 0:
        drive.braking[lane] = 1
        start_braking(drive, lane)
    x, v = profiles.stop(drive.position_demand[lane], drive.velocity_demand[lane], rate, dt)
    drive.position_demand[lane] = x
    drive.velocity_demand[lane] = v


@stage
def change_mode(drive, lane):
    """Change to the requested mode without a jump: demands start from the actual motion."""
    before = drive.loop_level[lane]
    if before == 0 or acts_as(drive.mode_display[lane]) == CSP:
        # A set-point of csp may have jumped: its speed in one period is not one that the axis has or could brake from.
        drive.velocity_demand[lane] = drive.omega_meas[lane]
    if before != 2:
        drive.position_demand[lane] = drive.theta_meas[lane]
    drive.mode_display[lane] = drive.mode[lane]
    by_position = drive.mode[lane] == PP or drive.mode[lane] == HM or acts_as(drive.mode[lane]) == CSP
    if before != 2 and by_position and drive.position_p[lane] > 0.0:
        # The position loop demands the present speed only with its lag at that speed.
        lag = lag_of_demand(drive, lane)
        window = drive.following_error_window[lane]
        if window == 0.0 or abs(lag) < window:
            drive.position_demand[lane] += lag
    drive.set_point_valid[lane] = 0
    drive.set_point_acknowledged[lane] = 0
    drive.target_reached[lane] = 0
    drive.in_window_time[lane] = 0.0
    cyclic.forget(drive, lane)
    hm.forget(drive, lane)


@stage
def may_change_mode(drive, lane):
    """Return whether the written mode takes effect now: after its delay and, if the drive needs it, at a halt."""
    if drive.mode_wait[lane] > 0.0:
        return False
    if drive.mode_needs_halt[lane] == 0 or drive.fsa[lane] != fsa.ENABLED:
        return True
    return (drive.controlword[lane] & cia402.HALT) != 0 and drive.velocity_demand[lane] == 0.0


@stage
def request_mode(drive, lane, mode):
    """Handle a write of 6060h: the mode changes at once, unless it must wait."""
    drive.mode[lane] = mode
    drive.mode_wait[lane] = drive.mode_delay[lane]
    if mode != drive.mode_display[lane] and may_change_mode(drive, lane):
        change_mode(drive, lane)


@stage
def asked_direction(drive, lane):
    """Return the sign of the motion that the targets of the present mode demand."""
    mode = acts_as(drive.mode_display[lane])
    way = 0.0
    if mode == PP:
        way = drive.profile_target[lane] - drive.position_demand[lane] if drive.set_point_valid[lane] == 1 else 0.0
    elif mode == PV:
        way = drive.target_velocity[lane]
    elif mode == VL:
        way = vl.ramp_input(drive, lane)
    elif mode == CSP and drive.set_point_steps[lane] != cyclic.NO_SET_POINT:
        way = drive.target_position[lane] + drive.position_offset[lane] - drive.position_demand[lane]
    elif mode == CSV:
        way = drive.target_velocity[lane] + drive.velocity_offset[lane]
    elif mode == CST:
        way = drive.target_torque[lane] + drive.torque_offset[lane]
    return 1.0 if way > 0.0 else (-1.0 if way < 0.0 else 0.0)


@stage
def is_blocked(drive, lane):
    """Return whether a limit of travel forbids the demanded motion; motion away from it is allowed."""
    way = asked_direction(drive, lane)
    blocked = drive.blocked[lane]
    return (way > 0.0 and blocked & protection.BLOCKS_POSITIVE) or (way < 0.0 and blocked & protection.BLOCKS_NEGATIVE)


@stage
def follow(drive, lane, mode, dt):
    """Run the mode's own generator for one period of dt [s]."""
    if mode == PP:
        pp.generate(drive, lane, slow_down_ramp(drive, lane), dt)
    elif mode == PV:
        pv.generate(drive, lane, dt)
    elif mode == VL:
        vl.generate(drive, lane, dt)
    elif mode == HM:
        hm.generate(drive, lane, dt)
    elif mode == CSP:
        csp.generate(drive, lane, dt)
    elif mode == CSV:
        csv.generate(drive, lane, dt)
    elif mode == CST:
        cst.generate(drive, lane)
    else:
        idle.generate(drive, lane, slow_down_ramp(drive, lane), dt)


@stage
def generate_demand(drive, lane, dt):
    """Run the mode for one period of dt [s]: reads targets; writes position, velocity or torque demand and bit 10."""
    if drive.mode[lane] != drive.mode_display[lane]:
        drive.mode_wait[lane] -= dt
        if drive.mode_wait[lane] < 0.5 * dt:
            drive.mode_wait[lane] = 0.0
        if may_change_mode(drive, lane):
            change_mode(drive, lane)
    if drive.set_point_waiting[lane] == 1 and drive.set_point_valid[lane] == 0:
        pp.empty_buffer(drive, lane)
    mode = acts_as(drive.mode_display[lane])
    # Generators without bows leave no acceleration for a later ramp with bows.
    drive.acceleration_before[lane] = drive.acceleration_demand[lane]
    drive.acceleration_demand[lane] = 0.0
    if drive.drive_function[lane] == 0.0:
        drive.position_demand[lane] = drive.theta_meas[lane]
        drive.velocity_demand[lane] = 0.0
        drive.torque_demand[lane] = 0.0
        drive.target_reached[lane] = 0
        drive.braking[lane] = 0
        cyclic.forget(drive, lane)
        return
    if start_up.is_busy(drive, lane):
        drive.position_demand[lane] = drive.theta_meas[lane]
        drive.velocity_demand[lane] = 0.0
        drive.velocity_sum[lane] = 0.0
        return
    if mode != PP and mode != CSP:
        drive.internal_limit[lane] = 0
    halted = (drive.controlword[lane] & cia402.HALT) != 0
    if drive.stopping[lane] == 1:
        brake(drive, lane, stop_ramp(drive, lane), dt)
        drive.target_reached[lane] = 1 if drive.velocity_demand[lane] == 0.0 else 0
    elif halted and mode != 0 and mode != HM:
        brake(drive, lane, slow_down_ramp(drive, lane), dt)
        # CiA 402: with halt set, bit 10 shows that the axis has come to rest.
        drive.target_reached[lane] = 1 if drive.velocity_demand[lane] == 0.0 else 0
    elif is_blocked(drive, lane):
        brake(drive, lane, quick_stop_ramp(drive, lane), dt)
        drive.internal_limit[lane] = 1
        drive.target_reached[lane] = 0
        if drive.velocity_demand[lane] == 0.0:
            drive.set_point_valid[lane] = 0
    else:
        drive.braking[lane] = 0
        follow(drive, lane, mode, dt)
    if mode in (CSP, CSV, CST):
        drive.target_reached[lane] = 0  # bit 10 is reserved in these modes


@stage
def mode_bits(drive, lane):
    """Return bit 12 of the statusword of the present mode (TMCM-1636 manual, tables 148, 217, 237, 263, 283)."""
    mode = acts_as(drive.mode_display[lane])
    bits = 0
    if mode == PP:
        if drive.set_point_acknowledged[lane] == 1:
            bits |= 0x1000
    elif mode == HM:
        if drive.homing_attained[lane] == 1:
            bits |= 0x1000
    elif (
        # 1 while the target is the input of the control loop.
        mode in (CSP, CSV, CST)
        and drive.fsa[lane] == fsa.ENABLED
        and drive.stopping[lane] == 0
        and (drive.controlword[lane] & cia402.HALT) == 0
        and not is_blocked(drive, lane)
    ):
        bits |= 0x1000
    return bits
