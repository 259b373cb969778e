"""Roles: functions of objects on a drive, independent of their index; a device's `roles.toml` names the object of each.

A role can be used wherever an object is named: `drives.read(Role.CURRENT_LIMIT)`. `device.roles` has those of a device;
access by another role is an error that names it.
"""

from __future__ import annotations

from enum import Enum

from drive_env import cia402


class Role(Enum):
    """A function of an object; the value is its name in messages."""

    POSITION_SCALE = "scale of positions (increments of a revolution)"
    ENCODER_INCREMENTS = "increments of the encoder"
    ENCODER_TURNS = "revolutions of the motor that have them"
    FEED = "units of position"
    FEED_TURNS = "revolutions of the driving shaft that have them"
    GEAR_MOTOR = "revolutions of the motor"
    GEAR_SHAFT = "revolutions of the driving shaft that it makes of them"
    POSITION_INSIDE = "actual position inside the drive"
    TARGET_INSIDE = "target position inside the drive"
    POSITION_NUMERATOR = "increments inside of a position unit: numerator"
    POSITION_DIVISOR = "increments inside of a position unit: divisor"
    VELOCITY_NUMERATOR = "rpm of a velocity unit: numerator"
    VELOCITY_DIVISOR = "rpm of a velocity unit: divisor"
    SET_POINT_NUMERATOR = "velocity units of a target velocity of vl: numerator"
    SET_POINT_DIVISOR = "velocity units of a target velocity of vl: denominator"
    PEAK_CURRENT = "peak current of the motor, whose parts torques are"
    PROFILE_BITS = "increments of a revolution of the profile generator, as a power of two"
    SET_CYCLE = "cycle of communication that the drive is set to [us]"
    SYNC_TIME = "measured time between two pulses that outputs take effect with"
    PACKET_TIME = "measured time between two packets of process data"
    NATIVE_CONTROL = "control of an image that knows no controlword"
    SERVICE_COMMAND = "command of the maker's service program"
    OUTPUTS_OWN = "digital outputs of an axis, every second one"
    OUTPUTS_SET = "digital outputs of an axis that are set by force"
    OUTPUTS_CLEAR = "digital outputs of an axis that are cleared by force"
    MODE_GATE = "mode of the drive that a mode of operation needs"
    OUTPUT_IMAGE = "process image into the drive that it begins with"
    INPUT_IMAGE = "process image out of the drive that it begins with"
    FULL_STEPS = "full steps of a revolution"
    MICROSTEPS = "microsteps of a full step, as a power of two"
    CURRENT_LIMIT = "current limit"
    CURRENT_LIMIT_NEGATIVE = "current limit the other way, of drives that have two"
    NOMINAL_CURRENT = "nominal current of the motor, whose thousandths current limits are"
    OPEN_LOOP_CURRENT = "open-loop current"
    MOTOR_TYPE = "motor type"
    COMMUTATION = "commutation mode"
    POLE_PAIRS = "number of pole pairs"
    LOAD_VALUE = "load reading of a stepper"
    STALL_SPEED = "speed above which a stall stops the motor"
    COOLSTEP_SPEED = "speed above which the current follows the load"
    SHAFT_DIRECTION = "direction of the shaft"
    MOTOR_FLAGS = "status flags of the motor"
    LIMIT_SWITCHES = "use of the limit switches"
    ENCODER_DIRECTION = "direction of the encoder"
    ENCODER_STEPS = "steps of the encoder"
    ENCODER_INITIALISATION = "initialisation of the encoder"
    HALL_POLARITY = "polarity of the hall sensors"
    HALL_DIRECTION = "direction of the hall sensors"
    LOOP_MODE = "mode of the loop that an encoder closes around a stepper"
    LOOP_INITIALISED = "whether that loop commutates"
    FIELD_ANGLE = "angle of the field in open loop"
    ELECTRICAL_ANGLE = "electrical angle by the encoder"
    HALL_ANGLE = "electrical angle by the hall sensors"
    TORQUE_ERROR = "error of the torque current"
    TORQUE_ERROR_SUM = "error sum of the torque current"
    FLUX_ERROR = "error of the flux current"
    FLUX_ERROR_SUM = "error sum of the flux current"
    BRAKE_CHOPPER = "brake chopper"
    BRAKE_CHOPPER_VOLTAGE = "voltage of the brake chopper"
    BRAKE_RELEASE_CURRENT = "current of the brake output while the brake is released"
    DIGITAL_INPUTS = "digital inputs that belong to no axis"
    OUTPUTS = "digital outputs"
    OUTPUTS_MASK = "mask of the digital outputs"
    ANALOG_INPUTS = "analog inputs"


# Of CiA 402's drives with vl: velocities are rpm times 604Ch, and targets of vl also times 604Bh.
VL_FACTORS = {
    Role.VELOCITY_NUMERATOR: (cia402.VL_DIMENSION_FACTOR, 1),
    Role.VELOCITY_DIVISOR: (cia402.VL_DIMENSION_FACTOR, 2),
    Role.SET_POINT_NUMERATOR: (cia402.VL_SET_POINT_FACTOR, 1),
    Role.SET_POINT_DIVISOR: (cia402.VL_SET_POINT_FACTOR, 2),
}
