"""Objects of CiA 402 that this emulator gives an effect, and the substitutes for those that a drive lacks.

A row of `STANDARD` binds an object of the standard to a field of the drive record. Its unit is one of `dictionary/
units.py`, or the name of a quantity that each drive counts in its own unit: velocity, acceleration, torque.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from drive_env import cia402
from drive_env.dictionary.bindings import Binding

VELOCITY, ACCELERATION, TORQUE = "velocity", "acceleration", "torque"
ERROR_REGISTER = 0x1001
# Numbers of 6098h that homing knows (firmware/common/modes/hm.py).
HOMING_METHODS = (*range(1, 15), *range(17, 31), 33, 34, 35, 37)
HOMING_HERE = (35, 37)  # which need no switch
# Values of 605Ah that the automaton knows (firmware/common/fsa.py).
QUICK_STOP_OPTIONS = (1, 2, 5, 6)

STANDARD = (
    Binding(ERROR_REGISTER, 0, "error_register"),
    Binding(cia402.CONTROLWORD, 0, "controlword", event="controlword"),
    Binding(cia402.STATUSWORD, 0, "statusword"),
    Binding(cia402.QUICK_STOP_OPTION, 0, "quick_stop_option"),
    Binding(cia402.MODE, 0, "mode", event="mode"),
    Binding(cia402.MODE_DISPLAY, 0, "mode_display"),
    Binding(cia402.POSITION_DEMAND, 0, "position_demand", "counter"),
    Binding(cia402.POSITION_INTERNAL, 0, "theta_meas", "counter"),
    Binding(cia402.POSITION_ACTUAL, 0, "theta_meas", "counter"),
    Binding(cia402.FOLLOWING_WINDOW, 0, "following_error_window", "position window"),
    Binding(cia402.POSITION_WINDOW, 0, "position_window", "position window"),
    Binding(cia402.POSITION_WINDOW_TIME, 0, "position_window_time", "ms"),
    Binding(cia402.VELOCITY_DEMAND, 0, "velocity_demand", VELOCITY),
    Binding(cia402.VELOCITY_ACTUAL, 0, "omega_meas", VELOCITY),
    Binding(cia402.TARGET_TORQUE, 0, "target_torque", TORQUE),
    Binding(cia402.MAX_CURRENT, 0, "i_max", TORQUE),
    Binding(cia402.TORQUE_DEMAND, 0, "i_q_ref", TORQUE),
    Binding(cia402.TORQUE_ACTUAL, 0, "torque_meas", TORQUE),
    Binding(cia402.CURRENT_ACTUAL, 0, "torque_meas", TORQUE),
    Binding(cia402.DC_LINK_VOLTAGE, 0, "u_dc", "mV"),
    Binding(cia402.TARGET_POSITION, 0, "target_position", "inc", event="set_point"),
    Binding(cia402.HOME_OFFSET, 0, "home_offset", "inc"),
    Binding(cia402.POSITION_LIMITS, 1, "position_min", "position limit"),
    Binding(cia402.POSITION_LIMITS, 2, "position_max", "position limit"),
    Binding(cia402.MAX_PROFILE_VELOCITY, 0, "velocity_limit", VELOCITY),
    Binding(cia402.PROFILE_VELOCITY, 0, "max_velocity", VELOCITY),
    Binding(cia402.PROFILE_ACCELERATION, 0, "acceleration", ACCELERATION),
    Binding(cia402.PROFILE_DECELERATION, 0, "deceleration", ACCELERATION),
    Binding(cia402.QUICK_STOP_DECELERATION, 0, "quick_stop_deceleration", ACCELERATION),
    Binding(cia402.HOMING_METHOD, 0, "homing_method"),
    Binding(cia402.HOMING_SPEEDS, 1, "homing_fast", VELOCITY),
    Binding(cia402.HOMING_SPEEDS, 2, "homing_slow", VELOCITY),
    Binding(cia402.HOMING_ACCELERATION, 0, "homing_acceleration", ACCELERATION),
    Binding(cia402.POSITION_OFFSET, 0, "position_offset", "inc", event="set_point"),
    Binding(cia402.VELOCITY_OFFSET, 0, "velocity_offset", VELOCITY, event="set_point"),
    Binding(cia402.TORQUE_OFFSET, 0, "torque_offset", TORQUE),
    Binding(cia402.INTERPOLATION_DATA, 1, "target_position", "inc", event="set_point"),
    Binding(cia402.INTERPOLATION_PERIOD, 1, "interpolation_value"),
    Binding(cia402.INTERPOLATION_PERIOD, 2, "interpolation_index"),
    Binding(cia402.POSITIONING_OPTIONS, 0, "positioning_option"),
    Binding(cia402.FOLLOWING_ERROR, 0, "position_error", "inc"),
    Binding(cia402.DIGITAL_INPUTS, 0, "inputs"),
    Binding(cia402.TARGET_VELOCITY, 0, "target_velocity", VELOCITY, event="set_point"),
)

# Objects whose value the emulator shows or obeys by itself, without a field of the record.
BY_THEMSELVES = (cia402.ERROR_CODE, cia402.SUPPORTED_MODES)

# What a reader must know of objects that are stored and have no effect here.
WITHOUT_EFFECT: Mapping[int, str] = {
    cia402.ABORT_CONNECTION_OPTION: "a lost master is answered by 1029h and a fault, whatever it says",
    cia402.SHUTDOWN_OPTION: "a shutdown takes the voltage away at once",
    cia402.DISABLE_OPERATION_OPTION: "disable operation brakes with the mode's ramp",
    cia402.HALT_OPTION: "halt brakes with the mode's ramp and holds the axis",
    cia402.FAULT_REACTION_OPTION: "a fault cuts the voltage or brakes, each cause as device.toml's firmware has it",
    cia402.FOLLOWING_TIMEOUT: "a following error beyond 6065h is a fault at once",
    cia402.VELOCITY_WINDOW: "bit 10 of the statusword tells in pv that the ramp has ended",
    cia402.VELOCITY_WINDOW_TIME: "as 606Dh",
    cia402.VELOCITY_THRESHOLD: "standstill is [motion] standstill of device.toml",
    cia402.VELOCITY_THRESHOLD_TIME: "as 606Fh",
    cia402.MAX_TORQUE: "the current is limited by 6073h, or by the emulator's own object",
    cia402.RATED_CURRENT: "thousandths count from [current] rated of device.toml",
    cia402.RATED_TORQUE: "thousandths count from [current] rated of device.toml",
    cia402.POLARITY: "directions are not turned round",
    cia402.MAX_MOTOR_SPEED: "no speed is limited by it",
    cia402.END_VELOCITY: "a move of pp ends at rest",
    cia402.PROFILE_TYPE: "ramps are linear",
    cia402.PROFILE_JERK: "ramps are linear",
    cia402.TOUCH_PROBE: "there is no touch probe",
    cia402.DIGITAL_OUTPUTS: "nothing is connected to the outputs",
    **dict.fromkeys(
        (cia402.POSITION_UNIT, cia402.VELOCITY_UNIT, cia402.ACCELERATION_UNIT),
        "its factory value told units as the folder was made; a write changes nothing",
    ),
    **dict.fromkeys(
        (cia402.ENCODER_RESOLUTION, cia402.GEAR_RATIO, cia402.FEED_CONSTANT),
        "another object gives the scale of positions",
    ),
    cia402.MOTOR_TYPE: "the motor is the machine's",
}


class OwnObject(NamedTuple):
    """An object of the emulator's own, where a drive has none: a name, a type of variants.py, a field, its unit."""

    name: str
    kind: str
    field: str
    unit: str = "raw"
    why: str = ""


# Always there: CiA 402 has no objects for a motor's wiring and a drive's loops.
GAINS = (
    OwnObject("Current P", "u32", "current_p", "current P"),
    OwnObject("Current I", "u32", "current_i", "I"),
    OwnObject("Velocity P", "u32", "velocity_p", "velocity P"),
    OwnObject("Velocity I", "u32", "velocity_i", "I"),
    OwnObject("Position P", "u32", "position_p", "position P"),
)
MOTOR = (
    OwnObject("Motor type", "u8", "motor_type"),
    OwnObject("Commutation mode", "u8", "commutation_mode"),
    OwnObject("Pole pairs", "u8", "pole_pairs"),
    OwnObject("Encoder direction", "u8", "encoder_direction"),
    OwnObject("Encoder steps", "u32", "encoder_steps"),
    OwnObject("Encoder initialisation", "u8", "encoder_init_mode"),
    OwnObject("Hall polarity", "u8", "hall_polarity"),
    OwnObject("Hall direction", "u8", "hall_direction"),
    OwnObject("Use of the limit switches", "u32", "limit_switches"),
)
MOTOR_ROLES = {
    "motor_type": "motor_type", "commutation_mode": "commutation", "pole_pairs": "pole_pairs",
    "encoder_direction": "encoder_direction", "encoder_steps": "encoder_steps",
    "encoder_init_mode": "encoder_initialisation", "hall_polarity": "hall_polarity", "hall_direction": "hall_direction",
    "limit_switches": "limit_switches",
}  # fmt: skip
# Where the EDS lacks the standard's object for a field, and a mode of the drive needs it (None: every drive does).
NEEDED: tuple[tuple[OwnObject, tuple[int, ...] | None], ...] = (
    (
        OwnObject("Increments of a revolution", "u32", "position_scaler", "raw", "no 608Fh, 6092h, 60A8h for it"),
        None,
    ),
    (OwnObject("Current limit", "u16", "i_max", TORQUE, "no 6073h"), None),
    (OwnObject("Lowest position", "i32", "position_min", "position limit", "no 607Dh"), None),
    (OwnObject("Highest position", "i32", "position_max", "position limit", "no 607Dh"), None),
    (OwnObject("Quick stop deceleration", "u32", "quick_stop_deceleration", ACCELERATION, "no 6085h"), None),
    (OwnObject("Acceleration", "u32", "acceleration", ACCELERATION, "no 6083h"), (cia402.PP, cia402.PV)),
    (OwnObject("Profile velocity", "u32", "max_velocity", VELOCITY, "no 6081h"), (cia402.PP,)),
    (OwnObject("Homing method", "i8", "homing_method", "raw", "no 6098h"), (cia402.HM,)),
    (OwnObject("Homing speed, switch", "u32", "homing_fast", VELOCITY, "no 6099h"), (cia402.HM,)),
    (OwnObject("Homing speed, zero", "u32", "homing_slow", VELOCITY, "no 6099h"), (cia402.HM,)),
    (OwnObject("Homing acceleration", "u32", "homing_acceleration", ACCELERATION, "no 609Ah"), (cia402.HM,)),
    (OwnObject("Position window", "u32", "position_window", "position window", "no 6067h"), (cia402.PP,)),
    (OwnObject("Position window time", "u16", "position_window_time", "ms", "no 6068h"), (cia402.PP,)),
)
