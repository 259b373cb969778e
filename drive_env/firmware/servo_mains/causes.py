"""Causes of two-axis servo amplifiers on mains: the errors of the TGZ manual's table, by their physical cause.

A cause's status flag is its bit of the error register. Two errors have no documented physical cause: 2 is an
unspecified "internal hardware error", and 18 has only a name. They occur only if a machine sets them by error_bits, as
it can set every error.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from drive_env.firmware.common import causes, fsa, start_up
from drive_env.firmware.common.brake import CLOSED, PULL_IN, WITH_OUTPUT, WITH_STAGE
from drive_env.firmware.common.modes import CSP, acts_as
from drive_env.firmware.common.phases import open_load_a, open_load_b
from drive_env.firmware.common.protection import (
    BLOCKS_NEGATIVE,
    BLOCKS_POSITIVE,
    COMMUNICATION,
    CUT,
    FAULT_RESET,
    FOLLOWING_ERROR,
    LIMIT,
    STOP,
    WARN,
    Cause,
)
from drive_env.firmware.servo.causes import overcurrent_a, overcurrent_b
from drive_env.firmware.servo.causes import overcurrent_high_side as overcurrent_link
from drive_env.firmware.servo_mains.mains_link import owner
from mechanics.kernels.compiled import inlined, stage

REVERSE_TIME = 0.01  # s of accelerating against the current, after which the commutation is wrong
REVERSE_SHARE = 0.5  # of the current's limit, that must be demanded
OFF_TIME = 0.02  # s after which a switched-off stage has no current: several times a winding's L/R
STUCK_TIME = 0.1  # s of standstill under a brake that should be open
SWITCH_TIME = 0.2  # s in which the brake's switch must follow its output: several times the brake's time
BRAKE_SUPPLY = 21.6  # V: 24 V less 10 %, what holding brakes are specified for
# Bits of 1001h (TGZ manual): current, voltage, temperature, communication.
CURRENT, VOLTAGE, TEMPERATURE, NETWORK = 0x02, 0x04, 0x08, 0x10


@stage
def watch_motion(drive, lane, dt):
    """Measure how long causes of faults have been present: no power, following error, runaway, brake, its switch."""
    drive.off_time[lane] = 0.0 if drive.stage_on[lane] > 0.0 else drive.off_time[lane] + dt
    window = drive.following_error_window[lane]
    error = abs(drive.position_demand[lane] - drive.theta_meas[lane])
    follows = drive.drive_function[lane] > 0.0 and window > 0.0 and drive.loop_level[lane] > 0.0
    drive.following_time[lane] = drive.following_time[lane] + dt if follows and error > window else 0.0
    # The mean of the period: single values of a current that oscillates faster are arbitrary.
    asked = drive.asked_mean[lane]
    drive.asked_mean[lane] = 0.0
    most = REVERSE_SHARE * (drive.i_high[lane] if asked > 0.0 else -drive.i_low[lane])
    omega, slow = drive.omega_meas[lane], drive.omega_slow[lane]
    # It gains speed against the current. An oscillating axis also does, but loses the speed again.
    gained = omega - drive.omega_before[lane]
    drive.omega_before[lane] = omega
    runs_away = (
        drive.stage_on[lane] > 0.0
        and drive.torque_share[lane] > 0.0  # in open loop the current is not demanded for torque
        and abs(asked) > most
        and asked * omega < 0.0
        and asked * gained < 0.0
        and abs(omega) > drive.standstill[lane]
    )
    # All the time in one direction: it restarts at another sign of the current.
    way = 1.0 if asked > 0.0 else -1.0
    so_far = way * drive.reverse_time[lane]
    drive.reverse_time[lane] = way * ((so_far if so_far > 0.0 else 0.0) + dt) if runs_away else 0.0
    mode = drive.brake_mode[lane]
    held = (
        (mode == CLOSED or (mode == WITH_OUTPUT and drive.brake_opened[lane] == 0))
        and drive.stage_on[lane] > 0.0
        and abs(drive.velocity_demand[lane]) > drive.standstill[lane]
        and abs(slow) <= drive.standstill[lane]
    )
    drive.stuck_time[lane] = drive.stuck_time[lane] + dt if held else 0.0
    by_stage = mode == WITH_STAGE and drive.stage_on[lane] == 0.0
    is_closed = mode == CLOSED or by_stage or (mode == WITH_OUTPUT and drive.brake_opened[lane] == 0)
    is_wrong = is_closed == (drive.brake_output[lane] >= PULL_IN)
    watched = drive.brake_switch[lane] > 0.5 and drive.static_brake[lane] == 1
    drive.switch_time[lane] = drive.switch_time[lane] + dt if watched and is_wrong else 0.0


@stage
def mains_phase(drive, lane, told):
    """Return whether a phase of the mains is missing."""
    return drive.mains_phase_lost[owner(drive, lane)] > 0.5


@stage
def mains_supply(drive, lane, told):
    """Return whether the mains voltage is too low to charge the link."""
    return drive.supply_voltage[owner(drive, lane)] < drive.undervoltage[lane]


@stage
def holding_brake(drive, lane, told):
    """Return whether the brake holds a motor that it should have released."""
    return drive.stuck_time[lane] > STUCK_TIME


@stage
def holding_brake_switch(drive, lane, told):
    """Return whether the brake's switch has shown another state than the commanded one for too long."""
    return drive.switch_time[lane] > SWITCH_TIME


@stage
def current_measurement(drive, lane, told):
    """Return whether a current is measured although the stage has been off for OFF_TIME."""
    peak = max(drive.peak_a[lane], drive.peak_b[lane])
    return drive.off_time[lane] > OFF_TIME and peak > drive.offset_limit[lane]


@stage
def motor_thermostat(drive, lane, told):
    """Return whether the resistance of the motor's sensor is beyond its limits; false for a feedback without one."""
    found = drive.sensor_resistance[lane]
    return found > 0.0 and (found < drive.sensor_lowest[lane] or found > drive.sensor_highest[lane])


@stage
def ambient_temperature(drive, lane, told):
    """Return whether the ambient temperature is too high."""
    return drive.ambient[lane] > drive.ambient_limit[lane]


@stage
def feedback(drive, lane, told):
    """Return whether the encoder does not answer."""
    return drive.encoder_broken[lane] > 0.5


@stage
def commutation(drive, lane, told):
    """Return whether the motor speeds up against its current, or its angle could not be found."""
    failed = drive.init_state[lane] == start_up.FAILED and drive.fsa[lane] >= fsa.SWITCHED
    return failed or abs(drive.reverse_time[lane]) > REVERSE_TIME


@stage
def over_speed(drive, lane, told):
    """Return whether the motor turns too fast."""
    return abs(drive.omega_meas[lane]) > drive.overspeed[lane]


@stage
def contouring(drive, lane, told):
    """Return whether the following error exceeds P-Max..., or 6065h for longer than 6066h."""
    most = drive.error_turns[lane] + drive.error_angle[lane]
    by_position = drive.drive_function[lane] > 0.0 and drive.loop_level[lane] == 2.0
    if by_position and 0.0 < most < abs(drive.position_demand[lane] - drive.theta_meas[lane]):
        return True
    # In whole milliseconds; half a period avoids rounding errors of the sum.
    return drive.following_time[lane] > drive.following_error_time[lane] + 5e-4


@stage
def trajectory(drive, lane, told):
    """Return whether a cyclic set-point demands more speed than the motor may have."""
    cyclic = acts_as(drive.mode_display[lane]) == CSP and drive.drive_function[lane] > 0.0
    return cyclic and drive.stopping[lane] == 0 and abs(drive.velocity_demand[lane]) > drive.overspeed[lane]


@stage
def current_regulation(drive, lane, told):
    """Return whether a phase lacks the demanded current."""
    return open_load_a(drive, lane, told) or open_load_b(drive, lane, told)


@stage
def igbt_driver_voltage(drive, lane, told):
    """Return whether a phase has too much current, or the link is shorted: the transistors' drivers detect it."""
    too_much = overcurrent_a(drive, lane, told) or overcurrent_b(drive, lane, told)
    return too_much or overcurrent_link(drive, lane, told)


@stage
def emergency_stop(drive, lane, told):
    """Return whether the emergency stop button is pressed."""
    return drive.emergency_stop[lane] > 0.5


@stage
def brake_resistance(drive, lane, told):
    """Return whether the brake resistor is too hot."""
    return drive.brake_hot[lane] > 0.5


@stage
def brake_supply(drive, lane, told):
    """Return whether a brake must be released and its supply voltage is too low."""
    return drive.static_brake[lane] == 1 and drive.brake_supply[lane] < BRAKE_SUPPLY


@stage
def i2t(drive, lane, told):
    """Return whether the stage's I2t budget is used up, or the motor has more than M-Inull in the mean."""
    return drive.overload[lane] > 1.0 or drive.mean_motor_current[lane] > drive.nominal_motor_current[lane]


@stage
def motor_temperature(drive, lane, told):
    """Return whether the winding is too hot."""
    return drive.T_winding[lane] > drive.motor_temperature[lane]


@stage
def motor_parameter(drive, lane, told):
    """Return whether the motor's parameters are impossible."""
    i_peak = drive.peak_current[lane]
    return i_peak <= 0.0 or i_peak > drive.current_range[lane] or drive.pole_pairs[lane] < 1.0


@stage
def _never(drive, lane, told):
    return False


def _error(
    bit: int,
    name: str,
    reaction: int,
    condition: Callable[..., Any] = _never,
    *,
    register: int = 0,
    held: bool = False,
    known_as: str = "",
) -> Cause:
    """Return the row of an error: it is present by its condition, or because the machine sets it."""

    @inlined
    def is_there(drive, lane, told):
        return (drive.error_bits[lane] >> bit) & 1 == 1 or condition(drive, lane, told)

    return Cause(name, reaction, register, 1 << bit, is_there, held=held, known_as=known_as)


CAUSES = (
    Cause(FAULT_RESET, WARN, 0x00, 0x0),
    _error(0, "mains_phase", STOP, mains_phase),
    _error(1, "mains_supply", STOP, mains_supply),
    _error(2, "internal_error", CUT),
    _error(3, "over_voltage", CUT, causes.overvoltage, register=VOLTAGE),
    _error(4, "under_voltage", CUT, causes.undervoltage, register=VOLTAGE),
    _error(5, "sto", CUT, causes.shutdown_switch),
    _error(6, "holding_brake", CUT, holding_brake, held=True),
    _error(7, "holding_brake_switch", STOP, holding_brake_switch, held=True),
    _error(8, "current_measurement", CUT, current_measurement, register=CURRENT),
    _error(9, "motor_thermostat", STOP, motor_thermostat, register=TEMPERATURE),
    _error(10, "ambient_temperature", STOP, ambient_temperature),
    _error(11, "heat_sink_temperature", CUT, causes.overtemperature, register=TEMPERATURE),
    _error(12, "feedback", CUT, feedback, register=NETWORK),
    _error(13, "commutation", CUT, commutation, held=True),
    _error(14, "over_speed", CUT, over_speed, held=True),
    _error(15, "contouring", STOP, contouring, held=True, known_as=FOLLOWING_ERROR),
    _error(16, "trajectory", STOP, trajectory, held=True),
    # Also for causes outside the axis: its network was stopped or lost.
    _error(17, "host_communication", STOP, register=NETWORK, held=True, known_as=COMMUNICATION),
    _error(18, "drive_ramp_e2", STOP),
    _error(19, "current_regulation", CUT, current_regulation, register=CURRENT, held=True),
    _error(20, "emergency_stop", STOP, emergency_stop),
    _error(21, "igbt_driver_voltage", CUT, igbt_driver_voltage, register=CURRENT, held=True),
    _error(22, "brake_resistance", STOP, brake_resistance),
    _error(23, "brake_supply", STOP, brake_supply),
    _error(25, "i2t", STOP, i2t, held=True),
    _error(26, "motor_temperature", STOP, motor_temperature),
    _error(27, "motor_parameter", CUT, motor_parameter),
    # The manual has no code for them: they stop the axis, and set statusword bit 11.
    Cause("positive_software_limit", LIMIT, 0, 0, causes.above_limit, BLOCKS_POSITIVE, software=True, silent=True),
    Cause("negative_software_limit", LIMIT, 0, 0, causes.below_limit, BLOCKS_NEGATIVE, software=True, silent=True),
    # The axis has left its limits: it is no command, and ends nothing else.
    Cause(FAULT_RESET, WARN, 0x00, 0x0),
)
FAULTS = sum(1 << row for row, cause in enumerate(CAUSES) if cause.reaction in (CUT, STOP))  # as bits of `present`
