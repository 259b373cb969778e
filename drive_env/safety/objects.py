"""The objects of CiA 402 that the envelope commands, checks and watches: index and sub-index."""

CONTROLWORD, STATUSWORD, MODE, MODE_DISPLAY = (0x6040, 0), (0x6041, 0), (0x6060, 0), (0x6061, 0)
TARGET_POSITION, TARGET_VELOCITY, TARGET_TORQUE = (0x607A, 0), (0x60FF, 0), (0x6071, 0)
POSITION_OFFSET, VELOCITY_OFFSET, TORQUE_OFFSET = (0x60B0, 0), (0x60B1, 0), (0x60B2, 0)
PROFILE_VELOCITY, POSITIONING_OPTIONS = (0x6081, 0), (0x60F2, 0)
HOMING_SPEED_TO_SWITCH, HOMING_SPEED_TO_ZERO = (0x6099, 1), (0x6099, 2)
POSITION, DEMAND, VELOCITY, CURRENT = (0x6064, 0), (0x6062, 0), (0x606C, 0), (0x6077, 0)
QUICK_STOP_OPTION, STORE = (0x605A, 0), 0x1010
# What makes an axis move, or changes how far; whoever writes it arms.
SET_POINTS = (
    TARGET_POSITION, TARGET_VELOCITY, TARGET_TORQUE, POSITION_OFFSET, VELOCITY_OFFSET, TORQUE_OFFSET,
)  # fmt: skip

NEW_SET_POINT, RELATIVE = 0x10, 0x40  # bits of the controlword in pp
PP, PV, HM, CSP, CSV = 1, 3, 6, 8, 9  # modes of operation
UNRAMPED_MODES = (4, CSP, 10)  # tq, csp, cst: no object says how fast what they command may become
# What sets the speed of a mode, sums in brackets: from when the mode is on, and from when a move is started.
RUNNING_SPEEDS = {PV: ((TARGET_VELOCITY,),), CSV: ((TARGET_VELOCITY, VELOCITY_OFFSET),)}
MOVING_SPEEDS = {PP: ((PROFILE_VELOCITY,),), HM: ((HOMING_SPEED_TO_SWITCH,), (HOMING_SPEED_TO_ZERO,))}
