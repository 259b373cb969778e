"""Trials of an open-loop stepper's currents: what is identified by the load angle, J, sweep, search and environment."""

from __future__ import annotations

import csv
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from rigs.commands import drive_tune
from rigs.stepper_rig import BARE

from drive_env import cia402
from drive_env.devices import find_device
from drive_env.dictionary.roles import Role
from drive_env.envs.gain_tuning import GainTuning
from drive_env.motors import MOTORS
from drive_env.phase_current import (
    RESERVE,
    amplitude,
    current_for,
    holding_torque,
    rated_setting,
    setting_of,
    swing_period,
)
from drive_env.trials.method import OpenLoop, check_tried, method_of
from drive_env.trials.open_loop import OpenLoopTerms, open_loop_cost
from drive_env.trials.score import STEPPER_VARIANTS, VARIANTS
from tuning.search.optimise import Settings, optimise
from tuning.search.trial_bench import TrialBench
from tuning.target import emulated

NAME = "qsh4218_51"
MOTOR = MOTORS[NAME]
QUIET = {"motor.coulomb": 0.0, "load.coulomb": 0.0, "load.breakaway": 0.0}


@pytest.fixture(scope="module")
def stepper(tmp_path_factory):
    """The bare drive with a stage of 2 A, so that the rated current of a NEMA 17 motor is most of what it gives."""
    folder = tmp_path_factory.mktemp("device") / "small_stepper"
    shutil.copytree(BARE, folder)
    data = folder / "device.toml"
    text = data.read_text(encoding="utf-8").replace("full_scale = 10.0", "full_scale = 2.0")
    data.write_text(text.replace('name = "bare_stepper"', 'name = "small_stepper"'), encoding="utf-8")
    return str(folder)


def target(stepper, machines=1, **options):
    return emulated(stepper, "inertia", NAME, num_machines=machines, num_threads=1, **options)


# --- settings and currents ------------------------------------------------------------------------------------------
def test_a_setting_is_one_of_32_amplitudes(stepper):
    device = find_device(stepper)
    np.testing.assert_allclose(amplitude(device, [0, 7, 8, 128, 255]), 2.0 * np.array([1, 1, 2, 17, 32]) / 32)
    for current in (0.1, 0.7, 1.3, 2.0):
        setting = setting_of(device, current)
        assert amplitude(device, setting) >= current - 1e-9
        assert setting < 8 or amplitude(device, setting - 8) < current
    assert (
        amplitude(device, rated_setting(device, MOTOR))
        <= MOTOR.rated_current
        < amplitude(device, rated_setting(device, MOTOR) + 8)
    )


def test_the_current_for_a_load_holds_it_with_half_of_the_torque_in_reserve():
    load = 0.2
    i = current_for(MOTOR, load)
    assert holding_torque(MOTOR, i) * RESERVE == pytest.approx(load)
    assert holding_torque(MOTOR, MOTOR.rated_current) == pytest.approx(MOTOR.rated_torque)
    assert current_for(MOTOR, 10.0) == pytest.approx(MOTOR.rated_current)
    assert swing_period(MOTOR) == pytest.approx(2 * math.pi * math.sqrt(MOTOR.inertia / (50 * MOTOR.rated_torque)))


# --- J --------------------------------------------------------------------------------------------------------------
def test_j_is_its_formula_and_lost_steps_cost_all():
    terms = OpenLoopTerms(*(np.array([value]) for value in (4.0, 2.0, 0.1, 0.12, False, 0.5, 0.25)))
    by_hand = 4.0**0.4 * 2.0**0.4 * 0.25**0.4 * 2.0**0.2 * 2.0**0.2 * 2.0
    np.testing.assert_allclose(open_loop_cost(terms), by_hand)
    np.testing.assert_allclose(open_loop_cost(terms._replace(tripped=np.array([True]))), 30.0)


def test_inertia_and_friction_are_identified_by_the_load_angle_alone(stepper):
    """A disc of 30 rotors and friction of its bearing, known to the machine; the drive has no 6077h."""
    inertia, friction = 30 * MOTOR.inertia, 0.02
    parameters = QUIET | {"load.inertia": inertia, "load.coulomb": friction, "load.breakaway": friction}
    with target(stepper, parameters=parameters) as found:
        with pytest.raises(Exception, match="6077h"):
            found.drives.read(cia402.TORQUE_ACTUAL)
        bench = TrialBench(found, anew=True)
        bench.identify()
        assert bench.identified.inertia == pytest.approx(inertia + MOTOR.inertia, rel=0.1)
        assert bench.identified.coulomb * MOTOR.torque_constant == pytest.approx(friction, rel=0.3)
        assert abs(bench.identified.offset * MOTOR.torque_constant) < 0.005


def test_the_rule_sets_the_current_by_the_load_and_never_above_the_rated_one(stepper):
    runs = []
    for rotors in (1, 60, 120):
        with target(stepper, parameters={"load.inertia": rotors * MOTOR.inertia}) as found:
            bench = TrialBench(found, anew=True)
            bench.identify()
            runs.append(bench.rule[0, 0])
            assert np.all(bench.rule <= bench.highest) and np.all(
                bench.safe[:, :2] == rated_setting(found.device, MOTOR)
            )
    assert runs[0] < min(runs[1:])
    assert runs[0] == setting_of(find_device(stepper), current_for(MOTOR, 0.3 * MOTOR.rated_torque))


def test_a_trial_with_too_little_current_loses_steps_is_stopped_and_the_next_one_starts_where_it_should(stepper):
    with target(stepper, parameters={"load.inertia": 60 * MOTOR.inertia}) as found:
        bench = TrialBench(found)  # goes on from where it is, as on a bus
        bench.identify()
        good = bench.run(bench.safe)
        weak = bench.safe.copy()
        weak[:, 0] = 7
        bad = bench.run(weak)
        assert not good.aborted.any() and bad.aborted.all() and bad.cost > good.cost
        again = bench.run(bench.safe)
        assert not again.aborted.any()
        tooth = found.drives.read(Role.POSITION_SCALE) / MOTOR.n_p
        wanted = bench._origin
        at = found.drives.read(cia402.POSITION_ACTUAL)
        assert abs(int(at[0]) - int(wanted[0])) < 0.05 * tooth[0]
        # The encoder tells the position during trials, and the drive gets back what it had.
        assert found.drives.read(cia402.SENSOR_SELECTION) == 0
        bench.leave(bench.safe)
        assert found.drives.read(cia402.SENSOR_SELECTION) == -1


def test_an_encoder_that_shows_nothing_is_told_before_anything_is_scored(stepper):
    told = r"axis 0: the encoder showed 0 of \d+ increments .* not connected"
    with target(stepper, parameters={"motor.encoder_broken": 1.0}) as found, pytest.raises(RuntimeError, match=told):
        TrialBench(found, anew=True).identify()


# --- search ---------------------------------------------------------------------------------------------------------
def test_a_search_finds_currents_that_cost_less_than_the_rules(stepper):
    with target(stepper, machines=4) as found:
        result = optimise(found, Settings(trials=16), shared=True, anew=True)
        rule = next(row for row in result.rows if row.number == 0)
        assert result.cost[0] < rule.cost
        assert np.all(result.gains <= rated_setting(found.device, MOTOR))
        np.testing.assert_array_equal(found.device.gains.read(found.drives), result.gains)


def test_a_safe_search_starts_at_the_rated_current_and_loses_no_step(stepper):
    with target(stepper) as found:
        result = optimise(found, Settings(trials=10, safe=True))
        assert result.rows[0].gains[:, :2].tolist() == [[rated_setting(found.device, MOTOR)] * 2]
        assert result.aborts.sum() == 0
        assert result.cost[0] < result.rows[0].cost


def test_gains_that_no_trial_shows_are_refused_before_anything_moves(stepper):
    device = find_device(stepper)
    assert isinstance(method_of(device, MOTOR), OpenLoop)
    check_tried(device, device.gains.outer)
    with pytest.raises(ValueError, match="no gain is named 'velocity_p'"):
        check_tried(device, ("velocity_p",))


# --- the environment ------------------------------------------------------------------------------------------------
def test_gain_tuning_tunes_currents_and_its_robust_cost_asks_for_a_torque_reserve(stepper):
    env = GainTuning(2, device=stepper, motor=NAME, load="inertia", trials=2, num_threads=1,
                     distributions={"parameters": {}})  # fmt: skip
    try:
        observation, info = env.reset(seed=3)
        assert observation.shape == (2, 41)
        names = [variant.name for variant in env._score.variants]
        assert "run current x 0.8" in names and "velocity P x 1.5" not in names
        assert all(info["robust_cost"] < 30.0)
        down = np.tile(np.float32([-0.5, -0.5]), (2, 1))
        _, reward, *_, info = env.step(down)
        np.testing.assert_allclose(reward, info["reward_terms"]["tuning"] + info["reward_terms"]["abort"])
        assert np.all(info["trial_gains"][:, 0, :2] < env._rule[:, :2])
        # Just enough for the load step, and not with a fifth less: the robust cost says so, the trial's own J does not.
        tight = env._rule.copy()
        tight[:, 0] = setting_of(find_device(stepper), 0.36 * MOTOR.rated_current)
        scores = env._score.score(tight)
        assert np.all(scores.j[:, 0] < 30.0) and np.all(scores.j[:, names.index("run current x 0.8")] == 30.0)
    finally:
        env.close()


def test_gain_tuning_draws_steppers_by_the_loads_shipped_set(stepper):
    env = GainTuning(2, device=stepper, motor=NAME, load="inertia", trials=1, num_threads=1)
    try:
        env.reset(seed=1)
        drawn = env._parameters
        assert drawn["motor.L_s"][0] != drawn["motor.L_s"][1]
        assert drawn["load.inertia"][0] != drawn["load.inertia"][1]
    finally:
        env.close()


def test_a_variant_of_the_run_current_is_the_steppers_alone():
    assert [v.name for v in STEPPER_VARIANTS if v.run_current != 1.0] == ["run current x 0.8"]
    assert all(v.run_current == 1.0 for v in VARIANTS)


# --- the commands ---------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_sweep_runs_the_open_loop_experiment_says_what_is_not_measured_and_repeats(stepper, tmp_path):
    first, again = tmp_path / "first", tmp_path / "again"
    result = drive_tune("sweep", "--device", stepper, "--out", first)
    assert result.exit_code == 0, result.output
    assert "No torque current is measured (no 6077h)" in result.output
    with (first / "results.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert not {"peak_current [A]", "rms_current [A]", "ripple [A]"} & set(rows[0])
    for row in rows:
        share = amplitude(find_device(stepper), int(row["2003h:00"])) / MOTOR.rated_current
        assert float(row["effort [%]"]) == pytest.approx(100 * share**2)
        held = holding_torque(MOTOR, amplitude(find_device(stepper), int(row["2003h:00"])))
        if held < 0.1:  # N m, less than the load step: steps are lost
            assert row["fault"] == "1" and row["score [s]"] == "inf"
    assert any(row["fault"] == "0" for row in rows)
    assert drive_tune("sweep", "--config", first / "settings.toml", "--out", again).exit_code == 0
    assert (first / "results.csv").read_bytes() == (again / "results.csv").read_bytes()


def test_optimise_says_which_terms_j_has_not(stepper, tmp_path):
    out = tmp_path / "found"
    result = drive_tune("auto", "--by", "tpe", "--device", stepper, "--motor", NAME, "--load", "inertia", "--trials", 4,
                 "--machines", 2, "--objective", "speed", "--objective", "current", "--out", out)  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "no load step and no ripple" in result.output
    assert "current [%]" in (out / "trials.csv").read_text(encoding="utf-8").splitlines()[0]


@pytest.mark.parametrize(("command", "reason"), [
    (("identify",), "no linear model of its loops"),
    (("response",), "no linear model of its loops"),
    (("response", "position"), "no linear model of its loops"),
    (("rules",), "no linear model of its loops"),
    (("rules", "--relay"), "no linear model of its loops"),
    (("sweep", "--load", "nothing"), "nothing"),
    (("auto", "--by", "tpe", "--gain", "velocity_p"), "no gain is named 'velocity_p'; there are run_current"),
    (("auto", "--by", "tpe", "--objective", "noise"), "no objective is named 'noise'"),
])  # fmt: skip
def test_commands_refuse_in_one_line_before_anything_moves(stepper, command, reason, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    motor = ("--motor", NAME, "--load", "inertia") if command[0] != "sweep" else ("--motor", NAME)
    result = drive_tune(*command, "--device", stepper, *motor)
    assert result.exit_code == 2 and reason in result.output
    assert not list(Path(tmp_path).iterdir())


def test_tracking_asks_no_stepper_for_a_current():
    from drive_env.envs.tracking import Tracking

    with pytest.raises(ValueError, match=r"mode='cst': .* drives steppers, which are not asked for a current"):
        Tracking(1, device="tmcm6212", load="inertia", mode="cst")
