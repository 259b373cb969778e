"""Checks whether a motor's numbers contradict each other, as with a wrong unit or form of a data sheet."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from drive_env.motors import RPM, Motor


class FigureBounds(NamedTuple):
    """A figure computed from a motor's numbers, its bounds, their source, and the likely mistake outside.

    Attributes:
        meaning: Its description; a text for `format` with the motor, its rated speed and speed without load [rpm].
        kinds: Kinds of motors that it applies to; a stepper's torque constant and rated speed are computed.
        figure: Computes it for a motor, in `unit`.
    """

    meaning: str
    unit: str
    kinds: tuple[str, ...]
    figure: Callable[[Motor], float]
    low: float
    high: float
    source: str
    remedy: str


_SERVO, _ALL = ("pmsm", "dc"), ("pmsm", "dc", "stepper")


def no_load_speed(motor: Motor) -> float:
    """Return the speed [rad/s] at which the back-EMF equals the supply, with sinusoidal voltages."""
    return (motor.voltage / math.sqrt(3.0) if motor.kind == "pmsm" else motor.voltage) / (motor.n_p * motor.psi_m)


def _mechanical_time(motor: Motor) -> float:
    """Return R J / (k_t k_e) [ms], for a PMSM 2 R_s J / (3 (n_p psi_m)^2)."""
    return 1e3 * motor.copper_resistance * motor.inertia / motor.torque_constant**2


CHECKS = (
    FigureBounds(
        "torque constant {motor.torque_constant:.3g} N*m/A times rated current {motor.rated_current:.3g} A (peak i_q) "
        "over the rated torque of {motor.rated_torque:.3g} N*m", "", _SERVO,
        lambda motor: motor.torque_constant * motor.rated_current / motor.rated_torque, 0.75, 1.35,
        "0.86 (maxon EC 45 flat, 70 W) to 1.19 (Heidenhain SRP 5000); RMS taken for peak is a factor of 1.41",
        "are rated_current and torque_constant of the same ampere, RMS or peak, and of the rated torque's speed?",
    ),
    FigureBounds(
        "rated speed {rated_rpm:.0f} rpm over the {no_load_rpm:.0f} rpm that {motor.voltage:g} V give without load", "",
        _SERVO,
        lambda motor: motor.rated_speed / no_load_speed(motor), 0.1, 1.0,
        "0.35 (Heidenhain SRP 5000) to 0.92 (maxon RE 40); field weakening apart, 1 is the end",
        "is voltage_v the supply of the rated speed, the speed in rpm, the torque constant per ampere RMS or peak?",
    ),
    FigureBounds(
        "electrical time constant L / R", "ms", _ALL, lambda motor: 1e3 * motor.L_q / motor.R_s, 0.02, 60.0,
        "0.035 ms (Faulhaber 2232 BX4) to 11 ms (EMRAX 228), and 10 ms of the catalogue's largest stepper",
        "is the inductance in mH or uH, the resistance in ohm or mohm?",
    ),
    FigureBounds(
        "mechanical time constant R J / (k_t k_e)", "ms", _ALL, _mechanical_time, 0.03, 300.0,
        "0.13 ms (the catalogue's largest stepper) to 22 ms (Faulhaber 2232 BX4 S)",
        "is the inertia in gcm2 or kgcm2, the torque constant in mNm/A or Nm/A?",
    ),
    FigureBounds(
        "electrical frequency without load", "Hz", ("pmsm",),
        lambda motor: motor.n_p * no_load_speed(motor) / (2.0 * math.pi), 20.0, 6000.0,
        "140 Hz (Heidenhain SRP 5000) to 4400 Hz (T-Motor F60 Pro, KV 2550, 14 poles, four cells)",
        "are pole_pairs pole pairs, not poles, and is the torque constant or KV in the unit that is given?",
    ),
)  # fmt: skip


def doubts(motor: Motor) -> list[str]:
    """Return a sentence for each check that a motor fails, with the figure, its bounds and the likely mistake."""
    found = []
    for check in CHECKS:
        value = check.figure(motor) if motor.kind in check.kinds else math.nan
        if value < check.low or value > check.high:
            rated, no_load = motor.rated_speed / RPM, no_load_speed(motor) / RPM
            what = check.meaning.format(motor=motor, rated_rpm=rated, no_load_rpm=no_load)
            unit = f" {check.unit}" if check.unit else ""
            limits = f"{check.low:g} to {check.high:g}{unit}"
            found.append(f"{what} is {value:.3g}{unit}, of other motors {limits}: {check.remedy}")
    return found
