"""Distributed clocks in the master: delays, offsets, SYNC0 of 250 us to 4 ms, frames between its pulses."""

from __future__ import annotations

import struct
import time

import numpy as np
import pytest
from rigs.ethercat_segment import EmulatedSegment

from drive_env import EmulatedDrives, Limits, motion
from drive_env.ethercat.application import AlState
from drive_env.ethercat.ethercat_server import EtherCatServer
from drive_env.ethercat.segment import HOP
from drive_env.ethercat.ways import UdpSocket
from drive_env.fieldbus.errors import BusError
from drive_env.master.ethercat.clocks import FramePhase, delays_in_a_line, set_offsets
from drive_env.master.ethercat_drives import EtherCatDrives
from drive_env.master.pace import RealTimePace

SAMPLED = [0x6041, 0x6064, 0x606C]
SYNC, TYPE, CYCLE_TIME, MISSED = 0x1C32, 1, 2, 11
RATES = {"current": 32000, "velocity": 8000, "supervision": 4000, "communication": 4000}


def at_rate(tmp_path, rate):
    """A TMCM-3313 with a communication cycle of its own."""
    rates = RATES if rate > 1000 else {"communication": rate}
    path = tmp_path / "variant.toml"
    lines = "\n".join(f"{name} = {value}" for name, value in rates.items())
    path.write_text(f'variant_of = "tmcm3313"\n[rates]\n{lines}\n', encoding="utf-8")
    return "tmcm3313" if rate == 1000 else str(path)


def csp(drives, cycle, rows):
    motion.enable(drives, mode="csp")
    targets = drives.read(0x6064) + np.minimum(np.arange(rows), rows // 2)[:, None] * [4, 8, 12]
    trace = drives.record(SAMPLED, rows * cycle, {0x607A: targets}, period=cycle)
    return np.stack([trace[index] for index in SAMPLED])


def shown(segment, sub, position=0):
    return segment.slaves[position].application.dictionary.port(SYNC, sub).read()


# --- virtual time -----------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("rate", [4000, 1000, 250])
def test_in_lockstep_outputs_take_effect_at_the_next_pulse(tmp_path, rate):
    """Integers are those without clocks, of which each row acts a cycle later, from 250 us to 4 ms."""
    device, cycle, rows = at_rate(tmp_path, rate), 1.0 / rate, 160
    found = {}
    for sync0 in (False, True):
        with (
            EmulatedSegment(device) as segment,
            EtherCatDrives(device, master=segment.master(), pace="lockstep", sync0=sync0) as drives,
        ):
            found[sync0] = csp(drives, cycle, rows)
            assert segment.slaves[0].state is AlState.OP
            kind = (2, round(cycle * 1e9)) if sync0 else (1, round(cycle * 1e9))
            assert (shown(segment, TYPE), shown(segment, CYCLE_TIME)) == kind
            assert shown(segment, MISSED) == 0
    np.testing.assert_array_equal(found[True][1, 1:], found[False][1, :-1])
    assert (np.ptp(found[True][1], axis=0) > 100).all(), "every axis moved"


@pytest.mark.slow
def test_at_4_khz_in_lockstep_a_policy_acts_in_each_cycle(tmp_path):
    """The same integers as in process, row by row, of one call for each cycle of 250 us."""
    device, cycle = at_rate(tmp_path, 4000), 0.00025

    def policy(drives):
        motion.enable(drives, mode="csp")
        start, rows = drives.read(0x6064), []
        for k in range(120):
            trace = drives.record(SAMPLED, cycle, {0x607A: [start + k * np.array([1, 2, 3])]}, period=cycle)
            rows.append([trace[index][0] for index in SAMPLED])
        return np.array(rows)

    with EmulatedDrives(device, load="portal", num_threads=1) as inside:
        inside.advance(0.002)
        expected = policy(inside)
    with EmulatedSegment(device) as segment, EtherCatDrives(device, master=segment.master(), pace="lockstep") as drives:
        np.testing.assert_array_equal(policy(drives), expected)
    assert (np.ptp(expected[:, 1], axis=0) > 50).all()


@pytest.mark.slow
def test_clocks_of_all_slaves_show_one_time_and_pulse_together():
    with (
        EmulatedSegment(number=3) as segment,
        EtherCatDrives(master=segment.master(), nodes=(0, 1, 2), pace="lockstep", sync0=True) as drives,
    ):
        drives.record(SAMPLED, 0.02)
        now = round(segment.world.time * 1e9)
        clocks = [slave.controller.clock for slave in segment.slaves]
        assert np.ptp([clock.system(now) for clock in clocks]) <= 2  # ns; they were 1 us apart
        pulses = [clock.next_pulse() for clock in clocks]
        assert np.ptp(pulses) <= 3 and pulses[0] > now
        assert all(clock.system(pulse) % 1_000_000 <= 2 for clock, pulse in zip(clocks, pulses, strict=True))
        delays = [slave.controller.register(0x0928, 4) for slave in segment.slaves]
        assert delays == pytest.approx([0, HOP, 2 * HOP], abs=2)
    assert not any(clock.has_sync0 for clock in clocks), "switched off at the end"


@pytest.mark.slow
def test_a_slave_without_clocks_is_told():
    with EmulatedSegment() as segment:
        segment.slaves[0].controller.memory[8] &= ~0x04  # features
        with pytest.raises(BusError, match="position 0 has no distributed clocks; open it without sync0"):
            EtherCatDrives(master=segment.master(), pace="lockstep", sync0=True)


@pytest.mark.parametrize("local", [(5, 1005), (10**18, 7), (7, 10**18), (3 << 60, 2**64 - 1)])
def test_an_offset_makes_a_local_time_that_of_the_first_slave_and_the_frames_way(local):
    """System time is local time plus 0920h, in 64 bits (ETG.1000.4): a clock counts nanoseconds, for centuries."""
    written = {}

    class Registers:
        """A master of two slaves through which a frame has just gone: 0900h to 091Fh, and what is written."""

        def register(self, position, address, size):
            out, back = (100, 1300) if position == 0 else (900, 0)  # the way is 600 ns
            return struct.pack("<IIIIQQ", out, back, 0, 0, 0, local[position])

        def write_register(self, position, address, data):
            written[position, address] = int.from_bytes(data, "little")

    set_offsets(Registers(), 2)
    system = [(local[k] + written[k, 0x0920]) % 2**64 for k in (0, 1)]
    assert system == [local[0], local[0] + 600]
    assert [written[k, 0x0928] for k in (0, 1)] == [0, 600]


# --- when frames go ---------------------------------------------------------------------------------------------------
def test_delays_by_receive_times():
    """A frame is at port 0 on its way out and at port 1 on its way back; the last slave has no way back. ns."""
    assert delays_in_a_line([(1000, 7000), (50, 4050), (900, 2900), (7, 7)]) == [0, 1000, 2000, 3000]
    assert delays_in_a_line([(2**32 - 10, 990), (5, 5)]) == [0, 500], "the counter of 32 bits begins anew"


@pytest.mark.parametrize(("system", "later"), [(0, 0.0005), (250_000, 0.00025), (500_000, 0.0), (600_000, 0.0009)])
def test_the_next_frame_goes_in_the_middle_between_two_pulses(system, later):
    phase = FramePhase(0.001)
    assert phase.wait(time.perf_counter()) == 0.0, "nothing is known yet"
    phase.take(7_000_000_000 + system)
    assert phase.wait(phase._seen[0]) == pytest.approx(later, abs=1e-8)
    assert phase.wait(phase._seen[0] + 0.0043) == pytest.approx((later - 0.0043) % 0.001, abs=1e-8)


class Clock:
    """A clock in place of this computer's, which goes on while somebody waits."""

    now = 100.00037

    def perf_counter(self):
        return self.now

    def wait(self, timeout):
        self.now += timeout
        return False


@pytest.mark.parametrize("fast", [1.0001, 0.9999])
def test_a_pace_begins_with_the_pulses_and_stays_with_them(monkeypatch, fast):
    """The drives' clock is 100 ppm away from this computer's, and their pulses are at its whole milliseconds."""
    cycle, clock = 0.001, Clock()
    monkeypatch.setattr("drive_env.master.pace.time", clock)
    pace = RealTimePace(cycle, lambda due: (0.5 * cycle - due * fast) % cycle)
    pace.begin()
    off = []
    for _ in range(200):
        pace.wait(clock.wait)
        off.append(clock.now * fast % cycle - 0.5 * cycle)
    assert np.abs(off).max() < 1e-6
    clock.now += 0.0042  # this computer was late by four cycles: a frame goes at once, those after it catch up
    for _ in range(40):
        pace.wait(clock.wait)
    assert clock.now * fast % cycle == pytest.approx(0.5 * cycle, abs=1e-6)


# --- real time --------------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("cycle", [0.001, 0.004])
def test_in_real_time_over_udp_all_axes_follow_by_sync0(cycle):
    with EmulatedSegment() as segment:
        segment.world.lockstep = False
        way = UdpSocket(0)
        try:
            with (
                EtherCatServer(segment.world, way),
                EtherCatDrives(
                    interface="ethercat-udp",
                    channel=str(way.port),
                    sync0=True,
                    cycle=cycle,
                    timeout=5.0,
                    safety=Limits(silence=3.0),
                ) as drives,
            ):
                motion.enable(drives, mode="csp")
                start, rows = drives.read(0x6064), round(0.4 / cycle)
                targets = start + np.minimum(np.arange(rows), rows // 2)[:, None] * [8, 16, 24]
                trace = drives.record(SAMPLED, rows * cycle, {0x607A: targets}, period=cycle)
                assert (shown(segment, TYPE), shown(segment, CYCLE_TIME)) == (2, round(1e9 * cycle))
                assert trace[0x6064][-1] - start == pytest.approx(targets[-1] - start, abs=60)
                motion.disable(drives)
        finally:
            segment.world.lockstep = True
