"""The master's port on a bus of this test: who gets which frame, who receives, and what is said of a bus that fails."""

from __future__ import annotations

import os
import threading
from collections import deque

import can
import pytest

from drive_env.fieldbus.errors import BusError, OpenError
from drive_env.master.can import port as module
from drive_env.master.can.port import CHANNEL_VARIABLE, INTERFACE_VARIABLE, MOST_FRAMES, TOKEN_VARIABLE, Port, open_bus


class Bus:
    """A bus of python-can as far as a port knows it: frames that wait, frames that were sent."""

    def __init__(self, *frames):
        self.waiting, self.sent, self.timeouts = deque(frames), [], []
        self.error, self.is_open = None, True

    def fileno(self):
        raise NotImplementedError

    def send(self, message, timeout):
        if self.error is not None:
            raise self.error
        self.sent.append((message.arbitration_id, bytes(message.data), message.is_remote_frame, message.dlc, timeout))

    def recv(self, timeout):
        self.timeouts.append(timeout)
        if self.error is not None:
            raise self.error
        return self.waiting.popleft() if self.waiting else None

    def shutdown(self):
        self.is_open = False


def frame(can_id, data=b"\x01", **kind):
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=kind.pop("is_extended_id", False), **kind)


@pytest.fixture
def clock(monkeypatch):
    """A clock that every look at it puts on by a millisecond."""
    now = [100.0]

    def monotonic():
        now[0] += 1e-3
        return now[0]

    monkeypatch.setattr(module.time, "monotonic", monotonic)
    return now


# --- frames -----------------------------------------------------------------------------------------------------------
def test_a_frame_goes_to_the_handler_of_its_identifier_and_to_no_other():
    bus, heard, other = Bus(frame(0x585, b"\x05\x06"), frame(0x586), frame(0x585, b"\x07")), [], []
    port = Port(bus)
    port.subscribe(0x585, heard.append)
    port.subscribe(0x580, other.append)
    assert [port.receive() for _ in range(4)] == [True, True, True, False]
    assert heard == [b"\x05\x06", b"\x07"] and other == []


def test_who_ended_the_subscription_hears_nothing_and_may_end_it_twice():
    bus, heard = Bus(frame(0x585)), []
    port = Port(bus)
    port.subscribe(0x585, heard.append)
    port.subscribe(0x585, None)
    port.subscribe(0x585, None)
    assert port.receive() and heard == []


@pytest.mark.parametrize("kind", ["is_extended_id", "is_error_frame", "is_remote_frame"])
def test_frames_that_carry_no_data_of_a_node_are_passed_over(kind):
    bus, heard = Bus(frame(0x585, b"", **{kind: True}), frame(0x585)), []
    port = Port(bus)
    port.subscribe(0x585, heard.append)
    assert port.receive() and heard == []
    assert port.receive() and heard == [b"\x01"]


def test_what_is_sent():
    bus = Bus()
    port = Port(bus)
    port.send(0x605, b"\x40\x41\x60")
    port.send(0x080)
    port.send(0x185, remote=True, length=6)
    assert bus.sent == [
        (0x605, b"\x40\x41\x60", False, 3, 0.5),
        (0x080, b"", False, 0, 0.5),
        (0x185, b"", True, 6, 0.5),
    ]


@pytest.mark.parametrize("error", [can.CanError("full"), OSError("full")])
def test_a_frame_that_the_bus_does_not_take_is_named(error):
    bus = Bus()
    bus.error = error
    with pytest.raises(BusError, match=r"the bus did not take frame 07Fh: full; check that another node acknowledges"):
        Port(bus).send(0x7F)


@pytest.mark.parametrize("error", [can.CanError("away"), OSError("away"), ValueError("away")])
def test_a_bus_that_is_gone_is_said_and_the_next_to_receive_has_its_turn(error):
    bus = Bus(frame(0x585))
    port = Port(bus)
    bus.error = error
    with pytest.raises(BusError, match=r"the bus is gone: away; open it again"):
        port.receive()
    bus.error = None
    assert port.receive()


def test_only_a_bus_of_its_own_is_shut_down():
    for owned in (True, False):
        bus = Bus()
        Port(bus, owned).close()
        assert bus.is_open != owned
    bus = Bus()
    Port(bus).close()
    assert not bus.is_open


# --- waiting ----------------------------------------------------------------------------------------------------------
def test_waiting_ends_with_what_is_waited_for_and_leaves_the_frames_after_it():
    bus, heard = Bus(*[frame(0x585)] * 5), []
    port = Port(bus)
    port.subscribe(0x585, heard.append)
    assert port.wait(lambda: len(heard) == 3, 1.0)
    assert len(heard) == 3 and len(bus.waiting) == 2


def test_what_has_arrived_by_the_end_of_the_time_counts(clock):
    """The thread may have slept through its time while the frames came."""
    bus, heard = Bus(*[frame(0x585)] * 5), []
    port = Port(bus)
    port.subscribe(0x585, heard.append)
    assert port.wait(lambda: len(heard) == 5, 0.0)
    assert set(bus.timeouts) == {0.0}


def test_waiting_in_vain_ends_with_its_time(clock):
    bus = Bus()
    before = clock[0]
    assert not Port(bus).wait(lambda: False, 0.1)
    assert clock[0] - before == pytest.approx(0.1, abs=0.01)
    assert bus.timeouts[0] == pytest.approx(0.099) and bus.timeouts[-1] == 0.0


def test_what_is_there_already_needs_no_frame():
    bus = Bus(frame(0x585))
    port = Port(bus)
    assert port.receive(done=lambda: True)
    assert port.wait(lambda: True, 0.0)
    assert len(bus.waiting) == 1 and bus.timeouts == []


def test_draining_takes_all_that_has_come_and_ends_where_more_comes_than_can_be_received():
    bus = Bus(*[frame(0x585)] * 7)
    Port(bus).drain()
    assert not bus.waiting and set(bus.timeouts) == {0.0}
    bus = Bus()
    bus.recv = lambda timeout: bus.timeouts.append(timeout) or frame(0x585)
    Port(bus).drain()
    assert len(bus.timeouts) == MOST_FRAMES


# --- two threads ------------------------------------------------------------------------------------------------------
def test_while_another_receives_a_thread_looks_for_what_that_one_heard():
    port = Port(Bus(frame(0x585)))
    port._receiving.acquire()
    port._is_receiving = True
    assert not port.receive(0.005)
    assert not port.receive(0.005, lambda: False)
    assert port.receive(5.0, lambda: True)
    assert port._receiving.locked(), "the turn is still the other's"


def test_a_turn_that_nobody_uses_is_taken_after_a_while():
    """Ctrl-C may end the other thread between its turn and its first instruction."""
    bus = Bus(frame(0x585))
    port = Port(bus)
    port._receiving.acquire()
    assert port.receive(60.0)
    assert not bus.waiting and not port._receiving.locked()


def test_a_turn_that_is_used_is_not_taken(monkeypatch):
    monkeypatch.setattr(module, "_ORPHANED", 0.0)
    port = Port(Bus(frame(0x585)))
    port._receiving.acquire()
    port._is_receiving = True
    assert not port.receive(0.02)
    port._is_receiving = False
    assert port.receive(60.0)


def test_who_has_received_gives_the_turn_on():
    bus = Bus(frame(0x585), frame(0x586))
    port = Port(bus)
    assert port.receive()
    assert not port._is_receiving and not port._receiving.locked()
    done = []
    thread = threading.Thread(target=lambda: done.append(port.receive(5.0)))
    thread.start()
    thread.join(20.0)
    assert done == [True]


# --- a bus with a file ------------------------------------------------------------------------------------------------
def test_where_there_is_a_file_it_tells_whether_a_frame_has_come():
    reading, writing = os.pipe()
    try:
        bus = Bus(frame(0x585))
        bus.fileno = lambda: reading
        port = Port(bus)
        assert not port.receive(0.0) and bus.timeouts == [], "nothing has come: nobody asks the bus"
        os.write(writing, b"t")
        assert port.receive(0.0) and bus.timeouts == [0.002], "the rest of the line"
    finally:
        os.close(reading)
        os.close(writing)


@pytest.mark.parametrize("number", [-1, None, "closed"])
def test_what_is_no_file_is_not_waited_on(number):
    bus = Bus(frame(0x585))
    bus.fileno = lambda: number
    assert Port(bus)._file is None
    assert Port(bus).receive(0.25) and bus.timeouts == [0.25]


def test_standard_input_is_a_file_as_any_other():
    reading, writing = os.pipe()
    kept = os.dup(0)
    try:
        os.dup2(reading, 0)
        bus = Bus()
        bus.fileno = lambda: 0
        assert Port(bus)._file == 0
    finally:
        os.dup2(kept, 0)
        for number in (kept, reading, writing):
            os.close(number)


# --- opening ----------------------------------------------------------------------------------------------------------
@pytest.fixture
def opened(monkeypatch):
    """What buses were opened with, and neither a channel nor a token in the environment."""
    for name in (INTERFACE_VARIABLE, CHANNEL_VARIABLE, TOKEN_VARIABLE):
        monkeypatch.delenv(name, raising=False)
    calls = []
    monkeypatch.setattr(module, "SlcanSocket", lambda *arguments: calls.append(("ours", *arguments)) or calls)
    monkeypatch.setattr(module.can, "Bus", lambda **options: calls.append(options) or calls)
    return calls


def test_a_hub_is_opened_with_our_own_client(opened, monkeypatch):
    open_bus(None, "socket://here:1")
    open_bus("slcan", "socket://here:1", bitrate=500_000, token="of the call")
    monkeypatch.setenv(TOKEN_VARIABLE, "of the environment")
    open_bus(None, "socket://here:1")
    open_bus(None, "socket://here:1", token="of the call")
    monkeypatch.setenv(TOKEN_VARIABLE, "")
    open_bus(None, "socket://here:1")
    assert opened == [
        ("ours", "socket://here:1", None, None),
        ("ours", "socket://here:1", 500_000, "of the call"),
        ("ours", "socket://here:1", None, "of the environment"),
        ("ours", "socket://here:1", None, "of the call"),
        ("ours", "socket://here:1", None, None),
    ]


def test_every_other_bus_is_python_cans(opened):
    open_bus("socketcan", "can0", bitrate=1)
    open_bus(None, "socket://here:1", tty_baudrate=1)
    open_bus("slcan", "socket://here:1", sleep_after_open=2.0)
    assert opened == [
        {"interface": "socketcan", "channel": "can0", "bitrate": 1},
        {"interface": "slcan", "channel": "socket://here:1", "tty_baudrate": 1, "sleep_after_open": 0.0},
        {"interface": "slcan", "channel": "socket://here:1", "sleep_after_open": 2.0},
    ]


def test_what_is_not_given_comes_from_the_environment(opened, monkeypatch):
    monkeypatch.setenv(INTERFACE_VARIABLE, "pcan")
    monkeypatch.setenv(CHANNEL_VARIABLE, "USB1")
    open_bus()
    open_bus("kvaser", "0")
    assert opened == [{"interface": "pcan", "channel": "USB1"}, {"interface": "kvaser", "channel": "0"}]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({}, r"no CAN channel is given; .*set DRIVE_ENV_INTERFACE and DRIVE_ENV_CHANNEL"),
        ({"interface": "pcan"}, r"no CAN channel is given"),
        ({"channel": "can0"}, r"channel 'can0' needs an interface: .*DRIVE_ENV_INTERFACE$"),
        ({"channel": "here:1"}, r"needs an interface: .*; a hub of `drive-env serve` is socket://here:1$"),
        ({"interface": "pcan", "channel": "USB1", "token": "x"}, r"a token is for the hub of `drive-env serve`"),
        ({"channel": "socket://here:1", "token": "x", "tty_baudrate": 1}, r"a token is for the hub"),
    ],
)
def test_what_cannot_be_opened(opened, given, said):
    with pytest.raises(OpenError, match=said):
        open_bus(**given)
    assert opened == []


@pytest.mark.parametrize("error", [can.CanError("x"), OSError("x"), ValueError("x"), ImportError("x"), TypeError("x")])
def test_what_does_not_open_says_what_to_look_at(opened, monkeypatch, error):
    def fails(**options):
        raise error

    monkeypatch.setattr(module.can, "Bus", fails)
    with pytest.raises(OpenError, match=r"cannot open interface 'pcan', channel 'USB1': x; check that the adapter"):
        open_bus("pcan", "USB1")
