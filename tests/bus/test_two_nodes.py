"""Two nodes with one node-ID, as after 1011h and a reset: who opens, reads or scans them is told."""

import json
import uuid

import can
import pytest
from rigs.world_bus import WorldBus
from typer.testing import CliRunner

from drive_env import CanDrives, EmulatedDrives
from drive_env.bus.can_port import CanPort
from drive_env.bus.config import Bus, Machine, build_world
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.canopen.frames import Frame
from drive_env.commands.cli import app
from drive_env.commands.serve import _announce
from drive_env.fieldbus.errors import BusError

LOAD, SAVE = 0x64616F6C, 0x65766173
SAID = "two nodes answer as 1: switch all but one of them off, and give it another node-ID"


@pytest.fixture
def world():
    """Nodes 1 and 2, of which the second one was given its factory values: it boots as node 1."""
    made = World(lockstep=True)
    made.add(EmulatedDrives("tmcm1636", "inertia", num_threads=1), (1,))
    made.add(EmulatedDrives("tmcm1636", "inertia", num_threads=1), (2,))
    yield made
    made.close()


def restore_factory(world):
    made = WorldBus(world)
    with CanDrives(bus=made, nodes=(2,), pace="lockstep", safety=False) as drives:
        drives.write((0x1011, 1), LOAD)
    made.shutdown()
    world.receive(Frame(0x000, bytes((0x81, 2))))
    assert [node.node_id for node in world.nodes.values()] == [1, 1]


@pytest.fixture
def twins(world):
    restore_factory(world)
    return world


@pytest.mark.parametrize("device", ["tmcm1636", "tgz_d"])
def test_drives_are_not_opened_that_are_two(twins, device):
    """Before: they were opened, and whichever answered first was read."""
    bus = WorldBus(twins)
    with pytest.raises(BusError, match=SAID):
        CanDrives(device, bus=bus, pace="lockstep")
    bus.shutdown()


def test_two_that_are_not_of_one_kind_are_told_alike(world):
    world.add(EmulatedDrives("tmcm6212", num_threads=1), (3,))
    bus = WorldBus(world)
    world.nodes[3]._given_id = 1  # as a node of its own would store it
    world.nodes[3].power_on(world.time)
    for device in ("tmcm1636", "tmcm6212"):
        with pytest.raises(BusError, match=SAID):
            CanDrives(device, bus=bus, pace="lockstep")
    bus.shutdown()


def test_one_answer_that_is_repeated_makes_no_second_node(world):
    bus = WorldBus(world)
    twice = []
    hear = bus._hear

    def repeat(ended):
        hear(ended)
        if ended.frame.can_id == 0x581 and not twice:
            twice.append(ended)
            hear(ended)

    world.listeners[:] = [repeat]
    with CanDrives(bus=bus, pace="lockstep") as drives:
        assert drives.read(0x6041).shape == (1,)
    assert twice
    bus.shutdown()


@pytest.mark.slow
def test_scan_and_get_tell_of_them(twins, monkeypatch):
    """Before: scan showed one node 1, and get one drive's value."""
    twins.lockstep = False
    channel = str(uuid.uuid4())
    monkeypatch.setenv("DRIVE_ENV_INTERFACE", "virtual")
    monkeypatch.setenv("DRIVE_ENV_CHANNEL", channel)
    with Server(twins, CanPort(can.Bus(interface="virtual", channel=channel))):
        scanned = CliRunner().invoke(app, ["scan", "--last", "1", "--timeout", "3"])
        rows = CliRunner().invoke(app, ["scan", "--last", "1", "--timeout", "3", "--json"])
        got = CliRunner().invoke(app, ["get", "6041", "--timeout", "20"])
    assert scanned.stdout.startswith(f"node 1  {SAID}")
    assert [(row["node"], row["answers"]) for row in json.loads(rows.stdout)] == [(1, 2)]
    assert got.exit_code == 1 and SAID in got.stderr.replace("\n", " ")


def test_serve_prints_the_node_id_that_boots(tmp_path, capsys):
    """Before: the one of its arguments, under which nobody answers."""
    bus = Bus(store=str(tmp_path), machines=(Machine(load="inertia", nodes=(5,)),))
    for said in ("node 5 (tmcm1636, ", "node 33 (in its store; 5 was given) (tmcm1636, "):
        world = build_world(bus, lockstep=True)
        server = Server(world, Hub(0))
        _announce(server, bus, False, None, None, None)
        server.close()
        assert said in capsys.readouterr().out
        given = world.nodes[5].node_id
        other = WorldBus(world)
        with CanDrives(bus=other, nodes=(given,), pace="lockstep", safety=False) as drives:
            drives.write(0x2705, 33)
            drives.write(0x2706, SAVE)
        other.shutdown()
        world.close()
