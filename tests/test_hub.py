"""The slcan hub and the python-can port, with stock clients, and what neither rubbish nor a lost client may do."""

import socket
import struct
import time
import uuid
from contextlib import contextmanager

import can
import canopen
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drive_env import EmulatedDrives
from drive_env.bus.can_port import CanPort
from drive_env.bus.faults import Faults
from drive_env.bus.hub import MAX_CLIENTS, Hub
from drive_env.bus.server import EARLY, Server
from drive_env.bus.slcan import MAX_LINE, Channel, format_frame, parse_frame
from drive_env.bus.wire import Wire
from drive_env.bus.world import World
from drive_env.canopen.frames import Frame


class Echo:
    """A node that answers 601h with 581h, and a remote request for 701h with its state."""

    def __init__(self, send):
        self.send = send

    def power_on(self, now):
        pass

    def receive(self, frame, now):
        if frame.rtr and frame.can_id == 0x701:
            self.send(Frame(0x701, b"\x7f"))
        elif frame.can_id == 0x601:
            self.send(Frame(0x581, frame.data))

    before_cycle = after_cycle = power_on


@contextmanager
def serving(**options):
    """A hub with an echo as node 1, in a thread; yields the server."""
    world = World(**options)
    world.attach(1, Echo)
    with Server(world, Hub(bit_rate=world.wire.bit_rate)) as server:
        yield server


@pytest.fixture
def hub():
    with serving() as server:
        yield server.transport


@contextmanager
def joined(hub, **options):
    """A stock python-can client, its channel open."""
    with can.Bus(interface="slcan", channel=hub.channel, sleep_after_open=0, **options) as bus:
        assert bus.get_version(5.0) == (10, 13)  # what was sent before is done
        yield bus


@contextmanager
def plain(hub):
    """A TCP connection to the hub."""
    with socket.create_connection((hub.host, hub.port), timeout=10) as connection:
        yield connection


def answers(connection, command, length):
    connection.sendall(command)
    data = b""
    while len(data) < length:
        data += connection.recv(length - len(data))
    return data


def received(bus, count, timeout=10.0):
    """Return the next frames of a bus; fewer if they do not come in time [s]."""
    end, frames = time.monotonic() + timeout, []
    while len(frames) < count and time.monotonic() < end:
        message = bus.recv(0.2)
        if message is not None:
            frames.append(message)
    return frames


def message(can_id, data=b"", **options):
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False, **options)


# --- stock clients --------------------------------------------------------------------------------------------------
def test_a_client_talks_to_a_node(hub):
    with joined(hub, bitrate=1_000_000) as bus:
        bus.send(message(0x601, bytes.fromhex("40 08 10 00 00 00 00 00")))
        (answer,) = received(bus, 1)
        assert (answer.arbitration_id, answer.data.hex()) == (0x581, "4008100000000000")
        assert not answer.is_extended_id
        assert bus.get_serial_number(5.0) == "DE01"


def test_a_remote_request_is_answered(hub):
    with joined(hub) as bus:
        bus.send(can.Message(arbitration_id=0x701, is_remote_frame=True, dlc=1, is_extended_id=False))
        (answer,) = received(bus, 1)
        assert (answer.arbitration_id, answer.data, answer.is_remote_frame) == (0x701, b"\x7f", False)


def test_clients_see_each_other_and_not_themselves(hub):
    with joined(hub) as left, joined(hub) as right, joined(hub) as third:
        left.send(message(0x123, b"\x01\x02\x03"))
        left.send(can.Message(arbitration_id=0x1ABCDEF0, data=b"\x04", is_extended_id=True))
        right.send(can.Message(arbitration_id=0x321, is_remote_frame=True, dlc=5, is_extended_id=False))
        # Both are served by one thread in the order in which they came; left's came first if right's is sent later.
        assert [m.arbitration_id for m in received(right, 2)] == [0x123, 0x1ABCDEF0]
        (remote,) = received(left, 1)
        assert (remote.arbitration_id, remote.is_remote_frame, remote.dlc) == (0x321, True, 5)
        seen = received(third, 3)
        assert {(m.arbitration_id, m.is_extended_id, m.is_remote_frame, bytes(m.data)) for m in seen} == {
            (0x123, False, False, b"\x01\x02\x03"),
            (0x1ABCDEF0, True, False, b"\x04"),
            (0x321, False, True, b""),
        }
        assert left.recv(0.05) is right.recv(0.05) is None


def test_a_burst_arrives_whole_and_in_order(hub):
    count = 3_000
    with joined(hub) as sender, joined(hub) as listener:
        for k in range(count):
            sender.send(message(0x100 + k % 0x200, k.to_bytes(4, "big")))
        numbers = [int.from_bytes(m.data, "big") for m in received(listener, count, 30.0)]
        assert numbers == list(range(count))


def test_a_burst_of_requests_is_answered_whole_and_in_order(hub):
    count = 1_000
    with joined(hub) as bus:
        for k in range(count):
            bus.send(message(0x601, k.to_bytes(8, "big")))
        assert [int.from_bytes(m.data, "big") for m in received(bus, count, 30.0)] == list(range(count))


def test_the_modelled_wire_holds_back_and_loses_nothing():
    count = 600  # more than the hub takes from a client at once
    with serving(lockstep=False, wire=Wire(250_000)) as server, joined(server.transport, bitrate=250_000) as bus:
        start = time.monotonic()
        for k in range(count):
            bus.send(message(0x601, k.to_bytes(8, "big")))
        assert [int.from_bytes(m.data, "big") for m in received(bus, count, 30.0)] == list(range(count))
        assert time.monotonic() - start > 2 * count * 111 / 250_000  # no frame is shorter


def test_python_canopen_reads_the_device_name():
    world = World()
    drives = EmulatedDrives(load="inertia", num_threads=1)
    world.add(drives, [1])
    with Server(world, Hub()) as server:
        network = canopen.Network()
        network.connect(interface="slcan", channel=server.transport.channel, sleep_after_open=0)
        try:
            node = network.add_node(1, str(drives.device.eds))
            assert node.sdo[0x1008].raw == "TMCM-1636"
            assert node.sdo[0x6041].raw & 0x4F == 0x40  # switch on disabled
        finally:
            network.disconnect()
    world.close()


# --- the adapter ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("command", "answer"), [
    (b"V\r", b"V1013\r"),
    (b"v\r", b"V1013\r"),
    (b"N\r", b"NDE01\r"),
    (b"S8\r", b"\r"),
    (b"s0014\r", b"\r"),          # BTR0 00h, BTR1 14h: 8 MHz / 1 / (3 + 4 + 1) = 1 Mbit/s
    (b"Z1\r", b"\r"),
    (b"M00000000\r", b"\r"),      # acceptance code and mask: everything passes all the same
    (b"C\r", b"\r"),
    (b"\r\r", b""),
    (b"S\r", b"\a"),
    (b"SA\r", b"\a"),
    (b"F\r", b"\a"),              # the channel is closed
    (b"t1230\r", b"\a"),          # the channel is closed
    (b"hello\r", b"\a"),
    (b"O\rF\r", b"\rF00\r"),
    (b"O\rS8\r", b"\r\a"),        # the channel is open
    (b"O\rt1230\r", b"\r"),       # a frame has no answer
    (b"O\rt12381122\r", b"\r\a"),  # eight bytes announced, two follow
    (b"O\rt8000\r", b"\r\a"),     # 11 bits end at 7FFh
    (b"O\rT200000000\r", b"\r\a"),  # 29 bits end at 1FFFFFFFh
    (b"O\rr123211\r", b"\r\a"),   # a remote frame with data
    (b"O\rt1239001122334455667788\r", b"\r\a"),
    (b"L\rt1230\r", b"\r\a"),     # listens only
    (b"S6\rO\rt1230\r", b"\r\a\a"),  # the bus has 1 Mbit/s: the channel stays closed
    (b"O\nt1230\nV\n", b"\rV1013\r"),
    (b"O\r" + b"x" * 1000 + b"\rV\r", b"\r\aV1013\r"),
])  # fmt: skip
def test_commands_are_answered_as_lawicels_manual_says(command, answer):
    assert Channel(1_000_000).feed(command)[1] == answer
    channel = Channel(1_000_000)
    assert b"".join(channel.feed(command[k : k + 1])[1] for k in range(len(command))) == answer


@pytest.mark.parametrize(("line", "frame", "extended"), [
    (b"t12321A2B", Frame(0x123, b"\x1a\x2b"), False),
    (b"t7ff0", Frame(0x7FF, b""), False),
    (b"r7018", Frame(0x701, b"", rtr=True, dlc=8), False),
    (b"T1FFFFFFF1ff", Frame(0x1FFFFFFF, b"\xff"), True),
    (b"R000000010", Frame(1, b"", rtr=True, dlc=0), True),
])  # fmt: skip
def test_lines_and_frames(line, frame, extended):
    assert parse_frame(line) == (frame, extended)
    assert format_frame(frame, extended).upper() == line.upper() + b"\r"


def test_time_stamps_are_milliseconds_of_a_minute():
    channel = Channel(1_000_000)
    channel.feed(b"Z1\rO\r")
    assert channel.format(Frame(0x123, b"\x01"), False, 60.5) == b"t12310101F4\r"
    channel.feed(b"C\rZ0\rO\r")
    assert channel.format(Frame(0x123, b"\x01"), False, 60.5) == b"t123101\r"


@given(st.lists(st.binary(max_size=200) | st.sampled_from([b"O\r", b"t1232", b"1122", b"\r", b"T", b"\xff" * 100])))
def test_whatever_comes_is_survived_and_bounded(chunks):
    channel = Channel(1_000_000)
    for chunk in chunks:
        channel.feed(chunk)
        assert len(channel._line) <= MAX_LINE
    frames, answer = channel.feed(b"\rO\rt12321122\r")
    assert frames[-1:] == [(Frame(0x123, b"\x11\x22"), False)] or channel.listen_only or not channel.is_open
    if channel.is_open and not channel.listen_only:
        assert (answer + b"\r")[-1:] == b"\r"


# --- what may not end it --------------------------------------------------------------------------------------------
def test_a_client_with_another_bit_rate_stays_off_the_bus(hub, caplog):
    with joined(hub, bitrate=500_000) as deaf, joined(hub, bitrate=1_000_000) as bus:
        bus.send(message(0x123))
        deaf.send(message(0x124))
        assert deaf.recv(0.1) is bus.recv(0.1) is None
        assert "asked for 500 kbit/s and stays off the bus, which has 1000 kbit/s" in caplog.text


def test_rubbish_ends_nothing(hub):
    with plain(hub) as vandal, joined(hub) as bus:
        for data in (
            b"\x00" * 10_000,
            b"t" * 100_000,
            bytes(range(256)) * 50,
            b"\r" * 5_000,
            b"T1FFFFFFF9\r",
            b"tzzz8\r",
        ):
            vandal.sendall(data)
            bus.send(message(0x601, b"\x05"))
            assert [m.arbitration_id for m in received(bus, 1)] == [0x581]
        assert answers(vandal, b"\rC\rV\r", 0) == b""


@pytest.mark.parametrize("how", ["at once", "in a line", "without a word", "reset", "without reading"])
def test_a_client_that_goes_ends_nothing(hub, how):
    connection = socket.create_connection((hub.host, hub.port), timeout=10)
    if how == "in a line":
        connection.sendall(b"O\rt12381122")
    elif how == "reset":
        connection.sendall(b"O\r")
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    elif how == "without reading":
        connection.sendall(b"O\r" + b"V\r" * 1_000)
    if how != "without a word":
        connection.close()
    with joined(hub) as bus:
        for k in range(50):
            bus.send(message(0x601, bytes([k])))
        assert [m.data[0] for m in received(bus, 50)] == list(range(50))
    connection.close()


def test_what_a_client_sent_before_it_went_is_still_heard(hub):
    with joined(hub) as bus:
        with plain(hub) as connection:
            connection.sendall(b"O\rt12311A\rt12411B\r")
        assert [m.arbitration_id for m in received(bus, 2)] == [0x123, 0x124]


def test_one_client_too_many_is_turned_away(hub):
    connections = [socket.create_connection((hub.host, hub.port), timeout=10) for _ in range(MAX_CLIENTS)]
    try:
        for connection in connections:
            assert answers(connection, b"V\r", 6) == b"V1013\r"
        with plain(hub) as extra:
            assert extra.recv(1) == b""
    finally:
        for connection in connections:
            connection.close()
    with joined(hub) as bus:
        bus.send(message(0x601, b"\x01"))
        assert len(received(bus, 1)) == 1


def test_a_client_that_does_not_read_loses_frames_and_nobody_else_does(monkeypatch, hub):
    monkeypatch.setattr("drive_env.bus.hub.MAX_UNSENT", 1_000)
    count = 0
    with plain(hub) as sleeper, joined(hub) as bus:
        assert answers(sleeper, b"O\r", 1) == b"\r"
        while not hub.lost:  # until the kernel's buffers are full, some megabytes
            bus.serialPortOrig.write(b"T1ABCDEF081122334455667788\r" * 2_000)
            bus.send(message(0x601, count.to_bytes(8, "big")))
            assert [int.from_bytes(m.data, "big") for m in received(bus, 1)] == [count]
            count += 1
            assert count < 1_000


def test_an_overrun_shows_in_the_flags_once():
    channel = Channel(1_000_000)
    channel.feed(b"O\r")
    channel.overrun = True
    assert channel.feed(b"F\rF\r")[1] == b"F08\rF00\r"


def test_a_port_that_is_taken_is_refused(hub):
    with pytest.raises(OSError, match=r"[Aa]ddress"):
        Hub(hub.port)


def test_it_listens_on_loopback(hub):
    assert hub.host == "127.0.0.1"
    assert hub.channel == f"socket://127.0.0.1:{hub.port}"


# --- any python-can interface ---------------------------------------------------------------------------------------
@contextmanager
def virtual(**options):
    """An echo on python-can's virtual bus, and a master's bus."""
    name = uuid.uuid4().hex
    world = World(**options)
    world.attach(1, Echo)
    port = CanPort(can.Bus(interface="virtual", channel=name))
    with Server(world, port), can.Bus(interface="virtual", channel=name) as bus:
        yield bus


def test_the_virtual_bus_reaches_the_nodes():
    with virtual() as bus:
        for k in range(300):
            bus.send(message(0x601, bytes([k % 256])))
        assert [m.data[0] for m in received(bus, 300)] == [k % 256 for k in range(300)]
        bus.send(can.Message(arbitration_id=0x701, is_remote_frame=True, dlc=1, is_extended_id=False))
        assert [(m.arbitration_id, bytes(m.data)) for m in received(bus, 1)] == [(0x701, b"\x7f")]
        bus.send(can.Message(arbitration_id=0x601, data=b"\x01", is_extended_id=True))
        bus.send(can.Message(is_error_frame=True))
        bus.send(can.Message(arbitration_id=0x601, data=bytes(12), is_fd=True, is_extended_id=False))
        assert bus.recv(0.1) is None


def test_faults_act_on_any_interface():
    with virtual(wire=Wire(instant=True, faults=Faults(duplicate=1.0, only=(0x581,)))) as bus:
        bus.send(message(0x601, b"\x01"))
        assert [m.arbitration_id for m in received(bus, 2)] == [0x581, 0x581]


def test_an_interface_that_fails_ends_serving_with_its_error():
    class GoneError(Exception):
        pass

    class Unplugged:
        def recv(self, timeout):
            raise GoneError("the adapter is gone")

        def shutdown(self):
            pass

    server = Server(World(), CanPort(Unplugged()))
    with pytest.raises(GoneError, match="the adapter is gone"):
        server.run(1.0)


def test_a_frame_that_the_interface_does_not_take_is_counted(caplog):
    class Full:
        def send(self, sent):
            raise can.CanOperationError("no buffer space")

    port = CanPort(Full())
    world = World()
    world.attach(1, Echo)
    world.listeners.append(port.deliver)
    world.receive(Frame(0x601, b"\x01"), port)
    world.receive(Frame(0x601, b"\x02"), port)
    assert port.lost == 2
    assert caplog.text.count("the interface did not take frame 581") == 1


# --- real time ------------------------------------------------------------------------------------------------------
def test_real_time_follows_the_clock():
    world = World(lockstep=False)
    world.attach(1, Echo)
    server = Server(world, Hub())
    start = time.perf_counter()
    server.run(0.2)
    elapsed = time.perf_counter() - start
    server.close()
    assert 0.0 < world.time + server.skipped <= elapsed + EARLY
    assert world.cycles == server.lateness.count == int(world.time * 1000 + 1e-9) > 0
    assert 0.0 <= server.lateness.percentile(0.5) <= server.lateness.percentile(0.99) <= server.lateness.largest


def test_a_host_that_slept_does_not_catch_up():
    world = World(lockstep=False)
    world.attach(1, Echo)
    server = Server(world, Hub())
    server._start = time.perf_counter() - 3600.0
    server._catch_up()
    server.close()
    assert world.cycles <= 1
    assert server.skipped == pytest.approx(3600.0, abs=1.0)
