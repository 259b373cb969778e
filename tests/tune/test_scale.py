"""Work on processes and on a cluster, stopped and resumed: the digits of one process that was never stopped."""

from __future__ import annotations

import importlib
import logging
import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from rigs.shards import GRID, PATIENCE, contents, environment, run_command, start_and_wait_for_a_shard

from tuning.runs import pools, provenance, sweep
from tuning.runs.experiment import load_experiment, resolve
from tuning.runs.pools import PoolError, in_order, open_pool, parse_cluster
from tuning.runs.shard_log import ShardLog, ShardLogError
from tuning.runs.sweep_files import save_sweep
from tuning.runs.unfinished import shard_log


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("scale") / "grid.toml"
    path.write_text(GRID, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def experiment(config):
    return load_experiment(config)


@pytest.fixture(scope="module")
def whole(experiment):
    """The sweep in one process, never stopped."""
    return sweep.run(experiment)


@pytest.fixture(scope="module")
def saved(whole, tmp_path_factory):
    """Its files, as bytes."""
    return contents(save_sweep(whole, tmp_path_factory.mktemp("saved") / "run"))


def equal(one, other):
    for name, column in one.columns.items():
        np.testing.assert_array_equal(other.columns[name], column, err_msg=name)
    np.testing.assert_array_equal(other.response.speed_rpm, one.response.speed_rpm)


def square(item):
    return item * item


def fails(item):
    raise ValueError(f"no {item}")


def dies(item):
    os._exit(9)


# --- shards -------------------------------------------------------------------------------------------------------
def test_shards_are_the_grid_without_gap_or_overlap_whatever_runs_them(experiment):
    parts = sweep.shards(experiment)
    assert len(parts) == 3
    edges = [(part.first, part.last) for part in parts]
    assert edges[0][0] == 0 and edges[-1][1] == experiment.size() == 2304
    assert all(left[1] == right[0] for left, right in pairwise(edges))
    assert edges == [(part.first, part.last) for part in sweep.shards(experiment, num_threads=7)]


@pytest.mark.parametrize(("width", "size"), [
    (1, 1024), (2, 256), (4, 128), (9, 64),
    (800, 64),  # a packed model is not taken apart
])  # fmt: skip
def test_many_workers_get_smaller_shards_of_whole_models(experiment, width, size):
    parts = sweep.shards(experiment, width=width)
    assert [part.first for part in parts] == list(range(0, 2304, size))
    assert all(part.last == min(part.first + size, 2304) for part in parts)


def test_a_run_goes_on_between_what_another_width_has_done(experiment):
    left = sweep.shards(experiment, width=2, done={0: 576, 1024: 1088})
    edges = [(part.first, part.last) for part in left]
    assert edges == [(576, 832), (832, 1024), (1088, 1344), (1344, 1600), (1600, 1856), (1856, 2112), (2112, 2304)]


@pytest.mark.slow
def test_any_cut_gives_the_digits_of_any_other(experiment, whole, tmp_path):
    class Wide:
        width, shares_disk = 9, True

        def unordered(self, function, items, say=None, fits=None):
            return iter([(k, function(item)) for k, item in enumerate(items)])

    with ShardLog(tmp_path / "shards", "x") as log:
        log.append(576, sweep.simulate(sweep.Shard(experiment, 576, 1152, 1)))
        equal(whole, sweep.run(experiment, pool=Wide(), log=log))
        assert sorted(log.done) == [*range(0, 640, 64), *range(1152, 2304, 64)]


@pytest.mark.slow
def test_only_what_is_not_done_is_simulated(experiment, whole, tmp_path, monkeypatch):
    with ShardLog(tmp_path / "shards", "x") as log:
        sweep.run(experiment, log=log)
        kept = dict(log.done)
    assert sorted(kept) == [0, 1024, 2048]
    simulated = []
    truly = sweep.simulate
    monkeypatch.setattr(sweep, "simulate", lambda shard, *rest: simulated.append(shard.first) or truly(shard, *rest))
    with ShardLog(tmp_path / "some", "x") as log:
        log.append(1024, kept[1024])
        result = sweep.run(experiment, log=log)
    assert sorted(simulated) == [0, 2048]
    equal(whole, result)
    assert result.simulated == pytest.approx(0.1 * (1024 + 256))


# --- the file of results ------------------------------------------------------------------------------------------
def frames(path, count=3):
    with ShardLog(path, "run") as log:
        for k in range(count):
            log.append(k, {"x": np.arange(4.0) + k, "flag": np.array([True, k == 1])})


def test_what_was_appended_reads_back_to_the_last_bit(tmp_path):
    values = np.array([np.nan, np.inf, -0.0, 1e-310, np.pi])
    with ShardLog(tmp_path / "log", "run") as log:
        log.append(5, {"x": values, "n": np.array([2**53 + 1])})
    with ShardLog(tmp_path / "log", "run") as log:
        assert list(log.done) == [5]
        assert log.done[5]["x"].tobytes() == values.tobytes()
        assert log.done[5]["n"].tolist() == [2**53 + 1]


def test_a_file_cut_off_anywhere_holds_the_frames_before_and_goes_on(tmp_path):
    frames(tmp_path / "whole")
    whole = (tmp_path / "whole").read_bytes()
    ends = []  # of the first line and of each frame
    for k in range(4):
        frames(tmp_path / f"first {k}", k)
        ends.append((tmp_path / f"first {k}").stat().st_size)
    assert ends[-1] == len(whole)
    path = tmp_path / "cut"
    for cut in [*range(0, len(whole), 7), *ends, *(end - 1 for end in ends)]:
        path.write_bytes(whole[:cut])
        with ShardLog(path, "run") as log:
            complete = sum(end <= cut for end in ends[1:])
            assert sorted(log.done) == list(range(complete)), cut
            for k in range(complete, 3):
                log.append(k, {"x": np.arange(4.0) + k, "flag": np.array([True, k == 1])})
        assert path.read_bytes() == whole, cut


def test_a_frame_with_a_flipped_bit_and_what_follows_it_are_done_again(tmp_path):
    frames(tmp_path / "log")
    data = bytearray((tmp_path / "log").read_bytes())
    frames(tmp_path / "first", 1)
    data[(tmp_path / "first").stat().st_size + 300] ^= 4  # in the second frame
    (tmp_path / "log").write_bytes(data)
    with ShardLog(tmp_path / "log", "run") as log, ShardLog(tmp_path / "first", "run") as first:
        assert sorted(log.done) == [0]
        for each in (log, first):
            each.append(7, {"x": np.zeros(1)})  # shorter than what lay there
    assert (tmp_path / "log").read_bytes() == (tmp_path / "first").read_bytes()


def test_results_of_another_run_are_not_taken(tmp_path):
    frames(tmp_path / "log")
    with pytest.raises(ShardLogError, match="holds results of another experiment"):
        ShardLog(tmp_path / "log", "another run")


def test_an_unfinished_run_is_not_overwritten_and_one_without_results_leaves_nothing(tmp_path):
    with shard_log(tmp_path / "run", "a = 1\n", resume=False) as log:
        log.append(0, {"x": np.zeros(1)})
    with pytest.raises(ShardLogError, match=r"run\.unfinished holds an unfinished run; continue it with --resume"), \
            shard_log(tmp_path / "run", "a = 1\n", resume=False):  # fmt: skip
        pass
    with shard_log(tmp_path / "run", "a = 1\n", resume=True) as log:
        assert list(log.done) == [0]
    with shard_log(tmp_path / "other", "a = 1\n", resume=True):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["run.unfinished"]


# --- pools --------------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("workers", [None, 2])
def test_a_pool_gives_every_result_with_its_number(workers):
    with open_pool(workers) as pool:
        assert in_order(pool, square, range(20)) == [k * k for k in range(20)]
        assert dict(pool.unordered(square, [7, 7, 8])) == {0: 49, 1: 49, 2: 64}
        with pytest.raises(ValueError, match="no 3"):
            in_order(pool, fails, [3])


@pytest.mark.slow
def test_a_worker_that_dies_is_told_with_the_remedy():
    with open_pool(1) as pool, pytest.raises(PoolError, match=r"worker process ended unexpectedly.*--resume"):
        in_order(pool, dies, [1])


@pytest.mark.parametrize(("options", "error", "message"), [
    ({"workers": 0}, ValueError, "--workers 0 is below 1"),
    ({"workers": 1, "cluster": "tcp://127.0.0.1:1"}, ValueError, "choose one"),
    ({"cluster": "tcp://127.0.0.1:1"}, PoolError, r"no Dask scheduler answers at tcp://127\.0\.0\.1:1"),
    ({"cluster": "nonsense"}, ValueError, "--cluster nonsense must be the address of a Dask scheduler, as "
                                          "tcp://host:port"),
])  # fmt: skip
def test_a_pool_that_cannot_be_says_why(options, error, message, monkeypatch):
    monkeypatch.setattr("tuning.runs.pools.CONNECT_TIMEOUT", 0.5)
    with pytest.raises(error, match=message), open_pool(**options):
        pass


@pytest.mark.slow
def test_worker_processes_give_the_digits_of_one_process_and_go_on_from_what_is_done(experiment, whole, tmp_path):
    first = sweep.simulate(sweep.shards(experiment)[0])
    with open_pool(2) as pool, ShardLog(tmp_path / "shards", "x") as log:
        log.append(0, first)
        equal(whole, sweep.run(experiment, pool=pool, log=log))
        assert sorted(log.done) == [0, *range(1024, 2304, 256)]


@pytest.mark.slow
def test_a_cluster_that_loses_one_of_two_workers_gives_the_digits_of_one_process(experiment, whole, saved, tmp_path):
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "dashboard_address": "127.0.0.1:0"}
    with distributed.LocalCluster(host="127.0.0.1", silence_logs="CRITICAL", **options) as cluster:
        address = cluster.scheduler_address
        with distributed.Client(address, set_as_default=False) as client:
            workers = client.run(os.getpid)
            assert len(workers) == 2
            victim = next(iter(workers.values()))
            killed = []

            def kill_once(what, share):
                if 0.0 < share < 1.0 and not killed:  # one shard is done, the others are not
                    os.kill(victim, signal.SIGKILL)
                    killed.append(share)

            with open_pool(cluster=address) as pool, ShardLog(tmp_path / "shards", "x") as log:
                assert pool.differences() == []
                result = sweep.run(experiment, kill_once, pool=pool, log=log)
            assert killed
            with pytest.raises(ProcessLookupError):
                os.kill(victim, 0)
    assert sorted(log.done) == list(range(0, 2304, 256))
    equal(whole, result)
    assert contents(save_sweep(result, tmp_path / "run")) == saved


@pytest.fixture
def small_cluster():
    distributed = pytest.importorskip("distributed")
    options = {
        "n_workers": 1,
        "threads_per_worker": 1,
        "processes": False,
        "protocol": "tcp://",
        "dashboard_address": "127.0.0.1:0",
    }
    with distributed.LocalCluster(host="127.0.0.1", silence_logs="CRITICAL", **options) as cluster:
        yield cluster


@pytest.mark.slow
def test_a_scheduler_that_goes_is_told_with_the_remedy(small_cluster):
    address = small_cluster.scheduler_address
    with (
        pytest.raises(PoolError, match=rf"connection to the Dask scheduler at {address} was lost.*--resume"),
        open_pool(cluster=address) as pool,
    ):
        for _ in pool.unordered(time.sleep, [0.0, PATIENCE]):
            small_cluster.close(timeout=PATIENCE)


def test_what_dask_says_itself_of_a_lost_connection_is_not_shown(small_cluster, capfd):
    level = logging.getLogger("distributed.client").level
    with open_pool(cluster=small_cluster.scheduler_address):
        logging.getLogger("distributed.client").error("Traceback (most recent call last)")
    assert capfd.readouterr().err == ""
    assert logging.getLogger("distributed.client").level == level


def test_a_cluster_without_workers_is_told_and_waited_for(small_cluster, monkeypatch, caplog):
    monkeypatch.setattr(pools, "WORKERS_PERIOD", 0.05)
    with open_pool(cluster=small_cluster.scheduler_address) as pool:
        small_cluster.scale(0)
        deadline = time.monotonic() + PATIENCE
        waited = []
        results = pool.unordered(square, [3, 4], waited.append)

        def scale_up_once_told():
            while "has no workers left; waiting for one: `dask worker tcp://" not in caplog.text:
                assert time.monotonic() < deadline
                time.sleep(0.01)
            small_cluster.scale(1)

        with ThreadPoolExecutor(1) as executor:
            told = executor.submit(scale_up_once_told)
            assert sorted(results) == [(0, 9), (1, 16)]
            told.result(PATIENCE)
    assert caplog.text.count("has no workers left") == 1
    assert waited[0] == pools.FIRST_RESULT
    assert any(text.startswith("waiting for a worker: `dask worker tcp://") for text in waited)
    assert waited[-1] == ""


# A worker of another computer, on which drive-env is not installed.
BARE_WORKER = """
import sys
sys.modules["tuning"] = None
from distributed.cli.dask_worker import main
main()
"""


@contextmanager
def cluster_with(program):
    """Give a cluster whose one worker is a process with a program of its own."""
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 0, "protocol": "tcp://", "dashboard_address": "127.0.0.1:0"}
    with distributed.LocalCluster(host="127.0.0.1", silence_logs="CRITICAL", **options) as cluster:
        address = cluster.scheduler_address
        process = subprocess.Popen(
            [sys.executable, "-c", program, address, "--host", "127.0.0.1", "--no-nanny", "--no-dashboard"],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment(),
        )  # fmt: skip
        try:
            with distributed.Client(address, set_as_default=False) as client:
                client.wait_for_workers(1, timeout=PATIENCE)
            yield cluster
        finally:
            process.kill()
            process.wait()


@pytest.fixture
def bare_cluster():
    with cluster_with(BARE_WORKER) as cluster:
        yield cluster


@pytest.mark.slow
def test_a_worker_without_the_package_is_told_before_and_when_it_joins_late(bare_cluster):
    told = (
        r" of the cluster at tcp://.* cannot run this: .*tuning.*; install drive-env where it runs, and continue with"
    )
    with open_pool(cluster=bare_cluster.scheduler_address) as pool:
        with pytest.raises(PoolError, match=rf"^worker tcp://127\.0\.0\.1:\d+{told}"):
            pool.differences()
        with pytest.raises(PoolError, match=f"^a worker{told}"):
            in_order(pool, square, [3])


# A worker whose packages are ours and whose answers are not.
LYING_WORKER = """
from tuning.runs import pools, provenance
honest, versions = pools._checked, provenance.versions
{lie}
from distributed.cli.dask_worker import main
main()
"""
NO_RESULT = r"which is no result of its work and is not used: start it again with the same files installed"


@pytest.mark.every(3)
@pytest.mark.parametrize(("lie", "told"), [
    ("pools._checked = lambda *_: None", "nothing"),
    ("pools._checked = lambda *_: {'score': 1.0}", "a value of type dict"),
    ("pools._checked = lambda sources, work: honest(sources, work)._replace(work='other')", "a result of other work"),
])  # fmt: skip
def test_a_worker_of_a_cluster_that_gives_back_what_is_no_result_is_refused_by_its_address(lie, told):
    with cluster_with(LYING_WORKER.format(lie=lie)) as cluster, open_pool(cluster=cluster.scheduler_address) as pool:
        assert pool.differences() == []
        with pytest.raises(PoolError, match=rf"^worker tcp://127\.0\.0\.1:\d+ gave back {told}, {NO_RESULT}"):
            in_order(pool, abs, [-3])


@pytest.mark.slow
def test_a_worker_of_another_numpy_that_is_not_there_at_first_is_named_once(caplog):
    lie = "provenance.versions = lambda: versions() | {'numpy': '0.9'}"
    with cluster_with(LYING_WORKER.format(lie=lie)) as cluster, open_pool(cluster=cluster.scheduler_address) as pool:
        assert in_order(pool, abs, [-3, 4]) == [3, 4]
        assert pool.differences() == []  # told already
    assert len(re.findall(r"worker tcp://\S+ has numpy 0\.9, here it is .*: last digits may differ", caplog.text)) == 1


@pytest.mark.parametrize(("change", "told"), [
    (lambda answer: None, "nothing"),
    (lambda answer: 9, "a value of type int"),
    (lambda answer: answer._replace(versions={"sources": "fedcba9876543210"}), "a result of sources fedcba9876543210"),
    (lambda answer: answer._replace(versions={}), "a result of sources unknown"),
    (lambda answer: answer._replace(work="0" * 64), "a result of other work"),
    (lambda answer: answer._replace(content=answer.content + b"x"), "a result whose content does not match its hash"),
])  # fmt: skip
def test_an_answer_that_is_none_of_the_work_is_refused(change, told):
    work = pickle.dumps((square, 3))
    answer = pools._checked(provenance.SOURCES, work)
    assert pools._result_of(answer, work, lambda result: result == 9, "a worker", "try again") == 9
    with pytest.raises(PoolError, match=f"^a worker gave back {told}, {NO_RESULT} as here, and try again"):
        pools._result_of(change(answer), work, lambda result: True, "a worker", "try again")


def test_a_result_of_another_form_is_refused_whatever_it_is():
    work = pickle.dumps((square, 3))
    for fits in (lambda result: False, lambda result: result["score"] > 0):
        with pytest.raises(PoolError, match=r"gave back a result of another form \(int\)"):
            pools._result_of(pools._checked(provenance.SOURCES, work), work, fits, "a worker", "try again")


@pytest.mark.parametrize("change", [
    lambda arrays: arrays | {"score": arrays["score"][:-1]},
    lambda arrays: arrays | {"score": arrays["score"][:, None]},
    lambda arrays: arrays | {"score": arrays["score"].astype(str)},
    lambda arrays: {name: values for name, values in arrays.items() if name != "fault"},
    lambda arrays: arrays | {"more": arrays["score"]},
    lambda arrays: {},
    lambda arrays: None,
])  # fmt: skip
def test_what_is_not_of_a_shard_is_not_taken_for_it(experiment, change):
    names = [*sweep._column_names(resolve(experiment)), *(f"best.{name}" for name in sweep._recorded(experiment))]
    arrays = {name: np.zeros(64) for name in names}
    shard = sweep.Shard(experiment, 64, 128, 1)
    assert sweep._is_of(shard, arrays)
    work = b"work"
    answer = pools._Answer(pools._sha256(work), provenance.versions(), (content := pickle.dumps(change(arrays))),
                           pools._sha256(content))  # fmt: skip
    with pytest.raises(PoolError, match="a result of another form"):
        pools._result_of(answer, work, lambda result: sweep._is_of(shard, result), "a worker", "try again")


def test_sources_are_compared_before_the_work_is_opened(monkeypatch):
    """What other sources do not know cannot be unpickled there: they are told, and no traceback."""
    monkeypatch.setattr(provenance, "SOURCES", "0123456789abcdef")
    with pytest.raises(PoolError, match="worker has sources 0123456789abcdef, the run was begun with fedcba9876543210"):
        pools._checked("fedcba9876543210", b"no pickle")


def test_workers_of_another_version_are_told():
    class Client:
        def run(self, function, call, on_error):
            here = function(call)
            return {"tcp://a:1": here, "tcp://b:2": here | {"numpy": "0.9"}}

    (line,) = pools._Dask(Client(), 2).differences()
    assert line == f"worker tcp://b:2 has numpy 0.9, here it is {np.__version__}: last digits may differ"


# --- the sources --------------------------------------------------------------------------------------------------
def test_the_hash_of_the_sources_covers_every_file_that_decides_a_digit(tmp_path):
    package = tmp_path / "package"
    (package / "presets").mkdir(parents=True)
    (package / "loops.py").write_text("gain = 1\n")
    (package / "presets" / "motor.toml").write_text("poles = 4\n")
    first = provenance.hash_of_sources([package])
    for left_behind in ("__pycache__", ".cache"):
        (package / left_behind).mkdir()
        (package / left_behind / "loops.cpython-311.pyc").write_bytes(b"1")
    (package / ".loops.py.swp").write_text("x")
    assert provenance.hash_of_sources([package]) == first
    seen = {first}
    for path, text in [("loops.py", "gain = 2\n"), ("presets/motor.toml", "poles = 8\n"), ("new.json", "")]:
        (package / path).write_text(text)
        seen.add(provenance.hash_of_sources([package]))
    (package / "new.json").rename(package / "other.json")
    seen.add(provenance.hash_of_sources([package]))
    assert len(seen) == 5


def test_the_hash_of_the_sources_is_that_of_the_packages_that_are_loaded():
    packages = [
        Path(importlib.import_module(name).__file__).parent for name in ("drive_env", "mechanics", "tuning", "agents")
    ]
    assert provenance.hash_of_sources(packages) == provenance.SOURCES
    for package in packages:
        assert provenance.hash_of_sources(one for one in packages if one != package) != provenance.SOURCES


def test_worker_processes_of_other_sources_are_refused_with_both_hashes(monkeypatch):
    here = provenance.SOURCES
    monkeypatch.setattr(provenance, "SOURCES", "0123456789abcdef")
    with open_pool(1) as pool, pytest.raises(
        PoolError, match=f"worker has sources {here}, the run was begun with 0123456789abcdef.*--resume"
    ):  # fmt: skip
        in_order(pool, square, [1])


def test_a_worker_whose_files_were_edited_since_it_began_is_refused(monkeypatch):
    monkeypatch.setattr(provenance, "hash_of_sources", lambda: "fedcba9876543210")
    with pytest.raises(PoolError, match=f"sources fedcba9876543210, the run was begun with {provenance.SOURCES}"):
        pools._checked(provenance.SOURCES, pickle.dumps((square, 1)))
    assert pools._versions()["sources"] == "fedcba9876543210"


def test_a_worker_of_other_sources_that_joins_a_cluster_late_is_refused(small_cluster, monkeypatch):
    with open_pool(cluster=small_cluster.scheduler_address) as pool:
        assert pool.differences() == []
        assert in_order(pool, square, [3]) == [9]
        # It runs in this process: what it finds from now on are other files.
        monkeypatch.setattr(provenance, "hash_of_sources", lambda: "fedcba9876543210")
        with pytest.raises(PoolError, match=f"fedcba9876543210, the run was begun with {provenance.SOURCES}"):
            in_order(pool, square, [4])


def test_a_cluster_with_a_worker_of_other_sources_is_refused():
    class Client:
        def run(self, function, call, on_error):
            here = function(call)
            return {"tcp://a:1": here, "tcp://b:2": here | {"sources": "fedcba9876543210"}}

    with pytest.raises(PoolError, match=rf"worker tcp://b:2 has sources fedcba9876543210, .* {provenance.SOURCES}"):
        pools._Dask(Client(), 2).differences()


def test_results_of_other_sources_are_not_gone_on_with(tmp_path, monkeypatch):
    frames(tmp_path / "log")
    before = (tmp_path / "log").read_bytes()
    here = provenance.SOURCES
    monkeypatch.setattr(provenance, "SOURCES", "0123456789abcdef")
    with pytest.raises(ShardLogError, match=f"results of sources {here}, these are 0123456789abcdef"):
        ShardLog(tmp_path / "log", "run")
    assert (tmp_path / "log").read_bytes() == before


# --- the command --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def long(config, tmp_path_factory):
    """A grid of five shards, and the files of its uninterrupted run."""
    folder = tmp_path_factory.mktemp("long")
    path = folder / "long.toml"
    path.write_text(GRID.replace("count = 48", "count = 66"), encoding="utf-8")
    done = run_command(path, folder / "run")
    assert done.returncode == 0, done.stderr
    return path, contents(folder / "run")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
@pytest.mark.parametrize("more", [
    pytest.param((), id="threads"),
    pytest.param(("--workers", 2), id="workers", marks=pytest.mark.slow),
])  # fmt: skip
def test_a_run_that_is_killed_goes_on_to_the_same_bytes(long, tmp_path, more):
    config, expected = long
    out = tmp_path / "run"
    process = start_and_wait_for_a_shard(config, out, *more)
    process.kill()
    process.communicate()
    assert not out.exists()
    refused = run_command(config, out)
    assert refused.returncode == 2
    assert "run.unfinished holds an unfinished run" in refused.stderr.replace("\n", "")
    done = run_command(config, out, "--resume")
    assert done.returncode == 0, done.stderr
    assert "note: continues a stopped run" in done.stdout
    assert contents(out) == expected
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_an_interrupt_says_what_is_kept_and_the_run_goes_on_from_its_own_settings(long, tmp_path):
    config, expected = long
    out = tmp_path / "run"
    process = start_and_wait_for_a_shard(config, out)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert "the completed part is kept; continue with --out" in errors
    assert "Traceback" not in errors
    done = subprocess.run(
        [sys.executable, "-m", "tuning.commands.cli", "sweep", "--out", str(out), "--resume"],
        env=environment(), capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert contents(out) == expected


@pytest.mark.slow
def test_a_run_is_not_resumed_with_another_experiment(config, tmp_path):
    with shard_log(tmp_path / "run", GRID, resume=False) as log:
        log.append(0, {"x": np.zeros(1)})
    done = run_command(config, tmp_path / "run", "--resume", "--seed", 9)
    assert done.returncode == 2
    assert "another experiment" in done.stderr
    assert done.stderr.startswith("drive-tune: ")


@pytest.mark.slow
@pytest.mark.parametrize(("more", "code", "message"), [
    (("--workers", 0), 2, "--workers 0 is below 1"),
    (("--workers", 1, "--cluster", "tcp://x:1"), 2, "choose one"),
])  # fmt: skip
def test_a_mistake_is_one_line(config, tmp_path, more, code, message):
    done = run_command(config, tmp_path / "run", *more)
    assert (done.returncode, message in done.stderr) == (code, True), done.stderr
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_resume_needs_a_folder():
    done = subprocess.run(
        [sys.executable, "-m", "tuning.commands.cli", "sweep", "--resume"],
        env=environment(), capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.startswith("drive-tune: --resume needs --out")


@pytest.fixture
def certificates(tmp_path):
    """A certificate that vouches for itself, and its key: (folder, the query of an address)."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl, which makes the certificate, is not installed")
    cert, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1", "-subj", "/CN=127.0.0.1",
         "-keyout", str(key), "-out", str(cert)], check=True, capture_output=True,
    )  # fmt: skip
    return cert, key


@pytest.mark.slow
def test_a_cluster_over_tls_takes_certificates(certificates):
    distributed = pytest.importorskip("distributed")
    cert, key = map(str, certificates)
    roles = {f"tls_{role}_{part}": path for role in ("scheduler", "worker", "client")
             for part, path in (("cert", cert), ("key", key))}  # fmt: skip
    security = distributed.Security(require_encryption=True, tls_ca_file=cert, **roles)
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, protocol="tls", host="127.0.0.1",
        dashboard_address="127.0.0.1:0", security=security, silence_logs="CRITICAL",
    ) as cluster:  # fmt: skip
        address = cluster.scheduler_address
        assert address.startswith("tls://")
        with open_pool(cluster=f"{address}?ca={cert}&cert={cert}&key={key}") as pool:
            assert sorted(pool.unordered(abs, [-1, 2, -3])) == [(0, 1), (1, 2), (2, 3)]
        with pytest.raises(PoolError, match="needs certificates: tls://"), open_pool(cluster=address):
            pass


@pytest.mark.parametrize(("text", "says"), [
    ("somewhere", "must be the address of a Dask scheduler, as tcp://host:port, or tls://host:port"),
    ("tcp://host:1?ca=a&cert=b&key=c", "and of other protocols nothing"),
    ("tls://host:1?ca=a", "stand the files ca, cert, key, each with its path"),
    ("tls://host:1?ca=none.pem&cert=none.pem&key=none.pem", "there is no file none.pem, which ca names"),
])  # fmt: skip
def test_what_is_no_address_of_a_cluster_is_told(text, says):
    with pytest.raises(ValueError, match=re.escape(says)):
        parse_cluster(text)
