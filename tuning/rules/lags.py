"""The small lags that rules use, loop by loop, and how much an elastic load slows a loop down."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from drive_env.devices.gains import VELOCITY_FILTER_DAMPING
from drive_env.emulator.parameters import velocity_filter

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.loops.linear_model import Plant
    from tuning.rules.proposal import Workbench

ANTI_RESONANCE_SHARE = (
    0.5  # greatest crossover of a velocity loop over the first anti-resonance, as manufacturers' tools use it
)
_RESPONSE = 4096  # samples after which a velocity filter's impulse response has decayed, for corners from 5 Hz


def current_lag(device: Device) -> float:
    """Return the sum of the current loop's small time constants [s]: 1 PWM period of computation, 0.5 of hold."""
    return 1.5 / device.current_rate


def velocity_lag(plant: Plant, current: float) -> float:
    """Return the sum of the velocity loop's small time constants [s].

    Args:
        plant: The axis, with its delay and the corner of its velocity filter.
        current: Time constant of the closed current loop [s].
    """
    return current + plant.delay + 2.0 * VELOCITY_FILTER_DAMPING / (2.0 * math.pi * plant.velocity_filter)


def slow_enough(bench: Workbench, plant: Plant, small: float, share: float) -> float:
    """Return the small time constant, or a larger one with which a crossover of share/small stays below the limit.

    The limit is half the first anti-resonance: above it, only the rotor follows, not the load on its spring.
    """
    if not math.isfinite(plant.anti_resonance):
        return small
    highest = ANTI_RESONANCE_SHARE * plant.anti_resonance
    wanted = share / small / (2.0 * math.pi)
    if wanted <= highest:
        return small
    bench.note(
        f"velocity loop limited to {highest:.0f} Hz, half the anti-resonance at {plant.anti_resonance:.0f} Hz; "
        f"the lags alone would allow {wanted:.0f} Hz"
    )
    return share / (2.0 * math.pi * highest)


def velocity_noise(device: Device, plant: Plant) -> float:
    """Return the RMS noise in the filtered velocity of a turning axis caused by the encoder's resolution [rad/s].

    Position errors are uniform within half a count and independent from sample to sample; the velocity is their
    filtered difference.
    """
    from scipy.signal import lfilter

    b, a1, a2 = (
        float(x) for x in velocity_filter(np.asarray(min(plant.velocity_filter, 0.45 * device.velocity_rate)),
                                          device.velocity_rate)
    )  # fmt: skip
    impulse = np.zeros(_RESPONSE)
    impulse[0] = device.velocity_rate
    impulse[1] = -device.velocity_rate
    answer = lfilter(b * np.array([1.0, 2.0, 1.0]), [1.0, a1, a2], impulse)
    count = 2.0 * math.pi / plant.counts
    return float(count / math.sqrt(12.0) * math.sqrt(np.sum(answer**2)))
