"""A disk that is full at any file of a run on a bus: the drive has what it had, and the message says where that is."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager, nullcontext
from pathlib import Path

import numpy as np
import pytest
from rigs import TESTS
from rigs.auto_stages import skip_stages
from rigs.served_drives import environment, node, status_is
from typer.testing import CliRunner

from agents.commands.cli import app as drive_agent
from agents.tuner import tuning_run
from drive_env import CanDrives
from drive_env.commands.cli import app as drive_env
from drive_env.devices import find_device
from drive_env.whole_file import files_to_be, write_whole
from tuning.auto import one_button as auto_module
from tuning.auto.stages import RecordedGains
from tuning.commands.cli import app as drive_tune
from tuning.runs import provenance
from tuning.search import trials_files
from tuning.snapshot import load_snapshot

GAIN_OBJECTS = find_device("tmcm1636").gains.keys

SAID = "No space left on device"
SWITCH_ON_DISABLED = (0x4F, 0x40)
NEW = np.array([[1000, 900, 800, 700, 600]])

pytestmark = pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is full")


def full(path):
    """Have the disk be full for a file: its bytes go to a device that takes none."""
    path.with_name(f".{path.name}.partial").symlink_to("/dev/full")


def gains(machine):
    return [int(machine.read(name)[0]) for name in GAIN_OBJECTS]


@pytest.fixture
def quick(monkeypatch):
    """Have auto, and a trained tuner, find gains at once."""
    skip_stages(monkeypatch.setattr, NEW)
    monkeypatch.setattr(tuning_run, "make_trials", lambda bench, basis, policy, show: RecordedGains.only(NEW.copy()))


def tune(by, bus, out):
    return CliRunner().invoke(
        drive_tune, ["auto", "--by", by, "--bus", *bus, "--travel", "-5:5", "--yes", "--out", str(out), "--json"]
    )


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("by", ["design", "agent"])
@pytest.mark.parametrize("file", ["certificate.json", "report.html", "before.toml"])
def test_a_tuning_whose_file_finds_no_room_is_rolled_back_and_says_so(tmp_path, monkeypatch, by, file):
    """before.toml is written twice: before anything is changed, and before the drive is to keep the gains."""
    out = tmp_path / "run"
    collect = auto_module.collect

    def disk_is_full(*arguments):
        assert (out / "before.toml").is_file()
        full(out / file)
        return collect(*arguments)

    monkeypatch.setattr(auto_module, "collect", disk_is_full)
    with node() as (machine, bus):
        before = gains(machine)
        done = tune(by, bus, out)
        assert (done.exit_code, done.stdout.count("{")) == (2, 0), done.output
        said = done.stderr.strip().splitlines()[-1]
        assert f"{out / file}: " in said and SAID in said
        assert f"; the drives have their state from before; if not, drive-tune undo {out / 'before.toml'}" in said
        assert status_is(machine, SWITCH_ON_DISABLED)
        assert gains(machine) == before == [load_snapshot(out / "before.toml").axes[0][key] for key in GAIN_OBJECTS]
        with CanDrives(interface="slcan", channel=bus[3], pace="lockstep", safety=False) as drives:
            drives.reset_node()  # takes what it was told to keep
        assert gains(machine) == before
    assert [path.name for path in out.iterdir()] == ["before.toml"]


@pytest.mark.usefixtures("quick")
def test_no_room_for_the_way_back_changes_nothing(tmp_path, monkeypatch):
    out = tmp_path / "run"
    take = auto_module.Transaction.__enter__

    def disk_is_full(self):
        out.mkdir()
        full(out / "before.toml")
        return take(self)

    monkeypatch.setattr(auto_module.Transaction, "__enter__", disk_is_full)
    with node() as (machine, bus):
        before = gains(machine)
        done = tune("design", bus, out)
        assert (done.exit_code, gains(machine)) == (2, before)
    assert f"{out / 'before.toml'}: the state before cannot be written: {SAID}; choose another place" in done.stderr
    assert list(out.iterdir()) == []


@pytest.mark.usefixtures("quick")
def test_a_drive_that_refuses_to_keep_the_gains_leaves_no_certificate_of_them(tmp_path, monkeypatch):
    from drive_env.fieldbus.errors import BusError
    from tuning.snapshot import Transaction

    def refuses(self, where=None):
        raise BusError("node 1 refused the store")

    monkeypatch.setattr(Transaction, "store", refuses)
    with node() as (machine, bus):
        before = gains(machine)
        done = tune("design", bus, tmp_path / "run")
        assert (done.exit_code, gains(machine)) == (1, before)
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["before.toml"]


@pytest.mark.usefixtures("quick")
def test_with_room_it_keeps_them(tmp_path):
    with node() as (machine, bus):
        done = tune("design", bus, tmp_path / "run")
        assert done.exit_code == 0, done.output
        assert gains(machine) == NEW[0].tolist()
    names = sorted(path.name for path in (tmp_path / "run").iterdir())
    assert names == ["before.toml", "certificate.json", "report.html"]


KILLED = f"""
import os, signal, sys
sys.path.insert(0, {str(TESTS)!r})
import numpy as np
from rigs.auto_stages import skip_stages
from drive_env.programs import drive_tune
from tuning.auto import one_button as auto
skip_stages(setattr, np.array({NEW.tolist()}))
auto.collect = lambda *arguments: os.kill(os.getpid(), signal.SIGKILL)
drive_tune()
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_a_tuning_that_is_killed_before_its_files_are_written_is_undone_by_one_command(tmp_path):
    out = tmp_path / "run"
    with node() as (machine, bus):
        before = gains(machine)
        done = subprocess.run(
            [sys.executable, "-c", KILLED, "auto", "--bus", *bus, "--travel", "-5:5", "--yes", "--out", str(out)],
            cwd=tmp_path, env=environment(), capture_output=True, text=True, timeout=120, check=False,
        )  # fmt: skip
        assert done.returncode == -signal.SIGKILL, done.stderr
        assert gains(machine) == NEW[0].tolist()
        assert [path.name for path in out.iterdir()] == ["before.toml"]
        again = CliRunner().invoke(drive_tune, ["undo", str(out / "before.toml"), "--yes"])
        assert (again.exit_code, gains(machine)) == (0, before), again.output


@pytest.mark.slow
@pytest.mark.parametrize("file", ["trials.csv", "settings.toml", "trials.png"])
def test_a_search_whose_file_finds_no_room_is_rolled_back_and_says_so(tmp_path, monkeypatch, file):
    out, way_back = tmp_path / "searched", tmp_path / "searched" / "before.toml"
    save = trials_files.save

    def disk_is_full(found, settings, folder, *others):
        full(folder / file)
        save(found, settings, folder, *others)

    monkeypatch.setattr(trials_files, "save", disk_is_full)
    with node() as (machine, bus):
        before = gains(machine)
        done = CliRunner().invoke(
            drive_tune,
            ["auto", "--by", "random", "--bus", *bus, "--travel", "-5:5", "--yes", "--out", str(out), "--trials", "1"],
        )  # fmt: skip
        assert done.exit_code == 2, done.output
        said = f"{out / file}: {SAID}; the drives have their state from before; if not, drive-tune undo {way_back}"
        assert said in done.stderr
        assert gains(machine) == before
    assert way_back.is_file() and not (out / "certificate.json").exists()


def test_a_backup_that_finds_no_room_leaves_no_file_that_looks_like_one(tmp_path):
    full(tmp_path / "drive.toml")
    with node() as (_, bus):
        done = CliRunner().invoke(drive_env, ["parameters", "backup", str(tmp_path / "drive.toml"), *bus[:4]])
    assert (done.exit_code, done.stderr) == (2, f"drive-env: {tmp_path / 'drive.toml'}: {SAID}\n")
    assert list(tmp_path.iterdir()) == []


# --- the files themselves -----------------------------------------------------------------------------------------
def test_what_was_there_stays_where_its_successor_finds_no_room(tmp_path):
    file = tmp_path / "a.toml"
    write_whole(file, "one")
    full(file)
    with pytest.raises(OSError, match=SAID) as caught:
        write_whole(file, "two" * 10_000)
    assert (file.read_text(), caught.value.filename) == ("one", str(file))
    assert [path.name for path in tmp_path.iterdir()] == ["a.toml"]


def test_what_is_no_file_is_not_replaced_by_one(tmp_path):
    nowhere = tmp_path / "null"
    nowhere.symlink_to("/dev/null")
    write_whole(nowhere, "gone")
    assert nowhere.is_char_device() and [path.name for path in tmp_path.iterdir()] == ["null"]
    nowhere.unlink()
    nowhere.symlink_to("/dev/full")
    with pytest.raises(OSError, match=SAID):
        write_whole(nowhere, "gone")


def test_files_have_their_names_at_the_end_of_the_block_and_are_on_the_disk_before_it(tmp_path, monkeypatch):
    kept, fsync = [], os.fsync

    def keep(number):
        kept.append(os.fstat(number).st_ino)
        fsync(number)

    monkeypatch.setattr(os, "fsync", keep)
    contents = {tmp_path / "a": "one", tmp_path / "b": b"two"}
    with files_to_be(contents):
        partial = [tmp_path / ".a.partial", tmp_path / ".b.partial"]
        assert sorted(tmp_path.iterdir()) == partial
        assert partial[1].read_bytes() == b"two"
        assert kept == [path.stat().st_ino for path in partial]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b"]
    assert kept[2:] == [tmp_path.stat().st_ino] * 2  # their names, too


@pytest.mark.parametrize("error", [ValueError("no"), KeyboardInterrupt()])
def test_files_of_a_block_that_fails_vanish(tmp_path, error):
    with pytest.raises(type(error)), files_to_be({tmp_path / "a": "one", tmp_path / "b": "two"}):
        raise error
    assert list(tmp_path.iterdir()) == []


@contextmanager
def tiny_disk(place, kilobytes):
    """Mount a file system of so many kB."""
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", str(place)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("only who may mount has a disk that is full")
    try:
        yield place
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True)  # a library may still have a file open


@pytest.mark.skipif(sys.platform != "linux", reason="tmpfs")
@pytest.mark.usefixtures("quick")
def test_a_real_disk_that_holds_the_way_back_and_no_report(tmp_path, monkeypatch):
    collect = auto_module.collect

    def fill(*arguments):
        with pytest.raises(OSError, match=SAID), (tmp_path / "disk" / "others").open("wb", buffering=0) as others:
            while True:
                others.write(bytes(4096))
        return collect(*arguments)

    monkeypatch.setattr(auto_module, "collect", fill)
    with tiny_disk(tmp_path / "disk", 64) as disk, node() as (machine, bus):
        before = gains(machine)
        done = tune("design", bus, disk / "run")
        assert (done.exit_code, gains(machine)) == (2, before), done.output
        assert SAID in done.stderr and "the drives have their state from before" in done.stderr
        assert [path.name for path in (disk / "run").iterdir()] == ["before.toml"]
        machine.write(GAIN_OBJECTS[2], 77)
        again = CliRunner().invoke(drive_tune, ["undo", str(disk / "run" / "before.toml"), "--yes"])
        assert (again.exit_code, gains(machine)) == (0, before), again.output


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="tmpfs")
def test_a_journal_that_finds_no_room_ends_a_search_and_is_named(tmp_path):
    with tiny_disk(tmp_path / "disk", 16) as disk, node() as (machine, bus):
        before = gains(machine)
        (disk / "ballast").write_bytes(bytes(8 << 10))
        done = CliRunner().invoke(
            drive_tune,
            ["auto", "--by", "random", "--bus", *bus, "--travel", "-5:5", "--yes", "--out", str(tmp_path / "searched"),
             "--trials", "60", "--journal", str(disk / "journal")],
        )  # fmt: skip
        assert (done.exit_code, gains(machine)) == (2, before), done.output
    assert f"{disk / 'journal'}: {SAID}; the drives have their state from before" in done.stderr


# Command and options, kB that are left, the file that finds no room, and the option with which it goes on.
COMMANDS = [
    ("rank", ("-t", "baseline", "--count", 1), 8, "run/tuners.csv", "--resume"),
    ("rank", ("-t", "factory", "-t", "baseline", "--count", 1), 36, "run/comparison.png", "--resume"),
    ("auto", ("--by", "random", "--load", "inertia", "--trials", 1), 8, "run.unfinished/part-0", ""),
    ("auto", ("--by", "random", "--load", "inertia", "--trials", 1), 28, "run/trials.png", "--resume"),
    ("sweep", ("--config", "small.toml"), 4, "run.unfinished/settings.toml", ""),
    ("sweep", ("--config", "small.toml"), 0, "run.unfinished/shards", ""),
    ("response", ("--load", "inertia"), 20, "run/velocity_axis0.png", ""),
    ("identify", ("--load", "inertia"), 0, "run", ""),
    ("scope", (), 8, "run.csv", ""),
    ("jog", ("60 rpm", "--for", 0.1), 32, "run.png", ""),
    ("train", ("tracking", "--config", "small.yaml", "--load", "gantry"), 8, "run", ""),
    ("train", ("tracking", "--config", "small.yaml", "--load", "gantry"), 20, "run/checkpoint.zip", ""),
    ("train", ("tracking", "--config", "small.yaml", "--load", "gantry"), 68, "run/learning_curve.png", "--trust"),
]


@pytest.mark.skipif(sys.platform != "linux", reason="tmpfs")
@pytest.mark.every(32)
@pytest.mark.parametrize(("command", "options", "left", "file", "goes_on"), COMMANDS)
def test_a_command_names_the_file_that_finds_no_room(tmp_path, monkeypatch, command, options, left, file, goes_on):
    """`sweep`, `optimise` and `train` said "[Errno 28] No space left on device" alone."""
    monkeypatch.chdir(tmp_path)
    if command == "train":
        pytest.importorskip("stable_baselines3")
    small_runs(tmp_path)
    app = {"scope": drive_env, "jog": drive_env, "train": drive_agent}.get(command, drive_tune)
    with tiny_disk(tmp_path / "disk", 256) as disk:
        ballast, out = disk / "ballast", disk / "run"
        line = [command, *map(str, options), "--out", str(out)]
        ballast.write_bytes(bytes(shutil.disk_usage(disk).free - (left << 10)))
        with node() if app is drive_env else nullcontext((None, [])) as (_, bus):
            done = CliRunner().invoke(app, [*line, *bus[:4]])
        assert done.exit_code == 2, done.output
        said = done.stderr.strip().splitlines()[-1]
        assert f"{disk / file}: {SAID}" in said and "Errno" not in done.stderr and "Traceback" not in done.stderr
        there = [path for path in disk.rglob("*") if path != ballast]
        assert not [path for path in there if path.name.startswith(".") or path.suffix in (".part", ".partial")]
        assert (goes_on != "") == ("continue" in said) == any(path.is_dir() for path in there), there
        if goes_on:
            ballast.unlink()
            again = ["train", "--resume", str(out), goes_on] if command == "train" else [*line, goes_on]
            assert CliRunner().invoke(app, again).exit_code == 0
            assert not (disk / "run.unfinished").exists()


def small_runs(folder):
    """Write files with which a sweep and a training take a moment."""
    text = (Path(provenance.__file__).parent / "sweep.toml").read_text(encoding="utf-8")
    (folder / "small.toml").write_text(re.sub(r"count = \d+", "count = 2", text), encoding="utf-8")
    env = {"num_threads": 1, "duration": 0.01}
    table = {"n_envs": 4, "n_timesteps": 200, "policy": "MlpPolicy", "normalize": True, "n_steps": 8, "batch_size": 16,
             "learning_rate": "lin_1e-3", "policy_kwargs": "dict(net_arch=[8], activation_fn=nn.ReLU)",
             "env_kwargs": env}  # fmt: skip
    (folder / "small.yaml").write_text(json.dumps({"ServoDrive/Tracking-v0": table, "gantry": {"n_steps": 4}}))
