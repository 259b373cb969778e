"""Inertia of an open-loop stepper by its rotor's free swing, against the emulator's truth and a swing of its own."""

from __future__ import annotations

import math

import numpy as np
import pytest

from drive_env.motors import MOTORS
from drive_env.trials.rotor_swing import _errors, _fit, inertia_of_swings
from tuning.search.trial_bench import TrialBench
from tuning.target import emulated

EXPLAINED, LENGTH = 0.85, 100  # of the variance; samples of a swing
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


@pytest.mark.every(5)
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


# --- the fit, against a swing that is integrated apart from it --------------------------------------------------------
MOTOR = MOTORS["qsh4218_51"]._replace(viscous=2e-3)
FRICTIONS, STARTS = (0.01, 0.02, 0.04, 0.07, 0.12), (-1.0, 0.0, 1.0)
STEP = 0.4  # of the field, electrical [rad], made evenly in 4 ms


def swing(inertia, friction, start, age=0.0, held=None, motor=MOTOR, drag=None):
    """Return field and encoder [rad, electrical] of a swing in steps of 2 us, from where friction had left it."""
    dt, held = 2e-6, motor.rated_torque if held is None else held
    x, v, field, rows, seen = start * friction, 0.0, 0.0, [0.0], [0.0]
    drag = motor.viscous if drag is None else drag
    begin = x
    for n in range(1, LENGTH):
        for k in range(500):
            field = STEP * min((n - 1 + (k + 1) / 500) / 4.0, 1.0)
            v += dt * (motor.n_p * held * math.sin(field - x) - drag * v) / inertia
            v -= math.copysign(min(dt * motor.n_p * held * friction / inertia, abs(v)), v)
            x += dt * v
            if k == 499 - round(age / dt):
                seen.append(x - begin)
        rows.append(field)
    return np.array(rows), np.array(seen)


def omega_of(inertia, held=MOTOR.rated_torque):
    return math.sqrt(MOTOR.n_p * held / inertia)


@pytest.mark.parametrize(("friction", "start"), [(0.04, -1.0), (0.07, 1.0), (0.12, -1.0), (0.02, 1.0)])
def test_a_swing_is_nearest_to_that_of_its_own_friction_and_start(friction, start):
    """Columns are frictions, and of each the starts; what is left is the integration's own error."""
    inertia = 6.0 * MOTOR.inertia
    field, seen = swing(inertia, friction, start)
    errors = _errors(MOTOR, np.array([omega_of(inertia)]), field, seen, MOTOR.rated_torque, 0.0)[0]
    assert errors.shape == (15,)
    pairs = [(f, s) for f in FRICTIONS for s in STARTS]
    assert pairs[int(errors.argmin())] == (friction, start)
    assert errors.min() < 4e-3 * seen.var() and errors.min() < 0.5 * np.sort(errors)[1]


def test_a_swing_is_nearest_to_that_of_its_own_frequency_and_its_encoders_age():
    inertia = 6.0 * MOTOR.inertia
    omega = omega_of(inertia)
    for age in (0.0, 0.2e-3, 0.5e-3):
        field, seen = swing(inertia, 0.04, 0.0, age)
        at = {a: _errors(MOTOR, np.array([omega]), field, seen, MOTOR.rated_torque, a)[0, 7] for a in
              (age, age + 0.3e-3)}  # fmt: skip
        assert at[age] < 4e-3 * seen.var() and at[age + 0.3e-3] > 3.0 * at[age]
        near = _errors(MOTOR, omega * np.array([0.93, 1.0, 1.07]), field, seen, MOTOR.rated_torque, age)[:, 7]
        assert near.argmin() == 1 and near[[0, 2]].min() > 3.0 * near[1]


def test_the_motors_bearings_damp_a_swing_by_its_inertia():
    """Twice the drag of the motor is told from it."""
    inertia = 6.0 * MOTOR.inertia
    for factor, is_near in ((1.0, True), (2.0, False), (0.0, False)):
        field, seen = swing(inertia, 0.04, 0.0, drag=factor * MOTOR.viscous)
        error = _errors(MOTOR, np.array([omega_of(inertia)]), field, seen, MOTOR.rated_torque, 0.0)[0, 7]
        assert (error < 4e-3 * seen.var()) == is_near


def test_an_error_is_the_variance_about_its_mean():
    """Of a rotor that rests in a field that rests, what is seen is the difference: a constant is none."""
    zero, wave = np.zeros(LENGTH), 0.3 * (-1.0) ** np.arange(LENGTH)
    errors = _errors(MOTOR, np.array([300.0]), zero, zero + 5.0, MOTOR.rated_torque, 0.0)
    np.testing.assert_allclose(errors[0, 1::3], 0.0, atol=1e-12)
    errors = _errors(MOTOR, np.array([300.0]), zero, wave + 5.0, MOTOR.rated_torque, 0.0)
    np.testing.assert_allclose(errors[0, 1::3], np.var(wave[1:]), rtol=1e-9)


@pytest.mark.every(3)
@pytest.mark.parametrize("rotors", [6.0, 40.0, 250.0])
def test_the_frequency_is_found_between_the_lines_of_its_grid(rotors):
    inertia = rotors * MOTOR.inertia
    held = np.array([MOTOR.rated_torque, 0.5 * MOTOR.rated_torque])
    rows = [swing(inertia, 0.02, 0.0, held=float(torque)) for torque in held]
    demand, position = (7.0 + np.stack([row[k] for row in rows], axis=1) / MOTOR.n_p for k in (0, 1))
    omega, explained = _fit(MOTOR, demand, position, held, 0.0)
    np.testing.assert_allclose(omega, [omega_of(inertia, torque) for torque in held], rtol=0.01)
    assert np.all(explained > 0.99) and np.all(explained <= 1.0)


def test_the_stiffness_of_two_places_is_the_mean_and_the_worse_is_what_counts(monkeypatch):
    """Squares of 100 and 300 rad/s have a mean of 50,000."""
    fits = iter([(np.array([100.0, 50.0]), np.array([0.9, 0.7])), (np.array([300.0, 50.0]), np.array([0.8, 0.95]))])
    monkeypatch.setattr("drive_env.trials.rotor_swing._fit", lambda *arguments: next(fits))
    held = np.array([0.2, 0.4])
    found = inertia_of_swings(np.zeros((2, 3, 2)), np.zeros((2, 3, 2)), held, 0.0, MOTOR)
    np.testing.assert_allclose(found.inertia, [50 * 0.2 / 50_000.0, 50 * 0.4 / 2500.0])
    np.testing.assert_allclose(found.explained, [0.8, 0.7])


@pytest.mark.parametrize(
    ("errors", "shift", "explained"),
    [
        ([5.0, 2.0, 1.0, 2.0, 5.0], 0.0, 0.5),
        ([5.0, 3.0, 1.0, 2.0, 5.0], 1.0 / 6.0, 0.5),  # the vertex of the parabola of 3, 1 and 2
        ([5.0, 1.0, 1.0, 4.0, 5.0], None, 0.5),
        ([1.0, 1.0, 1.0, 1.0, 1.0], 0.0, 0.5),
    ],
)
def test_between_two_lines_the_least_error_is_a_parabolas(errors, shift, explained, monkeypatch):
    middle = []

    def made(motor, omega, field, seen, held, age):
        place = 40
        found = np.full((len(omega), 15), 9.0)
        found[place - 2 : place + 3, 4] = errors
        middle.append(omega[place] if errors[1] > errors[2] else omega[place - 1 if errors[1] < 2.0 else place])
        middle.append(omega[place + 1] / omega[place])
        if errors == [1.0] * 5:
            found[:] = 1.0
            middle[0] = omega[1]
        return found

    monkeypatch.setattr("drive_env.trials.rotor_swing._errors", made)
    wave = np.sqrt(2.0) * (-1.0) ** np.arange(LENGTH)[:, None] / MOTOR.n_p
    omega, share = _fit(MOTOR, wave, wave, np.array([0.2]), 0.0)
    assert middle[1] == pytest.approx(1.03)
    if shift is None:  # of 5, 1 and 1 half a line on: no further
        shift = 0.5
    assert omega[0] == pytest.approx(middle[0] * 1.03**shift)
    assert share[0] == pytest.approx(explained)


def test_the_grid_reaches_from_300_rotors_to_less_than_one_and_the_detents_stiffness_beyond(monkeypatch):
    grids = []

    def made(motor, omega, field, seen, held, age):
        grids.append(omega)
        return np.ones((len(omega), 15))

    monkeypatch.setattr("drive_env.trials.rotor_swing._errors", made)
    held = np.array([0.1, 0.3])
    _, explained = _fit(MOTOR, np.zeros((3, 2)), np.zeros((3, 2)), held, 0.0)
    rotor = 50 * 0.2 / MOTOR.inertia
    assert grids[0][0] == pytest.approx(math.sqrt(rotor / 300.0 / 2.0))
    assert 1.0 < math.sqrt(rotor / 0.8 * 2.0) / grids[0][-1] <= 1.03
    assert explained[0] == pytest.approx(1.0 - 1e12)  # of what did not move at all nothing is explained
