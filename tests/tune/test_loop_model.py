"""Identified machines as linear ones, against the true machines of the emulator."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from rigs.known_machines import true_plant

from drive_env.devices import find_device
from drive_env.devices.gains import rule_gains
from drive_env.loops.dynamics import OFF_NOMINAL, find_dynamics
from drive_env.loops.linear_model import Plant
from drive_env.loops.sampled import CascadeGains, LoopRates, open_loops
from drive_env.loops.true_plant import linear_load, true_machines
from drive_env.motors import find_motor
from drive_env.trials.score import RobustScore
from tuning.auto.loop_model import LinkedAxis, LoopModel, loop_models, one_axis, one_plant, two_ends
from tuning.auto.stages import IdentifiedAxes
from tuning.identify.identified_axis import Identification
from tuning.target import emulated

DEVICE, MOTOR, STANDARD = find_device("tmcm1636"), find_motor("qbl4208"), find_dynamics("standard")
F = np.geomspace(2.0, 0.49 * DEVICE.velocity_rate, 500)


def ends_of(drives):
    """Return the two plants that a gantry's axes show alone, by closed form of its true masses, and M, K at the rotors.

    A mass held by one rotor swings at sqrt(k / what is left), free at sqrt(k (J_1 + J_2 + 2 J_12) / det J).
    """
    load = linear_load(drives.machine.drives.inside.groups[0].load)
    to_joints = np.linalg.inv(load.rotors)
    M, K = (to_joints.T @ part[0] @ to_joints for part in (load.M, load.K))
    k, total = K[0, 0], M.sum()
    free = math.sqrt(k * total / np.linalg.det(M)) / (2.0 * math.pi)
    D = to_joints.T @ load.D[0] @ to_joints
    damping = -0.5 * D[0, 1] / k * 2.0 * math.pi * free
    start = Plant.from_data_sheet(DEVICE, MOTOR, 24.0, total, viscous=D.sum())
    plants = [
        replace(start, anti_resonance=math.sqrt(k / M[j, j]) / (2.0 * math.pi), resonance=free, damping=damping)
        for j in (1, 0)
    ]
    return plants, M, K


@pytest.fixture(scope="module")
def gantry():
    with emulated(load="gantry", num_threads=1) as target:
        yield target.drives


def test_both_ends_of_a_gantry_are_known_by_the_responses_of_each_alone(gantry):
    plants, M, K = ends_of(gantry)
    found = two_ends(*plants)
    np.testing.assert_allclose(found.M, M, rtol=1e-9)
    np.testing.assert_allclose(found.K, K, rtol=1e-9)


def test_ends_without_a_resonance_or_with_one_that_no_mass_has_are_no_part(gantry):
    (first, second), _, _ = ends_of(gantry)
    rigid = {"anti_resonance": math.inf, "resonance": math.inf}
    assert two_ends(replace(first, **rigid), replace(second, **rigid)) is None
    higher = replace(first, anti_resonance=1.8 * first.resonance, resonance=2.0 * first.resonance)
    assert two_ends(higher, second) is None, "its mean resonance lies below what its end swings at that is held"
    one = two_ends(first, replace(second, **rigid))
    assert one.M[0, 0] == pytest.approx(one.M[1, 1]), "what one end does not show is taken as on the other"


def test_the_loops_of_a_gantry_are_the_true_ones_with_both_ends_active(gantry):
    plants, M, _ = ends_of(gantry)
    supply = float(gantry.machine.supply[0])
    plants = [replace(plant, supply=supply) for plant in plants]
    gains = np.repeat(rule_gains(DEVICE, MOTOR, 0.5 * M.sum(), supply=supply), 2, axis=0)
    gains[1] = np.rint(0.8 * gains[1])
    true = open_loops(LoopRates.of(DEVICE), true_machines(gantry), CascadeGains.of(DEVICE, gains[None]), F[None])
    model = LoopModel(DEVICE, MOTOR, plants, two_ends(*plants))
    for found, expected in zip(model.open_loops(gains, F), true, strict=True):
        assert np.abs(found / expected[0] - 1.0).max() < 0.03, "its friction differs: of each end, not of the part"
    one = LinkedAxis(model, 1, gains)
    assert one.slack(STANDARD, gains[1][None]) == pytest.approx(model.slack(STANDARD, gains[None]))
    assert [*one.margins(gains[1])] == ["velocity", "position"]


def test_axes_that_feel_each_others_acceleration_are_one_plant_whose_loops_are_the_true_ones():
    """A robot's shoulder, elbow and pitch turn about parallel axes, roll and turn about one; the base feels none."""
    with emulated(load="robot", num_threads=1) as target:
        load = linear_load(target.drives.machine.drives.inside.groups[0].load)
        turning = np.linalg.inv(load.rotors)
        M = turning.T @ load.M[0] @ turning
        plants = tuple(
            Plant.from_data_sheet(DEVICE, MOTOR, 24.0, M[k, k], delay=1.0 / DEVICE.velocity_rate) for k in range(6)
        )
        found = tuple(Identification({}, 0.0, pushed=tuple(row)) for row in M.tolist())
        identified = IdentifiedAxes(found, plants)
        groups = [axes.tolist() for axes in one_plant(target, identified)]
        models = loop_models(target, identified, None, np.ones(6, bool), STANDARD)
        gains = np.concatenate([rule_gains(DEVICE, MOTOR, M[k, k], supply=24.0) for k in range(6)])
        true = open_loops(
            LoopRates.of(DEVICE), true_machines(target.drives), CascadeGains.of(DEVICE, gains[None]), F[None]
        )
        # Whoever has no part in a plant changes nothing of it.
        few = [model.axes for model, _ in loop_models(target, identified, None, np.arange(6) != 2, STANDARD)]
    assert groups == [[0], [1, 2, 4], [3, 5]] and few == [1, 2, 2]
    for model, axes in models:
        for loop, expected in zip(model.open_loops(gains[axes], F), true, strict=True):
            off = np.abs(loop / expected[0, axes] - 1.0)
            assert off[:, F > 20.0].max() < 0.02, "below, their friction tells"


@pytest.mark.parametrize("load", ["inertia", "two_mass"])
def test_an_axis_as_it_may_become_is_the_emulated_one_with_other_inertia_stiffness_and_gain(load):
    with emulated(load=load, num_threads=1) as target:
        plant = true_plant(target.drives)
        gains = rule_gains(DEVICE, MOTOR, plant.inertia, supply=plant.supply)
        score = RobustScore("tmcm1636", load, MOTOR, 1, num_threads=1)
        score.set_machines(target.drives.machine.parameters, target.drives.machine.supply)
        true = score.score(gains)
        score.close()
    model = LoopModel(DEVICE, MOTOR, [plant], one_axis(plant))
    kept = model.kept(STANDARD, gains)
    for variant, clearance in zip(score.variants[1:], true.clearance[0, 1:], strict=True):
        assert kept[variant.name] == pytest.approx(max(clearance, 0.0), abs=0.03), variant.name
    expected = STANDARD.slack(true.clearance[:, 0], true.clearance[:, 1:], true.overshoot)
    assert model.slack(STANDARD, gains[None]) == pytest.approx(expected, abs=0.03 / OFF_NOMINAL)
    nominal = STANDARD.slack(true.clearance[:, 0], np.zeros((1, 0)), true.overshoot)
    assert model.slack(STANDARD, gains[None], nominal=True) == pytest.approx(nominal, abs=0.03)
