"""A search asked for dynamics: what no drive gets, what is left where nothing keeps them, what is said of margins."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from rigs.commands import drive_tune

from drive_env.drives.raw_gains import read_gains
from drive_env.emulator.emulated_drives import EmulatedDrives
from drive_env.loops.dynamics import OFF_NOMINAL, find_dynamics, loop_clearance
from drive_env.loops.sampled import CascadeGains, LoopRates
from drive_env.loops.true_plant import true_machines
from drive_env.loops.worst_margins import worst_margins
from drive_env.trials.score import robust_cost
from tuning.search import optimise as search
from tuning.search.model_margins import ModelMargins
from tuning.search.optimise import Settings, TrialRow, objective_values, optimise
from tuning.search.trial_bench import TrialBench
from tuning.target import emulated

MACHINE = {"device": "tmcm1636", "motor": None, "num_machines": 4}
FEW = Settings(trials=8, seed=1, dynamics="standard")
UNKEPT = "89.9/39.9/1.0001"
IDENTIFIED = 0.1  # of the clearance: what a brief identification may be wrong by


@pytest.mark.every(4)
@pytest.mark.parametrize("load", ["inertia", "two_mass"])
@pytest.mark.parametrize("safe", [False, True])
def test_what_breaks_margins_by_the_true_machine_never_reaches_a_drive(load, safe, monkeypatch):
    seen, searching = set(), []
    with emulated(load=load, **MACHINE) as target:
        drives = target.drives
        truly, identified = EmulatedDrives._run, TrialBench.identify

        def run(self, *given):  # whatever lets time pass comes here
            if searching:
                seen.update(map(tuple, read_gains(drives).tolist()))
            return truly(self, *given)

        monkeypatch.setattr(EmulatedDrives, "_run", run)
        monkeypatch.setattr(TrialBench, "identify", lambda bench: (identified(bench), searching.append(1)))
        found = optimise(target, replace(FEW, safe=safe), shared=True, anew=True)
        true = true_machines(drives)
    rates, dynamics = LoopRates.of(target.device), find_dynamics("standard")

    def clearance(gains):
        one = type(true)(*(np.repeat(part[:1], len(gains), axis=0) for part in true))
        return loop_clearance(dynamics, rates, one, CascadeGains.of(target.device, np.array(gains)[:, None]))[0]

    tried = [row.gains[0] for row in found.rows]
    assert {tuple(gains.tolist()) for gains in tried} <= seen, "what was tried was on a drive"
    assert len(tried) == 8 and clearance(tried).min() > 1.0 - IDENTIFIED
    # The probe of a trial has 1.5 times the velocity P, with which a smaller region is asked for.
    assert clearance(sorted(seen)).min() > OFF_NOMINAL * (1.0 - IDENTIFIED)
    phase, gain, ms = worst_margins(rates, type(true)(*(part[:1] for part in true)), CascadeGains.of(
        target.device, found.gains[None, :1]
    ))  # fmt: skip
    worst = found.margins[0, :, 0].min(), found.margins[0, :, 1].min(), found.margins[0, :, 2].max()
    np.testing.assert_allclose(worst, [phase[0], gain[0], ms[0]], rtol=0.15)


@pytest.mark.slow
def test_proposals_that_break_the_dynamics_are_no_trials():
    with emulated(load="two_mass", **MACHINE) as target:
        found = optimise(target, FEW, shared=True, anew=True)
    assert [row.number for row in found.rows] == list(range(8)) and found.untried > 0
    assert min(row.slack for row in found.rows) > 0.0 and not any(row.aborted for row in found.rows)
    best = min(found.rows, key=lambda row: row.robust_cost)
    assert found.gains[0].tolist() == best.gains[0].tolist() and found.cost[0] == best.cost


@pytest.mark.every(2)
@pytest.mark.parametrize(
    ("safe", "says"), [(False, "0 trials: 160 proposals broke"), (True, "no slow gains keep 89.9/39.9/1.0001")]
)
def test_where_nothing_keeps_the_dynamics_the_drives_keep_their_gains(safe, says):
    with emulated(load="inertia", **MACHINE | {"num_machines": 1}) as target:
        before = read_gains(target.drives)
        found = optimise(target, replace(FEW, sampler="random", dynamics=UNKEPT, safe=safe))
        assert read_gains(target.drives).tolist() == before.tolist() == found.gains.tolist()
    assert found.rows == () and np.isnan(found.cost).all()
    (note,) = found.notes
    assert says in note and note.endswith("the drives keep those of before")


@pytest.mark.slow
def test_a_search_goes_on_from_its_journal_with_what_was_not_tried(tmp_path):
    settings = replace(FEW, journal=tmp_path / "journal")

    def found(trials):
        with emulated(load="two_mass", **MACHINE) as target:
            return optimise(target, replace(settings, trials=trials), shared=True, anew=True)

    first = found(4)
    both = found(8)
    assert first.untried > 0 and both.untried >= first.untried
    assert [row.number for row in both.rows] == list(range(8))
    assert [row.gains.tolist() for row in both.rows[:4]] == [row.gains.tolist() for row in first.rows]
    with pytest.raises(ValueError, match="journal"):
        settings = replace(settings, dynamics="soft")
        found(8)


@pytest.mark.slow
def test_several_axes_of_a_machine_keep_them_each():
    with emulated(load="gantry", **MACHINE | {"num_machines": 2}) as target:
        found = optimise(target, replace(FEW, trials=3), shared=True, anew=True)
    assert len(found.rows) == 3 and found.margins.shape == (4, 2, 3)
    assert np.isfinite(found.margins[:2]).all() and np.isnan(found.margins[2:]).all()  # copies of the first
    assert found.margins[:2, :, 0].min() > 45.0 and found.margins[:2, :, 2].max() < 2.0


@pytest.mark.parametrize(("cost", "slack"), [(0.5, 0.2), (0.5, 0.001), (3.0, -0.3), (0.5, -3.0)])
def test_a_trial_is_worth_its_robust_cost(cost, slack):
    row = TrialRow(0, 0, np.ones((1, 5), int), cost, (1.0, 2.0, 3.0), False, slack=slack)
    expected = math.log(robust_cost(np.array(math.exp(cost)), np.array(slack)))
    assert objective_values(row, ("cost",)) == (pytest.approx(expected),)
    assert objective_values(row, ("speed",)) == (pytest.approx(1.0 + math.log(2.0 - math.exp(min(slack, 0.0)))),)
    assert row._replace(slack=math.inf).robust_cost == cost
    slower, slowest = (row._replace(cost=c, slack=0.2).robust_cost for c in (math.log(31.0), math.log(40.0)))
    assert slower < slowest, "J has come to its end"


def test_dynamics_that_cannot_be_asked_for_are_refused(tmp_path):
    with pytest.raises(ValueError, match="dynamics 'softy': give soft, standard, stiff"):
        Settings(dynamics="softy")
    stepper = emulated(device="tmcm6212", motor="qsh4218_51", load="inertia", num_machines=1)
    with stepper as target, pytest.raises(ValueError, match="no linear model"):
        optimise(target, FEW)
    out = tmp_path / "out"
    refused = drive_tune(
        "auto", "--by", "tpe", "--device", "tmcm6212", "--load", "inertia", "--dynamics", "soft", "--out", out
    )
    assert refused.exit_code == 2 and "leave --dynamics out" in refused.output and not out.exists()
    refused = drive_tune("auto", "--by", "tpe", "--dynamics", "45/8", "--out", out)
    assert refused.exit_code == 2 and "phase margin/gain margin/Ms" in refused.output and not out.exists()


@pytest.mark.slow
def test_gains_of_a_search_bear_the_load_inertia_that_was_asked_for(tmp_path, monkeypatch):
    asked = []

    class Margins(ModelMargins):
        def __init__(self, target, dynamics, where):
            asked.append((dynamics.name, dynamics.inertia_range))
            super().__init__(target, dynamics, where)

    monkeypatch.setattr(search, "ModelMargins", Margins)
    one, two = tmp_path / "one", tmp_path / "two"
    arguments = ("--trials", 1, "--machines", 1, "--inertia-range", "0.2/5", "--out", one, "--json")
    done = drive_tune("auto", "--by", "tpe", *arguments)
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["search"]["settings"]["inertia_range"] == "0.2/5"
    assert drive_tune("auto", "--config", one / "settings.toml", "--out", two).exit_code == 0
    assert asked == [("standard", (0.2, 5.0))] * 2


@pytest.mark.slow
def test_a_journal_of_another_range_of_load_inertia_is_refused(tmp_path):
    journal = tmp_path / "search.journal"
    arguments = ("auto", "--by", "tpe", "--trials", 1, "--machines", 1, "--load", "inertia", "--journal", journal)
    assert drive_tune(*arguments, "--out", tmp_path / "one").exit_code == 0
    refused = drive_tune(*arguments, "--inertia-range", "0.5/3", "--out", tmp_path / "two")
    assert refused.exit_code == 2 and "give another --journal" in refused.output, refused.output


@pytest.mark.slow
def test_the_command_asks_for_standard_dynamics_and_says_whose_margins_it_prints(tmp_path):
    arguments = ("auto", "--by", "tpe", "--trials", 2, "--machines", 2)
    found = drive_tune(*arguments, "--out", tmp_path / "one")
    assert found.exit_code == 0, found.output
    assert "they break standard dynamics by the model" in found.output
    assert "axis 0: by the identified model, not measured: velocity loop " in found.output
    told = json.loads(drive_tune(*arguments, "--dynamics", "50/10/1.8", "--json", "--out", tmp_path / "two").stdout)[
        "search"
    ]
    assert told["settings"]["dynamics"] == "50/10/1.8"
    margins = told["margins"][0]
    assert set(margins) == {"velocity", "position"}
    assert min(loop["phase_deg"] for loop in margins.values()) > 50.0
    assert max(loop["ms"] for loop in margins.values()) < 1.8
    again = drive_tune("auto", "--config", tmp_path / "two" / "settings.toml", "--out", tmp_path / "three", "--json")
    assert json.loads(again.stdout)["search"]["gains"] == told["gains"]
    stepper = (
        "--device",
        "tmcm6212",
        "--motor",
        "qsh4218_51",
        "--load",
        "inertia",
        "--json",
        "--out",
        tmp_path / "four",
    )
    assert json.loads(drive_tune(*arguments, *stepper).stdout)["settings"]["dynamics"] is None
