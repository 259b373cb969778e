"""`drive-env home` and `move`: what they say is held against the emulator's inside; Ctrl-C stops the motor."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import uuid

import can
import numpy as np
import pytest
from rigs.served_drives import environment, node, status_is, wait_until
from typer.testing import CliRunner

import drive_env.commands.cli
from drive_env import EmulatedDrives, motion
from drive_env.bus.can_port import CanPort
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.commands.one_axis import MoveOutcome
from drive_env.dictionary.homing_methods import METHODS, method_text
from drive_env.firmware.common.modes import hm

TURN = 65536
DONE, REFUSED, USER_ERROR, INTERRUPTED = 0, 1, 2, 130
OFF = ((0x4F, 0x40),)


@pytest.fixture(scope="module")
def served():
    """A belt with switches, and its drive on a bus in real time."""
    world = World(lockstep=False)
    drives = EmulatedDrives(load="belt", num_threads=1)
    world.add(drives, [1])
    channel = str(uuid.uuid4())
    with Server(world, CanPort(can.Bus(interface="virtual", channel=channel))):
        yield drives, ["--interface", "virtual", "--channel", channel, "--timeout", "20"]
    world.close()


@pytest.fixture
def run(served):
    drives, bus = served
    for key, value in {(0x6099, 1): 5 * TURN, (0x6099, 2): TURN, (0x6098, 0): 0}.items():
        drives.write(key, value)
    return lambda *words: CliRunner().invoke(drive_env.commands.cli.app, [*words, *bus])


# --- what is said, and nothing done ---------------------------------------------------------------------------------
@pytest.mark.parametrize(("words", "code", "told"), [
    (("home",), REFUSED, "node 1 has no homing method: 6098h is 0. Choose one of the list"),
    (("home", "--method", "3"), USER_ERROR, "--method 3: node 1 has 17, 18, 19, 21, 35"),
    (("home", "--method", "0", "--yes"), USER_ERROR, "--method 0: node 1 has 17, 18, 19, 21, 35"),
    (("home", "--method", "17"), USER_ERROR, "Home now? There is no terminal to ask; confirm with --yes"),
    (("home", "--method", "17", "--axis", "1"), USER_ERROR, "--axis 1: a tmcm1636 has 1 axes, from 0"),
    (("home", "--method", "35", "--node", "2", "--node", "1", "--yes"), USER_ERROR, "--node 2 --node 1: this"),
    (("move", "1 rev", "--node", "2", "--node", "1", "--yes"), USER_ERROR, "this command is of one node"),
    (("move", "1 rev", "--axis", "1", "--axis", "0", "--yes"), USER_ERROR, "this command is of one axis"),
    (("jog", "60 rpm", "--axis", "0", "--axis", "1"), USER_ERROR, "this command is of one axis"),
    (("home", "--within", "0"), USER_ERROR, "--within 0 s must be above 0 s"),
    (("move", "1 rev"), USER_ERROR, "Move now? There is no terminal to ask; confirm with --yes"),
    (("move", "1 V", "--yes"), USER_ERROR, "is not a quantity in 'V'; it takes inc, rev"),
    (("move", "there", "--yes"), USER_ERROR, "'there' is not a number"),
    (("move", "1 rev", "--speed", "-60 rpm", "--yes"), USER_ERROR, "6081h:00 Profile velocity"),
    (("move", "1 rev", "--speed", "0", "--yes"), USER_ERROR, "--speed 0 must be above 0; the sign of the position"),
    (("move", "1 rev", "--max-current", "0 A", "--yes"), USER_ERROR, "--max-current 0 A must be above 0 A"),
])  # fmt: skip
def test_a_mistake_is_named_with_its_remedy_and_moves_nothing(served, run, words, code, told):
    drives, before = served[0], float(served[0].machine.rotor_angle[0])
    found = run(*words)
    assert (found.exit_code, told in found.stderr) == (code, True), found.output
    assert isinstance(found.exception, SystemExit | None)
    assert abs(float(drives.machine.rotor_angle[0]) - before) < 0.01 and status_is(drives, *OFF)
    assert int(drives.read(0x6098)[0]) == 0


def test_a_drive_without_a_method_gets_those_that_it_has(run):
    lines = run("home").stdout.splitlines()[1:]
    assert [int(line.split()[0]) for line in lines] == [17, 18, 19, 21, 35]
    assert "left limit switch" in lines[0] and "right limit switch" in lines[1]
    assert set(json.loads(run("home", "--json").stdout)["methods"]) == {"17", "18", "19", "21", "35"}


def test_a_dry_run_says_where_to_and_moves_nothing(served, run):
    drives, before = served[0], float(served[0].machine.rotor_angle[0])
    found = run("move", "0.25 rev", "--relative", "--speed", "60 rpm", "--dry-run")
    assert found.exit_code == DONE and "would be enabled, moved by 16384 inc (0.25 rev) to " in found.stdout
    assert run("home", "--method", "17", "--dry-run").exit_code == DONE
    assert abs(float(drives.machine.rotor_angle[0]) - before) < 0.01


def test_a_home_that_the_drive_does_not_show_is_not_claimed(run, monkeypatch):
    monkeypatch.setattr(motion, "home", lambda drives, **others: motion.enable(drives, mode="hm"))
    found = run("home", "--method", "17", "--yes")
    assert found.exit_code == REFUSED and "not homed" in found.stdout
    assert "the drive does not show that home is attained" in found.stderr


def test_a_speed_of_0_is_named_before_the_axis_is_enabled(served, run):
    served[0].write((0x6099, 2), 0)
    found = run("home", "--method", "17", "--yes")
    assert found.exit_code == USER_ERROR and "drive-env set 6099:2 '10 rpm' --node 1" in found.stderr
    assert run("home", "--method", "35", "--yes").exit_code == DONE  # which needs none


# --- moves, by the rotor itself -------------------------------------------------------------------------------------
def test_a_move_ends_where_it_says_and_gives_the_speed_back(served, run):
    drives, speed = served[0], int(served[0].read(0x6081)[0])
    start, angle = int(drives.read(0x6064)[0]), float(drives.machine.rotor_angle[0])
    found = run("move", "-0.5 rev", "--relative", "--speed", "300 rpm", "--yes", "--json")
    assert found.exit_code == DONE, found.output
    row = json.loads(found.stdout)
    assert row["target"] == start - TURN // 2 and abs(row["position"] - row["target"]) < 700
    turned = (float(drives.machine.rotor_angle[0]) - angle) / (2.0 * np.pi)
    assert turned == pytest.approx(-0.5, abs=0.02) and row["stopped"] == ""
    assert status_is(drives, *OFF) and int(drives.read(0x6081)[0]) == speed
    assert run("move", str(start), "--speed", "300 rpm", "--yes").exit_code == DONE
    assert float(drives.machine.rotor_angle[0]) == pytest.approx(angle, abs=0.1)


@pytest.mark.parametrize("words", [("move", "2147483647", "--relative"), ("jog", "60 rpm", "--by", "2147483647")])
def test_a_relative_target_beyond_what_607a_holds_is_refused_before_the_axis_is_enabled(served, run, words):
    drives = served[0]
    assert run("move", "1000", "--speed", "60 rpm", "--yes").exit_code == DONE
    here, word = int(drives.read(0x6064)[0]), int(drives.read(0x6040)[0])
    found = run(*words, *(["--yes"] if words[0] == "move" else []))
    assert found.exit_code == USER_ERROR, found.output
    assert f"607Ah:00 Target position cannot be {2**31 - 1 + here}; its highest is 2147483647" in found.stderr
    assert (int(drives.read(0x6064)[0]), int(drives.read(0x6040)[0])) == (here, word)


@pytest.mark.slow
def test_homing_finds_the_switch_s_edge_and_gives_the_method_back(served, run):
    drives = served[0]
    found = run("home", "--method", "17", "--yes", "--json")
    assert found.exit_code == DONE, found.output
    row = json.loads(found.stdout)
    assert row["method"] == 17 and abs(row["position"]) < TURN // 50 and row["stopped"] == ""
    assert status_is(drives, *OFF) and int(drives.read(0x6098)[0]) == 0
    # The edge is there: a little to the left the left limit switch is active, a little to the right it is not.
    for way, active in (("-0.1 rev", True), ("0.2 rev", False)):
        run("move", way, "--relative", "--speed", "60 rpm", "--yes")
        assert bool(int(drives.read(0x60FD)[0]) & 1) is active


def test_a_homing_that_does_not_end_in_time_fails_and_stops(served, run):
    drives = served[0]
    found = run("home", "--method", "18", "--within", "0.2", "--yes")
    assert found.exit_code == REFUSED and "did not attain home in 0.2 s" in found.stderr
    assert status_is(drives, *OFF) and abs(float(drives.machine.rotor_speed[0])) < 1.0


def test_an_emergency_on_the_way_to_the_target_stops_nothing_and_one_that_kept_from_it_did():
    jam = [{"code": 0x8611, "name": "following_error"}]
    assert MoveOutcome(0, 0, 0, [], jam, None).stopped(True) == ""
    assert (
        MoveOutcome(0, 0, 0, [], jam, None).stopped(False)
        == "the movement was stopped: emergency 8611h following error"
    )
    assert MoveOutcome(0, 0, 0, ["late"], [], None).stopped(True) == "late"


# --- Ctrl-C ---------------------------------------------------------------------------------------------------------
@pytest.mark.every(6)
@pytest.mark.parametrize("words", [
    ("home", "--method", "17"), ("move", "500 rev", "--speed", "600 rpm"),
    ("move", "500 rev", "--speed", "600 rpm", "--out", "long"),
])  # fmt: skip
def test_ctrl_c_stops_the_motor(tmp_path, words):
    """The command is a process of its own; the emulator's truth tells that the motor turned, and that it stands."""
    with node(lockstep=False, load="belt" if words[0] == "home" else "inertia") as (machine, bus):
        if words[0] == "home":
            for name in ("6099:1", "6099:2"):
                assert CliRunner().invoke(drive_env.commands.cli.app, ["set", name, "60 rpm", *bus]).exit_code == 0
        program = "from drive_env.commands.cli import main; main()"
        command = [sys.executable, "-c", program, *words, "--yes", *bus]
        process = subprocess.Popen(command, cwd=tmp_path, env=environment(), stderr=subprocess.PIPE, text=True)
        try:
            wait_until(lambda: abs(float(machine.machine.rotor_speed[0])) > 3.0, process)
            assert abs(float(machine.machine.rotor_speed[0])) > 3.0
            os.kill(process.pid, signal.SIGINT)
            _, errors = process.communicate(timeout=60)
        finally:
            process.kill()
        assert process.returncode == INTERRUPTED, errors
        assert "Traceback" not in errors and "interrupted" in errors
        wait_until(lambda: status_is(machine, *OFF))
        assert status_is(machine, *OFF) and abs(float(machine.machine.rotor_speed[0])) < 0.5
        assert int(machine.read(0x6098)[0]) == 0  # what was lent is back


# --- the table of homing methods ------------------------------------------------------------------------------------
@pytest.mark.parametrize("method", sorted(METHODS))
def test_the_table_says_what_the_firmware_does(method):
    """Direction, index and edge of each text are the firmware's, which its own tests hold to CiA 402."""
    text, edge = METHODS[method], method + 16 if method < 15 else method
    assert ("index" in text) == (method < 15 or method in (33, 34))
    if 17 <= edge <= 30:
        assert text.startswith("left" if edge in hm.SEARCH_LEFT else "right")
        assert ("becomes active" in text or "reached from" in text) == (edge in hm.WHERE_ACTIVE)
    assert ("does not move" in text) == (method in hm.HERE)


def test_a_maker_s_own_method_is_known_of_known_devices_alone():
    assert "mechanical stop" in method_text(-1, is_known=True)
    assert "manual" in method_text(-1, is_known=False)
