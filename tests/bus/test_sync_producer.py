"""SYNC from the node itself, its counter, and the window after it (CiA 301: 1005h, 1006h, 1007h, 1019h)."""

from __future__ import annotations

import pytest
from rigs import TESTS
from rigs.canopen_wire import Wire

from drive_env import EmulatedDrives
from drive_env.bus.world import World
from drive_env.canopen.frames import Frame

DEVICE = str(TESTS / "all_services.toml")


@pytest.fixture(scope="module")
def drives():
    with EmulatedDrives(DEVICE, load="inertia", num_threads=1) as made:
        yield made


@pytest.fixture
def wire(drives):
    """Node 5 without the TPDOs that are on from the factory."""
    drives.machine.reset()
    made = Wire(drives)
    for index in (0x1800, 0x1801, 0x1802, 0x1803):
        assert made.download(index, 1, 0xC000_0385, 4) == 0
    return made


PRODUCE = """
    rx 605  23 06 10 00 D0 07 00 00   # every 2000 us
    tx 585  60 06 10 00 00 00 00 00
    rx 605  23 05 10 00 80 00 00 40   # bit 30: produce
    tx 585  60 05 10 00 00 00 00 00
"""


def test_the_producer_sends_within_a_period_and_then_every_period(wire):
    wire.play(PRODUCE)
    wire.play("""
        wait 1 ms
        tx 080
        wait 1 ms
        wait 1 ms
        tx 080
        wait 4 ms
        tx 080
        tx 080
        rx 605  23 05 10 00 80 00 00 00   # bit 30 off
        tx 585  60 05 10 00 00 00 00 00
        wait 10 ms
    """)


def test_a_new_period_begins_at_once_and_0_ends_it(wire):
    wire.play(PRODUCE)
    wire.play("""
        wait 2 ms
        tx 080
        rx 605  23 06 10 00 B8 0B 00 00   # 3000 us
        tx 585  60 06 10 00 00 00 00 00
        wait 6 ms
        tx 080
        tx 080
        rx 605  23 06 10 00 00 00 00 00
        tx 585  60 06 10 00 00 00 00 00
        wait 10 ms
    """)


def test_the_counter_goes_from_1_to_its_overflow(wire):
    wire.play("rx 605  2F 19 10 00 03 00 00 00\ntx 585  60 19 10 00 00 00 00 00")
    wire.play(PRODUCE)
    wire.play("""
        wait 9 ms
        tx 080  01
        tx 080  02
        tx 080  03
        tx 080  01
        tx 080  02
        rx 000  02 05                     # stopped: no SYNC
        wait 5 ms
        rx 000  80 05                     # and from there the count begins anew
        wait 2 ms
        tx 080  01
    """)


@pytest.mark.parametrize(
    ("setup", "request_", "code"),
    [
        ((), "2F 19 10 00 01 00 00 00", "30 00 09 06"),  # 1 is reserved
        ((), "2F 19 10 00 F1 00 00 00", "30 00 09 06"),
        ((), "23 06 10 00 F4 01 00 00", "30 00 09 06"),  # 500 us: the node looks once in a millisecond
        ((), "23 05 10 00 80 00 00 20", "30 00 09 06"),  # 29 bits
        ((), "23 05 10 00 05 06 00 40", "30 00 09 06"),  # an SDO's
        (("23 06 10 00 D0 07 00 00",), "2F 19 10 00 0A 00 00 00", "22 00 00 08"),  # while there is a period
        (("23 05 10 00 80 00 00 40",), "23 05 10 00 81 00 00 40", "22 00 00 08"),  # identifier in use
    ],
)
def test_what_the_standard_forbids_is_refused(wire, setup, request_, code):
    for one in setup:
        assert wire.receive(0x605, one)[0].data[0] == 0x60
    wire.play(f"rx 605  {request_}\ntx 585  80 {request_[3:11]} {code}")


def test_the_producer_is_stored_and_restored(wire):
    wire.play(PRODUCE)
    wire.receive(0x605, "23 10 10 01 73 61 76 65")
    wire.play("rx 000  82 05\ntx 705  00\nwait 3 ms\ntx 080\ntx 080")


def test_its_own_sync_is_one_to_the_producer(wire):
    """TPDO 1 of type 1 goes with every SYNC that the node makes; an RPDO that waits for SYNC takes effect with it."""
    assert wire.download(0x1800, 1, 0xC000_0185, 4) == 0
    assert wire.download(0x1800, 2, 1, 1) == 0
    assert wire.download(0x1800, 1, 0x4000_0185, 4) == 0
    assert wire.download(0x1400, 2, 1, 1) == 0  # controlword
    wire.start()
    wire.play(PRODUCE)
    wire.play("""
        wait 2 ms
        tx 080
        tx 185  50 02
        rx 205  06 00                     # it waits
    """)
    assert wire.value(0x6041) & 0x6F == 0x40
    wire.play("wait 1 ms\ntx 080\ntx 185  31 02")
    assert wire.value(0x6041) & 0x6F == 0x21


# --- the window -------------------------------------------------------------------------------------------------------
def with_window(wire, microseconds):
    assert wire.download(0x1007, 0, microseconds, 4) == 0
    assert wire.download(0x1400, 2, 1, 1) == 0
    wire.start()


def test_a_synchronous_rpdo_behind_the_window_is_discarded_and_told_once(wire):
    with_window(wire, 2500)
    wire.play("rx 080\nwait 2 ms\nrx 205  06 00\nrx 080")
    assert wire.value(0x6041) & 0x6F == 0x21  # 2 ms behind the SYNC: within
    wire.play("""
        wait 3 ms
        rx 205  07 00                     # 3 ms: late
        tx 085  50 82 11 00 FF 00 00 00
        rx 205  07 00
        rx 080
    """)
    assert wire.value(0x6041) & 0x6F == 0x21
    wire.play("rx 205  07 00\nrx 080")
    assert wire.value(0x6041) & 0x6F == 0x23


@pytest.mark.parametrize("first", ["asynchronous", "no window", "no SYNC yet"])
def test_whatever_has_no_window_is_never_late(wire, first):
    with_window(wire, 0 if first == "no window" else 1000)
    if first == "asynchronous":
        assert wire.download(0x1400, 2, 255, 1) == 0
    if first != "no SYNC yet":
        wire.play("rx 080")
    wire.wait(20)
    wire.take()
    wire.play("rx 205  06 00\nrx 080")
    assert wire.value(0x6041) & 0x6F == 0x21


# --- the counter, consumed --------------------------------------------------------------------------------------------
def synchronous_tpdo(wire, kind, start_value=0):
    assert wire.download(0x1800, 1, 0xC000_0185, 4) == 0
    assert wire.download(0x1800, 2, kind, 1) == 0
    assert wire.download(0x1800, 6, start_value, 1) == 0
    assert wire.download(0x1800, 1, 0x4000_0185, 4) == 0


def test_a_start_value_says_which_sync_is_the_first(wire):
    assert wire.download(0x1019, 0, 4, 1) == 0
    synchronous_tpdo(wire, 2, start_value=3)
    wire.start()
    wire.play("""
        rx 080  01
        rx 080  02
        rx 080  03                        # the first of two
        rx 080  04
        tx 185  50 02
        rx 080  01
        rx 080  02
        tx 185  50 02
    """)


def test_a_sync_of_another_length_is_none_and_told_once(wire):
    assert wire.download(0x1019, 0, 4, 1) == 0
    synchronous_tpdo(wire, 1)
    wire.start()
    wire.play("""
        rx 080
        tx 085  40 82 11 00 FF 00 00 00   # 8240h
        rx 080
        rx 080  01
        tx 185  50 02
        rx 080
        tx 085  40 82 11 00 FF 00 00 00
    """)


# --- in a world -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("lockstep", [True, False])
def test_a_producer_on_a_bus_clocks_the_other_nodes(lockstep):
    with EmulatedDrives(DEVICE, load="inertia", num_machines=2, num_threads=1) as drives:
        world = World(lockstep=lockstep)
        world.add(drives, (5, 6))
        frames = []
        world.listeners.append(lambda ended: frames.append(ended.frame))
        world.power_on()

        def send(can_id, text):
            world.receive(Frame(can_id, bytes.fromhex(text)))
            if not lockstep:
                world.run_until(world.time + 0.005)

        for request in ("23 00 18 01 86 01 00 C0", "2F 00 18 02 01 00 00 00", "23 00 18 01 86 01 00 40"):
            send(0x606, request)
        for request in ("23 06 10 00 10 27 00 00", "23 05 10 00 81 00 00 40"):  # 10 ms, under 081h
            send(0x605, request)
        send(0x606, "23 05 10 00 81 00 00 00")
        send(0x000, "01 00")
        frames.clear()
        if lockstep:  # a SYNC of the master lets time pass, and is none to these nodes but by its identifier
            for _ in range(40):
                world.cycle()
                world._settle()
        else:
            world.run_until(world.time + 0.04)
        syncs = [k for k, frame in enumerate(frames) if frame.can_id == 0x081]
        samples = [frame for frame in frames if frame.can_id == 0x186]
        assert len(syncs) == 4
        assert len(samples) in (3, 4)  # the last may be under way
