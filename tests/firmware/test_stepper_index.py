"""The encoder's index: homing by it (CiA 402, methods 1, 2, 3, 5, 33, 34), its latch (TMCM-3313 manual, 200Fh).

The disc's index begins at a true angle of the rotor and is one count wide, so home is known in closed form: where the
steps were when the rotor came to that angle.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from rigs.stepper_rig import SMOOTH, build, lane

from drive_env import motion
from drive_env.firmware.record import set_lanes
from drive_env.motors import MOTORS

MOTOR = MOTORS["qsh4218_51"]
DAMPED = SMOOTH | {"motor.viscous": MOTOR.viscous}
TURN = 51_200  # microsteps
COUNT = 2.0 * math.pi / MOTOR.encoder_counts  # rad
REACHED, ATTAINED = 0x0400, 0x1000
FAST, SLOW = 60_000, 25_000
# The rotor is behind the steps by what friction takes, and the axis comes to rest a period's step away at most.
LAG = 2.0 * math.pi / TURN * 8.0


def homed(drives, method, seconds=5.0):
    """Home, and return the statusword."""
    drives.write(0x6098, method)
    drives.write((0x6099, 1), FAST)
    drives.write((0x6099, 2), SLOW)
    drives.write(0x609A, 1_000_000)
    motion.enable(drives, mode="hm")
    drives.write(0x6040, 0x1F)
    drives.advance(seconds)
    return drives.read(0x6041)


def true_zero(drives):
    """Return the rotor's angle at position 0 [rad]."""
    return drives.machine.rotor_angle - drives.read(0x6064) * 2.0 * math.pi / TURN


@pytest.mark.parametrize(("method", "way"), [(33, -1.0), (34, 1.0)])
def test_the_next_index_in_a_direction_is_home(method, way):
    angles = np.array([0.3, 1.7, 3.14, 5.9])
    with build(num_machines=4, parameters=DAMPED) as drives:
        drives.write(0x2005, 3)
        drives.machine.set("motor.index_angle", angles)
        word = homed(drives, method)
        np.testing.assert_array_equal(word & (REACHED | ATTAINED), REACHED | ATTAINED)
        # Leftwards N is seen as its second edge is passed.
        edge = np.floor(angles / COUNT) * COUNT + (COUNT if way < 0.0 else 0.0)
        home = edge if way > 0.0 else edge - 2.0 * math.pi
        np.testing.assert_allclose(true_zero(drives), home, rtol=0, atol=LAG)
        np.testing.assert_allclose(drives.machine.rotor_angle, home, rtol=0, atol=LAG)
        assert drives.read(0x6062).tolist() == [0] * 4


def test_home_offset_is_the_position_of_zero_as_seen_from_the_index():
    with build(parameters=DAMPED) as drives:
        drives.write(0x2005, 3)
        drives.write(0x607C, 1_000)
        drives.machine.set("motor.index_angle", 2.0)
        homed(drives, 34)
        assert drives.read(0x6062)[0] == -1_000
        assert drives.machine.rotor_angle[0] == pytest.approx(2.0, abs=LAG + COUNT)


@pytest.mark.every(9)
@pytest.mark.parametrize(
    ("method", "switch", "edge", "way"),
    [
        (1, 0, -2.0, 1.0),  # left limit switch pressed from -2 rad down; the index to the right of it
        (2, 1, 2.5, -1.0),
        (3, 2, 2.5, -1.0),  # home switch pressed from 2.5 rad up; the index to the left of it
        (5, 2, -2.0, 1.0),
    ],
)
@pytest.mark.parametrize("index", [0.4, 2.6, 4.5])
def test_from_a_switch_the_next_index_on_the_side_where_it_is_released_is_home(method, switch, edge, way, index):
    with build(parameters=DAMPED) as drives:
        drives.write(0x2005, 0)
        low, high = (edge, np.inf) if way < 0.0 else (-np.inf, edge)
        for k in range(3):
            set_lanes(drives.inside.records, "switch_low", np.array([low if k == switch else np.inf]), part=k)
            set_lanes(drives.inside.records, "switch_high", np.array([high if k == switch else np.inf]), part=k)
        set_lanes(drives.inside.records, "wired", np.array([7]))
        drives.machine.set("motor.index_angle", index)
        word = homed(drives, method, 8.0)
        assert word[0] & (REACHED | ATTAINED) == REACHED | ATTAINED
        home = index - 2.0 * math.pi * 3
        while way * (home - edge) < 0.0 if way > 0.0 else home + 2.0 * math.pi < edge:
            home += 2.0 * math.pi
        assert true_zero(drives)[0] == pytest.approx(home, abs=LAG + COUNT)
        assert drives.machine.rotor_angle[0] == pytest.approx(home, abs=LAG + COUNT)


def test_a_search_for_the_index_that_is_taken_back_stops():
    with build(parameters=DAMPED) as drives:
        drives.write(0x2005, 3)
        drives.machine.set("motor.index_angle", 6.0)
        homed(drives, 34, 0.3)
        drives.write(0x6040, 0x0F)
        drives.advance(0.3)
        stands = drives.machine.rotor_angle[0]
        assert 0.3 < stands < 5.0
        drives.advance(0.5)
        assert drives.machine.rotor_angle[0] == pytest.approx(stands, abs=1e-3)
        assert drives.read(0x6041)[0] & (REACHED | ATTAINED) == REACHED


@pytest.mark.parametrize("method", [1, 33])
def test_an_axis_whose_index_does_not_come_gives_up_after_a_turn(method):
    with build(parameters=DAMPED) as drives:
        drives.write(0x2005, 3 if method == 33 else 2)
        set_lanes(drives.inside.records, "wired", np.array([7]))
        set_lanes(drives.inside.records, "switch_low", np.array([-np.inf]), part=0)
        set_lanes(drives.inside.records, "switch_high", np.array([-1.0]), part=0)
        drives.machine.set("motor.encoder_broken", 1.0)
        word = homed(drives, method, 5.0)
        assert word[0] & (REACHED | ATTAINED) == REACHED
        start = -1.0 if method == 1 else 0.0
        way = abs(drives.machine.rotor_angle[0] - start) / (2.0 * math.pi)
        assert 1.05 <= way < 1.07


def turn(drives, target):
    drives.write(0x607A, target)
    drives.write(0x6040, 0x0F)
    drives.write(0x6040, 0x1F)
    drives.advance(1.5)


def latched(drives):
    """Return 200Fh: armed, position by the steps, position by the encoder."""
    return [int(drives.read((0x200F, sub))[0]) for sub in (1, 2, 3)]


@pytest.mark.parametrize("speed", [2_000, 100_000])
def test_the_latch_takes_both_positions_at_the_next_index_and_disarms(speed):
    """At any speed: a window of 200 us is 20 counts at the fast one. Edge 6,000 of 40,000 is at 7,680 microsteps."""
    with build(parameters=DAMPED) as drives:
        drives.write(0x6081, speed)
        drives.write(0x6083, 10**7)
        drives.write(0x6084, 10**7)
        drives.machine.set("motor.index_angle", 6_000.5 * COUNT)
        motion.enable(drives, mode="pp")
        turn(drives, 3_000)
        turn(drives, 5_000)
        assert latched(drives) == [0, 0, 0]
        drives.write((0x200F, 1), 1)
        drives.advance(0.1)
        assert latched(drives) == [1, 0, 0]
        for target in (6_500, 7_600, 9_000):
            turn(drives, target)
        armed, steps, encoder = latched(drives)
        assert armed == 0
        assert encoder == 7_680
        assert steps == pytest.approx(7_680, abs=20 if speed < 10_000 else 300)  # the rotor lags, and is seen lagging
        turn(drives, 0)
        assert latched(drives) == [armed, steps, encoder]  # not armed


def test_both_positions_are_latched_as_they_were_at_the_same_moment():
    """At an even speed the rotor lags by a constant angle, also at the index, wherever in a window of 200 us it comes.

    In a window the steps go on by 20; the encoder resolves 1.28.
    """
    with build(num_machines=4, parameters=DAMPED) as drives:
        drives.machine.set("motor.index_angle", np.array([1_000.5, 1_004.5, 1_009.5, 1_013.5]) * COUNT)
        motion.enable(drives, mode="pv")
        drives.write(0x6083, 10**6)
        drives.write(0x60FF, 100_000)
        drives.advance(1.5)
        drives.write((0x200F, 1), 1)
        lags = []
        for _ in range(600):
            drives.advance(0.001)
            lags.append((lane(drives, "step_position") - lane(drives, "theta_m")) * TURN / (2.0 * math.pi))
        assert drives.read((0x200F, 1)).tolist() == [0] * 4
        latched_lag = drives.read((0x200F, 2)) - drives.read((0x200F, 3))
        np.testing.assert_allclose(latched_lag, np.mean(lags, axis=0), rtol=0, atol=3)


@pytest.mark.parametrize(("polarity", "inverted"), [(0, 0), (1, 1), (0, 1), (1, 0)])
def test_the_wrong_polarity_of_n_latches_beside_the_index_and_on_another_count_from_each_side(polarity, inverted):
    """Right: from both sides the counter stands at count 6,000. Wrong: the end of the pulse is taken for its begin."""
    with build(parameters=DAMPED) as drives:
        drives.write((0x200B, 1), polarity)
        drives.write(0x606A, 0)
        drives.machine.set("motor.index_angle", 6_000.5 * COUNT)
        drives.machine.set("motor.index_inverted", float(inverted))
        motion.enable(drives, mode="pp")
        found = []
        for target in (12_000, 0):
            drives.write((0x200F, 1), 1)
            turn(drives, target)
            found.append(latched(drives)[2] / TURN * MOTOR.encoder_counts)
        expected = [6_000.0, 6_000.0] if polarity == inverted else [6_001.0, 5_999.0]
        np.testing.assert_allclose(found, expected, rtol=0, atol=0.5)


def test_lost_counts_show_at_the_index():
    """The index is at a true angle, so each turn's latch tells how many counts were lost in it."""
    with build(parameters=DAMPED) as drives:
        drives.machine.set("motor.index_angle", 1.0)
        motion.enable(drives, mode="pp")
        drives.write(0x6081, 40_000)
        drives.machine.fault("encoder_lost_counts", share=0.01)
        found = []
        for target in (TURN // 2, TURN * 3 // 2):
            drives.write((0x200F, 1), 1)
            turn(drives, target)
            drives.advance(1.0)
            found.append(latched(drives)[2])
        assert found[1] - found[0] == pytest.approx(0.99 * TURN, abs=3)


@pytest.mark.parametrize("takes", [0, 1])
def test_an_axis_turned_without_current_has_the_encoders_position_if_200bh_says_so(takes):
    with build(parameters=DAMPED) as drives:
        drives.write(0x606A, 0)
        drives.write((0x200B, 3), takes)
        motion.enable(drives, mode="pp")
        turn(drives, 4_096)  # a whole electrical period: the field stands at the table's beginning
        motion.disable(drives)
        drives.machine.load_torque = 0.02
        drives.advance(0.5)
        drives.machine.load_torque = 0.0
        drives.advance(1.0)
        moved = drives.machine.rotor_angle[0] * TURN / (2.0 * math.pi)
        assert moved > 6_000
        assert drives.read(0x6062)[0] == pytest.approx(moved if takes else 4_096, abs=2)
        motion.enable(drives, mode="pp")
        drives.advance(0.3)
        # The rotor swings to the field, which stands where it stood: a period is four full steps of 256.
        assert drives.read(0x6064)[0] == pytest.approx(moved, abs=512 + 64)
        assert abs(drives.read(0x6062)[0] - drives.read(0x6064)[0]) < (512 + 64 if takes else math.inf)
