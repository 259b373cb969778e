"""The rules of a search without a machine: points and gains, how far a safe one goes, what is kept and what is told."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from drive_env.devices import find_device
from drive_env.motors import find_motor
from tuning.search import optimise as module
from tuning.search.optimise import Optimised, Settings, TrialRow, _row, _Search, optimise, pareto
from tuning.search.trial_bench import OBJECTIVES, Tried
from tuning.target import Target

SAFE_STEP, SAFE_HALVINGS = 0.4, 3  # of a gain's logarithm; of a step that would lead to what was stopped
PULLED, SHUNNED = 0.2, 1.0  # what a point costs for each unit that it was held back by, and a stop besides

RULE = np.array([[1000, 200, 800, 100, 50], [1000, 200, 400, 50, 25]] * 2)
COLUMNS = np.array([2, 3, 4])


def search_of(*, shared=False, safe=True, caution=1, **settings):
    """A search of two machines of two axes, whose trials are what a test says."""
    made = _Search.__new__(_Search)
    made.rows, made.notes, made._axes = [], [""] * 2, 2
    made._columns, made._known = COLUMNS, None
    made._settings = Settings(**({"sampler": "random", "trials": 4, "safe": safe} | settings))
    made._bench = SimpleNamespace(
        rule=RULE.copy(), safe=RULE // 2, incumbent=RULE // 2, num_machines=2, highest=np.full(5, 32767),
        target=SimpleNamespace(device=find_device("tmcm1636")),
        method=SimpleNamespace(caution=caution, measures_current=caution > 0),
    )  # fmt: skip
    made._members = [np.arange(2)] if shared else [np.array([0]), np.array([1])]
    count = len(made._members)
    made._proved, made._refuted = [[] for _ in range(count)], [[] for _ in range(count)]
    made._fragile, made._least, made._halted = [set() for _ in range(count)], np.full(2, np.inf), [False] * count
    made.untried = [0] * count
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
    search._refuted[0] = [caution * np.full(3, 0.26)]  # an eighth of a step would do: it is not tried
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
    search._tell(
        0, [point], [own], [math.inf], (tried(aborted=(aborted, False), causes=("undervoltage (3220h)", "")), RULE)
    )
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
    search._run = lambda held, slack: (points.append(held[0][0].copy()), None)

    def tell(k, asked, held, slack, run):
        (search._refuted if len(points) <= stopped else search._proved)[k].append(held[0])

    search._tell = tell
    search._prove()
    assert search._halted == [halted] and bool(search.notes[0]) == halted
    if tries is not None:
        assert len(points) == tries
    np.testing.assert_allclose([point[0] for point in points], [-k * math.log(2.0) for k in range(len(points))])


@pytest.mark.parametrize(
    ("caution", "told"),
    [
        (1, "the axis oscillated with the safe gains, and with 1/4 of them: no safe start"),
        (-1, "the axis was stopped even at its motor's rated current: no safe start"),
    ],
)
def test_where_no_safe_start_is_found_it_is_said_why(caution, told):
    """Gains are halved, currents doubled; a search that has proved gains in its journal starts there."""
    search, points = search_of(caution=caution), []
    search._proved[1] = [np.zeros(3)]
    asked = []
    for proposer in search._proposers:
        proposer.ask = asked.append
    search._start = np.zeros((2, 3))
    search._run = lambda held, slack: (points.append({k: at[0].tolist() for k, at in held.items()}), None)
    search._tell = lambda k, points, held, slack, run: search._refuted[k].append(held[0])
    search._prove()
    assert points == [{0: [pytest.approx(-caution * k * math.log(2.0))] * 3} for k in range(3)]
    assert asked == [1, 1, 1] and search._halted == [True, False] and search.notes == [told, ""]


def test_copies_of_a_machine_start_where_the_first_of_them_does():
    search, points = search_of(shared=True), []
    search._proposers = [SimpleNamespace(ask=lambda count: None)]
    search._start = np.array([[-1.0] * 3, [-2.0] * 3])
    search._run = lambda held, slack: (points.append(held[0][0].tolist()), None)
    search._tell = lambda k, asked, held, slack, run: search._proved[k].append(held[0])
    search._prove()
    assert points == [[-1.0] * 3]


# --- a generation -----------------------------------------------------------------------------------------------------
class Proposer:
    """A sampler that proposes what a test has for it."""

    def __init__(self, *points, told=0):
        self.told, self.points, self.asked = told, list(points), []

    def ask(self, count):
        self.asked.append(count)
        found, self.points = self.points[:count], self.points[count:]
        return found

    def tell(self, values, facts):
        self.told += len(values)


def generations(search, monkeypatch=None):
    """Have a search run generations; return the gains of each, and where they were tried."""
    ran = []

    def run(gains, where):
        ran.append((gains.tolist(), where.tolist()))
        return tried()

    search._trials = SimpleNamespace(run=run)
    return ran


def test_a_generation_of_machines_of_their_own_is_one_trial_of_each():
    search = search_of(safe=False, trials=2)
    search._proposers = [Proposer(np.zeros(3), np.log([2.0, 1.0, 1.0])), Proposer(np.log([0.5, 1.0, 1.0]), told=1)]
    ran = generations(search)
    assert search.generation() and search.share() == 0.5
    assert ran[0][1] == [True, True]
    assert [row[2] for row in ran[0][0]] == [800, 400, 400, 200]
    assert search.generation() and ran[1][1] == [True, False]  # the second has made its two trials
    assert [row[2] for row in ran[1][0]][:2] == [1600, 800]
    assert ran[1][0][2:] == search._bench.incumbent[2:].tolist()
    assert not search.generation() and len(ran) == 2 and search.share() == 1.0
    assert [(row.search, row.number) for row in search.rows] == [(0, 0), (1, 1), (0, 1)]
    assert [proposer.asked for proposer in search._proposers] == [[1, 1], [1]]


def test_a_generation_of_copies_of_a_machine_fills_them_and_no_more_than_are_left():
    search = search_of(shared=True, safe=False, trials=3)
    search._proposers = [Proposer(np.zeros(3), np.log([2.0, 1.0, 1.0]), np.log([3.0, 1.0, 1.0]))]
    ran = generations(search)
    assert search.generation() and search.generation() and not search.generation()
    assert search._proposers[0].asked == [2, 1]
    assert [where for _, where in ran] == [[True, True], [True, False]]
    assert [row[2] for row in ran[0][0]] == [800, 400, 1600, 800]
    assert [row[2] for row in ran[1][0]][:2] == [2400, 1200]
    assert [(row.number, row.cost) for row in search.rows] == [(0, 1.0), (1, 2.0), (2, 1.0)]


def test_a_search_that_was_given_up_or_whose_sampler_has_nothing_left_tries_nothing():
    search = search_of(safe=False)
    search._proposers = [Proposer(np.zeros(3)), Proposer()]
    ran = generations(search)
    search._halted[0] = True
    assert not search.generation() and ran == []
    assert [proposer.asked for proposer in search._proposers] == [[], [1]]


def test_in_a_safe_generation_points_are_held_back_and_told_as_they_were_tried():
    search = search_of(trials=2)
    search._proposers = [Proposer(np.full(3, 5.0)), Proposer()]
    search._proved = [[np.zeros(3)], [np.zeros(3)]]
    ran = generations(search)
    assert search.generation()
    assert [row[2] for row in ran[0][0]][:2] == [round(800 * math.exp(0.4)), round(400 * math.exp(0.4))]
    np.testing.assert_allclose(search._proved[0][1], 0.4)


# --- settings ---------------------------------------------------------------------------------------------------------
def test_what_is_searched_by_default():
    made = Settings()
    assert (made.sampler, made.trials, made.objectives, made.gains) == ("tpe", 30, ("cost",), None)
    assert (made.width, made.safe, made.seed, made.journal) == (math.log(6.0), False, 0, None)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"trials": 1}, None),
        ({"trials": 0}, "trials must be 1 or more, not 0"),
        ({"width": math.log(32767)}, None),
        ({"width": math.log(32767) * 1.001}, "width must lie above 0 and up to 10.4, not 10.4076"),
        ({"width": 0.0}, "width must lie above 0 and up to 10.4, not 0"),
        ({"width": math.nan}, "not nan"),
        ({"objectives": ("speed", "speed")}, "give different ones of objective: .*, not speed, speed"),
        ({"objectives": ("cost", "speed")}, None),
        ({"objectives": ()}, "not none"),
        ({"objectives": ("beauty",)}, "no objective is named 'beauty'; there are cost, speed, robustness, current"),
        ({"sampler": "luck"}, "no sampler is named 'luck'; there are random, grid, tpe, cmaes, gp"),
        ({"sampler": ""}, "no sampler is named ''"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings, message):
    if message is None:
        Settings(**settings)
        return
    with pytest.raises(ValueError, match=message):
        Settings(**settings)


@pytest.mark.parametrize(
    ("aborted", "fragile", "accepted"), [(0, 0, True), (1, 0, False), (0, 1, False), (1, 1, False)]
)
def test_gains_could_be_kept_that_were_neither_stopped_nor_fragile(aborted, fragile, accepted):
    assert row(1.0, aborted=bool(aborted))._replace(fragile=bool(fragile)).accepted is accepted


def test_the_front_of_a_search_is_of_its_own_accepted_trials():
    rows = (
        row(0.0, search=1, objectives=(0.0, 0.0, 0.0)), row(0.0, objectives=(1.0, 1.0, 0.0), number=1),
        row(0.0, objectives=(0.5, 0.5, 0.0), number=2, aborted=True),
        row(0.0, objectives=(0.5, 0.5, 0.0), number=3)._replace(fragile=True),
        row(0.0, objectives=(2.0, 0.0, 0.0), number=4),
    )  # fmt: skip
    found = Optimised(RULE, RULE, np.zeros(2), rows, 1.0, RULE, RULE, ("", ""), 0.01, 0, np.zeros((4, 2, 3)))
    assert [one.number for one in found.front(OBJECTIVES[:2])] == [1, 4]
    assert [one.search for one in found.front(OBJECTIVES[:2], 1)] == [1]
    assert found.front(OBJECTIVES[:2], 2) == []


def test_a_search_of_several_objectives_ends_with_the_cheapest_of_its_front():
    search = search_of(objectives=("speed", "robustness"))
    search.rows = [
        row(1.0, gains=RULE[:2] + 1, objectives=(9.0, 9.0, 0.0)),  # the cheapest, and beaten by both others
        row(3.0, gains=RULE[:2] + 2, objectives=(1.0, 2.0, 0.0)),
        row(2.0, gains=RULE[:2] + 3, objectives=(2.0, 1.0, 0.0)),
    ]
    gains, cost = search.best()
    assert gains[:2].tolist() == (RULE[:2] + 3).tolist() and cost[0] == 2.0


def test_objectives_are_told_in_their_order_each_with_what_it_was_held_back_by():
    search = search_of(objectives=("current", "cost"))
    search._proposers[1].told = 0
    search._tell(1, [np.array([0.0, -1.0, 0.0])], [np.array([0.0, -0.5, 0.1])], [math.inf], (tried(), RULE))
    (k, values, facts) = search.told[0]
    assert k == 1 and values == [[pytest.approx(5.0 + 0.1), pytest.approx(2.0 + 0.1)]]
    assert facts[0]["gains"] == RULE[2:].tolist() and facts[0]["cost"] == 2.0 and facts[0]["search"] == 1


# --- a search from its start ------------------------------------------------------------------------------------------
@pytest.fixture
def started(monkeypatch):
    """Start a search of two machines of two axes; return it, and what its samplers were made of."""
    made = []

    def start(history=(), *, shared=False, **settings):
        def new_proposer(sampler, low, high, **more):
            made.append((sampler, low.tolist(), high.tolist(), more))
            return SimpleNamespace(told=0, history=lambda: history if more["study"].name == "machine 1" else ())

        monkeypatch.setattr(module, "new_proposer", new_proposer)
        bench = SimpleNamespace(
            num_machines=2, target=SimpleNamespace(axes_per_machine=2, device=find_device("tmcm1636")),
            rule=RULE.copy(), safe=RULE // 4, incumbent=RULE // 4, highest=np.array([9, 8, 7, 6, 5]),
            method=SimpleNamespace(caution=1),
        )  # fmt: skip
        return _Search(bench, Settings(**settings), COLUMNS, shared, bench), made

    return start


def test_every_machine_has_a_sampler_and_a_seed_of_its_own(started):
    search, made = started(sampler="random", seed=5, trials=7, objectives=("speed", "current"))
    width = math.log(6.0)
    assert [(sampler, low, high) for sampler, low, high, _ in made] == [
        ("random", [-width] * 3, [pytest.approx(width)] * 3)
    ] * 2
    assert [more["seed"] for *_, more in made] == [5, 5 + 7919]
    for k, (*_, more) in enumerate(made):
        assert (more["objectives"], more["trials"], more["generation"], more["journal"]) == (2, 7, 1, None)
        assert more["study"].name == f"machine {k}" and [point.tolist() for point in more["first"]] == [[0.0] * 3]
    assert search._gains(0, np.full(3, 9.0))[0, 2:].tolist() == [7, 6, 5], "as high as the bench allows"
    assert search.notes == ["", ""] and search._halted == [False, False]


def test_copies_of_a_machine_share_one_sampler(started):
    _, made = started(shared=True, sampler="random")
    assert [more["generation"] for *_, more in made] == [2]


def test_a_safe_search_reaches_down_to_where_it_starts(started, monkeypatch):
    """Safe gains are a fourth of the rule's, and the search is to reach half of them at least."""
    proved = []
    monkeypatch.setattr(_Search, "_prove", lambda self: proved.append(self))
    search, made = started(safe=True, width=math.log(2.0))
    np.testing.assert_allclose(made[0][1], np.log([0.25, 0.245, 0.24]), rtol=0.02)
    np.testing.assert_allclose(made[0][2], math.log(2.0))
    np.testing.assert_allclose(made[0][3]["first"], search._start[:1])
    assert proved == [search]
    started()
    assert len(proved) == 1


def test_what_a_journal_remembers_is_taken_up_by_its_search(started):
    facts = [
        {"point": [0.1, 0.2, 0.3], "number": 4, "gains": RULE[2:].tolist(), "cost": 1.5, "objectives": [1, 2, 3],
         "aborted": False},
        {"point": [0.4, 0.5, 0.6], "number": 5, "gains": RULE[2:].tolist(), "cost": 0.5, "objectives": [1, 2, 3],
         "aborted": True, "cause": "stall"},
    ]  # fmt: skip
    search, _ = started(facts)
    assert [(one.search, one.number, one.cost, one.aborted, one.cause) for one in search.rows] == [
        (1, 4, 1.5, False, ""), (1, 5, 0.5, True, "stall")
    ]  # fmt: skip
    assert search.rows[0].objectives == (1, 2, 3) and search.rows[0].gains.tolist() == RULE[2:].tolist()
    assert [len(points) for points in (*search._proved, *search._refuted)] == [0, 1, 0, 1]
    assert search._least.tolist() == [np.inf, 1.5]
    assert search._bench.incumbent[2:].tolist() == RULE[2:].tolist()
    assert _row(3, facts[0]).search == 3 and _row(3, facts[0]).fragile is False


@pytest.mark.parametrize(("anew", "journal"), [(False, None), (True, "kept.log"), (False, "kept.log")])
def test_a_search_is_continued_from_its_log_only_where_that_repeats_it(anew, journal):
    with pytest.raises(ValueError, match="only if every trial starts from rest, and if it has no journal"):
        optimise(None, Settings(journal=journal), anew=anew, log=object())


# --- all of it, on a bench that a test plays --------------------------------------------------------------------------
class PlayedBench:
    """A bench of two machines of one axis, where a velocity P of 1.5 times the rule's costs least."""

    made: ClassVar[list] = []
    trials = None

    def __init__(self, target, *, anew, gains):
        self.made.append(self)
        self.anew, self.gains, self.target, self.num_machines = anew, gains, target, 2
        self.rule = np.array([[100, 100, 1000, 100, 100]] * 2)
        self.safe, self.incumbent, self.highest = self.rule // 3, self.rule // 3, np.full(5, 32767)
        self.method = SimpleNamespace(caution=1)
        self.moves, self.aborts, self.t_0 = np.array([3, 4]), np.array([0, 1]), 0.01
        self.identified, self.left, self.ran = 0, None, []

    def identify(self):
        self.identified += 1

    def run(self, gains, where):
        self.ran.append(where.tolist())
        self.target.drives.advance(0.5)
        off = np.abs(np.log(gains[:, 2] / 1500.0))
        no = np.zeros(2, bool)
        return Tried(off, np.stack([off] * 3, axis=1), no, no, np.array(["", ""]))

    def leave(self, gains):
        self.left = gains.copy()


@pytest.fixture
def played(monkeypatch):
    drives = SimpleNamespace(advance=lambda seconds: None, num_axes=2, time_waits=True)
    target = Target(
        drives, find_device("tmcm1636"), find_motor("qbl4208"), np.full(2, 24.0), np.full(2, -np.inf),
        np.full(2, np.inf), 10.0, 1.0,
    )  # fmt: skip
    monkeypatch.setattr(module, "TrialBench", PlayedBench)
    PlayedBench.made.clear()
    return target


def test_a_search_identifies_tries_generation_by_generation_and_leaves_the_best(played):
    shares = []
    found = optimise(played, Settings(sampler="random", trials=5, seed=1), progress=shares.append)
    (bench,) = PlayedBench.made
    assert (bench.identified, bench.anew, bench.gains) == (1, False, ("velocity_p", "velocity_i", "position_p"))
    assert shares == [0.2, 0.4, 0.6, 0.8, 1.0] and bench.ran == [[True, True]] * 5
    assert [(row.search, row.number) for row in found.rows] == [(k, n) for n in range(5) for k in (0, 1)]
    for k in (0, 1):
        rows = [row for row in found.rows if row.search == k]
        assert rows[0].gains[0].tolist() == bench.rule[0].tolist() and found.cost[k] == min(row.cost for row in rows)
        assert found.gains[k].tolist() == min(rows, key=lambda row: row.cost).gains[0].tolist()
    assert bench.left.tolist() == found.gains.tolist() and found.rule is bench.rule
    assert (found.drive_seconds, found.moves.tolist(), found.aborts.tolist()) == (2.5, [3, 4], [0, 1])
    assert (found.notes, found.t_0) == (("", ""), 0.01)


def test_a_search_of_copies_of_one_machine_and_of_the_gains_that_were_named(played):
    found = optimise(played, Settings(sampler="random", trials=5, gains=("velocity_p",)), shared=True, anew=True)
    (bench,) = PlayedBench.made
    assert (bench.anew, bench.gains) == (True, ("velocity_p",))
    assert bench.ran == [[True, True], [True, True], [True, False]]
    assert {row.search for row in found.rows} == {0} and [row.number for row in found.rows] == list(range(5))
    assert all(np.delete(row.gains[0], 2).tolist() == [100] * 4 for row in found.rows)
    assert found.cost[0] == found.cost[1] and found.gains[0].tolist() == found.gains[1].tolist()


def test_a_search_with_a_log_tries_by_it(played, monkeypatch):
    logged = []

    def logs(bench, clock, log):
        logged.append((log, clock.seconds))
        return bench

    monkeypatch.setattr(module, "LoggedTrials", logs)
    optimise(played, Settings(sampler="random", trials=1), anew=True, log="log")
    optimise(played, Settings(sampler="random", trials=1))
    assert logged == [("log", 0.0)]
    with pytest.raises(ValueError, match="no gain is named 'velocity_d'"):
        optimise(played, Settings(gains=("velocity_d",)))
    assert len(PlayedBench.made) == 2
