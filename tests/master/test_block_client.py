"""Our client's block transfers: when it takes them, what it does where they are lost or refused, and how they end."""

from __future__ import annotations

import random
from collections import deque
from pathlib import Path

import pytest
from rigs import TESTS

from drive_env import EmulatedDrives, cia402
from drive_env.bus.wire import Wire
from drive_env.bus.world import World
from drive_env.canopen.frames import Frame
from drive_env.canopen.node import Node
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.fieldbus.errors import BusError
from drive_env.master.can.block_transfer import BLOCK_FROM
from drive_env.master.can.port import Port
from drive_env.master.can.sdo import SdoClient

DEVICE = str(TESTS / "all_services.toml")
DATA = 0x2F01
UPLOAD, DOWNLOAD = 5, 6  # client command specifiers of blocks


@pytest.fixture(scope="module")
def drives():
    with EmulatedDrives(DEVICE, load="inertia", num_threads=1) as made:
        yield made


class NodePort(Port):
    """A port with a node behind it; frames of either direction are lost by their number."""

    def __init__(self, drives):
        self._handlers, self.sent, self.answers = {}, [], deque()
        self.lost, self.lost_answers, self.answered = set(), set(), 0
        self.drives, self.now, self.after = drives, 0.0, None
        self.node = Node(5, drives, send=self._take)
        self.node.power_on(0.0)

    def _take(self, frame):
        self.answered += 1
        if self.answered not in self.lost_answers:
            self.answers.append(frame)

    def send(self, can_id, data=b"", *, remote=False, length=0):
        self.sent.append(bytes(data))
        if len(self.sent) not in self.lost:
            self.node.receive(Frame(can_id, bytes(data)), self.now)
        if self.after is not None:
            self.after(len(self.sent))

    def receive(self, timeout=0.0, done=None):
        if not self.answers:
            return False
        frame = self.answers.popleft()
        if frame.can_id in self._handlers:
            self._handlers[frame.can_id](frame.data)
        return True

    def blocks(self):
        """Return the block specifiers among the requests, but those of segments."""
        return [data[0] >> 5 for data in self.sent if data[0] in (0xA4, 0xC6)]


@pytest.fixture
def port(drives):
    drives.machine.reset()
    made = NodePort(drives)
    made.answers.clear()
    made.answered = 0
    return made


def client_of(port):
    return SdoClient(port, 5)


def write(client, data, index=DATA):
    client.write(index, 0, data, "data", 0.02)


def read(client, index=DATA):
    return client.read(index, 0, "data", 0.02)


@pytest.mark.parametrize(("size", "in_blocks"), [(1, 0), (BLOCK_FROM - 1, 0), (BLOCK_FROM, 1), (889, 1), (4096, 1)])
def test_what_is_long_goes_in_blocks(port, size, in_blocks):
    client, content = client_of(port), random.Random(size).randbytes(size)
    write(client, content)
    assert port.blocks() == [DOWNLOAD] * in_blocks
    port.sent.clear()
    assert read(client) == content
    assert port.blocks() == [UPLOAD] * in_blocks
    if in_blocks:  # an answer for a sub-block, and not for each segment
        assert len(port.sent) == 5 + -(-size // 889)


def test_a_download_that_loses_frames_arrives(port):
    client, content = client_of(port), random.Random(3).randbytes(1400)
    port.lost = {2, 50, 127, 140, 200}
    write(client, content)
    assert port.node.dictionary.port(DATA, 0).read().encode("latin-1") == content
    assert len(port.sent) > 1400 // 7 + 2


@pytest.mark.parametrize("lost", [{3}, {100, 101}, {128}, {130}, {202}, {3, 128, 200}])
def test_an_upload_that_loses_frames_arrives(port, lost):
    content = random.Random(4).randbytes(1400)
    port.node.dictionary.port(DATA, 0).write_text(content.decode("latin-1"))
    port.lost_answers = lost  # 1 and 2 begin the transfers
    assert read(client_of(port)) == content
    assert port.answered > 200 + 3


def test_a_server_without_blocks_is_asked_once(tmp_path):
    text = Path(DEVICE).read_text().replace("block_size = 127", "")
    (tmp_path / "device.toml").write_text(text)
    with EmulatedDrives(str(tmp_path / "device.toml"), load="inertia", num_threads=1) as drives:
        port = NodePort(drives)
        client, content = client_of(port), random.Random(5).randbytes(400)
        for _ in range(2):
            write(client, content)
            assert read(client) == content
        assert port.blocks() == [DOWNLOAD]


@pytest.mark.parametrize("frame", [3, 50, 128])
def test_a_stop_gets_through_a_block_download(port, drives, frame):
    """A write of the supervisor must not be taken for a segment: the transfer is given up for it."""
    for word in (6, 7, 15):
        port.node.dictionary.port(cia402.CONTROLWORD, 0).write(word)
        drives.advance(0.001)
    assert port.node.dictionary.port(cia402.STATUSWORD, 0).read() & 0x6F == 0x27
    client = client_of(port)

    def stop(count):
        if count == frame:
            port.after = None
            client.command(cia402.CONTROLWORD, 0, b"\0\0")

    port.after = stop
    with pytest.raises((BusError, ObjectAccessError)):
        write(client, bytes(1400))
    drives.advance(0.001)
    assert port.node.dictionary.port(cia402.STATUSWORD, 0).read() & 0x6F == 0x40
    assert port.node.dictionary.port(DATA, 0).read() == ""
    port.answers.clear()
    write(client, b"again")
    assert read(client) == b"again"


# --- in a world -------------------------------------------------------------------------------------------------------
class WorldPort(NodePort):
    """The same on a world's bus, whose time passes as somebody waits."""

    def __init__(self, world):
        self._handlers, self.answers, self.world, self.sent = {}, deque(), world, []
        world.listeners.append(lambda ended: self.answers.append(ended.frame) if ended.sender != "master" else None)

    def send(self, can_id, data=b"", *, remote=False, length=0):
        self.sent.append(bytes(data))
        while self.world.wire.waiting("master") > 8:
            self.world.run_until(self.world.time + 1e-3)
        self.world.receive(Frame(can_id, bytes(data)))

    def receive(self, timeout=0.0, done=None):
        if not self.answers and not self.world.lockstep:
            self.world.run_until(self.world.time + 1e-3)
        return super().receive(timeout, done)


@pytest.mark.every(3)
@pytest.mark.parametrize(("lockstep", "bit_rate"), [(True, 1_000_000), (False, 1_000_000), (False, 125_000)])
def test_the_eds_over_a_bus(drives, lockstep, bit_rate):
    """36 kB: no buffer overflows at any bit rate, in lockstep neither."""
    drives.machine.reset()
    world = World(lockstep=lockstep, wire=Wire(bit_rate, instant=lockstep))
    (node,) = world.add(drives, (5,))
    world.power_on()
    port = WorldPort(world)
    begun = world.time
    content = SdoClient(port, 5).read(0x1021, 0, "EDS", 5.0)
    assert content.decode() == drives.device.eds.read_text()
    assert port.blocks() == [UPLOAD]
    assert world.wire.statistics.lost == 0
    assert node.dictionary.port(0x1003, 0).read() == 0
    if not lockstep:
        segments = len(content) / 7
        assert world.time - begun > segments * max(node._device.canopen.sdo_time, 111 / bit_rate)
        assert world.time - begun < segments * max(node._device.canopen.sdo_time, 135 / bit_rate) * 1.3
