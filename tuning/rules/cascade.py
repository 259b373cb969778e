"""Classical commissioning, loop by loop: current, velocity, position, each around the closed inner loop.

Current by the modulus optimum. Velocity by the symmetrical optimum, slowed down by the strictest of these: the lags,
half the first anti-resonance, or the current noise caused by the encoder's resolution. Position at a quarter of the
velocity loop's crossover.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from tuning.rules.lags import slow_enough, velocity_lag, velocity_noise
from tuning.rules.optima import take_current
from tuning.rules.proposal import Proposal, Workbench

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.loops.linear_model import Plant
    from drive_env.motors import Motor

SPREAD = 3.0  # a: 53 degrees of phase margin, as commissioning engineers prefer, instead of the textbook's 37
POSITION = 0.25  # k_v over the velocity loop's crossover
NOISE = 0.1  # greatest RMS current caused by the encoder's resolution, over the rated current


def cascade_rule(device: Device, motor: Motor, plant: Plant) -> Proposal:
    """Propose gains loop by loop; notes name what limits the velocity loop."""
    bench = Workbench(device, plant)
    lag = take_current(bench, device, plant)
    small = slow_enough(bench, plant, velocity_lag(plant, lag), 1.0 / SPREAD)
    slope = plant.torque_constant / plant.inertia
    wanted = 1.0 / (SPREAD * slope * small)
    quiet = NOISE * motor.rated_current / velocity_noise(device, plant)
    if wanted > quiet:
        bench.note(
            f"velocity loop limited to {quiet * slope / (2.0 * math.pi):.0f} Hz, where the encoder's {plant.counts} "
            f"counts cause current noise of {100.0 * NOISE:.0f} % of rated; the lags alone would allow "
            f"{wanted * slope / (2.0 * math.pi):.0f} Hz"
        )
        wanted = quiet
    crossover = bench.p("velocity", wanted) * slope
    bench.time("velocity", SPREAD / crossover)
    bench.p("position", POSITION * crossover)
    return bench.proposal()
