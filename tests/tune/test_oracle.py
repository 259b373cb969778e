"""The constrained oracle: it keeps the constraints, nothing near is better, and a row that is stale is noticed."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tuning.compare import oracle as module
from tuning.compare.oracle import KEPT, digest, find_oracles, read_oracles, search_oracle, write_oracles
from tuning.compare.suite import load_suite, open_group
from tuning.compare.yardstick import Yardstick
from tuning.identify.moved_inertia import true_inertia

MACHINES = {machine.name: machine for machine in load_suite(seed=0)}
RIGID, ELASTIC = MACHINES["inertia-qbl4208-0"], MACHINES["two_mass-qbl4208-0"]


@pytest.mark.slow
@pytest.mark.parametrize("machine", [RIGID, ELASTIC], ids=["rigid", "elastic"])
def test_nothing_near_the_oracle_keeps_the_constraints_and_is_better(machine):
    best = search_oracle(machine)
    rng = np.random.default_rng(5)
    near = np.exp(rng.normal(0.0, 0.1, (48, *best.gains.shape)))
    near[..., 1] = 1.0  # torque I follows the winding
    yardstick = Yardstick([machine], None, copies=len(near))
    box = module._Box.of(yardstick)
    scores = yardstick.score(box.whole(np.log(best.gains * near)).reshape(-1, best.gains.shape[1]))
    yardstick.close()
    # P of the current loop keeps 60 degrees, and is no low-pass of the velocity loop either.
    assert box.least[0, 0] - box.most[0, 0] == pytest.approx(np.log(0.3))
    assert np.abs(np.log(best.gains) - np.clip(np.log(best.gains), box.least, box.most)).max() < 1e-3
    assert best.slack > 0.0
    assert scores.performance[scores.slack > 0.0].min() > 0.97 * best.performance


@pytest.mark.slow
def test_another_seed_ends_as_well():
    first, second = (search_oracle(RIGID, seed=seed).performance for seed in (0, 1))
    assert first == pytest.approx(second, rel=0.03)


@pytest.mark.parametrize(
    ("slacks", "runs"), [([-1.0, 0.1], [3, 16, 16, 16]), ([0.1], [3, 16]), ([-1.0, -1.0], [3, 16, 16, 16])]
)
def test_where_all_finalists_hunt_in_some_place_every_run_counts_in_the_search(slacks, runs, monkeypatch):
    asked, left = [], list(slacks)

    class Judge:
        def __init__(self, group, num_threads, repeats=16, copies=1, dynamics=None):
            asked.append(repeats)

        def score(self, gains):
            slack = np.full(len(gains), left.pop(0))
            return SimpleNamespace(robust_cost=1.0 - slack, performance=np.ones(len(gains)), slack=slack)

        def close(self):
            pass

    monkeypatch.setattr(module, "Yardstick", Judge)
    monkeypatch.setattr(module._Box, "of", lambda yardstick: None)
    monkeypatch.setattr(module, "_evolved", lambda yardstick, box, rng: np.ones((48, 1, 5), np.int64))
    assert search_oracle(RIGID).slack == slacks[-1]
    assert asked == runs and not left


def test_what_is_kept_are_gains_and_their_figures_are_scored_anew(monkeypatch):
    monkeypatch.setattr(module, "search_oracle", None)  # which is not needed
    kept, found = read_oracles()[digest(RIGID)], find_oracles([RIGID])[RIGID.name]
    assert found.gains.tolist() == kept.gains.tolist()
    assert found.performance == pytest.approx(kept.performance, rel=0.001)


@pytest.mark.slow
def test_every_row_that_is_kept_still_holds(monkeypatch):
    """Also those of machines that no gains satisfy."""
    monkeypatch.setattr(module, "search_oracle", None)  # which is not needed
    machines = load_suite()
    assert set(find_oracles(machines)) == {machine.name for machine in machines}


@pytest.mark.parametrize("stale", ["machine", "performance", "slack"])
def test_a_row_that_no_longer_holds_is_searched_anew(stale, monkeypatch, tmp_path):
    true, shares = read_oracles()[digest(RIGID)], []
    monkeypatch.setattr(module, "search_oracle", lambda machine, num_threads, dynamics: "searched")
    machine, row = RIGID, true
    if stale == "machine":
        machine = replace(RIGID, supply=RIGID.supply + 1.0)
    elif stale == "performance":
        row = true._replace(performance=1.1 * true.performance)
    else:
        row = true._replace(gains=true.gains * np.array([1, 1, 1, 1, 3]))
    file = tmp_path / "oracles.csv"
    write_oracles(file, [RIGID], {RIGID.name: row})
    assert find_oracles([machine], progress=shares.append, kept=file) == {machine.name: "searched"}
    assert shares == [0.0, 1.0]


@pytest.mark.parametrize(("dynamics", "is_searched"), [("soft", True), ("45/8/2", False), ("standard", False)])
def test_the_file_has_oracles_for_standard_dynamics_alone(dynamics, is_searched, monkeypatch):
    asked = []

    def search(machine, num_threads, dynamics):
        asked.append((machine.name, dynamics))

    monkeypatch.setattr(module, "search_oracle", search)
    find_oracles([RIGID], dynamics=dynamics)
    assert asked == ([(RIGID.name, dynamics)] if is_searched else [])


@pytest.mark.slow
def test_softer_dynamics_have_a_slower_oracle_that_keeps_them():
    soft, standard = (search_oracle(RIGID, dynamics=name) for name in ("soft", "standard"))
    assert soft.performance > standard.performance and soft.slack > 0.0
    yardstick = Yardstick([RIGID], None)
    worst = yardstick.margins(soft.gains)
    yardstick.close()
    assert worst.phase_deg[0] > 59.0 and worst.ms[0] < 1.52


def test_both_ends_of_a_gantry_are_judged_by_the_same_move():
    """The payload makes one heavier than the other: moves of their own would wring the bridge."""
    gantry = MACHINES["gantry-qbl4208-0"]
    with closing(Yardstick([gantry], 1, repeats=1)) as yardstick, open_group([gantry], 1) as target:
        first, second = true_inertia(target)
        move = yardstick._score._move
    assert abs(first / second - 1.0) > 0.02
    assert np.ptp(move.distance) == np.ptp(move.velocity) == np.ptp(move.acceleration) == 0


def test_every_axis_is_kept_in_the_file(tmp_path):
    gains = np.arange(1, 11).reshape(2, 5)
    write_oracles(tmp_path / "file.csv", [RIGID], {RIGID.name: module.Oracle(gains, 1.5, 0.05)})
    (found,) = read_oracles(tmp_path / "file.csv").values()
    assert found.gains.tolist() == gains.tolist() and found[1:] == (1.5, 0.05)


def test_the_machines_of_one_axis_that_ship_have_a_row():
    rows = read_oracles(KEPT)
    assert [
        name for name, one in MACHINES.items() if digest(one) not in rows and one.load not in ("gantry", "robot")
    ] == []
