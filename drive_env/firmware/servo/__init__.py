"""The stages of servo drives for PMSMs and DC motors: sensors, start-up, loops, power stage, winding, temperatures."""

MOTOR_KINDS = ("pmsm", "dc")  # of motors/, supported by these stages
DEFAULT_MOTOR = "qbl4208"
