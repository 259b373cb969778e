"""Types and access of standard objects, for an EDS that omits them, and the objects that are not parameters."""

from __future__ import annotations

from canopen.objectdictionary import datatypes

from drive_env import cia402

I8, I16, I32 = datatypes.INTEGER8, datatypes.INTEGER16, datatypes.INTEGER32
U8, U16, U32 = datatypes.UNSIGNED8, datatypes.UNSIGNED16, datatypes.UNSIGNED32

# Type and access of objects without sub-indices, or of an object's sub-indices above 0 (IEC 61800-7-201, section 8).
STANDARD_TYPES: dict[int, tuple[int, str]] = {
    cia402.ERROR_CODE: (U16, "ro"),
    cia402.CONTROLWORD: (U16, "rw"),
    cia402.STATUSWORD: (U16, "ro"),
    cia402.QUICK_STOP_OPTION: (I16, "rw"),
    cia402.MODE: (I8, "rw"),
    cia402.MODE_DISPLAY: (I8, "ro"),
    cia402.POSITION_DEMAND: (I32, "ro"),
    cia402.POSITION_INTERNAL: (I32, "ro"),
    cia402.POSITION_ACTUAL: (I32, "ro"),
    cia402.FOLLOWING_WINDOW: (U32, "rw"),
    cia402.FOLLOWING_TIMEOUT: (U16, "rw"),
    cia402.POSITION_WINDOW: (U32, "rw"),
    cia402.POSITION_WINDOW_TIME: (U16, "rw"),
    cia402.VELOCITY_DEMAND: (I32, "ro"),
    cia402.VELOCITY_ACTUAL: (I32, "ro"),
    cia402.TARGET_TORQUE: (I16, "rw"),
    cia402.MAX_TORQUE: (U16, "rw"),
    cia402.MAX_CURRENT: (U16, "rw"),
    cia402.TORQUE_DEMAND: (I16, "ro"),
    cia402.RATED_CURRENT: (U32, "rw"),
    cia402.RATED_TORQUE: (U32, "rw"),
    cia402.TORQUE_ACTUAL: (I16, "ro"),
    cia402.CURRENT_ACTUAL: (I16, "ro"),
    cia402.DC_LINK_VOLTAGE: (U32, "ro"),
    cia402.TARGET_POSITION: (I32, "rw"),
    cia402.HOME_OFFSET: (I32, "rw"),
    cia402.POSITION_LIMITS: (I32, "rw"),
    cia402.POLARITY: (U8, "rw"),
    cia402.MAX_PROFILE_VELOCITY: (U32, "rw"),
    cia402.MAX_MOTOR_SPEED: (U32, "rw"),
    cia402.PROFILE_VELOCITY: (U32, "rw"),
    cia402.PROFILE_ACCELERATION: (U32, "rw"),
    cia402.PROFILE_DECELERATION: (U32, "rw"),
    cia402.QUICK_STOP_DECELERATION: (U32, "rw"),
    cia402.PROFILE_TYPE: (I16, "rw"),
    cia402.ENCODER_RESOLUTION: (U32, "rw"),
    cia402.GEAR_RATIO: (U32, "rw"),
    cia402.FEED_CONSTANT: (U32, "rw"),
    cia402.HOMING_METHOD: (I8, "rw"),
    cia402.HOMING_SPEEDS: (U32, "rw"),
    cia402.HOMING_ACCELERATION: (U32, "rw"),
    cia402.POSITION_OFFSET: (I32, "rw"),
    cia402.VELOCITY_OFFSET: (I32, "rw"),
    cia402.TORQUE_OFFSET: (I16, "rw"),
    cia402.POSITIONING_OPTIONS: (U16, "rw"),
    cia402.FOLLOWING_ERROR: (I32, "ro"),
    cia402.DIGITAL_INPUTS: (U32, "ro"),
    cia402.DIGITAL_OUTPUTS: (U32, "rw"),
    cia402.TARGET_VELOCITY: (I32, "rw"),
    cia402.SUPPORTED_MODES: (U32, "ro"),
}

# Writable objects of CiA 301 and 402 that are not parameters; a device's own are in its data.
COMMANDS = {
    0x1003: "error history: a service",
    0x1010: "store: a service",
    0x1011: "restore defaults: a service",
    0x1F50: "program download: a service",
    0x1F51: "program control: a service",
    0x1F52: "program verification: a service",
    cia402.CONTROLWORD: "controlword: a command",
    cia402.VL_TARGET_VELOCITY: "vl target velocity: a command",
    cia402.MODE: "modes of operation: a command",
    cia402.TARGET_TORQUE: "target torque: a command",
    cia402.TARGET_POSITION: "target position: a command",
    cia402.POSITION_OFFSET: "position offset: a command",
    cia402.VELOCITY_OFFSET: "velocity offset: a command",
    cia402.TORQUE_OFFSET: "torque offset: a command",
    cia402.TOUCH_PROBE: "touch probe function: a command",
    cia402.INTERPOLATION_DATA: "interpolation data: a command",
    cia402.DIGITAL_OUTPUTS: "digital outputs: a command",
    cia402.TARGET_VELOCITY: "target velocity: a command",
}
