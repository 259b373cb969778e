"""Drives on CAN and on EtherCAT at one load: a description of such a bus, and a program that moves both at once."""

from __future__ import annotations

import json
import socket
import subprocess
import sys

import pytest
from rigs import TESTS
from rigs.namespaces import first_line
from typer.testing import CliRunner

from drive_env.bus.config import Bus, BusConfigError, Machine, build_world, load_bus
from drive_env.commands.cli import app
from drive_env.ethercat.application import AlState
from drive_env.ethercat.coe_node import CoeNode
from drive_env.ethercat.slaves import build_beside

PATIENCE = 240.0  # s; kernels may have to be compiled
TRIES = 4  # in real time, on a computer that may be busy
GANTRY = Machine(device="tgz_s", load="gantry", nodes=(1,), on_ethercat=(1,))
FILE = """
ethercat_channel = "{port}"
[[machines]]
device = "tgz_s"
load = "gantry"
nodes = [1]
on_ethercat = [1]
"""


def test_one_world_has_the_nodes_the_slaves_and_the_time_of_both():
    world = build_world(Bus(machines=(GANTRY,)), lockstep=False)
    beside = build_beside(Bus(machines=(GANTRY,)), world)
    try:
        (drives,) = world.machines
        (slave,) = beside.segment.slaves
        assert list(world.nodes) == [1] and isinstance(slave.application, CoeNode)
        assert drives.num_axes == 2 and beside.drives == [], "the world of CAN lets both advance"
        world.power_on()
        beside.power_on()
        world.run_until(0.05)
        assert (world.cycles, beside.cycles) == (50, 50) and beside.time == world.time == 0.05
        assert slave.state is AlState.INIT
    finally:
        world.close()


@pytest.mark.parametrize(
    ("row", "says"),
    [
        (
            {"nodes": (1, 2)},
            r"take 2 nodes of tgz_s, which drives 1 axes \(1 of them on EtherCAT\); 2 node identifiers",
        ),
        (
            {"on_ethercat": (2,)},
            "on_ethercat = \\[2\\]: load 'gantry' takes 2 of tgz_s; name each at most once, 0 to 1",
        ),
        ({"on_ethercat": (1, 1), "nodes": ()}, "name each at most once"),
        ({"device": "tmcm1636"}, "tmcm1636 has no EtherCAT; take a device that has"),
    ],
)
def test_a_description_that_cannot_be_says_why(row, says):
    machine = Machine(**{"device": "tgz_s", "load": "gantry", "nodes": (1,), "on_ethercat": (1,)} | row)
    with pytest.raises(BusConfigError, match=says):
        build_world(Bus(machines=(machine,)), lockstep=False)


def test_a_file_says_it(tmp_path):
    path = tmp_path / "bus.toml"
    path.write_text(FILE.format(port=34999), encoding="utf-8")
    bus = load_bus(path)
    assert bus.has_both and bus.machines == (GANTRY,)
    assert (bus.ethercat_interface, bus.ethercat_channel) == ("ethercat-udp", "34999")


def program(name, *arguments):
    code = f"from drive_env.programs import {name}; {name}()"
    return [sys.executable, "-c", code, *map(str, arguments)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("more", "says"),
    [
        (["--lockstep"], "have one time, that of the clock: leave --lockstep out"),
        (["--interface", "ethercat-udp"], "machines of this bus are on CAN, too: leave --interface ethercat-udp out"),
    ],
)
def test_what_a_bus_of_both_has_not(tmp_path, more, says):
    path = tmp_path / "bus.toml"
    path.write_text(FILE.format(port=0), encoding="utf-8")
    done = CliRunner().invoke(app, ["serve", "--config", str(path), "--port", "0", *more])
    assert done.exit_code == 2 and says in " ".join(done.stderr.split())


def free_port(kind):
    with socket.socket(socket.AF_INET, kind) as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


@pytest.mark.slow
def test_one_program_moves_a_gantry_by_both_buses_and_its_envelope_stops_it(tmp_path):
    path, can, udp = tmp_path / "bus.toml", free_port(socket.SOCK_STREAM), free_port(socket.SOCK_DGRAM)
    path.write_text(FILE.format(port=udp), encoding="utf-8")
    served = subprocess.Popen(
        program("drive_env", "serve", "--config", path, "--port", can), stdout=subprocess.PIPE, text=True
    )
    try:
        assert f"1 slave on 127.0.0.1:{udp}, beside the nodes on CAN" in first_line(served)
        # It may have come with the line before, and be in Python's buffer.
        assert "node 1 (tgz_s, am3041_e, gantry; 1 on EtherCAT)" in served.stdout.readline()
        for _ in range(TRIES):
            done = subprocess.run(
                [sys.executable, TESTS / "two_buses_master.py", f"socket://127.0.0.1:{can}", str(udp)],
                capture_output=True, text=True, timeout=PATIENCE,
            )  # fmt: skip
            if done.returncode == 0:
                break
            assert "could not be seen for" in done.stderr, done.stderr  # this computer was busy for so long
    finally:
        served.terminate()
        served.wait(PATIENCE)
        served.stdout.close()
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout.splitlines()[-1])
    assert seen["dragged"] > 16_000, "one load: the left motor takes the right end with it"
    assert seen["moved"] == pytest.approx([48_000, 48_000], abs=1600)
    assert seen["words"] == [0x27, 0x27], "operation enabled, both"
    assert "606Ch:00 Velocity actual value" in seen["stopped"] and "quick-stopped" in seen["stopped"]
    assert seen["off"] == [0x40, 0x40] and max(seen["at_rest"]) <= 80
