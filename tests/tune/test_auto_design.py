"""Design of gains on digital twins: the same whenever it is made, and the best of what keeps the constraints."""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rigs.known_machines import true_plant

from drive_env.devices import find_device
from drive_env.devices.gains import cascade_columns
from drive_env.loops.dynamics import find_dynamics
from drive_env.motors import find_motor
from tuning.auto import design as module
from tuning.auto.design import LEAST_TORQUE, Judge, _around, _of_each, design
from tuning.auto.loop_model import LoopModel, one_axis
from tuning.auto.twin import UNCERTAIN, WORLDS, Known, Twins, gain_bounds
from tuning.target import emulated

DEVICE, MOTOR = find_device("tmcm1636"), find_motor("qbl4208")
TORQUE_P, _, VELOCITY_P, VELOCITY_I, POSITION_P = cascade_columns(DEVICE)


def known(load):
    """Return an axis as a good identification has it, and 2058h."""
    with emulated(load=load, num_threads=1) as target:
        plant = true_plant(target.drives)
    spread = dict(zip(UNCERTAIN, (0.03, 0.03, 0.03, 0.1), strict=True))
    return Known(plant, math.inf, 0.1, 1e-4, spread=spread), np.array([65536.0])


def both_twins(load):
    """Return twins for the many and for the few, and the plant."""
    one, scaler = known(load)
    models = [(LoopModel(DEVICE, MOTOR, [one.plant], one_axis(one.plant)), np.array([0]))]
    coarse = Twins(DEVICE, MOTOR, [one], scaler, 32, worlds=WORLDS[:1], num_threads=1)
    fine = Twins(DEVICE, MOTOR, [one], scaler, 32, repeats=2, num_threads=1)
    return Judge(coarse, models, [None]), Judge(fine, models, [None]), one.plant


@pytest.fixture(scope="module", params=["inertia", "belt"])
def designed(request):
    """Twins of a load, its plant, and the design on them."""
    coarse, fine, plant = both_twins(request.param)
    with closing(coarse.twins), closing(fine.twins):
        yield coarse, fine, plant, design(coarse, fine, [plant])


def test_an_axis_that_could_not_be_measured_must_keep_the_dynamics_without_its_spring_too():
    """A soft spring may be the play of a gear; with it a high integral gain looks safe."""
    (elastic, _), (rigid, _) = known("two_mass"), known("inertia")
    target = SimpleNamespace(device=DEVICE, motor=MOTOR)
    models = module._as_rigid(target, [elastic, elastic, rigid], [None, "measured", None], find_dynamics("standard"))
    assert [axes.tolist() for _, axes in models] == [[0]]
    plain = replace(elastic.plant, anti_resonance=math.inf, resonance=math.inf)
    gains = np.array([4021, 1573, 445, 329, 118])
    wanted = LoopModel(DEVICE, MOTOR, [plain], one_axis(plain)).margins(gains[None])
    assert models[0][0].margins(gains[None]) == wanted


@pytest.mark.slow
def test_a_design_is_the_same_whenever_it_is_made(designed):
    coarse, fine, plant, found = designed
    again = design(coarse, fine, [plant])
    np.testing.assert_array_equal(found.gains, again.gains)
    np.testing.assert_array_equal(found.cost, again.cost)


@pytest.mark.slow
def test_it_keeps_the_constraints_on_its_twin_and_says_what_it_costs_there(designed):
    coarse, fine, _, found = designed
    assert found.slack[0, 0] > 0.0 and coarse.slack(found.gains)[0, 0] == found.slack[0, 0]
    assert np.all(np.diff(found.cost[0]) >= 0.0)
    np.testing.assert_allclose(fine.score(found.gains), found.cost, rtol=1e-9)


@pytest.mark.slow
def test_no_random_search_finds_much_better_gains(designed):
    """300 sets all over the ranges that an engineer would look at, on the same twins."""
    _, fine, _, found = designed
    rng, best = np.random.default_rng(7), found.gains[0, 0]
    factors = np.exp(rng.uniform(np.log(0.3), np.log(3.0), (300, DEVICE.gains.count)))
    rows = np.maximum(np.rint(best * factors), gain_bounds(DEVICE)[0]).astype(np.int64)
    most = found.gains[0, :, TORQUE_P].max()
    rows[:, TORQUE_P] = np.clip(rows[:, TORQUE_P], LEAST_TORQUE * most, most)
    searched = fine.score(rows[None])[0]
    assert found.cost[0, 0] < 1.3 * searched.min()
    assert found.cost[0, 0] < 0.3 * np.median(searched), "most of them keep no constraints"


@pytest.mark.slow
def test_velocity_p_stays_below_what_the_drive_has_shown_to_be_too_much(designed):
    coarse, fine, plant, found = designed
    most = np.floor(0.6 * found.gains[:, 0, VELOCITY_P])
    less = design(coarse, fine, [plant], most_velocity_p=most)
    assert np.all(less.gains[..., VELOCITY_P] <= most)
    assert less.slack[0, 0] > 0.0 and less.cost[0, 0] >= 0.99 * found.cost[0, 0]


# --- on a judge whose truth is known ----------------------------------------------------------------------------------
class Bounds:
    """The faster the better, but for a bound of velocity P and of position P over velocity I."""

    twins = SimpleNamespace(device=DEVICE, num_axes=1)

    def __init__(self, most=900.0):
        self.most, self.asked = most, 0

    def of_machines(self, values, reduce):
        return values

    def slack(self, gains, *, nominal=False):
        ratio = gains[..., POSITION_P] / gains[..., VELOCITY_I]
        return np.minimum(1.0 - gains[..., VELOCITY_P] / self.most, 1.0 - ratio / 0.6)

    def score(self, gains):
        self.asked += gains.shape[1]
        worth = 1e6 / (gains[..., VELOCITY_P] * gains[..., VELOCITY_I] * gains[..., POSITION_P]) ** 0.5
        return np.where(self.slack(gains) > 0.0, worth, 1e3 - self.slack(gains))


def test_it_comes_to_the_border_of_the_constraints_and_not_across():
    plant = known("inertia")[0].plant
    coarse, fine = Bounds(), Bounds()
    found = design(coarse, fine, [plant])
    assert 0.0 < found.slack[0, 0] < 0.1
    assert 0.9 * 900 < found.gains[0, 0, VELOCITY_P] < 900
    assert (
        coarse.asked <= 20 * len(module.TORQUES) * module.EACH
        and fine.asked <= module.FINALISTS + len(module.STEPS) * module.PROMISING
    )


def test_where_no_gains_keep_the_constraints_the_nearest_are_found_and_that_is_said():
    found = design(Bounds(most=0.5), Bounds(most=0.5), [known("inertia")[0].plant])
    assert found.slack[0, 0] < 0.0
    assert found.gains[0, 0, VELOCITY_P] == found.gains[0, :, VELOCITY_P].min() < 100


def test_of_every_bandwidth_the_most_promising_that_keep_the_constraints_are_looked_at():
    slack = np.array([[0.1, 0.2, -0.1, 0.3, -0.3, -0.1, -0.2, -0.4]])
    promise = np.array([[3.0, 2.0, 1.0, 4.0, 1.0, 2.0, 3.0, 4.0]])
    assert _of_each(slack, promise, 2, 2).tolist() == [[1, 0, 5, 6]], "of the second one those that come nearest"


def test_torque_p_is_looked_for_between_three_tenths_of_its_greatest_and_that():
    for torque_p in (1000, 310):
        near = _around(DEVICE, np.array([torque_p, 200, 800, 100, 50]), 1.25, 1000)[:, TORQUE_P]
        assert (near.min(), near.max()) == (max(round(torque_p / 1.25), 300), min(round(torque_p * 1.25), 1000))
    assert min(module.TORQUES) >= LEAST_TORQUE


def test_what_say_raises_ends_a_design():
    def stop(share):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        design(Bounds(), Bounds(), [known("inertia")[0].plant], stop)


def judged(slack, models, axes=1):
    """Return a judge whose measured loops have slack by their velocity P; twins cost 2, 3, ... by axis and keep all."""
    twins = SimpleNamespace(
        dynamics=None,
        num_axes=axes,
        device=DEVICE,
        judge=lambda gains: (np.full(gains.shape[:2], 2.0) + np.arange(axes)[:, None], 1.0),
    )
    measured = SimpleNamespace(slack=lambda dynamics, gains: slack(gains[:, VELOCITY_P]))
    return Judge(twins, models, [measured] * axes)


def sets(*velocity_p):
    """Return sets of gains with these velocity P, (sets, count)."""
    rows = np.full((len(velocity_p), DEVICE.gains.count), 100)
    rows[:, VELOCITY_P] = velocity_p
    return rows


def test_the_design_is_made_for_the_worst_of_measurement_and_model():
    """What a measured loop refuses is refused, whatever the model says of it."""
    model = SimpleNamespace(slack=lambda dynamics, gains, nominal: 1.0 - gains[:, 0, VELOCITY_P] / 900.0)
    both = judged(lambda p: 1.0 - p / 400.0, [(model, np.array([0]))])
    rows = sets(300, 500, 1000)[None]
    assert both.slack(rows)[0] == pytest.approx([0.25, -0.25, -1.5])
    assert (both.score(rows)[0] < 30.0).tolist() == [True, False, False]
    assert (both.score(rows, 0.3)[0] < 30.0).tolist() == [True, True, False]


def test_axes_of_one_machine_have_one_slack_and_the_worst_cost():
    model = SimpleNamespace(slack=lambda dynamics, gains, nominal: 1.0 - gains[..., VELOCITY_P].max(axis=1) / 900.0)
    both = judged(lambda p: np.ones(len(p)), [(model, np.array([0, 1]))], axes=2)
    rows = np.array([sets(300, 600), sets(450, 450)])
    np.testing.assert_allclose(both.slack(rows), [[0.5, 1.0 / 3.0]] * 2)
    np.testing.assert_allclose(both.score(rows), 3.0)  # of the second one; the first one costs 2


class FedForward:
    """Whatever the loops, a share of the speed feed-forward is the best."""

    def __init__(self, device, best):
        self.twins = SimpleNamespace(device=device, num_axes=1)
        self.column, self.best = device.gains.column("feed-forward", "speed"), best

    def of_machines(self, values, reduce):
        return values

    def slack(self, gains, *, nominal=False):
        return np.ones(gains.shape[:2])

    def score(self, gains):
        ahead = 0.0 if self.column is None else gains[..., self.column]
        return 1.0 + np.abs(ahead - self.best) * np.ones(gains.shape[:2])


@pytest.mark.every(4)
@pytest.mark.parametrize("best", [0, 500, 850, 1000])
def test_the_speed_feed_forward_of_a_tgz_is_tried_and_taken_where_it_is_better(best):
    """P-SFF, thousandths of the demanded speed."""
    device = find_device("tgz_d")
    with emulated("tgz_d", "inertia", num_threads=1) as target:
        plant = true_plant(target.drives)
    judge = FedForward(device, best)
    found = design(judge, judge, [plant])
    assert found.gains[0, 0, judge.column] == best and found.cost[0, 0] == 1.0
