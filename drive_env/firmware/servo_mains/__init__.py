"""The stages of two-axis servo amplifiers on mains: a DC link shared by axes, a gate for the master, shaped ramps."""

MOTOR_KINDS = ("pmsm",)  # of motors/, supported by these stages
DEFAULT_MOTOR = "am3041_e"
