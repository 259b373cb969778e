"""The stages of two-axis servo amplifiers on mains: a DC link that axes share, a gate for the master, shaped ramps."""

MOTOR_KINDS = ("pmsm",)  # of motors/, that it turns
DEFAULT_MOTOR = "am3041_e"
