"""Machines with stepper drives: true parameters of motor and stage, and the fields of the record that they are."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from drive_env import motors
from drive_env.devices import Device
from drive_env.emulator.parameters import (
    MachineKind,
    MachineParameter,
    Records,
    change_encoder,
    set_encoder_counts,
    set_velocity_filter,
)
from drive_env.firmware.record import set_lanes
from drive_env.motors import Motor
from mechanics.arrays import Floats, Mask

# Parameters that are a field of the record as they stand.
_FIELDS = {
    "motor.R_s": "R_nominal",
    "motor.L_s": "L_s",
    "motor.psi_m": "psi_nominal",
    "motor.detent_torque": "detent_torque",
    "motor.saturation": "saturation",
    "motor.thermal_resistance": "thermal_resistance",
    "motor.thermal_time": "thermal_time",
    "motor.ambient": "ambient",
    "motor.encoder_broken": "encoder_broken",
    "motor.index_angle": "index_angle",
    "motor.index_inverted": "index_inverted",
    "motor.brake_opens_in": "brake_opens_in",
    "motor.brake_closes_in": "brake_closes_in",
    "motor.open_a": "open_a",
    "motor.open_b": "open_b",
    "motor.encoder_line_error": "encoder_line_error",
    "motor.encoder_line_phase": "encoder_line_phase",
    "stage.chopper_clock": "chopper_clock",
    "stage.supply_resistance": "supply_resistance",
    "stage.dc_capacitance": "dc_capacitance",
    "stage.idle_current": "idle_current",
    "stage.supply_sinks": "supply_sinks",
    "stage.on_resistance": "on_resistance",
    "stage.thermal_resistance": "stage_thermal_resistance",
    "stage.thermal_time": "stage_thermal_time",
    "stage.short_conductance": "short_conductance",
    "stage.short_a": "short_a",
    "stage.short_b": "short_b",
}
_AT_TEMPERATURE = {"motor.R_s": "R_s", "motor.psi_m": "psi_m"}
_ENCODER_DIRECTION = "motor.encoder_direction"

# Parameters that are no field as they stand: how each is brought into the records.
_SPECIAL: dict[str, Callable[[Records, Device, Motor, Floats, Mask], None]] = {
    _ENCODER_DIRECTION: lambda r, device, motor, values, axes: change_encoder(
        r, "encoder_true_direction", values, axes
    ),
    "motor.encoder_interpolation": lambda r, device, motor, values, axes: set_encoder_counts(r, motor, values, axes),
    "stage.velocity_filter": lambda r, device, motor, values, axes: set_velocity_filter(r, device, values, axes),
}


def motor_parameters(motor: Motor) -> list[MachineParameter]:
    """Return the parameters of a motor, in the order in which they are drawn; an ideal one has no friction."""
    rows = []
    for name, unit, value, ideal in (
        ("R_s", "ohm", motor.R_s, motor.R_s),
        ("L_s", "H", motor.L_q, motor.L_q),
        ("psi_m", "V*s", motor.psi_m, motor.psi_m),
        ("inertia", "kg*m^2", motor.inertia, motor.inertia),
        ("detent_torque", "N*m", motor.cogging_torque, 0.0),
        ("coulomb", "N*m", motor.coulomb, 0.0),
        ("viscous", "N*m*s/rad", motor.viscous, 0.0),
        ("encoder_line_error", "rad", motor.encoder_line_error, 0.0),
    ):
        low, high = motors.RANGES[name]
        rows.append(MachineParameter(f"motor.{name}", unit, value, low * value, high * value, ideal))
    rows.append(MachineParameter("motor.encoder_line_phase", "rad", 0.0, 0.0, 2.0 * np.pi, 0.0))
    heat = motor.thermal_resistance
    # An ideal winding does not warm.
    rows.append(MachineParameter("motor.thermal_resistance", "K/W", heat, 0.7 * heat, 1.4 * heat, 0.0))
    for name, unit, value in (
        ("motor.thermal_time", "s", motor.thermal_time),
        ("motor.ambient", "degC", 25.0),
        ("motor.saturation", "1/A^2", motor.saturation),
        # Broken cables: 1 is broken. Never drawn: a world with faults is made on purpose.
        ("motor.encoder_broken", "1", 0.0),
        ("motor.open_a", "1", 0.0),
        ("motor.open_b", "1", 0.0),
        ("stage.short_conductance", "S", 0.0),
        ("motor.encoder_interpolation", "1", 1.0),
    ):
        rows.append(MachineParameter(name, unit, value, value, value, value))
    return rows


def wiring_parameters(motor: Motor) -> list[MachineParameter]:
    """Return how the motor's cables may be wired, where its encoder's index is, and how quick a brake on it is."""
    wired = float(motor.encoder_direction)
    return [
        MachineParameter(_ENCODER_DIRECTION, "1", wired, 0.0, 1.0, wired),
        MachineParameter("motor.index_angle", "rad", 0.0, 0.0, 2.0 * np.pi, 0.0),
        MachineParameter("stage.short_a", "S", 0.0, 0.0, 0.0, 0.0),
        MachineParameter("stage.short_b", "S", 0.0, 0.0, 0.0, 0.0),
        MachineParameter("motor.index_inverted", "1", 0.0, 0.0, 0.0, 0.0),
        # Usual for brakes of some newton metres that a spring closes.
        MachineParameter("motor.brake_opens_in", "s", 0.04, 0.02, 0.08, 0.04),
        MachineParameter("motor.brake_closes_in", "s", 0.02, 0.01, 0.04, 0.02),
    ]


def apply(records: Records, device: Device, motor: Motor, name: str, values: Floats, axes: Mask) -> None:
    """Write a motor or stage parameter into the records of the axes where the mask is true."""
    if name in _SPECIAL:
        _SPECIAL[name](records, device, motor, values, axes)
        return
    set_lanes(records, _FIELDS[name], values, axes)
    if name in _AT_TEMPERATURE:
        # The thermal model sets the live value once a period; until then it is the one at 25 degC.
        set_lanes(records, _AT_TEMPERATURE[name], values, axes)


def set_constants(records: Records, device: Device, motor: Motor) -> None:
    """Write what stage and motor are besides their parameters."""
    records["duty_limit"] = device.duty_limit
    records["overcurrent"] = device.overcurrent
    records["full_scale_current"] = device.current_full_scale
    records["flux_temperature"] = motor.flux_temperature
    records["n_p"] = motor.n_p


STEPPER = MachineKind(
    motor_parameters, wiring_parameters, frozenset({*_FIELDS, *_SPECIAL}), set_constants, apply, noise=""
)
