"""Machines with servo amplifiers on mains: parameters of a servo machine, rectifier, DC link and braking resistor.

In a machine with an even number of axes, pairs of axes form two-axis modules and share DC links. Machines of one axis
have a module each, until a fieldbus node has two of them: axes of one module share its link, whatever they turn. A
machine of three axes has three links, and each axis of a device with one axis has its own.
"""

from __future__ import annotations

import numpy as np

from drive_env.devices import Device
from drive_env.emulator import servo_machine
from drive_env.emulator.parameters import MachineKind, MachineParameter, Records, check_one_supply, field
from drive_env.emulator.servo_machine import SERVO
from drive_env.firmware.record import LANES, get_lanes, set_lanes
from drive_env.firmware.servo.alignment import BLDC, ENCODER, USE_OFFSET
from drive_env.motors import Motor
from mechanics.arrays import Mask

AXES = 2  # per shared DC link
OFFSET_SHARE = 0.05  # of the current's range: largest current reading while the stage is off
CHOPPER, CHOPPER_HYSTERESIS = 0.92, 0.025  # of the over-voltage: where the chopper starts, and its hysteresis
MOTOR_TEMPERATURE, AMBIENT = 145.0, 60.0  # degC; class values: below the sensor's limit (M-MaxResTerm), and a cabinet

_NOT_HERE = {"stage.idle_current", "stage.supply_sinks"}  # the rectifier only feeds


def motor_parameters(motor: Motor) -> list[MachineParameter]:
    """Return the parameters of a motor, in the order of drawing; those of mains and brake are never drawn."""
    rows = servo_machine.motor_parameters(motor)
    for name in ("mains_phase_lost", "emergency_stop"):
        rows.append(MachineParameter(f"stage.{name}", "1", 0.0, 0.0, 0.0, 0.0))
    for name, value in (("brake_opens_in", 0.04), ("brake_closes_in", 0.02)):  # usual for a brake closed by a spring
        rows.append(MachineParameter(f"motor.{name}", "s", value, value, value, value))
    return rows


def wiring_parameters(motor: Motor) -> list[MachineParameter]:
    """Return the wiring parameters of the motor's cables, and the connection of its brake, which is never drawn."""
    brake = (("motor.brake_switch", "1", 0.0), ("stage.brake_supply", "V", 24.0))
    rows = [MachineParameter(name, unit, value, value, value, value) for name, unit, value in brake]
    return [*SERVO.wiring_parameters(motor), *rows]


def set_constants(records: Records, device: Device, motor: Motor) -> None:
    """Write the constants of stage and motor that are not parameters, and the drive's data of its motor."""
    servo_machine.set_constants(records, device, motor)
    records["cyclic_wraps"] = 1  # internal positions have 64 bits; 6064h has the lower 32
    records["chopper_enable"] = 1.0
    records["chopper_voltage"] = CHOPPER * device.overvoltage
    records["chopper_hysteresis"] = CHOPPER_HYSTERESIS * device.overvoltage
    records["offset_limit"] = OFFSET_SHARE * device.current_full_scale
    records["current_range"] = device.current_full_scale
    records["motor_temperature"] = MOTOR_TEMPERATURE
    records["ambient_limit"] = AMBIENT
    for mode, needed in device.mode_gate.items():
        records["d_mode_needed"][:, mode, :] = needed
    for lane in range(LANES):  # three inputs for the switches of each axis of a module
        records["switch_input"][:, :, lane] = 3 * (lane % device.num_axes) + np.arange(3)
        records["module_axis"][:, lane] = lane % device.num_axes
    # for an absolute encoder, which knows the rotor's angle
    records["motor_type"], records["commutation_mode"], records["encoder_init_mode"] = BLDC, ENCODER, USE_OFFSET
    records["pole_pairs"], records["encoder_steps"] = motor.n_p, motor.encoder_counts
    records["encoder_direction"] = motor.encoder_direction


def connect(records: Records, device: Device, axes: Mask) -> None:
    """Make axes 2k and 2k + 1 of a two-axis device share DC link and inputs."""
    if device.num_axes != AXES:
        return
    pairs = np.zeros(len(axes) + len(axes) % 2, bool)
    pairs[: len(axes)] = axes
    both = np.repeat(pairs.reshape(-1, 2).all(axis=1), 2)[: len(axes)]
    number = np.arange(len(axes))
    volts = get_lanes(records, "supply_voltage", len(axes)).astype(float)
    check_one_supply(volts, np.where(both, number - number % 2, number))
    set_lanes(records, "link_shared", both.astype(float), both)


SERVO_MAINS = MachineKind(
    motor_parameters,
    wiring_parameters,
    set_constants,
    {name: write for name, write in SERVO.writes.items() if name not in _NOT_HERE}
    | {
        "stage.mains_frequency": field("mains_frequency"),
        "stage.charging_resistance": field("charging_resistance"),
        "stage.idle_power": field("idle_power"),
        "stage.brake_power": field("brake_power"),
        "stage.brake_thermal_time": field("brake_thermal_time"),
        "stage.mains_phase_lost": field("mains_phase_lost"),
        "stage.emergency_stop": field("emergency_stop"),
        "stage.brake_supply": field("brake_supply"),
        "motor.brake_switch": field("brake_switch"),
        "motor.brake_opens_in": field("brake_opens_in"),
        "motor.brake_closes_in": field("brake_closes_in"),
    },
    noise=SERVO.noise,
    connect=connect,
)
