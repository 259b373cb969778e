"""Bit 4 of the controlword: moves and homing begin at its rising edge, whatever is left of the one before."""

import numpy as np
import pytest
from rigs.quirks import build

from drive_env import EmulatedDrives, cia402, motion
from drive_env.dictionary.roles import Role

DEVICES = ["tmcm1636", "tmcm3313", "tmcm6212", "tgz_d"]
WAY = 20_000  # inc


class Watched:
    """Drives that note the controlwords that they get, and fail after so many calls of `advance`."""

    def __init__(self, drives, error=None, after=0, meanwhile=lambda drives: None):
        self._drives, self._error, self._left, self._meanwhile = drives, error, after, meanwhile
        self.words, self.passed = [], 0.0

    def __getattr__(self, name):
        return getattr(self._drives, name)

    def write(self, name, value, where=None):
        if name == cia402.CONTROLWORD:
            self.words.append(int(value))
        self._drives.write(name, value, where=where)

    def advance(self, duration):
        self._drives.advance(duration)
        self.passed += duration
        self._left -= 1
        if self._error is not None and self._left == 0:
            self._meanwhile(self._drives)
            raise self._error


class Deaf:
    """A drive in pp that acknowledges for ever what it took once, and takes nothing more."""

    num_axes = 1

    def __init__(self):
        self.controlword = 0x1F

    def read(self, name):
        return np.array([{0x6041: 0x1637, 0x6040: self.controlword}.get(name, 1)])

    def write(self, name, value, where=None):
        if name == cia402.CONTROLWORD:
            self.controlword = int(value)

    def advance(self, duration):
        pass


@pytest.fixture
def drives():
    with EmulatedDrives("tmcm1636", "inertia", num_threads=1) as made:
        yield made


def has_bit_4(drives):
    return bool(np.any(drives.read(0x6040) & 0x10))


def left_high(drives):
    drives.write(0x6040, 0x1F)
    drives.advance(0.01)


def failed_home(drives):
    drives.write(0x6098, 17)
    drives.write((0x6099, 1), 0)  # by which no homing can begin
    motion.select_mode(drives, "hm")
    drives.write(0x6040, 0x1F)
    drives.advance(0.05)
    assert (drives.read(0x6041) & 0x3400 != 0x1400).all()  # home is not attained
    drives.write(0x6040, 0x0F)
    motion.select_mode(drives, "pp")


def unchosen_home(drives):
    drives.write(0x6098, 0)
    with pytest.raises(RuntimeError, match=r"axis 0 cannot home: no homing method is chosen \(6098h is 0\)"):
        motion.home(drives)


ROWS = [(before, device) for before in (left_high, failed_home, unchosen_home) for device in DEVICES]
ROWS.remove((unchosen_home, "tgz_d"))  # it has no method 0


@pytest.mark.every(2)
@pytest.mark.parametrize(("before", "device"), ROWS)
def test_a_move_begins_whatever_was_left_of_bit_4(device, before):
    """Before: done at -16 inc after 001Fh; "did not reach set-point acknowledge" after a home that failed."""
    with EmulatedDrives(device, "inertia", num_threads=1) as drives:
        motion.enable(drives, mode="pp")
        before(drives)
        start = drives.machine.rotor_angle.copy()
        scale = drives.read(Role.POSITION_SCALE)
        motion.move_to(drives, drives.read(0x6064) + np.rint(0.3 * scale).astype(int))
        drives.advance(0.2)
        np.testing.assert_allclose(drives.machine.rotor_angle - start, 0.6 * np.pi, rtol=0.02)


@pytest.mark.parametrize(
    ("method", "why"),
    [
        (0, "no homing method is chosen"),
        (17, "6099h:01 is 0, so method 17 would not move the axis; set it, for example to 100 rpm"),
    ],
)
def test_a_home_that_cannot_begin_enables_nothing(drives, method, why):
    drives.write(0x6098, method)
    drives.write((0x6099, 1), 0)
    watched = Watched(drives)
    with pytest.raises(RuntimeError, match=why):
        motion.home(watched)
    assert watched.words == []


@pytest.fixture
def searching():
    """An axis that homing lets search for its left limit switch for seconds."""
    with EmulatedDrives("tmcm1636", "belt", num_threads=1) as made:
        for name, value in ((0x6098, 17), ((0x6099, 1), 65_536), ((0x6099, 2), 6_554), (0x609A, 6_553_600)):
            made.write(name, value)
        yield made


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, TimeoutError])
def test_bit_4_is_lowered_on_every_way_out_of_home(searching, error):
    """Before: 1Fh stayed, and the axis searched on for a switch that nobody waited for any more."""
    drives = searching
    watched = Watched(drives, None if error is TimeoutError else error("on purpose"), after=50)
    with pytest.raises(error):
        motion.home(watched, timeout=0.2)
    assert watched.words[-2:] == [0x1F, 0x0F]
    assert abs(drives.machine.rotor_speed[0]) > 3.0, "rad/s, as it was interrupted"
    drives.advance(0.5)
    at_rest = drives.machine.rotor_angle.copy()
    drives.advance(0.5)
    np.testing.assert_allclose(drives.machine.rotor_angle, at_rest, atol=1e-3)


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, TimeoutError])
def test_bit_4_is_lowered_on_every_way_out_of_start_move(drives, error):
    motion.enable(drives, mode="pp")
    drives.write(0x6040, 0x10F)  # halted: it acknowledges nothing
    drives.advance(0.01)

    class Halted(Watched):
        def write(self, name, value, where=None):
            if name == cia402.CONTROLWORD and value & 0x10:
                self.words.append(int(value))
                return  # lost on its way
            super().write(name, value, where)

    watched = Halted(drives, None if error is TimeoutError else error("on purpose"), after=3)
    with pytest.raises(error):
        motion.start_move(watched, WAY, timeout=0.02)
    assert watched.words == [0x0F, 0x1F, 0x0F]
    assert not has_bit_4(drives)


def test_an_axis_that_was_stopped_is_not_enabled_by_lowering_it(searching):
    """Quick stop active with 605Ah = 6 is left by 0Fh: whoever stopped the axis would be overruled."""
    drives = searching
    drives.write(0x605A, 6)

    def stop(real):
        real.write(0x6040, 0x02)
        real.advance(0.3)

    with pytest.raises(KeyboardInterrupt):
        motion.home(Watched(drives, KeyboardInterrupt(), after=5, meanwhile=stop))
    drives.advance(0.1)
    assert cia402.matches(drives.read(0x6041), cia402.QUICK_STOP_ACTIVE).all()


def test_an_acknowledge_that_did_not_rise_does_not_count():
    drive = Deaf()
    with pytest.raises(TimeoutError, match=r"axis 0 did not reach end of set-point acknowledge in 0\.1 s"):
        motion.start_move(drive, WAY, timeout=0.1)
    assert drive.controlword == 0x0F


def test_a_move_costs_no_cycle_more(drives):
    motion.enable(drives, mode="pp")
    watched = Watched(drives)
    motion.start_move(watched, WAY)
    assert watched.words == [0x0F, 0x1F, 0x0F] and watched.passed == 0.0


def test_a_relative_move_waits_for_room_in_a_buffer_that_somebody_has_filled(tmp_path):
    """Before: the edge was ignored, the acknowledge of the one before taken for its own, and its way lost."""
    with build(tmp_path, set_point_buffer=1) as drives:
        motion.enable(drives, mode="pp")
        for name, value in ((0x6081, 400_000), (0x6083, 4_000_000), (0x6084, 4_000_000), (0x607A, 65_536)):
            drives.write(name, value)
        start = drives.machine.rotor_angle.copy()
        for word in (0x5F, 0x4F, 0x5F, 0x4F):  # one under way, one that waits
            drives.write(0x6040, word)
            drives.advance(0.002)
        motion.start_move(drives, 65_536, relative=True, timeout=5.0)
        drives.advance(2.0)
        np.testing.assert_allclose(drives.machine.rotor_angle - start, 3 * 2.0 * np.pi, rtol=0.01)
