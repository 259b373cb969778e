"""Tuners compared: judged by the constrained oracle and by true margins, and counted alike."""

from __future__ import annotations

import csv
import importlib.metadata
import json
import tomllib
from functools import partial

import numpy as np
import pytest
from rigs.commands import drive_tune

from drive_env.devices.gains import rule_gains
from drive_env.drives.raw_gains import read_gains, write_gains
from drive_env.trials.positioning import plan_move
from drive_env.trials.score import RobustScore
from tuning.compare import comparison as compare_module
from tuning.compare import tuners
from tuning.compare.comparison import compare
from tuning.compare.comparison_files import save
from tuning.compare.oracle import digest, find_oracles, read_oracles
from tuning.compare.suite import load_suite, open_group
from tuning.compare.tuners import MissingTunerError, find_tuner, search_tuner, tuner_rows
from tuning.compare.yardstick import REPEATS
from tuning.outcome import Outcome
from tuning.runs.pools import open_pool
from tuning.runs.shard_log import ShardLog
from tuning.search.optimise import Optimised, Settings, TrialRow
from tuning.search.trials_files import trials_figure
from tuning.target import emulated

RIGID = [m for m in load_suite() if m.load == "inertia" and m.motor == "qbl4208"]
SHORT = [m for m in load_suite() if m.load == "belt"][-1:]


def outcome(target, gains, note=""):
    zero = np.zeros(target.num_axes, int)
    return Outcome(np.asarray(gains), np.zeros(target.num_axes), zero, zero, zero, (note,) * target.num_axes)


def true_rule():
    """Return the rule's gains for the true inertia of the rigid machines: disc and rotor, over the true K_t."""
    with open_group(RIGID) as target:
        true = target.drives.machine.parameters
        inertia = (true["load.inertia"] + true["motor.inertia"]) / (true["motor.psi_m"] / target.motor.psi_m)
        gains = [
            rule_gains(target.device, target.motor, J, supply=volts)[0]
            for J, volts in zip(inertia, target.supply, strict=True)
        ]
        return np.array(gains), inertia


def knows_the_truth():
    """Return a tuner that takes the oracle's gains of the rigid machines, in their order."""
    best, machines = read_oracles(), iter(RIGID)
    return lambda target, rng: outcome(target, best[digest(next(machines))].gains)


def moves_and_slows(target, rng):
    """Move once, take a fifth of the gains, and say what there is."""
    from drive_env import motion

    motion.enable(target.drives, mode="pp")
    motion.start_move(target.drives, 10_000)
    target.drives.advance(0.3)
    gains = np.maximum(read_gains(target.drives) // 5, 1)
    write_gains(target.drives, gains)
    return outcome(target, gains, "slowed")


def shakes(target, rng):
    """Take gains with which the velocity loop oscillates, which is worse than the rule anywhere."""
    gains = read_gains(target.drives)
    gains[:, 2] *= 60
    write_gains(target.drives, gains)
    return outcome(target, gains, "shaken")


def breaks(target, rng):
    write_gains(target.drives, np.tile([4021, 1573, 700, 500, 200], (target.num_axes, 1)))
    raise RuntimeError("out of ideas\nentirely")


# --- the score ----------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_the_oracle_is_the_yardstick():
    found = compare(RIGID, {"truth": knows_the_truth()})
    assert [row.relative for row in found.rows] == pytest.approx([1.0] * 4, rel=1e-12)
    assert all(row.kept and row.near and row.phase_deg > 44.0 and row.ms < 2.1 for row in found.rows)


def test_the_cost_is_the_robust_cost_of_the_machine():
    found = compare(RIGID, {"factory": find_tuner("factory")})
    _, inertia = true_rule()
    hidden = RobustScore("tmcm1636", "inertia", "qbl4208", 4, repeats=REPEATS)
    with open_group(RIGID) as target:
        hidden.set_machines(target.drives.machine.parameters, target.supply)
        hidden.set_moves(plan_move(target.motor, inertia, target.drives.read((0x2058, 0)), np.full(4, np.inf)))
        expected = hidden.score(read_gains(target.drives))
    hidden.close()
    assert [row.robust_cost for row in found.rows] == pytest.approx(expected.robust_cost)
    assert [row.performance for row in found.rows] == pytest.approx(expected.performance)
    assert [row.slack for row in found.rows] == pytest.approx(expected.slack)
    best = find_oracles(RIGID)
    assert [row.relative for row in found.rows] == pytest.approx(
        expected.performance / [best[machine.name].performance for machine in RIGID]
    )


@pytest.mark.slow
def test_gains_are_judged_by_the_dynamics_asked_for():
    best, rows = find_oracles(RIGID), {}
    for dynamics in ("soft", "standard"):
        found = compare(RIGID, {"truth": knows_the_truth()}, oracles=best, dynamics=dynamics)
        rows[dynamics] = found.of("truth")
        assert found.tuners[0].kept == (1.0 if dynamics == "standard" else 0.0)
        assert all(row.near == (dynamics == "standard") for row in rows[dynamics])
    for soft, standard in zip(rows["soft"], rows["standard"], strict=True):
        assert soft.slack < standard.slack and soft.performance == standard.performance
        assert soft.robust_cost > 30.0 > standard.robust_cost


def test_auto_is_asked_for_the_dynamics(monkeypatch):
    asked = {}

    def auto(target, file, *, dynamics, keep):
        asked["dynamics"] = dynamics
        raise RuntimeError("that is all")

    monkeypatch.setattr("tuning.auto.one_button.auto", auto)
    compare(RIGID[:1], {"auto": find_tuner("auto", dynamics="soft")}, oracles=find_oracles(RIGID[:1]))
    assert asked == {"dynamics": "soft"}


@pytest.mark.slow
def test_a_search_keeps_the_dynamics_asked_for():
    best = find_oracles(RIGID[:2])
    named = {"asked": find_tuner("tpe", 6, "soft"), "free": partial(search_tuner, sampler="tpe", trials=6)}
    found = compare(RIGID[:2], named, oracles=best, dynamics="soft")
    assert all(row.near and row.phase_deg > 55.0 for row in found.of("asked"))
    assert not all(row.near for row in found.of("free"))


def test_a_search_of_a_drive_without_a_linear_model_has_no_margins_to_keep():
    with emulated("tmcm6212", "inertia") as target:
        kept = search_tuner(target, np.random.default_rng(0), "standard", sampler="random", trials=1)
    assert kept.moves.all()


@pytest.mark.slow
def test_a_summary_is_of_all_machines():
    found = compare(RIGID, {"wild": shakes, "truth": knows_the_truth()})
    wild, relative = next(row for row in found.tuners if row.tuner == "wild"), [r.relative for r in found.of("wild")]
    ordered = sorted(relative)
    assert wild.median == pytest.approx(0.5 * (ordered[1] + ordered[2]))
    assert wild.p95 == pytest.approx(ordered[2] + 0.85 * (ordered[3] - ordered[2]))  # 0.95 * 3 = 2.85
    assert wild.machines == 4 and wild.failed == 0
    assert (wild.kept, wild.near, wild.accepted) == (0.0, 0.0, 1.0)
    assert wild.phase_deg < 20.0 and wild.ms > 3.0
    assert [row.tuner for row in found.tuners] == ["truth", "wild"]  # the best first


@pytest.mark.slow
def test_what_a_tuner_does_not_vouch_for_is_not_accepted():
    verdicts = [(True, False), (False, False), (True, True), (True, False)]
    each = iter(verdicts)

    def doubts(target, rng):
        accepted, reserved = map(np.atleast_1d, next(each))
        return outcome(target, read_gains(target.drives))._replace(accepted=accepted, reserved=reserved)

    found = compare(RIGID, {"doubts": doubts, "broken": breaks})
    assert [(row.accepted, row.reserved) for row in found.of("doubts")] == verdicts
    shares = {row.tuner: (row.accepted, row.reserved) for row in found.tuners}
    assert shares == {"doubts": (0.75, 0.25), "broken": (0.0, 0.0)}


# --- what tuners do -----------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_what_a_tuner_did_is_counted_by_the_meter_not_by_itself():
    (row, *_) = compare(RIGID, {"slow": moves_and_slows}).rows
    assert row.moves == 1 and row.note == "slowed"
    assert 0.3 <= row.drive_seconds < 0.4
    assert (row.gains["velocity_p"], row.gains["position_p"]) == (445 // 5, 118 // 5)


def test_a_violation_is_named():
    def runs_off(target, rng):
        from drive_env import motion

        motion.enable(target.drives, mode="pp")
        motion.start_move(target.drives, int(0.8 * 65536))
        target.drives.advance(0.5)
        return outcome(target, read_gains(target.drives))

    (row,) = compare(SHORT, {"runs off": runs_off}).rows
    assert row.violations == 1 and row.kinds == "left its travel 1"


@pytest.mark.slow
def test_the_true_machine_is_hidden_from_a_tuner():
    seen = []
    compare(
        RIGID[:1],
        {"curious": lambda target, rng: seen.append(target.drives.machine) or outcome(target, true_rule()[0][:1])},
    )
    assert seen == [None]


def test_a_tuner_that_breaks_is_scored_by_what_it_left_and_the_others_go_on():
    found = compare(RIGID, {"broken": breaks, "truth": knows_the_truth()})
    for row in found.of("broken"):
        assert row.failed and row.note == "RuntimeError: out of ideas entirely"
        assert (row.gains["velocity_p"], row.gains["position_p"]) == (700, 200)
    assert [row.relative for row in found.of("truth")] == pytest.approx([1.0] * 4)
    assert next(row for row in found.tuners if row.tuner == "broken").failed == 4


@pytest.mark.slow
@pytest.mark.parametrize(
    "gains", [np.ones((1, 4), int), np.full((1, 5), np.nan), np.full((1, 5), 10.5)], ids=["shape", "nan", "fraction"]
)
def test_gains_that_are_none_are_the_tuners_mistake(gains):
    (row,) = compare(RIGID[:1], {"odd": lambda target, rng: outcome(target, gains)}).rows
    assert row.failed and "a tuner returns an Outcome with integer gains of shape (1, 5)" in row.note


@pytest.mark.slow
def test_a_comparison_follows_from_its_seed_and_from_nothing_else():
    def tuner(target, rng):
        return search_tuner(target, rng, sampler="random", trials=6)

    alone, again, other = (compare(RIGID, {"search": tuner}, seed=seed).rows for seed in (0, 0, 1))
    beside = compare(RIGID, {"factory": find_tuner("factory"), "search": tuner}).of("search")
    assert alone == again == tuple(beside)
    assert [row.gains["velocity_p"] for row in alone] != [row.gains["velocity_p"] for row in other]


@pytest.mark.slow
def test_a_machine_is_tuned_as_if_it_were_alone():
    """Tuned together, machines waited for the slowest: 16.8 s of drive time in the median, where each needs 13.0 s."""
    tuners = {"search": partial(search_tuner, sampler="random", trials=2)}
    assert compare(RIGID[:2], tuners).rows[0] == compare(RIGID[:1], tuners).rows[0]


class KilledError(Exception):
    """Raised in place of a kill."""


@pytest.mark.slow
def test_a_comparison_that_was_killed_goes_on_to_the_same_figures(tmp_path):
    machines = [*RIGID[:2], *SHORT]
    calls = []

    def noted(name):
        def tuner(target, rng):
            calls.append((name, target.machine))
            return moves_and_slows(target, rng)

        return tuner

    names = {name: noted(name) for name in ("a", "b")} | {"broken": breaks, "simc": find_tuner("simc")}
    whole = compare(machines, names, seed=3)
    calls.clear()
    steps = []

    def progress(what, share):
        steps.append(what)
        if len(steps) == 4:  # the first machine has been tuned by three
            raise KilledError

    with pytest.raises(KilledError), ShardLog(tmp_path / "log", "x") as log:
        compare(machines, names, seed=3, log=log, progress=progress)
    with ShardLog(tmp_path / "log", "x") as log:
        assert sorted(log.done) == [0, 1, 2]
        resumed = compare(machines, names, seed=3, log=log)
    assert resumed == whole
    assert calls == [(name, load) for load in ("inertia", "inertia", "belt") for name in "ab"]  # none of them twice


@pytest.mark.slow
def test_on_processes_it_is_the_same_comparison(tmp_path):
    machines, names = [*RIGID[:2], *SHORT], ("factory", "simc", "random")
    whole = compare(machines, {name: find_tuner(name, 2) for name in names}, seed=3)
    with open_pool(workers=2) as pool, ShardLog(tmp_path / "log", "x") as log:
        apart = compare(machines, {name: find_tuner(name, 2) for name in names}, seed=3, log=log, pool=pool, trials=2)
        assert sorted(log.done) == list(range(3 * len(machines)))
    assert apart == whole


# --- machines of several axes -------------------------------------------------------------------------------------
@pytest.mark.every(8)
@pytest.mark.parametrize("load", ["gantry", pytest.param("robot", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "name", ["factory", "baseline", "simc", pytest.param("auto", marks=pytest.mark.slow), "random", "tpe-safe"]
)
def test_machines_of_several_axes_are_tuned_by_everybody(load, name):
    machines = [m for m in load_suite() if m.load == load][:1]
    (row,) = compare(machines, {name: find_tuner(name)}).rows
    axes = {"gantry": 2, "robot": 6}[load]
    assert not row.failed, row.note
    assert 0.0 < row.relative < 100.0
    assert row.violations == 0 or name in ("random", "factory"), row.kinds
    if name == "baseline":
        assert row.moves == 2 * axes
    if name == "auto":
        assert row.drive_seconds < 10.0 * axes
    if name not in ("factory", "baseline"):
        assert 5 * axes <= row.moves <= 100 * axes


# --- the registry -------------------------------------------------------------------------------------------------
def test_the_tuners_of_the_issue_are_there():
    names = set(tuner_rows())
    assert {"factory", "baseline", "auto", "random", "grid", "tpe", "cmaes", "gp"} <= names
    from tuning.rules.rules_by_name import RULES

    assert set(RULES) <= names


@pytest.mark.slow
def test_the_factory_leaves_and_the_baseline_rule_computes():
    found = compare(RIGID, {name: find_tuner(name) for name in ("factory", "baseline")})
    assert {row.gains["velocity_p"] for row in found.of("factory")} == {445}
    assert all(row.moves == 2 for row in found.of("baseline"))


@pytest.mark.slow
def test_searches_come_near_the_optimum_and_the_safe_one_is_stopped_less():
    names = {"tpe": False, "tpe-safe": True}
    found = compare(RIGID, {name: find_tuner(name) for name in names})
    by_name = {row.tuner: row for row in found.tuners}
    assert by_name["tpe"].median < 6.0 and by_name["tpe-safe"].median < 6.0  # of the machine's own optimum
    assert by_name["tpe-safe"].aborts < by_name["tpe"].aborts


@pytest.mark.slow
def test_a_rule_identifies_once_for_all_rules(monkeypatch):
    calls = []
    real = compare_module.identify_all
    monkeypatch.setattr(compare_module, "identify_all", lambda target: calls.append(1) or real(target))
    found = compare(RIGID[:1], {name: find_tuner(name) for name in ("simc", "modulus_optimum")})
    assert calls == [1]
    simc, modulus = found.of("simc")[0], found.of("modulus_optimum")[0]
    assert simc.drive_seconds == modulus.drive_seconds > 1.0
    assert simc.gains["velocity_i"] != modulus.gains["velocity_i"]
    assert not simc.failed and simc.relative < 10.0


class Entry:
    """An entry point of a package that somebody has installed."""

    def __init__(self, name, load, dist="others-agents"):
        self.name, self.value, self._load = name, "somewhere:tune", load
        self.dist = type("Distribution", (), {"name": dist})()

    def load(self):
        return self._load()


def register(monkeypatch, *entries):
    def entry_points(*, group):
        return list(entries) if group == "drive_env.tuners" else []

    monkeypatch.setattr(importlib.metadata, "entry_points", entry_points)


@pytest.mark.slow
def test_whatever_registers_is_compared(monkeypatch):
    register(monkeypatch, Entry("agent", knows_the_truth))
    assert tuner_rows()["agent"].meaning == "from others-agents"
    found = compare(RIGID, {"agent": find_tuner("agent")})
    assert found.tuners[0].median == pytest.approx(1.0)


def test_a_registered_tuner_that_cannot_be_loaded_is_said(monkeypatch):
    def missing():
        raise ImportError("no module named onnx")

    register(monkeypatch, Entry("agent", missing), Entry("number", lambda: 3))
    with pytest.raises(MissingTunerError, match=r"'agent' of somewhere:tune cannot be loaded: no module named onnx"):
        find_tuner("agent")
    with pytest.raises(MissingTunerError, match=r"'number' of somewhere:tune is not a function but 3"):
        find_tuner("number")


def test_a_registered_name_that_is_taken_is_refused(monkeypatch):
    register(monkeypatch, Entry("tpe", lambda: knows_the_truth))
    with pytest.raises(
        MissingTunerError, match=r"others-agents registers a tuner 'tpe', and there is one of that name"
    ):
        tuner_rows()


def test_unknown_and_incomplete_tuners_are_named_with_the_remedy(monkeypatch):
    with pytest.raises(MissingTunerError, match=r"no tuner is named 'luck'; there are factory, baseline"):
        find_tuner("luck")

    def missing(sampler):
        raise ValueError("the sampler 'gp' needs torch: pip install torch")

    monkeypatch.setattr(tuners, "check_installed", missing)
    with pytest.raises(MissingTunerError, match=r"pip install torch"):
        find_tuner("gp")


# --- files and the command ----------------------------------------------------------------------------------------
@pytest.mark.slow
def test_the_files_say_what_the_comparison_says(tmp_path):
    found = compare(RIGID, {"slow": moves_and_slows, "broken": breaks})
    save(found, tmp_path, {"suite": "public", "tuners": ["slow", "broken"], "seed": 0, "count": None})
    machines = list(csv.DictReader((tmp_path / "machines.csv").open(encoding="utf-8")))
    assert [row["machine"] for row in machines] == [m.name for m in RIGID] * 2
    assert [float(row["relative"]) for row in machines] == pytest.approx([row.relative for row in found.rows], rel=1e-5)
    summaries = list(csv.DictReader((tmp_path / "tuners.csv").open(encoding="utf-8")))
    assert {row["tuner"] for row in summaries} == {"slow", "broken"}
    assert (tmp_path / "comparison.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "settings.toml").read_text() == 'suite = "public"\ntuners = ["slow", "broken"]\nseed = 0\n'


@pytest.mark.slow
def test_the_command_prints_the_table_and_writes_the_folder(tmp_path):
    folder = tmp_path / "out"
    result = drive_tune("rank", "-t", "factory", "-t", "baseline", "--count", 3, "--out", folder)
    assert result.exit_code == 0
    assert "Robust performance over the constrained oracle's on 3 machines" in result.output
    names = {path.name for path in folder.iterdir()}
    assert names == {"tuners.csv", "rivals.csv", "machines.csv", "comparison.png", "settings.toml"}
    told = drive_tune("rank", "-t", "baseline", "--count", 3, "--json", "--out", tmp_path / "again")
    first = list(csv.DictReader((folder / "tuners.csv").open(encoding="utf-8")))
    (row,) = json.loads(told.stdout)["tuners"]
    assert f"{row['median']:.6g}" == next(line["median"] for line in first if line["tuner"] == "baseline")


def test_the_command_searches_the_oracles_of_other_dynamics_and_says_so(tmp_path, monkeypatch):
    kept, asked = read_oracles()[digest(RIGID[0])], []

    def search(machine, num_threads, dynamics):
        asked.append((machine.name, dynamics))
        return kept

    monkeypatch.setattr("tuning.compare.oracle.search_oracle", search)
    result = drive_tune("rank", "-t", "factory", "--count", 1, "--dynamics", "soft", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "no oracles for soft dynamics are kept; they are searched first" in result.stderr
    assert "on 1 machines, soft dynamics" in result.stdout
    assert len(asked) == 1 and asked[0][1] == "soft"
    assert 'dynamics = "soft"' in (tmp_path / "out" / "settings.toml").read_text()


def test_a_run_that_is_interrupted_prints_the_figures_it_has(monkeypatch, tmp_path):
    """Two loads: the second is never done."""
    calls = []

    def stops(target, rng):
        calls.append(target.machine)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return outcome(target, read_gains(target.drives))

    register(monkeypatch, Entry("stops", lambda: stops))
    result = drive_tune("rank", "-t", "stops", "--count", 2, "--out", tmp_path / "out")
    assert result.exit_code == 130
    assert "interrupted: of 2 machines these are done" in result.stdout
    assert "Robust performance over the constrained oracle's on 1 machine" in result.stdout
    assert "--resume" in result.stderr


def test_the_command_lists_tuners_and_suites():
    output = drive_tune("rank", "--list").output
    assert "cmaes" in output and "public" in output and "51 machines" in output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("rank", "-t", "luck"), "no tuner is named 'luck'"),
        (("rank", "--suite", "secret"), "no suite is named 'secret'"),
        (("rank", "--count", "0"), "count must be 1 or more"),
        (("rank", "--dynamics", "harsh"), "dynamics 'harsh': give soft, standard, stiff"),
        (("rank", "--seed", "-1"), "--seed must be 0 or more, not -1"),
        (("auto", "--by", "cmaes", "--objective", "speed", "--objective", "current"), "CMA-ES has one"),
        (("auto", "--by", "tpe", "--machines", "0"), "--machines must be 1 or more"),
        (("auto", "--by", "tpe", "--load", "pendulum"), "no load is named 'pendulum'"),
        (("auto", "--by", "tpe", "--bus"), "--travel is missing"),
        (
            ("auto", "--by", "tpe", "--bus", "--travel", "-1:1"),
            "will turn. Is its way clear? There is no terminal to ask",
        ),
        (("auto", "--config", "nosuch.toml"), "cannot read nosuch.toml"),
        (("auto", "--by", "tpe", "--cluster", "here"), "--cluster here must be the address of a Dask scheduler"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(arguments, message, tmp_path):
    result = drive_tune(*arguments, "--out", tmp_path / "out")
    assert result.exit_code == 2
    lines = [line for line in result.stderr.splitlines() if line.startswith("drive-tune: ")]
    assert len(lines) == 1 and message in lines[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_optimise_prints_and_writes_what_it_found(tmp_path):
    folder = tmp_path / "out"
    search = ("auto", "--by", "tpe", "--load", "inertia", "--trials", 6, "--machines", 3, "--safe")
    result = drive_tune(*search, "--out", folder)
    assert result.exit_code == 0, result.output
    assert "6 trials" in result.output and "safe start" in result.output
    rows = list(csv.DictReader((folder / "trials.csv").open(encoding="utf-8")))
    assert [int(row["trial"]) for row in rows] == list(range(6))
    assert (folder / "trials.png").read_bytes().startswith(b"\x89PNG")
    assert "safe = true" in (folder / "settings.toml").read_text()
    told = json.loads(drive_tune(*search, "--json", "--out", tmp_path / "b").stdout)["search"]
    best = min((row for row in rows if row["stopped"] == "False"), key=lambda row: float(row["J"]))
    assert told["gains"][0][2:] == [int(best[name]) for name in ("velocity_p", "velocity_i", "position_p")]


@pytest.mark.slow
def test_a_search_repeats_from_its_settings_and_what_is_said_besides_takes_their_place(tmp_path):
    first, again, other = tmp_path / "first", tmp_path / "again", tmp_path / "other"
    options = ("--searches", 2, "--machines", 2, "--load", "gantry", "--travel=-1:1,-0.5:0.5", "--seed", 5, "--gain",
               "velocity_p", "--objective", "speed", "--objective", "current", "--width", 1.2)  # fmt: skip
    assert drive_tune("auto", "--by", "tpe", "--trials", 3, *options, "--out", first).exit_code == 0
    settings = first / "settings.toml"
    assert drive_tune("auto", "--config", settings, "--out", again).exit_code == 0
    for name in ("trials.csv", "settings.toml", "trials.png"):
        assert (first / name).read_bytes() == (again / name).read_bytes()
    assert drive_tune("auto", "--config", settings, "--trials", 1, "--out", other).exit_code == 0
    changed = tomllib.loads((other / "settings.toml").read_text(encoding="utf-8"))
    assert changed == tomllib.loads(settings.read_text(encoding="utf-8")) | {"trials": 1}


def test_the_picture_shows_the_trials_of_every_search():
    rows = [row(search, number, cost) for search, cost in ((0, 2.0), (1, 1.0)) for number in range(3)]
    found = Optimised(np.ones((2, 5), int), np.ones((2, 5), int), np.array([2.0, 1.0]), tuple(rows), 0.0,
                      np.zeros(2, int), np.zeros(2, int), ("", ""), 0.01, 0, np.zeros((2, 2, 3)))  # fmt: skip
    axes = trials_figure(found, Settings(), "tmcm1636").axes[0]
    assert len(axes.collections[0].get_offsets()) == 6
    assert [line.get_ydata().tolist() for line in axes.lines] == pytest.approx(np.exp([[2.0] * 3, [1.0] * 3]))


def test_the_best_so_far_is_of_accepted_trials_alone():
    """A trial that was stopped, or after which the axis went on shaking, is no gain, however little it cost."""
    rows = (
        row(0, 0, -1.0, aborted=True),
        row(0, 1, 2.0),
        row(0, 2, 0.5, fragile=True),
        row(0, 3, 1.0),
        row(0, 4, -2.0, aborted=True),
    )
    (line,) = trials_figure(searched(rows), Settings(), "tmcm1636").axes[0].lines
    np.testing.assert_allclose(line.get_ydata(), [np.nan, *np.exp([2.0, 2.0, 1.0, 1.0])])


def test_the_front_is_of_accepted_trials_and_its_axes_have_units():
    """The search's own objectives are logarithms: of the settling time over t_0, and of a ratio."""
    rows = (
        row(0, 0, 0.0, objectives=(np.log(2.0), np.log(3.0), 4.0)),
        row(0, 1, 0.0, objectives=(0.0, np.log(5.0), 4.0)),
        row(0, 2, -1.0, objectives=(-1.0, 0.0, 1.0), aborted=True),
    )
    axes = trials_figure(searched(rows), Settings(objectives=("speed", "robustness")), "tmcm1636").axes[0]
    (front,) = axes.lines
    np.testing.assert_allclose(sorted(front.get_xydata().tolist()), [[10.0, 5.0], [20.0, 3.0]])  # t_0 is 10 ms
    assert axes.get_xlabel() == "settling time, the slower of move and reversal [ms]"
    assert axes.get_ylabel() == "J of the worst phase over that of the moves"


def searched(rows):
    """Return what a search of one machine has found, with a t_0 of 10 ms."""
    none = np.zeros(1, int)
    return Optimised(
        np.ones((1, 5), int),
        np.ones((1, 5), int),
        np.ones(1),
        rows,
        0.0,
        none,
        none,
        ("",),
        0.01,
        0,
        np.zeros((1, 2, 3)),
    )


def row(search, number, cost, *, objectives=(0.0, 0.0, 0.0), aborted=False, fragile=False):
    return TrialRow(search, number, np.ones((1, 5), int), cost, objectives, aborted, fragile)
