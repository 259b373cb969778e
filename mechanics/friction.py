"""Dry and viscous friction, semi-implicit: the one place in which friction is computed.

The static law is Coulomb's with Stribeck's rise towards standstill and viscous parts (Armstrong-Helouvry et al.,
Automatica 30(7), 1994): F(v) = F_c + (F_s - F_c) exp(-(v/v_s)^2) + b |v| + c v^2, against the motion.

Explicit Coulomb friction chatters around zero speed, because it is applied for a whole step in the direction of a
speed that it would reverse within it. Here friction may at most stop the motion within the step: with v_free the speed
that the step would reach without friction, the torque is -clip(J v_free / h, +-F).

LuGre's law (Canudas de Wit et al., IEEE TAC 40(3), 1995) has bristles of deflection z between the surfaces:
dz/dt = v - |v| z / z_ss(v), z_ss = (F_c + (F_s - F_c) exp(-(v/v_s)^2)) / s_0, F = s_0 z + s_1 dz/dt + b v + c |v| v.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from mechanics.kernels.compiled import inlined, stage

# Damping ratio of the bristles: LuGre's canonical s_1 = sqrt(s_0) with a mass of 1 kg.
BRISTLE_DAMPING = 0.5


class FrictionModel(NamedTuple):
    """The parts of a load's friction that a model includes; a fan's drag is its load and always included."""

    name: str
    dry: bool
    stribeck: bool
    viscous: bool
    bristles: bool
    meaning: str


FRICTION_MODELS = {
    row.name: row
    for row in (
        FrictionModel("none", False, False, False, False, "no dry and no viscous friction of the load"),
        FrictionModel("coulomb_viscous", True, False, True, False, "sliding friction at all speeds, and viscous"),
        FrictionModel("stribeck", True, True, True, False, "break-away friction that falls to sliding friction"),
        FrictionModel("lugre", True, True, True, True, "the same with bristles: pre-sliding, hysteresis, lag"),
    )
}


def find_friction(name: str) -> FrictionModel:
    """Return a model of friction by name; ValueError lists the known names."""
    if name not in FRICTION_MODELS:
        raise ValueError(f"no friction is named {name!r}; there are {', '.join(FRICTION_MODELS)}")
    return FRICTION_MODELS[name]


@inlined
def middle_speed(v, other, J, h):
    """Return the absolute mean speed of a step of h [s] without friction [rad/s]."""
    return abs(v + 0.5 * h / J * other)


@stage
def dry_friction(speed, coulomb, breakaway, stribeck):
    """Return sliding or break-away friction at a speed of 0 or more [N*m]."""
    # Beyond six times Stribeck's speed the rise is below 1e-15 of itself.
    if breakaway != coulomb and speed < 6.0 * stribeck:
        x = speed / stribeck
        return coulomb + (breakaway - coulomb) * math.exp(-x * x)
    return coulomb


@inlined
def limited_torque(v, other, J, h, dry, viscous, drag):
    """Return the friction torque [N*m] of one step, where dry friction is `dry` at the step's middle speed.

    Written without branches, so that a loop over many copies is vectorised.

    Args:
        v: Speed at the step's start [rad/s].
        other: All other torque on this motion [N*m].
        J: Inertia of this motion [kg*m^2].
        h: Step [s].
        dry: Dry friction at `middle_speed` [N*m].
        viscous: Coefficient b [N*m*s/rad].
        drag: Coefficient c [N*m*s^2/rad^2].
    """
    half = 0.5 * h / J  # mean speed gained per torque in one step
    # With the mean speed of the step, itself reduced by friction: second order, and stable for any b and c.
    mean = max(abs(v + half * other) - half * dry, 0.0)
    # The positive root of u + h/2J (b u + c u^2) = mean.
    damped = 1.0 + half * viscous
    u = 2.0 * mean / (damped + math.sqrt(damped * damped + 4.0 * half * drag * mean))
    limit = dry + (viscous + drag * u) * u
    torque = v * J / h + other
    return -min(max(torque, -limit), limit)


@stage
def bristle_torque(v, other, J, h, z, s_0, s_1, coulomb, breakaway, stribeck, viscous, drag):
    """Return LuGre's friction torque [N*m] of one step, and the bristles' deflection [rad] at its end.

    The step's mean speed u solves u = v + h/2J (other + F(u)); at that speed the bristles relax towards z_ss
    exponentially, computed exactly, so that neither stiff bristles nor high speeds are unstable. `s_0` [N*m/rad] and
    `s_1` [N*m*s/rad] are the bristles' stiffness and damping; the others are as in `dry_friction` and `limited_torque`.
    """
    half = 0.5 * h / J
    free = v + half * other
    reach = half * (s_0 * abs(z) + breakaway + coulomb + s_1 * abs(z) / h) + 1e-12
    low, high = min(free - reach, -1e-12), max(free + reach, 1e-12)
    width = high - low
    u, u_before, miss_before = v, v, 0.0
    mean = 0.0
    end = z
    for turn in range(100):
        x = h * s_0 * abs(u) / max(dry_friction(abs(u), coulomb, breakaway, stribeck), 1e-300)
        if x < 1e-4:
            decay, phi, psi = 1.0 - x + 0.5 * x * x, 1.0 - 0.5 * x + x * x / 6.0, 0.5 - x / 6.0
        else:
            decay = math.exp(-x)
            phi = (1.0 - decay) / x
            psi = (1.0 - phi) / x
        # Mean force = constant + slope u, with x held.
        constant = (s_0 * phi + s_1 * (decay - 1.0) / h) * z
        slope = s_0 * h * psi + s_1 * phi + viscous + drag * abs(u)
        mean = constant + slope * u
        end = decay * z + h * phi * u
        miss = u - free + half * mean
        if miss == 0.0:  # at rest on relaxed bristles; further iterations would only chase rounding errors
            break
        if miss > 0.0:
            high = u
        else:
            low = u
        following = (free - half * constant) / (1.0 + half * slope)
        if turn > 0 and miss != miss_before:
            # x held creeps where friction almost stops the motion; the secant does not.
            secant = u - miss * (u - u_before) / (miss - miss_before)
            if low < secant < high:
                following = secant
        if turn % 2 == 1:
            if high - low > 0.5 * width:
                following = 0.5 * (low + high)
            width = high - low
        if not low < following < high:
            following = 0.5 * (low + high)
        if abs(following - u) <= 1e-12 * (abs(u) + abs(following)) + 1e-18:
            break
        u_before, miss_before = u, miss
        u = following
    return -mean, end
