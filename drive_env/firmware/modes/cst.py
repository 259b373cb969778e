"""Cyclic synchronous torque mode (manual, section 11): the target torque is the current loop's set-point."""

from __future__ import annotations

from mechanics.compiled import stage


@stage
def generate(drive, lane):
    """Hand 6071h to the current loop; position demand follows the axis."""
    drive.loop_level[lane] = 0
    drive.torque_demand[lane] = drive.target_torque[lane]
    drive.position_demand[lane] = drive.theta_meas[lane]
    drive.velocity_demand[lane] = 0.0
    drive.target_reached[lane] = 0
