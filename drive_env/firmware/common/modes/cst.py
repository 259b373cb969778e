"""Cyclic synchronous torque mode (TMCM-1636 manual, section 11): the target torque is the current loop's set-point."""

from __future__ import annotations

from mechanics.kernels.compiled import stage


@stage
def generate(drive, lane):
    """Pass 6071h + 60B2h to the current loop; the position demand follows the axis."""
    drive.loop_level[lane] = 0
    drive.torque_demand[lane] = drive.target_torque[lane] + drive.torque_offset[lane]
    drive.position_demand[lane] = drive.theta_meas[lane]
    # A stop ramp starts from it.
    drive.velocity_demand[lane] = drive.omega_meas[lane]
    drive.target_reached[lane] = 0
