"""The stages of drives for two-phase stepper motors: steps, current scaling, chopper, winding, encoder, causes."""

MOTOR_KINDS = ("stepper",)  # of motors/, supported by these stages
DEFAULT_MOTOR = "qsh4218_51"
