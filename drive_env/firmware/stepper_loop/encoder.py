"""What a closed loop takes from the encoder: where the axis is, aligned with the steps."""

from __future__ import annotations

from drive_env.firmware.common.arithmetic import TWO_PI
from drive_env.firmware.record import LANES
from mechanics.kernels.compiled import inlined

MARGIN = 1.0 + 1e-6  # of a way that the demand's speed explains
SMALLEST_WAY = 1e-6  # microsteps


@inlined
def encoder_position(drive, lane):
    """Return the rotor's position as the encoder has counted it since power-on [rad]."""
    return (drive.count[lane] - drive.count_zero[lane]) * TWO_PI * drive.turns_per_count[lane]


@inlined
def see_axis(drive):
    """Let an axis in a loop be where the encoder sees it.

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
    """Set the step counter where a demand of this period of dt [s] has not moved, but was taken from the encoder.

    So begin enabling, a stop after a fault, torque modes: none of them may move the field. Writes step_position.
    """
    for lane in range(LANES):
        position = drive.position_demand[lane] + drive.home_shift[lane] + drive.step_shift[lane]
        way = abs(position - drive.step_position[lane])
        now, before = abs(drive.velocity_demand[lane]), abs(drive.velocity_before[lane])
        explained = (now if now > before else before) * dt * MARGIN + SMALLEST_WAY / drive.steps_per_rad[lane]
        taken = drive.loop_closed[lane] > 0.5 and way > explained
        drive.step_position[lane] = position if taken else drive.step_position[lane]
