"""Six faults on three kinds of drives: the emergency that the table says, its way back, and the same move as before."""

from __future__ import annotations

import time
from contextlib import contextmanager, suppress

import numpy as np
import pytest
from rigs.fault_injection import FaultyBus, served, until

from drive_env import CanDrives, EmulatedDrives, Limits, SafetyError, motion
from drive_env.faults.table import FAULTS
from drive_env.fieldbus.errors import BusError
from drive_env.master.can.port import open_bus
from drive_env.studio.machine_jobs import take_step

DEVICES = ("tmcm1636", "tmcm6212", "tgz_d")
OF_MACHINES = ("supply_dip", "encoder_stuck", "enable_lost", "brake_stuck", "limit_switch")
WINDOWS = {("tmcm1636", name): 30_000 for name in OF_MACHINES} | {("tgz_d", "encoder_stuck"): 30_000}  # of 6065h
SETTINGS = {("tmcm1636", "limit_switch"): {0x2005: 0}, ("tmcm6212", "limit_switch"): {0x2005: 0}}  # which lets it act
FROM_NODE = (0x81, 0x181, 0x281, 0x381, 0x481, 0x581, 0x701)


def row_of(drives, name):
    return FAULTS[name].on_firmware(drives.device.firmware_name)


def told_within(drives, seconds):
    """Return the codes of axis 0 within so long, resets left out."""
    codes = []
    for _ in range(round(seconds / 0.01)):
        drives.advance(0.01)
        codes += [one.code for one in drives.emergencies() if one.axis == 0 and one.code]
    return codes


def moves(drives, truth):
    """Enable, move to a target by 0.3 revolutions; return how far the rotor of axis 0 truly turned [rad]."""
    first = np.arange(drives.num_axes) == 0
    motion.enable(drives, mode="pp", where=first)
    drives.advance(0.05)
    start, place = truth()[0], int(drives.read(0x6064)[0])
    drives.write("Target position", "0.3 rev", where=first)
    goal = int(drives.read(0x607A)[0])
    motion.move_to(drives, goal, relative=True, where=first, timeout=20.0)
    drives.advance(0.3)
    assert abs(int(drives.read(0x6064)[0]) - place - goal) < 0.05 * goal
    return truth()[0] - start


@pytest.mark.every(4)
@pytest.mark.parametrize("name", OF_MACHINES)
@pytest.mark.parametrize("device", DEVICES)
def test_after_a_fault_the_table_s_way_back_leads_to_a_target_again(device, name):
    with EmulatedDrives(device, "belt", num_threads=1) as drives:
        first, truth = np.arange(drives.num_axes) == 0, lambda: drives.machine.rotor_angle
        row = row_of(drives, name)
        for index, value in SETTINGS.get((device, name), {}).items():
            drives.write(index, value)
        whole = moves(drives, truth)
        drives.write(0x6065, WINDOWS.get((device, name), 0))
        motion.enable(drives, mode="pv", where=first)
        drives.write("Target velocity", "60 rpm", where=first)
        assert told_within(drives, 0.3) == []
        drives.machine.fault(name)
        codes = told_within(drives, 1.5)
        assert codes[:1] == ([] if row.emergency is None else [row.emergency])
        for step in row.steps:
            if step != "home":
                take_step(step, name, 0)(drives)
            told_within(drives, 0.5)
        assert drives.machine.faults() == []
        assert moves(drives, truth) == pytest.approx(whole, rel=0.05)
        assert told_within(drives, 0.1) == []


@contextmanager
def deaf(bus):
    """While the block runs nothing of what a master sends arrives; the node is heard."""
    bus.meets = lambda number, message: message.arbitration_id in FROM_NODE
    try:
        yield
    finally:
        bus.meets = None


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
def test_after_a_network_that_was_lost_the_table_s_way_back_leads_to_a_target_again(device):
    with EmulatedDrives(device, "belt", num_threads=1) as emulated:
        emulated.advance(0.01)  # compiled before a node is waited for
    with EmulatedDrives(device, "belt", num_threads=1) as emulated, served(emulated) as (world, channel):
        bus = FaultyBus(open_bus("slcan", channel))
        with CanDrives(device, bus=bus, timeout=0.5, safety=Limits(silence=0.5)) as drives:
            row = row_of(drives, "bus_loss")
            truth = lambda: world.truth.theta()[-1]  # noqa: E731
            whole = moves(drives, truth)
            with deaf(bus):
                until(lambda: not world.truth.is_on()[0], "the drive's own stop")
                time.sleep(0.1)
            codes = []
            for _ in range(20):
                with suppress(SafetyError, BusError):
                    drives.advance(0.05)
                codes += [one.code for one in drives.emergencies() if one.axis == 0 and one.code]
            assert row.emergency in codes
            for step in row.steps[1:]:
                take_step(step, "bus_loss", 0)(drives)
            assert moves(drives, truth) == pytest.approx(whole, rel=0.05)
            motion.disable(drives)
