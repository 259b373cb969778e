"""Error control, as transcripts: heartbeat producer and consumer, node and life guarding, what a loss does."""

from __future__ import annotations

import pytest
from rigs.canopen_wire import Wire

from drive_env import EmulatedDrives
from drive_env.canopen.error_control import consumers
from drive_env.devices import find_device


# --- heartbeat, sent --------------------------------------------------------------------------------------------------
def test_the_boot_up_message_is_the_first_heartbeat(wire):
    assert wire.download(0x1017, 0, 50, 2) == 0
    assert wire.download(0x1010, 2, 0x65766173, 4) == 0
    wire.wait(3)
    wire.take()
    wire.play("""
        rx 000  82 05
        tx 705  00
        wait 49 ms
        wait 1 ms
        tx 705  7F
    """)


# --- heartbeat, watched -----------------------------------------------------------------------------------------------
WATCH_7 = "rx 605  23 16 10 01 32 00 07 00   # node 7, 50 ms\ntx 585  60 16 10 01 00 00 00 00"


def test_it_is_watched_anew_after_its_next_heartbeat(wire):
    wire.play(f"""
        {WATCH_7}
        rx 707  05
        wait 51 ms
        tx 085  30 81 11 00 FF 00 00 00
        rx 605  40 01 10 00 00 00 00 00
        tx 585  4F 01 10 00 11 00 00 00
        wait 100 ms
        rx 707  7F
        rx 605  40 01 10 00 00 00 00 00
        tx 585  4F 01 10 00 00 00 00 00
        wait 1 ms
        tx 085  00 00 00 00 00 00 00 00   # no error any more
        wait 50 ms
        tx 085  30 81 11 00 FF 00 00 00
    """)


@pytest.mark.parametrize("entries", [[0x00070000, 0x00070032], [0x00070032, 0x00070000]])
def test_of_two_entries_for_one_node_the_one_with_a_time_watches_it(entries):
    """The other is switched off, as a master leaves it that takes another one for itself."""
    [one] = consumers(entries)
    assert one.node_id == 7
    one.receive(1.0)
    assert not one.is_lost(1.049)
    assert one.is_lost(1.050)


def test_the_master_s_own_number_may_be_watched_and_switched_off_again(wire):
    wire.play("""
        rx 605  23 16 10 01 64 00 7F 00
        tx 585  60 16 10 01 00 00 00 00
        rx 77F  05
        wait 50 ms
        rx 605  23 16 10 01 00 00 00 00
        tx 585  60 16 10 01 00 00 00 00
        wait 200 ms
    """)


@pytest.fixture
def two_entries(tmp_path, monkeypatch):
    """Node 5 that can watch two others."""
    device = find_device("tmcm1636")
    path = tmp_path / "two.eds"
    path.write_text(
        device.eds.read_text(encoding="utf-8") + "[1016sub2]\nParameterName=Consumer heartbeat time 2\nObjectType=0x7\n"
        "DataType=0x0007\nAccessType=rw\nDefaultValue=0\nPDOMapping=0\n", encoding="utf-8"
    )  # fmt: skip
    monkeypatch.setattr("drive_env.emulator.emulated_drives.find_device", lambda name: device._replace(eds=path))
    with EmulatedDrives(load="inertia", num_threads=1) as made:
        yield Wire(made)


def test_a_node_is_watched_once(two_entries):
    two_entries.play("""
        rx 605  23 16 10 01 64 00 07 00   # node 7, 100 ms
        tx 585  60 16 10 01 00 00 00 00
        rx 605  23 16 10 02 C8 00 07 00   # once more
        tx 585  80 16 10 02 43 00 04 06   # abort 0604 0043h: general parameter incompatibility
        rx 605  23 16 10 01 32 00 07 00   # the same entry may change
        tx 585  60 16 10 01 00 00 00 00
        rx 605  23 16 10 02 C8 00 08 00
        tx 585  60 16 10 02 00 00 00 00
        rx 605  23 16 10 02 00 00 07 00   # with a time of 0 no node is watched
        tx 585  60 16 10 02 00 00 00 00
    """)


# --- guarding ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("between", ["2B 0C 10 00 00 00 00 00", "2B 0C 10 00 14 00 00 00"], ids=["off", "longer"])
def test_life_guarding_configured_a_second_time_waits_for_its_first_request(wire, between):
    assert wire.download(0x100D, 0, 3, 1) == 0
    wire.play(f"""
        rx 605  2B 0C 10 00 0A 00 00 00   # 10 ms, three times
        tx 585  60 0C 10 00 00 00 00 00
        rx 705  RTR
        tx 705  7F
        wait 20 ms
        rx 605  {between}
        tx 585  60 0C 10 00 00 00 00 00
        wait 100 ms
        rx 605  2B 0C 10 00 0A 00 00 00   # the second master
        tx 585  60 0C 10 00 00 00 00 00
        wait 100 ms                       # no 8130h: it has not asked yet
        rx 705  RTR
        tx 705  FF
        wait 30 ms
        wait 1 ms
        tx 085  30 81 11 00 FF 00 00 00
    """)


@pytest.mark.parametrize(("time", "factor"), [(0, 3), (10, 0)])
def test_no_life_guarding_without_time_or_factor(wire, time, factor):
    assert wire.download(0x100C, 0, time, 2) == 0
    assert wire.download(0x100D, 0, factor, 1) == 0
    wire.play("""
        rx 705  RTR
        tx 705  7F
        wait 500 ms
    """)
