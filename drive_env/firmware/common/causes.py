"""Conditions of the causes that all drives share: supply, temperature, enable input, following error, limits.

A condition is evaluated once per supervision period: `told` is whether the cause was present at the previous one.
"""

from __future__ import annotations

from drive_env.firmware.common import inputs, limits
from drive_env.firmware.common.protection import (
    BLOCKS_NEGATIVE,
    BLOCKS_POSITIVE,
    COMMUNICATION,
    FAULT_RESET,
    LIMIT,
    LIMIT_REGISTER,
    STOP,
    WARN,
    Cause,
)
from mechanics.kernels.compiled import stage

HOMING = 6  # homing searches the limit switches


@stage
def undervoltage(drive, lane, told):
    """Return whether the DC link is too low."""
    return drive.u_dc[lane] < drive.undervoltage[lane]


@stage
def overvoltage(drive, lane, told):
    """Return whether the DC link is too high."""
    return drive.u_dc[lane] > drive.overvoltage[lane]


@stage
def warm(drive, lane, told):
    """Return whether the stage is warmer than its warning threshold."""
    return drive.T_stage[lane] > drive.warning_temperature[lane]


@stage
def overtemperature(drive, lane, told):
    """Return whether the stage is too hot."""
    return drive.T_stage[lane] > drive.warning_temperature[lane] and drive.T_stage[lane] > drive.error_temperature[lane]


@stage
def shutdown_switch(drive, lane, told):
    """Return whether the enable input is open."""
    return (drive.inputs[lane] & inputs.ENABLE) == 0


@stage
def following_error(drive, lane, told):
    """Return whether the axis is farther from its demand than the window of 6065h."""
    window = drive.following_error_window[lane]
    error = abs(drive.position_demand[lane] - drive.theta_meas[lane])
    return drive.drive_function[lane] > 0.0 and window > 0.0 and drive.loop_level[lane] > 0.0 and error > window


@stage
def _limits_count(drive, lane):
    """Return whether limits are checked: not in homing, which searches switches, nor before positions are valid."""
    return drive.drive_function[lane] > 0.0 and drive.mode_display[lane] != HOMING


@stage
def above_limit(drive, lane, told):
    """Return whether axis or demand is past the upper software limit (section 6.1.11); once reported, to its edge."""
    margin = 0.0 if told else limits.LIMIT_MARGIN
    past = drive.theta_meas[lane] > limits.corrected_maximum(drive, lane) + margin
    return _limits_count(drive, lane) and (past or limits.demand_above(drive, lane))


@stage
def below_limit(drive, lane, told):
    """Return whether axis or demand is past the lower software limit."""
    margin = 0.0 if told else limits.LIMIT_MARGIN
    past = drive.theta_meas[lane] < limits.corrected_minimum(drive, lane) - margin
    return _limits_count(drive, lane) and (past or limits.demand_below(drive, lane))


@stage
def positive_switch(drive, lane, told):
    """Return whether the right limit switch is active."""
    return _limits_count(drive, lane) and inputs.is_active(drive, lane, 1)


@stage
def negative_switch(drive, lane, told):
    """Return whether the left limit switch is active."""
    return _limits_count(drive, lane) and inputs.is_active(drive, lane, 0)


# The last rows of every drive with limit switches of its own.
LIMITS_AND_NETWORK = (
    Cause("positive_software_limit", LIMIT, LIMIT_REGISTER, 0x0, above_limit, BLOCKS_POSITIVE, software=True),
    Cause("negative_software_limit", LIMIT, LIMIT_REGISTER, 0x0, below_limit, BLOCKS_NEGATIVE, software=True),
    Cause("positive_limit_switch", LIMIT, LIMIT_REGISTER, 0x0, positive_switch, BLOCKS_POSITIVE),
    Cause("negative_limit_switch", LIMIT, LIMIT_REGISTER, 0x0, negative_switch, BLOCKS_NEGATIVE),
    # Causes outside the axis: its network was stopped or lost.
    Cause(COMMUNICATION, STOP, 0x10, 0x0),
    # The axis has left its limits: 0000h, too, as in CiA 301, but it is no command, and ends nothing else.
    Cause(FAULT_RESET, WARN, 0x00, 0x0),
)
