"""Times of the TGZ on EtherCAT: SYNC1, the cycle that C-SetCycleTime has, and what registers measure of both."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from rigs.coe_rig import CoeRig
from rigs.ethercat_segment import EmulatedSegment

from drive_env import EmulatedDrives, EtherCatDrives, motion
from drive_env.ethercat.application import AlState
from drive_env.ethercat.world import EtherCatWorld

US = 1000  # ns
SYNC_TIME, PACKET_TIME, SET_CYCLE = 0x200E, 0x3340, 0x2010
CSP, TARGET = 40, struct.Struct("<i36x")  # image 1701h: 607Ah first


@pytest.fixture(scope="module")
def machine():
    with EmulatedDrives("tgz_d", "gantry", num_threads=1) as drives:
        yield drives


@pytest.fixture
def rig(machine):
    machine.machine.reset()
    machine.set_cycle(1e-3)
    rig = CoeRig(machine)
    rig.bring_to(AlState.PRE_OP)
    return rig


def number(rig, index, sub=0):
    return int.from_bytes(rig.upload(index, sub), "little")


def start_clocks(rig, cycle, delay=None, ahead=1_500_000):
    """SYNC0 from `ahead` [ns] after now on, and with a delay [ns] SYNC1."""
    rig.write(0x0990, struct.pack("<Q", rig.value(0x0910, 8) + ahead))
    rig.write(0x09A0, struct.pack("<2I", cycle, delay or 0))
    rig.write(0x0981, "03" if delay is None else "07")


# --- SYNC1 ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("delay", "at"), [(None, 1500), (0, 1500), (400, 1900), (1250, 2750)])
def test_outputs_take_effect_with_the_sync1_that_the_master_makes(rig, machine, delay, at):
    """From SYNC0 at 1.5 ms on, each millisecond; without SYNC1 its pulse counts."""
    start_clocks(rig, 1000 * US, None if delay is None else delay * US)
    rig.bring_to(AlState.OP, outputs=CSP, inputs=CSP)
    began = rig.world.time
    rig.node.outputs(TARGET.pack(777), began)
    before = machine.read(0x607A)[0]
    rig.slave.run_until(began + 1e-6 * (at - 20))
    assert machine.read(0x607A)[0] == before != 777
    rig.slave.run_until(began + 1e-6 * (at + 20))
    assert machine.read(0x607A)[0] == 777


@pytest.mark.parametrize(
    ("cycle", "delay", "period"),
    [(1000, None, 1000), (1000, 0, 1000), (500, 100, 500), (250, 750, 1000), (500, 500, 1000)],
)
def test_type_cycle_and_c_synctime_are_those_of_the_pulses_that_count(rig, cycle, delay, period):
    """A SYNC1 that comes after the next SYNC0 leaves that out (ET1100): its time is a multiple of SYNC0's."""
    assert number(rig, 0x1C32, 4) == 0x0E, "SYNC0 and SYNC1 are supported"
    start_clocks(rig, cycle * US, None if delay is None else delay * US)
    rig.bring_to(AlState.SAFE_OP, outputs=CSP, inputs=CSP)
    assert number(rig, 0x1C32, 1) == (2 if delay is None else 3)
    assert number(rig, 0x1C33, 2) == period * US
    assert number(rig, SYNC_TIME) == 0
    rig.slave.run_until(rig.world.time + 0.0098)
    assert number(rig, SYNC_TIME) == period
    rig.write(0x0981, "00")
    rig.request(AlState.PRE_OP)
    rig.request(AlState.SAFE_OP)
    assert number(rig, SYNC_TIME) == 0


def test_a_sync1_whose_time_the_drive_does_not_know_is_refused(rig):
    start_clocks(rig, 250 * US, 500 * US)  # every 750 us
    rig.configure(CSP, CSP)
    assert rig.request(4) == (0x12, 0x0035)
    start_clocks(rig, 250 * US, 250 * US)  # every 500 us
    assert rig.request(0x14) == (4, 0)


def test_sync1_that_is_asked_for_must_be_there(rig):
    assert rig.download(0x1C32, 1, struct.pack("<H", 3)) == 0
    start_clocks(rig, 1000 * US)
    rig.configure(CSP, CSP)
    assert rig.request(4) == (0x12, 0x0030)


def test_our_master_makes_both():
    with (
        EmulatedSegment("tgz_d", load="gantry") as segment,
        EtherCatDrives("tgz_d", master=segment.master(), pace="lockstep", sync0=True) as drives,
    ):
        before = drives.read(0x6064)
        motion.enable(drives, mode="csp")
        drives.record([0x6064], 0.2, {0x607A: before + np.minimum(np.arange(200), 150)[:, None] * [40, 40]})
        drives.advance(0.2)
        assert drives.read(0x6064) - before == pytest.approx([5960, 5960], abs=200)
        clock = segment.slaves[0].controller.clock
        assert clock.has_sync1 and clock.sync1_cycle == clock.cycle == 1000 * US
        motion.disable(drives)


# --- C-SetCycleTime ---------------------------------------------------------------------------------------------------
def axis_of(rig, cycles, step):
    """Enable both axes in csp and ramp their set-points by `step` a frame; return the positions of axis 1 [inc]."""
    for index in (0x6060, 0x6860):
        assert rig.download(index, 0, b"\x08") == 0
    rig.bring_to(AlState.OP, outputs=CSP, inputs=CSP)
    image, found, target, words = bytearray(CSP), [], None, [0x80, 0x06, 0x07, 0x0F]
    began = rig.world.time
    for _ in range(cycles):
        data, _ = rig.exchange_image(bytes(image), CSP)
        at = struct.unpack_from("<i", data, 0)[0], struct.unpack_from("<i", data, 20)[0]
        word = words[min(int((rig.world.time - began) / 0.04), 3)]
        enabled = all(struct.unpack_from("<H", data, place)[0] & 0x6F == 0x27 for place in (12, 32))
        target = [one + step for one in target] if enabled and target else list(at)
        for axis in range(2):
            struct.pack_into("<i", image, 20 * axis, target[axis])
            struct.pack_into("<H", image, 20 * axis + 12, word)
        found.append((rig.world.time, *at, *target))
    return np.array(found)


@pytest.mark.parametrize("cycle", [250, 500, 1000, 2000])
def test_a_frame_is_a_cycle_of_c_setcycletime_and_each_set_point_acts(rig, machine, cycle):
    """At one speed, 60 rpm, the same place after the same time; the demand has a new value each cycle.

    The drive itself has cycles of 1 ms at the most: of 2000 us two.
    """
    assert rig.download(SET_CYCLE, 0, struct.pack("<I", cycle)) == 0
    step = 2**20 * cycle // 1_000_000
    found = axis_of(rig, 300_000 // cycle, step)
    assert np.diff(found[:, 0]) == pytest.approx(1e-6 * cycle)
    assert number(rig, PACKET_TIME) == cycle
    assert rig.world.next_event() - rig.world.time == pytest.approx(min(1e-6 * cycle, 1e-3), abs=1e-9)
    for axis in (1, 2):
        speed = np.diff(found[-(100_000 // cycle) :, axis]).mean() / (1e-6 * cycle)
        assert speed == pytest.approx(2**20, rel=0.03)
    demand = []
    for _ in range(4):  # set-points of one cycle each: no two of four are alike
        struct.pack_into("<i", image := bytearray(CSP), 0, int(found[-1, 3]) + step * (len(demand) + 1))
        struct.pack_into("<H", image, 12, 0x0F)
        rig.exchange_image(bytes(image), CSP)
        demand.append(int(machine.read(0x6062)[0]))
    assert np.diff(demand) == pytest.approx(step, abs=2)


def test_the_cycle_is_taken_before_safe_op_and_given_back(rig, machine):
    assert rig.download(SET_CYCLE, 0, struct.pack("<I", 250)) == 0
    assert machine.device.cycle == pytest.approx(1e-3)
    rig.bring_to(AlState.SAFE_OP, outputs=CSP, inputs=CSP)
    assert machine.device.cycle == rig.world.cycle_time == pytest.approx(250e-6)
    assert machine.device.velocity_rate == 4000  # the nearest below 5000 that divides 250 us
    assert rig.download(SET_CYCLE, 0, struct.pack("<I", 1000)) == 0
    rig.request(AlState.PRE_OP)
    rig.bring_to(AlState.SAFE_OP, outputs=CSP, inputs=CSP)
    assert machine.device.cycle == pytest.approx(1e-3) and machine.device.velocity_rate == 5000


def test_what_is_scheduled_keeps_its_time_and_a_coasting_load_its_speed():
    with EmulatedDrives("tgz_d", "inertia", num_threads=1, ideal=True) as drives:
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, 300_000)
        drives.advance(0.3)
        drives.machine.schedule("motor.inertia", [0.01], [2.0 * drives.machine.parameters["motor.inertia"][0]])
        drives.write(0x6040, 0)  # it coasts
        before, inertia = drives.machine.rotor_speed[0], drives.machine.parameters["motor.inertia"][0]
        drives.set_cycle(250e-6)
        drives.advance(0.00975)
        assert drives.machine.parameters["motor.inertia"][0] == inertia
        assert drives.machine.rotor_speed[0] == pytest.approx(before, rel=0.05)
        drives.advance(0.0005)
        assert drives.machine.parameters["motor.inertia"][0] == 2.0 * inertia


def test_slaves_of_other_cycles_go_on_at_their_own():
    world = EtherCatWorld()
    with EmulatedDrives("tgz_d", "inertia", num_threads=1) as fast, EmulatedDrives("tmcm3313", "portal") as slow:
        world.drives += [fast, slow]
        fast.set_cycle(250e-6)
        for _ in range(10):
            world.cycle()
        assert world.time == pytest.approx(2.5e-3)
        assert (fast.inside.cycle, slow.inside.cycle) == (10, 2)


def test_our_master_tells_the_drive_its_cycle_and_puts_the_drives_back():
    with EmulatedSegment("tgz_d", load="gantry") as segment:
        segment.drives.write(SET_CYCLE, 250)
        with EtherCatDrives("tgz_d", master=segment.master(), pace="lockstep") as drives:
            motion.enable(drives, mode="csp")
            assert segment.world.cycle_time == pytest.approx(1e-3)
            assert segment.drives.read(SET_CYCLE)[0] == 1000
            motion.disable(drives)
        assert segment.drives.read(SET_CYCLE)[0] == 250
