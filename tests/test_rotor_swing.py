"""Inertia of an open-loop stepper by its rotor's free swing, against the emulator's truth and a swing of its own."""

from __future__ import annotations

import math

import numpy as np
import pytest

from drive_env.motors import MOTORS
from drive_env.trials.rotor_swing import EXPLAINED, LENGTH, inertia_of_swings
from tuning.search.trial_bench import TrialBench
from tuning.target import emulated

WITHIN = {
    ("tmcm3313", "qsh4218_51"): 0.12,
    ("tmcm3313", "qsh6018_86"): 0.12,
    ("tmcm6212", "qsh6018_86"): 0.3,  # its ramps end at 3 full steps in 6 ms, as long as a light rotor swings
}
ROTORS = (1.2, 2.5, 6.0, 12.0, 30.0)
BRIEF = [("tmcm3313", "qsh4218_51", 2.5), ("tmcm3313", "qsh6018_86", 20.0), ("tmcm6212", "qsh6018_86", 6.0)]
ALL = [(*which, rotors) for which in WITHIN for rotors in ROTORS if (*which, rotors) not in BRIEF]


@pytest.mark.parametrize(
    ("device", "name", "rotors"), BRIEF + [pytest.param(*row, marks=pytest.mark.slow) for row in ALL]
)
def test_the_identified_inertia_is_the_machines(device, name, rotors):
    within = WITHIN[device, name]
    motor = MOTORS[name]
    parameters = {"load.inertia": (rotors - 1.0) * motor.inertia}
    with emulated(device, "inertia", name, num_threads=1, parameters=parameters) as target:
        bench = TrialBench(target)
        bench.identify()
        assert bench.identified.inertia[0] == pytest.approx(rotors * motor.inertia, rel=within)
        values = target.drives.machine.parameters
        friction = values["motor.coulomb"] + values["load.coulomb"]
        assert 0.5 * friction < bench.identified.coulomb[0] * motor.torque_constant < 4.0 * friction + 0.01


def swings(motor, inertia, friction, detent, at):
    """Return demand and position of a swing by an integration in 5 us, detent torque included; `at` is electrical."""
    dt, held = 5e-6, motor.rated_torque
    x, v, rows = at, 0.0, [(0.0, 0.0)]
    start = x
    step = math.pi / 8.0
    for n in range(1, LENGTH):
        for k in range(200):
            field = at + step * min(n - 1 + (k + 1) / 200, 1.0)
            torque = held * math.sin(field - x) - detent * math.sin(4.0 * x) - motor.viscous * v / motor.n_p
            v += dt * motor.n_p * torque / inertia
            v -= math.copysign(min(dt * motor.n_p * friction / inertia, abs(v)), v)
            x += dt * v
        rows.append((step, x - start))
    return np.array(rows) / motor.n_p


@pytest.mark.parametrize("rotors", [1.2, 4.0, 20.0])
@pytest.mark.parametrize("phase", [0.0, math.pi / 8.0])
def test_detent_torque_cancels_between_two_places_wherever_full_steps_are(rotors, phase):
    """It changes the stiffness by a fifth; half a full step on, by a fifth the other way."""
    motor = MOTORS["qsh4218_51"]
    inertia, held = rotors * motor.inertia, np.array([motor.rated_torque])
    found = [
        swings(motor, inertia, 0.02 * motor.rated_torque, 0.05 * motor.rated_torque, phase + half)
        for half in (0.0, math.pi / 4.0)
    ]
    demand, position = (np.stack([one[:, k, None] for one in found]) for k in (0, 1))
    swing = inertia_of_swings(demand, position, held, 0.0, motor)
    assert swing.explained[0] > EXPLAINED
    assert swing.inertia[0] == pytest.approx(inertia, rel=0.08)
    alone = inertia_of_swings(demand[:1], position[:1], held, 0.0, motor).inertia[0]
    assert not phase or abs(alone / inertia - 1.0) > 0.08, "one place alone is wrong by the detent torque"


def test_what_does_not_swing_is_not_explained():
    motor = MOTORS["qsh4218_51"]
    demand = np.zeros((2, LENGTH, 1))
    demand[:, 1:] = math.pi / 8.0 / motor.n_p
    noise = np.random.default_rng(1).normal(0.0, 1e-3, demand.shape)
    swing = inertia_of_swings(demand, noise, np.array([motor.rated_torque]), 0.0, motor)
    assert swing.explained[0] < EXPLAINED
