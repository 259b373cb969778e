"""Our client of an slcan adapter, against an adapter that is a bare socket: Lawicel's lines, whole and in pieces."""

from __future__ import annotations

import os
import socket
import struct
import threading
import time
from types import SimpleNamespace

import can
import pytest

from drive_env.fieldbus.errors import BusError, OpenError
from drive_env.master.can import slcan_socket
from drive_env.master.can.port import Port
from drive_env.master.can.slcan_socket import SlcanSocket

TOKEN = "a-token-of-some-length"


@pytest.fixture
def place():
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(20.0)
        yield listening


def address(place):
    return f"socket://127.0.0.1:{place.getsockname()[1]}"


@pytest.fixture
def joined(place):
    """Our client and the adapter's end, whose channel is open."""
    bus = SlcanSocket(address(place))
    adapter, _ = place.accept()
    adapter.settimeout(20.0)
    assert adapter.recv(100) == b"O\r"
    with adapter:
        yield bus, adapter
    bus.shutdown()


def hears(adapter, size):
    data = b""
    while len(data) < size:
        data += adapter.recv(size - len(data))
    return data


FRAMES = [  # Lawicel's manual: t and r for 11 bits, T and R for 29
    (b"t60182F60600003000000", 0x601, False, False, 8, bytes.fromhex("2F60600003000000")),
    (b"t0000", 0x000, False, False, 0, b""),
    (b"t7FF10A", 0x7FF, False, False, 1, b"\x0a"),
    (b"T1FFFFFFF2A5FF", 0x1FFFFFFF, True, False, 2, b"\xa5\xff"),
    (b"r7011", 0x701, False, True, 1, b""),
    (b"R000007018", 0x701, True, True, 8, b""),
]


@pytest.mark.parametrize(("line", "can_id", "extended", "remote", "length", "data"), FRAMES)
def test_frames_are_lawicels_lines_both_ways(joined, line, can_id, extended, remote, length, data):
    bus, adapter = joined
    adapter.sendall(line + b"\r")
    message = bus.recv(20.0)
    told = (message.arbitration_id, message.is_extended_id, message.is_remote_frame, message.dlc, bytes(message.data))
    assert told == (can_id, extended, remote, length, data)
    assert abs(message.timestamp - time.time()) < 10.0
    bus.send(message)
    assert hears(adapter, len(line) + 1) == line + b"\r"


@pytest.mark.parametrize("answer", [b"\r", b"\a", b"z\r", b"V1013\r", b"t12\r", b"tXYZ0\r", b"t1231Q0\r"])
def test_answers_and_what_is_no_frame_are_passed_over(joined, answer):
    bus, adapter = joined
    adapter.sendall(answer + b"t70117F\r")
    assert bus.recv(20.0).arbitration_id == 0x701
    assert bus.recv(0.0) is None


def test_a_line_in_pieces_is_a_frame_once_it_is_whole(joined):
    bus, adapter = joined
    for piece in (b"t70", b"117", b"F"):
        adapter.sendall(piece)
        assert bus.recv(0.02) is None
    adapter.sendall(b"\rt70105\r")  # the second has a length of 0
    assert [bus.recv(20.0).data for _ in range(2)] == [b"\x7f", b""]


def test_every_line_of_a_piece_is_a_frame_in_its_order(joined):
    bus, adapter = joined
    adapter.sendall(b"".join(b"t%03X0\r" % can_id for can_id in range(0x700, 0x740)))
    assert [bus.recv(20.0).arbitration_id for _ in range(64)] == list(range(0x700, 0x740))


def test_receiving_waits_as_long_as_it_is_told_to(joined):
    bus, _ = joined
    begun = time.monotonic()
    assert bus.recv(0.0) is None
    assert time.monotonic() - begun < 0.2
    begun = time.monotonic()
    assert bus.recv(0.3) is None
    assert time.monotonic() - begun >= 0.3


def test_an_adapter_that_is_gone_is_an_error_and_no_silence(joined):
    bus, adapter = joined
    adapter.close()
    with pytest.raises(can.CanOperationError, match="the other end closed the connection"):
        bus.recv(20.0)


def test_closing_twice_is_closing(joined):
    bus, _ = joined
    bus.shutdown()
    bus.shutdown()
    with pytest.raises(can.CanOperationError, match="is gone"):
        bus.send(can.Message(arbitration_id=1, is_extended_id=False))


def test_an_adapter_that_takes_nothing_is_told_of_in_time(joined):
    bus, _ = joined
    message = can.Message(arbitration_id=0x601, data=bytes(8), is_extended_id=False)
    with pytest.raises(can.CanOperationError, match="the other end takes nothing"):
        for _ in range(2_000_000):
            bus.send(message, 0.05)


@pytest.mark.parametrize(
    ("bitrate", "line"),
    [(10_000, b"S0"), (20_000, b"S1"), (50_000, b"S2"), (100_000, b"S3"), (125_000, b"S4"), (250_000, b"S5"),
     (500_000, b"S6"), (1_000_000, b"S8")],
)  # fmt: skip
def test_a_bit_rate_is_set_while_the_channel_is_closed(place, bitrate, line):
    bus = SlcanSocket(address(place), bitrate)
    adapter, _ = place.accept()
    with adapter:
        adapter.settimeout(20.0)
        assert hears(adapter, 7) == b"C\r" + line + b"\rO\r"
    bus.shutdown()


def test_a_bit_rate_that_is_none_of_slcans_is_refused_before_anybody_is_called(place):
    with pytest.raises(OpenError, match=r"bit rate 123456 bit/s is not one of slcan's: 10000, .*, 1000000"):
        SlcanSocket(address(place), 123_456)


@pytest.mark.parametrize("channel", ["socket://", "socket://:1", "socket://host", "socket://host:", "127.0.0.1:x"])
def test_what_is_no_address_is_told(channel):
    with pytest.raises(OpenError, match=r"is not an address; write it as socket://127\.0\.0\.1:PORT"):
        SlcanSocket(channel)


@pytest.mark.parametrize("port", [1, 10**6])
def test_where_nobody_listens_is_told(port):
    with pytest.raises(OpenError, match="no hub answers at"):
        SlcanSocket(f"socket://127.0.0.1:{port}")


# --- the token ----------------------------------------------------------------------------------------------------
def hub(place, *, pieces=(), resets=False, closes=False):
    """Who is joined: takes the token, answers in pieces, then resets or closes the connection, or stays."""
    heard = []

    def serve():
        connection, _ = place.accept()
        connection.settimeout(20.0)
        heard.append(hears(connection, len(TOKEN) + 2))
        for piece in pieces:
            connection.sendall(piece)
            time.sleep(0.02)
        if resets:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        if resets or closes:
            connection.close()
        else:
            heard.append(connection)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    return heard, thread


@pytest.mark.parametrize("end", ["resets", "closes"])
@pytest.mark.parametrize("pieces", [(), (b"K\r",), (b"K",)], ids=["nothing", "asked", "half"])
def test_a_connection_that_is_lost_before_the_token_is_taken_is_a_refusal(place, end, pieces):
    heard, thread = hub(place, pieces=pieces, **{end: True})
    with pytest.raises(OpenError, match="refuses the token"):
        SlcanSocket(address(place), token=TOKEN)
    thread.join(20.0)
    assert heard == [b"K" + TOKEN.encode() + b"\r"]


@pytest.mark.parametrize("pieces", [(b"\r",), (b"K\r\r",), (b"K\r", b"\r"), (b"K", b"\r", b"\r"), (b"\a",)])
def test_a_token_is_taken_once_more_than_the_question_has_come(place, pieces):
    """Of a hub that asks: its question, which may come in pieces, then "yes". Who knows of no token answers as well."""
    heard, thread = hub(place, pieces=pieces)
    bus = SlcanSocket(address(place), token=TOKEN)
    thread.join(20.0)
    assert hears(heard[1], 2) == b"O\r"
    heard[1].close()
    bus.shutdown()


# --- a bus that tells of what has begun to arrive ------------------------------------------------------------------
@pytest.fixture
def piped():
    """A port to a bus with a file, and how long the bus was told to wait."""
    reading, writing = os.pipe()
    waits = []

    def recv(timeout):
        waits.append(timeout)
        os.read(reading, 1)
        return can.Message(arbitration_id=0x701, data=b"\x05", is_extended_id=False)

    yield Port(SimpleNamespace(fileno=lambda: reading, recv=recv, shutdown=lambda: None)), writing, waits
    os.close(reading)
    os.close(writing)


def test_the_rest_of_a_line_that_has_begun_is_waited_for_and_not_for_long(piped):
    port, writing, waits = piped
    found = []
    port.subscribe(0x701, found.append)
    assert not port.receive(0.0) and waits == []  # nothing has begun
    os.write(writing, b"x")
    assert port.receive(5.0)
    assert found == [b"\x05"]
    assert 0.001 <= waits[0] <= 0.003


def test_what_nobody_waits_for_is_handed_to_nobody(piped):
    port, writing, _ = piped
    found = []
    port.subscribe(0x701, found.append)
    port.subscribe(0x701, None)
    os.write(writing, b"x")
    assert port.receive(5.0)
    assert found == []


def test_a_bus_that_is_gone_is_told(piped):
    port, writing, _ = piped
    port._bus.recv = lambda timeout: (_ for _ in ()).throw(can.CanOperationError("unplugged"))
    os.write(writing, b"x")
    with pytest.raises(BusError, match="the bus is gone: unplugged"):
        port.receive(5.0)


def test_a_look_without_waiting_is_one_system_call(joined, monkeypatch):
    """It is done some thousand times a second."""
    bus, _ = joined
    monkeypatch.setattr(slcan_socket, "select", SimpleNamespace())
    assert bus.recv(0.0) is None


# --- without a hub ------------------------------------------------------------------------------------------------
class Connection:
    """A connection whose answer to a token is told: bytes, or an error."""

    def __init__(self, *answers):
        self.answers, self.sent, self.is_open = list(answers), b"", True

    def sendall(self, data):
        self.sent += data

    def recv(self, size):
        assert size >= 4096
        found = self.answers.pop(0)
        if isinstance(found, Exception):
            raise found
        return found

    def close(self):
        self.is_open = False


@pytest.mark.parametrize(("answers", "said"), [
    ((TimeoutError(),), "chan does not answer to the token within 3 s; if it is not the hub of `drive-env serve`, "
     "unset"),
    ((b"K", TimeoutError()), "chan does not answer to the token within 3 s"),
    ((OSError("reset"),), "chan refuses the token; take the one that `drive-env serve` printed, and wait a second"),
    ((b"K\r", b""), "chan refuses the token"),
])  # fmt: skip
def test_who_does_not_take_the_token_is_let_go(answers, said):
    connection = Connection(*answers)
    with pytest.raises(OpenError, match=f"^{said}"):
        slcan_socket._present(TOKEN, connection, "chan")
    assert connection.sent == b"K" + TOKEN.encode() + b"\r" and not connection.is_open


def test_what_is_no_token_is_not_sent():
    connection = Connection()
    with pytest.raises(OpenError, match=r"; take the one that `drive-env serve` printed$"):
        slcan_socket._present("short", connection, "chan")
    assert connection.sent == b"" and not connection.is_open
    connection = Connection(b"\r")
    slcan_socket._present(TOKEN, connection, "chan")
    assert connection.is_open


def test_a_connection_is_tried_for_3_s(monkeypatch):
    asked = []
    monkeypatch.setattr(slcan_socket.socket, "create_connection", lambda *what: asked.append(what) or "connection")
    assert slcan_socket._connect("socket://host.example:29536") == "connection"
    assert slcan_socket._connect("::1:5") == "connection"
    assert asked == [(("host.example", 29536), 3.0), (("::1", 5), 3.0)]


def test_a_question_for_the_token_is_told(joined):
    bus, adapter = joined
    adapter.sendall(b"K\r")
    with pytest.raises(
        OpenError, match="asks for a token; set DRIVE_ENV_TOKEN to the one that `drive-env serve` print"
    ):
        bus.recv(20.0)
