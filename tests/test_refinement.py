"""Where twins know an axis too little the drive itself tells which gains are better, trial by trial."""

from __future__ import annotations

import numpy as np
import pytest
from auto_stages import basis, recorded
from test_rule_as_peer import RULE, Ground, bench_on, shown

from drive_env.devices import find_device
from drive_env.safety.envelope import SafetyError
from tuning.auto import refinement
from tuning.auto.measured_margins import SENSITIVITY, SOUGHT
from tuning.auto.proving import RESTLESS
from tuning.auto.refinement import STEPS, TRIES, refine
from tuning.auto.stages import RuleTried

HIGHEST = find_device("tmcm1636").gains.highest


def start(ground, axes=1, **known):
    """Return bench, basis and gains of machines of one axis each, which have the rule's gains and a response."""
    bench = bench_on(ground, axes)
    bench.target.axes_per_machine = 1
    gains = [RULE] * axes
    cost = ground.cost(np.array(gains))
    values = {"response": object(), "won": np.zeros(axes, bool), "cost": np.ones(axes)} | known
    own = recorded(gains, shown=shown(cost, np.zeros(axes), np.ones(axes, bool)), proof=cost, **values)
    return bench, basis(gains), own


@pytest.fixture
def far(monkeypatch):
    """Every set of gains is far from instability."""
    monkeypatch.setattr(refinement, "sensitivity", lambda *given: 2.0)


def by_position_p(gains):
    """J that falls with position P, and hardly with anything else."""
    return 2100.0 / gains[:, 4] + 1e-6 * gains[:, 2]


def test_what_helps_is_tried_again_and_the_last_that_helped_is_kept(far):
    """Velocity I times 0.65 and position P times 1.5, as long as J falls by 3 %: nothing else is tried before."""
    ground = Ground(lambda gains: np.maximum(by_position_p(gains), 0.9))
    bench, given, own = start(ground)
    found = refine(bench, given, own, bench.target)
    tried = [row[0] for row in ground.tried]
    assert tried[0] == RULE and tried[1] == [*RULE[:3], round(0.65 * RULE[3]), round(1.5 * RULE[4])]
    assert [row[4] for row in tried[1:4]] == [1050, 1575, 2362]
    # The fourth helps by less than 3 %, and so does every other step from there: the round ends, or the trials do.
    assert found.gains[0].tolist() == [*RULE[:3], 494, 2362] and found.proof.tolist() == [0.9]
    assert len(tried) <= 1 + TRIES
    assert bench.journals[0].notes == [
        f"gains refined in {len(tried) - 1} trials on the drive, of which its digital twins do not know enough: the "
        "measured cost J of a trial fell from 3.00 to 0.90"
    ]
    assert found.shown.cost.tolist() == [0.9], "the move on record is that of the gains"


def test_each_axis_climbs_by_itself(far):
    """One gains by position P, the other by less velocity P."""

    def cost(gains):
        return np.where([True, False], by_position_p(gains), gains[:, 2] / 350.0)

    ground = Ground(cost)
    bench, given, own = start(ground, 2)
    found = refine(bench, given, own, bench.target)
    assert found.gains[0, 4] > 3 * RULE[4] and found.gains[0, 2] == RULE[2]
    assert found.gains[1, 2] < 0.7 * RULE[2] and found.gains[1, 4] == RULE[4]


def test_what_fails_its_move_is_not_taken(far):
    class Failing(Ground):
        def show(self, gains, where):
            made = super().show(gains, where)
            return made._replace(reason=("it oscillated" if gains[0, 4] > 1100 else "",))

    ground = Failing(by_position_p)
    bench, given, own = start(ground)
    assert RULE[4] < refine(bench, given, own, bench.target).gains[0, 4] <= 1100


def test_what_shakes_at_rest_is_not_taken(far):
    ground = Ground(by_position_p, lambda gains: np.where(gains[:, 4] > 1100, 1.2 * RESTLESS, 0.0))
    bench, given, own = start(ground)
    found = refine(bench, given, own, bench.target)
    assert RULE[4] < found.gains[0, 4] <= 1100
    assert max(row[0][4] for row in ground.moved) > 1100, "it was looked at"


@pytest.mark.parametrize(("now", "most"), [(2.0, SOUGHT), (3.5, 3.5), (2.0 * SENSITIVITY, None)])
def test_gains_stay_as_far_from_instability_as_is_sought_or_as_they_were(now, most, monkeypatch):
    """By the measured loop, which no trial is needed for."""

    def ms(target, basis, response, gains, k):
        return now * gains[4] / RULE[4]

    monkeypatch.setattr(refinement, "sensitivity", ms)
    ground = Ground(by_position_p)
    bench, given, own = start(ground)
    refine(bench, given, own, bench.target)
    tried = np.array([row[0] for row in ground.tried])[1:]
    assert bool(len(tried)) == (most is not None), "of what is beyond what is allowed nothing near is"
    assert most is None or np.all(now * tried[:, 4] / RULE[4] <= most + 1e-9)


def test_what_is_better_by_a_few_percent_is_left_alone(far):
    """It is not worth other gains: a tenth is asked for, of what a trial measures with its noise."""
    ground = Ground(lambda gains: np.where(gains[:, 4] > RULE[4], 0.92, 1.0))
    bench, given, own = start(ground)
    assert refine(bench, given, own, bench.target).gains.tolist() == [RULE]
    assert bench.journals[0].notes == []


def test_a_climb_ends_with_its_trials_its_time_or_when_nothing_helps(far, monkeypatch):
    ground = Ground(by_position_p)
    bench, given, own = start(ground)
    refine(bench, given, own, bench.target)
    assert len(ground.tried) == 1 + TRIES
    worse = Ground(lambda gains: np.where((gains == RULE).all(axis=1), 1.0, 2.0))
    bench, given, own = start(worse)
    refine(bench, given, own, bench.target)
    assert len(worse.tried) == 1 + len(STEPS), "each step once"
    later = Ground(lambda gains: np.where(gains[:, 2] < RULE[2], 0.5, 1.0))  # the third step, and once only
    bench, given, own = start(later)
    refine(bench, given, own, bench.target)
    assert len(later.tried) == min(1 + TRIES, 1 + 3 + len(STEPS))
    ground = Ground(by_position_p)
    bench, given, own = start(ground)
    bench.spent[:] = bench._budget + refinement.OVERTIME
    refine(bench, given, own, bench.target)
    assert [row[0] for row in ground.tried] == [RULE]


@pytest.mark.parametrize("known", [
    {"won": np.ones(1, bool)}, {"kept": np.ones(1, bool)}, {"unseen": np.ones(1, bool)}, {"response": None},
    {"shown": None}, {"cost": np.full(1, np.nan)},
])  # fmt: skip
def test_where_the_twins_were_right_or_not_asked_or_nothing_tells_margins_nothing_is_refined(known, far):
    ground = Ground(by_position_p)
    bench, given, own = start(ground)
    own = type(own)(**(vars(own) | known))
    assert refine(bench, given, own, bench.target) is own and ground.tried == []


def test_what_won_against_a_lowered_rule_only_is_refined(far):
    ground = Ground(by_position_p)
    rule = RuleTried(np.array([RULE]), np.ones(1, bool), np.ones(1, bool), np.ones(1, bool), np.ones(1))
    bench, given, own = start(ground, won=np.ones(1, bool), rule=rule)
    assert refine(bench, given, own, bench.target).gains[0, 4] > RULE[4]


def test_axes_of_one_machine_are_not_refined(far):
    ground = Ground(by_position_p)
    bench, given, own = start(ground, 2)
    bench.target.axes_per_machine = 2
    assert refine(bench, given, own, bench.target) is own and ground.tried == []


def test_what_the_envelope_stops_leaves_the_gains_as_they_were(far):
    class Stopped(Ground):
        def run(self, gains, where, heavier=False):
            if self.tried:
                raise SafetyError("axis 0 oscillates")
            return super().run(gains, where, heavier)

    ground = Stopped(by_position_p)
    bench, given, own = start(ground)
    assert refine(bench, given, own, bench.target) is own
    assert bench.journals[0].notes == ["the envelope stopped a trial of refined gains: axis 0 oscillates"]


def test_steps_stay_within_the_ranges_of_gains(far):
    ground = Ground(lambda gains: 1.0 / np.prod(gains[:, [0, 2, 3, 4]].astype(float), axis=1))
    bench, given, own = start(ground)
    refine(bench, given, own, bench.target)
    tried = np.array([row[0] for row in ground.tried])
    assert np.all(tried >= 1) and np.all(tried <= HIGHEST)
