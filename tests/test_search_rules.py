"""The rules of a search without a machine: points and gains, how far a safe one goes, what is kept and what is told."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from tuning.search.optimise import PULLED, SAFE_HALVINGS, SAFE_STEP, SHUNNED, Settings, TrialRow, _Search, pareto
from tuning.search.trial_bench import OBJECTIVES, Tried

RULE = np.array([[1000, 200, 800, 100, 50], [1000, 200, 400, 50, 25]] * 2)
COLUMNS = np.array([2, 3, 4])


def search_of(*, shared=False, safe=True, caution=1, **settings):
    """A search of two machines of two axes, whose trials are what a test says."""
    made = _Search.__new__(_Search)
    made.rows, made.notes, made._axes = [], [""] * 2, 2
    made._columns, made._highest = COLUMNS, np.array([32767, 32767, 32767])
    made._settings = Settings(**({"sampler": "random", "trials": 4, "safe": safe} | settings))
    made._bench = SimpleNamespace(
        rule=RULE.copy(), safe=RULE // 2, incumbent=RULE // 2, num_machines=2,
        method=SimpleNamespace(caution=caution, measures_current=caution > 0),
    )  # fmt: skip
    made._members = [np.arange(2)] if shared else [np.array([0]), np.array([1])]
    count = len(made._members)
    made._proved, made._refuted = [[] for _ in range(count)], [[] for _ in range(count)]
    made._fragile, made._least, made._halted = [set() for _ in range(count)], np.full(2, np.inf), [False] * count
    made._proposers = [
        SimpleNamespace(told=0, tell=lambda values, facts, k=k: told.append((k, values, facts))) for k in range(count)
    ]
    made.told = told = []
    return made


def row(cost, *, search=0, number=0, aborted=False, gains=None, objectives=(0.0, 0.0, 0.0)):
    return TrialRow(search, number, RULE[:2] if gains is None else gains, cost, objectives, aborted)


# --- points -----------------------------------------------------------------------------------------------------------
def test_a_point_is_the_logarithm_of_gains_over_the_rules_for_all_axes_of_a_machine():
    search = search_of()
    np.testing.assert_allclose(search._points(RULE), 0.0)
    np.testing.assert_allclose(search._points(2 * RULE), math.log(2.0))
    found = search._gains(1, np.log([2.0, 0.5, 1.0]))
    assert found.tolist() == [[1000, 200, 1600, 50, 50], [1000, 200, 800, 25, 25]]
    assert search._gains(0, np.log([1e9, 1e-9, 1.0]))[:, 2:4].tolist() == [[32767, 1]] * 2
    assert [search._axes_of(k) for k in (0, 1)] == [slice(0, 2), slice(2, 4)]
    assert search._bench.rule.tolist() == RULE.tolist()


# --- how far a safe search goes ---------------------------------------------------------------------------------------
def test_a_search_that_is_not_safe_goes_where_it_wants():
    point = np.array([9.0, 9.0, 9.0])
    assert search_of(safe=False)._held_back(0, point) is point


def test_a_safe_search_goes_a_step_from_what_was_proved():
    search = search_of()
    search._proved[0] = [np.zeros(3), np.array([1.0, 1.0, 1.0])]
    near = np.array([0.1, -0.1, 0.0])
    np.testing.assert_allclose(search._held_back(0, near), near)
    found = search._held_back(0, np.array([9.0, 1.2, -2.0]))
    np.testing.assert_allclose(found, [1.0 + SAFE_STEP, min(1.2, 1.0 + SAFE_STEP), 1.0 - SAFE_STEP])


@pytest.mark.parametrize("caution", [1, -1])
def test_a_safe_search_goes_not_beyond_what_was_stopped_nor_near_it(caution):
    """Higher gains than those that oscillated, or lower currents than those that lost steps."""
    search = search_of(caution=caution)
    search._proved[0] = [np.zeros(3)]
    search._refuted[0] = [caution * np.full(3, 0.75 * SAFE_STEP)]
    away = -caution * np.full(3, SAFE_STEP)
    np.testing.assert_allclose(search._held_back(0, away), away)
    towards = caution * np.full(3, SAFE_STEP)
    np.testing.assert_allclose(search._held_back(0, towards), towards / 4.0)  # half would be half a step from it
    search._refuted[0] = [np.zeros(3), *(towards / 2**k for k in range(SAFE_HALVINGS))]
    np.testing.assert_allclose(search._held_back(0, towards), 0.0)


# --- what is kept -----------------------------------------------------------------------------------------------------
def test_what_is_better_than_all_before_and_was_not_stopped_is_gone_back_to():
    search = search_of()
    point, better = np.zeros(3), RULE[:2] + 7
    search._take(0, point, row(2.0))
    search._take(0, point, row(3.0, gains=RULE[:2] + 1))
    search._take(0, point, row(2.0, gains=RULE[:2] + 2))  # as good is not better
    search._take(0, point, row(0.5, gains=RULE[:2] + 3, aborted=True))
    assert search._bench.incumbent[:2].tolist() == RULE[:2].tolist() and search._least.tolist() == [2.0, np.inf]
    search._take(0, point, row(1.0, gains=better))
    assert search._bench.incumbent[:2].tolist() == better.tolist()
    assert search._bench.incumbent[2:].tolist() == (RULE[2:] // 2).tolist()
    assert (len(search._proved[0]), len(search._refuted[0]), len(search.rows)) == (4, 1, 5)


def tried(*, cost=(1.0, 2.0), aborted=(False, False), fragile=(False, False), causes=("", "")):
    return Tried(np.array(cost), np.arange(6.0).reshape(2, 3), np.array(aborted), np.array(fragile), np.array(causes))


def test_gains_that_could_not_end_an_oscillation_are_dropped_for_those_before_them():
    search = search_of()
    first, fragile = RULE[:2] + 1, RULE[:2] + 2
    search._take(0, np.zeros(3), row(2.0, gains=first))
    search._take(0, np.zeros(3), row(3.0, gains=RULE[:2] + 3))
    search._take(0, np.zeros(3), row(1.0, gains=fragile))
    search._drop_fragile(tried())
    assert search._bench.incumbent[:2].tolist() == fragile.tolist() and search.notes == ["", ""]
    search._drop_fragile(tried(fragile=(True, False)))
    assert search._bench.incumbent[:2].tolist() == first.tolist() and search._least[0] == 2.0
    assert "were not kept" in search.notes[0] and search.notes[1] == ""
    search._drop_fragile(tried(fragile=(True, False)))
    search._drop_fragile(tried(fragile=(True, False)))
    assert search._bench.incumbent[:2].tolist() == (RULE[:2] // 2).tolist() and search._least[0] == np.inf
    assert [one.fragile for one in search.judged()] == [True, True, True]
    assert search._bench.incumbent[2:].tolist() == (RULE[2:] // 2).tolist()


@pytest.mark.parametrize(("safe", "aborted", "shunned"), [(True, True, 1), (True, False, 0), (False, True, 0)])
def test_a_sampler_is_told_what_was_tried_and_how_far_it_was_held_back(safe, aborted, shunned):
    search = search_of(safe=safe)
    search._proposers[0].told = 5
    point, own = np.array([1.0, 0.0, 0.0]), np.array([0.5, 0.0, 0.0])
    search._tell(0, [point], [own], tried(aborted=(aborted, False), causes=("undervoltage (3220h)", "")), RULE)
    (k, values, facts) = search.told[0]
    pulled = PULLED * 0.5 + SHUNNED * shunned
    assert k == 0 and values == [[pytest.approx(1.0 + pulled)]]
    assert facts[0]["point"] == own.tolist() and facts[0]["number"] == 5
    assert facts[0]["cause"] == ("undervoltage (3220h)" if aborted else "")
    assert search.rows[0].objectives == (0.0, 1.0, 2.0) and search.rows[0].gains.tolist() == RULE[:2].tolist()


# --- what is found ----------------------------------------------------------------------------------------------------
def test_the_best_is_what_was_not_stopped_or_the_start():
    search = search_of()
    gains, cost = search.best()
    assert gains.tolist() == (RULE // 2).tolist() and np.isnan(cost).all()
    search.rows = [
        row(1.0, aborted=True),
        row(3.0, gains=RULE[:2] + 1),
        row(2.0, gains=RULE[:2] + 2),
        row(0.1, search=1, aborted=True),
    ]
    gains, cost = search.best()
    assert gains.tolist() == [*(RULE[:2] + 2).tolist(), *(RULE[2:] // 2).tolist()]
    assert cost[0] == 2.0 and np.isnan(cost[1]) and search.notes == ["", ""]


def test_of_a_search_that_is_not_safe_and_was_always_stopped_the_least_cost_counts_and_is_told():
    search = search_of(safe=False)
    search.rows = [row(3.0, aborted=True, gains=RULE[:2] + 1), row(2.0, aborted=True, gains=RULE[:2] + 2)]
    gains, cost = search.best()
    assert gains[:2].tolist() == (RULE[:2] + 2).tolist() and cost[0] == 2.0
    assert gains[2:].tolist() == RULE[2:].tolist()
    assert search.notes == ["every trial was stopped; these are the gains of least cost", ""]


def test_a_shared_search_has_one_best_for_all_its_machines():
    search = search_of(shared=True)
    search.rows = [row(2.0, gains=RULE[:2] + 2)]
    gains, cost = search.best()
    assert gains.tolist() == [*(RULE[:2] + 2).tolist()] * 2 and cost.tolist() == [2.0, 2.0]


def test_the_share_that_is_done_is_that_of_the_slowest_that_goes_on():
    search = search_of()
    search._proposers[0].told, search._proposers[1].told = 1, 3
    assert search.share() == 0.25
    search._halted[0] = True
    assert search.share() == 0.75
    search._halted[1] = True
    assert search.share() == 1.0


def test_no_other_trial_is_better_in_everything_than_those_of_the_front():
    names = OBJECTIVES[:2]
    rows = [
        row(0.0, number=k, objectives=(*pair, 0.0))
        for k, pair in enumerate([(1, 5), (2, 4), (2, 5), (3, 3), (3, 3), (4, 3), (0.5, 9)])
    ]
    assert [one.number for one in pareto(rows, names)] == [6, 0, 1, 3, 4]


# --- a safe start -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("stopped", "tries", "halted"), [(0, 1, False), (2, 3, False), (99, None, True)])
def test_a_safe_search_begins_with_gains_that_are_not_stopped_or_not_at_all(stopped, tries, halted):
    search, points = search_of(), []
    search._members, search._proposers = [np.array([0])], [SimpleNamespace(ask=lambda count: None)]
    search._proved, search._refuted, search._halted = [[]], [[]], [False]
    search._start = np.zeros((1, 3))
    search._run = lambda held: (points.append(held[0][0].copy()), None)

    def tell(k, asked, held, found, gains):
        (search._refuted if len(points) <= stopped else search._proved)[k].append(held[0])

    search._tell = tell
    search._prove()
    assert search._halted == [halted] and bool(search.notes[0]) == halted
    if tries is not None:
        assert len(points) == tries
    np.testing.assert_allclose([point[0] for point in points], [-k * math.log(2.0) for k in range(len(points))])
