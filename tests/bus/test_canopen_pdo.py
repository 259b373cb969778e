"""Process data, as transcripts: defaults, transmission types, inhibit time, event timer, identifiers, wrong frames."""

from __future__ import annotations

import itertools
import sys
import tomllib

import pytest
from rigs.canopen_wire import Wire

from drive_env.canopen.frames import Frame
from drive_env.devices import allowed_values


@pytest.fixture
def wire(drives):
    """Node 5, operational, the drive in switch on disabled."""
    drives.machine.reset()
    made = Wire(drives)
    made.start()
    return made


def configure(wire, index, sub, raw, size):
    assert wire.download(index, sub, raw, size) == 0


def map_pdo(wire, index, objects, can_id=None):
    """Follow the manual's rule: off, 0 entries, entries, count, on."""
    cob_id = wire.value(index, 1)
    configure(wire, index, 1, cob_id | 1 << 31, 4)
    configure(wire, index + 0x200, 0, 0, 1)
    for k, raw in enumerate(objects, 1):
        configure(wire, index + 0x200, k, raw, 4)
    configure(wire, index + 0x200, 0, len(objects), 1)
    configure(wire, index, 1, (cob_id & ~0x7FF | can_id if can_id else cob_id) & 0x7FFF_FFFF, 4)


# --- the manual's defaults --------------------------------------------------------------------------------------------
def test_operational_tells_event_driven_values_once(wire):
    wire.play("""
        wait 50 ms
        rx 000  80 05
        wait 5 ms
        rx 000  01 05
        wait 50 ms
        tx 185  50 02
        tx 285  50 02 00
        rx 000  01 05                 # operational already
        wait 50 ms
    """)


# --- an RPDO takes effect as a whole ----------------------------------------------------------------------------------
def test_a_new_set_point_finds_the_target_of_its_frame(wire):
    for index, raw in ((0x6081, 300_000), (0x6083, 3_000_000), (0x6084, 3_000_000)):
        configure(wire, index, 0, raw, 4)
    wire.play("""
        rx 305  06 00 01              # pp
        rx 305  07 00 01              # the mode again is no write
        rx 305  0F 00 01
        rx 405  1F 00 20 4E 00 00     # the controlword comes first in the frame, the target takes effect first
    """)
    wire.wait(300)
    assert abs(wire.value(0x6064) - 20_000) < 200  # within a degree: the factory preset is soft


def test_the_mode_of_a_frame_takes_effect_before_the_controlword_that_stands_in_front_of_it(wire):
    for index, raw in ((0x6081, 300_000), (0x6083, 3_000_000), (0x6084, 3_000_000), (0x607A, 20_000)):
        configure(wire, index, 0, raw, 4)
    wire.play("""
        rx 305  06 00 03              # pv
        rx 305  07 00 03
        rx 305  0F 00 03
        rx 305  1F 00 01              # pp, and its new set-point
    """)
    wire.wait(300)
    assert abs(wire.value(0x6064) - 20_000) < 200


def test_a_repeated_mode_is_ignored_in_an_rpdo_and_refused_by_sdo(wire):
    wire.play("""
        rx 305  06 00 03
        rx 305  06 00 03
        rx 605  2F 60 60 00 03 00 00 00
        tx 585  80 60 60 00 22 00 00 08
        wait 1 ms
        tx 185  31 02
        tx 285  31 02 03
    """)


# --- transmission types -----------------------------------------------------------------------------------------------
def test_what_waits_for_sync_is_forgotten_when_operational_ends(wire):
    configure(wire, 0x1403, 2, 0, 1)
    wire.play("""
        rx 505  06 00 01 00 00 00
        rx 000  80 05
        rx 080
        rx 000  01 05
        rx 080
        tx 385  50 02 00 00 00 00
        tx 485  50 02 00 00 00 00
    """)


def test_synchronous_data_that_cannot_be_accepted_is_told_at_sync(wire):
    configure(wire, 0x1401, 2, 0, 1)
    configure(wire, 0x1802, 1, 0xC000_0385, 4)
    configure(wire, 0x1803, 1, 0xC000_0485, 4)
    wire.play("""
        rx 305  06 00 02
        rx 080
        tx 085  20 63 21 00 FF 00 00 00
        rx 305  06 00                 # the length is told at once
        tx 085  10 82 11 00 FF 00 00 00
        rx 080
    """)


# --- the manual's text, which has fewer types than its tables ---------------------------------------------------------
@pytest.fixture
def strict(drives):
    """Node 5 of a drive with the quirk that takes the text by the letter."""
    device = drives.device
    data = tomllib.loads(device.eds.with_name("device.toml").read_text(encoding="utf-8"))
    data["quirks"]["strict_transmission_types"] = True
    drives.device = device._replace(allowed_values=allowed_values(data))
    drives.machine.reset()
    yield Wire(drives)
    drives.device = device


@pytest.mark.parametrize(("index", "text"), [(0x1400, {0, 254, 255}), (0x1403, {0, 254, 255}),
                                             (0x1800, {0, 1, 254, 255}), (0x1803, {0, 1, 254, 255})])  # fmt: skip
def test_transmission_types_of_the_tables_and_of_the_strict_quirk(wire, strict, index, text):
    """Sections 3.1.17 and 3.1.19: the tables have UNSIGNED8, of which CiA 301 reserves 241 to 251."""
    for kind in range(256):
        assert (wire.download(index, 2, kind, 1) == 0) is (kind <= 240 or kind >= 254), kind
        assert (strict.download(index, 2, kind, 1) == 0) is (kind in text), kind


# --- timers -----------------------------------------------------------------------------------------------------------
def test_event_timer_in_milliseconds(wire):
    configure(wire, 0x1800, 5, 250, 2)
    wire.play("""
        wait 1 ms
        tx 185  50 02
        wait 249 ms
        wait 1 ms
        tx 185  50 02
        wait 100 ms
        rx 205  06 00                 # an event: the timer begins anew
        wait 1 ms
        tx 185  31 02
        tx 285  31 02 00
        wait 249 ms
        wait 1 ms
        tx 185  31 02
        wait 750 ms
        tx 185  31 02
        tx 185  31 02
        tx 185  31 02
        rx 605  2B 00 18 05 00 00 00 00
        tx 585  60 00 18 05 00 00 00 00
        wait 1 ms
        tx 185  31 02
        wait 600 ms
    """)


def test_an_event_within_the_inhibit_time_is_told_although_the_value_came_back(wire):
    configure(wire, 0x1801, 1, 0xC000_0285, 4)
    configure(wire, 0x1800, 1, 0xC000_0185, 4)
    configure(wire, 0x1800, 3, 20, 2)
    configure(wire, 0x1800, 1, 0x4000_0185, 4)
    wire.play("""
        wait 1 ms
        tx 185  50 02
        rx 205  06 00
        wait 2 ms
        rx 205  00 00
        wait 17 ms
        wait 1 ms
        tx 185  50 02
        wait 100 ms
    """)


TIMED = [254, 255]


@pytest.mark.parametrize("kind", [0, 1, 2, 240, *TIMED])
def test_the_event_timer_belongs_to_event_driven_types(wire, kind):
    """CiA 301, 1800h:05: the longest interval of types 254 and 255; a synchronous PDO waits for its SYNC."""
    configure(wire, 0x1801, 1, 0xC000_0285, 4)
    configure(wire, 0x1800, 2, kind, 1)
    configure(wire, 0x1800, 5, 10, 2)
    wire.wait(1)
    wire.take()
    wire.wait(100)
    assert [frame.can_id for frame in wire.take()] == ([0x185] * 10 if kind in TIMED else [])


@pytest.mark.parametrize("kind", [0, 1, 2, *TIMED])
def test_the_inhibit_time_belongs_to_event_driven_types(wire, kind):
    """CiA 301, 1800h:03: the shortest interval of types 254 and 255; whoever sends SYNC decides how often."""
    for index in (0x1800, 0x1801, 0x1803):
        configure(wire, index, 1, 0xC000_0000 | wire.value(index, 1), 4)
    configure(wire, 0x1800, 2, kind, 1)
    configure(wire, 0x1800, 3, 50, 2)
    configure(wire, 0x1802, 1, 0xC000_0385, 4)
    configure(wire, 0x1800, 1, 0x4000_0185, 4)
    times = []
    for k in range(200):
        wire.receive(0x205, "06 00" if k % 2 else "00 00")  # each changes the statusword
        sent = wire.receive(0x080)
        wire.wait(1)
        times += [k for frame in (*sent, *wire.take()) if frame.can_id == 0x185]
    apart = {later - before for before, later in itertools.pairwise(times)}
    assert apart == {50 if kind in TIMED else max(kind, 1)}


def test_another_type_or_event_timer_does_not_end_the_inhibit_time(wire):
    configure(wire, 0x1801, 1, 0xC000_0285, 4)
    configure(wire, 0x1800, 1, 0xC000_0185, 4)
    configure(wire, 0x1800, 3, 20, 2)
    configure(wire, 0x1800, 1, 0x4000_0185, 4)
    wire.play("""
        wait 1 ms
        tx 185  50 02
        rx 605  2B 00 18 05 05 00 00 00   # event timer 5 ms
        tx 585  60 00 18 05 00 00 00 00
        rx 605  2F 00 18 02 FE 00 00 00
        tx 585  60 00 18 02 00 00 00 00
        wait 19 ms
        wait 1 ms
        tx 185  50 02
        wait 19 ms
        wait 1 ms
        tx 185  50 02
    """)


# --- identifiers ------------------------------------------------------------------------------------------------------
def test_two_rpdos_on_one_identifier(wire):
    configure(wire, 0x1403, 1, 0xC000_0505, 4)
    configure(wire, 0x1403, 1, 0x4000_0405, 4)
    wire.play("rx 405  06 00 07 00 00 00")
    assert (wire.value(0x607A), wire.value(0x60FF)) == (7, 7)


# --- mapping ----------------------------------------------------------------------------------------------------------


def test_a_mapping_of_nothing_sends_nothing_and_takes_an_empty_frame(wire):
    map_pdo(wire, 0x1803, [])
    map_pdo(wire, 0x1403, [])
    wire.play("""
        rx 080
        tx 385  50 02 00 00 00 00
        rx 505
        rx 505  00
        tx 085  20 82 11 00 FF 00 00 00
    """)


def test_an_entry_may_be_emptied(wire):
    configure(wire, 0x1803, 1, 0xC000_0485, 4)
    configure(wire, 0x1A03, 0, 0, 1)
    configure(wire, 0x1A03, 2, 0, 4)
    configure(wire, 0x1A03, 0, 1, 1)
    configure(wire, 0x1803, 1, 0x4000_0485, 4)
    wire.play("rx 080\ntx 385  50 02 00 00 00 00\ntx 485  50 02")


def test_a_cycle_costs_few_calls(wire):
    """2 RPDO and 2 TPDO with SYNC; what they cost in time is for the benchmarks."""
    wire.enable()
    frames = [Frame(0x405, bytes(6)), Frame(0x505, bytes(6)), Frame(0x80)]
    calls = 0

    def count(frame, event, argument):
        nonlocal calls
        calls += event in ("call", "c_call")

    sys.setprofile(count)
    try:
        for k in range(100):
            for frame in frames:
                wire.node.receive(frame, wire.now)
            wire.node.before_cycle(wire.now + k * 0.001)
            wire.node.after_cycle(wire.now + k * 0.001)
    finally:
        sys.setprofile(None)
    assert 100 * 50 < calls < 100 * 300  # 181 a cycle when this was written
