"""Tuning of the TMCM-3313: its currents and load detection in open loop, and the gains of its closed loop."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rigs.commands import drive_tune

from drive_env import EmulatedDrives, cia402, motion
from drive_env.devices import find_device
from drive_env.devices.gain_set import LOAD_ANGLE, PID_ALONE, PID_ON_RAMP
from drive_env.dictionary.roles import Role
from drive_env.emulator.inertia_check import MisfitWarning
from drive_env.envs.gain_tuning import GainTuning
from drive_env.firmware.stepper_loop.fields import PARAMETERS
from drive_env.motors import MOTORS
from drive_env.phase_current import holding_torque, rated_setting
from drive_env.trials.closed_loop import BEHIND, OVERLOAD, full_step, held_in_trial, plan_overload
from drive_env.trials.gain_trial import Identified
from drive_env.trials.method import check_tried
from drive_env.trials.open_loop import unmeasured
from drive_env.trials.position_pid import CLOCK, load_step_error
from drive_env.trials.positioning import plan_move, start, write_profile
from tuning.runs.experiment import ExperimentError, SweptObject, load_experiment, resolve
from tuning.runs.metrics import MoveRecording, figures, tracking
from tuning.runs.sweep import _close_loop, run
from tuning.runs.sweep_files import save_sweep
from tuning.search.optimise import Settings, optimise
from tuning.search.trial_bench import TrialBench
from tuning.target import emulated

NAME = "qsh4218_51"
MOTOR = MOTORS[NAME]
DEVICE = find_device("tmcm3313")


# --- open loop --------------------------------------------------------------------------------------------------------
def test_its_load_detection_is_that_of_the_tmcm6212_row_by_row():
    """Sections 4.2.45 to 4.2.51 of its manual; the objects are shared."""
    rows = [row for row in DEVICE.gains.rows if row.loop in ("load detection", "CoolStep")]
    assert rows == [row for row in find_device("tmcm6212").gains.rows if row.loop in ("load detection", "CoolStep")]
    dictionary = DEVICE.new_dictionary()
    for row in rows:
        entry = dictionary.find(row.key)
        assert (entry.low, entry.high) == (row.lowest, row.highest)


@pytest.mark.slow
def test_a_sweep_of_two_currents_has_a_point_for_each_pair(tmp_path):
    shown = drive_tune("sweep", "--device", "tmcm3313", "--load", "inertia", "--show-config").output
    grid = shown[shown.index("[[sweep]]") : shown.index("[excitation]")]
    pair = "".join(
        f'[[sweep]]\nobject = "{name}"\nlow = 63\nhigh = 95\ncount = 2\nspacing = "lin"\n\n'
        for name in ("run_current", "standby_current")
    )
    config = tmp_path / "two.toml"
    config.write_text(shown.replace(grid, pair), encoding="utf-8")
    result = drive_tune("sweep", "--config", config, "--device", "tmcm3313", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    lines = (tmp_path / "out" / "results.csv").read_text(encoding="utf-8").splitlines()
    assert lines[0].startswith("2003h:00,2004h:00,")
    assert [line.split(",")[:2] for line in lines[1:]] == [["63", "63"], ["63", "95"], ["95", "63"], ["95", "95"]]
    assert "in open loop 6077h is the size of the current" in result.output
    assert unmeasured(find_device("tmcm6212")) == "no 6077h"


@pytest.mark.slow
def test_optimise_finds_currents_of_three_axes_again_to_the_digit():
    settings = Settings(trials=4, seed=3)
    found = []
    for _ in range(2):
        with emulated("tmcm3313", "portal", NAME, num_threads=1) as target:
            found.append(optimise(target, settings, anew=True))
    one, other = found
    assert [row.cost for row in one.rows] == [row.cost for row in other.rows]
    assert len({row.cost for row in one.rows}) > 1, "the currents are told apart"
    assert one.gains.shape == (3, DEVICE.gains.count)
    assert np.all(one.gains[:, :2] <= rated_setting(DEVICE, MOTOR))
    assert one.cost[0] <= one.rows[0].cost, "the first is the rule"
    assert np.array_equal(one.gains[:, 2:], one.rule[:, 2:]), "what is no current is left as it was"


def test_an_episode_of_gain_tuning():
    env = GainTuning(device="tmcm3313", motor=NAME, load="inertia", trials=3, num_threads=1)
    try:
        observation, info = env.reset(seed=1)
        first, rule, ended, costs = info["robust_cost"].copy(), info["gains"].copy(), False, []
        while not ended:
            observation, _, terminated, truncated, info = env.step(np.array([[-0.2, 0.2]]))
            assert not terminated.any() and env.observation_space.contains(observation)
            costs.append(float(info["trial_robust_cost"][0]))
            ended = bool(truncated[0])
        # A lower run current and a higher standby current may cost the same in one of the trials.
        assert len(costs) == 3 and max(abs(cost / first[0] - 1.0) for cost in costs) > 0.02, "the currents change it"
        tried = info["trial_gains"][0, 0] - rule[0, 0]
        assert tried[0] < 0 < tried[1] and not tried[2:].any(), "what is no current stays"
    finally:
        env.close()


@pytest.mark.slow
def test_auto_commissions_and_certifies_load_detection_and_closed_loop(tmp_path, monkeypatch):
    result = drive_tune("auto", "--device", "tmcm3313", "--motor", NAME, "--load", "inertia", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    axis = json.loads((tmp_path / "out" / "stepper-certificate.json").read_text(encoding="utf-8"))["axes"][0]
    assert axis["verdict"] == "accepted" and axis["figures"]["teeth lost at an obstacle"] == 0
    assert axis["after"]["coolstep_lower"] > 0
    assert axis["figures"]["current saved by CoolStep, by the load angle [%]"] > 5
    by_table, tuned = (axis["figures"][f"J of the closed loop, {how}"] for how in ("by commissioning", "tuned"))
    assert tuned < by_table
    assert any(axis["after"][name] != axis["before"][name] for name in LOOP_GAINS)


@pytest.mark.slow
def test_gains_that_won_by_noise_are_not_kept(tmp_path, monkeypatch):
    """A search that praises a tenth of the commissioned gains: in trials that are made again they are no better."""

    def praise(target, settings):
        bench = TrialBench(target, gains=settings.gains)
        bench.identify()
        gains = target.device.gains.scaled(bench.rule, 0.1, target.device.gains.columns(settings.gains))
        bench.leave(gains)
        return SimpleNamespace(gains=gains, cost=np.array([0.0]), rows=(), rule=gains)

    monkeypatch.setattr("tuning.stepper.closed_loop.optimise", praise)
    result = drive_tune("auto", "--device", "tmcm3313", "--motor", NAME, "--load", "inertia", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    axis = json.loads((tmp_path / "out" / "stepper-certificate.json").read_text(encoding="utf-8"))["axes"][0]
    assert axis["verdict"] == "accepted with reservations"
    assert axis["figures"]["J of the closed loop, tuned"] is None
    assert axis["figures"]["J of the closed loop, by commissioning"] > 1.0
    assert all(axis["after"][name] == axis["before"][name] for name in LOOP_GAINS)
    assert "none of 24 others that were tried was better" in result.output


@pytest.mark.slow
def test_a_closed_loop_whose_every_trial_is_stopped_is_not_certified(tmp_path, monkeypatch):
    """The axis is, with its loop open; a J of stopped trials is no figure."""

    class Stopped(TrialBench):
        def run(self, gains):
            tried = super().run(gains)
            return tried._replace(aborted=np.ones_like(tried.aborted))

    def search(target, settings):
        bench = TrialBench(target, gains=settings.gains)
        bench.identify()
        bench.leave(bench.rule)
        return SimpleNamespace(gains=bench.rule, cost=np.array([0.0]), rows=(), rule=bench.rule)

    monkeypatch.setattr("tuning.stepper.closed_loop.optimise", search)
    monkeypatch.setattr("tuning.stepper.closed_loop.TrialBench", Stopped)
    result = drive_tune("auto", "--device", "tmcm3313", "--motor", NAME, "--load", "inertia", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    axis = json.loads((tmp_path / "out" / "stepper-certificate.json").read_text(encoding="utf-8"))["axes"][0]
    assert axis["verdict"] == "accepted with reservations"
    assert [axis["figures"][f"J of the closed loop, {how}"] for how in ("by commissioning", "tuned")] == [None, None]
    assert "the closed loop is not certified: its trials were stopped" in " ".join(axis["reservations"])
    assert "leave it open (2020h:00 = 0)" in " ".join(axis["reservations"])


def test_trials_of_currents_open_a_closed_loop_and_give_it_back():
    """With it closed the difference of demand and encoder is a following error, and no load angle."""
    with emulated("tmcm3313", "inertia", NAME, num_threads=1) as target:
        drives = target.drives
        drives.write(cia402.SENSOR_SELECTION, 0)
        motion.enable(drives, mode="pp")
        drives.write(Role.LOOP_MODE, 1)
        drives.advance(3.2)
        assert drives.read(Role.LOOP_INITIALISED).all()
        motion.disable(drives)
        bench = TrialBench(target)
        bench.identify()
        assert not drives.read(Role.LOOP_INITIALISED).any() and not drives.read(Role.LOOP_MODE).any()
        bench.leave(bench.rule)
        assert np.all(drives.read(Role.LOOP_MODE) == 1)


@pytest.mark.parametrize(
    ("names", "remedy"),
    [
        (("stall_threshold", "run_current"), "search the others by themselves"),
        (("correction_velocity_p", "run_current"), "search the others by themselves"),
    ],
)
def test_what_trials_do_not_show_is_refused_before_anything_moves(names, remedy):
    with emulated("tmcm3313", "inertia", NAME, num_threads=1) as target:
        with pytest.raises(ValueError, match=rf"{names[-1]}: .*{remedy}"):
            optimise(target, Settings(trials=1, gains=names))
        assert not cia402.matches(target.drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED).any()
    with pytest.raises(ValueError, match=rf"{names[-1]}: .*{remedy}"):
        GainTuning(device="tmcm3313", motor=NAME, load="inertia", gains=names)


# --- closed loop ------------------------------------------------------------------------------------------------------
def closed_experiment(*swept, **excitation):
    shipped = load_experiment(closed_loop=LOAD_ANGLE)
    return replace(shipped, sweep=swept, excitation=replace(shipped.excitation, **excitation))


def test_gains_of_the_closed_loop_are_told_apart_where_the_motor_is_overloaded(tmp_path):
    """A ramp that is too steep: with more P, and with more I, the axis is behind for less time."""
    result = run(
        closed_experiment(
            SweptObject("correction_velocity_p", 1000, 10000, 2, "lin"),
            SweptObject("202C:00", 20, 400, 2, "lin"),
        ),
        num_threads=1,
    )  # fmt: skip
    assert result.objects == ("202Bh:00", "202Ch:00") and not result.columns["fault"].any()
    behind = result.columns["behind [s]"].reshape(2, 2)
    assert behind[1, 0] < 0.8 * behind[0, 0] and behind[0, 1] < 0.8 * behind[0, 0]
    assert result.best(1)[0]["202Bh:00"] == 10000
    assert np.all(result.columns["following [full steps]"] > 2.0), "in open loop the steps would be lost"
    assert np.all(result.columns["rms_current [A]"] < MOTOR.rated_current)
    folder = save_sweep(result, tmp_path / "closed")
    again = run(load_experiment(folder / "settings.toml"), num_threads=1)
    assert np.array_equal(again.score, result.score)


def test_tracking_in_closed_loop_is_its_formula():
    """480 rpm are 1600 full steps/s; 40 of them behind in the step, 8 under load, a ripple of 0.1 A of 1 A."""
    t = np.arange(0.0, 0.4, 0.001)
    n = len(t)
    recording = MoveRecording(
        t, np.where(t < 0.02, 0.0, 480.0), np.full((n, 1), 480.0), 0.05 * (-1.0) ** np.arange(n)[:, None],
        np.array([1.0]), 0.02, 0.2, np.where(t < 0.2, 40.0, 8.0)[:, None], None, np.array([200.0]),
    )  # fmt: skip
    found = figures(recording)
    score = tracking(found, {"step": 1.0, "disturbance": 2.0, "ripple": 0.005})
    step = (180 * 40.0 + 8.0) / 181  # the step's window has the first sample under load, too
    assert score[0] == pytest.approx(step / 1600.0 + 2.0 * 8.0 / 1600.0 + 0.005 * 0.1)


def test_a_ramp_within_the_motors_torque_shows_no_gain_of_the_closed_loop():
    swept = (SweptObject("correction_velocity_p", 300, 30000, 2, "lin"),)
    result = run(closed_experiment(*swept, acceleration_rpm_per_s=3000.0, velocity_rpm=120.0), num_threads=1)
    assert result.columns["following [full steps]"].max() < 1.0
    assert len(set(result.score)) == 1 and result.without_effect() == ["202Bh:00"]


@pytest.mark.parametrize(("rotors", "acts"), [(5, False), (30, False), (100, True)])
def test_why_trials_of_the_closed_loop_overload_the_motor(rotors, acts):
    """In the move of a servo's trial its gains do nothing at the rated current where the motor is not overloaded."""
    values = [300, 3000, 30000]
    heavy = {"load.inertia": rotors * MOTOR.inertia}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MisfitWarning)
        drives = EmulatedDrives("tmcm3313", "inertia", NAME, num_machines=3, distinct=1, parameters=heavy)
    with drives:
        drives.write(cia402.SENSOR_SELECTION, 0)
        motion.enable(drives, mode="pp")
        assert not _close_loop(drives, DEVICE.gains.loop_of_kind(LOAD_ANGLE)).any()
        scale = drives.read(Role.POSITION_SCALE)
        move = plan_move(MOTOR, np.full(3, (rotors + 1) * MOTOR.inertia), scale, np.full(3, 20.0))
        write_profile(drives, move)
        drives.write(DEVICE.gains.keys[DEVICE.gains.names.index("correction_velocity_p")], values)
        start(drives, drives.read(cia402.POSITION_ACTUAL) + move.distance)
        trace = drives.record([cia402.POSITION_ACTUAL], 0.25)[cia402.POSITION_ACTUAL]
    assert bool(np.any(trace != trace[:, :1])) is acts


LOOP_GAINS = ("correction_velocity_p", "correction_velocity_i", "correction_velocity_limit", "correction_position_p")


@pytest.mark.parametrize("rotors", [3.0, 6.0, 20.0])
def test_the_ramp_of_a_trial_leaves_every_axis_behind(rotors):
    """By BEHIND full steps by the plan's formula, at the run current of the trial; friction adds to it."""
    zero = np.zeros(1)
    found = Identified(np.array([rotors * MOTOR.inertia]), zero, zero, zero)
    move = plan_overload(DEVICE, MOTOR, found, 51200.0, np.array([30.0]))
    held = held_in_trial(DEVICE, MOTOR, np.asarray(move.share))
    speed, ramp = move.velocity / move.increments, move.acceleration / move.increments
    assert ramp == pytest.approx(OVERLOAD * held / found.inertia, rel=1e-3)
    behind = found.inertia * speed**2 / (2.0 * held) * (1.0 - 1.0 / OVERLOAD) / full_step(MOTOR)
    assert behind == pytest.approx(BEHIND, rel=0.01)
    profile = move.distance / move.increments / speed + speed / ramp
    assert 0.0599 < profile <= 0.0601 or speed == pytest.approx(0.5 * ramp * 0.06, rel=1e-3)
    assert (float(move.share[0]) == 1.0) is (rotors > 10.0), "a light load is overloaded by less current"
    short = plan_overload(DEVICE, MOTOR, found, 51200.0, np.array([-1.0]))
    assert short.distance / short.increments == pytest.approx(-0.4, rel=1e-3) and short.velocity < move.velocity


def test_trials_of_the_closed_loop_tell_its_gains_apart_and_give_the_loop_back():
    with emulated("tmcm3313", "inertia", NAME, num_machines=3, num_threads=1, distinct=1) as target:
        drives = target.drives
        bench = TrialBench(target, gains=LOOP_GAINS)
        bench.identify()
        assert drives.read(Role.LOOP_INITIALISED).all()
        gains = bench.rule.copy()
        gains[:, DEVICE.gains.names.index("correction_velocity_p")] = [30, 3000, 10000]
        tried = bench.run(gains)
        assert not tried.aborted.any()
        assert tried.cost[0] > tried.cost[1] > tried.cost[2] + 0.05
        bench.leave(gains)
        assert np.array_equal(DEVICE.gains.read(drives), gains), "the run current of the trial was for it alone"
        assert not drives.read(Role.LOOP_MODE).any()
        assert np.all(drives.read(cia402.FOLLOWING_WINDOW) != 0)


def test_an_axis_whose_loop_does_not_close_is_stopped_in_its_trial(monkeypatch):
    monkeypatch.setattr("drive_env.trials.closed_loop.LONGEST_CLOSING", 0.1)
    with emulated("tmcm3313", "inertia", NAME, num_threads=1) as target:
        bench = TrialBench(target, anew=True, gains=LOOP_GAINS)
        bench.identify()
        assert bench.run(bench.rule).aborted.all()


def test_gain_tuning_and_its_robust_cost_tell_gains_of_the_closed_loop_apart():
    env = GainTuning(device="tmcm3313", motor=NAME, load="inertia", trials=2, num_threads=1, gains=LOOP_GAINS[:2],
                     distributions={"parameters": {}})  # fmt: skip
    try:
        _, info = env.reset(seed=1)
        rule = float(info["robust_cost"][0])
        _, _, _, _, info = env.step(np.array([[-1.0, -1.0]], np.float32))
        slow = float(info["trial_robust_cost"][0])
        assert slow > 1.05 * rule and info["trial_measured"][0] != info["measured"][0] and slow < 30.0
        tried = info["trial_gains"][0, 0]
        assert tried[3:5].tolist() == [1490, 10] and tried[0] == rated_setting(DEVICE, MOTOR)
    finally:
        env.close()


def test_an_axis_whose_loop_does_not_close_counts_as_one_in_fault(monkeypatch):
    """Here the time is too short for the rotor to swing in."""
    monkeypatch.setattr("tuning.runs.sweep.CLOSING_TIME", 0.1)
    result = run(closed_experiment(SweptObject("correction_velocity_p", 3000, 3000, 1, "lin")), num_threads=1)
    assert result.columns["fault"].all() and np.isinf(result.score).all()


# --- position PID -----------------------------------------------------------------------------------------------------
def pid_loop(kind=PID_ON_RAMP):
    return DEVICE.gains.loop_of_kind(kind)


def test_a_search_of_the_pid_begins_with_table_3_of_the_manual():
    """Section 1.6.3; 2022h alone is another: table 3's 255 is a full step, within which nothing is corrected."""
    table = {0x202B: 8000, 0x202C: 500, 0x202D: 400, 0x202E: 2, 0x202F: 400_000, 0x2021: 10_000, 0x2022: 8}
    for kind, mode in ((PID_ON_RAMP, 2), (PID_ALONE, 3)):
        loop = pid_loop(kind)
        objects = {DEVICE.gains.keys[DEVICE.gains.columns([name])[0]]: value for name, value in loop.first.items()}
        assert objects == {(index, 0): value for index, value in table.items()}
        assert loop.mode == mode and loop.first.keys() == loop.gains.keys()


def test_names_of_two_loops_are_refused_and_one_object_has_a_name_in_each():
    known = DEVICE.gains
    assert len({int(known.columns([name])[0]) for name in ("correction_position_p", "pid_d", "pid_v0_d")}) == 1
    assert known.loop_of(("pid_p", "pid_d")).mode == 2 and known.loop_of(("pid_v0_p",)).mode == 3
    assert known.loop_of(("correction_position_p",)).mode == 1 and known.loop_of(("run_current",)) is None
    for names in (("pid_p", "pid_v0_i"), ("pid_p", "correction_velocity_i")):
        with pytest.raises(ValueError, match="gains of different loops"):
            check_tried(DEVICE, names)
    with pytest.raises(ValueError, match="different ones"):
        known.columns(("pid_p", "correction_velocity_p"))
    with pytest.raises(ValueError, match="different loops"):
        GainTuning(device="tmcm3313", load="inertia", gains=("pid_p", "pid_v0_i"))


VARIED = {"p": (4000, 30_000), "i": (1, 8000), "d": (1, 100_000), "limit": (2000, 400_000), "tolerance": (255, 1),
          "divider": (200, 2)}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("prefix", "without"),
    [
        ("pid", ()),
        # A motion that the PID makes alone needs the sum, too.
        ("pid_v0", (("sum_limit", (2, 400)),)),
    ],
)
def test_trials_tell_each_gain_of_the_pid_apart(prefix, without):
    """Each of them alone is another than table 3's, and J of a trial is, too; what oscillates or slips is stopped."""
    rows = [(name, value) for name, values in (*VARIED.items(), *without) for value in values]
    names = tuple(f"{prefix}_{name}" for name in VARIED)
    with emulated("tmcm3313", "inertia", NAME, num_machines=len(rows) + 1, num_threads=1, distinct=1) as target:
        bench = TrialBench(target, anew=True, gains=names)
        bench.identify()
        gains = bench.rule.copy()
        for machine, (name, value) in enumerate(rows, 1):
            gains[machine, DEVICE.gains.columns([f"{prefix}_{name}"])[0]] = value
        tried = bench.run(gains)
        assert not tried.aborted[0]
        cost = {(name, value): float(tried.cost[k]) for k, (name, value) in enumerate(rows, 1)}
        unlike = {name for name, value in rows if abs(cost[name, value] - float(tried.cost[0])) > 0.02}
        assert unlike == {name for name, _ in rows}
        stopped = {row for k, row in enumerate(rows, 1) if tried.aborted[k]}
        assert {("p", 30_000), ("d", 100_000), ("divider", 200)} <= stopped
        bench.leave(gains)
        assert np.array_equal(DEVICE.gains.read(target.drives), gains)
        assert not target.drives.read(Role.LOOP_MODE).any() and np.all(target.drives.read(cia402.FOLLOWING_WINDOW) != 0)


def test_what_a_load_step_costs_a_pid_follows_from_its_gains():
    """Closed forms: P alone lets e decay with 256 / P, within 2022h it stays, and 202Fh takes it away evenly."""
    loop, columns = pid_loop(), dict(zip(pid_loop().gains, DEVICE.gains.columns_of_loop(pid_loop()), strict=True))
    gains = np.tile(DEVICE.gains.lowest, (4, 1))
    for name, values in {
        "pid_p": [8000, 8000, 8000, 8000],
        "pid_limit": [10**6, 10**6, 10**6, 100],
        "pid_tolerance": [1, 100, 1, 1],
        "pid_d": [1, 1, 125_000 // 2, 1],
        "pid_divider": [1, 1, 2, 1],
    }.items():
        gains[:, columns[name]] = values
    found = load_step_error(DEVICE, MOTOR, loop, gains)
    held = float(holding_torque(MOTOR, MOTOR.rated_current))
    away = np.arcsin(0.3 * MOTOR.rated_torque / held) / (np.pi / 2.0) * 256.0
    tau = 256.0 / 8000.0
    decays = away * tau * (1.0 - np.exp(-0.1 / tau))
    slower = away * 2.0 * tau * (1.0 - np.exp(-0.1 / (2.0 * tau)))  # D of 1 halves the speed
    assert found == pytest.approx([decays, 0.1 * away, slower, 0.1 * away - 0.5 * 100 * 0.1**2], rel=0.01)
    assert next(field.initial for field in PARAMETERS if field.name == "motion_clock") == CLOCK


def test_what_a_load_step_costs_a_pi_is_that_of_a_second_order():
    """e'' + P e' + I e = 0 from e and -P e; P is 202Bh / 256, I is 202Ch f / 2^23 (TMC4361 data sheet)."""
    loop, columns = pid_loop(), dict(zip(pid_loop().gains, DEVICE.gains.columns_of_loop(pid_loop()), strict=True))
    gains = np.tile(DEVICE.gains.highest, (1, 1))
    for name, value in {"pid_p": 20_000, "pid_i": 500, "pid_tolerance": 0, "pid_d": 0, "pid_divider": 1}.items():
        gains[:, columns[name]] = value
    p, i = 20_000 / 256.0, 500 * 16e6 / 2.0**23
    fast, slow = np.roots([1.0, p, i])
    t = np.arange(0.0, 0.1, 1e-6)
    share = (p + slow) / (slow - fast)  # of the fast part, by e' = -P e at first
    e = share * np.exp(fast * t) + (1.0 - share) * np.exp(slow * t)
    assert e[0] == pytest.approx(1.0) and (e[1] - e[0]) / 1e-6 == pytest.approx(-p, rel=0.01)
    held = float(holding_torque(MOTOR, MOTOR.rated_current))
    away = np.arcsin(0.3 * MOTOR.rated_torque / held) / (np.pi / 2.0) * 256.0
    assert load_step_error(DEVICE, MOTOR, loop, gains) == pytest.approx([away * np.abs(e).sum() * 1e-6], rel=0.02)


def test_optimise_finds_gains_of_the_pid_and_leaves_the_loop_as_it_was():
    with emulated("tmcm3313", "inertia", NAME, num_threads=1) as target:
        found = optimise(target, Settings(trials=6, seed=1, gains=("pid_p", "pid_i")), anew=True)
        assert found.cost[0] <= found.rows[0].cost and len({row.cost for row in found.rows}) > 3
        columns = DEVICE.gains.columns(("pid_p", "pid_i"))
        others = np.delete(found.gains[0], columns), np.delete(found.rule[0], columns)
        assert np.array_equal(*others) and not target.drives.read(Role.LOOP_MODE).any()


@pytest.mark.every(2)
@pytest.mark.parametrize(("prefix", "slow"), [("pid", 1.1), ("pid_v0", 1.3)])
def test_gain_tuning_and_its_robust_cost_tell_gains_of_the_pid_apart(prefix, slow):
    env = GainTuning(device="tmcm3313", motor=NAME, load="inertia", trials=2, num_threads=1,
                     gains=(f"{prefix}_p", f"{prefix}_i"), distributions={"parameters": {}})  # fmt: skip
    try:
        _, info = env.reset(seed=1)
        rule = float(info["robust_cost"][0])
        assert 1.0 < rule < 30.0
        _, _, _, _, info = env.step(np.array([[-1.0, 0.0]], np.float32))
        assert float(info["trial_robust_cost"][0]) > slow * rule, "less P resists a load less"
        assert info["trial_gains"][0, 0, DEVICE.gains.columns([f"{prefix}_p"])[0]] == 3973
    finally:
        env.close()


@pytest.mark.slow
def test_a_sweep_of_the_pid_measures_no_current_and_says_so(tmp_path):
    shipped = load_experiment(closed_loop=PID_ON_RAMP)
    few = replace(shipped, sweep=(replace(shipped.sweep[0], count=3), replace(shipped.sweep[1], count=2)))
    config = tmp_path / "pid.toml"
    config.write_text(few.to_toml({}), encoding="utf-8")
    said = drive_tune("sweep", "--config", config, "--out", tmp_path / "out")
    assert said.exit_code == 0, said.output
    assert "No torque current is measured (a PID does not commutate" in said.output
    result = run(load_experiment(tmp_path / "out" / "settings.toml"), num_threads=1)
    assert result.objects == ("202Bh:00", "202Ch:00")
    assert not {"ripple [A]", "peak_current [A]", "rms_current [A]"} & result.columns.keys()
    usable = (result.score < np.inf).reshape(3, 2)
    assert usable[:2].all() and not usable[2].any(), "P = 32000 makes the rotor swing in its field"
    behind = result.columns["behind [s]"].reshape(3, 2)
    assert behind[0, 1] < 0.8 * behind[0, 0], "the I part takes away what the load turns the rotor by"


def test_a_sweep_by_objects_closes_the_first_loop_in_which_they_act():
    shipped = load_experiment(closed_loop=PID_ON_RAMP)
    for objects, mode in ((("202B:00",), 1), (("202D:00",), 2), (("pid_v0_p", "202C:00"), 3), (("run_current",), None)):
        swept = tuple(SweptObject(name, 10, 100, 2, "lin") for name in objects)
        metric = replace(shipped.metric, name="settling", weights={})
        loop = resolve(replace(shipped, sweep=swept, metric=metric)).loop
        assert (None if loop is None else loop.mode) == mode
    two = tuple(SweptObject(name, 10, 100, 2, "lin") for name in ("pid_p", "pid_v0_i"))
    with pytest.raises(ExperimentError, match="gains of different loops"):
        resolve(replace(shipped, sweep=two))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--device", "tmcm6212"), "tmcm6212 has no loop to close"),
        (("--pid",), "give one of them"),
        (("--device", "tmcm1636"), "tmcm1636 has no loop to close"),
        (("--config", "my.toml"), "leave them out with --config"),
    ],
)
def test_a_loop_that_cannot_be_closed_is_refused_with_the_reason(arguments, said, tmp_path):
    result = drive_tune("sweep", "--closed-loop", *arguments, "--out", tmp_path / "out")
    assert result.exit_code != 0 and said in result.output and "Traceback" not in result.output
