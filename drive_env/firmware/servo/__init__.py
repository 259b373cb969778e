"""The stages of servo drives for PMSMs and DC motors: sensors, start-up, loops, power stage, winding, temperatures."""

MOTOR_KINDS = ("pmsm", "dc")  # of motors/, that it turns
DEFAULT_MOTOR = "qbl4208"
