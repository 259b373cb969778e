"""Temperatures of winding and stage, once per millisecond: copper loss warms, and changes resistance and flux."""

from __future__ import annotations

from drive_env.firmware.record import LANES
from drive_env.motors import COPPER
from mechanics.compiled import inlined

LARGEST_SQUARE = 1e12  # A^2
NOMINAL = 25.0  # degC at which the motor's row holds


@inlined
def warm(drive, dt):
    """Move both temperatures on by dt [s], first-order models to ambient; writes R_s and psi_m."""
    for lane in range(LANES):
        square = drive.i_d[lane] * drive.i_d[lane] + drive.i_q[lane] * drive.i_q[lane]
        square = square if square < LARGEST_SQUARE else 0.0  # a frozen lane's currents may be no numbers
        factor = drive.phase_factor[lane]
        T = drive.T_winding[lane]
        loss = factor * drive.R_s[lane] * square
        rise = drive.ambient[lane] + loss * drive.thermal_resistance[lane] - T
        T += rise * dt / drive.thermal_time[lane]
        drive.T_winding[lane] = T
        drive.R_s[lane] = drive.R_nominal[lane] * (1.0 + COPPER * (T - NOMINAL))
        drive.psi_m[lane] = drive.psi_nominal[lane] * (1.0 + drive.flux_temperature[lane] * (T - NOMINAL))
        stage_loss = factor * drive.on_resistance[lane] * square
        rise = drive.ambient[lane] + stage_loss * drive.stage_thermal_resistance[lane] - drive.T_stage[lane]
        drive.T_stage[lane] += rise * dt / drive.stage_thermal_time[lane]
        share = square / (drive.nominal_current[lane] * drive.nominal_current[lane]) - 1.0
        used = drive.overload[lane] + dt * share / drive.overload_time[lane]
        drive.overload[lane] = used if used > 0.0 else 0.0
