"""The objects of CiA 402 that the envelope commands, checks and watches: index and sub-index."""

from drive_env import cia402

CONTROLWORD, STATUSWORD, MODE, MODE_DISPLAY = (
    (cia402.CONTROLWORD, 0),
    (cia402.STATUSWORD, 0),
    (cia402.MODE, 0),
    (cia402.MODE_DISPLAY, 0),
)
TARGET_POSITION, TARGET_VELOCITY, TARGET_TORQUE = (
    (cia402.TARGET_POSITION, 0),
    (cia402.TARGET_VELOCITY, 0),
    (cia402.TARGET_TORQUE, 0),
)
POSITION_OFFSET, VELOCITY_OFFSET, TORQUE_OFFSET = (
    (cia402.POSITION_OFFSET, 0),
    (cia402.VELOCITY_OFFSET, 0),
    (cia402.TORQUE_OFFSET, 0),
)
PROFILE_VELOCITY, POSITIONING_OPTIONS = (cia402.PROFILE_VELOCITY, 0), (cia402.POSITIONING_OPTIONS, 0)
HOMING_SPEED_TO_SWITCH, HOMING_SPEED_TO_ZERO = (cia402.HOMING_SPEEDS, 1), (cia402.HOMING_SPEEDS, 2)
POSITION, DEMAND, VELOCITY, CURRENT = (
    (cia402.POSITION_ACTUAL, 0),
    (cia402.POSITION_DEMAND, 0),
    (cia402.VELOCITY_ACTUAL, 0),
    (cia402.TORQUE_ACTUAL, 0),
)
QUICK_STOP_OPTION, STORE = (cia402.QUICK_STOP_OPTION, 0), 0x1010
DISABLE_OPERATION_OPTION, HALT_OPTION, FAULT_REACTION_OPTION = (
    (cia402.DISABLE_OPERATION_OPTION, 0),
    (cia402.HALT_OPTION, 0),
    (cia402.FAULT_REACTION_OPTION, 0),
)
# What makes an axis move, or changes how far; whoever writes it arms.
SET_POINTS = (
    TARGET_POSITION, TARGET_VELOCITY, TARGET_TORQUE, POSITION_OFFSET, VELOCITY_OFFSET, TORQUE_OFFSET,
)  # fmt: skip

PP, PV, HM, CSP, CSV = 1, 3, 6, 8, 9  # modes of operation
UNRAMPED_MODES = (4, CSP, 10)  # tq, csp, cst: no object says how fast what they command may become
# What sets the speed of a mode, sums in brackets: from when the mode is on, and from when a move is started.
RUNNING_SPEEDS = {PV: ((TARGET_VELOCITY,),), CSV: ((TARGET_VELOCITY, VELOCITY_OFFSET),)}
MOVING_SPEEDS = {PP: ((PROFILE_VELOCITY,),), HM: ((HOMING_SPEED_TO_SWITCH,), (HOMING_SPEED_TO_ZERO,))}
