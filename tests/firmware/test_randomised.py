"""Domain randomisation: every row's ranges make machines that can be built, stay finite and obey the default tuning.

The criterion, for every axis of a machine after a move of two turns in pp: no fault, the position within 5 % of the
move for the last 0.3 s, and a ripple of the velocity (its greatest deviation from the mean) below 10 % of the profile
velocity. On the inverted pendulum the pole, which nobody balances, swings freely and shakes its cart within these.
"""

import warnings
from collections import Counter

import numpy as np
import pytest

from drive_env import EmulatedDrives, motion
from drive_env.emulator.inertia_check import MisfitWarning
from mechanics.loads import LOADS

MOVE = 2 * 65536  # increments
SPEED = 1_000_000  # increments/s
OBJECTS = (0x6064, 0x606C, 0x6041)


def settle(load, num_machines, friction="stribeck"):
    """Return the drives after the move, and a mask of the machines whose default tuning is stable."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # The heaviest machines may well be said to be heavy.
        warnings.simplefilter("ignore", MisfitWarning)
        drives = EmulatedDrives(load=load, num_machines=num_machines, seed=1, randomise=True, friction=friction)
        motion.enable(drives, mode="pp")
        drives.write("Profile velocity", SPEED)
        motion.start_move(drives, MOVE)
        drives.advance(0.7)
        trace = drives.record(OBJECTS, 0.3)
    position, velocity = trace[0x6064], trace[0x606C]
    stable = (
        np.all(trace[0x6041] & 0x4F != 0x08, axis=0)
        & np.all(np.abs(position - MOVE) < 0.05 * MOVE, axis=0)
        & np.all(np.abs(velocity - velocity.mean(axis=0)) < 0.1 * SPEED, axis=0)
    )
    return drives, stable.reshape(num_machines, -1).all(axis=1)


def check(load, num_machines):
    drives, stable = settle(load, num_machines)
    with drives:
        assert not drives.machine.diverged.any()
        for values in (drives.machine.rotor_angle, drives.machine.rotor_speed, drives.machine.joint_positions):
            assert np.isfinite(values).all()
        causes = Counter(message.name for message in drives.emergencies())
        assert stable.mean() >= 0.95, f"{load}: {stable.mean():.1%} stable, emergencies {dict(causes)}"


@pytest.mark.every(12)
@pytest.mark.parametrize("load", sorted(LOADS))
def test_a_hundred_random_machines_are_sound(load):
    check(load, 100)


@pytest.mark.slow
@pytest.mark.parametrize("load", sorted(LOADS))
def test_a_thousand_random_machines_are_sound(load):
    check(load, 1000)


@pytest.mark.every(6)
@pytest.mark.parametrize("load", sorted(LOADS))
def test_the_ranges_are_drawn_to_their_ends(load):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MisfitWarning)
        drives = EmulatedDrives(load=load, num_machines=64, randomise=("load",))
    with drives, EmulatedDrives(load=load) as default:
        for row in drives.load.parameters:
            value = default.machine.parameters[f"load.{row.name}"][0]
            found = drives.machine.parameters[f"load.{row.name}"] / value
            span = row.high - row.low
            assert row.low <= found.min() < row.low + 0.15 * span
            assert row.high >= found.max() > row.high - 0.15 * span
            assert row.low <= 1.0 <= row.high
