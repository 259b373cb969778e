"""Machines with servo drives: true parameters of motor and power stage, and the fields of the record that they are."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from drive_env import motors
from drive_env.devices import Device
from drive_env.emulator.parameters import (
    WIRING,
    MachineKind,
    MachineParameter,
    Records,
    change_encoder,
    set_encoder_counts,
    set_velocity_filter,
)
from drive_env.firmware.record import get_lanes, set_lanes
from drive_env.motors import Motor
from mechanics.arrays import Floats, Mask

# Parameters that are a field of the record as they stand: name -> (field, part).
_FIELDS = {
    "motor.R_s": ("R_nominal", 0),
    "motor.L_d": ("L_d", 0),
    "motor.L_q": ("L_q", 0),
    "motor.psi_m": ("psi_nominal", 0),
    "motor.thermal_resistance": ("thermal_resistance", 0),
    "motor.thermal_time": ("thermal_time", 0),
    "motor.ambient": ("ambient", 0),
    "motor.hall_polarity": ("hall_true_polarity", 0),
    "motor.hall_direction": ("hall_true_direction", 0),
    "motor.hall_offset": ("hall_true_offset", 0),
    "motor.hall_broken": ("hall_broken", 0),
    "motor.encoder_broken": ("encoder_broken", 0),
    "motor.index_angle": ("index_angle", 0),
    "motor.open_a": ("open_a", 0),
    "motor.open_b": ("open_b", 0),
    "motor.cogging_torque": ("cogging_torque", 0),
    "motor.cogging_phase": ("cogging_phase", 0),
    "motor.encoder_line_error": ("encoder_line_error", 0),
    "motor.encoder_line_phase": ("encoder_line_phase", 0),
    "motor.commutation_offset": ("commutation_offset", 0),
    "stage.dead_time_current": ("dead_time_current", 0),
    "stage.adc_noise": ("adc_noise", 0),
    "stage.adc_offset_a": ("adc_offset_error", 0),
    "stage.adc_offset_b": ("adc_offset_error", 1),
    "stage.supply_resistance": ("supply_resistance", 0),
    "stage.dc_capacitance": ("dc_capacitance", 0),
    "stage.chopper_resistance": ("chopper_resistance", 0),
    "stage.idle_current": ("idle_current", 0),
    "stage.supply_sinks": ("supply_sinks", 0),
    "stage.on_resistance": ("on_resistance", 0),
    "stage.thermal_resistance": ("stage_thermal_resistance", 0),
    "stage.thermal_time": ("stage_thermal_time", 0),
    "stage.short_conductance": ("short_conductance", 0),
}


_AT_TEMPERATURE = {"motor.R_s": "R_s", "motor.psi_m": "psi_m"}

_MOTOR_UNITS = {
    "R_s": "ohm", "L_d": "H", "L_q": "H", "psi_m": "V*s", "inertia": "kg*m^2", "cogging_torque": "N*m",
    "coulomb": "N*m", "viscous": "N*m*s/rad",
}  # fmt: skip


def motor_parameters(motor: Motor) -> list[MachineParameter]:
    """Return the parameters of a motor, in the order in which they are drawn."""
    rows: list[MachineParameter] = []
    for name in ("R_s", "L_d", "L_q", "psi_m", "inertia", "cogging_torque", "coulomb", "viscous"):
        value = getattr(motor, name)
        low, high = motors.RANGES[name]
        faultless = 0.0 if name in ("cogging_torque", "coulomb", "viscous") else value
        rows.append(MachineParameter(f"motor.{name}", _MOTOR_UNITS[name], value, low * value, high * value, faultless))
    for name in ("encoder_line_error", "commutation_offset"):
        value = getattr(motor, name)
        low, high = motors.RANGES[name]
        rows.append(MachineParameter(f"motor.{name}", "rad", value, low * value, high * value, 0.0))
    for name in ("cogging_phase", "encoder_line_phase"):
        rows.append(MachineParameter(f"motor.{name}", "rad", 0.0, 0.0, 2.0 * np.pi, 0.0))
    for name, unit, value in (
        ("thermal_time", "s", motor.thermal_time),
        ("ambient", "degC", 25.0),
        ("hall_offset", "rad", 0.0),
        # Broken cables: 1 is broken. Never drawn: a world with faults is made on purpose.
        ("hall_broken", "1", 0.0),
        ("encoder_broken", "1", 0.0),
        ("open_a", "1", 0.0),
        ("open_b", "1", 0.0),
    ):
        rows.append(MachineParameter(f"motor.{name}", unit, value, value, value, value))
    # An ideal winding does not warm.
    heat = motor.thermal_resistance
    rows.append(MachineParameter("motor.thermal_resistance", "K/W", heat, 0.7 * heat, 1.4 * heat, 0.0))
    rows.append(MachineParameter("stage.short_conductance", "S", 0.0, 0.0, 0.0, 0.0))
    rows.append(MachineParameter("motor.encoder_interpolation", "1", 1.0, 1.0, 1.0, 4096.0))
    return rows


def wiring_parameters(motor: Motor) -> list[MachineParameter]:
    """Return how the motor's cables may be wired, and where its encoder's index is."""
    wired = {name: float(getattr(motor, name.removeprefix("motor."))) for name in WIRING}
    rows = [MachineParameter(name, "1", value, 0.0, 1.0, value) for name, value in wired.items()]
    return [*rows, MachineParameter("motor.index_angle", "rad", 0.0, 0.0, 2.0 * np.pi, 0.0)]


# Parameters that are no field as they stand: how each is brought into the records.
_SPECIAL: dict[str, Callable[[Records, Device, Motor, Floats, Mask], None]] = {
    "motor.encoder_direction": lambda r, device, motor, values, axes: change_encoder(
        r, "encoder_true_direction", values, axes
    ),
    "motor.encoder_interpolation": lambda r, device, motor, values, axes: set_encoder_counts(r, motor, values, axes),
    "stage.dead_time": lambda r, device, motor, values, axes: set_lanes(
        r, "dead_time_duty", values * device.current_rate, axes
    ),
    "stage.adc_gain_error_a": lambda r, device, motor, values, axes: set_lanes(r, "adc_gain", 1.0 + values, axes, 0),
    "stage.adc_gain_error_b": lambda r, device, motor, values, axes: set_lanes(r, "adc_gain", 1.0 + values, axes, 1),
    "stage.adc_bits": lambda r, device, motor, values, axes: _set_adc(r, device, values, axes),
    "stage.velocity_filter": lambda r, device, motor, values, axes: set_velocity_filter(r, device, values, axes),
}


def apply(records: Records, device: Device, motor: Motor, name: str, values: Floats, axes: Mask) -> None:
    """Write a motor or stage parameter into the records of the axes where the mask is true."""
    if name == "motor.commutation_offset":
        # A drive that runs is aligned: the error of its angle changes with the offset.
        change = values - get_lanes(records, "commutation_offset", len(values)).astype(float)
        set_lanes(records, "angle_zero", get_lanes(records, "angle_zero", len(values)).astype(float) + change, axes)
    if name in _FIELDS:
        field, part = _FIELDS[name]
        set_lanes(records, field, values, axes, part)
        if name in _AT_TEMPERATURE:
            # The thermal model sets the live value once a millisecond; until then it is the one at 25 degC.
            set_lanes(records, _AT_TEMPERATURE[name], values, axes)
        return
    _SPECIAL[name](records, device, motor, values, axes)


def _set_adc(records: Records, device: Device, bits: Floats, axes: Mask) -> None:
    set_lanes(records, "adc_step", 2.0 * device.current_full_scale / 2.0**bits, axes)
    set_lanes(records, "adc_step_lsb", 65536.0 / 2.0**bits, axes)


def set_constants(records: Records, device: Device, motor: Motor) -> None:
    """Write what stage and motor are besides their parameters."""
    records["duty_limit"] = device.duty_limit
    records["overcurrent"] = device.overcurrent
    records["nominal_current"] = device.nominal_current
    records["overload_time"] = device.overload_time
    records["is_dc"] = motor.kind == "dc"
    records["phase_factor"] = 1.0 if motor.kind == "dc" else 1.5
    records["flux_temperature"] = motor.flux_temperature
    records["n_p"] = motor.n_p
    records["cogging_order"] = motor.cogging_order


SERVO = MachineKind(
    motor_parameters, wiring_parameters, frozenset({*_FIELDS, *_SPECIAL}), set_constants, apply, noise="random"
)
