"""Distributed clocks: port receive times, offset, delay, drift, SYNC0 (ETG.1000.4, 6.8; ET1100, 0900h to 09FFh)."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from rigs.ethercat_rig import STATION, Rig

from drive_env.ethercat.application import AlState
from drive_env.ethercat.datagrams import DatagramCommand, at_station
from drive_env.ethercat.segment import HOP

DRIFTS, EPOCHS = [0.0, 50e-6, -80e-6, 20e-6], [123_456_789, 5_000_000_000, 17, 1 << 40]


@pytest.fixture
def rig():
    rig = Rig(4, lockstep=False, drift=DRIFTS, epoch=EPOCHS)
    rig.address()
    rig.world.run_until(1.0)
    return rig


def times(rig, k):
    """Receive times of ports 0 and 1, and of the processing unit, of slave k."""
    station = STATION + k
    return rig.value(0x0900, 4, station), rig.value(0x0904, 4, station), rig.value(0x0918, 8, station)


def synchronise(rig):
    """Measure delays and set offsets as a master does; returns the delays [ns]."""
    rig.send(at_station(DatagramCommand.BWR, 0, 0x0900, bytes(4)))
    first, back, reference = times(rig, 0)
    loop = (back - first) % 2**32
    delays = [0]
    for k in range(1, 4):
        port0, port1, unit = times(rig, k)
        own = (port1 - port0) % 2**32 if k < 3 else 0
        delays.append((loop - own) // 2)
        rig.write(0x0920, struct.pack("<Q", (reference - unit + delays[-1]) % 2**64), STATION + k)
        rig.write(0x0928, struct.pack("<I", delays[-1]), STATION + k)
    return delays


def errors(rig):
    """System times of all slaves less the first one's at the same instant [ns]."""
    now = round(rig.world.time * 1e9)
    system = [slave.controller.clock.system(now) for slave in rig.slaves]
    return [value - system[0] for value in system]


def test_port_receive_times_measure_the_line(rig):
    """A frame comes to port 0 on its way out and to port 1 on its way back; the last one's port 1 is closed."""
    rig.send(at_station(DatagramCommand.BWR, 0, 0x0900, bytes(4)))
    loops = []
    for k in range(4):
        port0, port1, unit = times(rig, k)
        assert unit % 2**32 == port0
        assert unit == pytest.approx(EPOCHS[k] + 1e9 * (1 + DRIFTS[k]), abs=2000)
        loops.append((port1 - port0) % 2**32 if k < 3 else 0)
    assert loops == pytest.approx([6 * HOP, 4 * HOP, 2 * HOP, 0], abs=2)


def test_delays_and_offsets(rig):
    assert synchronise(rig) == pytest.approx([0, HOP, 2 * HOP, 3 * HOP], abs=2)
    assert np.abs(errors(rig)).max() < 200  # ns; drift alone since the measurement


@pytest.mark.parametrize("command", [DatagramCommand.ARMW, DatagramCommand.FRMW])
def test_the_first_clock_draws_the_others(rig, command):
    synchronise(rig)
    station = 0 if command is DatagramCommand.ARMW else STATION
    world = rig.world
    for _ in range(2000):
        world.run_until(world.time + 1e-3)
        rig.send(at_station(command, station, 0x0910, bytes(8)))
    assert np.abs(errors(rig)).max() < 20  # ns; without, 80 ppm of 2 s are 160 us
    for k in (1, 2, 3):
        difference = rig.value(0x092C, 4, STATION + k)
        assert difference & 0x7FFFFFFF < 20
        share = struct.unpack("<h", rig.read(0x0932, 2, STATION + k))[0] / 0x1000
        assert share == pytest.approx(-DRIFTS[k], abs=1.5 / 0x1000)


def test_without_it_they_drift_apart(rig):
    synchronise(rig)
    rig.world.run_until(rig.world.time + 2.0)
    assert errors(rig)[1:] == pytest.approx([100e3, -160e3, 40e3], rel=0.05)  # ns: 50, -80, 20 ppm of 2 s


def test_an_offset_is_caught_up_with_and_time_never_goes_back(rig):
    synchronise(rig)
    clock = rig.slaves[1].controller.clock
    offset = rig.value(0x0920, 8, STATION + 1)
    rig.write(0x0920, struct.pack("<Q", (offset + 50_000) % 2**64), STATION + 1)  # 50 us ahead
    world, seen = rig.world, []
    for _ in range(3000):
        world.run_until(world.time + 1e-3)
        rig.send(at_station(DatagramCommand.ARMW, 0, 0x0910, bytes(8)))
        seen.append(clock.system(round(world.time * 1e9)))
    assert np.diff(seen).min() > 0.85e6  # ns in a millisecond
    assert np.abs(errors(rig)).max() < 20


def test_the_sign_of_the_difference_says_who_is_ahead(rig):
    synchronise(rig)
    for ahead, sign in ((2000, 0), (-2000, 1)):
        rig.write(0x0930, "00 10", STATION + 1)  # the filter begins anew
        offset = rig.value(0x0920, 8, STATION + 1)
        rig.write(0x0920, struct.pack("<Q", (offset + ahead) % 2**64), STATION + 1)
        rig.send(at_station(DatagramCommand.ARMW, 0, 0x0910, bytes(8)))
        assert rig.value(0x092C, 4, STATION + 1) >> 31 == sign
        rig.write(0x0920, struct.pack("<Q", offset), STATION + 1)


# --- SYNC0 ------------------------------------------------------------------------------------------------------------
def start_sync0(rig, ahead, cycle, station=STATION):
    now = rig.value(0x0910, 8, station)
    rig.write(0x0990, struct.pack("<Q", now + ahead), station)
    rig.write(0x09A0, struct.pack("<I", cycle), station)
    rig.write(0x0981, "03", station)


@pytest.fixture
def safe_op():
    rig = Rig(lockstep=False)
    rig.address()
    rig.bring_to(AlState.SAFE_OP)
    return rig


def pulses(rig):
    return [event[1] for event in rig.devices[0].events if event[0] == "sync0"]


@pytest.mark.parametrize("cycle", [250e-6, 1e-3, 4e-3])
def test_sync0_has_its_cycle_from_its_start_on(safe_op, cycle):
    world = safe_op.world
    start_sync0(safe_op, 10_000_000, round(cycle * 1e9))
    assert safe_op.value(0x0984, 1) == 1
    step, found = 10e-6, []
    while world.time < 0.03:
        before = len(pulses(safe_op))
        world.run_until(min(world.time + step, 0.03))
        found += [world.time] * (len(pulses(safe_op)) - before)
    expected = np.arange(0.01, 0.03 - 1e-9, cycle)
    assert len(found) >= len(expected)
    assert np.abs(np.array(found[: len(expected)]) - expected).max() <= 1.1 * step


def test_the_next_pulse_is_the_next_event(safe_op):
    start_sync0(safe_op, 10_250_000, 1_000_000)
    safe_op.world.run_until(10e-3)
    assert safe_op.world.next_event() == pytest.approx(10.25e-3, abs=1e-8)
    safe_op.world.run_until(10.3e-3)
    assert len(pulses(safe_op)) == 1
    assert safe_op.value(0x0990, 8) % 1_000_000 == 250_000  # it shows the next one


def test_one_shot(safe_op):
    start_sync0(safe_op, 1_000_000, 0)
    safe_op.world.run_until(0.05)
    assert len(pulses(safe_op)) == 1


def test_a_start_that_has_passed_makes_no_pulse(safe_op):
    safe_op.world.run_until(0.1)
    start_sync0(safe_op, -1_000_000, 1_000_000)
    safe_op.world.run_until(0.2)
    assert not pulses(safe_op)
    assert safe_op.value(0x0984, 1) == 4  # start time is not in the near future


def test_switched_off_it_ends(safe_op):
    start_sync0(safe_op, 1_000_000, 1_000_000)
    safe_op.world.run_until(0.01)
    safe_op.write(0x0981, "00")
    count = len(pulses(safe_op))
    safe_op.world.run_until(0.05)
    assert len(pulses(safe_op)) == count > 5


def test_the_device_learns_the_cycle_before_it_agrees(safe_op):
    start_sync0(safe_op, 1_000_000, 500_000)
    safe_op.request(AlState.OP)
    assert safe_op.devices[0].clock.has_sync0
    assert safe_op.devices[0].clock.sync0_cycle == pytest.approx(500e-6)


def test_in_virtual_time_pulses_come_with_the_cycles():
    rig = Rig()
    rig.address()
    rig.bring_to(AlState.OP)
    start_sync0(rig, 5_500_000, 1_000_000)
    for _ in range(20):
        rig.exchange(bytes(4))
    assert rig.world.time == pytest.approx(0.02)
    assert len(pulses(rig)) == 15  # at 5.5 ms, 6.5 ms, ... 19.5 ms


def test_slaves_that_are_synchronised_pulse_together(rig):
    for k in range(4):
        rig.bring_to(AlState.SAFE_OP, STATION + k)
    synchronise(rig)
    world = rig.world
    start = rig.value(0x0910, 8) // 1_000_000 * 1_000_000 + 500_000_000
    for k in range(4):
        rig.write(0x0990, struct.pack("<Q", start), STATION + k)
        rig.write(0x09A0, struct.pack("<I", 1_000_000), STATION + k)
        rig.write(0x0981, "03", STATION + k)
    for _ in range(1000):
        world.run_until(world.time + 1e-3)
        rig.send(at_station(DatagramCommand.ARMW, 0, 0x0910, bytes(8)))
    following = [slave.controller.clock.next_pulse() for slave in rig.slaves]
    assert np.ptp(following) < 30  # ns
