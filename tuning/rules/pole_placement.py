"""Pole placement: the gains that give a loop chosen poles.

A first-order plant under PI has two poles, s^2 + 2 zeta w_0 s + w_0^2; the small lags are not modelled, so w_0 must
stay below their limit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from tuning.rules.lags import current_lag, slow_enough, velocity_lag
from tuning.rules.optima import PI
from tuning.rules.proposal import Proposal, Workbench

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.loops.linear_model import Plant
    from drive_env.motors import Motor

CURRENT_DAMPING, VELOCITY_DAMPING = 0.9, 1.0
# Crossover, about 2 zeta w_0, times the lags: 0.35 rad is 20 degrees of phase loss that the design does not include.
LAG_SHARE = 0.35


def place_first_order(storage: float, loss: float, natural: float, damping: float) -> PI:
    """Return the controller that gives storage dx/dt + loss x = u the poles s^2 + 2 damping natural s + natural^2.

    Args:
        storage: L of a winding, J of an axis over K_t.
        loss: R of a winding, viscous friction over K_t.
        natural: w_0 [rad/s]; 2 damping natural must be above loss/storage.
        damping: zeta.

    Raises:
        ValueError: If the plant alone is already faster, so that p would not be positive.
    """
    p = 2.0 * damping * natural * storage - loss
    if p <= 0.0:
        raise ValueError(
            f"a natural frequency of {natural:g} rad/s is below what the plant alone has, "
            f"{loss / (2.0 * damping * storage):g} rad/s; choose a faster one"
        )
    return PI(p, p / (natural**2 * storage))


def pole_rule(device: Device, motor: Motor, plant: Plant) -> Proposal:
    """Propose two well damped poles in each PI loop, and a real position pole at a third of their frequency."""
    bench = Workbench(device, plant)
    natural = LAG_SHARE / (2.0 * CURRENT_DAMPING * current_lag(device))
    # A winding that is already fast still gets a proportional gain above 0.
    natural = max(natural, 0.6 * plant.R / (CURRENT_DAMPING * plant.L))
    wanted = place_first_order(plant.L, plant.R, natural, CURRENT_DAMPING)
    p = bench.p("current", wanted.p)
    bench.time("current", p / (natural**2 * plant.L))
    # With this damping the lag of the closed current loop is L over proportional gain plus resistance.
    lag = plant.L / (p + plant.R)
    small = slow_enough(bench, plant, velocity_lag(plant, lag), LAG_SHARE)
    storage, loss = plant.inertia / plant.torque_constant, plant.viscous / plant.torque_constant
    natural = max(LAG_SHARE / (2.0 * VELOCITY_DAMPING * small), 0.6 * loss / (VELOCITY_DAMPING * storage))
    p = bench.p("velocity", place_first_order(storage, loss, natural, VELOCITY_DAMPING).p)
    natural = (p + loss) / (2.0 * VELOCITY_DAMPING * storage)  # with the rounded gain
    bench.time("velocity", p / (natural**2 * storage))
    bench.p("position", natural / 3.0)
    return bench.proposal()
