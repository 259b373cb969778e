"""pv of stepper drives: which ramp slows down, where it begins and ends, in closed form.

TMCM-3313 manual, 7.1.10 and 7.1.14: 6083h speeds up, 6084h slows down; a halt slows down as the mode does.
TMCM-6212 manual, 1.5: a trapezoid of 6083h, 60FFh, start speed 2010h and stop speed 6082h; 6084h is not used.
"""

from __future__ import annotations

import numpy as np
import pytest

from drive_env import EmulatedDrives, cia402, motion

TURN = 51_200  # microsteps
CYCLE = 0.001  # s
GRAIN = 1_500  # pps: a step more or less of 6062h in a cycle is 1,000
FAST = 2 * TURN  # pps
UP = 10 * TURN  # pps^2
HALT = 0x010F


def drives_of(device, count):
    return EmulatedDrives(device, "inertia", "qsh4218_51", num_machines=count, num_threads=1, distinct=1)


def demand(drives, cycles):
    """Let time pass, and return the speed demand of each cycle [pps]: the change of 6062h."""
    before = drives.read(cia402.POSITION_DEMAND)
    places = drives.record([cia402.POSITION_DEMAND], cycles * CYCLE)[cia402.POSITION_DEMAND]
    return np.diff(np.vstack([before, places]), axis=0) / CYCLE


def turn(drives, speed):
    motion.enable(drives, mode="pv")
    drives.write(cia402.PROFILE_ACCELERATION, UP)
    drives.write(cia402.TARGET_VELOCITY, speed)


@pytest.mark.parametrize("how", ["stop", "halt", "slower", "reverse"])
def test_6084h_slows_the_tmcm3313_down_and_6083h_speeds_it_up(how):
    down = np.array([10, 100, 2, 0]) * TURN  # 0: 6083h both ways
    with drives_of("tmcm3313", 4) as drives:
        drives.write(cia402.PROFILE_DECELERATION, down)
        turn(drives, FAST)
        rise = demand(drives, 300)
        np.testing.assert_allclose(np.count_nonzero(rise < FAST - GRAIN, axis=0), FAST / UP / CYCLE, atol=5)
        end = {"stop": 0, "halt": 0, "slower": FAST // 2, "reverse": -FAST // 2}[how]
        if how == "halt":
            drives.write(cia402.CONTROLWORD, HALT)
        else:
            drives.write(cia402.TARGET_VELOCITY, end)
        fall = demand(drives, 1_300)
        rate = np.where(down > 0, down, UP)
        slowing = (FAST - max(end, 0)) / rate
        taken = np.count_nonzero(fall > max(end, 0) + GRAIN, axis=0) * CYCLE
        np.testing.assert_allclose(taken, slowing - GRAIN / rate, atol=0.005)
        if end < 0:
            speeding = np.count_nonzero((fall < -GRAIN) & (fall > end + GRAIN), axis=0)
            np.testing.assert_allclose(speeding, (-end - 2 * GRAIN) / UP / CYCLE, atol=5)
        np.testing.assert_allclose(fall[-1], end, atol=GRAIN)


def test_start_and_stop_speed_of_the_tmcm6212_are_jumped_to_and_from_and_6084h_is_not_used():
    start, stop = np.array([0, 20_000, 0, 200_000]), np.array([0, 0, 30_000, 30_000])
    with drives_of("tmcm6212", 4) as drives:
        drives.write(cia402.PROFILE_DECELERATION, [TURN, 100 * TURN, TURN, 0])
        drives.write(0x2010, start)
        drives.write(0x6082, stop)
        turn(drives, FAST)
        rise = demand(drives, 300)
        first = np.minimum(start, FAST)
        np.testing.assert_allclose(rise[1], np.minimum(first + UP * 1.5 * CYCLE, FAST), atol=GRAIN)
        took = np.count_nonzero(rise < FAST - GRAIN, axis=0)
        np.testing.assert_allclose(took, (FAST - first) / UP / CYCLE, atol=5)
        drives.write(cia402.TARGET_VELOCITY, 0)
        fall = demand(drives, 300)
        np.testing.assert_allclose(np.count_nonzero(fall > GRAIN, axis=0), (FAST - stop) / UP / CYCLE, atol=5)
        assert (np.where(fall > GRAIN, fall, np.inf).min(axis=0) >= stop / 2 - GRAIN).all(), "it jumps, in a period"
        assert not fall[-1].any()


def test_a_jump_to_the_start_speed_turns_the_motor_the_other_way_too():
    with drives_of("tmcm6212", 1) as drives:
        drives.write(0x2010, 20_000)
        drives.write(0x6082, 10_000)
        turn(drives, 40_000)
        demand(drives, 200)
        drives.write(cia402.TARGET_VELOCITY, -40_000)
        speed = demand(drives, 200)[:, 0]
        through = speed[(speed > -20_000 + GRAIN) & (speed < 10_000 - GRAIN)]
        assert len(through) <= 2, "neither is crept through"
        assert speed[-1] == pytest.approx(-40_000, abs=GRAIN)
