"""TIME on the bus: consumed, produced, and the clock that it sets (CiA 301: 1012h, 1013h)."""

from __future__ import annotations

from datetime import datetime

import canopen
import pytest
from rigs import TESTS

from drive_env import EmulatedDrives
from drive_env.canopen.frames import Frame
from drive_env.canopen.time_of_day import Clock, decode, encode

DEVICE = str(TESTS / "all_services.toml")
DAY = 86_400_000


@pytest.fixture(scope="module")
def drives():
    with EmulatedDrives(DEVICE, load="inertia", num_threads=1) as made:
        yield made


@pytest.mark.parametrize(
    ("data", "time"),
    [
        ("00 00 00 00 00 00", (0, 0)),  # 1 January 1984
        ("E8 03 00 00 01 00", (1, 1000)),
        ("FF 5B 26 05 FF FF", (65_535, DAY - 1)),
        ("E8 03 00 F0 01 00", (1, 1000)),  # four bits are reserved
        ("00 5C 26 05 00 00", None),  # a day has 86,400,000 ms
        ("E8 03 00 00 01", None),
    ],
)
def test_a_time_of_day(data, time):
    assert decode(bytes.fromhex(data)) == time
    if time is not None:
        assert decode(encode(*time)) == time


def test_a_clock_runs_on_from_what_it_was_set_to():
    clock = Clock()
    clock.power_on(10.0)
    assert clock.date(10.5) == datetime(1984, 1, 1, 0, 0, 0, 500_000)
    assert not clock.is_set
    clock.set(15_000, DAY - 500, 20.0)  # 15,000 days later, half a second before midnight
    assert clock.is_set
    assert clock.milliseconds(20.25) == (15_000, DAY - 250)
    assert clock.milliseconds(20.5) == (15_001, 0)
    assert clock.date(20.5) == datetime(2025, 1, 26)
    clock.set_microseconds(0xFFFF_FFFF, 20.0)
    assert clock.microseconds(20.0) == 0xFFFF_FFFF
    assert clock.microseconds(20.000_001) == 0  # it wraps round


def test_the_node_takes_the_time(wire):
    wire.play("rx 100  E8 03 00 00 01 00")
    assert wire.node.clock.date(wire.now) == datetime(1984, 1, 2, 0, 0, 1)
    wire.wait(250)
    assert wire.node.clock.milliseconds(wire.now) == (1, 1250)


@pytest.mark.parametrize("frame", ["E8 03 00 00 01", "00 5C 26 05 00 00", "E8 03 00 00 01 00 00", ""])
def test_what_is_no_time_sets_nothing(wire, frame):
    wire.play(f"rx 100  {frame}")
    assert not wire.node.clock.is_set


def test_a_stopped_node_and_one_that_consumes_none_take_none(wire):
    wire.play("rx 000  02 05\nrx 100  E8 03 00 00 01 00\nrx 000  80 05")
    assert not wire.node.clock.is_set
    wire.play("""
        rx 605  23 12 10 00 00 01 00 00   # bit 31 off
        tx 585  60 12 10 00 00 00 00 00
        rx 100  E8 03 00 00 01 00
    """)
    assert not wire.node.clock.is_set


def test_the_producer_tells_its_clock(wire):
    wire.play("""
        rx 100  FF 5B 26 05 01 00         # a millisecond before midnight
        rx 605  23 12 10 00 00 01 00 40   # bit 30: produce, every 50 ms in this device
        tx 585  60 12 10 00 00 00 00 00
        wait 1 ms
        tx 100  FF 5B 26 05 01 00
        wait 49 ms
        wait 1 ms
        tx 100  31 00 00 00 02 00         # 49 ms of the next day
        rx 605  23 12 10 00 00 01 00 00
        tx 585  60 12 10 00 00 00 00 00
        wait 100 ms
    """)


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        ("23 12 10 00 01 01 00 80", "30 00 09 06"),  # 101h is reserved
        ("23 12 10 00 00 01 00 A0", "30 00 09 06"),  # 29 bits
        ("23 12 10 00 00 02 00 80", "22 00 00 08"),  # in use: its bits first
    ],
)
def test_what_the_standard_forbids_is_refused(wire, request_, code):
    wire.play(f"rx 605  {request_}\ntx 585  80 12 10 00 {code}")


def test_the_time_stamp_counts_microseconds_and_can_be_set_by_a_pdo(wire):
    wire.wait(3)
    wire.play("rx 605  40 13 10 00 00 00 00 00\ntx 585  43 13 10 00 B8 0B 00 00")  # 3000 us
    wire.play("""
        rx 605  23 13 10 00 00 00 00 80
        tx 585  60 13 10 00 00 00 00 00
        wait 2 ms
        rx 605  40 13 10 00 00 00 00 00
        tx 585  43 13 10 00 D0 07 00 80
    """)
    for index, sub, raw, size in (
        (0x1401, 1, 0xC000_0305, 4), (0x1601, 0, 0, 1), (0x1601, 1, 0x1013_0020, 4), (0x1601, 0, 1, 1),
        (0x1401, 2, 255, 1), (0x1401, 1, 0x4000_0305, 4),
    ):  # fmt: skip
        assert wire.download(index, sub, raw, size) == 0
    wire.start()
    wire.play("rx 305  40 E2 01 00")
    assert wire.value(0x1013) == 123_456


def test_power_on_starts_the_clock_and_a_reset_does_not(wire):
    wire.play("rx 100  E8 03 00 00 01 00")
    wire.play("rx 000  81 05\ntx 705  00")
    assert wire.node.clock.is_set
    wire.node.power_on(wire.now)
    assert wire.node.clock.milliseconds(wire.now) == (0, 0)


def test_canopens_time_producer_sets_the_clock(wire):
    class Network(canopen.Network):
        def send_message(self, can_id, data, remote=False):
            wire.node.receive(Frame(can_id, bytes(data), remote), wire.now)

    moment = 1_700_000_000.25
    Network().time.transmit(moment)
    assert (wire.node.clock.date(wire.now) - datetime(1970, 1, 1)).total_seconds() == pytest.approx(moment, abs=2e-3)
