"""IMC and SIMC: controllers that invert the plant's model for a wanted closed-loop time constant.

IMC in PI form (Rivera, Morari, Skogestad 1986) for a first-order lag, and Skogestad's SIMC (2003,
doi:10.1016/S0959-1524(02)00062-8), which accounts for the dead time, here the sum of the small lags, and shortens the
integration time so that load disturbances are also compensated.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from tuning.rules.lags import current_lag, slow_enough, velocity_lag
from tuning.rules.optima import PI
from tuning.rules.proposal import Proposal, Workbench

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.loops.linear_model import Plant
    from drive_env.motors import Motor

# Closed-loop time constants over the dead time, which IMC ignores: the loops must be slower than it.
IMC_CURRENT = 4.0
IMC_VELOCITY = 3.0


def imc_first_order(gain: float, large: float, closed: float) -> PI:
    """Return the IMC controller of a lag gain / (1 + s large) for a closed loop of time constant `closed` [s]."""
    return PI(large / (gain * closed), large)


def simc_first_order(gain: float, large: float, dead: float, closed: float) -> PI:
    """Return the SIMC controller of gain e^(-s dead) / (1 + s large)."""
    return PI(large / (gain * (closed + dead)), min(large, 4.0 * (closed + dead)))


def simc_integrating(slope: float, dead: float, closed: float) -> PI:
    """Return the SIMC controller of slope e^(-s dead) / s."""
    return PI(1.0 / (slope * (closed + dead)), 4.0 * (closed + dead))


def imc_rule(device: Device, motor: Motor, plant: Plant) -> Proposal:
    """Propose IMC: large lags cancelled, closed loops three and four times as slow as the lags that are not modelled.

    An axis with little viscous friction has a time constant of seconds; the integral part is then as slow.
    """
    bench = Workbench(device, plant)
    wanted = imc_first_order(1.0 / plant.R, plant.L / plant.R, IMC_CURRENT * current_lag(device))
    lag = plant.L / bench.p("current", wanted.p)
    bench.time("current", wanted.time)
    small = slow_enough(bench, plant, velocity_lag(plant, lag), 1.0 / IMC_VELOCITY)
    slope = plant.torque_constant / plant.inertia
    crossover = bench.p("velocity", 1.0 / (slope * IMC_VELOCITY * small)) * slope
    if plant.viscous > 0.0:
        bench.time("velocity", plant.inertia / plant.viscous)
    else:
        bench.time("velocity", math.inf)
        bench.note("without viscous friction IMC has no integral part: a constant load leaves an error")
    bench.p("position", crossover / 2.0)
    return bench.proposal()


def simc_rule(device: Device, motor: Motor, plant: Plant) -> Proposal:
    """Propose SIMC with closed loops as slow as their dead time, Skogestad's choice for tight but robust control."""
    bench = Workbench(device, plant)
    dead = current_lag(device)
    wanted = simc_first_order(1.0 / plant.R, plant.L / plant.R, dead, dead)
    lag = plant.L / bench.p("current", wanted.p)
    bench.time("current", wanted.time)
    small = slow_enough(bench, plant, velocity_lag(plant, lag), 0.5)
    slope = plant.torque_constant / plant.inertia
    crossover = bench.p("velocity", simc_integrating(slope, small, small).p) * slope
    bench.time("velocity", 4.0 / crossover)
    bench.p("position", simc_position(crossover))
    return bench.proposal()


def simc_position(crossover: float) -> float:
    """Return k_v [1/s] of the position loop around a velocity loop with this crossover [rad/s].

    The position is the integral of the velocity. For SIMC the dead time of the velocity loop is its lag of 1/crossover,
    and half as much again for its overshoot.
    """
    dead = 1.5 / crossover
    return 1.0 / (2.0 * dead)
