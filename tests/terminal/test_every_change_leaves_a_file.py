"""Whatever moves drives of a bus leaves a file first: a run that is killed is undone by one command."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager

import pytest
from rigs.served_drives import GAIN_OBJECTS, PATIENCE, environment, files, node, parameters, status_is, wait_until
from typer.testing import CliRunner

from agents.commands.cli import app as drive_agent
from drive_env import cia402
from drive_env.fieldbus.description import Description
from tuning.commands.cli import app as drive_tune
from tuning.snapshot import load_snapshot

OFF = ((0x4F, 0x40), (0x4F, 0x08))  # masks and values of 6041h: as it comes up, and in fault
COMMUTATION, RAMP, CURRENT_LIMIT = (0x2055, 0), (0x6083, 0), (0x2003, 0)

TUNING = ("--travel", "-5:5", "--yes", "--bus")
COMMANDS = {
    "identify": (drive_tune, ("identify", *TUNING)),
    "response": (drive_tune, ("response", "position", *TUNING)),
    "rules": (drive_tune, ("rules", "cascade", "--relay", *TUNING)),
    "evaluate": (drive_agent, ("evaluate", "gain_tuning", "--episodes", "1", "--stall", "60")),
}


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def differences(machine, file):
    """Return the parameters of a machine that are not what a file says."""
    (before,) = load_snapshot(file).axes
    return {key for key, was in before.items() if key[0] >= 0x2000 and int(machine.read(key)[0]) != was}


@contextmanager
def standing_still_once(machine, is_under_way):
    """Let no time pass at a node from the moment on when something is so, until the end; yield the event of it.

    Whoever watches a run from another thread may see it when it is over: the node itself must stop.
    """
    reached, over, advance = threading.Event(), threading.Event(), machine.advance

    def stop_there(duration):
        if not reached.is_set() and is_under_way():
            reached.set()
            over.wait(PATIENCE)
        advance(duration)

    machine.advance = stop_there
    try:
        yield reached
    finally:
        machine.advance = advance
        over.set()


def killed(machine, command, bus, folder):
    """Run a command, kill it once the axis is enabled and other than before; return the file that it left."""

    def is_under_way():
        # A response is measured with the gains and ramps that there are: it changes PDOs alone.
        return status_is(machine, cia402.OPERATION_ENABLED) and (
            command == "response" or any(differences(machine, file) for file in files(folder))
        )

    app, arguments = COMMANDS[command]
    program = "drive_agent" if app is drive_agent else "drive_tune"
    with standing_still_once(machine, is_under_way) as reached:
        process = subprocess.Popen(
            [sys.executable, "-c", f"from drive_env.programs import {program} as run; run()", *arguments, *bus],
            cwd=folder, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            wait_until(reached.is_set, process)
        finally:
            process.kill()
            _, said = process.communicate()
    assert process.returncode == -signal.SIGKILL, said
    (file,) = files(folder)
    return file


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
@pytest.mark.parametrize("command", COMMANDS)
def test_a_run_that_is_killed_is_undone_by_one_command(tmp_path, command):
    with node() as (machine, bus):
        before = parameters(bus)
        file = killed(machine, command, bus, tmp_path)
        machine.write(0x6040, 0x00)  # without a SYNC this node's time stands still: it cannot miss its master
        machine.advance(0.2)
        left = parameters(bus)
        assert left != before
        # The travel was lent to the drive as its software limits, which it keeps until the way back is gone.
        assert bool(differences(machine, file) - {(0x607D, 1), (0x607D, 2)}) == (command != "response")
        if command in ("identify", "rules"):
            assert {COMMUTATION, RAMP, CURRENT_LIMIT} <= differences(machine, file)
            assert differences(machine, file) & set(GAIN_OBJECTS)
        done = CliRunner().invoke(drive_tune, ["undo", str(file), "--yes"])
        assert done.exit_code == 0, done.output
        assert parameters(bus) == before


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_a_node_in_real_time_switches_itself_off_and_is_restored(tmp_path, monkeypatch):
    # It is stopped then, and does not answer until it is woken.
    monkeypatch.setattr(Description, "answer_timeout", property(lambda self: 2.0))
    with node(lockstep=False) as (machine, bus):
        before = parameters(bus)
        file = killed(machine, "identify", bus, tmp_path)
        assert {COMMUTATION, RAMP, CURRENT_LIMIT} <= differences(machine, file)
        wait_until(lambda: status_is(machine, *OFF))
        done = CliRunner().invoke(drive_tune, ["undo", str(file), "--yes"])
        assert done.exit_code == 0, done.output
        assert parameters(bus) == before


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_a_run_that_ends_well_leaves_the_drive_as_the_file_says_and_tells_it(tmp_path, command):
    app, arguments = COMMANDS[command]
    with node() as (machine, bus):
        before = parameters(bus)
        done = CliRunner().invoke(app, [*arguments, *bus, "--json"])
        assert done.exit_code == 0, done.output
        (file,) = files(tmp_path)
        told = json.loads(done.stdout)
        assert (told if command == "evaluate" else told[0])["before"] == str(file.relative_to(tmp_path))
        assert parameters(bus) == before
        assert parameters(bus) == dict(load_snapshot(file).axes[0])
        assert status_is(machine, *OFF)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_place_that_cannot_be_written_is_told_before_the_bus_is_opened(tmp_path, command):
    (tmp_path / "runs").write_text("a file", encoding="utf-8")
    app, arguments = COMMANDS[command]
    done = CliRunner().invoke(app, [*arguments, "--channel", "socket://127.0.0.1:9"])
    assert done.exit_code == 2
    assert "the state before cannot be written to runs/" in done.stderr
    assert f"{tmp_path / 'runs'} is a file; choose another place" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


@pytest.mark.every(3)
@pytest.mark.parametrize(("command", "out", "file"), [
    ("identify", "found.json", "found-before.toml"),
    ("response", "shaken", "shaken-before.toml"),
    ("evaluate", "judged", "judged-before.toml"),
])  # fmt: skip
def test_the_file_lies_beside_the_results_and_never_replaces_one(tmp_path, monkeypatch, command, out, file):
    (tmp_path / file).write_text("what a killed run left", encoding="utf-8")
    named = []

    def taken(target):
        named.append(sorted(path.name for path in tmp_path.iterdir()))
        raise OSError("enough")

    monkeypatch.setattr("tuning.snapshot.take", taken)
    app, arguments = COMMANDS[command]
    with node() as (_, bus):
        done = CliRunner().invoke(app, [*arguments, *bus, "--out", out])
    assert (done.exit_code, named) == (2, [[file]])
    assert done.stderr.strip().endswith("enough")
    assert (tmp_path / file).read_text(encoding="utf-8") == "what a killed run left"


@pytest.mark.slow
@pytest.mark.parametrize("command", ["identify", "response", "rules"])
def test_emulated_drives_leave_none(tmp_path, command):
    _, arguments = COMMANDS[command]
    emulated = [one for one in arguments if one not in ("--bus", "--yes")]
    done = CliRunner().invoke(drive_tune, [*emulated, "--load", "inertia", "--json"])
    assert done.exit_code == 0, done.output
    assert all("before" not in row for row in json.loads(done.stdout))
    assert list(tmp_path.iterdir()) == []
