"""Disable operation is a ramp that no quick stop shortens: what it does to an axis that turns, by the drive's truth."""

from __future__ import annotations

import numpy as np
import pytest
from rigs.fault_injection import ANSWER, LIMITS, RADIANS, TURN, ObservedWorld, WorldBus, problems, run_lockstep

from drive_env import CanDrives, EmulatedDrives, SafetyError, motion
from drive_env.canopen.frames import Frame
from drive_env.dictionary.aborts import ObjectAccessError

FAST = 15 * TURN  # pps: 3 turns of travel are left in 0.2 s
GENTLE = 1 * TURN  # pps^2: 112 turns from that speed
REACTION = 0.03  # s
SLOW_DOWN = 0x6084


@pytest.fixture(scope="module")
def emulated():
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        yield drives


@pytest.fixture(autouse=True)
def as_commissioned(emulated):
    kept = {key: emulated.read(key) for key in (SLOW_DOWN, 0x605A)}
    yield
    for key, value in kept.items():
        emulated.write(key, value)


def turn(drives):
    motion.enable(drives, mode="csv")
    drives.write("Target velocity", FAST)
    drives.advance(0.1)


def disable_gently(drives):
    drives.write(SLOW_DOWN, GENTLE)
    turn(drives)
    drives.write(0x6040, 0x07)
    drives.advance(0.5)


def disable_in_rows(drives):
    drives.write(SLOW_DOWN, GENTLE)
    turn(drives)
    drives.record([0x6064], 0.5, play={0x6040: np.full(500, 0x07)})


@pytest.mark.parametrize("session", [disable_gently, disable_in_rows])
def test_an_axis_that_would_leave_its_travel_by_that_ramp_is_quick_stopped(emulated, session, caplog):
    truth, *_ = run_lockstep(emulated, session)
    assert not problems(truth, reaction=REACTION)
    assert np.abs(truth.omega()).max() > 0.9 * FAST * RADIANS
    assert "it would leave its limits, or turn for longer than 1 s: it is quick-stopped" in caplog.text


def test_a_ramp_that_ends_inside_is_the_programs_own(emulated, caplog):
    def session(drives):
        drives.write(SLOW_DOWN, 100 * TURN)  # 1.1 turns
        turn(drives)
        drives.write(0x6040, 0x07)
        drives.advance(0.1)
        slowed.append(int(drives.read(0x606C)[0]))
        drives.advance(0.2)
        states.append(int(drives.read(0x6041)[0]) & 0x6F)

    slowed, states = [], []
    truth, *_ = run_lockstep(emulated, session)
    assert not problems(truth, reaction=REACTION)
    assert slowed[0] == pytest.approx(5 * TURN, rel=0.1)  # 15 - 0.1 s * 100 turns/s^2
    assert states == [0x23]  # switched on: transition 5
    assert "quick-stopped" not in caplog.text


def test_that_ramp_is_not_made_longer_while_it_runs(emulated):
    def session(drives):
        drives.write(SLOW_DOWN, 100 * TURN)
        turn(drives)
        drives.write(0x6040, 0x07)
        with pytest.raises(SafetyError, match="is the ramp by which axis 0 is being disabled"):
            drives.write(SLOW_DOWN, GENTLE)
        drives.advance(0.3)
        drives.write(SLOW_DOWN, GENTLE)  # it is off
        done.append(True)

    done = []
    truth, *_ = run_lockstep(emulated, session)
    assert done and not problems(truth, reaction=REACTION)


def test_rows_that_enable_and_disable_by_such_a_ramp_are_refused(emulated):
    words = np.repeat([0x06, 0x07, 0x0F, 0x07], [5, 5, 100, 300])

    def session(drives):
        drives.write(SLOW_DOWN, GENTLE)
        motion.select_mode(drives, "csv")
        drives.record([0x6064], 0.41, play={0x6040: words, 0x60FF: np.full(410, FAST)})

    truth, _, ended = run_lockstep(emulated, session)
    assert isinstance(ended, SafetyError) and "that brakes less than a quick stop" in str(ended)
    assert not truth.current().any()


@pytest.mark.parametrize(("own", "meanwhile"), [(1, 2), (5, 6)])
def test_a_quick_stop_has_its_own_ramp_while_the_axis_is_ours(emulated, own, meanwhile):
    """605Ah = 1 and 5 ramp as profiles do: here by 1 turn/s^2, while the stopping distance is that of 6085h."""

    def session(drives):
        drives.write(0x605A, own)
        drives.write(SLOW_DOWN, GENTLE)
        turn(drives)
        options.append(int(emulated.read(0x605A)[0]))
        assert drives.read(0x605A)[0] == own  # the program's
        with pytest.raises(ObjectAccessError):
            drives.write(0x605A, 3)
        drives.write(0x605A, 6)  # which has that ramp itself
        options.append(int(emulated.read(0x605A)[0]))
        drives.write(0x605A, own)
        options.append(int(emulated.read(0x605A)[0]))
        drives.advance(0.3)  # towards the end of the travel

    options = []
    truth, _, ended = run_lockstep(emulated, session)
    assert isinstance(ended, SafetyError) and not problems(truth, reaction=REACTION)
    assert options == [meanwhile, 6, meanwhile]
    assert emulated.read(0x605A)[0] == own  # put back


def test_an_axis_that_another_master_enables_before_its_node_restarts_is_not_left(emulated):
    """No cycle passes, so that nobody saw it enabled; reset communication takes its watchdog and leaves it running."""
    emulated.machine.reset()
    world = ObservedWorld(emulated, lockstep=True)
    bus = WorldBus(world)
    with CanDrives(bus=bus, pace="lockstep", timeout=ANSWER, safety=LIMITS) as drives:
        motion.select_mode(drives, "pv")
        drives.write(0x6040, 0x06)
        drives.write(0x6040, 0x07)
        for can_id, data in ((0x601, bytes.fromhex("2B 40 60 00 0F 00 00 00")), (0x000, b"\x82\x00")):
            with world.lock:
                world.receive(Frame(can_id, data), "another master")
        with pytest.raises(SafetyError, match="has restarted by itself"):
            drives.read(0x6041)
            drives.read(0x6041)
    world.cycle()
    assert not world.truth.is_on()[0]
    bus.shutdown()
