"""Dry and viscous friction, semi-implicit: the one place in which friction is computed.

The law is Coulomb's with Stribeck's rise towards standstill and a viscous part (Armstrong-Helouvry et al., Automatica
30(7), 1994): F(v) = F_c + (F_s - F_c) exp(-(v/v_s)^2) + b |v|, against the motion.

Explicit Coulomb friction chatters around zero speed, because it is applied for a whole step in the direction of a
speed that it would reverse within it. Here friction may at most stop the motion within the step: with v_free the speed
that the step would reach without friction, the torque is -clip(J v_free / h, +-F).
"""

from __future__ import annotations

import math

from mechanics.compiled import stage


@stage
def friction_torque(v, other, J, h, coulomb, breakaway, stribeck, viscous):
    """Return the friction torque [N*m] of one step.

    Args:
        v: Speed at the step's start [rad/s].
        other: All other torque on this motion [N*m].
        J: Inertia of this motion [kg*m^2].
        h: Step [s].
        coulomb: Sliding friction F_c [N*m].
        breakaway: Friction at standstill F_s [N*m].
        stribeck: Speed v_s over which it falls to F_c [rad/s].
        viscous: Coefficient b [N*m*s/rad].
    """
    mobility = h / J  # speed gained per torque in one step
    v_free = v + mobility * other
    v_mid = 0.5 * abs(v + v_free)
    limit = coulomb
    # Beyond six times Stribeck's speed the rise is below 1e-15 of itself.
    if breakaway != coulomb and v_mid < 6.0 * stribeck:
        x = v_mid / stribeck
        limit += (breakaway - coulomb) * math.exp(-x * x)
    if viscous != 0.0:
        # With the mean speed of the step, itself reduced by friction: second order, and stable for any b.
        v_mean = max(v_mid - 0.5 * mobility * limit, 0.0)
        limit += viscous * v_mean / (1.0 + 0.5 * mobility * viscous)
    torque = v_free / mobility
    if torque > limit:
        return -limit
    if torque < -limit:
        return limit
    return -torque
