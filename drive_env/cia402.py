"""The drive profile CiA 402 (IEC 61800-7-201): objects, states, statusword and controlword, modes, option codes.

Objects are indices of the first axis; axis k of a node has its own 800h higher. Statusword patterns are (mask, value).
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, NamedTuple

Key = tuple[int, int]  # index and sub-index of an object

AXIS_OFFSET = 0x800  # between the profile areas of two axes of a node
PROFILE_AREAS = range(0x6000, 0xA000)  # of up to eight axes (CiA 301)


def of_first_axis(index: int) -> int:
    """Return the index that an object of the profile area has on a node's first axis; others are returned as given."""
    if index not in PROFILE_AREAS:
        return index
    return PROFILE_AREAS.start + (index - PROFILE_AREAS.start) % AXIS_OFFSET


# --- objects ---------------------------------------------------------------------------------------------------------
ABORT_CONNECTION_OPTION = 0x6007
ERROR_CODE = 0x603F
CONTROLWORD = 0x6040
STATUSWORD = 0x6041
VL_TARGET_VELOCITY = 0x6042
VL_VELOCITY_DEMAND = 0x6043
VL_VELOCITY_ACTUAL = 0x6044
VL_VELOCITY_LIMITS = 0x6046
VL_ACCELERATION = 0x6048
VL_DECELERATION = 0x6049
VL_QUICK_STOP = 0x604A
VL_SET_POINT_FACTOR = 0x604B
VL_DIMENSION_FACTOR = 0x604C
VL_REFERENCE = 0x604E
VL_SLOW_DOWN_TIME = 0x6050
VL_QUICK_STOP_TIME = 0x6051
QUICK_STOP_OPTION = 0x605A
SHUTDOWN_OPTION = 0x605B
DISABLE_OPERATION_OPTION = 0x605C
HALT_OPTION = 0x605D
FAULT_REACTION_OPTION = 0x605E
MODE = 0x6060
MODE_DISPLAY = 0x6061
POSITION_DEMAND = 0x6062
POSITION_INTERNAL = 0x6063
POSITION_ACTUAL = 0x6064
FOLLOWING_WINDOW = 0x6065
FOLLOWING_TIMEOUT = 0x6066
POSITION_WINDOW = 0x6067
POSITION_WINDOW_TIME = 0x6068
SENSOR_SELECTION = 0x606A
VELOCITY_DEMAND = 0x606B
VELOCITY_ACTUAL = 0x606C
VELOCITY_WINDOW = 0x606D
VELOCITY_WINDOW_TIME = 0x606E
VELOCITY_THRESHOLD = 0x606F
VELOCITY_THRESHOLD_TIME = 0x6070
TARGET_TORQUE = 0x6071
MAX_TORQUE = 0x6072
MAX_CURRENT = 0x6073
TORQUE_DEMAND = 0x6074
RATED_CURRENT = 0x6075
RATED_TORQUE = 0x6076
TORQUE_ACTUAL = 0x6077
CURRENT_ACTUAL = 0x6078
DC_LINK_VOLTAGE = 0x6079
TARGET_POSITION = 0x607A
HOME_OFFSET = 0x607C
POSITION_LIMITS = 0x607D
POLARITY = 0x607E
MAX_PROFILE_VELOCITY = 0x607F
MAX_MOTOR_SPEED = 0x6080
PROFILE_VELOCITY = 0x6081
END_VELOCITY = 0x6082
PROFILE_ACCELERATION = 0x6083
PROFILE_DECELERATION = 0x6084
QUICK_STOP_DECELERATION = 0x6085
PROFILE_TYPE = 0x6086
ENCODER_RESOLUTION = 0x608F
GEAR_RATIO = 0x6091
FEED_CONSTANT = 0x6092
HOMING_METHOD = 0x6098
HOMING_SPEEDS = 0x6099
HOMING_ACCELERATION = 0x609A
PROFILE_JERK = 0x60A4
POSITION_UNIT = 0x60A8
VELOCITY_UNIT = 0x60A9
ACCELERATION_UNIT = 0x60AA
POSITION_OFFSET = 0x60B0
VELOCITY_OFFSET = 0x60B1
TORQUE_OFFSET = 0x60B2
TOUCH_PROBE = 0x60B8
INTERPOLATION_DATA = 0x60C1
INTERPOLATION_PERIOD = 0x60C2
POSITIONING_OPTIONS = 0x60F2
FOLLOWING_ERROR = 0x60F4
HOMING_METHODS = 0x60E3
DIGITAL_INPUTS = 0x60FD
DIGITAL_OUTPUTS = 0x60FE
TARGET_VELOCITY = 0x60FF
MOTOR_TYPE = 0x6402
SUPPORTED_MODES = 0x6502
SINGLE_DEVICE_TYPE = 0x67FF
# What commands or leads an axis, or its outputs: no parameters.
COMMANDED = (
    CONTROLWORD, MODE, TARGET_TORQUE, TARGET_POSITION, POSITION_OFFSET, VELOCITY_OFFSET, TORQUE_OFFSET,
    INTERPOLATION_DATA, DIGITAL_OUTPUTS, TARGET_VELOCITY, VL_TARGET_VELOCITY,
)  # fmt: skip
OUTPUTS_MASK = (DIGITAL_OUTPUTS, 2)  # which outputs follow: a setting beside the command
# --- modes of operation (6060h) --------------------------------------------------------------------------------------
PP, VL, PV, TQ, HM, IP, CSP, CSV, CST = 1, 2, 3, 4, 6, 7, 8, 9, 10
MODES = {"pp": PP, "vl": VL, "pv": PV, "tq": TQ, "hm": HM, "ip": IP, "csp": CSP, "csv": CSV, "cst": CST}


# --- states and the statusword ---------------------------------------------------------------------------------------
class State(IntEnum):
    """State of the power drive system, in the order of the standard's figure."""

    NOT_READY_TO_SWITCH_ON = 0
    SWITCH_ON_DISABLED = 1
    READY_TO_SWITCH_ON = 2
    SWITCHED_ON = 3
    OPERATION_ENABLED = 4
    QUICK_STOP_ACTIVE = 5
    FAULT_REACTION_ACTIVE = 6
    FAULT = 7


class Pattern(NamedTuple):
    """A pattern of a word: a mask, and the value under it."""

    mask: int
    value: int


NOT_READY_TO_SWITCH_ON = Pattern(0x4F, 0x00)
SWITCH_ON_DISABLED = Pattern(0x4F, 0x40)
READY_TO_SWITCH_ON = Pattern(0x6F, 0x21)
SWITCHED_ON = Pattern(0x6F, 0x23)
OPERATION_ENABLED = Pattern(0x6F, 0x27)
QUICK_STOP_ACTIVE = Pattern(0x6F, 0x07)
FAULT_REACTION_ACTIVE = Pattern(0x4F, 0x0F)
FAULT = Pattern(0x4F, 0x08)
STATE_CODING = {
    State.NOT_READY_TO_SWITCH_ON: NOT_READY_TO_SWITCH_ON,
    State.SWITCH_ON_DISABLED: SWITCH_ON_DISABLED,
    State.READY_TO_SWITCH_ON: READY_TO_SWITCH_ON,
    State.SWITCHED_ON: SWITCHED_ON,
    State.OPERATION_ENABLED: OPERATION_ENABLED,
    State.QUICK_STOP_ACTIVE: QUICK_STOP_ACTIVE,
    State.FAULT_REACTION_ACTIVE: FAULT_REACTION_ACTIVE,
    State.FAULT: FAULT,
}
LIVE = (OPERATION_ENABLED, QUICK_STOP_ACTIVE, FAULT_REACTION_ACTIVE)  # the power stage is on, or may be
FAULT_BIT = Pattern(0x08, 0x08)  # fault or fault reaction active
WARNING = Pattern(0x80, 0x80)
REMOTE = Pattern(0x200, 0x200)  # the axis takes commands from its network
TARGET_REACHED = Pattern(0x0400, 0x0400)
INTERNAL_LIMIT = Pattern(0x0800, 0x0800)
SET_POINT_ACKNOWLEDGED = Pattern(0x1000, 0x1000)  # in pp
SET_POINT_TAKEN_BACK = Pattern(0x1000, 0x0000)
# Homing: bits 13 (error), 12 (attained) and 10 (at rest); 13 stays 0 on drives that do not support it.
HOMING_BITS = 0x3400
HOMED, HOMING_UNDER_WAY = 0x1400, (0x0000, 0x1000)


def matches(word: Any, pattern: tuple[int, int]) -> Any:
    """Return where a word shows a pattern; an integer or an array."""
    return word & pattern[0] == pattern[1]


def state_of(status: int) -> State | None:
    """Return the state that a statusword shows, None where it shows none."""
    return next((state for state, pattern in STATE_CODING.items() if matches(status, pattern)), None)


def is_live(status: Any) -> Any:
    """Return where a statusword shows that the power stage may be on."""
    return matches(status, LIVE[0]) | matches(status, LIVE[1]) | matches(status, LIVE[2])


def is_disabled(status: Any) -> Any:
    """Return where a statusword shows a state that no single controlword takes to operation enabled."""
    return matches(status, SWITCH_ON_DISABLED) | matches(status, FAULT) | matches(status, NOT_READY_TO_SWITCH_ON)


# --- the controlword -------------------------------------------------------------------------------------------------
# Words that command and nothing else; and patterns of the bits that make a command, whatever the others are.
DISABLE_VOLTAGE, QUICK_STOP, SHUTDOWN, SWITCH_ON, ENABLE_OPERATION = 0x00, 0x02, 0x06, 0x07, 0x0F
ENABLING = (SHUTDOWN, SWITCH_ON, ENABLE_OPERATION)  # one after the other, from switch on disabled
FAULT_RESET = 0x80  # acts as it rises
NEW_SET_POINT, CHANGE_AT_ONCE, RELATIVE = 0x10, 0x20, 0x40  # in pp
ENABLE_RAMP, UNLOCK_RAMP, REFERENCE_RAMP = 0x10, 0x20, 0x40  # in vl
FOLLOW_RAMP = ENABLE_OPERATION | ENABLE_RAMP | UNLOCK_RAMP | REFERENCE_RAMP
CHANGE_ON_SET_POINT = 0x200  # in pp, of drives with a set-point buffer
HALT = 0x100
COMMANDS = {
    "shutdown": Pattern(0x87, 0x06),
    "switch on": Pattern(0x8F, 0x07),
    "enable operation": Pattern(0x8F, 0x0F),
    "disable voltage": Pattern(0x82, 0x00),
    "quick stop": Pattern(0x86, 0x02),
    "disable operation": Pattern(0x8F, 0x07),
    "fault reset": Pattern(0x80, 0x80),
}


def leads_on(words: Any) -> Any:
    """Return where a controlword takes an axis that is off a step towards operation enabled."""
    return matches(words, (0x87, SHUTDOWN)) | matches(words, (0x8F, SWITCH_ON))


def may_enable(words: Any) -> Any:
    """Return where a controlword can bring an axis into operation enabled, or keep it there: bits 0 to 3."""
    return matches(words, (0x0F, ENABLE_OPERATION))


def cuts_voltage(words: Any) -> Any:
    """Return where a controlword takes the voltage away at once: disable voltage, shutdown."""
    return matches(words, (0x82, DISABLE_VOLTAGE)) | matches(words, (0x87, SHUTDOWN))
