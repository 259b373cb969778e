"""Automatic tuning ends with the better of its own and the baseline rule's gains, by the drives and by the twins."""

from __future__ import annotations

from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
from auto_stages import basis, recorded

from drive_env.devices import find_device
from tuning.auto import choice, loop_margins
from tuning.auto import moves as auto_moves
from tuning.auto.bench import AutoBench, Journal
from tuning.auto.calmer_gains import calmer
from tuning.auto.choice import PeerFigures, choose_set, keep_the_better, try_rule
from tuning.auto.moves import stand
from tuning.auto.proving import Proof, Shown
from tuning.auto.stages import IdentifiedAxes, RuleTried
from tuning.identify.quick_identification import identify_briefly
from tuning.identify.true_plant import true_plant
from tuning.target import emulated

RULE, OWN = [4000, 1500, 700, 1800, 700], [4000, 1000, 2000, 4800, 2000]
NAN = float("nan")


# --- what is chosen by figures ------------------------------------------------------------------------------------
@pytest.mark.parametrize(("drive", "twin", "chosen"), [
    ((2.0, 1.0), (2.0, 1.0), 1),  # better by both
    ((2.0, 1.0), (1.0, 2.0), 0),  # the twins have variants that no drive has
    ((1.0, 2.0), (2.0, 1.0), 0),  # the drive knows more than its twins
    ((1.0, 1.0), (2.0, 1.0), 0),  # no better is not better
    ((2.0, 1.0), (NAN, NAN), 1),  # no twin that could be trusted: the drive decides
    ((1.0, 2.0), (NAN, NAN), 0),
    ((2.0, NAN), (2.0, 1.0), 0),  # its trial was not made, or failed
])  # fmt: skip
def test_what_was_found_is_kept_where_it_is_better_on_the_drive_and_on_the_twins(drive, twin, chosen):
    costs = np.array(drive)[:, None]
    found = choose_set(costs, PeerFigures(costs, np.array(twin)[:, None]), np.ones(1, bool), 1)
    assert found.tolist() == [chosen]


@pytest.mark.parametrize(("rule", "own", "mixed", "twin_own", "chosen"), [
    ((2.0, 2.0), (1.0, 5.0), (1.0, 1.9), (1.0, 1.0), 2),  # one axis is worse with its own: the others keep theirs
    ((2.0, 2.0), (1.0, 5.0), (1.0, 2.5), (1.0, 1.0), 0),  # what is mixed is judged as a whole, and may be worse
    ((2.0, 2.0), (1.0, 1.2), (1.0, 1.9), (1.0, 1.0), 1),
    ((2.0, 1.0), (1.5, 1.4), (1.9, 1.0), (1.0, 1.0), 1),  # a machine is as good as its worst axis
    ((2.0, 1.0), (1.5, 1.4), (1.9, 1.0), (9.0, 1.0), 2),  # by the twins the axis 0 is not
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

    def run(self, gains, where):
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
    assert found.gains.tolist() == [kept]
    assert bool(bench.journals[0].notes) == (kept == RULE)
    assert found.shown.cost.tolist() == [rule if kept == RULE else own], "the move on record is that of the gains"


def test_a_rule_that_shakes_at_rest_is_no_peer(monkeypatch):
    """It would have to be slowed, as the gains found were: a swing of 6 % is refused with any gains."""
    twins(monkeypatch, 1.0, 2.0)
    ground = Ground(lambda gains: np.ones(1), lambda gains: np.where((gains == RULE).all(axis=1), 0.06, 0.0))
    bench, start = bench_on(ground, 1), basis([RULE])
    found = try_rule(bench, start, of([OWN], ground, None))
    assert not found.rule.passed.any()
    assert keep_the_better(bench, start, found, bench.target).gains.tolist() == [OWN]


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
    costs = {"RR": (2.0, 2.0), "OO": (1.0, 5.0), "OR": (1.1, 1.9)}

    def cost(gains):
        return np.array(costs["".join("R" if row == RULE else "O" for row in gains.tolist())])

    ground = Ground(cost)
    bench, start = bench_on(ground, 2), basis([RULE, RULE])
    found = keep_the_better(bench, start, try_rule(bench, start, of([OWN, OWN], ground, None)), bench.target)
    assert ground.tried == [[RULE, RULE], [OWN, RULE]]
    assert found.gains.tolist() == [OWN, RULE]
    costs["OR"] = (1.1, 2.5)  # which no axis by itself would say
    found = keep_the_better(bench, start, try_rule(bench, start, of([OWN, OWN], ground, None)), bench.target)
    assert found.gains.tolist() == [RULE, RULE]


# --- axes that shake at rest --------------------------------------------------------------------------------------
def peer(passed):
    return RuleTried(np.ones(1, bool), np.array([passed]), np.ones(1))


@pytest.mark.parametrize("passed", [True, False])
def test_easing_looks_at_the_rule_as_it_is_where_the_axis_stood_with_it(passed, monkeypatch):
    """By the twins it shakes; that the axis stood with it is worth more, and it is far better than what else stands."""

    @contextmanager
    def twins(bench, basis, k, sets, repeats, *, slippery=False):
        def cost_and_rest(gains):
            is_rule = (gains == RULE).all(axis=-1)
            return np.where(is_rule, 1.0, 9.0), np.where(is_rule, 0.5, gains[..., 2] / 2000.0)

        yield SimpleNamespace(device=find_device("tmcm1636"), num_axes=1, sets=sets, cost_and_rest=cost_and_rest)

    monkeypatch.setattr("tuning.auto.calmer_gains._twins_of", twins)
    monkeypatch.setattr("tuning.auto.calmer_gains.sensitivity", lambda *given: 2.0)
    start = basis([RULE], plant=object(), found=object())
    shakes = recorded([OWN], response=object(), rule=peer(passed))
    bench = bench_on(None, 1)
    bench.rng = np.random.default_rng(0)
    found = calmer(bench, start, shakes, 0, 0.5, 1.0, 0.1).tolist()
    assert (found == RULE) == passed
    assert passed or found[2] <= 200  # a tenth of the swing is allowed


class Refusing(Ground):
    """A ground on which gains with more velocity P than this fail their trial."""

    def __init__(self, most):
        super().__init__(lambda gains: np.ones(len(gains)))
        self.most = most

    def run(self, gains, where):
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
    "load.damping": 0.2619, "load.backlash": 0.005671, "load.efficiency": 0.8892, "load.coulomb": 0.1326,
    "load.breakaway": 0.1284, "load.viscous": 0.03574,
}  # fmt: skip


@pytest.mark.slow
def test_a_response_within_the_play_of_a_gear_is_no_identification_of_the_axis():
    """It gave 0.42 of the inertia; the two moves, which drive through the play, give 0.8."""
    with emulated(load="geared_joint", motor="ec_45_flat", parameters=LOOSE, num_threads=1) as target:
        (found,) = identify_briefly(target)
        true = true_plant(target.drives).inertia
    assert found.value("inertia") == pytest.approx(true, rel=0.25)
    assert "it was measured within the play of a gear" in found.doubt
    assert IdentifiedAxes((found,), (None,)).doubtful == (True,)
    assert not found.estimates["velocity_filter"].is_known


def test_twins_of_an_axis_in_doubt_are_not_asked(monkeypatch):
    monkeypatch.setattr(choice, "cost_on_twins", lambda *given: pytest.fail("twins"))
    ground = Ground(lambda gains: np.where((gains == RULE).all(axis=1), 2.0, 1.0))
    bench, start = bench_on(ground, 1), basis([RULE], found=SimpleNamespace(doubt="within the play of a gear"))
    found = keep_the_better(bench, start, try_rule(bench, start, of([OWN], ground, None)), bench.target)
    assert found.gains.tolist() == [OWN]
