"""Searches as shards: their seeds, where they run, and how one that was killed goes on, to the same digits."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from rigs import ROOT

from tuning.runs.pools import open_pool
from tuning.runs.shard_log import ShardLog, ShardLogError
from tuning.runs.unfinished import unfinished_folder
from tuning.search import searches
from tuning.search.optimise import Settings, optimise
from tuning.search.trial_bench import TrialBench
from tuning.target import emulated

PATIENCE = 300.0  # s, for a computer that stands still for minutes

MACHINE = {"load": "inertia", "num_machines": 3, "seed": 5}
FEW = Settings(sampler="random", trials=4, seed=7)


def found(parts, pool, path):
    with ShardLog(path, "searches") as log:
        return searches.run(parts, pool, log)


def same(one, other):
    assert one.gains.tolist() == other.gains.tolist() and one.rule.tolist() == other.rule.tolist()
    assert one.cost.tobytes() == other.cost.tobytes()
    assert [row.gains.tolist() for row in one.rows] == [row.gains.tolist() for row in other.rows]
    assert [row[1:2] + row[3:] for row in one.rows] == [row[1:2] + row[3:] for row in other.rows]
    assert (one.drive_seconds, one.notes) == (other.drive_seconds, other.notes)
    assert one.moves.tolist() == other.moves.tolist() and one.aborts.tolist() == other.aborts.tolist()


def test_searches_are_the_search_with_one_seed_after_the_other(tmp_path):
    results = found(searches.searches(MACHINE, FEW, 2), None, tmp_path / "log")
    for k, result in enumerate(results):
        with emulated(**MACHINE) as target:
            alone = optimise(target, replace(FEW, seed=7 + k), shared=True, anew=True)
        assert {row.search for row in result.rows} == {k}
        same(
            result,
            replace(alone, gains=alone.gains[:1], rule=alone.rule[:1], cost=alone.cost[:1], notes=alone.notes[:1]),
        )
    assert results[0].rows[1].gains.tolist() != results[1].rows[1].gains.tolist()
    together = searches.joined(results)
    assert together.gains.tolist() == [result.gains[0].tolist() for result in results]
    assert together.drive_seconds == sum(result.drive_seconds for result in results)
    assert len(together.rows) == 8 and together.cost.shape == (2,)


@pytest.mark.slow
def test_searches_on_workers_and_resumed_are_the_searches_of_one_process(tmp_path):
    parts = searches.searches(MACHINE, FEW, 3)
    whole = found(parts, None, tmp_path / "whole")
    with ShardLog(tmp_path / "whole", "searches") as log, ShardLog(tmp_path / "begun", "searches") as begun:
        begun.append(1, log.done[1])
    with open_pool(2) as pool:
        resumed = found(parts, pool, tmp_path / "begun")
    for one, other in zip(whole, resumed, strict=True):
        same(one, other)


class KilledError(Exception):
    """Raised in place of a kill."""


@pytest.mark.every(12)
@pytest.mark.parametrize("sampler", ["random", "tpe", "cmaes", "grid"])
@pytest.mark.parametrize("safe", [False, True])
def test_a_search_that_was_killed_goes_on_from_its_last_generation(tmp_path, monkeypatch, sampler, safe):
    parts = searches.searches(MACHINE | {"load": "two_mass"}, Settings(sampler, trials=11, seed=3, safe=safe), 1)
    (whole,) = found(parts, None, tmp_path / "whole")
    made = []
    truly = TrialBench.run
    monkeypatch.setattr(TrialBench, "run", lambda bench, *rest: made.append(1) or truly(bench, *rest))

    def killed_after(generations):
        def progress(share):
            if len(made) == generations:
                raise KilledError

        with pytest.raises(KilledError), ShardLog(tmp_path / "log", "searches") as log:
            searches.run(parts, None, log, progress)
        return [path.name for path in tmp_path.glob("part-*")]

    assert killed_after(2) == ["part-0"]
    torn = (tmp_path / "part-0").read_bytes()
    (tmp_path / "part-0").write_bytes(torn[:-100])  # killed while it wrote
    generations = len(made) - 1
    made.clear()
    (resumed,) = found(parts, None, tmp_path / "log")
    same(whole, resumed)
    assert whole.drive_seconds == resumed.drive_seconds > 0.0
    every = math.ceil(11 / MACHINE["num_machines"])
    assert len(made) <= every + safe - generations  # what was done is not done again
    assert not list(tmp_path.glob("part-*"))


def test_workers_keep_what_they_have_and_a_cluster_cannot(tmp_path):
    parts = searches.searches(MACHINE, FEW, 2)
    asked = []

    class Elsewhere:
        width, shares_disk = 1, True

        def unordered(self, function, items, say=None, fits=None):
            asked.extend(items)
            return iter([(k, function(item)) for k, item in enumerate(items)])

    whole = found(parts, None, tmp_path / "whole")
    for shares in (True, False):
        pool = Elsewhere()
        pool.shares_disk = shares
        for one, other in zip(whole, found(parts, pool, tmp_path / f"{shares}"), strict=True):
            same(one, other)
    assert [task.path and task.path.name for task in asked] == ["part-0", "part-1", None, None]
    assert not list(tmp_path.glob("part-*"))


def test_trials_of_another_search_are_not_taken(tmp_path):
    with emulated(**MACHINE) as target, ShardLog(tmp_path / "log", "x") as log:
        optimise(target, FEW, shared=True, anew=True, log=log)
        with pytest.raises(ShardLogError, match="holds trials of another search; remove it"):
            optimise(target, replace(FEW, seed=8), shared=True, anew=True, log=log)
        with pytest.raises(ValueError, match="only if every trial starts from rest, and if it has no journal"):
            optimise(target, FEW, shared=True, log=log)


@pytest.mark.parametrize(("count", "settings", "message"), [
    (0, FEW, "--searches 0 is below 1"),
    (2, replace(FEW, journal=Path("x")), "a journal keeps one search"),
])  # fmt: skip
def test_searches_that_cannot_be_are_refused(count, settings, message):
    with pytest.raises(ValueError, match=message):
        searches.searches(MACHINE, settings, count)


def test_another_seed_trial_or_machine_makes_another_run():
    texts = {
        searches.description(searches.searches(machine, settings, count))
        for machine, settings, count in [
            (MACHINE, FEW, 2), (MACHINE, FEW, 3), (MACHINE | {"seed": 6}, FEW, 2), (MACHINE, replace(FEW, trials=5), 2),
            (MACHINE | {"travel": (-1.0, 1.0)}, FEW, 2), (MACHINE, replace(FEW, safe=True), 2),
        ]
    }  # fmt: skip
    assert len(texts) == 6


# --- the command --------------------------------------------------------------------------------------------------
SEARCH = ("auto", "--by", "tpe", "--load", "inertia", "--trials", 40, "--machines", 2, "--seed", 4)


def begun(*arguments):
    environment = os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "100", "NO_COLOR": "1"}
    return subprocess.Popen(
        [sys.executable, "-m", "tuning.commands.cli", *map(str, arguments)],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def ended(*arguments):
    process = begun(*arguments)
    said = process.communicate(timeout=PATIENCE)
    return process.returncode, *said


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The folder of a search that was never stopped."""
    out = tmp_path_factory.mktemp("search") / "run"
    assert ended(*SEARCH, "--out", out)[0] == 0
    return out


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
@pytest.mark.parametrize("how", ["kill", "interrupt"])
def test_a_single_search_that_is_stopped_goes_on_to_the_same_bytes(undisturbed, tmp_path, how):
    out = tmp_path / "run"
    process = begun(*SEARCH, "--out", out)
    part = unfinished_folder(out) / "part-0"
    deadline = time.monotonic() + PATIENCE
    while not (part.exists() and part.stat().st_size > 10_000):  # a few generations of twenty
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.005)
    process.kill() if how == "kill" else process.send_signal(2)
    _, errors = process.communicate(timeout=PATIENCE)
    assert "Traceback" not in errors
    if how == "interrupt":
        assert process.returncode == 130
        assert f"interrupted; the completed part is kept; continue with --out {out} --resume" in errors.replace(
            "\n", ""
        )
    assert not out.exists()
    code, _, errors = ended(*SEARCH, "--out", out, "--resume")
    assert code == 0, errors
    assert "note: continues a stopped run" in errors
    for name in ("trials.csv", "trials.png", "settings.toml"):
        assert (out / name).read_bytes() == (undisturbed / name).read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
