"""The envelope: what it refuses, when it stops drives, and what happens when the program stalls or dies."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from contextlib import nullcontext

import numpy as np
import pytest
from rigs.scripted_drive import ScriptedBus, ScriptedDrive
from rigs.world_bus import served

from drive_env import CanDrives, EmulatedDrives, Limits, SafetyError, motion
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.devices import find_device
from drive_env.fieldbus.errors import BusError
from drive_env.safety.supervisor import Supervisor

QUICK_STOP = bytes.fromhex("2B 40 60 00 02 00 00 00")
DISABLE = bytes.fromhex("2B 40 60 00 00 00 00 00")
TURN = 65536


@pytest.fixture
def drive():
    return ScriptedDrive()


@pytest.fixture
def bus(drive):
    with ScriptedBus(drive) as made:
        yield made


def enabled(bus, limits=True, mode="csv", **options):
    drives = CanDrives(bus=bus, safety=limits, **{"pace": "lockstep"} | options)
    motion.enable(drives, mode=mode)
    bus.log.clear()
    return drives


def sent_controlwords(bus):
    return [data[4] for data in bus.sent(0x601) if data[:4] == QUICK_STOP[:4]]


def test_set_points_inside_their_limits_cost_no_transfer_and_one_outside_is_refused(bus):
    """A policy plays one a millisecond: to ask for the mode each time would take it half of that."""
    with enabled(bus, Limits(position=(-TURN, TURN)), mode="csp") as drives:
        for _ in range(2):  # the first one maps
            bus.log.clear()
            drives.record([0x6064], 0.001, play={0x607A: [TURN]})
        assert bus.sent(0x601) == []
        with pytest.raises(SafetyError, match=r"607Ah:00 Target position would lead to 65537, beyond the limits"):
            drives.record([0x6064], 0.001, play={0x607A: [TURN + 1]})


# --- what is refused before it is sent ----------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("limits", "name", "value", "text"),
    [
        (Limits(velocity=1000), 0x60FF, -1001, r"60FFh:00 Target velocity = -1001 is beyond the limit 1000; "),
        (Limits(velocity=1000), 0x6081, 1001, r"6081h:00 Profile velocity = 1001 .* raise Limits\(velocity=\.\.\.\)"),
        (Limits(velocity=1000), 0x60B1, 1001, "beyond the limit 1000"),
        (Limits(current=500), 0x6071, 501, r"6071h:00 Target torque = 501 .* raise Limits\(current=\.\.\.\)"),
        (Limits(current=500), 0x2003, 501, r"2003h:00 Maximum Current = 501 is beyond the limit 500"),
        (Limits(), 0x6071, 7001, r"beyond the limit 7000; .* or raise the drive's own limit, 2003h"),
    ],
)  # fmt: skip
def test_a_command_beyond_a_limit_is_refused_and_not_sent(bus, drive, limits, name, value, text):
    with CanDrives(bus=bus, pace="lockstep", safety=limits) as drives:
        with pytest.raises(SafetyError, match=f"axis 0: .*{text}"):
            drives.write(name, value)
        assert not any(data[0] & 0xE0 == 0x20 for data in bus.sent(0x601))  # no download at all


@pytest.mark.parametrize(
    ("limits", "name", "value"),
    [(Limits(velocity=1000), 0x60FF, -1000), (Limits(current=500), 0x6071, 500), (Limits(), 0x60FF, 2**31 - 1),
     (Limits(), 0x2003, 45_000), (Limits(), 0x6071, 7000)],
)  # fmt: skip
def test_a_command_within_the_limits_goes_through(bus, drive, limits, name, value):
    with CanDrives(bus=bus, pace="lockstep", safety=limits) as drives:
        drives.write(name, value)
        assert drive.get(name) == value


def test_the_drives_own_position_limits_hold(bus, drive):
    drive.values[0x607D, 1], drive.values[0x607D, 2] = (-100, 4), (5000, 4)
    with enabled(bus, mode="csp") as drives:
        drives.write(0x607A, 5000)
        with pytest.raises(SafetyError, match=r"would lead to 5001, beyond the limits -100 to 5000; .* 607Dh"):
            drives.write(0x607A, 5001)
        drives.write((0x607D, 2), 6000)  # the program widens the drive's limit, and the envelope follows
        drives.write(0x607A, 5001)


def test_in_pp_the_target_counts_when_the_move_is_started(bus, drive):
    drive.motion = lambda d: d.set(0x6064, 900)
    drive.set(0x6062, 900)
    with enabled(bus, Limits(position=(0, 1000)), mode="pp") as drives:
        drives.write(0x607A, 2000)  # may be meant as a distance, or be overwritten
        with pytest.raises(SafetyError, match="would lead to 2000, beyond the limits 0 to 1000"):
            drives.write(0x6040, 0x1F)
        drives.write(0x607A, -500)
        drives.write(0x6040, 0x5F)  # relative: to 400
        drives.write(0x6040, 0x4F)
        drives.write(0x607A, 101)
        with pytest.raises(SafetyError, match="would lead to 1001"):
            drives.write(0x6040, 0x5F)


@pytest.mark.parametrize("word", [0x2F, 0x4F, 0x6F, 0x0F])
def test_in_pp_what_sets_no_new_set_point_starts_nothing(bus, drive, word):
    """Bit 4 alone starts a move (CiA 402); 5 and 6 say of one how it would be."""
    with enabled(bus, Limits(position=(0, 1000)), mode="pp") as drives:
        drives.write(0x607A, 2000)
        drives.write(0x6040, word)
        with pytest.raises(SafetyError, match="would lead to 2000"):
            drives.write(0x6040, word | 0x10)


def test_relative_moves_of_pp_add_up_by_their_starts_alone(bus):
    """Bit 6 without bit 4, as between two starts, is no start: 100 and 100 more are 200."""
    with enabled(bus, Limits(position=(-1000, 250)), mode="pp") as drives:
        drives.write(0x607A, 100)
        for word in (0x5F, 0x4F, 0x4F, 0x5F, 0x4F):
            drives.write(0x6040, word)
        with pytest.raises(SafetyError, match="would lead to 300"):
            drives.write(0x6040, 0x5F)


def test_rows_are_checked_before_the_first_is_sent(bus, drive):
    with enabled(bus, Limits(velocity=100), mode="csv") as drives:
        with pytest.raises(SafetyError, match="60FFh:00 Target velocity = -101"):
            drives.record([0x6064], 0.003, play={0x60FF: [0, -101, 3]})
        assert drive.syncs == 0
        drives.record([0x6064], 0.003, play={0x60FF: [0, -100, 100]})
        assert drive.syncs == 3


def test_limits_that_cannot_be_are_told():
    with pytest.raises(ValueError, match=r"position limits are lowest and highest, not \(5, 5\)"):
        Limits(position=(5, 5))
    with pytest.raises(ValueError, match="velocity must be above 0, not 0"):
        Limits(velocity=0)


# --- what is watched ----------------------------------------------------------------------------------------------
def ramp(index, step):
    def move(drive):
        drive.set(index, drive.get(index) + step)

    return move


@pytest.mark.parametrize(
    ("limits", "index", "step", "mode", "at", "text"),
    [
        (Limits(velocity=100), 0x606C, 10, "csv", 11, "606Ch:00 Velocity actual value is 110, and its limit is 100"),
        (Limits(velocity=100), 0x606C, -10, "csv", 11, "is 110"),
        (Limits(position=(-1000, 1000)), 0x6064, 100, "csv", 13, "is 300 increments beyond the limits -1000 to 1000"),
        (Limits(following_error=50), 0x6062, 10, "csp", 6, "the following error is 60, and its limit is 50"),
        (Limits(current=100), 0x6077, 20, "cst", 7 + 9, "the current is 320 for 10 cycles, and its limit is 100"),
    ],
)  # fmt: skip
def test_a_drive_beyond_a_limit_is_quick_stopped(bus, drive, limits, index, step, mode, at, text):
    with enabled(bus, limits, mode) as drives:
        drive.motion = ramp(index, step)
        with pytest.raises(SafetyError, match=f"axis 0: .*{text}.*: the drives were quick-stopped; "):
            drives.advance(0.1)
        assert sent_controlwords(bus) == [2]
        assert drive.syncs == at + 1  # the SYNC that showed it was the last
        drives.advance(0.002)  # it may be looked at afterwards


@pytest.mark.parametrize("mode", ["csv", "csp"])
def test_watching_costs_no_sdo_transfer(bus, drive, mode):
    with enabled(bus, Limits(following_error=100, position=(-1000, 1000)), mode=mode) as drives:
        drives.record([0x6064], 0.001)
        bus.log.clear()
        drives.record([0x6064], 0.020)
        assert bus.sent(0x601) == []
        assert len(bus.sent(0x080)) == 20


def test_nothing_is_watched_while_no_axis_is_enabled(bus, drive):
    with CanDrives(bus=bus, pace="lockstep", safety=Limits(velocity=100)) as drives:
        drive.set(0x606C, 5000)  # turned by hand
        drives.advance(0.01)


def test_an_axis_that_is_enabled_outside_may_come_back(bus, drive):
    drive.set(0x6064, 3000)
    with enabled(bus, Limits(position=(-1000, 1000))) as drives:
        drive.motion = ramp(0x6064, -100)
        drives.advance(0.025)  # to 500
        drive.motion = ramp(0x6064, 100)
        with pytest.raises(SafetyError, match="position is 300 increments beyond"):  # and not out again
            drives.advance(0.1)


def test_an_axis_that_is_enabled_outside_may_not_go_on(bus, drive):
    drive.set(0x6064, 3000)
    with enabled(bus, Limits(position=(-1000, 1000))) as drives:
        drive.motion = ramp(0x6064, 100)
        with pytest.raises(SafetyError, match="position is 2300 increments beyond"):
            drives.advance(0.1)


def test_an_axis_that_stands_outside_is_told_how_to_come_back(bus, drive):
    drive.set(0x6064, 3000)
    with (
        CanDrives(bus=bus, pace="lockstep", safety=Limits(position=(-1000, 1000))) as drives,
        pytest.raises(
            SafetyError, match=r"607Ah.* would lead to 3000.* nothing was sent.* stands outside comes back in pp or pv"
        ),
    ):
        motion.enable(drives, mode="csp")


@pytest.mark.parametrize(("mode", "stops"), [("hm", False), ("pv", True)])
def test_homing_is_exempt_from_the_drive_s_own_position_limits(bus, drive, mode, stops):
    drive.set(0x607D, -1000, 1)
    drive.set(0x607D, 1000, 2)
    drive.set(0x606C, TURN)
    with enabled(bus, mode=mode) as drives, pytest.raises(SafetyError) if stops else nullcontext():
        drive.motion = ramp(0x6064, TURN // 1000)
        drives.advance(0.1)


def test_a_following_error_counts_across_the_end_of_the_type(bus, drive):
    drive.set(0x6062, -(2**31))
    drive.set(0x6064, 2**31 - 1)  # one increment behind
    with enabled(bus, Limits(following_error=50), "csp") as drives:
        drives.advance(0.01)


@pytest.mark.parametrize(("period", "stops"), [(4, True), (20, True), (60, False)])
def test_an_oscillating_current_is_noticed(bus, drive, period, stops):
    def shake(d):
        d.set(0x6077, 4000 if d.syncs % period < period // 2 else -4000)

    with enabled(bus) as drives:
        drive.motion = shake
        if stops:
            with pytest.raises(
                SafetyError, match="axis 0 oscillates: its current swung 8 times past plus and minus 3500"
            ):
                drives.advance(0.5)
            assert sent_controlwords(bus) == [2]
        else:
            drives.advance(0.5)


def test_an_excitation_may_switch_the_detector_off(bus, drive):
    with enabled(bus, Limits(oscillation=False)) as drives:
        drive.motion = lambda d: d.set(0x6077, 4000 if d.syncs % 2 else -4000)
        drives.advance(0.3)


def test_on_the_emulator_gains_that_shake_end_in_a_quick_stop():
    with served("calls", load="inertia") as drives:
        motion.enable(drives, mode="csv")
        drives.write("Velocity Mode Settings.P_Parameter", 30_000)
        with pytest.raises(SafetyError, match=r"axis 0 oscillates: .* lower the velocity loop's gains"):
            drives.record([0x606C], 0.3, play={0x60FF: np.full(300, 300_000)})
        drives.advance(0.1)
        assert drives.read(0x6041)[0] & 0x6F != 0x27


def test_a_quick_stop_of_the_envelope_ends_at_standstill():
    with served("calls", load="inertia", safety=Limits(velocity=800_000)) as drives:
        motion.enable(drives, mode="cst")
        with pytest.raises(SafetyError, match="606Ch:00 Velocity actual value is 8"):
            drives.record([0x6064], 0.5, play={0x6071: np.full(500, 800)})
        drives.advance(0.5)
        assert abs(drives.read(0x606C)[0]) < 10_000
        assert drives.read(0x6041)[0] & 0x4F == 0x40  # switch on disabled: no weight is to be held


# --- stops --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_an_exception_stops_the_drives_and_goes_on(bus, error):
    with pytest.raises(error), enabled(bus):
        raise error
    assert sent_controlwords(bus) == [2, 0]  # quick stop, then voltage off


def test_closing_stops_what_is_enabled_and_only_that(bus):
    drives = enabled(bus)
    drives.close()
    assert sent_controlwords(bus) == [2, 0]
    drives = enabled(bus)
    motion.disable(drives)
    bus.log.clear()
    drives.close()
    assert sent_controlwords(bus) == []


def test_without_safety_nothing_is_refused_watched_or_stopped(bus, drive):
    with enabled(bus, limits=False) as drives:
        drives.write(0x6071, 32767)
        drive.motion = ramp(0x6077, 1000)
        drives.advance(0.03)
    assert sent_controlwords(bus) == []


def test_a_silent_axis_does_not_keep_the_others_from_being_stopped(caplog):
    nodes = [ScriptedDrive(node) for node in (1, 2)]
    with ScriptedBus(*nodes) as bus:
        drives = CanDrives(bus=bus, nodes=(1, 2), pace="lockstep", timeout=0.02)
        motion.enable(drives, mode="csv")
        nodes[0].silent.update(nodes[0].values)
        drives.close()
    assert nodes[1].get(0x6040) == 0
    assert "node 1 did not answer" in caplog.text


# --- the watchdogs -------------------------------------------------------------------------------------------------
def test_enabling_starts_heartbeats_that_the_drive_watches_and_closing_ends_both(bus, drive):
    drive.values[0x1029, 1] = (1, 1)  # a communication error would change nothing
    with CanDrives(bus=bus, safety=Limits(silence=0.06)) as drives:
        assert drive.get(0x1016, 1) == 0
        motion.enable(drives, mode="csv")
        own = drive.get(0x1016, 1) >> 16
        assert own in range(96, 128)
        assert drive.get(0x1016, 1) & 0xFFFF == 60
        assert drive.get(0x1029, 1) == 0
        motion.disable(drives)
        until(lambda: len(bus.sent(0x700 + own)) >= 8)
        beats = bus.sent(0x700 + own)
        assert set(beats) == {b"\x05"}
    assert (drive.get(0x1016, 1), drive.get(0x1029, 1)) == (0, 1)


def test_without_a_heartbeat_consumer_life_is_guarded(tmp_path, bus, drive):
    eds = find_device("tmcm1636").eds.read_text(encoding="utf-8")
    path = tmp_path / "old.eds"
    path.write_text(re.sub(r"(?ms)^\[1016.*?(?=^\[1017\])", "", eds), encoding="utf-8")
    drive.values |= {(0x100C, 0): (0, 2), (0x100D, 0): (0, 1)}
    with CanDrives(eds=path, bus=bus, safety=Limits(silence=0.06)) as drives:
        motion.enable(drives, mode="csv")
        assert (drive.get(0x100C), drive.get(0x100D)) == (20, 3)
        motion.disable(drives)
        until(lambda: sum(can_id == 0x701 and remote for can_id, _, remote in bus.log) >= 3)
        assert not any(0x760 <= can_id <= 0x77F for can_id, _, _ in bus.log)
    assert (drive.get(0x100C), drive.get(0x100D)) == (0, 0)


def test_a_drive_that_cannot_watch_is_not_moved_unless_the_user_wants_it(bus, drive, caplog):
    drive.refusals[0x1016, 1] = 0x06060000
    with CanDrives(bus=bus) as drives:
        with pytest.raises(SafetyError, match=r"node 1 cannot monitor its master: .*Limits\(silence=None\)"):
            motion.enable(drives, mode="csv")
        assert 15 not in sent_controlwords(bus)
    with CanDrives(bus=bus, safety=Limits(silence=None)) as drives:
        motion.enable(drives, mode="csv")
        motion.disable(drives)
    assert "no drive stops by itself when this process dies" in caplog.text


def test_a_stalled_program_is_quick_stopped_and_told_once(bus, drive):
    with CanDrives(bus=bus, safety=Limits(stall=0.5)) as drives:
        motion.enable(drives, mode="csv")
        until(lambda: sent_controlwords(bus)[-1] == 2)
        with pytest.raises(SafetyError, match=r"made no call for \d+\.\d+ s with an axis enabled; the limit is 0\.5 s"):
            drives.read(0x6041)
        assert drives.read(0x6041) == [0x0240]


def test_a_program_may_take_its_time_while_no_axis_is_enabled(bus):
    with CanDrives(bus=bus, safety=Limits(stall=0.5)) as drives:
        motion.enable(drives, mode="csv")
        motion.disable(drives)
        time.sleep(0.7)
        drives.read(0x6041)
        assert 2 not in sent_controlwords(bus)


def test_waiting_and_recording_is_no_stall(bus):
    with CanDrives(bus=bus, safety=Limits(stall=0.3)) as drives:
        motion.enable(drives, mode="csv")
        drives.advance(0.5)
        drives.record([0x6041], 0.5)
        assert 2 not in sent_controlwords(bus)


def test_a_bus_that_is_lost_is_told_once_until_it_is_back(caplog):
    error, tried = ["the bus did not take frame 77Fh"], [0]

    def turn():
        tried[0] += 1
        if error[0]:
            raise BusError(error[0])

    def told_after_more_turns():
        before = tried[0]
        until(lambda: tried[0] > before + 3)
        return [record.message for record in caplog.records]

    supervisor = Supervisor(turn, fail=lambda: None)
    first = error[0]
    supervisor.start()
    try:
        assert told_after_more_turns() == [first]
        error[0] = "the adapter is gone"
        assert told_after_more_turns() == [first, "the adapter is gone"]
        error[0] = ""
        told_after_more_turns()
        error[0] = "the adapter is gone"
        assert told_after_more_turns() == [first, "the adapter is gone", "the adapter is gone"]
    finally:
        supervisor.close()


def until(condition, patience=30.0):
    """Wait for what another thread or process does; a busy computer may take its time [s]."""
    end = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.005)


PROGRAM = """
import sys
from drive_env import CanDrives, motion
drives = CanDrives(channel=sys.argv[1])
motion.enable(drives, mode="pv")
drives.write("Target velocity", 1_000_000)
drives.advance(0.2)
print("running", flush=True)
while True:
    drives.advance(0.1)
"""


@pytest.mark.parametrize(
    "number",
    [pytest.param(signal.SIGINT, id="Ctrl-C", marks=pytest.mark.slow), pytest.param(signal.SIGKILL, id="kill -9")],
)
def test_a_program_that_ends_leaves_no_turning_axis(number):
    """Ctrl-C is stopped by the program on its way out, a killed one by the drive that misses its heartbeat."""
    world = World(lockstep=False)
    emulated = EmulatedDrives(load="inertia", num_threads=1)
    world.add(emulated, [1])
    hub = Hub()
    with Server(world, hub):
        program = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, hub.channel], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        try:
            assert program.stdout.readline() == "running\n"
            assert abs(emulated.read(0x606C)[0]) > 800_000
            program.send_signal(number)
            until(lambda: abs(emulated.read(0x606C)[0]) <= 30_000)
            program.wait(60.0)
            state = emulated.read(0x6041)[0]
            assert state & 0x6F != 0x27
            if number == signal.SIGKILL:
                assert state & 0x08  # fault, by the heartbeat's loss
        finally:
            program.kill()
            program.communicate()
    world.close()
