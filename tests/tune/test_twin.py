"""Digital twins: emulated machines that are what was identified, and judge gains for it."""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from rigs.chip_gains import Gains
from rigs.known_machines import true_plant

from drive_env import EmulatedDrives, motion
from drive_env.devices import find_device
from drive_env.devices.gains import rule_gains
from drive_env.dictionary.units import RPM
from drive_env.loops.linear_model import Plant
from drive_env.motors import find_motor
from drive_env.trials.oscillation import OSCILLATION
from drive_env.trials.score import robust_cost
from tuning.auto import twin
from tuning.auto.twin import WORLDS, Known, MachineVariant, Twins, known_of, twin_parameters
from tuning.estimate import Estimate, refused
from tuning.identify.identified_axis import Identification

DEVICE, MOTOR = find_device("tmcm1636"), find_motor("qbl4208")
RIGID = Plant.from_data_sheet(DEVICE, MOTOR, 22.0, 2e-5, R=0.41, L=5.5e-4, velocity_filter=260.0)
ELASTIC = replace(RIGID, anti_resonance=70.0, resonance=141.0, damping=0.03)
KNOWN = Known(RIGID, math.inf, 0.1, 2e-4)
ONE = WORLDS[:1]


def scaler(n=1):
    return np.full(n, 65536.0)


@pytest.mark.parametrize("plant", [RIGID, ELASTIC], ids=["rigid", "elastic"])
def test_the_twin_is_the_plant_that_was_identified(plant):
    load = "two_mass" if plant.is_elastic else "inertia"
    values = twin_parameters(DEVICE, MOTOR, KNOWN._replace(plant=plant))
    with EmulatedDrives(load=load, parameters=values, supply=plant.supply, num_threads=1) as drives:
        true = true_plant(drives)
    for name in ("R", "L", "supply", "inertia", "anti_resonance", "resonance", "damping", "velocity_filter"):
        if name != "damping" or plant.is_elastic:
            assert getattr(true, name) == pytest.approx(getattr(plant, name), rel=0.01), name
    assert true.viscous == pytest.approx(2e-4 * MOTOR.torque_constant, rel=0.01)
    dry = values["motor.coulomb"] + values["load.coulomb"]
    assert dry == pytest.approx(0.1 * MOTOR.torque_constant)


def at_speed(load, parameters, torque, speed_rpm):
    """Return the mean current [A] of an emulated machine that turns steadily in pv with a load torque."""
    with EmulatedDrives(load=load, parameters=parameters, supply=RIGID.supply, num_threads=1) as drives:
        drives.machine.load_torque = torque
        drives.write(0x6083, 10_000_000)
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, round(speed_rpm / 60.0 * 65536.0))
        drives.advance(1.0)
        return float(drives.record([0x6077], 1.0)[0x6077].mean()) * 1e-3


@pytest.mark.parametrize("plant", [RIGID, ELASTIC], ids=["rigid", "elastic"])
def test_the_twin_takes_the_current_that_was_identified(plant):
    """i = offset + coulomb sign(omega) + viscous omega, of a machine that is measured like any other."""
    coulomb, viscous, offset = 0.2, 4e-3, 0.5
    known = KNOWN._replace(plant=plant, coulomb=coulomb, viscous=viscous, offset=offset)
    with closing(Twins(DEVICE, MOTOR, [known], scaler(), 1, worlds=ONE)) as twins:
        pull = float(twins._parts[0][1]._constant[0])
    values = twin_parameters(DEVICE, MOTOR, known) | {"motor.cogging_torque": 0.0}
    load = "two_mass" if plant.is_elastic else "inertia"
    for rpm in (600.0, -600.0, 1500.0):
        expected = offset + math.copysign(coulomb, rpm) + viscous * rpm * RPM
        assert at_speed(load, values, pull, rpm) == pytest.approx(expected, abs=0.03)


def test_friction_is_what_a_rough_world_has_less_of():
    rough = twin_parameters(DEVICE, MOTOR, KNOWN, MachineVariant("rough", friction=0.4))
    dry = rough["motor.coulomb"] + rough["load.coulomb"]
    assert dry == pytest.approx(0.4 * 0.1 * MOTOR.torque_constant)
    assert rough["load.breakaway"] == pytest.approx(1.5 * rough["load.coulomb"])


def test_a_resonance_too_fast_for_the_physics_is_taken_as_rigid():
    with closing(Twins(DEVICE, MOTOR, [KNOWN._replace(plant=replace(ELASTIC, resonance=900.0))], scaler(), 2)) as twins:
        (names,) = [[variant.name for variant in robust.variants] for _, robust in twins._parts]
        assert names[-2:] == ["velocity P x 1.5", "velocity P x 0.67"] and "stiffness x 0.8" not in names
        assert twins._parts[0][1]._drives.load.name == "inertia"


def test_a_world_is_as_far_off_as_the_interval_says_but_not_farther_than_makes_sense():
    world = MachineVariant("off", inertia=0.05, velocity_filter=-0.1)

    def off(spread):
        values = twin_parameters(DEVICE, MOTOR, KNOWN._replace(spread=spread), world)
        inertia = values["motor.inertia"] + values["load.inertia"]
        return inertia / RIGID.inertia, values["stage.velocity_filter"] / RIGID.velocity_filter

    assert off({}) == pytest.approx((1.05, 0.9))
    assert off({"inertia": 0.2, "velocity_filter": 0.3}) == pytest.approx((1.2, 0.7))
    assert off({"inertia": 9.0}) == pytest.approx((1.6, 0.9))


def identification(**values):
    names = {"inertia": (2e-5, 0.1), "coulomb": (0.1, 0.2), "viscous": (2e-4, 0.2)} | values
    estimates = {n: Estimate(v, v * (1 - w), v * (1 + w), "") for n, (v, w) in names.items()}
    blank = {
        n: refused("", "not seen") for n in ("anti_resonance", "resonance", "velocity_filter", "coulomb", "viscous")
    }
    return Identification(blank | estimates, 0.0)


def test_a_variant_of_a_fast_resonance_is_one_that_the_physics_resolves():
    known = KNOWN._replace(
        plant=replace(KNOWN.plant, anti_resonance=400.0, resonance=490.0), spread=dict.fromkeys(twin.UNCERTAIN, 0.5)
    )
    with closing(Twins(DEVICE, MOTOR, [known], np.array([65536.0]), 1, num_threads=1)) as twins:
        performance, _ = twins.judge(np.array([[[4000, 1500, 400, 300, 100]]]))
    assert np.isfinite(performance).all()


def test_intervals_become_the_twins_doubt_and_what_was_refused_the_greatest():
    found = known_of(RIGID, identification(velocity_filter=(260.0, 0.2), resonance=(141.0, 0.05)), 3.0)
    assert (found.coulomb, found.viscous) == (0.1, 2e-4)
    assert found.spread == pytest.approx({"inertia": 0.1, "resonance": 0.05, "velocity_filter": 0.2})
    without = known_of(RIGID, identification(coulomb=(math.nan, 0.0)), 3.0)
    assert without.coulomb == 0.0
    assert without.spread["velocity_filter"] == 0.5


def test_the_twin_swings_as_long_as_the_axis_does():
    pair = {"anti_resonance": (70.0, 0.05), "resonance": (141.0, 0.05), "damping": (0.3, 0.3)}
    plant = Plant.from_identification(DEVICE, MOTOR, 22.0, identification(**pair))
    values = twin_parameters(DEVICE, MOTOR, known_of(plant, identification(**pair), math.inf))
    with EmulatedDrives(load="two_mass", parameters=values, supply=22.0, num_threads=1) as drives:
        assert true_plant(drives).damping == pytest.approx(0.3, rel=0.01)


def test_scores_do_not_depend_on_the_lane_nor_on_the_other_axes():
    rule = rule_gains(DEVICE, MOTOR, RIGID.inertia, supply=RIGID.supply)[0]
    slow = np.rint(0.7 * rule).astype(int)
    with closing(Twins(DEVICE, MOTOR, [KNOWN], scaler(), 2, worlds=ONE)) as twins:
        alone = robust_cost(*twins.judge(np.array([[rule, slow]])))
    with closing(Twins(DEVICE, MOTOR, [KNOWN._replace(plant=ELASTIC), KNOWN], scaler(2), 2, worlds=ONE)) as twins:
        both = robust_cost(*twins.judge(np.array([[slow, rule], [slow, rule]])))
    np.testing.assert_allclose(both[1], alone[0, ::-1], rtol=1e-12)
    assert both[0, 0] != both[1, 0]


def test_the_worlds_count_by_their_geometric_mean():
    rule = rule_gains(DEVICE, MOTOR, RIGID.inertia, supply=RIGID.supply)
    scores, slacks = [], []
    for worlds in (WORLDS[:1], WORLDS[1:2], WORLDS[:2]):
        with closing(Twins(DEVICE, MOTOR, [KNOWN], scaler(), 1, worlds=worlds)) as twins:
            performance, slack = twins.judge(rule[:, None])
            scores.append(float(performance[0, 0]))
            slacks.append(float(slack[0, 0]))
    assert scores[2] == pytest.approx(math.sqrt(scores[0] * scores[1]), rel=1e-9)
    assert slacks[2] == slacks[0] != slacks[1], "margins are asked of the axis as it was identified"
    assert scores[0] != scores[1]


def test_as_many_worlds_as_there_are_gains_are_worlds_all_the_same():
    rule = rule_gains(DEVICE, MOTOR, RIGID.inertia, supply=RIGID.supply)
    scores = []
    for worlds in (ONE, ONE * len(Gains._fields)):
        with closing(Twins(DEVICE, MOTOR, [KNOWN], scaler(), 1, worlds=worlds)) as twins:
            scores.append(float(robust_cost(*twins.judge(rule[:, None]))[0, 0]))
    assert scores[1] == pytest.approx(scores[0], rel=1e-9)


def test_gains_that_a_trial_would_stop_count_for_worse(monkeypatch):
    """The robust cost looks at the current at rest only; a trial looks at all of the move, and at the probe."""
    rule = rule_gains(DEVICE, MOTOR, RIGID.inertia, supply=RIGID.supply)[0]
    wild = rule.copy()
    wild[Gains._fields.index("velocity_p")] *= 5
    both = np.array([[rule, wild]])
    slack = {}
    with closing(Twins(DEVICE, MOTOR, [KNOWN], scaler(), 2, worlds=ONE)) as twins:
        swings = twins._parts[0][1].score(both[0]).swing.max(axis=1)
        for limit in (0.8 * OSCILLATION, 0.5 * swings[1], math.inf):
            monkeypatch.setattr(twin, "MOST_SWING", limit)
            slack[limit] = twins.judge(both)[1][0]
    assert swings[0] < 0.8 * OSCILLATION < OSCILLATION < swings[1]
    for limit, (calm, shaking) in slack.items():
        assert calm == slack[math.inf][0]
        assert shaking == pytest.approx(max(min(slack[math.inf][1], 1.0 - swings[1] / limit), -5.0))
    assert slack[0.8 * OSCILLATION][1] < 0.0


def test_a_twin_rests_long_enough_to_show_gains_that_swing_at_rest(monkeypatch):
    """An integrator first has to bring it to the next count: a drawn fan swung by 10 % of the rated current."""
    motor = find_motor("re_35")
    fan = Plant.from_data_sheet(DEVICE, motor, 29.0, 4.55e-5, R=1.22, L=3.3e-4, velocity_filter=198.0)
    gains, slack = np.array([[[908, 9718, 2262, 700, 500], [908, 9718, 1600, 1200, 300]]]), {}
    for rest in (0.0, twin.REST):
        monkeypatch.setattr(twin, "REST", rest)
        with closing(Twins(DEVICE, motor, [Known(fan, math.inf, 0.06, 1.5e-4)], scaler(), 2, 1, ONE, 8)) as twins:
            slack[rest] = twins.judge(gains)[1][0]
    assert (slack[0.0] > 0.0).all() and (slack[twin.REST] > 0.0).tolist() == [False, True]
