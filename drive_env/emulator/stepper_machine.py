"""Machines with stepper drives: true parameters of motor and stage, and their fields of the record."""

from __future__ import annotations

import numpy as np

from drive_env import motors
from drive_env.devices import Device
from drive_env.emulator.parameters import COMMON, MachineKind, MachineParameter, Records, field
from drive_env.motors import Motor


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
        # Broken cables: 1 is broken. Never drawn: faults are only made on purpose.
        ("motor.encoder_broken", "1", 0.0),
        ("motor.open_a", "1", 0.0),
        ("motor.open_b", "1", 0.0),
        ("stage.short_conductance", "S", 0.0),
        ("motor.encoder_interpolation", "1", 1.0),
    ):
        rows.append(MachineParameter(name, unit, value, value, value, value))
    return rows


def wiring_parameters(motor: Motor) -> list[MachineParameter]:
    """Return the wiring parameters of the motor's cables, its encoder's index, and the times of a brake on it."""
    wired = float(motor.encoder_direction)
    return [
        MachineParameter("motor.encoder_direction", "1", wired, 0.0, 1.0, wired),
        MachineParameter("motor.index_angle", "rad", 0.0, 0.0, 2.0 * np.pi, 0.0),
        MachineParameter("stage.short_a", "S", 0.0, 0.0, 0.0, 0.0),
        MachineParameter("stage.short_b", "S", 0.0, 0.0, 0.0, 0.0),
        MachineParameter("motor.index_inverted", "1", 0.0, 0.0, 0.0, 0.0),
        # Usual for brakes of some newton metres that are closed by a spring.
        MachineParameter("motor.brake_opens_in", "s", 0.04, 0.02, 0.08, 0.04),
        MachineParameter("motor.brake_closes_in", "s", 0.02, 0.01, 0.04, 0.02),
    ]


def set_constants(records: Records, device: Device, motor: Motor) -> None:
    """Write the constants of stage and motor that are not parameters."""
    records["duty_limit"] = device.duty_limit
    records["overcurrent"] = device.overcurrent
    records["full_scale_current"] = device.current_full_scale
    records["flux_temperature"] = motor.flux_temperature
    records["n_p"] = motor.n_p


STEPPER = MachineKind(
    motor_parameters,
    wiring_parameters,
    set_constants,
    COMMON
    | {
        "motor.L_s": field("L_s"),
        "motor.detent_torque": field("detent_torque"),
        "motor.saturation": field("saturation"),
        "motor.index_inverted": field("index_inverted"),
        "motor.brake_opens_in": field("brake_opens_in"),
        "motor.brake_closes_in": field("brake_closes_in"),
        "stage.chopper_clock": field("chopper_clock"),
        "stage.short_a": field("short_a"),
        "stage.short_b": field("short_b"),
    },
    noise="",
)
