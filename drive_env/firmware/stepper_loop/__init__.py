"""The stages of stepper drives that close a loop over an encoder: load angle control, position PID, torque."""

MOTOR_KINDS = ("stepper",)  # of motors/, supported by these stages
DEFAULT_MOTOR = "qsh4218_51"
