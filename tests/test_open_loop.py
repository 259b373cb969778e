"""An open-loop stepper's trial in closed form: its terms, J, what its currents cost, and who has which method."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from drive_env import cia402
from drive_env.devices import find_device
from drive_env.motors import find_motor
from drive_env.phase_current import amplitude, holding_torque, swing_period
from drive_env.trials import open_loop as module
from drive_env.trials.gain_trial import Identified, Trials
from drive_env.trials.method import FIRST_HZ, SAFE_RULE, Cascade, OpenLoop, check_tried, method_of
from drive_env.trials.open_loop import (
    LONGEST_ROLL,
    OpenLoopTerms,
    OpenLoopTrial,
    OpenLoopTrials,
    effort,
    open_loop_cost,
    open_loop_softness,
    open_loop_terms,
    unmeasured,
    with_run_current,
)
from drive_env.trials.positioning import PROFILE, SETTLED, TRIAL, Move
from drive_env.trials.score import Terms, cost

STEPPER, STEPPER_MOTOR = find_device("tmcm3313"), find_motor("qsh4218_51")
SERVO, SERVO_MOTOR = find_device("tmcm1636"), find_motor("qbl4208")
RUN, STANDBY = STEPPER.gains.names.index("run_current"), STEPPER.gains.names.index("standby_current")
FULL_STEP = 256.0  # increments
# 10,000 increments of 51,200 a turn, and an encoder as fine.
MOVE = Move(np.array([10_000]), np.array([1]), np.array([1]), np.array([51200 / (2 * np.pi)]), 51200 / (2 * np.pi))


def gains(run, standby):
    found = np.tile(np.maximum(STEPPER.gains.lowest, 0), (len(run), 1))
    found[:, RUN], found[:, STANDBY] = run, standby
    return found


# --- the terms --------------------------------------------------------------------------------------------------------
def terms_of(error=None, lag=None, sign=1, move=MOVE):
    """The terms of a move: position short of its target, and demand less encoder, by the millisecond."""
    zero = np.zeros((TRIAL, 1))
    error = zero if error is None else np.asarray(error, float)[:, None]
    lag = zero if lag is None else np.asarray(lag, float)[:, None]
    target = np.array([10_000 * sign])
    found = open_loop_terms(target - error * sign, lag, move, 0.01, target, np.array([sign]), FULL_STEP)
    return [float(value[0]) for value in found]


MS = np.arange(TRIAL)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (0 * MS, [1.0, 0.0, 0.0, 0.0]),
        (np.where(MS < PROFILE, 5000, 0), [1.0, 0.0, 0.0, 0.0]),  # on its way
        (np.where((MS >= PROFILE) & (MS < PROFILE + 20), 100, 0), [3.0, 0.0, 0.0, 0.0]),  # 20 ms of a t_0 of 10
        (np.where((MS >= PROFILE) & (MS < PROFILE + 20), 5000, 0), [3.0, 0.0, 0.0, 0.0]),
        (np.where((MS >= PROFILE) & (MS < PROFILE + 20), 50, 0), [2.0, 0.0, 0.0, 0.0]),  # half the band of 1 %
        (np.where(MS == 30, -700, 0), [1.0, 0.0, 0.07, 0.0]),
        (np.where(MS >= SETTLED, 5000, 0), [1.0, 0.0, 0.0, 0.0]),
    ],
)
def test_settling_and_overshoot_of_a_move(error, expected, sign):
    assert terms_of(error, sign=sign) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("distance", "counts", "full_step", "width"),
    [
        (10_000, 51200, 256.0, 100.0),  # 1 % of the move
        (100, 51200, 256.0, 12.8),  # 0.05 full steps
        (100, 51200, 20.0, 3.0),  # 3 counts of the encoder
        (100, 5120, 256.0, 30.0),
    ],
)
def test_the_band_in_which_an_axis_has_settled(distance, counts, full_step, width):
    move = MOVE._replace(distance=np.array([distance]), counts=counts / (2 * np.pi))
    position = np.full((TRIAL, 1), distance - 0.5 * width)
    found = open_loop_terms(position, np.zeros((TRIAL, 1)), move, 0.09, np.array([distance]), np.array([1]), full_step)
    assert found[0] == pytest.approx(1.5)


def test_vibration_is_of_the_profile_and_the_load_angle_of_the_move():
    lag = np.where(MS < PROFILE, np.where(MS % 2, 12.8, -12.8), 0.0)
    assert terms_of(lag=lag)[1] == pytest.approx(0.1)  # full steps from millisecond to millisecond
    assert terms_of(lag=np.where(MS >= PROFILE, 64.0, 0.0))[1] == 0.0
    assert terms_of(lag=np.where(MS == SETTLED - 1, -64.0, 0.0))[3] == pytest.approx(0.25)
    assert terms_of(lag=np.where(MS >= SETTLED, 500.0, 0.0))[3] == 0.0


def test_positions_and_targets_wrap():
    target, position = np.array([-(2**31) + 5]), np.full((TRIAL, 1), 2.0**31 - 5)
    found = open_loop_terms(position, np.zeros((TRIAL, 1)), MOVE, 0.01, target, np.array([1]), FULL_STEP)
    assert found[0] == pytest.approx(1.0 + 0.1 * 90 / 10.0)  # 10 increments of a band of 100


@pytest.mark.parametrize(
    ("changed", "J"),
    [
        ({}, 1.0), ({"settling": 32.0}, 4.0), ({"disturbance": 32.0}, 4.0), ({"effort": 32.0}, 4.0),
        ({"load_angle": 0.5}, 2.0**0.2), ({"noise": 0.1}, 2.0**0.2), ({"overshoot": 0.02}, 1.0),
        ({"overshoot": 0.12}, 2.0), ({"tripped": True}, 30.0), ({"settling": 1e9}, 30.0), ({"noise": np.nan}, 30.0),
    ],
)  # fmt: skip
def test_j_of_one_term_at_a_time(changed, J):
    neutral = {"settling": 1.0, "disturbance": 1.0, "noise": 0.0, "overshoot": 0.0, "tripped": False,
               "load_angle": 0.0, "effort": 1.0}  # fmt: skip
    terms = OpenLoopTerms(**{name: np.array([value]) for name, value in (neutral | changed).items()})
    assert open_loop_cost(terms) == pytest.approx(J)
    assert terms.each(lambda value: value[0]) == tuple((neutral | changed).values()) or changed == {"noise": np.nan}


def test_the_disturbance_of_every_phase_is_that_of_the_standby_current():
    one = np.ones((3, 2))
    terms = OpenLoopTerms(one, one, 0 * one, 0 * one, one > 2, 0 * one, one)
    aborted = np.array([[False, False], [False, True], [False, True]])
    found = OpenLoopTrial(terms, one, aborted, one, aborted[0], aborted).costs(np.array([32.0, 1.0]))
    np.testing.assert_allclose(found, [[4.0, 1.0], [4.0, 30.0], [4.0, 30.0]])


# --- currents ---------------------------------------------------------------------------------------------------------
def test_softness_and_effort_of_currents():
    """Deflection is one over the standby current; copper has the run current for the profile, and then the other."""
    tried = gains([255, 127], [127, 255])
    np.testing.assert_allclose(open_loop_softness(STEPPER, tried), [1 / 1.5, 1 / 3.0])
    rated = STEPPER_MOTOR.rated_current**2
    share = 60 / 250
    np.testing.assert_allclose(
        effort(STEPPER, STEPPER_MOTOR, tried),
        [(share * 9.0 + (1 - share) * 2.25) / rated, (share * 2.25 + (1 - share) * 9.0) / rated],
    )


@pytest.mark.parametrize(("setting", "factor", "expected"), [(255, 0.8, 204), (100, 0.8, 80), (101, 0.8, 80),
                                                              (1, 0.8, 1), (200, 2.0, 255), (7, 1.0, 7)])  # fmt: skip
def test_a_probe_has_less_run_current_and_nothing_else(setting, factor, expected):
    tried = gains([setting], [33])
    found = with_run_current(STEPPER, tried, factor)
    assert found[0, RUN] == expected and tried[0, RUN] == setting
    assert np.delete(found, RUN, axis=1).tolist() == np.delete(tried, RUN, axis=1).tolist()


def test_what_6077h_is_in_open_loop():
    assert unmeasured(STEPPER) == "in open loop 6077h is the size of the current that is set"
    assert unmeasured(SimpleNamespace(bindings={})) == "no 6077h"


# --- what has been lost in steps --------------------------------------------------------------------------------------
class Counters:
    """Drives whose step counter and encoder are what a test says."""

    time_waits = True

    def __init__(self, demand, encoder):
        self.num_axes, self.device = len(demand), STEPPER
        self.demand, self.encoder, self.advanced = np.array(demand), np.array(encoder), 0
        self.rolling = 0  # readings for which the rotor still moves

    def read(self, name):
        if name == cia402.POSITION_ACTUAL:
            self.encoder = self.encoder + (100 if self.rolling > 0 else 0)
            self.rolling -= 1
        return {cia402.POSITION_DEMAND: self.demand, cia402.POSITION_ACTUAL: self.encoder}.get(
            name, np.full(self.num_axes, 51200)
        )

    def advance(self, seconds):
        self.advanced += 1


def test_whole_teeth_are_made_up_for_and_what_a_load_turns_the_rotor_by_is_not():
    """A tooth of 50 is 1,024 increments of 51,200."""
    drives = Counters([1000, 0], [990, 5])
    trials = OpenLoopTrials(drives, STEPPER_MOTOR, 1, 0.01)
    assert trials.shift().tolist() == [10, -5]
    drives.demand = np.array([1500, 500])
    assert trials.shift().tolist() == [10 + 0, -5 + 0]  # 510 and 495: less than half a tooth more
    drives.demand = np.array([1000 + 1024 + 300, -2048 - 300])
    assert trials.shift().tolist() == [10 + 1024, -5 - 2048]


@pytest.mark.parametrize(("rolling", "looks"), [(0, 1), (6, 4), (10**6, LONGEST_ROLL)])
def test_a_rotor_that_rolls_is_waited_for_and_not_for_ever(rolling, looks):
    drives = Counters([0], [0])
    drives.rolling = rolling
    trials = OpenLoopTrials(drives, STEPPER_MOTOR, 1, 0.01)
    trials._fell = True
    trials._come_to_rest(np.array([256.0]))
    assert drives.advanced == looks and not trials._fell


def test_inertia_and_friction_are_what_the_load_angle_says_at_the_run_current(monkeypatch):
    """sin(n_p lag) of the run current's holding torque is the torque; the encoder's count is one period old.

    The travel of 1.4 full steps leaves no room for the rotor's free swing.
    """
    motor, scale, age = STEPPER_MOTOR, 512_000_000, 1.0 / STEPPER.velocity_rate
    J, coulomb, run = 5.0 * motor.inertia, 0.05, 100
    held = float(holding_torque(motor, amplitude(STEPPER, run)))
    t = np.arange(TRIAL)
    speed = np.interp(t, [0, 30, 60, TRIAL], [0.0, 40.0, 0.0, 0.0])
    acceleration = np.diff(speed, prepend=0.0) / 1e-3
    angle = np.cumsum(speed) * 1e-3
    lag = np.arcsin((J * acceleration + motor.torque_constant * coulomb * np.clip(speed, -1, 1)) / held) / motor.n_p
    to_increments = scale / (2.0 * np.pi)
    phases = []

    class Drives:
        num_axes, time_waits = 1, True

        def read(self, name):
            return np.array([scale if name is module.Role.POSITION_SCALE else 0])

        def advance(self, seconds):
            pass

        def record(self, objects, seconds):
            way = 1 if not phases else -1
            first = 0.0 if not phases else angle[-1]
            phases.append(1)
            true = first + way * angle
            rows = {
                cia402.POSITION_ACTUAL: true - way * speed * age,
                cia402.POSITION_DEMAND: true + way * lag,
            }
            return {name: np.rint(rows[name] * to_increments).astype(np.int64)[:, None] for name in objects}

    monkeypatch.setattr(module, "device_of", lambda drives: STEPPER)
    monkeypatch.setattr(module, "read_gains", lambda drives: gains([run], [250]))
    monkeypatch.setattr(module, "write_profile", lambda drives, move, where: None)
    monkeypatch.setattr(module, "start", lambda drives, target, where: None)
    found, origin = OpenLoopTrials(Drives(), motor, 1, 0.01).identify(np.array([0.044]), np.array([True]))
    assert origin == 0
    np.testing.assert_allclose(found.inertia, J, rtol=0.1)
    assert 0.3 * coulomb < found.coulomb < 1.5 * coulomb


@pytest.mark.parametrize(("way", "moved"), [(2500, True), (2499, False), (-2500, True)])
def test_an_encoder_must_show_a_quarter_of_the_move(way, moved):
    trials = OpenLoopTrials(Counters([0, 0], [0, 0]), STEPPER_MOTOR, 1, 0.01)
    move = MOVE._replace(distance=np.array([-10_000, 10_000]))
    position = np.array([[0, 7], [10_000, 7 + way], [0, 7]])
    both = np.array([True, True])
    if moved:
        trials._check_moved(position, move, both)
        return
    with pytest.raises(RuntimeError, match="axis 1: the encoder showed 2499 of 10000 increments of a move at"):
        trials._check_moved(position, move, both)
    trials._check_moved(position, move, np.array([True, False]))


@pytest.mark.parametrize(("window", "loop"), [((0, 0), (0, 0)), ((500, 0), (1, 0)), ((500, 500), (1, 1))])
def test_sensor_window_and_loop_are_what_they_were_afterwards(window, loop, monkeypatch):
    monkeypatch.setattr(module, "device_of", lambda drives: STEPPER)
    monkeypatch.setattr(Trials, "recover", lambda self, where: None)
    first = {"sensor": [1, 0], "window": list(window), "loop": list(loop)}
    values = {name: np.array(value) for name, value in first.items()}
    log = []
    names = {cia402.SENSOR_SELECTION: "sensor", cia402.FOLLOWING_WINDOW: "window", module.Role.LOOP_MODE: "loop"}

    class Drives:
        num_axes, time_waits = 2, True

        def read(self, name):
            return values[names[name]].copy() if name in names else np.array([0x0240, 0x0240])

        def write(self, name, value, *, where=None):
            mask = np.ones(2, bool) if where is None else where
            log.append((names[name], np.flatnonzero(mask).tolist()))
            values[names[name]] = np.where(mask, value, values[names[name]])

    trials = OpenLoopTrials(Drives(), STEPPER_MOTOR, 1, 0.01)
    trials.leave()
    assert not log  # nothing was changed
    trials.recover(np.array([True, True]))
    assert {name: value.tolist() for name, value in values.items()} == {
        "sensor": [0, 0],
        "window": [0, 0],
        "loop": [0, 0],
    }
    trials.recover(np.array([True, True]))
    assert trials.sensor.tolist() == [1, 0]  # what it was at first
    trials.leave()
    assert {name: value.tolist() for name, value in values.items()} == first
    log.clear()
    trials.leave()
    assert not log


# --- methods ----------------------------------------------------------------------------------------------------------
def test_a_cascade_and_an_open_loop_answer_for_their_kind():
    servo, stepper = method_of(SERVO, SERVO_MOTOR), method_of(STEPPER, STEPPER_MOTOR)
    assert isinstance(servo, Cascade) and isinstance(stepper, OpenLoop)
    assert (servo.measures_current, servo.caution) == (True, 1)
    assert (stepper.measures_current, stepper.caution) == (False, -1)
    assert stepper.t_0() == swing_period(STEPPER_MOTOR)
    assert servo.highest().tolist() == SERVO.gains.highest.tolist()
    assert type(servo.trials(None, 1)) is Trials and type(stepper.trials(None, 1)) is OpenLoopTrials
    one = np.ones(1)
    assert servo.cost(Terms(2 * one, one, 0 * one, 0 * one, one > 2)) == cost(
        Terms(2 * one, one, 0 * one, 0 * one, one > 2)
    )
    assert servo.current(Terms(one, one, 0.3 * one, one, one > 2)) == 0.3
    terms = OpenLoopTerms(one, one, one, one, one > 2, one, 0.25 * one)
    assert stepper.current(terms) == 0.5 and stepper.cost(terms) == open_loop_cost(terms)


def test_no_current_of_a_search_is_above_the_motors_rated_one():
    stepper = method_of(STEPPER, STEPPER_MOTOR)
    most = stepper.highest()
    assert amplitude(STEPPER, most[RUN]) <= STEPPER_MOTOR.rated_current < amplitude(STEPPER, most[RUN] + 8)
    assert most[RUN] == most[STANDBY]
    others = [k for k in range(len(most)) if k not in (RUN, STANDBY)]
    assert most[others].tolist() == STEPPER.gains.highest[others].tolist()
    first = stepper.first(np.array([24.0, 48.0]))
    assert first.shape == (2, len(most)) and (first[:, [RUN, STANDBY]] == most[RUN]).all()
    assert stepper.safe(None, None, np.array([24.0])).tolist() == first[:1].tolist()


def test_what_is_no_current_stays_as_the_drives_have_it():
    present = np.arange(2 * len(STEPPER.gains.names)).reshape(2, -1)
    found = method_of(STEPPER, STEPPER_MOTOR).keep(gains([200, 100], [50, 60]), present)
    assert found[:, [RUN, STANDBY]].tolist() == [[200, 50], [100, 60]]
    assert np.delete(found, [RUN, STANDBY], axis=1).tolist() == np.delete(present, [RUN, STANDBY], axis=1).tolist()
    same = np.ones((1, 5), int)
    assert method_of(SERVO, SERVO_MOTOR).keep(same, 2 * same) is same


def test_the_rules_currents_hold_what_a_move_takes():
    """Twice the torque of J alpha + friction + load, and of the load and 0.3 of the rated torque at rest."""
    motor = STEPPER_MOTOR
    zero = np.zeros(1)
    move = MOVE._replace(velocity=np.array([2.0]) * MOVE.increments, acceleration=np.array([500.0]) * MOVE.increments)
    supply = np.array([24.0])

    def torque(**found):
        known = {"inertia": zero, "coulomb": zero, "viscous": zero, "offset": zero} | found
        used = method_of(STEPPER, motor).rule(Identified(**known), move, supply)
        run = used[0, RUN]
        return float(holding_torque(motor, amplitude(STEPPER, run))), float(
            holding_torque(motor, amplitude(STEPPER, run - 8))
        )

    for found, needed in [
        ({"inertia": np.array([2e-4])}, 0.1), ({"coulomb": np.array([0.3])}, 0.3 * motor.torque_constant),
        ({"viscous": np.array([0.15])}, 0.3 * motor.torque_constant),
    ]:  # fmt: skip
        has, less = torque(**found)
        least = max(needed, 0.3 * motor.rated_torque) / 0.5
        assert less < least * 1.001 and has >= least * 0.999
    for offset in (0.1, -0.1):
        used = method_of(STEPPER, motor).rule(Identified(zero, zero, zero, np.array([offset])), move, supply)
        least = (0.1 * motor.torque_constant + 0.3 * motor.rated_torque) / 0.5
        assert holding_torque(motor, amplitude(STEPPER, used[0, STANDBY])) >= 0.999 * least
        assert holding_torque(motor, amplitude(STEPPER, used[0, STANDBY] - 8)) < least


def test_the_first_gains_of_a_cascade_are_those_of_three_rotors_and_the_safe_rule_is_slow():
    assert (FIRST_HZ["current_hz"], FIRST_HZ["velocity_hz"], FIRST_HZ["position_hz"]) == (1000.0, 20.0, 5.0)
    servo = method_of(SERVO, SERVO_MOTOR)
    found = servo.first(np.array([24.0, 48.0]))
    assert found[0, 0] == pytest.approx(2 * found[1, 0], abs=1)  # torque P is per volt
    assert found[0, 1:].tolist() == found[1, 1:].tolist()
    inertia = Identified(np.array([1.0, 4.0]) * 3.0 * SERVO_MOTOR.inertia, *np.zeros((3, 2)))
    rule, safe = (make(inertia, None, np.array([24.0, 24.0])) for make in (servo.rule, servo.safe))
    assert np.all(safe[:, 2] == np.rint(rule[:, 2] / 3).astype(int)) or np.abs(safe[:, 2] - rule[:, 2] / 3).max() <= 1
    assert np.abs(safe[:, 3] - rule[:, 3] / 9).max() <= 1
    assert np.abs(safe[:, 4] - rule[:, 4] * 0.3 / 3).max() <= 1
    assert SAFE_RULE.speed < 0.1


def test_what_a_trial_cannot_tell_apart_is_refused():
    check_tried(SERVO, ("velocity_p",))
    with pytest.raises(ValueError, match="give different ones of gain"):
        check_tried(SERVO, ())
    check_tried(STEPPER, ("run_current", "standby_current"))
    with pytest.raises(ValueError, match="run_current: trials of correction_velocity_p close the loop"):
        check_tried(STEPPER, ("run_current", "correction_velocity_p"))
    with pytest.raises(ValueError, match="coolstep_up: a trial of an open-loop stepper shows what the phase currents"):
        check_tried(STEPPER, ("run_current", "coolstep_up"))
    none = SimpleNamespace(
        name="none",
        gains=SimpleNamespace(
            outer=(), columns=lambda names: (), loop_of=lambda names: None, closed_loops=(), is_open_loop=False
        ),
    )
    with pytest.raises(ValueError, match="none has no gains of a velocity or position loop and no phase currents"):
        check_tried(none, ())
    check_tried(none, ("anything",))
