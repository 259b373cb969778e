"""Automatic tuning ends with the better of its own and the baseline rule's gains, by the drives and by the twins."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from auto_stages import basis, recorded

from drive_env.devices import find_device
from drive_env.loops.true_plant import true_plant
from drive_env.safety.envelope import SafetyError
from tuning.auto import choice, loop_margins
from tuning.auto import moves as auto_moves
from tuning.auto.bench import AutoBench, Journal
from tuning.auto.calmer_gains import calmer
from tuning.auto.choice import PeerFigures, choose_set, keep_the_better, try_rule, try_what_changed
from tuning.auto.measured_margins import SENSITIVITY, SOUGHT
from tuning.auto.moves import stand
from tuning.auto.proving import Proof, Shown
from tuning.auto.stages import IdentifiedAxes, RuleTried
from tuning.auto.trials import faster
from tuning.identify.quick_identification import identify_briefly
from tuning.target import emulated

RULE, OWN = [4000, 1500, 700, 1800, 700], [4000, 1000, 2000, 4800, 2000]
NAN = float("nan")


# --- what is chosen by figures ------------------------------------------------------------------------------------
@pytest.mark.parametrize(("drive", "twin", "chosen"), [
    ((2.0, 1.0), (2.0, 1.0), 1),  # better by both
    ((2.0, 1.0), (1.0, 2.0), 0),  # the twins have variants that no drive has
    ((1.0, 2.0), (2.0, 1.0), 0),  # the drive knows more than its twins
    ((1.0, 1.0), (2.0, 1.0), 0),  # no better is not better
    ((1.0, 0.91), (2.0, 1.0), 0),  # nor is what may be so by chance
    ((1.0, 0.89), (2.0, 1.0), 1),
    ((2.0, 1.0), (NAN, NAN), 1),  # no twin that could be trusted: the drive decides
    ((1.0, 2.0), (NAN, NAN), 0),
    ((2.0, NAN), (2.0, 1.0), 0),  # its trial was not made, or failed
])  # fmt: skip
def test_what_was_found_is_kept_where_it_is_better_on_the_drive_and_on_the_twins(drive, twin, chosen):
    costs = np.array(drive)[:, None]
    found = choose_set(costs, PeerFigures(costs, np.array(twin)[:, None]), np.ones(1, bool), 1)
    assert found.tolist() == [chosen]


@pytest.mark.parametrize(("rule", "own", "mixed", "twin_own", "chosen"), [
    ((2.0, 2.0), (1.0, 5.0), (1.0, 1.7), (1.0, 1.0), 2),  # one axis is worse with its own: the others keep theirs
    ((2.0, 2.0), (1.0, 5.0), (1.0, 2.5), (1.0, 1.0), 0),  # what is mixed is judged as a whole, and may be worse
    ((2.0, 2.0), (1.0, 1.2), (1.0, 1.9), (1.0, 1.0), 1),
    ((2.0, 1.0), (1.5, 1.4), (1.7, 1.0), (1.0, 1.0), 1),  # a machine is as good as its worst axis
    ((2.0, 1.0), (1.5, 1.4), (1.7, 1.0), (9.0, 1.0), 2),  # by the twins the axis 0 is not
    ((2.0, 2.0), (1.0, 1.0), (2.0, 2.0), (np.inf, np.inf), 0),  # linked axes, of which no twin tells
])  # fmt: skip
def test_a_machine_of_several_axes_is_judged_as_a_whole(rule, own, mixed, twin_own, chosen):
    costs = np.array([rule, own, mixed])
    figures = PeerFigures(costs[:2], np.array([(2.0, 2.0), twin_own]))
    assert choose_set(costs, figures, np.ones(2, bool), 2).tolist() == [chosen, chosen]


# --- the stages ---------------------------------------------------------------------------------------------------
class Ground:
    """A proving ground on which J and the swing at rest of an axis follow from the gains of its machine."""

    def __init__(self, cost, swing=lambda gains: np.zeros(len(gains))):
        self.cost, self.swing, self.tried, self.moved = cost, swing, [], []
        self.asks_heavier = True

    def run(self, gains, where, heavier=False):
        assert heavier or not self.asks_heavier, "what is compared is tried as with a heavier load, too"
        self.tried.append(gains.tolist())
        zero, no = np.zeros(len(gains)), np.zeros(len(gains), bool)
        return Proof(self.cost(gains), no, no, ("",) * len(gains), zero, zero, zero)

    def show(self, gains, where):
        self.moved.append(gains.tolist())
        return shown(self.cost(gains), self.swing(gains), where)


def shown(cost, swing, where):
    row = np.array([cost])
    return Shown(np.zeros(1), row, row, row, where, ("",) * len(cost), np.asarray(cost), swing, np.zeros(len(cost)))


def bench_on(ground, axes):
    """Return a bench of one machine; its time costs nothing."""
    drives = SimpleNamespace(time_waits=True, machine=None)
    target = SimpleNamespace(num_axes=axes, axes_per_machine=axes, drives=drives, together=lambda where: where,
                             device=find_device("tmcm1636"), linked=False)  # fmt: skip
    bench = AutoBench.__new__(AutoBench)
    bench.target, bench.ground, bench.spent = target, ground, np.zeros(axes)
    bench.journals = tuple(Journal() for _ in range(axes))
    bench.response_time, bench._budget, bench._clock = 2.3, 12.0, SimpleNamespace(seconds=0.0)
    bench.faults = dict
    return bench


def of(own, ground, bench, **known):
    n = len(own)
    cost = ground.cost(np.array(own))
    made = shown(cost, ground.swing(np.array(own)), np.ones(n, bool))
    return recorded(own, shown=made, cost=np.ones(n), proof=cost, unseen=np.ones(n, bool), **known)


def twins(monkeypatch, rule, own):
    """Have the twins give these robust costs to the rule's gains and to all others."""

    def score(bench, basis, axes, sets):
        return np.where((sets == RULE).all(axis=-1), rule, own)

    monkeypatch.setattr(choice, "cost_on_twins", score)


@pytest.mark.parametrize(("rule", "own", "twin_rule", "twin_own", "kept"), [
    (2.0, 1.0, 2.0, 1.0, OWN), (1.0, 2.0, 2.0, 1.0, RULE), (2.0, 1.0, 1.0, 2.0, RULE),
])  # fmt: skip
def test_the_rule_makes_the_same_trial_and_what_is_worse_than_it_by_either_gives_way(
    rule, own, twin_rule, twin_own, kept, monkeypatch
):
    twins(monkeypatch, twin_rule, twin_own)
    ground = Ground(lambda gains: np.where((gains == RULE).all(axis=1), rule, own))
    bench, start = bench_on(ground, 1), basis([RULE])
    found = try_rule(bench, start, of([OWN], ground, None))
    assert ground.tried == ground.moved == [[RULE]]
    found = keep_the_better(bench, start, found, bench.target)
    assert ground.tried == [[RULE], [OWN]]
    assert found.gains.tolist() == [kept]
    assert bool(bench.journals[0].notes) == (kept == RULE)
    assert found.shown.cost.tolist() == [rule if kept == RULE else own], "the move on record is that of the gains"
    assert found.proof.tolist() == [rule if kept == RULE else own] and found.won.tolist() == [kept == OWN]
    assert not any("linked" in note for note in bench.journals[0].notes)


def test_a_rule_that_shakes_at_rest_is_no_peer(monkeypatch):
    """A swing of 6 % is refused with any gains, and none calmer are looked for on machines of several axes."""
    twins(monkeypatch, 1.0, 2.0)
    ground = Ground(lambda gains: np.ones(2), lambda gains: np.where((gains == RULE).all(axis=1), 0.06, 0.0))
    bench, start = bench_on(ground, 2), basis([RULE, RULE])
    found = try_rule(bench, start, of([OWN, OWN], ground, None))
    assert not found.rule.passed.any()
    assert keep_the_better(bench, start, found, bench.target).gains.tolist() == [OWN, OWN]


@pytest.mark.parametrize(("stands", "tries"), [(650, [700, 650]), (600, [700, 650, 600]), (500, [700, 650, 600])])
def test_a_rule_that_shakes_at_rest_is_lowered_until_it_stands_and_compared_then(stands, tries, monkeypatch):
    """As the gains found are: what else would tell that these are better? Twice at the most."""
    monkeypatch.setattr(choice, "cost_on_twins", lambda bench, basis, axes, sets: np.array([[1.0, 2.0]]))
    told = []

    def lower(bench, basis, recorded, k, swing, allowed, near):
        assert allowed == pytest.approx(0.045) and len(near) == 0
        told.append(swing)
        return recorded.gains[k] - [0, 0, 50, 0, 0]

    monkeypatch.setattr(choice, "standing", lower)
    ground = Ground(lambda gains: np.ones(1), lambda gains: np.where(gains[:, 2] > stands, 0.06, 0.0))
    bench, start = bench_on(ground, 1), basis([RULE])
    found = try_rule(bench, start, of([[4000, 1000, 400, 4800, 2000]], ground, None))
    assert [row[0][2] for row in ground.tried] == [row[0][2] for row in ground.moved] == tries
    assert found.rule.passed.tolist() == [stands != 500] and told == [0.06] * (len(tries) - 1)
    kept = keep_the_better(bench, start, found, bench.target)
    assert kept.gains[0, 2] == (400 if stands == 500 else stands)


def test_gains_that_were_changed_since_their_trial_make_it_again(monkeypatch):
    """A trial of faster gains says nothing of those that were lowered afterwards."""
    twins(monkeypatch, 2.0, 1.0)
    lowered = [4000, 1000, 1000, 2400, 1000]
    costs = {tuple(RULE): 2.0, tuple(OWN): 1.0, tuple(lowered): 3.0}
    ground = Ground(lambda gains: np.array([costs[tuple(row)] for row in gains.tolist()]))
    bench, start = bench_on(ground, 1), basis([RULE])
    found = try_rule(bench, start, of([OWN], ground, None).with_gains(0, np.array(lowered)))
    found = keep_the_better(bench, start, found, bench.target)
    assert [lowered] in ground.tried and found.gains.tolist() == [RULE]


def test_on_several_axes_the_rule_is_tried_on_all_and_what_is_mixed_as_a_whole(monkeypatch):
    """Axis 1 is worse with its own gains; axis 0 is better, and stays so beside the rule's on axis 1."""
    twins(monkeypatch, 2.0, 1.0)
    costs = {"RR": (2.0, 2.0), "OO": (1.0, 5.0), "OR": (1.1, 1.7)}

    def cost(gains):
        return np.array(costs["".join("R" if row == RULE else "O" for row in gains.tolist())])

    ground = Ground(cost)
    bench, start = bench_on(ground, 2), basis([RULE, RULE])
    found = keep_the_better(bench, start, try_rule(bench, start, of([OWN, OWN], ground, None)), bench.target)
    assert ground.tried == [[RULE, RULE], [OWN, OWN], [OWN, RULE]]
    assert found.gains.tolist() == [OWN, RULE] and found.proof.tolist() == [1.1, 1.7]
    assert [bool(journal.notes) for journal in bench.journals] == [False, True], "whose gains are the rule's hears why"
    costs["OR"] = (1.1, 2.5)  # which no axis by itself would say
    found = keep_the_better(bench, start, try_rule(bench, start, of([OWN, OWN], ground, None)), bench.target)
    assert found.gains.tolist() == [RULE, RULE]


@pytest.mark.parametrize(("most", "tries", "passed"), [(700, [700], True), (500, [700, 560, 448], True),
                                                      (400, [700, 560, 448], False)])  # fmt: skip
def test_a_rule_that_fails_its_trial_is_lowered_by_a_fifth_at_a_time(most, tries, passed, monkeypatch):
    """What the identified inertia makes of it may be at its edge, where what is found is not to win by that alone."""
    twins(monkeypatch, 2.0, 1.0)
    ground = Refusing(most)
    bench, start = bench_on(ground, 1), basis([RULE])
    found = try_rule(bench, start, of([OWN], ground, None)).rule
    assert [row[0][2] for row in ground.tried] == tries
    assert found.passed.tolist() == [passed] and found.lowered.tolist() == [len(tries) > 1]
    assert found.gains[0].tolist() == faster(find_device("tmcm1636").gains, np.array(RULE), tries[-1] / 700).tolist()


def test_a_rule_that_the_envelope_stops_is_no_peer_and_what_was_found_stays(monkeypatch):
    class Stopped(Ground):
        def run(self, gains, where, heavier=False):
            raise SafetyError("axis 0 oscillates")

    ground = Stopped(lambda gains: np.ones(1))
    bench, start = bench_on(ground, 1), basis([RULE])
    found = try_rule(bench, start, of([OWN], ground, None))
    assert not found.rule.passed.any() and np.isnan(found.rule.cost).all()
    assert bench.journals[0].notes == [
        "the envelope stopped the move with the baseline rule's gains: axis 0 oscillates"
    ]
    assert keep_the_better(bench, start, found, bench.target).gains.tolist() == [OWN]


def test_of_linked_axes_what_was_found_is_never_better_and_the_reason_is_told(monkeypatch):
    monkeypatch.setattr(choice, "cost_on_twins", lambda *given: pytest.fail("twins"))
    ground = Ground(lambda gains: np.where((gains == RULE).all(axis=1), 3.0, 1.0))
    bench, start = bench_on(ground, 2), basis([RULE, RULE])
    bench.target.linked = True
    found = keep_the_better(bench, start, try_rule(bench, start, of([OWN, OWN], ground, None)), bench.target)
    assert found.gains.tolist() == [RULE, RULE]
    assert all(j.notes[0].endswith("how robust gains are on linked axes no digital twin tells") for j in bench.journals)


@pytest.mark.parametrize(("ms", "passed"), [(SENSITIVITY, True), (SENSITIVITY + 0.1, False)])
def test_a_rule_that_stays_too_near_to_instability_is_no_peer(ms, passed, monkeypatch):
    """Where no less P helps it is as near as it was, though it passes its trial and stands."""
    monkeypatch.setattr(choice, "not_beyond", lambda bench, basis, recorded, gains, k, limit: gains)
    monkeypatch.setattr(choice, "sensitivity", lambda target, basis, response, gains, k: ms)
    ground = Ground(lambda gains: np.ones(len(gains)))
    bench, start = bench_on(ground, 1), basis([RULE])
    seen = replace(of([OWN], ground, None), response=object(), unseen=np.zeros(1, bool))
    assert try_rule(bench, start, seen).rule.passed.tolist() == [passed]
    assert try_rule(bench, start, replace(seen, unseen=np.ones(1, bool))).rule.passed.tolist() == [True]


@pytest.mark.parametrize(("axes", "own", "limit"), [(1, 3.5, SENSITIVITY), (2, 2.0, SOUGHT), (2, 3.5, 3.5)])
def test_a_rule_that_is_too_near_to_instability_as_measured_is_lowered_before_it_is_tried(
    axes, own, limit, monkeypatch
):
    """Up to what is allowed of an axis alone on its machine; where axes take margin from each other less, as found."""
    asked = []

    def lower(bench, basis, recorded, gains, k, most):
        asked.append(most)
        return gains - [0, 0, 0, 0, 100]

    monkeypatch.setattr(choice, "not_beyond", lower)
    monkeypatch.setattr(
        choice, "sensitivity", lambda target, basis, response, gains, k: own if gains[2] == OWN[2] else 1.0
    )
    ground = Ground(lambda gains: np.ones(len(gains)))
    bench, start = bench_on(ground, axes), basis([RULE] * axes)
    seen = replace(of([OWN] * axes, ground, None), response=object(), unseen=np.zeros(axes, bool))
    found = try_rule(bench, start, seen).rule
    assert asked == [limit] * axes and ground.tried == [[[*RULE[:4], RULE[4] - 100]] * axes]
    assert found.passed.all() and found.title(0) == "the gains of the baseline rule, lowered,"


# --- what is claimed of the gains that are left ---------------------------------------------------------------------
class Failing(Ground):
    """A ground on which a trial fails, and moves do not."""

    def __init__(self, why):
        super().__init__(lambda gains: np.ones(len(gains)))
        self.why, self.asks_heavier = why, False

    def run(self, gains, where, heavier=False):
        return super().run(gains, where)._replace(reason=(self.why,) * len(gains))


@pytest.mark.parametrize(("why", "reservations"), [
    ("", []), ("it oscillated", ["the lowered gains fail their trial: it oscillated"]),
])  # fmt: skip
def test_gains_that_were_lowered_at_rest_make_their_trial_and_what_fails_it_is_no_plain_accept(why, reservations):
    """The certificate says that they made a move, its reversal and one with more velocity P: a move alone is less."""
    ground = Failing(why)
    bench, eased = bench_on(ground, 1), recorded([OWN], proof=np.ones(1)).with_gains(0, np.array(RULE))
    found = try_what_changed(bench, eased)
    assert ground.tried == [[RULE]] and bench.journals[0].reservations == reservations
    assert found.proven.tolist() == [RULE] and found.proof.tolist() == [np.inf if why else 1.0]
    again = try_what_changed(bench, found)
    assert len(ground.tried) == (2 if why else 1), "what has passed makes no other"
    assert again.gains.tolist() == [RULE]


@pytest.mark.parametrize("known", [{}, {"kept": np.ones(1, bool)}])
def test_gains_as_they_were_tried_make_no_other_trial(known):
    ground = Failing("it oscillated")
    same = recorded([OWN], proof=np.ones(1), **known)
    if known:  # those before, which were better by a move: the verdict says so
        same = same.with_gains(0, np.array(RULE))
    assert try_what_changed(bench_on(ground, 1), same) is same and ground.tried == []


def test_lowered_gains_without_drive_time_for_a_trial_are_a_reservation():
    ground = Failing("")
    bench, eased = bench_on(ground, 1), recorded([OWN], proof=np.ones(1)).with_gains(0, np.array(RULE))
    bench.spent[:] = bench._budget + choice.LAST_OVERTIME
    try_what_changed(bench, eased)
    (reservation,) = bench.journals[0].reservations
    assert ground.tried == [] and reservation.startswith("the lowered gains were tried by one move only")


# --- axes that shake at rest --------------------------------------------------------------------------------------
def peer(passed):
    return RuleTried(np.array([RULE]), np.zeros(1, bool), np.ones(1, bool), np.array([passed]), np.ones(1))


@pytest.mark.parametrize("passed", [True, False])
def test_easing_looks_at_the_rule_as_it_is_where_the_axis_stood_with_it(passed, monkeypatch):
    """By the twins it shakes; that the axis stood with it is worth more, and it is far better than what else stands."""

    @contextmanager
    def twins(bench, basis, k, sets, repeats, *, slippery=False):
        def cost_and_rest(gains):
            is_rule = (gains == RULE).all(axis=-1)
            return np.where(is_rule, 1.0, 9.0), np.where(is_rule, 5.0, gains[..., 2] / 2000.0)

        yield SimpleNamespace(cost_and_rest=cost_and_rest, score=lambda gains: cost_and_rest(gains)[0])

    monkeypatch.setattr("tuning.auto.calmer_gains._twins_of", twins)
    monkeypatch.setattr("tuning.auto.calmer_gains.sensitivity", lambda *given: 2.0)
    start = basis([RULE], plant=object(), found=object())
    shakes = recorded([OWN], response=object(), rule=peer(passed))
    found = calmer(bench_on(None, 1), start, shakes, 0, 0.5, 0.2, 0.1).tolist()
    assert (found == RULE) == passed
    assert passed or found[2] <= 1000  # half of the swing is allowed


class Refusing(Ground):
    """A ground on which gains with more velocity P than this fail their trial."""

    def __init__(self, most):
        super().__init__(lambda gains: np.ones(len(gains)))
        self.most, self.asks_heavier = most, False

    def run(self, gains, where, heavier=False):
        why = tuple("it oscillated" if row[2] > self.most else "" for row in gains.tolist())
        return super().run(gains, where)._replace(reason=why)


@pytest.mark.parametrize(("most", "kept", "reason"), [
    (2000, OWN, ""),
    (700, RULE, ""),  # changed gains that fail their trial give way to the rule's, which make it, too
    (600, None, "the lowered gains failed their trial: it oscillated"),
])  # fmt: skip
def test_gains_that_were_changed_and_fail_their_trial_give_way_to_the_rule_s(most, kept, reason, monkeypatch):
    monkeypatch.setattr(loop_margins, "sensitivity", lambda *given: 2.0)
    ground = Refusing(most)
    bench, start = bench_on(ground, 1), basis([RULE])
    found = loop_margins._try_again(bench, start, recorded([OWN], response=object()), np.ones(1, bool))
    assert bench.journals[0].reason == reason
    assert kept is None or (found.gains.tolist(), found.proven.tolist()) == ([kept], [kept])
    assert ground.tried == ([[OWN]] if kept == OWN else [[OWN], [RULE]])


@pytest.mark.parametrize("passed", [True, False])
def test_what_shakes_in_spite_of_easing_gets_the_rule_s_gains_before_it_is_rejected(passed, monkeypatch):
    monkeypatch.setattr(auto_moves, "calmer", lambda bench, basis, recorded, k, *how: recorded.gains[k] - 1)
    ground = Ground(lambda gains: np.ones(1), lambda gains: np.where((gains == RULE).all(axis=1), 0.0, 0.1))
    bench, start = bench_on(ground, 1), basis([RULE])
    found = stand(bench, start, of([OWN], ground, None, rule=peer(passed)), bench.target)
    assert (found.gains.tolist() == [RULE], not bench.journals[0].reason) == (passed, passed)
    assert passed or bench.journals[0].reason.startswith("it does not come to rest")


# --- a gear with play ---------------------------------------------------------------------------------------------
LOOSE = {
    "motor.R_s": 0.2996, "motor.L_d": 0.0002285, "motor.L_q": 0.0002122, "motor.psi_m": 0.002528,
    "motor.inertia": 1.914e-05, "motor.cogging_torque": 0.00397, "motor.coulomb": 0.002084, "motor.viscous": 1.953e-05,
    "stage.adc_noise": 0.03061, "stage.velocity_filter": 313.6, "load.inertia": 0.05085, "load.stiffness": 5411.0,
    "load.damping": 0.2619, "load.backlash": 0.004, "load.efficiency": 0.8892, "load.coulomb": 0.1326,
    "load.breakaway": 0.1284, "load.viscous": 0.03574,
}  # fmt: skip


@pytest.mark.slow
def test_a_response_within_the_play_of_a_gear_is_no_identification_of_the_axis():
    """It gives half of the inertia; the two moves, which drive through the play, 0.9.

    Where in its play a gear stands decides whether the shaking leaves it: of these plays one is not left.
    """
    doubted = 0
    for play in (0.004, 0.005, 0.006, 0.007):
        loose = LOOSE | {"load.backlash": play}
        with emulated(load="geared_joint", motor="ec_45_flat", parameters=loose, num_threads=1) as target:
            (found,) = identify_briefly(target)
            true = true_plant(target.drives).inertia
        assert found.value("inertia") == pytest.approx(true, rel=0.25), play
        if found.doubt:
            doubted += 1
            assert "it was measured within the play of a gear" in found.doubt
            assert IdentifiedAxes((found,), (None,)).doubtful == (True,)
            assert not found.estimates["velocity_filter"].is_known
    assert doubted


def test_twins_of_an_axis_in_doubt_are_not_asked(monkeypatch):
    monkeypatch.setattr(choice, "cost_on_twins", lambda *given: pytest.fail("twins"))
    ground = Ground(lambda gains: np.where((gains == RULE).all(axis=1), 2.0, 1.0))
    bench, start = bench_on(ground, 1), basis([RULE], found=SimpleNamespace(doubt="within the play of a gear"))
    found = keep_the_better(bench, start, try_rule(bench, start, of([OWN], ground, None)), bench.target)
    assert found.gains.tolist() == [OWN]
