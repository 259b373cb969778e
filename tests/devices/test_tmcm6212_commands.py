"""`drive-env` on a TMCM-6212 as a user calls it: by node and axis, the others of the node let alone."""

from __future__ import annotations

import json
import uuid

import can
import numpy as np
import pytest
from typer.testing import CliRunner

import drive_env.commands.cli
from drive_env import EmulatedDrives
from drive_env.bus.can_port import CanPort
from drive_env.bus.server import Server
from drive_env.bus.world import World

AXES, TURN = 6, 51200


@pytest.fixture
def bus(monkeypatch):
    """Commands on a node with six belts, their limit switches 0.23 m (5.75 turns) from where they begin; the axes."""
    world = World(lockstep=False)
    drives = EmulatedDrives("tmcm6212", "belt", num_machines=AXES, num_threads=1)
    world.add(drives, [1])
    channel = str(uuid.uuid4())
    for name, value in {"INTERFACE": "virtual", "CHANNEL": channel, "TIMEOUT": "20"}.items():
        monkeypatch.setenv(f"DRIVE_ENV_{name}", value)

    def run(command, *words):
        return CliRunner().invoke(
            drive_env.commands.cli.app, [*command.split(), "--device", "tmcm6212", *map(str, words)]
        )

    with Server(world, CanPort(can.Bus(interface="virtual", channel=channel))):
        yield run, drives
    world.close()


@pytest.mark.slow
def test_objects_of_an_axis(bus):
    run, drives = bus
    assert run("set", "2003", "100", "--axis", 4).stdout == "node 1 axis 4  2003h:00 Maximum current = 100 (64h)\n"
    assert run("set", "0x2403", "90").stdout == "node 1 axis 2  2403h:00 Maximum current axis 2 = 90 (5Ah)\n"
    assert drives.read(0x2003).tolist() == [239, 239, 90, 239, 100, 239]
    assert len(run("get", "2003").stdout.splitlines()) == AXES
    assert run("get", "2003", "--axis", 2, "--json").stdout.startswith('[{"node": 1, "axis": 2, "index": "2003"')
    assert run("get", "300E:1").stdout.count("\n") == 1, "that belongs to the module"
    for words, says in (
        (("get", "2403", "--axis", 1), "2403h:00 Maximum current axis 2 is an object of axis 2, not of --axis 1"),
        (("get", "2003", "--axis", 6), "--axis 6: a tmcm6212 has 6 axes, from 0"),
        (("monitor", "6064", "--axis", 6, "--duration", 0.1), "--axis 6: a tmcm6212 has 6 axes, from 0"),
        (("scope", "6064", "--axis", -1, "--out", "there"), "--axis -1: a tmcm6212 has 6 axes, from 0"),
        (("jog", "1 rev/s", "--axis", 6), "--axis 6: a tmcm6212 has 6 axes, from 0"),
        (("jog", "1 rev/s", "--max-current", "1 A"), "--max-current: tmcm6212 has no current limit in amperes"),
    ):
        found = run(*words)
        assert found.exit_code == 2 and says in found.stderr


@pytest.mark.slow
def test_one_axis_is_jogged_and_the_others_stand(bus, tmp_path):
    run, drives = bus
    before = drives.read(0x6064)
    found = run("jog", "1 rev/s", "--by", "-0.5 rev", "--axis", 3, "--out", tmp_path / "move")
    assert found.exit_code == 0, found.output
    assert found.stdout.startswith("node 1 axis 3 moved by -25600 inc (-0.5 rev)")
    assert (drives.read(0x6064) - before == np.where(np.arange(AXES) == 3, -25600, 0)).all()
    assert (drives.read(0x6041) & 0x4F == 0x40).all()
    head, *rows = (tmp_path / "move.csv").read_text(encoding="utf-8").splitlines()
    assert "6064" in head and "6077" not in head and len(rows) > 50


@pytest.mark.slow
def test_an_axis_that_is_jogged_to_its_limit_switch_stops_there(bus):
    run, drives = bus
    found = run("jog", "--axis", 5, "--for", 3, "--json", "--", "-4 rev/s")
    assert found.exit_code == 1, found.output
    told = json.loads(found.stdout)
    assert "negative limit switch" in told["stopped"] and {one["axis"] for one in told["emergencies"]} == {5}
    place = drives.read(0x6064)[5] / TURN
    assert -6.6 < place < -5.7, "turns; at 4 rev/s with 100 rev/s^2 it needs 0.08"
    assert (drives.read(0x6041) & 0x4F == 0x40).all()
    assert (drives.read(0x6064)[:5] == 0).all()


@pytest.mark.slow
def test_one_axis_is_watched(bus, tmp_path):
    run, _ = bus
    assert run("set", "2004", "3", "--axis", 3).exit_code == 0
    found = run("monitor", "2004", "6041", "--axis", 3, "--duration", 0.1, "--json")
    assert found.exit_code == 0, found.output
    assert json.loads(found.stdout.splitlines()[0])["2004:00"] == [3]
    found = run("monitor", "2004", "--axis", 3, "--duration", 0.1)
    assert "node 1 axis 3" in found.stdout and "axis 2" not in found.stdout
    found = run("scope", "6064", "6041", "--axis", 4, "--duration", "0.02", "--out", tmp_path / "seen")
    assert found.exit_code == 0, found.output
    head, *rows = (tmp_path / "seen.csv").read_text(encoding="utf-8").splitlines()
    assert head.count("6064h") == 1 and len(rows) == 20 and len(rows[0].split(",")) == 3


@pytest.mark.slow
def test_it_is_found_backed_up_and_watched(bus, tmp_path):
    run, _ = bus
    found = CliRunner().invoke(drive_env.commands.cli.app, ["scan", "--last", "1", "--timeout", "20"])
    assert found.stdout.startswith("node 1  tmcm6212  TMCM-6212"), found.output
    assert run("parameters backup", tmp_path / "all.toml").exit_code == 0
    changed = run("set", "6081", "1000", "--axis", 2)
    assert changed.exit_code == 0, changed.output
    found = run("parameters diff", tmp_path / "all.toml", "--axis", 0)
    assert found.exit_code == 1 and "7081h:00" in found.stdout, found.output
    found = run("scope", "6064", "--duration", "0.05", "--out", tmp_path / "seen")
    assert found.exit_code == 0, found.output
    assert (tmp_path / "seen.csv").read_text(encoding="utf-8").count("\n") == 51


@pytest.mark.slow
def test_a_node_of_another_device_is_named(bus):
    found = CliRunner().invoke(drive_env.commands.cli.app, ["get", "6041"])
    assert found.exit_code == 1
    assert "node 1 is not a tmcm1636" in found.stderr
    assert "it is a tmcm6212: name it so (device='tmcm6212', --device tmcm6212)" in found.stderr
