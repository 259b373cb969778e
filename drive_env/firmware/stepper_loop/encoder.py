"""The axis' position for a closed loop, from the encoder, aligned with the steps."""

from __future__ import annotations

from drive_env.firmware.common.arithmetic import TWO_PI
from drive_env.firmware.record import LANES
from mechanics.kernels.compiled import inlined

MARGIN = 1.0 + 1e-6  # of a distance explained by the demand's speed
SMALLEST_WAY = 1e-6  # microsteps


@inlined
def encoder_position(drive, lane):
    """Return the rotor's position counted by the encoder since power-on [rad]."""
    return (drive.count[lane] - drive.count_zero[lane]) * TWO_PI * drive.turns_per_count[lane]


@inlined
def see_axis(drive):
    """Take the position of an axis in a loop from the encoder.

    Writes loop_deviation, encoder_shift and omega_shown; in a loop theta_meas, omega_meas, theta_encoder and
    position_actual.
    """
    for lane in range(LANES):
        turned = encoder_position(drive, lane)
        closed = drive.loop_closed[lane] > 0.5
        shift = drive.loop_offset[lane] - drive.step_shift[lane]
        shown = turned + shift - drive.home_shift[lane]
        drive.encoder_shift[lane] = shift if closed else 0.0
        drive.loop_deviation[lane] = drive.step_position[lane] - (turned + drive.loop_offset[lane])
        drive.theta_meas[lane] = shown if closed else drive.theta_meas[lane]
        drive.omega_meas[lane] = drive.omega_encoder[lane] if closed else drive.omega_meas[lane]
        sees = drive.position_sensor[lane] > -0.5
        drive.omega_shown[lane] = drive.omega_encoder[lane] if sees else drive.omega_meas[lane]
        drive.theta_encoder[lane] = shown if closed else drive.theta_encoder[lane]
        drive.position_actual[lane] = shown if closed else drive.position_actual[lane]
        drive.deviation[lane] = 0.0 if closed else drive.deviation[lane]  # theta_meas is the encoder's


@inlined
def seed_steps(drive, dt):
    """Set the step counter if the demand of this period of dt [s] was set from the encoder, not moved.

    This is so at enabling, a stop after a fault, and in torque modes, none of which may move the field. Writes
    step_position.
    """
    for lane in range(LANES):
        position = drive.position_demand[lane] + drive.home_shift[lane] + drive.step_shift[lane]
        way = abs(position - drive.step_position[lane])
        now, before = abs(drive.velocity_demand[lane]), abs(drive.velocity_before[lane])
        explained = (now if now > before else before) * dt * MARGIN + SMALLEST_WAY / drive.steps_per_rad[lane]
        taken = drive.loop_closed[lane] > 0.5 and way > explained
        drive.step_position[lane] = position if taken else drive.step_position[lane]
