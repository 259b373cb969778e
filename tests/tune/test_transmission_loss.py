"""The loss of a transmission against motions whose currents follow from the equations of `transmission_loss`."""

from __future__ import annotations

import numpy as np
import pytest

from drive_env.drives.interface import CYCLE
from drive_env.motors import find_motor
from tuning.identify.momentum_balance import balance_rows, motion, solve
from tuning.identify.transmission_loss import Loss, find_losses, friction_of_whole_ways

MOTOR = find_motor("qbl4208")
LOAD = 2.0 * MOTOR.inertia
DRY, VISCOUS = 0.2, 6e-4  # A and A*s/rad, half of each before the transmission
RAMP, CRUISE = 60, 140  # cycles
SPEEDS = (300.0, 200.0, 100.0, 300.0, 200.0, 100.0)  # rad/s


def moved(loss, gravity=0.0, glides=False):
    """Return what an axis with such a loss does in moves there and back, and its cruises.

    Args:
        loss: Of what is carried.
        gravity: [A].
        glides: Whether the load runs along by itself in every cruise, slowed by its own friction alone.
    """
    rise = 0.5 - 0.5 * np.cos(np.pi * (np.arange(RAMP) + 1.0) / RAMP)
    twice = 0.5 - 0.5 * np.cos(np.pi * (np.arange(2 * RAMP) + 1.0) / (2 * RAMP))
    level = np.ones(CRUISE)
    once = np.concatenate([rise, level, 1.0 - 2.0 * twice, -level, rise - 1.0])
    speed = np.concatenate([np.zeros(40), *(w * once for w in SPEEDS), np.zeros(40)])
    cruises = []
    for k in range(len(SPEEDS)):
        at = 40 + k * len(once)
        cruises += [(at + RAMP, at + RAMP + CRUISE, k), (at + 3 * RAMP + CRUISE, at + 3 * RAMP + 2 * CRUISE, k)]
    sign, K = np.clip(speed / (0.02 * max(SPEEDS)), -1.0, 1.0), MOTOR.torque_constant
    friction = 0.5 * (DRY * sign + VISCOUS * speed)
    behind = speed.copy()
    for first, last, _ in cruises if glides else ():
        behind[first:last] -= K / LOAD * friction[first] * CYCLE * np.arange(last - first)
        behind[last : last + RAMP] -= (speed[last - 1] - behind[last - 1]) * np.linspace(1.0, 0.0, RAMP)
    carried = LOAD / K * np.gradient(behind) / CYCLE + friction + gravity
    current = MOTOR.inertia / K * np.gradient(speed) / CYCLE + friction + carried + loss * np.abs(carried) * sign
    current += 0.02 * np.random.default_rng(0).normal(size=len(current))
    return motion((np.cumsum(speed) - 0.5 * speed) * CYCLE, current, speed), tuple(cruises)


def cruising(did, cruises):
    """Return dry and viscous friction and offset, as the cruises show them."""
    t = np.arange(len(did.angle))
    weights = [np.clip(1.0 - 2.0 * np.abs(t - 0.5 * (a + b)) / (b - a), 0.0, 1.0) for a, b, _ in cruises]
    rows = balance_rows(did, weights, [number for _, _, number in cruises])
    return solve(rows.columns[:, 1:4], rows.charge, rows.duration, rows.moves).mean


@pytest.mark.parametrize("loss", [0.1, 0.3])
@pytest.mark.parametrize("gravity", [0.0, 0.5])
def test_a_loss_is_found_by_how_braking_differs_from_driving(loss, gravity):
    found = find_losses(*moved(loss, gravity), MOTOR, np.array([DRY, VISCOUS]))
    assert found[0].loss == pytest.approx(loss, rel=0.2)


def test_an_axis_without_a_loss_has_none():
    assert not find_losses(*moved(0.0), MOTOR, np.array([DRY, VISCOUS]))[0].is_clear


def test_the_load_alone_is_what_a_loss_leaves_of_the_inertia_seen():
    rotor = MOTOR.inertia
    seen = Loss(np.zeros(1), share=2.0 * 0.25 / (1.0 - 0.25))
    assert seen.loss == pytest.approx(0.25)
    assert seen.load_alone(rotor + 1.25 * LOAD, rotor) == pytest.approx(rotor + LOAD)


@pytest.mark.parametrize("glides", [False, True])
def test_whole_ways_tell_the_friction_that_a_load_hides_from_cruises_in_its_play(glides):
    did, cruises = moved(0.0, glides=glides)
    true = np.array([DRY, VISCOUS])
    assert cruising(did, cruises)[:2] == pytest.approx(0.5 * true if glides else true, rel=0.1)
    none = Loss(np.zeros(len(did.angle)), 0.0)
    found = friction_of_whole_ways(did, cruises, none, (MOTOR.inertia + LOAD) / MOTOR.torque_constant)
    assert found.mean[:2] == pytest.approx(true, rel=0.1)
