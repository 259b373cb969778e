"""Enabling moves nothing: what a program has left in the target of a mode is written over, and twins begin together."""

import numpy as np
import pytest
from rigs.ethercat_segment import EmulatedSegment
from rigs.world_bus import bus_of

from drive_env import CanDrives, EmulatedDrives, cia402, motion
from drive_env.devices import find_device
from drive_env.dictionary.roles import Role
from drive_env.master.ethercat_drives import EtherCatDrives

MODES = {
    "tmcm1636": ["pp", "pv", "csp", "csv", "cst"],
    "tmcm3313": ["pp", "pv", "csp", "csv", "cst"],
    "tmcm6212": ["pp", "pv", "csp", "csv"],
    "tgz_d": ["pp", "pv", "tq", "csp", "csv", "cst"],
}
ROWS = [(device, mode) for device, modes in MODES.items() for mode in modes]
LEFT = {0x60FF: 300_000, 0x6071: 500, 0x607A: 200_000, 0x6083: 2_000_000, 0x60B1: 100_000, 0x60B2: 300}
STILL = 0.05  # rad: noise and the grid of positions; what was left turns an axis by some radians


def leave(drives, device):
    """What a program has left that is dead."""
    known = find_device(device).new_dictionary()
    scale = drives.read(Role.POSITION_SCALE).max() / 65536.0
    for index, value in LEFT.items():
        if known.has((index, 0)):
            of_position = known.find(index).unit in ("inc", "pps", "pps^2")
            drives.write(index, round(value * (scale if of_position else 1)))
    drives.advance(0.01)


def way(drives, inside, duration=0.5):
    before = inside.machine.rotor_angle.copy()
    drives.advance(duration)
    return float(np.abs(inside.machine.rotor_angle - before).max())


@pytest.mark.every(2)
@pytest.mark.parametrize(("device", "mode"), ROWS)
def test_enabling_turns_no_motor(device, mode):
    """Before: 60FFh = 300,000 that was left turned a TMCM-1636 at 4.6 rev/s."""
    with EmulatedDrives(device, "inertia", num_threads=1) as drives:
        leave(drives, device)
        motion.enable(drives, mode=mode)
        assert way(drives, drives) < STILL
        if mode != "pp":
            motion.quick_stop(drives)
            drives.advance(0.3)
            leave(drives, device)
            motion.enable(drives)
            assert way(drives, drives) < STILL, "in the mode that it has"


@pytest.mark.every(7)
@pytest.mark.parametrize(("device", "mode"), ROWS)
def test_another_mode_turns_no_enabled_motor(device, mode):
    with EmulatedDrives(device, "inertia", num_threads=1) as drives:
        motion.enable(drives, mode="pp")
        leave(drives, device)
        motion.select_mode(drives, mode)
        assert way(drives, drives) < STILL


@pytest.mark.every(3)
@pytest.mark.parametrize("mode", ["pv", "csv", "cst", "csp"])
def test_nor_over_a_bus(mode):
    inside = EmulatedDrives("tmcm1636", "inertia", num_threads=1)
    with bus_of(inside, [1]) as bus:
        with CanDrives(bus=bus, pace="lockstep", safety=False) as dead:
            leave(dead, "tmcm1636")
        with CanDrives(bus=bus, pace="lockstep") as drives:
            motion.enable(drives, mode)
            assert way(drives, inside) < STILL


def test_an_offset_of_the_axis_stays_as_it_is_and_turns_nothing():
    with EmulatedDrives("tmcm1636", "inertia", num_threads=1) as drives:
        drives.write(0x60B1, 200_000)
        motion.enable(drives, "csv")
        assert way(drives, drives) < STILL
        assert drives.read(0x60B1) == [200_000] and drives.read(0x60FF) == [-200_000]


def test_an_axis_that_was_stopped_does_not_go_on():
    """Before: quick stop active with 605Ah = 6 was left at the speed of before."""
    with EmulatedDrives("tmcm1636", "inertia", num_threads=1) as drives:
        drives.write(0x605A, 6)
        motion.enable(drives, "pv")
        drives.write(0x60FF, 200_000)
        drives.advance(1.0)
        motion.quick_stop(drives)
        drives.advance(1.0)
        assert cia402.matches(drives.read(0x6041), cia402.QUICK_STOP_ACTIVE).all()
        motion.enable(drives)
        assert way(drives, drives) < STILL


def test_an_axis_that_is_enabled_goes_on():
    with EmulatedDrives("tmcm1636", "inertia", num_threads=1) as drives:
        motion.enable(drives, "pv")
        drives.write(0x60FF, 200_000)
        drives.advance(1.0)
        motion.enable(drives, "pv")
        assert drives.read(0x60FF) == [200_000] and way(drives, drives) > 5.0


def test_each_axis_stays_in_the_mode_that_it_has():
    with EmulatedDrives("tmcm6212", num_machines=1, num_threads=1) as drives:
        count = drives.num_axes
        drives.write(0x6060, np.where(np.arange(count) % 2 == 0, cia402.PV, cia402.CSP))
        drives.write(0x60FF, 300_000)
        drives.advance(0.01)
        motion.enable(drives)
        assert way(drives, drives) < STILL


@pytest.fixture
def gantry():
    """Both axes of a TGZ-D on the two rails of a gantry; a millisecond passes with each frame, whatever it carries."""
    segment = EmulatedSegment("tgz_d", lockstep=False, load="gantry")
    segment.states = []  # in each cycle, which axes were in operation enabled

    def frame_takes_a_cycle(frame):
        segment.world.run_until(segment.world.next_cycle)
        status = segment.drives.read(0x6041)
        segment.states.append(cia402.matches(status, cia402.OPERATION_ENABLED).tolist())
        return frame

    segment.damage = frame_takes_a_cycle
    yield segment
    segment.world.close()


def test_twins_get_and_lose_their_voltage_in_one_cycle(gantry):
    """Before: four frames apart; 14 ms over a mailbox that answers in its own time."""
    with EtherCatDrives("tgz_d", master=gantry.master(), safety=False) as drives:
        motion.enable(drives, mode="csv")
        drives.advance(0.01)
        motion.disable(drives)
    assert [True, True] in gantry.states
    assert all(first == second for first, second in gantry.states)
