"""What a cycle of the bus carries: frames that cannot fit are refused before any is sent, others are left out."""

from __future__ import annotations

import numpy as np
import pytest
from rigs.world_bus import bus_of

from drive_env import CanDrives, EmulatedDrives, ObjectAccessError
from drive_env.bus.bits import frame_bits
from drive_env.canopen.frames import Frame
from drive_env.fieldbus.description import describe
from drive_env.master.can import bus_time
from drive_env.master.can.bus_time import BusTime
from drive_env.master.can.can_link import CanLink
from drive_env.master.can.port import Port

SIX = describe("tmcm6212", None)
FIND = SIX.dictionary.find
STATUS, POSITION, SPEED, DEMAND, TARGET = (FIND(index) for index in (0x6041, 0x6064, 0x606C, 0x6062, 0x607A))


@pytest.mark.every(2)
@pytest.mark.parametrize("length", range(9))
def test_a_frame_has_bits_between_those_of_the_formulas(length):
    """With all stuff bits that there may be, and without any; the shortest of 2,000 comes near."""
    chance = np.random.default_rng(length)
    bits = [
        frame_bits(
            Frame(int(chance.integers(1, 0x7FF)), bytes(chance.choice([0, 255, *chance.bytes(2)], length).tolist()))
        )
        for _ in range(2000)
    ]
    group = [type("Entry", (), {"bits": 8 * length})]
    least, most = bus_time._least(group), bus_time._most(group)
    assert least == 47 + 8 * length
    assert least <= min(bits) <= least + 3
    assert max(bits) <= most


def test_six_axes_in_a_millisecond():
    """By hand: SYNC 47 bits; a PDO of 2 + 4 bytes at least 95; six are 617 of 1000."""
    bus = BusTime(1e6, 0.001)
    assert bus.excess([[STATUS, POSITION]], 6) is None
    assert bus.excess([[STATUS, POSITION], [SPEED]], 6) == (
        "12 PDOs of 6 axes take at least 1.1 ms of a bus of 1000 kbit/s, and SYNC comes every 1 ms; record and play "
        "fewer objects at a time, or give a longer cycle (in Python CanDrives(cycle=0.002))"
    )
    assert BusTime(1e6, 0.002).excess([[STATUS, POSITION], [SPEED]], 6) is None
    assert BusTime(250e3, 0.002).excess([[STATUS, POSITION]], 6) is not None
    assert BusTime().excess([[STATUS, POSITION]] * 4, 127) is None, "in lockstep frames take no time"


@pytest.fixture
def link():
    """Six axes behind a link of 1 Mbit/s, and what it sends; a function takes the cycle."""
    with bus_of(EmulatedDrives("tmcm6212", "robot", num_threads=1), [1]) as bus:
        yield lambda cycle: CanLink(Port(bus, owned=False), (1,), SIX, BusTime(1e6, cycle))


def test_what_is_welcome_is_left_out_where_a_cycle_has_no_room_for_it(link):
    welcome = (STATUS, POSITION, SPEED, DEMAND)
    assert link(0.004).process.choose((STATUS,), welcome) == welcome
    assert link(0.001).process.choose((STATUS,), welcome) == (STATUS, POSITION)
    assert link(0.001).process.choose((STATUS,), welcome, (TARGET,)) == (STATUS,), "the targets take a half of it"
    assert link(0.001).process.choose((STATUS, POSITION, SPEED), ()) == (STATUS, POSITION, SPEED), "that is for map"


def test_thirty_frames_go_with_a_sync_of_four_milliseconds_and_are_refused_in_one(link):
    more = tuple(map(FIND, (0x6061, 0x6063, 0x60FD, 0x60FF)))
    played, sampled = (TARGET,), (STATUS, POSITION, SPEED, DEMAND, *more)
    quick = link(0.001).process
    with pytest.raises(
        ObjectAccessError, match=r"30 PDOs of 6 axes take at least 2.9 ms .* give a longer cycle"
    ) as error:
        quick.map(played, sampled)
    assert error.value.abort_code == 0x06040042
    assert quick.sampled_entries() == (), "nothing was mapped"
    slow = link(0.004).process
    slow.map(played, sampled)
    assert len(slow._mapped["TPDO"][1][0]) == 24 and len(slow._mapped["RPDO"][1][0]) == 6


@pytest.mark.parametrize(
    ("cycle", "pace", "says"),
    [
        (0.0005, "real-time", r"cycle=0.0005 s must be from 0.001 s, the drives' communication cycle, to 0.1 s"),
        (0.2, "real-time", r"to 0.1 s"),
        (0.0025, "real-time", r"0.001 s"),
        (0.004, "lockstep", r"cycle=0.004 s is for real time: in lockstep each SYNC is a cycle of 0.001 s"),
    ],
)
def test_cycles_that_cannot_be(cycle, pace, says):
    with pytest.raises(ValueError, match=says):
        CanDrives("tmcm6212", interface="virtual", channel="nobody", cycle=cycle, pace=pace)
