"""Raw gains of 2041h, 2042h and 2043h from bandwidths, and back.

The scale is the motion chip's: with f the current bandwidth [Hz], V the supply, w_v the velocity bandwidth [rad/s], T_i
the integration time and k_v the position gain [1/s], the raw integers are

    P_T = 25600 2 pi f L / V     I_T = 65536 dt_c R / L     P_V = 8784 w_v J / K_t     I_V = 65536 dt_v / T_i
    P_P = 3.75 k_v

for a current loop of full scale 100 A; the functions take the scale from the device's data.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from drive_env.devices import Device
from drive_env.dictionary.units import RPM
from drive_env.motors import Motor

RAW_MAX = 32767  # the chip's registers are signed
DEFAULT_INTEGRATION = 5.0  # T_i as a multiple of 1/w_v


class Gains(NamedTuple):
    """Raw integers of 2041h:01, 2041h:02, 2042h:01, 2042h:02, 2043h:01."""

    torque_p: int
    torque_i: int
    velocity_p: int
    velocity_i: int
    position_p: int


class Bandwidths(NamedTuple):
    """What gains mean on a motor with a total inertia.

    current_hz, velocity_hz [Hz], velocity_integration_s [s], position_hz [Hz] (k_v / 2 pi).
    """

    current_hz: float
    velocity_hz: float
    velocity_integration_s: float
    position_hz: float


def gains_from_bandwidths(
    device: Device,
    motor: Motor,
    inertia: float,
    *,
    current_hz: float,
    velocity_hz: float,
    position_hz: float,
    supply: float | None = None,
    integration: float = DEFAULT_INTEGRATION,
) -> Gains:
    """Return the raw gains for the bandwidths wanted.

    Args:
        device: The drive.
        motor: The motor.
        inertia: Total inertia, rotor and load [kg*m^2].
        current_hz: Bandwidth of the current loop [Hz].
        velocity_hz: Bandwidth of the velocity loop [Hz].
        position_hz: Gain k_v of the position loop over 2 pi [Hz].
        supply: Supply voltage [V]; the motor's own by default.
        integration: Integration time of the velocity loop as a multiple of 1/w_v.

    Raises:
        ValueError: If a gain leaves 1...32767.
    """
    w_v = 2.0 * math.pi * velocity_hz
    raw = {
        "torque P": _torque_p_scale(device, motor, supply) * 2.0 * math.pi * current_hz,
        "torque I": 65536.0 / device.current_rate * motor.R_s / motor.L_q,
        "velocity P": _velocity_p_scale(device, motor, inertia) * w_v,
        "velocity I": 65536.0 / device.velocity_rate * w_v / integration,
        "position P": _POSITION_P_SCALE * 2.0 * math.pi * position_hz,
    }
    for name, value in raw.items():
        if not 0.5 <= value < RAW_MAX + 0.5:
            raise ValueError(f"{name} would be {value:.0f}, outside 1...{RAW_MAX}; choose another bandwidth")
    return Gains(*(round(value) for value in raw.values()))


def bandwidths_from_gains(
    device: Device, motor: Motor, inertia: float, gains: Gains, *, supply: float | None = None
) -> Bandwidths:
    """Return what raw gains mean; the inverse of `gains_from_bandwidths`."""
    two_pi = 2.0 * math.pi
    return Bandwidths(
        current_hz=gains.torque_p / _torque_p_scale(device, motor, supply) / two_pi,
        velocity_hz=gains.velocity_p / _velocity_p_scale(device, motor, inertia) / two_pi,
        velocity_integration_s=65536.0 / device.velocity_rate / gains.velocity_i if gains.velocity_i else math.inf,
        position_hz=gains.position_p / _POSITION_P_SCALE / two_pi,
    )


_POSITION_P_SCALE = 4096.0 * 2.0 * math.pi / 65536.0 / RPM  # raw per 1/s


def _torque_p_scale(device: Device, motor: Motor, supply: float | None) -> float:
    """Return raw torque P per rad/s of bandwidth."""
    return 256.0 * device.current_full_scale * motor.L_q / (motor.voltage if supply is None else supply)


def _velocity_p_scale(device: Device, motor: Motor, inertia: float) -> float:
    """Return raw velocity P per rad/s of bandwidth."""
    return 256.0 * RPM * 32768.0 / device.current_full_scale * inertia / motor.torque_constant
