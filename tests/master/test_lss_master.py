"""`drive-env lss` and the master behind it, over a hub in real time and as frames."""

from __future__ import annotations

import json
import time

import pytest
from rigs import TESTS
from typer.testing import CliRunner

from drive_env import EmulatedDrives
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.canopen.lss import LssIdentity
from drive_env.canopen.node import Node
from drive_env.commands.cli import app
from drive_env.master.can.lss import show

DEVICE = str(TESTS / "all_services.toml")
FIRST = LssIdentity(0x286, 0x664, 0x10009, 128)  # of the first node without a node-ID on a bus
SECOND = FIRST._replace(serial=129)
TIMEOUT = 0.1


@pytest.fixture(scope="module")
def drives():
    with EmulatedDrives(DEVICE, load="inertia", num_machines=2, num_threads=1) as made:
        yield made


class Served:
    """Two nodes behind a hub."""

    def __init__(self, drives, node_ids, store):
        drives.machine.reset()
        self.world = World(lockstep=False)
        self.nodes: list[Node] = self.world.add(drives, node_ids, store)
        self.world.power_on()
        self.hub = Hub()
        self.server = Server(self.world, self.hub)

    def run(self, *arguments):
        """Run the command; return its exit code and all that it said."""
        arguments = (*arguments, "--channel", self.hub.channel)
        if "--dry-run" not in arguments:
            arguments = (*arguments, "--timeout", str(TIMEOUT))
        found = CliRunner().invoke(app, ["lss", *arguments])
        return found.exit_code, found.output

    def wait_for(self, condition):
        end = time.monotonic() + 30.0
        while not condition():
            assert time.monotonic() < end, "it never came"
            time.sleep(0.005)

    def restart(self):
        for node in self.nodes:
            node.power_on(self.world.time)
        return [node.node_id for node in self.nodes]


@pytest.fixture
def serve(drives, tmp_path):
    entered = []

    def made(*node_ids):
        served = Served(drives, node_ids, tmp_path)
        entered.append(served.server)
        served.server.__enter__()
        return served

    yield made
    for server in entered:
        server.__exit__(None, None, None)


@pytest.mark.slow
def test_two_nodes_without_a_node_id_are_found_and_get_theirs(serve):
    served = serve(255, 255)
    code, said = served.run("scan", "--json")
    assert code == 0, said
    assert {row["identity"] for row in json.loads(said)} == {show(FIRST), show(SECOND)}
    code, said = served.run("node-id", "9", "--yes")
    assert code == 1  # which of the two?
    assert "2 nodes have no node-ID; choose one with --identity: " in said
    assert show(SECOND) in said
    assert served.run("node-id", "9", "--yes", "--identity", show(SECOND)) == (
        0, f"the node {show(SECOND)} has the node-ID 9\n"
    )  # fmt: skip
    served.wait_for(lambda: served.nodes[1].node_id == 9)  # it boots
    assert served.nodes[0].node_id == 255
    assert served.run("node-id", "7", "--yes")[0] == 0  # the one that is left
    code, said = served.run("scan")
    assert code == 1
    assert "no node without a node-ID answered" in said
    assert served.restart() == [7, 9]  # they keep it


@pytest.mark.slow
def test_a_node_gets_another_node_id_with_its_reset(serve):
    served = serve(5, 6)
    code, said = served.run("node-id", "6", "--node", "5", "--yes")
    assert (code, "node-ID 6 is taken" in said) == (2, True)
    code, said = served.run("node-id", "8", "--node", "5", "--yes", "--no-store")
    assert (code, said) == (
        0, "node 5 has the node-ID 8; it takes effect with the next reset (NMT, or power); it is lost with the power\n",
    )  # fmt: skip
    assert [node.node_id for node in served.nodes] == [5, 6]
    assert served.run("node-id", "9", "--node", "5", "--yes", "--reset")[0] == 0
    served.wait_for(lambda: served.nodes[0].node_id == 9)
    assert [node.node_id for node in served.nodes] == [9, 6]
    assert served.restart() == [9, 6]


def test_a_node_named_by_its_identity_has_a_new_node_id_no_sooner_than_one_named_by_its_old(serve):
    served = serve(5, 6)
    identity = show(FIRST._replace(serial=5))
    code, said = served.run("node-id", "8", "--identity", identity, "--yes")
    assert (code, said) == (
        0, f"the node {identity} has the node-ID 8; it takes effect with the next reset (NMT, or power)\n"
    )  # fmt: skip
    assert [node.node_id for node in served.nodes] == [5, 6]
    assert served.restart() == [8, 6]


@pytest.mark.every(3)
@pytest.mark.parametrize(
    ("node", "new", "arguments", "said"),
    [
        (5, "9", ("--node", "5", "--reset"), "does not answer under it within 0.5 s"),
        (255, "9", (), "does not answer under it within 0.5 s"),  # it is searched for, which takes seconds
        (5, "255", ("--node", "5", "--reset"), "after 0.5 s it still answers under 5"),
    ],
)
def test_a_node_that_does_not_boot_is_told(serve, monkeypatch, node, new, arguments, said):
    """It took the node-ID, and its firmware hangs: what it answered to LSS is no proof."""
    monkeypatch.setattr("drive_env.commands.lss.BOOT_TIMEOUT", 0.5)
    monkeypatch.setattr(Node, "_restart", lambda *arguments: None)
    served = serve(node, 6)
    found = served.run("node-id", new, *arguments, "--yes")
    assert (found[0], said in found[1].replace("\n", " ")) == (1, True), found


def test_a_bit_rate_is_stored_for_the_next_power_on(serve):
    served = serve(5, 6)
    code, said = served.run("bit-rate", "500000", "--node", "5", "--yes")
    assert (code, said) == (0, "node 5 has 500000 bit/s with the next power-on\n")
    assert [node.bit_rate for node in served.nodes] == [1000, 1000]
    served.restart()
    assert [node.bit_rate for node in served.nodes] == [500, 1000]


def test_an_activated_bit_rate_takes_the_node_off_this_bus(serve):
    served = serve(5, 6)
    assert served.run("bit-rate", "250000", "--node", "5", "--yes", "--no-store", "--activate", "0.02") == (
        0,
        "node 5 changes to 250000 bit/s in 0.02 s; it is lost with the power; open the bus with it to see that it is "
        "there\n",
    )
    served.wait_for(lambda: served.nodes[0].bit_rate == 250)
    code, said = served.run("bit-rate", "1000000", "--node", "5", "--yes")
    assert code == 1
    assert "did not answer" in said
    served.restart()
    assert served.nodes[0].bit_rate == 1000


def test_what_a_node_refuses_is_said(serve):
    served = serve(5, 6)
    code, said = served.run("bit-rate", "20000", "--node", "5", "--yes")
    assert code == 1
    assert "the node refuses 20000 bit/s (error 1, 0); choose one that its manual lists" in said
    code, said = served.run("node-id", "8", "--identity", "1:2:3:4", "--yes")
    assert code == 1
    assert "no LSS slave has the identity 1:2:3:4" in said


@pytest.mark.slow
def test_after_an_error_all_slaves_wait(serve):
    served = serve(255, 6)
    assert served.run("node-id", "8", "--identity", show(FIRST), "--yes", "--reset")[0] == 2
    assert served.run("bit-rate", "20000", "--yes")[0] == 1
    served.wait_for(lambda: not any(node._lss.is_configuring for node in served.nodes))  # its last frame has no answer


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("node-id", "0"), "node-ID 0 is impossible: CANopen has 1 to 127, and 255 takes it away"),
        (("node-id", "128"), "node-ID 128 is impossible"),
        (("node-id", "5", "--node", "5"), "node 5 has the node-ID 5 already"),
        (("node-id", "5", "--node", "6", "--identity", "1:2:3:4"), "--identity and --node name a node both"),
        (("node-id", "5", "--identity", "1:2:3"), "'1:2:3' is no identity"),
        (("node-id", "5", "--dry-run"), "--dry-run cannot find out which node is there; name it with --identity"),
        (("node-id", "5", "--reset"), "--reset is for a node that has a node-ID; name it with --node"),
        (("bit-rate", "123456"), "123456 bit/s is no bit rate of LSS; there are 1000000, 800000, 500000"),
        (("bit-rate", "500000", "--no-store"), "neither stored nor activated it would come to nothing"),
        (("bit-rate", "500000", "--activate", "0"), "--activate 0 s must be 0.001 s to 60 s"),
        (("bit-rate", "500000", "--activate", "nan"), "--activate nan s must be"),
        (("scan", "--timeout", "0"), "--timeout 0 s must be above 0 s"),
    ],
)
def test_a_mistake_is_told_before_anything_is_sent(arguments, said):
    found = CliRunner().invoke(app, ["lss", *arguments, "--channel", "socket://127.0.0.1:1"])
    assert found.exit_code == 2
    assert said in found.output


def test_a_dry_run_shows_the_frames():
    found = CliRunner().invoke(
        app, ["lss", "bit-rate", "500000", "--identity", "286:664:10009:5", "--activate", "0.1", "--dry-run"]
    )
    assert found.exit_code == 0
    assert found.output.splitlines() == [
        "7E5   [8]  04 00 00 00 00 00 00 00",
        "7E5   [8]  40 86 02 00 00 00 00 00",
        "7E5   [8]  41 64 06 00 00 00 00 00",
        "7E5   [8]  42 09 00 01 00 00 00 00",
        "7E5   [8]  43 05 00 00 00 00 00 00",
        "7E5   [8]  13 00 02 00 00 00 00 00",
        "7E5   [8]  17 00 00 00 00 00 00 00",
        "7E5   [8]  15 64 00 00 00 00 00 00",
        "7E5   [8]  04 00 00 00 00 00 00 00",
    ]
