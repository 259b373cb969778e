"""A trial without a machine: its cost, the momentum balance, and what is done when an axis must be stopped."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from drive_env import cia402
from drive_env.devices import find_device
from drive_env.drives.interface import CYCLE
from drive_env.motors import MOTORS, find_motor
from drive_env.trials import gain_trial
from drive_env.trials.gain_trial import (
    PHASE_TITLES,
    PHASES,
    Trial,
    Trials,
    clear,
    measured_cost,
    momentum_balance,
    samples_in_motion,
    softness,
)
from drive_env.trials.oscillation import shakes
from drive_env.trials.positioning import (
    PROFILE,
    QUIET,
    SETTLED,
    TRIAL,
    WATCH,
    highest_ramp,
    longer_way,
    plan_move,
    power_up,
    resting_swing,
    start,
    swing,
    write_profile,
)
from drive_env.trials.score import Terms, cost

DEVICE, MOTOR = find_device("tmcm1636"), find_motor("qbl4208")
ENABLED, FAULT = 0x0637, 0x0238
PROBE, RECOVERY, OSCILLATION = 1.5, 5, 0.4  # of velocity P; attempts; of the rated current
NAMES = DEVICE.gains.names
POSITION, DEMAND, CURRENT, STATUS = (
    cia402.POSITION_ACTUAL, cia402.POSITION_DEMAND, cia402.TORQUE_ACTUAL, cia402.STATUSWORD
)  # fmt: skip
GAINS = np.array([[1000, 200, 800, 100, 50]] * 4)
SAFE = np.array([[900, 200, 300, 40, 20]] * 4)


# --- moves ---
def test_a_trial_takes_250_ms_and_its_move_60_whatever_it_turns():
    """It has settled by 150 ms, when the load comes; the ripple is that of its last 45 ms; watched every 25 ms."""
    assert (CYCLE, PROFILE, QUIET, SETTLED, TRIAL, WATCH) == (0.001, 60, 105, 150, 250, 25)
    assert PHASES == ("move", "reversal", "probe")
    assert PHASE_TITLES == ("move", "reversal", "move with 1.5 times velocity P")


def test_the_least_error_of_a_load_step_is_half_a_count_all_the_time():
    """From 150 ms, when the load comes, to the end of the trial at 250 ms; 65,536 counts are a turn."""
    move = plan_move(MOTOR, np.array([1e-5]), np.array([65536]), np.array([10.0]))
    counts_of_a_turn = 2.0 * np.pi * move.counts
    assert counts_of_a_turn == pytest.approx(MOTOR.encoder_counts)
    assert move.least_error == pytest.approx(0.5 * 2.0 * np.pi / MOTOR.encoder_counts * 0.1)


@pytest.mark.parametrize(("low", "high", "way"), [
    (-1.0, 2.0, 2.0), (-2.0, 1.0, -2.0),
    (-1.0, 1.0, 1.0), (-1.1, 1.0, 1.0), (-1.2, 1.0, -1.2),  # about as long: forwards, as all axes of a machine go then
    (-np.inf, np.inf, np.inf), (-1.0, np.inf, np.inf), (-np.inf, 1.0, -np.inf), (0.0, 1.0, 1.0), (-1.0, 0.0, -1.0),
])  # fmt: skip
def test_the_longer_way_is_forwards_where_both_are_about_as_long(low, high, way):
    assert longer_way(low, high) == way


# --- cost -------------------------------------------------------------------------------------------------------------
def test_softness_is_one_over_the_product_of_the_gains_that_give_way_to_a_load():
    """i T_i / (P k_v): P, 1 / T_i and k_v are raw integers, and the current loop has no part in it."""
    assert NAMES == ("torque_p", "torque_i", "velocity_p", "velocity_i", "position_p")
    np.testing.assert_allclose(softness(DEVICE.gains, GAINS[:1]), 1.0 / (800 * 100 * 50))
    large = np.array([[1, 1, 32767, 32767, 32767]])  # beyond 32 bits
    np.testing.assert_allclose(softness(DEVICE.gains, large), 32767.0**-3)


def test_a_trial_costs_half_the_mean_of_its_moves_and_half_the_worst_of_all():
    assert measured_cost(np.array([[2.0, 6.0], [4.0, 2.0], [9.0, 3.0]])).tolist() == [1.5 + 4.5, 2.0 + 3.0]


def test_the_disturbance_of_a_trial_is_its_softness_less_in_the_probe():
    one = np.ones((3, 2))
    terms = Terms(2.0 * one, one, 0.0 * one, 0.0 * one, one > 2.0)
    aborted = np.array([[False, False], [False, True], [False, True]])
    found = Trial(terms, one, aborted, one, aborted[0]).costs(np.array([4.0, 1.0]))
    np.testing.assert_allclose(found[:, 0], 2.0**0.4 * np.array([4.0, 4.0, 4.0 / PROBE]) ** 0.4)
    np.testing.assert_allclose(found[:, 1], [2.0**0.4, 30.0, 30.0])


@pytest.mark.parametrize(("settling", "noise", "overshoot", "tripped", "J"), [
    (1.0, 0.0, 0.0, False, 1.0), (1.0, 0.0, 0.02, False, 1.0), (1.0, 0.0, 0.12, False, 2.0),
    (1.0, 0.03, 0.0, False, 2.0**0.2), (32.0, 0.0, 0.0, False, 4.0), (1e9, 0.0, 0.0, False, 30.0 - 225.0 / 1e9**0.4),
    (np.nan, 0.0, 0.0, False, 30.0), (np.inf, 0.0, 0.0, False, 30.0), (1.0, 0.0, 0.0, True, 30.0),
])  # fmt: skip
def test_cost_of_one_term_at_a_time(settling, noise, overshoot, tripped, J):
    values = [np.array([x]) for x in (settling, 1.0, noise, overshoot, tripped)]
    np.testing.assert_allclose(cost(Terms(*values)), J)


@pytest.mark.parametrize(("change", "oscillates"), [(0.99, False), (1.01, True)])
def test_an_axis_oscillates_above_two_fifths_of_the_rated_current_from_millisecond_to_millisecond(change, oscillates):
    current = np.zeros((25, 2))
    current[1::2, 1] = change * OSCILLATION * MOTOR.rated_current
    assert shakes(current, MOTOR.rated_current).tolist() == [False, oscillates]


def test_a_swing_is_the_largest_of_any_window_of_25_ms_and_each_axis_has_its_own():
    current = np.zeros((4 * WATCH, 2))
    current[1:WATCH:2, 0] = 0.5  # every change is 0.5 A
    current[WATCH + 5, 0] = 2.0  # two changes of 2 A among 24
    current[3 * WATCH :, 1] = 7.0  # a jump between two windows is in neither
    np.testing.assert_allclose(swing(current, 2.0), [max(0.25, np.sqrt(2 * 4.0 / 24) / 2.0), 0.0])


def test_a_swing_at_rest_is_about_its_trend_after_the_first_105_ms():
    current = np.zeros((SETTLED, 3))
    current[:QUIET] = 9.0  # the move
    late = np.arange(SETTLED - QUIET) - (SETTLED - QUIET - 1) / 2.0
    wave = 0.4 * np.cos(2.0 * np.pi * late / 15.0)
    current[QUIET:SETTLED] = np.stack(
        [5.0 + wave, wave - 0.03 * late, 5.0 + 0.03 * late], axis=1
    )  # the last one creeps
    rms = 0.4 / np.sqrt(2.0) / 2.0
    np.testing.assert_allclose(resting_swing(current, 2.0), [rms, rms, 0.0], atol=1e-12)


def test_a_longer_rest_has_a_trend_in_each_tenth_of_a_second():
    """An integrator that brings an axis slowly to the next count and back is no swing."""
    saw = np.tile(np.concatenate([np.arange(100.0), np.arange(100.0)[::-1]]), 2)[:, None]
    current = np.concatenate([np.zeros((QUIET, 1)), saw])
    np.testing.assert_allclose(resting_swing(current, 2.0), 0.0, atol=1e-12)
    assert resting_swing(np.concatenate([current[:QUIET], saw[50:350]]), 2.0) > 3.0, "the turn of it within a window is"


# --- identification -------------------------------------------------------------------------------------------------
def there_and_back(share=1.0):
    """Angle and speed of a smooth move and back, of a speed that has its peak at 40 rad/s."""
    t = np.arange(TRIAL)
    speed = 40.0 * np.sin(np.pi * np.minimum(t / 60.0, 1.0)) ** 2 * share
    speed = np.concatenate([speed, -speed])[:, None]
    return np.cumsum(0.5 * (speed + np.roll(speed, 1, axis=0)), axis=0) * CYCLE, speed


@pytest.mark.parametrize("offset", [0.3, -0.3, 0.0])
def test_what_a_machine_takes_is_found_from_its_own_signals(offset):
    """i = J alpha / K_t + coulomb sign(omega) + viscous omega + offset: the fit gets back what made the current."""
    angle, speed = there_and_back()
    J, coulomb, viscous = 4.0 * MOTOR.inertia, 0.5, 0.01
    acceleration = np.gradient(speed, CYCLE, axis=0)
    current = J / MOTOR.torque_constant * acceleration + coulomb * np.clip(speed, -1, 1) + viscous * speed + offset
    found = momentum_balance(angle, speed, current, MOTOR)
    np.testing.assert_allclose(found.inertia, J, rtol=0.01)
    np.testing.assert_allclose([found.coulomb[0], found.viscous[0]], [coulomb, viscous], rtol=0.02)
    np.testing.assert_allclose(found.offset, offset, atol=0.01)


def test_the_lag_of_a_filtered_speed_is_not_taken_for_friction_of_an_axis_that_swings():
    t = np.arange(2 * TRIAL)[:, None] * CYCLE
    speed = 40.0 * np.exp(-3.0 * t) * np.cos(26.0 * t)
    angle = np.cumsum(0.5 * (speed + np.roll(speed, 1, axis=0)), axis=0) * CYCLE
    J, coulomb, viscous = 16.0 * MOTOR.inertia, 0.2, 0.01
    acceleration = np.gradient(speed, CYCLE, axis=0)
    current = J / MOTOR.torque_constant * acceleration + coulomb * np.clip(speed, -1, 1) + viscous * speed
    late = np.roll(speed, 2, axis=0)
    late[:2] = speed[0]
    found = momentum_balance(angle, late, current, MOTOR)
    np.testing.assert_allclose([found.coulomb[0], found.viscous[0]], [coulomb, viscous], rtol=0.1)


def test_an_axis_that_did_not_move_has_its_rotors_inertia_and_no_friction_below_zero():
    still = np.zeros((2 * TRIAL, 1))
    found = momentum_balance(still, still, still, MOTOR)
    assert (found.inertia, found.coulomb, found.viscous, found.offset) == (0.8 * MOTOR.inertia, 0.0, 0.0, 0.0)
    angle, speed = there_and_back()
    found = momentum_balance(angle, speed, -0.5 * np.clip(speed, -1, 1) - 0.01 * speed, MOTOR)
    assert (found.coulomb, found.viscous) == (0.0, 0.0)
    huge = np.diff(speed, axis=0, prepend=0.0) / CYCLE * 1e3 * MOTOR.inertia / MOTOR.torque_constant
    assert momentum_balance(angle, speed, huge, MOTOR).inertia == 300.0 * MOTOR.inertia


class Moving:
    """Two axes that stand at 1,000 and -500; what they answer in each record is a parabola, and their current."""

    num_axes, device, time_waits = 2, DEVICE, True

    def __init__(self):
        self.targets, self.profile = [], None

    def read(self, name):
        return np.array([1000, -500]) if name == POSITION else np.array([65_536, 32_768])

    def record(self, objects, seconds):
        t = np.arange(round(seconds / CYCLE))[:, None]
        sign = 1 if len(self.targets) == 1 else -1
        way = t**2 * [1.0, -2.0]
        rows = {POSITION: [1000, -500] + (way if sign == 1 else way[-1] - way), cia402.VELOCITY_ACTUAL: sign * 2.0 * t,
                CURRENT: sign * t * [1.0, 3.0]}  # fmt: skip
        return {name: rows[name] for name in objects}


@pytest.mark.parametrize(("scale", "ratio"), [(1.0, 1.0), (2.0, 0.5)])
def test_identification_moves_three_rotors_there_and_back_from_where_the_axes_stand(scale, ratio, monkeypatch):
    drives, balanced = Moving(), []
    monkeypatch.setattr(gain_trial, "device_of", lambda drives: DEVICE)
    monkeypatch.setattr(gain_trial, "ampere_per_count", lambda drives: 1e-3)
    monkeypatch.setattr(gain_trial, "STANDSTILL", 2e-3)  # these turn slowly
    monkeypatch.setattr(gain_trial, "per_increment", lambda drives, name: scale)
    monkeypatch.setattr(gain_trial, "write_profile", lambda drives, move, where: setattr(drives, "profile", move))
    monkeypatch.setattr(gain_trial, "start", lambda drives, target, where: drives.targets.append(target.tolist()))
    monkeypatch.setattr(gain_trial, "momentum_balance",
                        lambda *arguments, moving: balanced.append((*arguments, moving)) or "found")  # fmt: skip
    reach, where = np.array([50.0, -0.5]), np.array([True, True])
    assert Trials(drives, MOTOR, 1, 0.004).identify(reach, where)[0] == "found"
    move = plan_move(MOTOR, np.full(2, 3.0 * MOTOR.inertia), np.array([65_536, 32_768]), reach)
    assert drives.profile.distance.tolist() == move.distance.tolist()
    assert drives.targets == [(np.array([1000, -500]) + move.distance).tolist(), [1000, -500]]
    ((angle, speed, current, motor, moving),) = balanced
    turn = 2.0 * np.pi
    np.testing.assert_allclose(angle[100], [1e4 / 65_536 * turn, -2e4 / 32_768 * turn])
    np.testing.assert_allclose(speed[100], ratio * 200.0 * turn / np.array([65_536, 32_768]))
    np.testing.assert_allclose(current[[100, TRIAL + 100]], [[0.1, 0.3], [-0.1, -0.3]])
    assert motor is MOTOR and len(angle) == 2 * TRIAL and angle[-1].tolist() == [0.0, 0.0]
    np.testing.assert_array_equal(moving, samples_in_motion(speed, 3))
    assert not np.array_equal(moving, samples_in_motion(speed, 2)) and not moving[0].any() and moving[-1].all()


def test_what_dry_friction_holds_at_rest_is_no_part_of_the_motion():
    """An integrator leaves it the current that the move ended with, up to its own: taken for a load it was 1.4 J."""
    angle, speed = there_and_back()
    J, coulomb = 4.0 * MOTOR.inertia, 0.5
    acceleration = np.gradient(speed, CYCLE, axis=0)
    current = J / MOTOR.torque_constant * acceleration + coulomb * np.clip(speed, -1, 1)
    current[100:TRIAL] -= 0.3
    current[TRIAL + 100 :] += 0.25
    held = momentum_balance(angle, speed, current, MOTOR, moving=samples_in_motion(speed, 3))
    np.testing.assert_allclose([held.inertia[0] / J, 1.0 + held.offset[0]], 1.0, atol=0.02)
    assert held.coulomb[0] == pytest.approx(coulomb, rel=0.06)
    assert abs(momentum_balance(angle, speed, current, MOTOR).inertia[0] / J - 1.0) > 0.1, "which it is without"


def test_a_rotor_is_in_motion_from_some_samples_before_it_turns_until_some_after():
    speed = np.zeros((60, 2))
    speed[20, 0], speed[30:41, 1] = -1.1, 1.0
    moving = samples_in_motion(speed, 10)
    assert np.flatnonzero(moving[:, 0]).tolist() == list(range(10, 31)) and not moving[:, 1].any()
    assert np.flatnonzero(samples_in_motion(speed, 0)[:, 0]).tolist() == [20]


# --- trials -----------------------------------------------------------------------------------------------------------
class Played:
    """Drives in pp that play what a test has for them: `faults` and `shaking` are (phase, window) -> axes."""

    time_waits, bus = True, None

    def __init__(self, axes=4, faults=None, shaking=None, stays_down=False):
        self.num_axes, self.device = axes, DEVICE
        self.faults, self.shaking, self.stays_down = faults or {}, shaking or {}, stays_down
        self.status = np.full(axes, ENABLED)
        self.target = np.zeros(axes, np.int64)
        self.gains = np.zeros((axes, len(NAMES)), np.int64)
        self.words, self.recorded, self.advanced = [], [], 0.0
        self.phase, self.window = -1, 0

    def read(self, name):
        return self.status.copy() if name == STATUS else np.zeros(self.num_axes, np.int64)

    def write(self, name, value, *, where=None):
        mask = np.ones(self.num_axes, bool) if where is None else where
        values = np.broadcast_to(np.asarray(value, np.int64), (self.num_axes,))
        keys = [key if isinstance(key, tuple) else (key, 0) for key in DEVICE.gains.keys]
        if name in keys:
            self.gains[mask, keys.index(name)] = values[mask]
        elif name == cia402.TARGET_POSITION:
            self.target = np.where(mask, values, self.target)
        elif name == cia402.CONTROLWORD:
            self.words.append((int(values[0]), np.flatnonzero(mask).tolist()))
            if (
                values[0] == cia402.ENABLE_OPERATION | cia402.NEW_SET_POINT and mask.sum() > 1
            ):  # not an axis alone that goes on
                self.phase, self.window = self.phase + 1, 0
            if values[0] == cia402.ENABLE_OPERATION and not self.stays_down:
                self.status = np.where(mask, ENABLED, self.status)

    def record(self, objects, seconds):
        cycles = round(seconds / CYCLE)
        self.recorded.append((self.phase, self.gains.copy()))
        down = self.faults.get((self.phase, self.window), [])
        self.status[down] = FAULT
        current = np.zeros((cycles, self.num_axes), np.int64)
        for axis in self.shaking.get((self.phase, self.window), []):
            current[::2, axis] = 10_000
        self.window += 1
        rows = np.tile(self.target, (cycles, 1))
        status = np.tile(self.status, (cycles, 1))
        return {POSITION: rows, DEMAND: rows, CURRENT: current, STATUS: status}

    def advance(self, seconds):
        self.advanced += seconds


@pytest.fixture
def trials(monkeypatch):
    monkeypatch.setattr(gain_trial, "device_of", lambda drives: DEVICE)
    monkeypatch.setattr(gain_trial, "ampere_per_count", lambda drives: 1e-3)
    monkeypatch.setattr("drive_env.drives.raw_gains.device_of", lambda drives: DEVICE)
    monkeypatch.setattr("drive_env.trials.positioning.per_increment", lambda drives, name: 1.0)
    return lambda drives, axes=2: Trials(drives, MOTOR, axes, 0.004)


MOVE = plan_move(MOTOR, np.full(4, 3.0 * MOTOR.inertia), np.full(4, 65536), np.full(4, 100.0))


def run(trials, drives, where=None, direction=1):
    return trials(drives).run(
        GAINS, SAFE, MOVE, np.full(4, 500), np.full(4, direction), np.ones(4, bool) if where is None else where
    )


@pytest.mark.parametrize("direction", [1, -1])
def test_a_trial_moves_there_back_and_there_again_with_more_velocity_p(trials, direction):
    drives = Played()
    targets = []
    record = drives.record
    drives.record = lambda *arguments: targets.append(drives.target.copy()) or record(*arguments)
    found = run(trials, drives, direction=direction)
    away = 500 + direction * MOVE.distance
    assert [t.tolist() for t in targets[:: TRIAL // WATCH]] == [away.tolist(), [500] * 4, away.tolist()]
    used = [gains[0].tolist() for _, gains in drives.recorded[:: TRIAL // WATCH]]
    assert used == [GAINS[0].tolist(), GAINS[0].tolist(), [1000, 200, 1200, 100, 50]]
    assert not found.aborted.any() and not found.culprit.any()
    assert found.error.shape == (TRIAL, 4) and not found.error.any()
    np.testing.assert_allclose(found.following, 0.5 * CYCLE)  # half a count for one cycle is the least there is to see
    np.testing.assert_allclose(found.terms.settling, 1.0)
    np.testing.assert_allclose(found.terms.disturbance, 1.0)
    assert len(PHASES) == 3


def test_a_machine_with_an_axis_that_oscillates_gets_its_gains_back_at_once_and_for_the_rest(trials):
    drives = Played(shaking={(1, 3): [2]})
    found = run(trials, drives)
    assert found.aborted.tolist() == [[False] * 4, [False, False, True, True], [False, False, True, True]]
    assert found.culprit.tolist() == [False, False, True, False]  # its neighbour was stopped with it
    windows = TRIAL // WATCH
    gains_of_2 = [gains[2].tolist() for _, gains in drives.recorded]
    assert gains_of_2[: windows + 4] == [GAINS[2].tolist()] * (windows + 4)
    assert gains_of_2[windows + 4 :] == [SAFE[2].tolist()] * (2 * windows - 4)
    assert drives.recorded[-1][1][0, NAMES.index("velocity_p")] == 1200  # the other machine has its probe


def test_an_axis_in_fault_is_cleared_and_goes_on_and_who_takes_no_part_is_left_alone(trials):
    drives = Played(faults={(0, 2): [1], (2, 0): [3]})
    found = run(trials, drives, np.array([True, True, False, False]))
    assert found.aborted.tolist() == [[True, True, False, False]] * 3
    assert found.culprit.tolist() == [False, True, False, False]
    cleared = [axes for word, axes in drives.words if word == cia402.FAULT_RESET]
    assert cleared == [[1]]
    assert drives.status[3] == FAULT
    again = [axes for word, axes in drives.words if word == cia402.ENABLE_OPERATION | cia402.NEW_SET_POINT]
    assert again == [[0, 1], [1], [0, 1], [0, 1]]


def test_the_error_of_the_first_phase_and_what_it_adds_up_to(trials):
    drives = Played()
    record = drives.record

    def behind(objects, seconds):
        rows = record(objects, seconds)
        rows[DEMAND] = rows[DEMAND] + 2 * MOVE.distance if drives.phase == 0 else rows[DEMAND]
        return rows

    drives.record = behind
    found = run(trials, drives)
    np.testing.assert_allclose(found.error, 2.0)
    np.testing.assert_allclose(found.following[0], 2.0 * TRIAL * CYCLE)
    np.testing.assert_allclose(found.following[1:], 0.5 * CYCLE)


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("beyond", [1, -1])
def test_what_is_beyond_a_target_lies_the_way_of_the_move_and_of_its_reversal(trials, direction, beyond):
    """By 5 % of the move from 75 to 100 ms; the current alternates by 100 mA all the time."""
    drives = Played()
    record = drives.record

    def past(objects, seconds):
        rows = record(objects, seconds)
        way = np.sign(MOVE.distance) * direction * (-1 if drives.phase == 1 else 1)
        if drives.window == 4:
            rows[POSITION] = rows[POSITION] + np.rint(0.05 * beyond * way * np.abs(MOVE.distance)).astype(int)
        rows[CURRENT] = np.tile([[100], [0]], (13, 4))[: len(rows[CURRENT])]
        return rows

    drives.record = past
    found = run(trials, drives, direction=direction)
    np.testing.assert_allclose(found.terms.overshoot, 0.05 if beyond > 0 else 0.0, rtol=1e-3)
    np.testing.assert_allclose(found.terms.settling, 1.0 + WATCH * 1e-3 / 0.004)  # a t_0 of 4 ms
    # A look begins as the one before it ended: 24 of 25 changes.
    np.testing.assert_allclose(found.terms.noise, 0.1 / MOTOR.rated_current, rtol=0.05)


def test_a_position_beyond_the_counters_end_is_where_it_goes_on(trials, monkeypatch):
    went = []
    monkeypatch.setattr(gain_trial, "start", lambda drives, target, where: went.append((target.tolist(), where)))
    monkeypatch.setattr(gain_trial, "power_up", lambda drives, where: went.append(where))
    made = trials(Played())
    made.go(np.array([2**31 + 3, -(2**31) - 3, 5, 2**31 - 1]), "here")
    made.power_up("there")
    assert went == [([-(2**31) + 3, 2**31 - 3, 5, 2**31 - 1], "here"), "there"]
    assert made.leave() is None and made.look is None


def test_where_a_demand_is_not_recorded_it_is_computed_and_not_asked_for(trials, monkeypatch):
    monkeypatch.setattr(gain_trial, "is_recorded", lambda drives: False)
    drives, asked = Played(), []
    record = drives.record
    drives.record = lambda objects, seconds: asked.append(list(objects)) or record(objects, seconds)
    found = run(trials, drives)
    assert all(DEMAND not in objects for objects in asked)
    assert np.abs(found.error[20]).max() > 0.5, "the profile has hardly begun where the axis is at its end already"


def test_whoever_looks_is_called_after_every_cycle(trials):
    drives, looks = Played(), []
    made = trials(drives)
    made.look = lambda: looks.append(1)
    made.run(GAINS, SAFE, MOVE, np.zeros(4, np.int64), np.ones(4, np.int64), np.ones(4, bool))
    assert len(looks) == 3 * TRIAL


def test_recovery_tries_five_times_and_ends_when_all_are_enabled(trials, monkeypatch):
    modes = []
    monkeypatch.setattr(gain_trial.motion, "select_mode", lambda drives, mode, where: modes.append(mode))
    drives = Played(stays_down=True)
    drives.status[1] = FAULT
    where = np.array([True, True, False, False])
    trials(drives).recover(where)
    resets = [axes for word, axes in drives.words if word == cia402.FAULT_RESET]
    assert resets == [[1]] * RECOVERY and drives.advanced == pytest.approx(0.05)
    drives = Played()
    drives.status[1] = drives.status[3] = FAULT
    trials(drives).recover(where)
    assert [axes for word, axes in drives.words if word == cia402.FAULT_RESET] == [[1]]
    assert modes == ["pp", "pp"] and drives.status[3] == FAULT


def test_on_a_bus_the_samples_are_mapped_before_the_move_begins(trials):
    drives = Played()
    drives.time_waits = False
    run(trials, drives)
    assert sum(len(gains) > 0 for _, gains in drives.recorded) == 3 * (TRIAL // WATCH + 1)


# --- what is written --------------------------------------------------------------------------------------------------
def test_a_fault_is_reset_by_an_edge_and_the_axis_enabled_step_by_step():
    drives = Played()
    clear(drives, np.array([False, True, False, False]))
    assert drives.words == [(word, [1]) for word in (0x00, 0x80, 0x06, 0x07, 0x0F)]


def test_bit_4_of_the_controlword_rises():
    drives = Played()
    start(drives, np.array([1, 2, 3, 4]), np.array([True, True, False, True]))
    assert drives.words == [(0x0F, [0, 1, 3]), (0x1F, [0, 1, 3])]
    assert drives.target.tolist() == [1, 2, 0, 4]


def test_drives_are_enabled_in_five_milliseconds_whatever_becomes_of_them(monkeypatch):
    monkeypatch.setattr("drive_env.trials.positioning.motion.select_mode", lambda drives, mode, where: None)
    drives = Played()
    power_up(drives)
    assert [word for word, _ in drives.words] == [0x06, 0x07, 0x0F]
    assert drives.advanced == pytest.approx(0.005)


def test_a_profile_is_written_rounded_up_in_the_drives_units(monkeypatch):
    monkeypatch.setattr("drive_env.trials.positioning.per_increment", lambda drives, name: 0.3)
    written = {}
    drives = SimpleNamespace(write=lambda name, value, where: written.update({name: value.tolist()}))
    write_profile(drives, MOVE._replace(velocity=np.array([10, 11]), acceleration=np.array([20, 21])))
    assert written == {0x6081: [3, 4], 0x6083: [6, 7], 0x6084: [6, 7]}


@pytest.mark.parametrize(("inertia", "reach", "angle"), [
    # 0.4 of the rated torque: a t^2 / 4
    (40.0 * MOTOR.inertia, 1e9, 0.4 * MOTOR.rated_torque / (40.0 * MOTOR.inertia) * 0.06**2 / 4.0),
    (1e-9, 1e9, 0.5 * MOTOR.rated_speed * 0.06 / 2.0),  # half the rated speed at the peak
    (1e-9, -0.5, -0.2),  # 0.4 of what there is to go
])  # fmt: skip
def test_a_move_is_as_long_as_torque_speed_and_travel_allow(inertia, reach, angle):
    move = plan_move(MOTOR, np.array([inertia]), 65536, np.array([reach]))
    scale = 65536 / (2.0 * np.pi)
    assert move.distance == round(angle * scale)
    # A triangle of 60 ms: the speed's peak is twice the mean.
    assert move.acceleration == np.ceil(4.0 * abs(int(move.distance[0])) / 0.06**2)
    assert move.velocity == np.ceil(2.0 * abs(int(move.distance[0])) / 0.06) + 1
    assert move.share == 1.0  # all of the run current
    assert move.increments == scale and move.counts == MOTOR.encoder_counts / (2.0 * np.pi)
    assert PROFILE * CYCLE == 0.06


def test_a_move_of_nothing_has_a_ramp_and_a_speed_all_the_same():
    move = plan_move(MOTOR, np.array([1.0]), 65536, np.array([0.0]))
    assert (move.distance, move.acceleration, move.velocity) == (0, 1, np.ceil(2 / 0.06) + 1)


def test_a_move_asks_for_no_ramp_that_its_drive_refuses():
    """The TMCM-6212 takes 7,629,278 pps^2 (its EDS); of every motor, with nothing but its rotor to turn."""
    highest = highest_ramp(find_device("tmcm6212"))
    assert highest == 7_629_278
    steeper = 0
    for motor in MOTORS.values():
        free, bound = (
            plan_move(motor, np.array([motor.inertia]), np.array([51_200]), np.array([np.inf]), most)
            for most in (np.inf, highest)
        )
        assert bound.acceleration[0] <= highest, motor.name
        steeper += free.acceleration[0] > highest
        if free.acceleration[0] <= highest:
            assert bound.distance == free.distance
        else:
            assert bound.acceleration[0] == pytest.approx(highest, abs=2_500)  # two increments of the way
    assert steeper > 2 and highest_ramp(find_device("tmcm1636_fw109")) == np.inf  # which counts in rpm/s
