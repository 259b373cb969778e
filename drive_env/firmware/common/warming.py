"""Temperatures: fields of winding and stage, and the winding's resistance and flux as functions of its temperature."""

from __future__ import annotations

from drive_env.firmware.record import Field
from drive_env.motors import COPPER
from mechanics.kernels.compiled import inlined

NOMINAL = 25.0  # degC of the motor's data

PARAMETERS = (
    Field("on_resistance", "f8", "ohm", "of the stage, in a phase's path"),
    Field("stage_thermal_resistance", "f8", "K/W", "stage to ambient", 1.0),
    Field("stage_thermal_time", "f8", "s", "", 100.0),
    Field("R_s", "f8", "ohm", "phase resistance at the present temperature", 1.0),
    Field("psi_m", "f8", "V*s", "magnet flux at the present temperature; of a DC motor its constant"),
    Field("R_nominal", "f8", "ohm", "phase resistance at 25 degC", 1.0),
    Field("psi_nominal", "f8", "V*s", "magnet flux at 25 degC"),
    Field("flux_temperature", "f8", "1/K", "relative change of the flux"),
    Field("thermal_resistance", "f8", "K/W", "winding to ambient", 1.0),
    Field("thermal_time", "f8", "s", "of winding and housing", 600.0),
    Field("ambient", "f8", "K", "ambient temperature above 0 degC", 25.0),
)

STATE = (Field("T_winding", "f8", "K", "winding temperature above 0 degC", 25.0),)


@inlined
def warmed(drive, lane, loss, stage_loss, dt):
    """Advance both temperatures by dt [s], first-order models to ambient, with losses [W]; writes R_s and psi_m."""
    T = drive.T_winding[lane]
    rise = drive.ambient[lane] + loss * drive.thermal_resistance[lane] - T
    T += rise * dt / drive.thermal_time[lane]
    drive.T_winding[lane] = T
    drive.R_s[lane] = drive.R_nominal[lane] * (1.0 + COPPER * (T - NOMINAL))
    drive.psi_m[lane] = drive.psi_nominal[lane] * (1.0 + drive.flux_temperature[lane] * (T - NOMINAL))
    rise = drive.ambient[lane] + stage_loss * drive.stage_thermal_resistance[lane] - drive.T_stage[lane]
    drive.T_stage[lane] += rise * dt / drive.stage_thermal_time[lane]
