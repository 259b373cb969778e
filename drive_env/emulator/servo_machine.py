"""Machines with servo drives: true parameters of motor and power stage, and their fields of the record."""

from __future__ import annotations

import numpy as np

from drive_env import motors
from drive_env.devices import Device
from drive_env.emulator.parameters import COMMON, WIRING, MachineKind, MachineParameter, Records, field
from drive_env.firmware.record import get_lanes, set_lanes
from drive_env.motors import Motor
from mechanics.arrays import Floats, Mask

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
        # Broken cables: 1 is broken. Never drawn: faults are only made on purpose.
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
    """Return the wiring parameters of the motor's cables, and the position of its encoder's index."""
    wired = {name: float(getattr(motor, name.removeprefix("motor."))) for name in WIRING}
    rows = [MachineParameter(name, "1", value, 0.0, 1.0, value) for name, value in wired.items()]
    return [*rows, MachineParameter("motor.index_angle", "rad", 0.0, 0.0, 2.0 * np.pi, 0.0)]


def _set_adc(records: Records, device: Device, motor: Motor, bits: Floats, axes: Mask) -> None:
    set_lanes(records, "adc_step", 2.0 * device.current_full_scale / 2.0**bits, axes)
    set_lanes(records, "adc_step_lsb", 65536.0 / 2.0**bits, axes)


def _set_commutation_offset(records: Records, device: Device, motor: Motor, values: Floats, axes: Mask) -> None:
    """Set the commutation offset; a running drive was aligned, so the error of its angle changes with it."""
    change = values - get_lanes(records, "commutation_offset", len(values)).astype(float)
    set_lanes(records, "angle_zero", get_lanes(records, "angle_zero", len(values)).astype(float) + change, axes)
    set_lanes(records, "commutation_offset", values, axes)


def set_constants(records: Records, device: Device, motor: Motor) -> None:
    """Write the constants of stage and motor that are not parameters."""
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
    motor_parameters,
    wiring_parameters,
    set_constants,
    COMMON
    | {
        "motor.L_d": field("L_d"),
        "motor.L_q": field("L_q"),
        "motor.hall_polarity": field("hall_true_polarity"),
        "motor.hall_direction": field("hall_true_direction"),
        "motor.hall_offset": field("hall_true_offset"),
        "motor.hall_broken": field("hall_broken"),
        "motor.cogging_torque": field("cogging_torque"),
        "motor.cogging_phase": field("cogging_phase"),
        "motor.commutation_offset": _set_commutation_offset,
        "stage.dead_time": lambda records, device, motor, values, axes: set_lanes(
            records, "dead_time_duty", values * device.current_rate, axes
        ),
        "stage.dead_time_current": field("dead_time_current"),
        "stage.adc_bits": _set_adc,
        "stage.adc_noise": field("adc_noise"),
        "stage.adc_offset_a": field("adc_offset_error"),
        "stage.adc_offset_b": field("adc_offset_error", 1),
        "stage.adc_gain_error_a": lambda records, device, motor, values, axes: set_lanes(
            records, "adc_gain", 1.0 + values, axes, 0
        ),
        "stage.adc_gain_error_b": lambda records, device, motor, values, axes: set_lanes(
            records, "adc_gain", 1.0 + values, axes, 1
        ),
        "stage.chopper_resistance": field("chopper_resistance"),
    },
    noise="random",
)
