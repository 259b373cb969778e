"""Modulus optimum and symmetrical optimum: the current loop by the first, the velocity loop by either.

Both replace all small lags by one time constant T (Kessler 1955, 1958). With a plant k / ((1 + s T_1)(1 + s T)) the
modulus optimum cancels T_1 and gives a damping of 0.707: 4.3 % overshoot. With k / (s (1 + s T)) the symmetrical
optimum puts the crossover at 1/(a T), in the middle between 1/(a^2 T) and 1/T: a = 2 gives 36.9 degrees of phase margin
and, without a set-point filter, 43.4 % overshoot.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from tuning.rules.lags import current_lag, slow_enough, velocity_lag
from tuning.rules.proposal import Proposal, Workbench

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.loops.linear_model import Plant
    from drive_env.motors import Motor

SPREAD = 2.0  # a of the symmetrical optimum
POSITION = 0.5  # k_v over the velocity loop's crossover: modulus optimum with the velocity loop as one lag
POSITION_SYMMETRICAL = 0.25  # for a velocity loop that overshoots


class PI(NamedTuple):
    """A controller p (1 + 1/(s time)); an infinite time makes it proportional."""

    p: float
    time: float


def modulus_optimum(gain: float, large: float, small: float) -> PI:
    """Return the controller of a plant gain / ((1 + s large)(1 + s small)).

    Args:
        gain: Gain of the plant [output per input].
        large: Time constant to cancel [s].
        small: Sum of the other time constants [s].
    """
    return PI(large / (2.0 * gain * small), large)


def symmetrical_optimum(slope: float, small: float, spread: float = SPREAD) -> PI:
    """Return the controller of a plant slope / (s (1 + s small)).

    Args:
        slope: Rate of the output per input [output per input and s].
        small: Sum of the small time constants [s].
        spread: a; the phase margin is asin((a^2 - 1)/(a^2 + 1)).
    """
    return PI(1.0 / (spread * slope * small), spread**2 * small)


def modulus_rule(device: Device, motor: Motor, plant: Plant) -> Proposal:
    """Propose the modulus optimum for all three loops.

    The velocity loop of an axis without viscous friction has no lag to cancel: it then gets no integral part, and a
    constant load leaves a steady error.
    """
    bench = Workbench(device, plant)
    lag = take_current(bench, device, plant)
    small = slow_enough(bench, plant, velocity_lag(plant, lag), 0.5)
    slope = plant.torque_constant / plant.inertia
    if plant.viscous > 0.0:
        found = modulus_optimum(plant.torque_constant / plant.viscous, plant.inertia / plant.viscous, small)
    else:
        found = PI(1.0 / (2.0 * slope * small), float("inf"))
        bench.note("without viscous friction the modulus optimum has no integral part: a constant load leaves an error")
    reached = bench.p("velocity", found.p)
    bench.time("velocity", found.time)
    bench.p("position", POSITION * reached * slope)
    return bench.proposal()


def symmetrical_rule(device: Device, motor: Motor, plant: Plant) -> Proposal:
    """Propose the symmetrical optimum for the velocity loop, and the modulus optimum for the current loop."""
    bench = Workbench(device, plant)
    lag = take_current(bench, device, plant)
    small = slow_enough(bench, plant, velocity_lag(plant, lag), 1.0 / SPREAD)
    slope = plant.torque_constant / plant.inertia
    reached = bench.p("velocity", symmetrical_optimum(slope, small).p)
    crossover = reached * slope
    # The integration time is relative to the crossover that was reached after rounding.
    bench.time("velocity", SPREAD / crossover)
    bench.p("position", POSITION_SYMMETRICAL * crossover)
    return bench.proposal()


def take_current(bench: Workbench, device: Device, plant: Plant) -> float:
    """Set the current loop by the modulus optimum; return its lag as seen by the outer loops [s]."""
    found = modulus_optimum(1.0 / plant.R, plant.L / plant.R, current_lag(device))
    reached = bench.p("current", found.p)
    bench.time("current", found.time)
    return plant.L / reached
