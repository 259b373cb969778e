"""The voltage lost by the bridge's dead time; its sign is that of the current.

While both switches of a leg are off the current selects the rail. Below the current that charges the switches within
the dead time the loss decreases, so that for small currents it acts like a resistance.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mechanics.arrays import Floats

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.motors import Motor


SQRT3 = 3.0**0.5
ANGLES = 24  # per turn, over which a resistance is averaged
STEP = 1e-3  # of the saturating current, for a difference quotient


def dead_time(angle: Floats, i_q: Floats, saturation: float, brushed: bool) -> Floats:
    """Return the voltage along q lost by dead time, over the greatest loss of one phase.

    Args:
        angle: Electrical angle [rad].
        i_q: Current [A]; i_d is 0.
        saturation: Current from which a phase has the greatest loss [A].
        brushed: Whether the motor is connected between two legs.
    """
    if brushed:
        return np.asarray(2.0 * np.clip(i_q / saturation, -1.0, 1.0))
    s, c = np.sin(angle), np.cos(angle)
    alpha, beta = -s * i_q / saturation, c * i_q / saturation
    a = np.clip(alpha, -1.0, 1.0)
    b = np.clip(0.5 * (SQRT3 * beta - alpha), -1.0, 1.0)
    third = np.clip(-0.5 * (SQRT3 * beta + alpha), -1.0, 1.0)
    return np.asarray(c * (b - third) / SQRT3 - s * (2.0 * a - b - third) / 3.0)


def dead_time_resistance(device: Device, motor: Motor, supply: float, current: Floats) -> float:
    """Return the resistance [ohm] by which dead time in the middle of its range acts on a change of the current.

    Args:
        device: The drive.
        motor: The motor.
        supply: Supply voltage [V].
        current: Samples of the torque-making current [A], shape (n,).
    """
    stage = device.stage
    share = 0.5 * (stage["dead_time"].low + stage["dead_time"].high) * device.current_rate
    saturation = float(np.sqrt(stage["dead_time_current"].low * stage["dead_time_current"].high))
    brushed, step = motor.kind == "dc", STEP * saturation
    angle = np.asarray(np.arange(ANGLES)[:, None] * (2.0 * np.pi / ANGLES), float)
    higher, lower = (dead_time(angle, current[None, :] + side, saturation, brushed) for side in (step, -step))
    return float(supply * share * np.mean(higher - lower) / (2.0 * step))
