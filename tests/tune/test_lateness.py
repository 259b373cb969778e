"""SYNCs that are late are named before anything else is blamed: encoder, wiring, travel.

The lateness is real: now and then this computer does nothing for a while before a SYNC, as a busy one.
"""

from __future__ import annotations

import time
import uuid

import can
import pytest

from drive_env import EmulatedDrives
from drive_env.bus.can_port import CanPort
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.drives.observed import ObservedDrives
from drive_env.fieldbus.link import Timing
from drive_env.master.pace import RealTimePace
from drive_env.safety.envelope import SafetyError
from tuning.auto.one_button import auto
from tuning.identify.identification import identify
from tuning.lateness import LATE, Punctuality, is_distorted, late_first, told_lateness
from tuning.response.frequency_response import measure
from tuning.target import on_bus

# A SYNC of so many comes so much later [s]: the field of the encoder check turns on meanwhile.
EVERY, STALL = 40, 0.06
BLAMES = ("encoder's counts per turn", "wrong direction", "pole pairs and the drive", "swap two motor phases")


class Late:
    """A bus whose drive is sound, and a master whose SYNCs are late."""

    def __init__(self, channel):
        self.channel, self.waits = channel, 0

    def open(self):
        return on_bus(interface="virtual", channel=self.channel, travel=(-60.0, 60.0), timeout=20.0)


@pytest.fixture
def late(monkeypatch):
    world = World(lockstep=False)
    world.add(EmulatedDrives(load="inertia", num_threads=1), [1])
    bus = Late(str(uuid.uuid4()))
    own = RealTimePace._pass_time

    def pass_time(self, receive):
        bus.waits += 1
        if bus.waits % EVERY == 0:
            time.sleep(STALL)
        own(self, receive)

    monkeypatch.setattr(RealTimePace, "_pass_time", pass_time)
    with Server(world, CanPort(can.Bus(interface="virtual", channel=bus.channel))):
        yield bus
    world.close()


@pytest.mark.slow
def test_identification_blames_neither_encoder_nor_wiring_for_late_syncs(late):
    """It said that the field made 0.16, 0.58 or 5.23 electrical turns per turn, or that the encoder was reversed."""
    with late.open() as target:
        found = identify(target)[0]
        assert target.drives.bus.total_timing.worst > 0.9 * STALL
    # Chance may leave the check right; what the motor then shows is measured by a clock that is wrong.
    reasons = {one.reason for one in found.estimates.values() if LATE in one.reason}
    assert reasons
    for reason in reasons:
        assert reason.split(" of ")[0].isdigit(), f"lateness comes first: {reason}"
        assert not any(blame in reason for blame in BLAMES), reason
    if not found.estimates["pole_pairs"].is_known:
        assert not found.wiring, "nothing is to be written for a check that says nothing"


@pytest.mark.slow
def test_auto_names_late_syncs_and_writes_no_wiring(late, tmp_path):
    with late.open() as target:
        before = target.drives.read((0x2080, 1))
        axis = auto(target, tmp_path / "before.toml", keep=False).axes[0]
        assert (target.drives.read((0x2080, 1)) == before).all()
    assert LATE in axis.reason
    assert not any(blame in axis.reason for blame in BLAMES), axis.reason
    assert any(LATE in one for one in axis.reservations)


@pytest.mark.slow
def test_a_response_or_the_envelope_that_stops_it_names_late_syncs_first(late):
    """The envelope stopped it for a travel that it would never have left in time."""
    with late.open() as target:
        try:
            notes = measure(target).notes[0]
        except SafetyError as error:
            notes = (str(error),)
    assert LATE in notes[0]
    assert notes[0].split(" of ")[0].isdigit()


# --- what counts ------------------------------------------------------------------------------------------------------
class Timed:
    """Drives of a bus, as far as they tell how punctual their SYNCs were."""

    time_waits = False
    observers = ()

    def __init__(self, *timing):
        self.total_timing = Timing(*timing)
        self.bus = self


@pytest.mark.parametrize(
    ("timing", "distorted"),
    [((1000, 0, 0.0), False), ((1000, 3, 0.004), False), ((1000, 1, 0.021), True), ((1000, 51, 0.002), True)],
)
def test_a_few_syncs_that_are_hardly_late_void_no_check(timing, distorted):
    drives = Timed(*timing)
    assert is_distorted(drives) == distorted
    assert (told_lateness(drives) != "") == (timing[1] > 0)


def test_what_was_late_before_a_tuner_began_is_not_told():
    below = Timed(1000, 400, 0.3)
    drives = ObservedDrives(below, Punctuality(below))
    assert late_first(drives, "the encoder is stuck") == "the encoder is stuck"
    below.total_timing = Timing(1500, 410, 0.3)
    told = late_first(drives, "the encoder is stuck")
    assert told.startswith(f"10 of 500 {LATE}, the worst by at most 300.0 ms: ")
    assert told.endswith(". With that: the encoder is stuck")
    assert late_first(drives, told) == told, "once"
    assert late_first(drives, "") == ""


def test_time_that_waits_is_never_late():
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        assert told_lateness(drives) == ""
        assert not is_distorted(drives)
