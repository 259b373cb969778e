"""An open-loop stepper's trial in closed form: its terms, J, what its currents cost, and who has which method."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from drive_env import cia402
from drive_env.devices import find_device
from drive_env.motors import find_motor
from drive_env.phase_current import amplitude, holding_torque, rated_setting, swing_period
from drive_env.trials import open_loop as module
from drive_env.trials.gain_trial import Identified, Trials
from drive_env.trials.method import (
    FIRST_HZ,
    SAFE_RULE,
    Cascade,
    LoadSettings,
    OpenLoop,
    check_tried,
    method_of,
    new_score,
)
from drive_env.trials.open_loop import (
    LONGEST_ROLL,
    OpenLoopTerms,
    OpenLoopTrial,
    OpenLoopTrials,
    acceleration_share,
    effort,
    open_loop_cost,
    open_loop_softness,
    open_loop_terms,
    unmeasured,
    with_run_current,
)
from drive_env.trials.positioning import PROFILE, SETTLED, TRIAL, WATCH, Move, highest_ramp, plan_move
from drive_env.trials.rotor_swing import FreeSwing
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


def test_a_move_of_nothing_has_overshot_by_increments():
    still = MOVE._replace(distance=np.array([0]))
    position = np.where(np.arange(TRIAL) == 30, 3.0, 0.0)[:, None]
    found = open_loop_terms(position, 0 * position, still, 0.01, np.array([0]), np.array([1]), FULL_STEP)
    assert found[2] == pytest.approx(3.0)


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
        ({"overshoot": 0.12}, 2.0), ({"tripped": True}, 30.0), ({"settling": 1e5}, 30.0 - 225.0 / 100.0),
        ({"noise": np.nan}, 30.0),
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

    time_waits, scale = True, 51200

    def __init__(self, demand, encoder):
        self.num_axes, self.device = len(demand), STEPPER
        self.demand, self.encoder, self.advanced = np.array(demand), np.array(encoder), 0
        self.rolling = 0  # readings for which the rotor still moves

    def read(self, name):
        if name == cia402.POSITION_ACTUAL:
            self.encoder = self.encoder + (100 if self.rolling > 0 else 0)
            self.rolling -= 1
        return {cia402.POSITION_DEMAND: self.demand, cia402.POSITION_ACTUAL: self.encoder}.get(
            name, np.full(self.num_axes, self.scale)
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


def test_a_tooth_need_not_be_a_whole_number_of_increments():
    """Of 51,230 a turn it is 1,024.6: a hundred of them are 102,460."""
    drives = Counters([0], [0])
    drives.scale = 51_230
    trials = OpenLoopTrials(drives, STEPPER_MOTOR, 1, 0.01)
    assert trials.shift().tolist() == [0]
    drives.demand = np.array([102_460])
    assert trials.shift().tolist() == [102_460]


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
            return np.array([{module.Role.POSITION_SCALE: scale, cia402.STATUSWORD: 0x0637}.get(name, 0)])

        def advance(self, seconds):
            pass

        def record(self, objects, seconds):
            way = 1 if not phases else -1
            first = 0.0 if not phases else angle[-1]
            phases.append(1)
            true = first + way * angle
            rows = {cia402.POSITION_ACTUAL: true - way * speed * age, cia402.POSITION_DEMAND: true + way * lag}
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
    with pytest.raises(RuntimeError, match="axis 0: the encoder showed 0 of 10000"):
        trials._check_moved(0 * position, move, both)


@pytest.mark.parametrize("acts", [False, True])
@pytest.mark.parametrize(("window", "loop"), [((0, 0), (0, 0)), ((500, 0), (1, 0)), ((500, 500), (1, 1))])
def test_sensor_window_loop_and_what_acts_by_the_load_are_what_they_were_afterwards(window, loop, acts, monkeypatch):
    """A stall stops nothing from 20A4h = 0 on, and CoolStep acts at no speed above the highest that 20A5h takes."""
    monkeypatch.setattr(module, "device_of", lambda drives: STEPPER)
    monkeypatch.setattr(Trials, "recover", lambda self, where: None)
    first = {"sensor": [1, 0], "window": list(window), "loop": list(loop), "stall": [900, 0], "coolstep": [0, 700]}
    values = {name: np.array(value) for name, value in first.items()}
    log = []
    names = {cia402.SENSOR_SELECTION: "sensor", cia402.FOLLOWING_WINDOW: "window", module.Role.LOOP_MODE: "loop",
             module.Role.STALL_SPEED: "stall", module.Role.COOLSTEP_SPEED: "coolstep"}  # fmt: skip

    class Drives:
        num_axes, time_waits = 2, True

        def read(self, name):
            return values[names[name]].copy() if name in names else np.array([0x0240, 0x0240])

        def write(self, name, value, *, where=None):
            mask = np.ones(2, bool) if where is None else where
            log.append((names[name], np.flatnonzero(mask).tolist()))
            values[names[name]] = np.where(mask, value, values[names[name]])

    trials = OpenLoopTrials(Drives(), STEPPER_MOTOR, 1, 0.01)
    trials.acts_by_load = acts
    trials.leave()
    assert not log  # nothing was changed
    trials.recover(np.array([False, True]))
    assert values["stall"].tolist() == first["stall"] and ("coolstep", [0]) not in log  # the other takes no part yet
    trials.recover(np.array([True, True]))
    load = {"stall": first["stall"], "coolstep": first["coolstep"]}
    assert {name: value.tolist() for name, value in values.items()} == {
        "sensor": [0, 0],
        "window": [0, 0],
        "loop": [0, 0],
        **(load if acts else {"stall": [0, 0], "coolstep": [2**31 - 1] * 2}),
    }
    log.clear()
    trials.recover(np.array([True, True]))
    assert not log
    assert trials.sensor.tolist() == [1, 0]  # what it was at first
    trials.leave()
    assert {name: value.tolist() for name, value in values.items()} == first
    log.clear()
    trials.leave()
    assert not log


# --- a trial, on drives whose field and rotor are what a test says ----------------------------------------------------
NEAR, FAR = 500, 512  # increments; two full steps are 512
TRIED, KEPT = gains([200] * 4, [100] * 4), gains([150] * 4, [90] * 4)
FOUR = Move(
    np.array([10_000, -10_000, 10_000, 10_000]), np.ones(4, int), np.ones(4, int), np.full(4, 51200 / (2 * np.pi)),
    51200 / (2 * np.pi),
)  # fmt: skip


class Played:
    """Drives that stand at the target of their phase, ahead of or behind it as a test says.

    `lag` and `over`: (phase, window) -> increments of each axis, of the field before the rotor, and of the rotor beyond
    its target. `faults`: (phase, window) -> axes.
    """

    num_axes, device, time_waits = 4, STEPPER, True

    def __init__(self, lag=None, over=None, faults=None):
        self.lag, self.over, self.faults = lag or {}, over or {}, faults or {}
        self.phase, self.window, self.target = -1, 0, np.zeros(4)
        self.log, self.targets = [], []

    def read(self, name):
        if name is module.Role.POSITION_SCALE:
            return np.full(4, 51200)
        return np.full(4, 7) if name == cia402.POSITION_DEMAND else np.zeros(4)  # the counter has 7 more

    def write(self, name, value, *, where):
        self.log.append((self.phase, self.window, name, value, where.tolist()))

    def record(self, objects, seconds):
        rows, place = round(seconds / 1e-3), (self.phase, self.window)
        self.window += 1
        status = np.full((rows, 4), 0x0637)
        status[-1, self.faults.get(place, [])] = 0x0238
        encoder = np.tile(self.target + np.asarray(self.over.get(place, 0)), (rows, 1))
        field = encoder + 7 + np.asarray(self.lag.get(place, 0))
        return {
            cia402.POSITION_ACTUAL: encoder, cia402.POSITION_DEMAND: field, cia402.STATUSWORD: status,
        }  # fmt: skip


@pytest.fixture
def trial(monkeypatch):
    """Run a trial of two machines of two axes; return it, the drives, and the gains as they were written."""
    monkeypatch.setattr(module, "device_of", lambda drives: STEPPER)
    monkeypatch.setattr(module, "write_profile", lambda drives, move, where: None)

    def run(where=None, direction=1, tried=TRIED, **played):
        drives, written = Played(**played), []
        monkeypatch.setattr(
            module, "write_gains", lambda drives, gains, where: written.append((gains.tolist(), where.tolist()))
        )

        def start(drives, target, where):
            drives.phase, drives.window, drives.target = drives.phase + 1, 0, target - 7
            drives.targets.append(target.tolist())

        monkeypatch.setattr(module, "start", start)
        monkeypatch.setattr(module, "clear", lambda drives, down: drives.log.append(("clear", down.tolist())))
        made = OpenLoopTrials(drives, STEPPER_MOTOR, 2, 0.01)
        monkeypatch.setattr(made, "_come_to_rest", lambda step: (
            drives.log.append(("rest", drives.phase, step.tolist())), setattr(made, "_fell", False),
        ))  # fmt: skip
        origin, part = np.full(4, 100), np.ones(4, bool) if where is None else np.array(where)
        found = made.run(tried, KEPT, FOUR, origin, np.full(4, direction), part)
        return found, drives, written

    return run


@pytest.mark.parametrize("direction", [1, -1])
def test_a_trial_moves_there_back_and_there_again_with_less_current(trial, direction):
    """Targets of the step counter are those of the encoder and the 7 that it has more."""
    found, drives, written = trial(direction=direction)
    away = (100 + direction * FOUR.distance).tolist()
    assert drives.targets == [[7 + t for t in away], [107] * 4, [7 + t for t in away]]
    probe = with_run_current(STEPPER, TRIED, 0.8)
    assert probe[0, RUN] == 160
    assert [gains for gains, _ in written] == [TRIED.tolist(), TRIED.tolist(), probe.tolist()]
    assert not found.aborted.any() and not found.lost.any() and not found.culprit.any() and drives.log == []
    expected = [effort(STEPPER, STEPPER_MOTOR, used) for used in (TRIED, TRIED, probe)]
    np.testing.assert_allclose(found.terms.effort, expected)
    for values, value in ((found.terms.settling, 1.0), (found.terms.disturbance, 1.0), (found.terms.noise, 0.0)):
        np.testing.assert_allclose(values, np.full((3, 4), value))
    np.testing.assert_allclose(found.following, 0.5e-3)  # half of the move for one cycle is the least
    assert found.error.shape == (TRIAL, 4) and not found.error.any() and not found.terms.tripped.any()


def test_what_a_trial_shows_of_the_field_before_its_rotor(trial):
    """Axis 1 goes backwards; a lag of 256 increments is a full step, and of a move of 10,000 0.0256."""
    everywhere = {(phase, k): [256, -128, 0, 0] for phase in range(3) for k in range(10)}
    found, _, _ = trial(lag=everywhere)
    np.testing.assert_allclose(found.terms.load_angle, [[1.0, 0.5, 0.0, 0.0]] * 3)
    np.testing.assert_allclose(found.error[:, :2], [[0.0256, -0.0128]] * TRIAL)
    np.testing.assert_allclose(found.following[:, 0], 0.0256 * TRIAL * 1e-3)
    early, _, _ = trial(lag={(0, 4): [256] * 4})
    np.testing.assert_allclose(early.error[100 : 100 + WATCH], 0.0256)
    later, _, _ = trial(lag={(1, 4): [256] * 4})
    assert not later.error.any()
    np.testing.assert_allclose(later.terms.load_angle[:, 2], [0.0, 1.0, 0.0])
    np.testing.assert_allclose(later.following[:, 0], [0.5e-3, 0.0256 * WATCH * 1e-3, 0.5e-3])


@pytest.mark.parametrize("direction", [1, -1])
def test_what_is_beyond_a_target_lies_the_way_of_the_move_and_of_its_reversal(trial, direction):
    way = direction * np.sign(FOUR.distance)
    beyond, _, _ = trial(direction=direction, over={(0, 3): 500 * way, (1, 3): -300 * way, (2, 3): 200 * way})
    np.testing.assert_allclose(beyond.terms.overshoot, np.tile([[0.05], [0.03], [0.02]], 4))
    short, _, _ = trial(direction=direction, over={(0, 3): -500 * way, (1, 3): 300 * way, (2, 3): -200 * way})
    assert not short.terms.overshoot.any()
    settled = [1.0 + 1.0 * WATCH * 1e-3 / 0.01] * 4  # 5, 3 and 2 % are out of the band of 1 %
    np.testing.assert_allclose(beyond.terms.settling, [settled] * 3)


def test_an_axis_that_loses_steps_stops_its_machine_which_gets_its_currents_back(trial):
    """Two full steps between field and rotor are none yet; the rotor is waited for before the next phase."""
    found, drives, written = trial(lag={(0, 4): [FAR, FAR, FAR + 1, NEAR]})
    assert found.culprit.tolist() == [False, False, True, False]
    assert found.aborted.tolist() == [[False, False, True, True]] * 3
    assert found.lost.tolist() == [[False, False, True, False], [False] * 4, [False] * 4]
    assert written[1] == (KEPT.tolist(), [False, False, True, True])
    mixed = [*TRIED[:2].tolist(), *KEPT[2:].tolist()]
    assert [gains for gains, where in written[2:]] == [mixed, [*with_run_current(STEPPER, TRIED, 0.8)[:2].tolist(),
                                                               *KEPT[2:].tolist()]]  # fmt: skip
    halted = (0, 5, cia402.CONTROLWORD, cia402.ENABLE_OPERATION | cia402.HALT, [False, False, True, True])
    assert drives.log == [halted, ("rest", 0, [pytest.approx(256.0)] * 4)]
    np.testing.assert_allclose(found.terms.effort[1, 2:], effort(STEPPER, STEPPER_MOTOR, KEPT)[2:])


def test_an_axis_that_goes_on_losing_steps_is_halted_again_and_blamed_once(trial):
    found, drives, _ = trial(lag={(0, 4): [FAR + 1] * 4, (0, 6): [-FAR - 1, 0, 0, 0], (2, 9): [0, FAR + 1, 0, 0]})
    assert found.culprit.all() and found.aborted.all()
    assert found.lost.tolist() == [[True] * 4, [False] * 4, [False, True, False, False]]
    halts = [(entry[0], entry[1], entry[4]) for entry in drives.log if entry[0] != "rest"]
    assert halts == [
        (0, 5, [True] * 4), (0, 7, [True, False, False, False]), (2, 10, [False, True, False, False])
    ]  # fmt: skip
    assert [entry[1] for entry in drives.log if entry[0] == "rest"] == [0]  # not again when it has come to rest


def test_an_axis_in_fault_is_cleared_and_has_lost_no_steps(trial):
    found, drives, written = trial(faults={(1, 2): [0]})
    assert found.culprit.tolist() == [True, False, False, False] and not found.lost.any()
    assert found.aborted.tolist() == [[False] * 4, [True, True, False, False], [True, True, False, False]]
    assert written[2] == (KEPT.tolist(), [True, True, False, False])
    # Its neighbour is stopped with it; what is in fault takes no halt.
    halted = (1, 3, cia402.CONTROLWORD, cia402.ENABLE_OPERATION | cia402.HALT, [False, True, False, False])
    assert drives.log == [halted, ("clear", [True, False, False, False])]


def test_who_takes_no_part_is_neither_stopped_nor_blamed(trial):
    found, drives, written = trial([True, True, False, False], lag={(0, 1): [0, 0, FAR + 1, 0]}, faults={(0, 2): [3]})
    assert not found.aborted.any() and not found.lost.any() and not found.culprit.any() and drives.log == []
    assert all(where == [True, True, False, False] for _, where in written)


def test_a_move_of_nothing_counts_over_an_increment(trial, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "FOUR", FOUR._replace(distance=np.array([0, 1, 2, 0])))
    found, _, _ = trial(lag={(0, 4): [8] * 4})
    assert found.error[100].tolist() == [8.0, 8.0, 4.0, 8.0]


def test_positions_of_a_trial_go_over_the_counters_end():
    drives = Counters([2**31 - 5], [2**31 - 10])
    trials = OpenLoopTrials(drives, STEPPER_MOTOR, 1, 0.01)
    started = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "start", lambda drives, target, where: started.append((target.tolist(), where)))
        trials.go(np.array([2**31 - 3]), "here")
    assert started == [([-(2**31) + 2], "here")]


# --- the free swing ---------------------------------------------------------------------------------------------------
class Swinging:
    """A drive of two axes that answers to where it is sent; what a profile of it had before is 11, 22 and 33."""

    num_axes, time_waits = 2, True

    def __init__(self, scale):
        self.log, self.at, self.scale = [], np.zeros(2), scale

    def read(self, name):
        if name is module.Role.POSITION_SCALE:
            return np.full(2, self.scale)
        old = {cia402.PROFILE_VELOCITY: 11, cia402.PROFILE_ACCELERATION: 22, cia402.PROFILE_DECELERATION: 33}
        return np.full(2, old[name]) if name in old else self.at.copy()

    def write(self, name, value, *, where):
        self.log.append((name, value.tolist(), where.tolist()))

    def advance(self, seconds):
        self.log.append(("advance", seconds))

    def record(self, objects, seconds):
        self.log.append(("record", seconds))
        rows = np.arange(3)[:, None] * [10.0, 20.0] + self.at
        return {cia402.POSITION_ACTUAL: rows, cia402.POSITION_DEMAND: 2.0 * rows}


@pytest.mark.parametrize(
    ("name", "scale", "speed", "steep"),
    [
        ("tmcm3313", 51_200, 256_000, 0.95 * (2**32 - 1)),  # of 256 * 2e7
        ("tmcm6212", 51_200, 256_000, 0.95 * 7_629_278),
        ("tmcm3313", 800, 4_000, 4 * 2e7),
        ("tmcm6212", 3_200_000, 0.95 * 7_999_511, 0.95 * 7_629_278),
    ],
)
def test_a_rotor_swings_after_a_quarter_of_a_full_step_here_and_half_a_full_step_on(
    name, scale, speed, steep, monkeypatch
):
    """Its profile has 1,000 full steps/s and 2e7 full steps/s^2 or what the drive takes, and is what it was then."""
    device = find_device(name)
    drives, swung = Swinging(scale), []
    monkeypatch.setattr(module, "device_of", lambda drives: device)
    monkeypatch.setattr(module, "per_increment", lambda drives, name: 1.0)
    monkeypatch.setattr(module, "inertia_of_swings", lambda *arguments: swung.append(arguments) or "inertia")

    def start(drives, target, where):
        drives.log.append(("go", target.tolist(), where.tolist()))
        drives.at = target.astype(float)

    monkeypatch.setattr(module, "start", start)
    move = Move(np.array([10, -10]), None, None, np.full(2, scale / (2 * np.pi)), 1.0)
    where, held = np.array([True, False]), np.array([0.2, 0.3])
    made = OpenLoopTrials(drives, STEPPER_MOTOR, 1, 0.01)
    assert made._swing(np.array([1000, 2000]), move, where, held) == "inertia"
    yes = where.tolist()
    quarters = [[1000 + k * scale // 800, 2000 - k * scale // 800] for k in range(4)]
    assert drives.log == [
        (cia402.PROFILE_VELOCITY, [int(speed)] * 2, yes),
        (cia402.PROFILE_ACCELERATION, [int(steep)] * 2, yes),
        (cia402.PROFILE_DECELERATION, [int(steep)] * 2, yes),
        ("go", quarters[0], yes), ("advance", 0.1), ("go", quarters[1], yes), ("record", 0.1),
        ("go", quarters[2], yes), ("advance", 0.1), ("go", quarters[3], yes), ("record", 0.1),
        ("go", quarters[0], yes), ("advance", 0.1),
        (cia402.PROFILE_VELOCITY, [11, 11], yes),
        (cia402.PROFILE_ACCELERATION, [22, 22], yes),
        (cia402.PROFILE_DECELERATION, [33, 33], yes),
    ]  # fmt: skip
    ((demand, position, torque, age, motor),) = swung
    way = np.arange(3)[:, None] * np.array([10.0, 20.0]) * 2.0 * np.pi / scale
    np.testing.assert_allclose(position, [way, way])
    np.testing.assert_allclose(demand, [2.0 * way, 2.0 * way])
    assert torque is held and motor is STEPPER_MOTOR and age == 1.0 / device.velocity_rate


ORIGIN = np.array([1000, -500])


class Recorded:
    """Drives whose encoder and step counter are two records."""

    num_axes, time_waits = 2, True

    def __init__(self, records=(), down=()):
        self.records, self.log, self.encoder = list(records), [], ORIGIN
        self.status = np.full(2, 0x0637)
        self.status[list(down)] = 0x0238

    def read(self, name):
        if name == cia402.STATUSWORD:
            return self.status
        return np.full(2, 51200) if name is module.Role.POSITION_SCALE else self.encoder

    def advance(self, seconds):
        self.log.append(seconds)

    def record(self, objects, seconds):
        position, demand = self.records.pop(0)
        return {cia402.POSITION_ACTUAL: position, cia402.POSITION_DEMAND: demand}


RAMP = 1.5e-6  # inertia that the ramp of the move tells


@pytest.fixture
def identified(monkeypatch):
    """Identify two axes by records; return what is balanced, and what is found with the swing that is given."""
    calls, swings, starts = [], [], []

    def run(swing, reach=(1.0, 1.0), where=(True, True), ramp=RAMP):
        t = np.arange(TRIAL)[:, None]
        there = np.minimum(t, 100) ** 2 * [1.0, 0.5]
        back = there[-1] - there
        drives = Recorded([(ORIGIN + there, ORIGIN + there + 30.0), (ORIGIN + back, ORIGIN + back - 30.0)])
        monkeypatch.setattr(module, "device_of", lambda drives: STEPPER)
        monkeypatch.setattr(module, "read_gains", lambda drives: gains([100, 200], [250, 250]))
        monkeypatch.setattr(module, "write_profile", lambda drives, move, where: starts.append(move))
        monkeypatch.setattr(module, "start", lambda drives, target, where: starts.append(target.tolist()))

        def balance(angle, speed, current, motor, inertia=None, moving=None):
            calls.append((angle, speed, current, inertia, moving))
            one = np.ones(2)
            if inertia is not None:
                return Identified(inertia, 5.0 * one, 6.0 * one, 7.0 * one)
            return Identified(ramp * one, 1.0 * one, 2.0 * one, 3.0 * one)

        def swing_of(self, origin, move, where, held):
            swings.append((where.tolist(), move, held))
            return FreeSwing(np.array(swing[0]), np.array(swing[1]))

        monkeypatch.setattr(module, "momentum_balance", balance)
        monkeypatch.setattr(OpenLoopTrials, "_swing", swing_of)
        found, origin = OpenLoopTrials(drives, STEPPER_MOTOR, 1, 0.01).identify(np.array(reach), np.array(where))
        assert origin.tolist() == ORIGIN.tolist() and drives.log == [0.02]
        return [value.tolist() for value in found], calls, swings

    run.starts = starts
    return run


def test_identification_moves_three_rotors_there_and_back(identified):
    identified(([1e-6, 1e-6], [0.0, 0.0]), reach=(50.0, -0.5))
    most, share = highest_ramp(STEPPER), acceleration_share(STEPPER, STEPPER_MOTOR)
    inertia = np.full(2, 3.0 * STEPPER_MOTOR.inertia)
    move = plan_move(STEPPER_MOTOR, inertia, 51200, np.array([50.0, -0.5]), most, share)
    planned, there, back = identified.starts
    assert planned.distance.tolist() == move.distance.tolist() and planned.acceleration.tolist() == (
        move.acceleration.tolist()
    )
    assert (there, back) == ((ORIGIN + move.distance).tolist(), ORIGIN.tolist())


@pytest.mark.parametrize("taken", [0.0, 0.02, 10.0])
def test_a_trial_asks_for_what_its_probe_holds_of_a_torque_that_pulls_at_once(taken):
    """Nine tenths of 0.725 of what 0.8 of the rated current holds, less friction, load, and detent torque."""
    motor = STEPPER_MOTOR
    held = float(holding_torque(motor, 0.8 * amplitude(STEPPER, rated_setting(STEPPER, motor))))
    free = (0.9 * 0.725 * held - taken - motor.cogging_torque) / motor.rated_torque
    share = acceleration_share(STEPPER, motor, np.array([taken]))
    assert share == pytest.approx(min(max(free, 0.15), 0.4))


def test_what_is_balanced_is_the_torque_of_the_load_angle(identified):
    """Half a period after what the encoder says, the lag is 30 increments less the way of a period of 0.2 ms."""
    _, calls, _ = identified(([1e-6, 1e-6], [0.0, 0.0]))
    angle, speed, current, inertia, moving = calls[0]
    to_rad = 2.0 * np.pi / 51200
    np.testing.assert_allclose(angle[40], [1600 * to_rad, 800 * to_rad])
    np.testing.assert_allclose(speed[40], [80e3 * to_rad, 40e3 * to_rad])
    assert inertia is None and angle.shape == (2 * TRIAL, 2)
    held = holding_torque(STEPPER_MOTOR, amplitude(STEPPER, np.array([100, 200])))
    age = 1.0 / STEPPER.velocity_rate
    for row, sign, rate in ((40, 1, 80e3), (TRIAL + 40, -1, -80e3)):
        torque = held * np.sin(50 * to_rad * (sign * 30.0 - rate * np.array([1.0, 0.5]) * age))
        np.testing.assert_allclose(current[row], torque / STEPPER_MOTOR.torque_constant)
    # 2 n 10^3 increments/s exceed 1 rad/s, 8,149 of them, from n = 5 on; at rest friction holds what it likes.
    assert moving[:111, 0].all() and not moving[111 : TRIAL - 5, 0].any()
    assert moving[TRIAL - 5 : TRIAL + 111, 0].all()


# --- a load that is heavier than a rotor's own ------------------------------------------------------------------------
@pytest.fixture
def heavy(monkeypatch):
    """Identify two axes that lose steps as a test says, move by move; what each told of its inertia is its number."""
    monkeypatch.setattr(module, "device_of", lambda drives: STEPPER)

    def run(lost, still=None, reach=50.0):
        drives, moves, anew = Recorded(), [], []

        def identify_by(self, move, origin, reach, where):
            k = len(moves)
            moves.append((move.distance.tolist(), origin.tolist(), where.tolist()))
            way = np.stack([origin, origin + move.distance])
            if still is not None:
                way[1, still] = way[0, still]
            return Identified(*np.tile([k + 1.0, k + 1.5], (4, 1))), way, np.array(lost[k], bool)

        def start_anew(self, where, full_step):
            anew.append((where.tolist(), full_step.tolist()))
            drives.encoder = drives.encoder + 10

        monkeypatch.setattr(OpenLoopTrials, "_identify_by", identify_by)
        monkeypatch.setattr(OpenLoopTrials, "_start_anew", start_anew)
        found, origin = OpenLoopTrials(drives, STEPPER_MOTOR, 1, 0.01).identify(np.full(2, reach), np.ones(2, bool))
        return found, origin, moves, anew

    return run


def planned(rotors):
    inertia, share = np.full(2, rotors * STEPPER_MOTOR.inertia), acceleration_share(STEPPER, STEPPER_MOTOR)
    return plan_move(STEPPER_MOTOR, inertia, 51200, np.full(2, 50.0), highest_ramp(STEPPER), share).distance.tolist()


def test_an_axis_that_loses_steps_makes_slower_moves_while_the_others_stand(heavy, monkeypatch):
    monkeypatch.setattr(module, "TRIED_ROTORS", (3.0, 100.0, 400.0))
    found, origin, moves, anew = heavy([[0, 1], [1, 1], [1, 0]])  # who stands is not asked
    there = [[ORIGIN[0], ORIGIN[1] + k] for k in (0, 10, 20)]
    parts = [[True, True], [False, True], [False, True]]
    assert moves == list(zip([planned(3.0), planned(100.0), planned(400.0)], there, parts, strict=True))
    assert planned(400.0)[0] < planned(100.0)[0] < planned(3.0)[0]
    assert anew == [([False, True], [256.0, 256.0])] * 2
    assert found.inertia.tolist() == [1.0, 3.5] and found.offset.tolist() == [1.0, 3.5]
    assert origin.tolist() == there[-1]


def test_after_the_slowest_move_identification_goes_on_with_what_that_says(heavy):
    assert module.TRIED_ROTORS == (3.0, 12.0, 48.0, 192.0)
    found, origin, moves, anew = heavy([[1, 1]] * 4)
    assert [distance for distance, *_ in moves] == [planned(3.0), planned(192.0)]
    assert len(anew) == 2 and found.inertia.tolist() == [2.0, 2.5] and origin.tolist() == (ORIGIN + 20).tolist()


def test_a_move_that_lost_steps_is_not_made_again(heavy):
    """At its highest speed a move for 12 and for 48 rotors is the one for 3; in a short travel all of them are."""
    assert planned(3.0) == planned(12.0) == planned(48.0)
    found, _, moves, anew = heavy([[0, 1], [0, 0]])
    assert [(distance, where) for distance, _, where in moves] == [
        (planned(3.0), [True, True]), (planned(192.0), [False, True])
    ]  # fmt: skip
    assert len(anew) == 1 and found.inertia.tolist() == [1.0, 2.5]
    found, _, moves, anew = heavy([[1, 1]], reach=0.1)
    assert len(moves) == len(anew) == 1 and found.inertia.tolist() == [1.0, 1.5]


@pytest.mark.parametrize("lost", [[[0, 0]], [[0, 1], [0, 0]], [[1, 1]] * 4])
def test_an_encoder_that_shows_nothing_is_told_whoever_moves_on(heavy, lost):
    with pytest.raises(RuntimeError, match="axis 0: the encoder showed 0 of"):
        heavy(lost, still=0)


@pytest.mark.parametrize(
    ("lag", "down", "lost"),
    [([511, -511], (), [0, 0]), ([513, 511], (), [1, 0]), ([0, -513], (), [0, 1]), ([0, 0], (1,), [0, 1])],
)
def test_steps_are_lost_beyond_two_full_steps_or_where_an_axis_ended_in_fault(lag, down, lost, monkeypatch):
    """Who lost steps does not swing."""
    monkeypatch.setattr(module, "device_of", lambda drives: STEPPER)
    monkeypatch.setattr(module, "read_gains", lambda drives: gains([100, 200], [250, 250]))
    monkeypatch.setattr(module, "write_profile", lambda drives, move, where: None)
    monkeypatch.setattr(module, "start", lambda drives, target, where: None)
    swung = []

    def swing(self, origin, move, where, held):
        swung.append(where.astype(int).tolist())
        return FreeSwing(np.zeros(2), np.zeros(2))

    monkeypatch.setattr(OpenLoopTrials, "_swing", swing)
    stands = np.tile(ORIGIN, (TRIAL, 1))
    ahead = stands.copy()
    ahead[40] += lag
    drives = Recorded([(stands, stands), (stands, ahead)], down)
    move = FOUR._replace(distance=np.array([9, 9]), acceleration=np.ones(2), increments=np.full(2, 51200 / (2 * np.pi)))
    made = OpenLoopTrials(drives, STEPPER_MOTOR, 1, 0.01)
    _, _, found = made._identify_by(move, ORIGIN, np.ones(2), np.ones(2, bool))
    assert found.astype(int).tolist() == lost and swung == [[1 - k for k in lost]]


def test_an_axis_that_lost_steps_is_halted_comes_to_rest_and_counts_from_there(monkeypatch):
    """What is in fault takes no halt; the others' counts stay as they were."""
    drives = Counters([0, 0, 0], [0, 0, 0])
    log, status = [], np.array([0x0637, 0x0637, 0x0238])
    read = drives.read
    drives.read = lambda name: status if name == cia402.STATUSWORD else read(name)
    drives.write = lambda name, value, *, where: log.append((name, value, where.tolist()))
    drives.advance = lambda seconds: log.append(seconds)
    monkeypatch.setattr(OpenLoopTrials, "_come_to_rest", lambda self, step: log.append(("rest", step)))
    monkeypatch.setattr(OpenLoopTrials, "recover", lambda self, where: log.append(("recover", where.tolist())))
    made = OpenLoopTrials(drives, STEPPER_MOTOR, 1, 0.01)
    made.shift()
    drives.demand, drives.encoder = np.array([700, 3000, 4000]), np.array([500, 100, 200])
    made._start_anew(np.array([False, True, True]), "step")
    assert log == [
        (cia402.CONTROLWORD, cia402.ENABLE_OPERATION | cia402.HALT, [False, True, False]), 0.02, ("rest", "step"),
        ("recover", [False, True, True]), 0.02,
    ]  # fmt: skip
    assert made._zero.tolist() == [0, 2900, 3800]


FULL = 2.0 * np.pi / 200.0  # rad, a full step


@pytest.mark.parametrize(
    ("reach", "swung"), [((1.49 * FULL, -1.51 * FULL), [False, True]), ((1.4 * FULL, -1.4 * FULL), None)]
)
def test_an_axis_without_room_of_one_and_a_half_full_steps_does_not_swing(identified, reach, swung):
    found, calls, swings = identified(([1e-6, 2e-6], [0.9, 0.9]), reach=reach)
    assert [where for where, *_ in swings] == ([] if swung is None else [swung])
    # The move to the ends of such a way is so short that even a light rotor takes little of the torque.
    assert found[0] == [RAMP, RAMP if swung is None else 2e-6] and len(calls) == (1 if swung is None else 2)


def test_an_axis_that_takes_no_part_does_not_swing(identified):
    found, _, swings = identified(([1e-6, 2e-6], [0.9, 0.9]), where=(True, False))
    assert [where for where, *_ in swings] == [[True, False]]
    assert found == [[1e-6, RAMP], [5.0, 1.0], [6.0, 2.0], [7.0, 3.0]]


@pytest.mark.parametrize(("ramp", "trusted"), [(1e-6 / 0.61, True), (1e-6 / 0.59, False)])
def test_a_swing_of_the_rotor_against_an_elastic_load_is_not_taken_for_the_inertia(identified, ramp, trusted):
    """Below 0.6 of what the ramp told the rotor swings alone, against what is elastic."""
    found, _, _ = identified(([1e-6, 1e-6], [0.9, 0.9]), ramp=ramp)
    assert found[0] == ([1e-6] * 2 if trusted else [ramp] * 2)


@pytest.mark.parametrize(
    ("share", "explained", "trusted"),
    [(0.29, 0.86, True), (0.31, 0.86, False), (0.29, 0.85, False), (0.29, 0.2, False)],
)
def test_the_swing_of_a_light_load_is_trusted_where_it_explains_what_was_seen(identified, share, explained, trusted):
    """Light is what takes less than 0.3 of the holding torque in the ramp: a heavier one's ramp says more."""
    _, _, swings = identified(([1e-6, 1e-6], [0.0, 0.0]))
    _, move, held = swings[0]
    inertia = share * held * move.increments / move.acceleration
    found, calls, _ = identified((inertia.tolist(), [explained] * 2))
    np.testing.assert_allclose(found[0], inertia if trusted else [RAMP] * 2)
    assert found[1] == ([5.0] * 2 if trusted else [1.0] * 2)
    if trusted:
        np.testing.assert_allclose(calls[-1][3], inertia)


# --- before and after a trial -----------------------------------------------------------------------------------------
def test_an_axis_that_is_on_is_switched_off_before_its_sensor_is_another(monkeypatch):
    """606Ah takes no value while an axis is enabled; one by its encoder already is left alone."""
    log = []
    monkeypatch.setattr(module, "device_of", lambda drives: SimpleNamespace(roles={}))
    monkeypatch.setattr(Trials, "recover", lambda self, where: log.append(("recover", where.tolist())))
    monkeypatch.setattr(module.motion, "disable", lambda drives, where: log.append(("off", where.tolist())))
    values = {cia402.SENSOR_SELECTION: np.array([1, 1, 0, 1]), cia402.FOLLOWING_WINDOW: np.zeros(4, int),
              cia402.STATUSWORD: np.array([0x0637, 0x0240, 0x0637, 0x0637])}  # fmt: skip
    drives = SimpleNamespace(
        num_axes=4, time_waits=True, read=lambda name: values[name],
        write=lambda name, value, where=None: log.append((name, value, where.tolist())),
    )  # fmt: skip
    trials = OpenLoopTrials(drives, STEPPER_MOTOR, 1, 0.01)
    trials.recover(np.array([True, True, True, False]))
    assert log == [
        ("off", [True, False, False, False]),
        (cia402.SENSOR_SELECTION, 0, [True, True, False, False]),
        ("recover", [True, True, True, False]),
    ]
    log.clear()
    values[cia402.STATUSWORD][:] = 0x0240
    trials.recover(np.array([True, False, False, False]))
    assert log[0] == (cia402.SENSOR_SELECTION, 0, [True, False, False, False]) and len(log) == 2
    monkeypatch.setattr(Trials, "power_up", lambda self, where: log.append(("on", where.tolist())))
    log.clear()
    values[cia402.FOLLOWING_WINDOW] = np.array([0, 9, 0, 9])  # drives that were switched on have theirs again
    trials.power_up(np.array([True, False, False, True]))
    assert log == [
        (cia402.SENSOR_SELECTION, 0, [True, False, False, True]),
        (cia402.FOLLOWING_WINDOW, 0, [False, True, False, True]),
        ("on", [True, False, False, True]),
    ]


@pytest.mark.parametrize(("device", "current"), [("tmcm3313", True), ("tmcm6212", False)])
@pytest.mark.parametrize(
    ("waits", "status", "mapped"),
    [(False, (0x0240, 0x0238), True), (False, (0x0240, 0x0637), False), (True, (0x0240, 0x0238), False)],
)
def test_what_trials_record_is_mapped_in_real_time_before_any_axis_is_enabled(
    device, current, waits, status, mapped, monkeypatch
):
    log = []
    known = find_device(device)
    monkeypatch.setattr(module, "device_of", lambda drives: known)
    monkeypatch.setattr(Trials, "recover", lambda self, where: log.append("enable"))
    drives = SimpleNamespace(
        num_axes=2, time_waits=waits, record=lambda objects, seconds: log.append((objects, seconds)),
        read=lambda name: np.array(status) if name == cia402.STATUSWORD else np.zeros(2, int),
        write=lambda name, value, *, where: None,
    )  # fmt: skip
    OpenLoopTrials(drives, STEPPER_MOTOR, 1, 0.01).recover(np.array([True, True]))
    objects = [cia402.POSITION_ACTUAL, cia402.POSITION_DEMAND, cia402.STATUSWORD]
    expected = [*objects, cia402.TORQUE_ACTUAL] if current else objects  # of its closed loop's trials
    assert log == [*([(expected, 0.0)] if mapped else []), "enable"]


@pytest.mark.parametrize(("way", "waits"), [(63, 1), (64, LONGEST_ROLL), (-64, LONGEST_ROLL)])
def test_a_rotor_that_moves_by_less_than_a_quarter_of_a_full_step_in_20_ms_is_at_rest(way, waits):
    waited, at = [], [0]

    def read(name):
        at[0] += way if waited else 0
        return np.array([0, len(waited) * way])

    drives = SimpleNamespace(read=read, num_axes=2, advance=waited.append)
    OpenLoopTrials(drives, STEPPER_MOTOR, 1, 0.01)._come_to_rest(np.full(2, 256.0))
    assert waited == [0.02] * waits


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
    assert np.abs(safe[:, 2] - rule[:, 2] / 6).max() <= 1
    assert np.abs(safe[:, 3] - rule[:, 3] / 6).max() <= 1
    assert np.abs(safe[:, 4] - rule[:, 4] / 12).max() <= 1
    assert SAFE_RULE.speed < 0.1


def test_what_a_trial_cannot_tell_apart_is_refused():
    check_tried(SERVO, ("velocity_p",))
    with pytest.raises(ValueError, match="give different ones of gain"):
        check_tried(SERVO, ())
    check_tried(STEPPER, ("run_current", "standby_current"))
    with pytest.raises(ValueError, match="run_current: trials of correction_velocity_p close the loop"):
        check_tried(STEPPER, ("run_current", "correction_velocity_p"))
    with pytest.raises(
        ValueError, match="run_current: trials of the load detection and of CoolStep show what stall_th"
    ):
        check_tried(STEPPER, ("run_current", "coolstep_up"))
    with pytest.raises(
        ValueError, match="correction_tolerance: a trial of an open-loop stepper shows what the phase currents do, run"
    ):
        check_tried(STEPPER, ("run_current", "correction_tolerance"))
    none = SimpleNamespace(
        name="none",
        gains=SimpleNamespace(
            outer=(), columns=lambda names: (), loop_of=lambda names: None, closed_loops=(), is_open_loop=False, rows=()
        ),
    )
    with pytest.raises(ValueError, match="none has no gains of a velocity or position loop and no phase currents"):
        check_tried(none, ())
    check_tried(none, ("anything",))


def test_the_times_of_a_cascade_are_four_times_its_small_time_constants():
    """1/(2 pi 1000 Hz) + 1.5 of 40 us + 1.4/(2 pi 400 Hz) + 200 us."""
    small = 1.0 / (2.0 * np.pi * 1000.0) + 60e-6 + 1.4 / (2.0 * np.pi * 400.0) + 200e-6
    assert method_of(SERVO, SERVO_MOTOR).t_0() == pytest.approx(4.0 * small, rel=1e-3)


@pytest.mark.parametrize("name", ["tmcm1636", "tmcm6212"])
def test_a_move_is_planned_for_what_was_identified_within_what_the_drive_takes(name):
    device = find_device(name)
    motor = find_motor(device.default_motor)
    light = Identified(np.array([1.01 * motor.inertia, 40.0 * motor.inertia]), *np.zeros((3, 2)))
    reach = np.array([100.0, -1.0])
    found = method_of(device, motor).plan(light, 51_200, reach)
    expected = plan_move(motor, light.inertia, 51_200, reach, highest_ramp(device))
    assert found.distance.tolist() == expected.distance.tolist()
    assert found.acceleration.tolist() == expected.acceleration.tolist()


@pytest.mark.parametrize(
    ("device", "gains", "kind"),
    [
        ("tmcm1636", (), "RobustScore"), ("tmcm6212", (), "OpenLoopScore"),
        ("tmcm3313", ("run_current",), "OpenLoopScore"),
        ("tmcm3313", ("correction_velocity_p",), "ClosedLoopScore"), ("tmcm3313", ("pid_p",), "PidScore"),
    ],
)  # fmt: skip
def test_which_score_gains_of_a_device_have(device, gains, kind, monkeypatch):
    made = []

    def noted(name):
        return lambda *arguments, **options: made.append((name, arguments, options)) or name

    for place, name in (
        ("method", "RobustScore"), ("open_loop_score", "OpenLoopScore"), ("closed_loop_score", "ClosedLoopScore"),
        ("position_pid_score", "PidScore"),
    ):  # fmt: skip
        monkeypatch.setattr(f"drive_env.trials.{place}.{name}", noted(name))
    assert new_score(device, "load", "motor", 3, gains=gains, repeats=2) == kind
    ((name, arguments, options),) = made
    assert name == kind and arguments == (device, "load", "motor", 3) and options["repeats"] == 2
    assert ("loop" in options) == (kind == "PidScore") and (kind != "PidScore" or options["loop"].mode == 2)


def test_gains_of_no_loop_close_none():
    known = STEPPER
    assert type(method_of(known, STEPPER_MOTOR, ("run_current",))) is OpenLoop
    with pytest.raises(
        ValueError, match="run_current: trials of correction_velocity_p close the loop at the motor's rat"
    ):
        check_tried(known, ("correction_velocity_p", "run_current"))
    with pytest.raises(
        ValueError, match=r"shows what the phase currents do, run_current, standby_current, and with its lo"
    ):
        check_tried(known, ("correction_tolerance",))


@pytest.mark.parametrize("name", ["tmcm3313", "tmcm6212"])
def test_load_detection_and_coolstep_have_a_method_of_their_own(name):
    device = find_device(name)
    for names in (("coolstep_up",), ("stall_threshold", "coolstep_lower")):
        check_tried(device, names)
        assert type(method_of(device, STEPPER_MOTOR, names)) is LoadSettings
    with pytest.raises(ValueError, match="of the load detection and of CoolStep show what stall_threshold, coolstep_l"):
        check_tried(device, ("coolstep_up", "standby_current"))


def test_a_load_detection_that_cannot_be_set_is_not_tried():
    deaf = STEPPER._replace(roles={})
    with pytest.raises(ValueError, match="tmcm3313: the load detection of this drive cannot be set: it has no "):
        check_tried(deaf, ("stall_threshold",))
