"""`drive-env jog` ends with 1 where something stopped the axis, or nothing moved, and says what."""

from __future__ import annotations

import dataclasses
import json
import uuid

import can
import pytest
from typer.testing import CliRunner

import drive_env.commands.cli
from drive_env import EmulatedDrives
from drive_env.bus.can_port import CanPort
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.commands.one_axis import is_error, what_stops
from drive_env.safety.errors import SafetyError

TURN = 65536


@pytest.fixture
def drives():
    """A belt axis with limit switches."""
    return EmulatedDrives(load="belt", num_threads=1)


@pytest.fixture
def jog(monkeypatch, drives):
    """A command on a drive; and the drive."""
    world = World(lockstep=False)
    world.add(drives, [1])
    channel = str(uuid.uuid4())
    for name, value in {"INTERFACE": "virtual", "CHANNEL": channel, "TIMEOUT": "20"}.items():
        monkeypatch.setenv(f"DRIVE_ENV_{name}", value)
    with Server(world, CanPort(can.Bus(interface="virtual", channel=channel))):
        yield lambda *words: CliRunner().invoke(drive_env.commands.cli.app, ["jog", *words]), drives
    world.close()


@pytest.mark.slow
@pytest.mark.parametrize("drives", [EmulatedDrives("tgz_s", load="inertia", num_threads=1)])
def test_amperes_of_a_drive_that_counts_in_its_motor_s_current_limit_it_and_are_recorded(jog, tmp_path):
    run, drives = jog
    peak = 1e-3 * drives.read(0x2107)[0]  # M-Ipeak [A]; 6077h counts 32767ths of it
    words = ("1000 rpm", "--for", "0.3", "--max-current", "0.5 A", "--device", "tgz_s")
    found = run(*words, "--out", str(tmp_path / "move"))
    assert found.exit_code == 0, found.output
    header, *rows = (tmp_path / "move.csv").read_text(encoding="utf-8").splitlines()
    column = next(k for k, name in enumerate(header.split(",")) if name.startswith("6077h"))
    most = max(abs(int(row.split(",")[column])) for row in rows) * peak / 32767
    assert 0.4 < most < 0.55


def is_off(drives):
    return drives.read(0x6041)[0] & 0x4F == 0x40


@pytest.mark.every(2)
@pytest.mark.parametrize("words", [("2000 rpm", "--by", "-50 rev"), ("-2000 rpm", "--for", "2")])
def test_a_limit_switch_ends_it_and_is_named(jog, words):
    run, drives = jog
    found = run(*words)
    assert found.exit_code == 1, found.output
    assert "drive-env: the movement was stopped: emergency FF01h negative limit switch" in found.stderr
    at_the_switch = drives.read(0x6064)[0]
    assert at_the_switch < -4 * TURN and is_off(drives)
    found = run("300 rpm", "--by", "-1 rev", "--json")
    assert found.exit_code == 1 and "negative limit switch" in json.loads(found.stdout)["stopped"]
    assert abs(drives.read(0x6064)[0] - at_the_switch) < TURN // 4
    found = run("300 rpm", "--by", "1 rev", "--json")  # away from it: it is told, and stops nothing
    assert found.exit_code == 0 and json.loads(found.stdout)["stopped"] == "", found.output
    assert is_off(drives)


@pytest.mark.slow
def test_an_axis_that_does_not_move_is_told(jog):
    run, drives = jog
    slow = CliRunner().invoke(
        drive_env.commands.cli.app, ["set", "6083", "1", "--yes"]
    )  # increments per second and second
    assert slow.exit_code == 0, slow.output
    found = run("300 rpm", "--for", "0.2")
    assert found.exit_code == 1, found.output
    assert "the axis hardly moved, and the drive reports no cause. The speed was 327680 pps (300 rpm)" in found.stderr
    assert "Else check for a closed brake, a blocked load" in found.stderr
    assert "Limits(" not in found.output and is_off(drives)


@pytest.mark.parametrize(
    ("speed", "way", "words"),
    [
        ("100 rpm", "0 rev", "--by 0 rev is less than one increment: nothing would move"),
        ("100 rpm", "0.000001 rev", "--by 0.000001 rev is less than one increment"),
        ("-300 rpm", "2 rev", "-300 rpm turns the other way than --by 2 rev; leave out one sign"),
    ],
)
def test_a_distance_that_moves_nothing_or_the_other_way_is_refused_before_the_axis_is_enabled(jog, speed, way, words):
    run, drives = jog
    found = run(speed, "--by", way)
    assert found.exit_code == 2 and words in found.stderr, found.output
    assert drives.read(0x6064)[0] == 0 and drives.read(0x6040)[0] == 0


@pytest.mark.slow
def test_a_speed_above_the_envelope_s_limit_names_no_argument_of_python(jog):
    run, drives = jog
    found = run("20000 rpm")
    assert found.exit_code == 1 and is_off(drives)
    assert "beyond the limit" in found.stderr and "Choose less: this drive has no limit of its own" in found.stderr
    assert "Limits(" not in found.output


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ("= 9 is beyond the limit 8. Choose less, or raise Limits(velocity=...): no", "the limit 8. Choose less: no"),
        ("Wait until it is slower, or raise Limits(velocity=...): no", "Wait until it is slower: no"),
        ("Write less there first, or raise Limits(velocity=...): no", "Write less there first: no"),
        ("beyond Limits(current=...)", "beyond --max-current"),
        ("the limit is 2 s; disable it, or set Limits(stall=...)", "the limit is 2 s; disable it"),
    ],
)
def test_no_limit_of_the_envelope_is_told_as_an_argument_of_python(said, told):
    reasons: list[str] = []
    with what_stops(reasons):
        raise SafetyError(said)
    assert reasons[0].endswith(told) and "Limits(" not in reasons[0]


def test_an_emergency_that_tells_of_no_error_any_more_is_none():
    assert [message["code"] for message in filter(is_error, [{"code": 0}, {"code": 0x2310}])] == [0x2310]


@pytest.mark.slow
def test_a_speed_without_a_unit_is_told_in_rpm_where_the_axis_hardly_moved(jog):
    run, drives = jog
    before = drives.read(0x6064)[0]
    found = run("30", "--for", "0.1")
    assert abs(drives.read(0x6064)[0] - before) < 16
    assert found.exit_code == 1, found.output
    assert "The speed was 30 pps (0.0274658 rpm) (if 30 rpm are meant, write '30 rpm'). Else check" in found.stderr


@pytest.mark.parametrize(
    ("speed", "text"),
    [("300", "300 pps (0.274658 rpm) (if 300 rpm are meant, write '300 rpm')"), ("300 pps", "300 pps (0.274658 rpm)")],
)
def test_a_speed_in_words(speed, text):
    from drive_env.commands.jog import _speed_in_words
    from drive_env.devices import find_device

    entry = find_device("tmcm1636").new_dictionary().find(0x60FF)
    assert _speed_in_words(speed, 300, entry, 65536.0) == text
    assert _speed_in_words("300", 300, entry, None) == "300 pps (if 300 rpm are meant, write '300 rpm')"
    assert (
        _speed_in_words("300", 300, dataclasses.replace(entry, unit=""), None)
        == "300, in a unit that the EDS does not tell"
    )
    rpm = find_device("tmcm1636_fw109").new_dictionary().find(0x60FF)
    assert _speed_in_words("300", 300, rpm, 65536.0) == "300 rpm"
