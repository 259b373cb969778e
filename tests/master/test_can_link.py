"""The link over CAN over a port of this test: what it sends, whom it tells, what a cycle has room for."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
from rigs.small_eds import U16, U32, described, small_eds

from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.fieldbus.errors import BusError
from drive_env.master.can import can_link
from drive_env.master.can.bus_time import BusTime
from drive_env.master.can.can_link import CanLink
from drive_env.master.can.dry_run import DryPort

STATUS = (0x6041, "Statusword", U16, "ro", 1)
HEARTBEAT = (0x1017, "Producer heartbeat time", U16, "rw", 0)
EMERGENCY = (0x1014, "COB-ID EMCY", U32, "rw", 0)


@pytest.fixture(scope="module")
def drive():
    return described(small_eds([EMERGENCY, HEARTBEAT, STATUS], []), 1)


class Bus:
    """A port whose nodes answer SDOs from their objects; heartbeats come with each answer, if a node sends any."""

    def __init__(self):
        self.sent, self.takers, self.waits, self.closed = [], {}, [], False
        self.objects = {(0x1014, 0): 0x85, (0x1017, 0): 500}
        self.refused, self.beats = set(), 0

    def subscribe(self, can_id, taker):
        if taker is None:
            self.takers.pop(can_id, None)
        else:
            self.takers[can_id] = taker

    def send(self, can_id, data=b"", *, remote=False, length=0):
        self.sent.append((can_id, data.hex(" ").upper()))
        if can_id == 0x605 and data[0] != 0x80:
            key = (int.from_bytes(data[1:3], "little"), data[3])
            for _ in range(self.beats):
                self.takers[0x705](b"\x7f")
            if key in self.refused or key not in self.objects:
                self.takers[0x585](b"\x80" + data[1:4] + (0x06020000).to_bytes(4, "little"))
            elif data[0] == 0x40:
                self.takers[0x585](b"\x43" + data[1:4] + self.objects[key].to_bytes(4, "little"))
            else:
                self.objects[key] = int.from_bytes(data[4:6], "little")
                self.takers[0x585](b"\x60" + data[1:4] + bytes(4))

    def receive(self, timeout=0.0, done=None):
        self.waits.append(timeout)
        return False

    def drain(self):
        pass

    def wait(self, done, timeout):
        self.waits.append(timeout)
        return done()

    def close(self):
        self.closed = True


@pytest.fixture
def bus():
    return Bus()


@pytest.fixture
def link(bus, drive):
    found = CanLink(bus, (5, 7), drive)
    bus.sent.clear()
    return found


def test_nodes_are_commanded_by_nmt(link, bus):
    link.start()
    link.wake(1)
    link.sync()
    assert bus.sent == [(0x000, "01 05"), (0x000, "01 07"), (0x000, "80 07"), (0x080, "")]
    bus.wait = lambda done, timeout: bus.takers[0x707](b"\0") or done()
    link.reset([1])
    assert bus.sent[4:] == [(0x000, "81 07")]
    assert not link.is_dry and link.sdo(1) is link._clients[1]


def test_a_node_that_boots_by_itself_is_told_by_its_number_here(link, bus):
    told = []
    link.hear(lambda: told.append("alive"), told.append)
    bus.takers[0x707](b"\0")
    assert told == [1]
    assert link._clients[1]._has_booted and not hasattr(link._clients[0], "_has_booted")


def test_emergencies_come_from_where_1014h_says(link, bus, drive):
    bus.takers[0x85](bytes.fromhex("11 86 20 01 02 03 04 05"))
    assert [one.code for one in link.take_emergencies()] == [0x8611]
    bus.objects[0x1014, 0] = 0x321
    link.welcome(0)
    assert 0x321 in bus.takers and 0x85 not in bus.takers
    bare = CanLink(Bus(), (5,), described(small_eds([STATUS], []), 1))
    bare.welcome(0)
    assert bare.port.sent == [], "a drive without 1014h has the standard's"


@pytest.mark.parametrize(("beats", "passes"), [(0, False), (1, False), (2, True)])
def test_whether_time_passes_is_seen_by_heartbeats(link, bus, monkeypatch, beats, passes):
    """One may be due at once; two come only where time goes on without SYNC. 1017h has then what it had."""
    slept = []

    def sleep(seconds):
        slept.append(seconds)
        bus.beats = 0
        for _ in range(beats):
            bus.takers[0x705](b"\x7f")

    monkeypatch.setattr(can_link, "time", SimpleNamespace(sleep=sleep))
    bus.beats = 3
    assert link.time_passes() is passes
    assert slept == [0.012] and bus.objects[0x1017, 0] == 500
    requests = [data for can_id, data in bus.sent if can_id == 0x605]
    assert requests == [
        "40 17 10 00 00 00 00 00", "2B 17 10 00 01 00 00 00", "40 17 10 00 00 00 00 00", "2B 17 10 00 F4 01 00 00",
    ]  # fmt: skip
    assert link._network.on_error_control is None


def test_a_drive_that_cannot_send_heartbeats_tells_nothing(link, bus, monkeypatch):
    monkeypatch.setattr(can_link, "time", SimpleNamespace(sleep=lambda seconds: None))
    bus.refused.add((0x1017, 0))
    assert link.time_passes() is None and link._network.on_error_control is None
    bare = CanLink(Bus(), (5,), described(small_eds([STATUS], []), 1))
    assert bare.time_passes() is None and bare.port.sent == []


def test_waiting_is_the_port_s(link, bus):
    assert link.receive() is False and link.receive(0.25) is False and bus.waits == [0.0, 0.25]
    assert link.wait(lambda: True, 0.5) and not link.wait(lambda: False, 0.75) and bus.waits[2:] == [0.5, 0.75]
    link.close()
    assert bus.closed
    link.other_masters()
    assert 0x605 in bus.takers and 0x607 in bus.takers


def test_a_dry_run_imagines_its_nodes(drive):
    lines = []
    link = CanLink(DryPort(lines.append), (5,), drive)
    assert link.is_dry
    link.start()
    assert lines == ["000   [2]  01 05"]


# --- what a cycle has room for ----------------------------------------------------------------------------------------
def pdo(*bits):
    return [SimpleNamespace(bits=one) for one in bits]


def test_frames_of_a_cycle_without_stuff_bits():
    """47 bits of a frame besides its data (ISO 11898-1): SYNC, and of each of two axes 47 + 48 and 47 + 8."""
    groups = [pdo(16, 32), pdo(8)]
    needed = 47 + 2 * (47 + 48 + 47 + 8)
    assert BusTime(1e6, needed * 1e-6 * 1.000001).excess(groups, 2) is None
    assert BusTime(1e6, needed * 1e-6).excess(groups, 2) is None
    assert BusTime(1e6, math.inf).excess(groups, 2) is None
    assert BusTime(1e6, needed * 1e-6 * 0.999999).excess(groups, 2) is not None
    assert BusTime(1e5, 0.002).excess(groups, 2) == (
        "4 PDOs of 2 axes take at least 3.5 ms of a bus of 100 kbit/s, and SYNC comes every 2 ms; record and play "
        "fewer objects at a time, or give a longer cycle (in Python CanDrives(cycle=0.005))"
    )


def test_frames_of_a_cycle_with_all_stuff_bits_leave_a_fifth():
    """Of 34 bits and the data one stuff bit for each 4 behind the first may come."""
    needed = 47 + 2 * (47 + 48 + (34 + 48 - 1) // 4)
    for share, has in ((0.7999, True), (0.8, True), (0.8001, False)):
        assert BusTime(1e6, needed * 1e-6 / share).has_room_besides([pdo(16, 32)], 2) is has
    assert BusTime() == (1_000_000, math.inf), "the highest rate of classical CAN"
    assert BusTime().has_room_besides([pdo(64)] * 100, 100), "where frames take no time"
    assert BusTime(1e6, 47e-6 / 0.79).has_room_besides([], 2)


def test_a_read_that_fails_is_told(link, bus):
    bus.objects.pop((0x1014, 0))
    with pytest.raises(ObjectAccessError, match="1014h:00 COB-ID EMCY"):
        link.welcome(0)
    with pytest.raises(BusError):
        link.reset([0])
