"""Tuners machine by machine, against the best of the others on each."""

from __future__ import annotations

import csv
import statistics

import numpy as np
import pytest

from tuning.compare.against_best import all_rivals
from tuning.compare.comparison import Comparison, MachineRow, TunerRow
from tuning.compare.comparison_files import save
from tuning.compare.tuners import find_tuner
from tuning.search.optimise import Settings

HIDDEN = {"learned": [1.0, 2.0, 3.0, 8.0, 5.0], "tpe": [2.0, 2.5, 2.0, 4.0, 6.0], "gp": [4.0, 1.0, 6.0, 9.0, 5.0]}


def comparison(table):
    def row(tuner, k, hidden):
        figures = (hidden, hidden, 2.0, hidden / 2.0, 0.1, 46.0, 9.0, 1.9, True, True, False)
        return MachineRow(tuner, f"machine {k}", *figures, 1.0, 3, 0, 0, "", False, {"torque_p": 1}, "")

    rows = tuple(row(name, k, hidden) for name, values in table.items() for k, hidden in enumerate(values))
    tuners = tuple(
        TunerRow(name, len(values), 1.0, 1.0, 1.0, 1.0, *(None,) * 5, 1.0, 0.0, 1.0, 3.0, 0, 0, 0)
        for name, values in table.items()
    )
    return Comparison(rows, tuners)


def test_each_machine_has_its_own_best_rival():
    (found,) = (row for row in all_rivals(comparison(HIDDEN)) if row.tuner == "learned")
    ratios = [1.0 / 2.0, 2.0 / 1.0, 3.0 / 2.0, 8.0 / 4.0, 5.0 / 5.0]
    assert found.median == statistics.median(ratios) == 1.5
    assert (found.better, found.machines, found.rivals) == (1, 5, "tpe, gp")  # a draw is no better


@pytest.mark.slow
def test_the_interval_holds_the_median_of_all_machines_as_often_as_it_says():
    rng, held = np.random.default_rng(0), []
    for _ in range(150):
        mine = rng.lognormal(np.log(1.2), 0.5, 41)
        found = next(row for row in all_rivals(comparison({"mine": mine, "other": np.ones(41)})) if row.tuner == "mine")
        held.append(found.low <= 1.2 <= found.high)
    assert 0.88 <= np.mean(held) <= 1.0


def test_every_tuner_is_held_against_all_others_the_best_first():
    rows = all_rivals(comparison(HIDDEN))
    assert [row.tuner for row in rows] == ["tpe", "learned", "gp"]
    assert [row.median for row in rows] == [1.2, 1.5, 2.25]
    assert all_rivals(comparison({"alone": [1.0]})) == ()


@pytest.mark.slow
def test_they_are_a_file_of_the_comparison(tmp_path):
    save(comparison(HIDDEN), tmp_path, {"suite": "public"})
    with (tmp_path / "rivals.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["tuner"] for row in rows] == ["tpe", "learned", "gp"] and rows[0]["rivals"] == "learned, gp"


def test_searches_take_another_number_of_trials():
    assert Settings(**find_tuner("tpe-safe", 100).keywords) == Settings(
        sampler="tpe", trials=100, safe=True, dynamics="standard"
    )
    assert find_tuner("cmaes").keywords["trials"] == 20
    assert find_tuner("grid", 100).keywords["trials"] == 28  # its points are what they are
    assert callable(find_tuner("baseline", 100))
