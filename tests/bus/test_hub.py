"""The slcan hub and the python-can port, with stock clients, and what neither rubbish nor a lost client may do."""

import re
import socket
import struct
import subprocess
import sys
import threading
import time
import tracemalloc
import uuid
from contextlib import contextmanager, suppress

import can
import canopen
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rigs import TESTS
from rigs.echo_hub import Echo, serving

from drive_env import EmulatedDrives, motion
from drive_env.bus.can_port import CanPort
from drive_env.bus.faults import Faults
from drive_env.bus.hub import CHUNK, LOG_LINES, MAX_CLIENTS, MAX_STRANGERS, MAX_UNSENT, MAX_WAITING, Hub
from drive_env.bus.server import EARLY, Server
from drive_env.bus.slcan import MAX_LINE, TOKEN_WANTED, Channel, format_frame, parse_frame
from drive_env.bus.wire import Wire
from drive_env.bus.world import World
from drive_env.canopen.frames import Frame
from drive_env.fieldbus.errors import OpenError
from drive_env.master.can.port import open_bus
from drive_env.master.can.slcan_socket import SlcanSocket


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


def eventually(condition, timeout=30.0):
    """Wait until a condition holds [s]."""
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, "it never came to hold"
        time.sleep(0.005)


def closed(connection, timeout=30.0):
    """Whether the hub has closed a connection, once all that it sent is read."""
    connection.settimeout(timeout)
    try:
        while connection.recv(1 << 16):
            pass
    except TimeoutError:
        return False
    except OSError:  # with something unread in it
        pass
    return True


def is_answered(bus, timeout=30.0):
    """Whether an answer of the echo comes, whatever else comes before it."""
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        answer = bus.recv(0.2)
        if answer is not None and answer.arbitration_id == 0x581:
            return True
    return False


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
    count = 1_000
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
def test_each_client_has_time_stamps_or_not(hub):
    with joined(hub) as bus, plain(hub) as stamped, plain(hub) as bare:
        assert answers(stamped, b"Z1\rO\r", 2) == answers(bare, b"Z0\rO\r", 2) == b"\r\r"
        bus.send(message(0x123, b"\x01"))
        assert answers(bare, b"", 8) == b"t123101\r"
        assert re.fullmatch(rb"t123101[0-9A-F]{4}\r", answers(stamped, b"", 12))


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


@pytest.mark.every(5)
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


def test_so_it_is_where_the_bus_takes_its_time():
    with serving(lockstep=False, wire=Wire(10_000)) as server, joined(server.transport, bitrate=10_000) as bus:
        with plain(server.transport) as connection:
            connection.sendall(b"S0\rO\r" + b"".join(b"t1231%02X\r" % k for k in range(20)))
        assert [m.data[0] for m in received(bus, 20)] == list(range(20))
        eventually(lambda: len(server.transport._clients) == 1)  # and then it is forgotten


def test_a_port_that_is_taken_is_refused(hub):
    with pytest.raises(OSError, match=r"[Aa]ddress"):
        Hub(hub.port)


def test_it_listens_on_loopback(hub):
    assert hub.host == "127.0.0.1"
    assert hub.channel == f"socket://127.0.0.1:{hub.port}"


# --- idle clients ---------------------------------------------------------------------------------------------------
def crowd(hub, count, say=b""):
    """Clients that say one thing and then nothing."""
    connections = []
    for _ in range(count):
        connections.append(socket.create_connection((hub.host, hub.port), timeout=10))
        connections[-1].sendall(say)
    return connections


@pytest.mark.every(3)
@pytest.mark.parametrize("say", [b"", b"V\r", b"O\r"], ids=["nothing", "a command", "open"])
def test_idle_clients_lock_nobody_out(hub, monkeypatch, caplog, say):
    monkeypatch.setattr("drive_env.bus.hub.BUSY", 0.05)
    connections = crowd(hub, MAX_CLIENTS, say)
    try:
        eventually(lambda: len(hub._clients) == MAX_CLIENTS)
        time.sleep(0.1)  # longer than BUSY: they are silent
        for _ in range(3):
            with joined(hub) as bus:
                bus.send(message(0x601, b"\x01"))
                assert len(received(bus, 1)) == 1
                assert len(hub._clients) <= MAX_CLIENTS
        assert closed(connections[0])  # the oldest made room
        assert "was dropped: a newcomer needs its place, and it has " in caplog.text
        assert not closed(connections[-1], 0.05)
    finally:
        for connection in connections:
            connection.close()


def test_a_master_at_work_keeps_its_place_in_any_crowd(hub):
    with joined(hub) as bus:
        connections = []
        for k in range(3 * MAX_CLIENTS):
            connections += crowd(hub, 1, b"O\r" if k % 2 else b"")
            bus.send(message(0x601, bytes([k])))
            assert [m.data[0] for m in received(bus, 1)] == [k]
        for connection in connections:
            connection.close()


def test_who_floods_gives_way_to_a_newcomer(monkeypatch, hub, caplog):
    monkeypatch.setattr("drive_env.bus.hub.MAX_CLIENTS", 2)
    monkeypatch.setattr("drive_env.bus.hub.BUSY", 0.2)
    with flood(hub.channel), flood(hub.channel):
        eventually(lambda: all(time.monotonic() - client.behind_since > 0.2 for client in hub._clients))
        with joined(hub) as bus:
            bus.send(message(0x601, b"\x01"))
            assert is_answered(bus)
    assert "it sends more than the bus takes" in caplog.text


def test_where_all_are_busy_a_newcomer_is_turned_away_and_told_of(monkeypatch, hub, caplog):
    monkeypatch.setattr("drive_env.bus.hub.MAX_CLIENTS", 2)
    monkeypatch.setattr("drive_env.bus.hub.BUSY", 60.0)
    with joined(hub) as left, joined(hub) as right:
        with plain(hub) as extra:
            assert closed(extra)
        assert "was turned away: 2 clients are on the bus, and all of them are busy" in caplog.text
        left.send(message(0x123))
        assert [m.arbitration_id for m in received(right, 1)] == [0x123]


def test_clients_that_leave_frames_behind_do_not_pile_up(monkeypatch):
    with serving(lockstep=False, wire=Wire(10_000)) as server:  # 80 frames a second
        hub, wire = server.transport, server.world.wire
        for _ in range(4 * MAX_CLIENTS):
            with plain(hub) as connection:
                assert answers(connection, b"S0\rO\r" + b"t7FF81122334455667788\r" * 20, 2) == b"\r\r"
        assert wire.statistics.most_waiting <= (MAX_CLIENTS + 1) * MAX_WAITING
        assert len(hub._clients) <= MAX_CLIENTS
        assert len(wire._senders) <= MAX_CLIENTS + 1
        with joined(hub, bitrate=10_000) as bus:
            bus.send(message(0x601, b"\x01"))
            assert is_answered(bus)


@pytest.mark.slow
def test_a_crowd_does_not_fill_the_log(monkeypatch, hub, caplog):
    monkeypatch.setattr("drive_env.bus.hub.MAX_CLIENTS", 1)
    connections = crowd(hub, 5 * LOG_LINES)
    eventually(lambda: closed(connections[-2]))
    assert caplog.text.count("was dropped") == LOG_LINES
    monkeypatch.setattr("drive_env.bus.hub.LOG_TIME", 0.0)
    connections += crowd(hub, 2)
    eventually(lambda: caplog.text.count("was dropped") > LOG_LINES)
    assert "more lines about clients were left out" in caplog.text
    for connection in connections:
        connection.close()


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX file numbers")
def test_without_a_file_number_a_client_is_turned_away_and_serving_goes_on(monkeypatch, hub, caplog):
    with joined(hub) as bus:
        monkeypatch.setattr("drive_env.bus.hub.FILE_NUMBERS", 0)
        with plain(hub) as extra:
            assert closed(extra)
        assert "this program has too many files open" in caplog.text
        bus.send(message(0x601, b"\x01"))
        assert len(received(bus, 1)) == 1
    with pytest.raises(OSError, match="this program has too many files open"):
        Hub()


def test_who_goes_makes_room_for_who_comes(monkeypatch, caplog):
    monkeypatch.setattr("drive_env.bus.hub.MAX_CLIENTS", 1)
    hub, wire = Hub(), Wire(instant=True)
    try:
        with plain(hub) as old:
            old.sendall(b"O\r")
            while not any(client.was_open for client in hub._clients):
                assert list(hub.wait(1.0, wire)) == []
        with plain(hub) as newcomer:  # both are found in the same turn
            assert list(hub.wait(1.0, wire)) == []
            hub.flush()
            assert not closed(newcomer, 0.05)
            assert len(hub._clients) == 1
    finally:
        hub.close()
    assert caplog.text == ""


# --- clients that do not read ---------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("say", [b"V\r", b"xyz\r"], ids=["answers", "bells"])
def test_who_asks_and_does_not_read_is_dropped_at_a_bounded_cost(hub, caplog, say):
    tracemalloc.start()
    try:
        with plain(hub) as sleeper, joined(hub) as bus:
            tracemalloc.reset_peak()
            before = tracemalloc.get_traced_memory()[0]
            with pytest.raises(OSError):
                for _ in range(20_000):
                    sleeper.sendall(say * 1_000)
            bus.send(message(0x601, b"\x01"))
            assert len(received(bus, 1)) == 1
            assert tracemalloc.get_traced_memory()[1] - before < 2 * MAX_UNSENT
    finally:
        tracemalloc.stop()
    assert caplog.text.count("was dropped") == 1
    assert re.search(r"client 127\.0\.0\.1:\d+ was dropped: it does not read, and \d+ kB wait for it", caplog.text)


def test_who_listens_and_does_not_read_is_dropped_and_nobody_else_loses_a_frame(monkeypatch, hub, caplog):
    monkeypatch.setattr("drive_env.bus.hub.MAX_UNSENT", 10_000)
    count = 0
    with plain(hub) as sleeper, joined(hub) as bus:
        assert answers(sleeper, b"O\r", 1) == b"\r"
        while len(hub._clients) > 1:  # until the kernel's buffers are full
            bus.serialPortOrig.write(b"T1ABCDEF081122334455667788\r" * 2_000)
            bus.send(message(0x601, count.to_bytes(8, "big")))
            assert [int.from_bytes(m.data, "big") for m in received(bus, 1, 30.0)] == [count]
            count += 1
            assert count < 1_000
        assert closed(sleeper)
    assert caplog.text.count("it does not read") == 1


@pytest.mark.slow
def test_who_pauses_loses_nothing_that_fits(hub):
    count = 30_000  # 800 kB
    with plain(hub) as sleeper, plain(hub) as sender:
        assert answers(sleeper, b"O\r", 1) == b"\r"
        for k in range(0, count, 1_000):
            sender.sendall(b"O\r" * (k == 0) + b"".join(b"T1ABCDEF08%016X\r" % n for n in range(k, k + 1_000)))
        eventually(lambda: any(client.blocked for client in hub._clients))
        data = answers(sleeper, b"", 27 * count)
        assert [int(line[10:], 16) for line in data.split()] == list(range(count))
        eventually(lambda: not any(client.blocked for client in hub._clients))


# --- floods ---------------------------------------------------------------------------------------------------------
FLOOD = """
import socket, sys, threading
connection = socket.create_connection((sys.argv[1], int(sys.argv[2])))
connection.sendall(b"O\\r")
def read():
    while connection.recv(65536):
        pass
threading.Thread(target=read, daemon=True).start()
print("it floods", flush=True)
try:
    while True:
        connection.sendall(bytes.fromhex(sys.argv[3]) * 500)
except OSError:
    pass
"""
FRAME = b"t7FF81122334455667788\r"


@contextmanager
def flood(channel, what=FRAME):
    """A process that sends the same as fast as it can, and reads all that comes."""
    host, port = channel.removeprefix("socket://").split(":")
    arguments = [sys.executable, "-c", FLOOD, host, port, what.hex()]
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert process.stdout.readline() == "it floods\n"
        yield
    finally:
        process.kill()
        process.communicate()


def transfers_per_second(bus, seconds=0.5):
    count, start = 0, time.perf_counter()
    while time.perf_counter() < start + seconds:
        bus.send(message(0x601, count.to_bytes(8, "big")))
        while (answer := bus.recv(20.0)).arbitration_id != 0x581:
            pass
        assert int.from_bytes(answer.data, "big") == count
        count += 1
    return count / (time.perf_counter() - start)


SERVE = """
import sys
from rigs.echo_hub import serving
with serving(lockstep=sys.argv[1] == "True") as server:
    print(server.transport.channel, flush=True)
    sys.stdin.read()
"""


@contextmanager
def serving_apart(lockstep):
    """The same in a process of its own, as `drive-env serve` is; yields the channel."""
    arguments = [sys.executable, "-c", SERVE, str(lockstep)]
    with subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=TESTS) as process:
        try:
            yield process.stdout.readline().strip()
        finally:
            process.stdin.close()
            assert process.wait(60) == 0


@pytest.mark.slow
@pytest.mark.parametrize("lockstep", [True, False], ids=["lockstep", "real time"])
@pytest.mark.parametrize("what", [FRAME, b"xyz\r" * 5], ids=["frames", "rubbish"])
def test_a_flood_leaves_a_master_a_third_of_its_transfers(lockstep, what):
    # Apart: in this process the master would wait for Python's lock rather than for its turn at the hub.
    shares = []
    with serving_apart(lockstep) as channel, SlcanSocket(channel) as bus:
        for _ in range(5):  # on a busy machine one of the two may have had bad luck
            alone = transfers_per_second(bus)
            with flood(channel, what):
                shares.append(transfers_per_second(bus) / alone)
            if shares[-1] > 1 / 3:
                break
    assert max(shares) > 1 / 3, shares


def test_clients_take_turns_frame_by_frame():
    hub, wire = Hub(), Wire(instant=True)
    try:
        with plain(hub) as left, plain(hub) as right, plain(hub) as master:
            for connection in (left, right):
                connection.sendall(b"O\r" + FRAME * 5_000)
            master.sendall(b"O\r" + b"t6010\r" * 3)
            order = []
            while order.count(0x601) < 3:
                order += [incoming.frame.can_id for incoming in hub.wait(1.0, wire)]
            first = order.index(0x601)
            assert [k - first for k, can_id in enumerate(order) if can_id == 0x601] == [0, 3, 6]
    finally:
        hub.close()


def test_a_client_has_few_frames_on_their_way_to_the_bus():
    hub, wire = Hub(), Wire()  # nothing leaves this wire: nobody takes
    try:
        with plain(hub) as connection:
            connection.sendall(b"O\r" + FRAME * 5_000)
            for _ in range(30):
                for frame, sender, extended in hub.wait(0.01, wire):
                    wire.send(frame, sender, 0.0, extended)
            (client,) = hub._clients
            assert wire.waiting(client) == MAX_WAITING
            assert 0 < len(client.frames) <= CHUNK // 5
    finally:
        hub.close()


@pytest.mark.slow
@pytest.mark.parametrize("what", [FRAME, b"t" * 1_000, b"\r" * 1_000, b"t7FF8112233", bytes(range(256))])
def test_no_flood_makes_it_grow(what):
    """Frames for a bus of 10 kbit/s, lines without end, empty lines, lines cut short, rubbish."""
    with serving(lockstep=False, wire=Wire(10_000)) as server, joined(server.transport, bitrate=10_000) as bus:
        stop = threading.Event()

        def send(connection):
            with suppress(BrokenPipeError):  # shut down below
                while not stop.is_set():
                    with suppress(TimeoutError):
                        connection.sendall(what * 20)

        with plain(server.transport) as vandal:
            vandal.sendall(b"S0\rO\r")
            vandal.settimeout(0.1)
            threads = [threading.Thread(target=send, args=(vandal,)), threading.Thread(target=closed, args=(vandal,))]
            for thread in threads:
                thread.start()
            tracemalloc.start()
            try:
                time.sleep(0.3)
                before = tracemalloc.get_traced_memory()[0]
                time.sleep(1.0)
                assert tracemalloc.get_traced_memory()[0] - before < 100_000
            finally:
                tracemalloc.stop()
                stop.set()
                vandal.shutdown(socket.SHUT_RDWR)
                for thread in threads:
                    thread.join()
        bus.send(message(0x601, b"\x01"))
        assert is_answered(bus)


# --- a flood and the drives -----------------------------------------------------------------------------------------
@pytest.mark.parametrize(("can_id", "state"), [(0x001, 0x08), (0x7FF, 0x07)], ids=["before all", "behind all"])
def test_under_a_flood_that_outranks_heartbeats_a_turning_drive_stops_by_its_watchdog(can_id, state):
    """The bus is full: with frames that win every arbitration, as on a real bus, or with those that lose it."""
    world = World(lockstep=False)
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        world.add(drives, [1])
        world.power_on()
        motion.enable(drives, mode="pv")
        drives.write("Target velocity", 500_000)
        world.receive(Frame(0x601, bytes.fromhex("23 16 10 01 32 00 7F 00")), "master")  # 1016h: node 127, 50 ms
        world.receive(Frame(0x000, b"\x01\x01"), "master")
        for quarter in range(6_000):  # of a millisecond; the flood's frames that wait take four of them
            world.run_until(quarter / 4e3)
            if quarter % 40 == 0:
                world.receive(Frame(0x77F, b"\x05"), "master")
            if quarter == 2_000:
                assert abs(int(drives.read("Velocity actual value")[0])) > 400_000
            while quarter >= 2_000 and world.wire.waiting("vandal") < MAX_WAITING:  # as the hub hands them on
                world.receive(Frame(can_id, bytes(8)), "vandal")
        assert int(drives.read("Statusword")[0]) & 0x4F == state
        if state == 0x08:
            assert abs(int(drives.read("Velocity actual value")[0])) < 10_000
    world.close()


# --- the token ------------------------------------------------------------------------------------------------------
TOKEN = "a-token_of_chance"


@pytest.fixture
def guarded():
    with serving(token=TOKEN) as server:
        yield server.transport


def test_a_hub_that_others_can_reach_needs_a_token():
    with pytest.raises(ValueError, match=r"0\.0\.0\.0 is not a loopback address: it .* needs a token"):
        Hub(host="0.0.0.0")


@pytest.mark.parametrize("token", ["", "short", "with a space", "x" * 49, "käse-käse"])
def test_a_token_that_cannot_be_is_refused_and_not_repeated(token):
    with pytest.raises(ValueError, match="a token has 8 to 48 letters, digits, - and _") as error:
        Hub(token=token)
    assert not token or token not in str(error.value)


def test_without_the_token_nothing_is_heard_and_nothing_is_told(guarded):
    with joined_by_token(guarded) as bus, plain(guarded) as stranger:
        stranger.sendall(b"O\rV\rt1230\rt6010\r" + b"x" * 200 + b"\r")
        bus.send(message(0x601, b"\x01"))
        assert [m.arbitration_id for m in received(bus, 1)] == [0x581]
        assert bus.recv(0.1) is None
        stranger.settimeout(0.2)
        assert stranger.recv(100) == TOKEN_WANTED
        with pytest.raises(TimeoutError):
            stranger.recv(100)
        stranger.sendall(b"K" + TOKEN.encode() + b"\rV\r")
        stranger.settimeout(20.0)
        assert answers(stranger, b"", 7) == b"\rV1013\r"


@contextmanager
def joined_by_token(hub):
    """A stock python-can client, as `drive-env serve` says it joins."""
    with can.Bus(interface="slcan", channel=hub.channel, sleep_after_open=0) as bus:
        bus.serialPortOrig.write(b"K" + TOKEN.encode() + b"\r")
        bus.open()
        assert bus.get_version(20.0) == (10, 13)
        yield bus


def test_a_wrong_token_is_dropped_told_of_and_costs_its_address_a_second(monkeypatch, guarded, caplog):
    monkeypatch.setattr("drive_env.bus.hub.GUESS_TIME", 60.0)
    with joined_by_token(guarded) as bus, plain(guarded) as waiting:
        assert answers(waiting, b"", 2) == TOKEN_WANTED
        with plain(guarded) as guesser:  # two guesses at once: the second one, right, is not looked at
            guesser.sendall(b"Kwrong-token\rK" + TOKEN.encode() + b"\rO\r")
            assert closed(guesser)
        assert closed(waiting, 5.0)  # a guess that waited for the outcome of another one
        with plain(guarded) as again:
            assert closed(again)
        bus.send(message(0x601, b"\x01"))  # who is in stays in
        assert len(received(bus, 1)) == 1
        assert "was dropped: its token is wrong; its address waits 60 s" in caplog.text
        assert TOKEN not in caplog.text
        monkeypatch.setattr("drive_env.bus.hub.GUESS_TIME", 0.0)
        guarded._penalties.clear()
        with joined_by_token(guarded):
            pass


@pytest.mark.parametrize("token", ["", TOKEN[:-1], TOKEN + "x", TOKEN.upper(), "\xff" * 17, "K" + TOKEN])
def test_only_the_whole_token_opens(guarded, token):
    with plain(guarded) as guesser:
        guesser.sendall(b"K" + token.encode("latin-1") + b"\r")
        assert closed(guesser, 5.0)


def test_a_second_guess_waits_until_the_penalty_of_the_first_is_over(guarded, monkeypatch):
    monkeypatch.setattr("drive_env.bus.hub.GUESS_TIME", 0.2)
    compared, ends = 0, time.monotonic() + 0.5
    while time.monotonic() < ends:
        with plain(guarded) as guesser, suppress(OSError):
            told = guesser.recv(2)
            guesser.sendall(b"Kwrong-token\r")
            assert closed(guesser)
            compared += told == TOKEN_WANTED
    assert 1 <= compared <= 4


def test_strangers_take_no_place_from_those_with_the_token(monkeypatch, guarded):
    monkeypatch.setattr("drive_env.bus.hub.BUSY", 0.0)
    with joined_by_token(guarded) as bus:
        connections = crowd(guarded, MAX_CLIENTS + MAX_STRANGERS)
        eventually(lambda: sum(client.channel.locked for client in guarded._clients) <= MAX_STRANGERS)
        assert closed(connections[0])
        assert not closed(connections[-1], 0.05)
        with joined_by_token(guarded) as newcomer:
            for master in (bus, newcomer):
                master.send(message(0x601, b"\x01"))
                assert is_answered(master)
        for connection in connections:
            connection.close()


def test_who_shows_the_token_takes_the_place_of_another_who_has_it(monkeypatch, guarded, caplog):
    monkeypatch.setattr("drive_env.bus.hub.BUSY", 0.0)
    monkeypatch.setattr("drive_env.bus.hub.MAX_CLIENTS", 1)
    with plain(guarded) as old, plain(guarded) as stranger:
        assert answers(old, b"K" + TOKEN.encode() + b"\rO\r", 4) == TOKEN_WANTED + b"\r\r"
        assert answers(stranger, b"", 2) == TOKEN_WANTED
        with joined_by_token(guarded) as bus:
            assert closed(old, 5.0)
            assert not closed(stranger, 0.05)
            bus.send(message(0x601, b"\x01"))
            assert is_answered(bus)
    assert "it has been silent for longest" in caplog.text


def test_who_shows_no_token_in_time_is_dropped(monkeypatch, guarded, caplog):
    monkeypatch.setattr("drive_env.bus.hub.TOKEN_TIME", 0.1)
    with plain(guarded) as stranger:
        assert closed(stranger)
    assert "it has not shown the token within 0.1 s" in caplog.text


def test_our_client_shows_its_token_and_says_what_is_wrong_with_it(monkeypatch, guarded, hub):
    monkeypatch.setattr("drive_env.bus.hub.GUESS_TIME", 0.0)
    monkeypatch.delenv("DRIVE_ENV_TOKEN", raising=False)
    with (
        pytest.raises(OpenError, match="asks for a token; set DRIVE_ENV_TOKEN"),
        open_bus(None, guarded.channel) as bus,
    ):
        bus.recv(20.0)
    with pytest.raises(OpenError, match="refuses the token; take the one that `drive-env serve` printed"):
        open_bus(None, guarded.channel, token="wrong-token")
    with pytest.raises(OpenError, match="a token has 8 to 48 letters") as error:
        open_bus(None, guarded.channel, token="O\rt00081122")
    assert "t000" not in str(error.value)
    with pytest.raises(OpenError, match="a token is for the hub"):
        open_bus("virtual", "x", token=TOKEN)
    monkeypatch.setenv("DRIVE_ENV_TOKEN", TOKEN)
    for place in (guarded, hub):  # one that asks for a token, and one that knows of none
        with open_bus(None, place.channel) as bus:
            bus.send(message(0x601, b"\x05"))
            assert [m.arbitration_id for m in received(bus, 1)] == [0x581]


def test_our_client_does_not_wait_for_ever_for_a_token_to_be_taken(monkeypatch):
    monkeypatch.setattr("drive_env.master.can.slcan_socket.CONNECT_TIMEOUT", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as mute, pytest.raises(OpenError, match="does not answer to the token"):
        SlcanSocket(f"socket://127.0.0.1:{mute.getsockname()[1]}", token=TOKEN)


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
    server.catch_up()
    server.close()
    assert world.cycles <= 1
    assert server.skipped == pytest.approx(3600.0, abs=1.0)
