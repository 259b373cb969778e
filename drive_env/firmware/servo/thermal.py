"""Temperatures of winding and stage in each supervision period, by copper loss; they change resistance and flux."""

from __future__ import annotations

from drive_env.firmware.common.warming import warmed
from drive_env.firmware.record import LANES
from mechanics.kernels.compiled import inlined

LARGEST_SQUARE = 1e12  # A^2


@inlined
def warm(drive, dt):
    """Advance both temperatures by dt [s], first-order models to ambient; writes R_s and psi_m."""
    for lane in range(LANES):
        square = drive.i_d[lane] * drive.i_d[lane] + drive.i_q[lane] * drive.i_q[lane]
        square = square if square < LARGEST_SQUARE else 0.0  # a frozen lane's currents may be non-finite
        factor = drive.phase_factor[lane]
        loss = factor * drive.R_s[lane] * square
        in_stage = factor * (1.0 + drive.is_dc[lane]) * drive.on_resistance[lane] * square  # in both legs of a DC motor
        warmed(drive, lane, loss, in_stage, dt)
        share = square / (drive.nominal_current[lane] * drive.nominal_current[lane]) - 1.0
        used = drive.overload[lane] + dt * share / drive.overload_time[lane]
        drive.overload[lane] = used if used > 0.0 else 0.0
