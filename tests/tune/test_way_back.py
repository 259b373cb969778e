"""However a command that changes drives of a bus ends, it says what is changed still and the line that restores it.

The truth is what the emulator has; a run that believes to have put everything back is not asked.
"""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import can
import numpy as np
import pytest
from rigs.auto_stages import skip_stages
from rigs.commands import drive_tune as drive_tune_wide
from rigs.served_drives import GAIN_OBJECTS, PATIENCE, environment, files, node, parameters, status_is, wait_until
from typer.testing import CliRunner

from agents.tuner import tuning_run
from drive_env import cia402, motion
from drive_env.devices import find_device
from drive_env.fieldbus.description import Description
from drive_env.master.can.port import Port
from drive_env.master.parameters import Difference
from tuning.auto import one_button as auto_module
from tuning.commands.cli import app as drive_tune
from tuning.snapshot import SET_POINTS, Transaction, differences
from tuning.target import on_bus
from tuning.way_back import way_back, what_is_changed

NEW = np.array([[1000, 900, 800, 700, 600]])
AS_BEFORE = "the drives have their state from before, by a second reading; drive-tune undo {} restores it"
TARGET_TORQUE, STOPPED, PRE_OPERATIONAL = (0x6071, 0), 4, 127


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def target_of(bus):
    """Return the node as a target."""
    return on_bus(interface="slcan", channel=bus[3], nodes=[1], travel=(-30.0, 30.0), pace="lockstep", timeout=20.0)


def undo(file):
    return CliRunner().invoke(drive_tune, ["undo", str(file), "--yes"])


@pytest.mark.parametrize(("axes", "told"), [(1, "changed still: 2041h"), (2, "changed still: axis 1: 2041h")])
def test_a_change_on_one_axis_of_several_names_it(monkeypatch, axes, told):
    entry = find_device("tmcm1636").new_dictionary().find(GAIN_OBJECTS[0])
    snapshot = SimpleNamespace(axes=({},) * axes, left_out={})
    monkeypatch.setattr("tuning.way_back.load_snapshot", lambda file: snapshot)
    monkeypatch.setattr("tuning.way_back.read_anew", lambda given: [(axes - 1, Difference(entry, 1, 2))])
    assert what_is_changed("before.toml").startswith(told)


@pytest.mark.parametrize("by", ["tpe", "rule", "agent"])
def test_an_axis_that_is_rejected_before_its_gains_are_searched_says_why(by):
    with node() as (_, bus):
        done = drive_tune_wide("auto", "--by", by, *bus, "--travel", "-0.01:0.01", "--yes", "--out", "run")
    assert done.exit_code == 1 and "axis 0 was not tuned: the travel is too short" in done.stdout, done.output
    written = re.search(r"written to run: (.*)", done.stdout)[1].split(", ")
    assert sorted(written) == sorted(path.name for path in Path("run").iterdir())


# --- the commands -------------------------------------------------------------------------------------------------
def pressed(*arguments):
    raise KeyboardInterrupt


@pytest.mark.every(14)
@pytest.mark.parametrize(
    ("by", "stage", "words"),
    [
        ("design", "Transaction", "nothing was changed"),
        ("design", "write", AS_BEFORE),
        ("design", "collect", AS_BEFORE),
        ("design", "Transaction.__exit__", "changed still: 2041h:01 "),
        ("agent", "Transaction", "nothing was changed"),
        ("agent", "collect", AS_BEFORE),
        ("agent", "Transaction.__exit__", "changed still: 2041h:01 "),
    ],
)
def test_ctrl_c_at_any_stage_ends_with_what_the_drives_have(monkeypatch, tmp_path, by, stage, words):
    skip_stages(monkeypatch.setattr, NEW)
    monkeypatch.setattr(tuning_run, "make_trials", lambda *given: auto_module.RecordedGains.only(NEW.copy()))
    owner, _, name = stage.rpartition(".")
    monkeypatch.setattr(getattr(auto_module, owner) if owner else auto_module, name, pressed)
    with node() as (machine, bus):
        before = [int(machine.read(key)[0]) for key in GAIN_OBJECTS]
        done = CliRunner().invoke(drive_tune, ["auto", "--by", by, *bus, "--travel", "-5:5", "--yes", "--out", "run"])
        assert done.exit_code == 130, done.output
        state, reason = done.stderr.strip().splitlines()
        assert words.format("run/before.toml") in state and reason.endswith(": interrupted")
        now = [int(machine.read(key)[0]) for key in GAIN_OBJECTS]
        assert (now != before) == ("changed still" in words)
        if "changed still" in words:
            assert state.endswith("drive-tune undo run/before.toml restores the state before")
            assert undo("run/before.toml").exit_code == 0
            assert [int(machine.read(key)[0]) for key in GAIN_OBJECTS] == before


def test_an_emulated_drive_that_ends_with_the_program_needs_no_way_back(monkeypatch):
    monkeypatch.setattr(auto_module, "Transaction", pressed)
    done = CliRunner().invoke(drive_tune, ["auto", "--load", "inertia"])
    assert (done.exit_code, done.stderr) == (130, "\ndrive-tune: interrupted\n")


# --- what it reads ------------------------------------------------------------------------------------------------
def test_what_a_lost_run_left_is_named_with_its_set_points_and_undone(tmp_path, capsys, monkeypatch):
    """6071h is a command, so no parameter file has it: with 300 mA in it the next `enable` in cst turns the motor."""
    file = tmp_path / "before.toml"
    with node() as (machine, bus):
        before = parameters(bus)
        with pytest.raises(ValueError, match="no"), way_back(file, "drive-tune"), target_of(bus) as target:
            with Transaction(target, file) as transaction:
                transaction.commit()
            machine.write(GAIN_OBJECTS[2], 77)
            machine.write(TARGET_TORQUE, 300)
            raise ValueError("no")
        (said,) = capsys.readouterr().err.strip().splitlines()
        assert said.startswith("drive-tune: changed still: 2042h:01 ") and " is 77, not " in said
        assert "6071h:00 Target torque is 300, not 0" in said
        assert said.endswith(f"; drive-tune undo {file} restores the state before")
        sent, send = [], Port.send
        monkeypatch.setattr(Port, "send", lambda self, *frame, **how: (sent.append(frame), send(self, *frame, **how)))
        planned = CliRunner().invoke(drive_tune, ["undo", str(file), "--dry-run"])
        monkeypatch.undo()
        # Beginnings and segments of uploads: no download, NMT command or process data.
        assert {number for number, _ in sent} == {0x601} and {data[0] >> 5 for _, data in sent} <= {2, 3}
        assert planned.exit_code == 0, planned.output
        assert "axis 0: 2042h:01 " in planned.stdout and f": 77, would be {before[GAIN_OBJECTS[2]]}\n" in planned.stdout
        assert planned.stdout.endswith("2 parameters would be restored (dry run: nothing was written)\n")
        assert machine.read(GAIN_OBJECTS[2])[0] == 77 and machine.read(TARGET_TORQUE)[0] == 300
        done = undo(file)
        assert done.exit_code == 0, done.output
        assert parameters(bus) == before
        assert [int(machine.read(key)[0]) for key in SET_POINTS] == [0] * len(SET_POINTS)
        assert what_is_changed(file) == AS_BEFORE.format(file)


def test_a_rollback_leaves_no_set_point_that_would_turn_the_motor(tmp_path):
    with node() as (machine, bus), target_of(bus) as target:
        with Transaction(target, tmp_path / "before.toml"):
            target.drives.write("Target velocity", 300_000)
            target.drives.write("Target torque", 500)
        assert [int(machine.read(key)[0]) for key in SET_POINTS] == [0] * len(SET_POINTS)


@pytest.mark.slow
def test_a_silent_node_is_not_woken_and_what_is_not_known_is_not_claimed(tmp_path, monkeypatch):
    """Pre-operational a drive may stop watching its master (docs/safety.md): a node that is stopped stays so."""
    file = tmp_path / "before.toml"
    monkeypatch.setattr("tuning.way_back.LOCKSTEP_PATIENCE", 1.0)
    monkeypatch.setattr(Description, "answer_timeout", property(lambda self: 1.0))  # conftest.py has it much longer
    with node() as (_, bus):
        with target_of(bus) as target, Transaction(target, file):
            pass
        with nmt(bus) as send:
            send(2)
            said = what_is_changed(file)
            assert said.startswith("what is changed still is not known: node 1 did not answer the read of 1000h:00")
            assert said.endswith(f"Once it answers, drive-tune undo {file} restores the state before")
            assert send.state() == STOPPED
            done = undo(file)
            assert done.exit_code == 0, done.output
            assert send.state() == PRE_OPERATIONAL


def test_a_bus_that_is_gone_is_told(tmp_path):
    file = tmp_path / "before.toml"
    with node() as (_, bus), target_of(bus) as target, Transaction(target, file):
        pass
    said = what_is_changed(file)
    assert said.startswith("what is changed still is not known: ") and f"drive-tune undo {file}" in said


@contextmanager
def nmt(bus):
    """Another master on the bus: sends NMT commands to node 1, and asks for its state by guarding."""
    with can.Bus(interface="slcan", channel=bus[3], sleep_after_open=0) as other:

        def send(command):
            other.send(can.Message(arbitration_id=0, data=[command, 1], is_extended_id=False))

        def state():
            other.send(can.Message(arbitration_id=0x701, is_remote_frame=True, dlc=1, is_extended_id=False))
            end = time.monotonic() + PATIENCE
            while time.monotonic() < end:
                frame = other.recv(1.0)
                if frame is not None and frame.arbitration_id == 0x701 and not frame.is_remote_frame:
                    return frame.data[0] & 0x7F
            raise TimeoutError("node 1 does not answer guarding")

        send.state = state
        yield send


# --- real processes, real signals ---------------------------------------------------------------------------------
RUNS = {
    "auto": ("drive_tune", ("auto", "--travel", "-5:5", "--yes", "--out", "run")),
    "agent": ("drive_tune", ("auto", "--by", "agent", "--travel", "-5:5", "--yes", "--out", "run")),
    "identify": ("drive_tune", ("identify", "--travel", "-5:5", "--yes")),
    "response": ("drive_tune", ("response", "position", "--travel", "-5:5", "--yes")),
}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
@pytest.mark.parametrize("how", ["signal", "node stopped", "node stopped and signal"])
@pytest.mark.parametrize("command", RUNS)
def test_what_a_process_says_at_its_end_is_so(tmp_path, command, how):
    """Once the axis is enabled, the node is thrown into NMT stopped for two seconds, or Ctrl-C is pressed, or both."""
    program, arguments = RUNS[command]
    with node() as (machine, bus), nmt(bus) as send:
        before = parameters(bus)
        process = subprocess.Popen(
            [sys.executable, "-c", f"from drive_env.programs import {program} as run; run()", *arguments, *bus],
            cwd=tmp_path, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            wait_until(lambda: status_is(machine, cia402.OPERATION_ENABLED), process)
            time.sleep(0.3)
            end = time.monotonic() + (2.0 if "stopped" in how else 0.0)
            if "signal" in how:
                process.send_signal(signal.SIGINT)
            while time.monotonic() < end:
                send(2)
                time.sleep(0.02)
            _, said = process.communicate(timeout=PATIENCE)
        finally:
            if process.poll() is None:
                process.kill()
        (file,) = files(tmp_path)
        assert process.returncode in ((130, 1) if "signal" in how else (1,)), said
        left = parameters(bus)
        if "by a second reading" in said:
            assert left == before
        else:
            assert "changed still: " in said or "what is changed still is not known: " in said, said
        assert f"drive-tune undo {file.relative_to(tmp_path)} restores" in said
        done = undo(file)
        assert done.exit_code == 0, done.output
        assert parameters(bus) == before


# --- images of EtherCAT -------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_an_image_that_a_killed_run_left_on_ethercat_is_undone():
    """A mapping is changed while no sync manager carries it: `undo` was refused 1A00h:01 with 0601 0000h."""
    from rigs.ethercat_served import served

    from drive_env.master.ethercat_drives import EtherCatDrives
    from drive_env.master.parameters import read_parameters
    from tuning.snapshot import restore, take_of

    device = "tmcm3313"
    with served(device) as (port, _):
        address = {"interface": "ethercat-udp", "channel": port, "pace": "lockstep", "safety": False}
        with EtherCatDrives(device, **address) as drives:
            before = [read_parameters(drives, axis) for axis in range(drives.num_axes)]
            taken = take_of(drives, {})
            drives.record([0x6064, 0x606C, 0x6041], 0.002)
            drives.record([0x6062], 0.002, play={0x60FF: [0, 0]})
            drives.link.process.forget([0])  # as a process that is killed does
        with EtherCatDrives(device, **address) as drives:
            left = [read_parameters(drives, axis) for axis in range(drives.num_axes)]
            restore(drives, taken)
            assert [read_parameters(drives, axis) for axis in range(drives.num_axes)] == before != left
            assert differences(drives, taken) == []


# --- axes that are left out ---------------------------------------------------------------------------------------
@pytest.mark.slow
def test_what_is_borrowed_of_axes_left_out_is_in_the_file_and_comes_back(tmp_path):
    """PDOs are mapped for a whole TMCM-6212: 50 objects of axes 1 to 5 stayed changed after `--axis 0` was killed."""
    from rigs.six_axes import partly_wired
    from rigs.world_bus import on_bus

    from drive_env.drives.chosen_axes import ChosenAxes
    from drive_env.master.parameters import read_parameters
    from tuning.snapshot import load_snapshot, restore, take_of

    with on_bus(partly_wired(), safety=False) as drives:
        before = [read_parameters(drives, axis) for axis in range(6)]
        taken = take_of(ChosenAxes(drives, (3,)), {"axes": [3], "nodes": [1], "channel": "here"})
        assert list(taken.left_out) == [0, 1, 2, 4, 5]
        assert load_snapshot(taken.save(tmp_path / "before.toml")) == taken
        drives.record([0x6064, 0x606C, 0x6041, 0x6062], 0.002)
        drives.link.process.forget([0])  # as a process that is killed does
        for axis, was in enumerate(before):
            assert read_parameters(drives, axis) != was
        assert {axis for axis, _ in differences(drives, taken)} == {0, 1, 2, 3, 4, 5}
        changed = restore(ChosenAxes(drives, (3,)), taken)
        assert len(changed) == 6 and all(changed)
        assert [read_parameters(drives, axis) for axis in range(6)] == before
        assert differences(drives, taken) == []
        drives.write(0x2003, 77, where=np.arange(6) == 1)  # another program's, of an axis that was not chosen
        motion.select_mode(drives, "pv")
        assert differences(drives, taken) == []
