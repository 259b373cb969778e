"""J, performance and robust cost, against numbers worked out by hand, and what they say of gains and machines."""

from __future__ import annotations

from contextlib import closing
from functools import partial
from types import MappingProxyType, SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from rigs.chip_gains import Gains, bandwidths_from_gains, chip_gains
from rigs.known_machines import true_plant

from drive_env import EmulatedDrives, cia402, motion
from drive_env.devices import find_device
from drive_env.devices.gains import BASELINE_RULE, bandwidth_gains, rule_gains, small_time_constants
from drive_env.dictionary.roles import Role
from drive_env.drives.currents import ampere_per_count
from drive_env.drives.raw_gains import write_gains
from drive_env.emulator.parameters import WIRING
from drive_env.loops.dynamics import find_dynamics
from drive_env.loops.true_plant import elastic_lags
from drive_env.motors import MOTORS
from drive_env.trials import score as module
from drive_env.trials.positioning import PROFILE, SETTLED, TRIAL, Move, move_terms, plan_move, reach, swing, wrapped
from drive_env.trials.score import (
    BORDER,
    RESTING,
    STEPPER_VARIANTS,
    TRIPPED,
    VARIANTS,
    CurrentSwings,
    RobustScore,
    StepperScore,
    Terms,
    cost,
    robust_cost,
    robust_performance,
)
from mechanics.loads import find_load
from mechanics.shaft import one, way
from tuning.compare.suite import load_suite, open_group
from tuning.compare.yardstick import Yardstick
from tuning.target import emulated

DEVICE, MOTOR = find_device("tmcm1636"), MOTORS["qbl4208"]
P = Gains._fields.index("velocity_p")


def terms(settling=1.0, disturbance=1.0, noise=0.0, overshoot=0.0, tripped=False):
    return Terms(*(np.array(value) for value in (settling, disturbance, noise, overshoot, tripped)))


# --- J ----------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("given", "J"), [
    (terms(), 1.0),
    (terms(settling=32.0), 4.0),                    # 32^0.4
    (terms(disturbance=32.0), 4.0),
    (terms(noise=0.03), 2.0**0.2),
    (terms(noise=0.03 * 31.0**0.5), 2.0),           # (1 + 31)^0.2
    (terms(overshoot=0.02), 1.0),                   # 2 % are free
    (terms(overshoot=0.12), 2.0),                   # 10 % more double J
    (terms(32.0, 32.0), 30.0 - 225.0 / 16.0),       # 16: from 15 on it bends towards a trip's 30
    (terms(32.0, 32.0, 0.03 * 31.0**0.5, 0.12), 30.0 - 225.0 / 64.0),
    (terms(tripped=True), 30.0),
    (terms(settling=np.nan), 30.0),                 # it left physics
    (terms(disturbance=np.inf), 30.0),
])  # fmt: skip
def test_cost(given, J):
    assert cost(given) == pytest.approx(J)


def test_whatever_performs_worse_costs_more_and_nothing_as_much_as_a_trip():
    """Without a jump or a kink where J begins to bend, so that a search finds its way on a very soft shaft, too."""
    settling = np.geomspace(1.0, 1e9, 20_001)
    bent = cost(terms(settling))
    assert (np.diff(bent) > 0.0).all() and bent[-1] < 30.0
    slope = np.diff(bent) / np.diff(settling**0.4)
    assert slope[settling[1:] ** 0.4 < 15.0] == pytest.approx(1.0)
    assert np.abs(np.diff(slope)).max() < 0.002


@pytest.mark.parametrize(("j", "performance"), [
    ([2.0, 1.0, 1.0, 1.0, 1.0], 2.0),    # nothing is worse than the nominal machine
    ([2.0, 3.0, 6.0, 1.0, 1.0], 4.0),
    ([2.0, 2.0, 2.0, 2.0, 30.0], 16.0),  # the probe trips
])  # fmt: skip
def test_performance_is_half_nominal_and_half_the_worst(j, performance):
    assert robust_performance(np.array([j])) == pytest.approx([performance])


def test_variants_are_those_of_the_score():
    assert {variant.name: variant[1:] for variant in VARIANTS} == {
        "nominal": (1.0, 1.0, 1.0, 1.0),
        "load inertia x 2": (2.0, 1.0, 1.0, 1.0),
        "load inertia x 0.5": (0.5, 1.0, 1.0, 1.0),
        "stiffness x 0.8": (1.0, 0.8, 1.0, 1.0),
        "velocity P x 1.5": (1.0, 1.0, 1.5, 1.0),
        "velocity P x 0.67": (1.0, 1.0, 0.67, 1.0),
    }
    assert {variant.name: variant[1:] for variant in STEPPER_VARIANTS} == {
        "nominal": (1.0, 1.0, 1.0, 1.0),
        "load inertia x 1.3": (1.3, 1.0, 1.0, 1.0),
        "load inertia x 0.7": (0.7, 1.0, 1.0, 1.0),
        "stiffness x 0.8": (1.0, 0.8, 1.0, 1.0),
        "velocity P x 1.5": (1.0, 1.0, 1.5, 1.0),
        "run current x 0.8": (1.0, 1.0, 1.0, 0.8),  # of a stepper in open loop, in place of the one before
    }
    assert VARIANTS[0].name == STEPPER_VARIANTS[0].name == "nominal"  # which the performance counts by half


# --- the robust cost by performance and slack -------------------------------------------------------------------------
@pytest.mark.parametrize(("performance", "slack", "expected"), [
    (2.0, np.inf, 2.0),                           # no constraints, or far from all: performance alone
    (2.0, 0.5, 2.0),
    (2.0, BORDER * np.log(2.0), np.sqrt(2.0 * 30.0)),   # g = 1/2: the geometric mean of performance and a trip's
    (2.0, 0.0, 30.0),                             # the border
    (0.1, 0.0, 30.0),
    (30.0, 0.5, 30.0),                            # useless, but feasible: no worse than the border
    (45.0, 0.5, 30.0),
    (0.1, -np.log(2.0), 45.0),                    # 30 (2 - 1/2), however well it performs
    (2.0, -np.log(2.0), 45.0),
    (2.0, -60.0, 60.0),
    (2.0, TRIPPED, 30.0 * (2.0 - np.exp(-5.0))),
])  # fmt: skip
def test_robust_cost(performance, slack, expected):
    assert robust_cost(np.array([performance]), np.array([slack])) == pytest.approx([expected])


def test_whatever_keeps_the_constraints_comes_before_whatever_does_not():
    rng = np.random.default_rng(0)
    performance, slack = rng.uniform(0.05, 40.0, (200, 1)), np.geomspace(1e-6, 3.0, 60)
    feasible, infeasible = robust_cost(performance, slack), robust_cost(performance, -slack)
    assert feasible.max() <= 30.0 + 1e-12 < infeasible.min()  # to rounding
    assert (np.diff(feasible, axis=1) <= 1e-12).all() and (
        np.diff(infeasible, axis=1) > 0.0
    ).all()  # more slack is better
    np.testing.assert_array_equal(infeasible, np.broadcast_to(infeasible[:1], infeasible.shape))
    # Of two that keep them by the same slack, the one that performs better costs less.
    ranked = robust_cost(np.linspace(0.1, 29.0, 100)[:, None], slack)
    assert (np.diff(ranked, axis=0) > 0.0).all()


@pytest.mark.parametrize("performance", [0.1, 1.0, 29.0])
def test_the_robust_cost_is_continuous_over_the_border_and_its_slope_is_bounded(performance):
    """Towards the border it rises by ln(30 / performance) / 2 % of itself, beyond by 30 per unit of slack."""
    s = np.linspace(-0.2, 0.2, 40_001)
    found = robust_cost(np.full(s.shape, performance), s)
    steepest = max(30.0 * np.log(30.0 / performance) / BORDER, 30.0)
    assert np.abs(np.diff(found)).max() <= 1.01 * steepest * (s[1] - s[0])
    assert (np.diff(found) <= 1e-9).all()


# --- the terms of a move ----------------------------------------------------------------------------------------------
MOVE = Move(np.array([10_000]), np.array([1]), np.array([1]), np.array([65536 / (2 * np.pi)]), 4096 / (2 * np.pi))


def recorded(error_at, current=0.0):
    """Return the position of an axis that lags its target by error_at(ms) increments, and its current."""
    ms = np.arange(TRIAL)
    position = (10_000 - error_at(ms)).astype(float)[:, None]
    return position, np.broadcast_to(np.asarray(current, float), (TRIAL,))[:, None].copy()


def of_move(position, current, sign=1, t_0=0.004):
    found = move_terms(position, current, MOVE, t_0, 3.5, np.array([10_000 * sign]), np.array([sign]))
    return [float(value[0]) for value in found]


def test_an_axis_that_is_there_at_the_profiles_end_has_t_s_of_t_0_alone():
    position, current = recorded(lambda ms: np.where(ms < PROFILE, 5000, 0))
    assert of_move(position, current) == [1.0, 0.0, 0.0]


@pytest.mark.parametrize(("error", "ms_counted"), [
    (100, 20.0),   # 1 % of the move: each millisecond counts in full
    (5000, 20.0),  # and so it does however far off
    (50, 10.0),    # half the band, half the time
])  # fmt: skip
def test_settling_adds_the_time_out_of_the_band_after_the_profile(error, ms_counted):
    position, current = recorded(lambda ms: np.where((ms >= PROFILE) & (ms < PROFILE + 20), error, 0))
    settling, _, _ = of_move(position, current)
    assert settling == pytest.approx(1.0 + ms_counted / 4.0)


def test_the_band_is_no_finer_than_three_counts_of_the_encoder():
    # 4096 counts: one is 16 increments, three are 48.
    short = MOVE._replace(distance=np.array([100]))
    position = np.where(np.arange(TRIAL) < PROFILE, 0.0, 76.0)[:, None]  # 24 short of 100: half of 48
    settling, _, _ = move_terms(position, np.zeros((TRIAL, 1)), short, 0.09, 3.5, np.array([100]), np.array([1]))
    assert settling[0] == pytest.approx(1.5)


@pytest.mark.parametrize("sign", [1, -1])
def test_overshoot_is_beyond_the_target_in_either_direction(sign):
    position, current = recorded(lambda ms: np.where(ms == 70, -500, 0))
    assert of_move(sign * position, current, sign)[2] == pytest.approx(0.05)


def test_what_the_load_step_does_is_not_the_moves():
    position, current = recorded(
        lambda ms: np.where(ms >= SETTLED, -5000, 0), np.where(np.arange(TRIAL) > SETTLED, 9, 0)
    )
    assert of_move(position, current) == [1.0, 0.0, 0.0]


def test_noise_is_the_rms_increment_at_rest_over_the_rated_current():
    position, _ = recorded(lambda ms: 0 * ms)
    current = np.where(np.arange(TRIAL) % 2, 0.35, -0.35)[:, None]  # changes by 0.7 A of 3.5 A each millisecond
    current[: (PROFILE + SETTLED) // 2] *= 10.0  # the move itself does not count
    assert of_move(position, current)[1] == pytest.approx(0.2)


def test_positions_wrap_at_2_31():
    assert wrapped(np.array([2**31 + 5 - 2**32, -(2**31) - 5 + 2**32, 7])).tolist() == [-(2**31) + 5, 2**31 - 5, 7]


# --- the move ---------------------------------------------------------------------------------------------------------
def test_a_move_takes_60_ms_and_0_4_of_the_rated_torque():
    J = 3 * MOTOR.inertia
    move = plan_move(MOTOR, [J], 65536, [np.inf])
    a = 0.4 * MOTOR.rated_torque / J
    assert move.acceleration[0] == pytest.approx(a * 65536 / (2 * np.pi), rel=1e-3)
    assert 2 * np.sqrt(move.distance[0] / move.acceleration[0]) == pytest.approx(0.060, rel=1e-4)
    assert 2 * np.sqrt(move.distance[0] / move.acceleration[0]) <= 0.060
    assert move.velocity[0] >= np.sqrt(move.distance[0] * move.acceleration[0])


@pytest.mark.parametrize(("inertia", "reach", "turns"), [
    (3.0, 1.0, 0.4 / (2 * np.pi)),       # 40 % of what there is
    (3.0, -1.0, -0.4 / (2 * np.pi)),
    (0.1, np.inf, 0.5 * MOTOR.rated_speed * 0.03 / (2 * np.pi)),  # half the rated speed
])  # fmt: skip
def test_a_move_ends_before_travel_or_speed_do(inertia, reach, turns):
    move = plan_move(MOTOR, [inertia * MOTOR.inertia], 65536, [reach])
    assert move.distance[0] / 65536 == pytest.approx(turns, rel=1e-3)


def test_reach_is_the_longer_way():
    assert np.isinf(reach("two_mass")).all()
    assert np.isfinite(reach("belt")).all()
    assert reach("robot").shape == (6,)


# --- the baseline rule ------------------------------------------------------------------------------------------------
def test_small_time_constants_of_the_device():
    # 1/(2 pi 1000 Hz) + 1.5 of 40 us + 1.4/(2 pi 400 Hz) + 200 us
    assert small_time_constants(DEVICE, 400.0) == pytest.approx(159.2e-6 + 60e-6 + 557.0e-6 + 200e-6, rel=1e-3)


def test_the_rule_is_its_formula_in_bandwidths():
    rule = BASELINE_RULE._replace(speed=0.2, integration=5.0, position=0.25)
    J = np.array([3.0, 12.0]) * MOTOR.inertia
    gains = rule_gains(DEVICE, MOTOR, J, rule)
    w_v = 0.2 / float(small_time_constants(DEVICE, 400.0))
    for k in range(2):
        exact = chip_gains(
            DEVICE, MOTOR, J[k], current_hz=1000.0, velocity_hz=w_v / 2 / np.pi, position_hz=0.25 * w_v / 2 / np.pi
        )
        assert np.abs(gains[k] - np.array(exact)).max() <= 1


def test_the_rule_stays_within_the_registers():
    gains = rule_gains(DEVICE, MOTOR, [1e-12, 1e3])
    assert gains.min() >= 1
    assert gains.max() <= 32767


def test_whatever_the_inertia_the_baseline_rule_has_one_bandwidth():
    J = np.array([2.0, 10.0]) * MOTOR.inertia
    found = [bandwidths_from_gains(DEVICE, MOTOR, j, Gains(*map(int, row))).velocity_hz
             for j, row in zip(J, rule_gains(DEVICE, MOTOR, J), strict=True)]  # fmt: skip
    assert found == pytest.approx(
        [BASELINE_RULE.speed / small_time_constants(DEVICE, 400.0) / (2 * np.pi)] * 2, rel=0.01
    )


# --- the robust cost of machines --------------------------------------------------------------------------------------
def bench(load, machines, repeats=1, dynamics="standard", **parameters):
    score = RobustScore("tmcm1636", load, "qbl4208", machines, num_threads=1, repeats=repeats, dynamics=dynamics)
    with EmulatedDrives(load=load, num_machines=machines, num_threads=1, parameters=parameters) as drives:
        axes = drives.load.num_axes
        score.set_machines(drives.machine.parameters, drives.machine.supply.reshape(machines, axes)[:, 0])
        score.set_moves(
            plan_move(MOTOR, np.full(drives.num_axes, 3 * MOTOR.inertia), 65536, np.tile(reach(load), machines))
        )
    return score


@pytest.fixture(scope="module")
def two_mass():
    score = bench("two_mass", 4)
    yield score
    score.close()


# What two masses of 80/140 Hz stand with margins.
CALM = bandwidth_gains(DEVICE, MOTOR, 3 * MOTOR.inertia, current_hz=1000.0, velocity_hz=16.0, position_hz=7.0)[None]


def times(factor, machines=4):
    gains = np.repeat(CALM, machines, axis=0)
    gains[:, P] = np.rint(gains[:, P] * factor)
    return gains


def bandwidths(velocity, position, axes=1):
    """Gains of one machine of three rotor inertias, by the bandwidths of its loops [Hz]."""
    gains = bandwidth_gains(
        DEVICE, MOTOR, 3 * MOTOR.inertia, current_hz=1000.0, velocity_hz=velocity, position_hz=position
    )
    return np.repeat(gains[None], axes, axis=0)


def test_a_load_has_the_variants_that_it_can_have():
    names = {}
    for load in ("inertia", "two_mass", "ball_screw"):
        score = RobustScore("tmcm1636", load, "qbl4208", 1, num_threads=1)
        names[load] = [variant.name for variant in score.variants]
        score.close()
    assert "stiffness x 0.8" not in names["inertia"]  # nothing is elastic
    assert names["two_mass"] == names["ball_screw"]
    assert names["two_mass"] == [variant.name for variant in VARIANTS if variant.run_current == 1.0]  # a servo


def test_the_scale_of_the_disturbance_is_that_of_a_rigid_cascade_by_hand():
    """132 T t^3 / J, whatever the gains are; on a soft shaft t is 4.5 times the load's lag."""
    for load, parameters in (("inertia", {}), ("two_mass", {"load.stiffness": 1.0}), ("two_mass", {})):
        score = bench(load, 2, **parameters)
        true = {name: values.reshape(2, -1)[:, 0] for name, values in score._drives.machine.parameters.items()}
        J, t = true["load.inertia"] + MOTOR.inertia, float(small_time_constants(DEVICE, 400.0))
        if load == "two_mass":
            t = np.maximum(t, 4.5 * true["load.inertia"] / np.sqrt(J * true["load.stiffness"]))
        w = 0.45 / t
        T_i, k_v = 4.0 / w, w / 3.0
        expected = 0.3 * MOTOR.rated_torque * T_i / (J * w * k_v)
        score.close()
        assert score._reference[:, 0] == pytest.approx(expected, rel=1e-3)  # by the shaft's own inertia


def test_good_gains_have_a_disturbance_of_about_the_scale():
    score = bench("inertia", 1)
    found = score.score(bandwidths(80.0, 30.0))
    score.close()
    assert found.slack[0] > 0.0 and 0.2 < found.terms.disturbance[0, 0] < 2.0


def test_all_axes_of_a_machine_have_the_scale_of_the_one_that_a_load_moves_most():
    score = bench("robot", 1)
    scale, pushed = score._reference[0], score._pushed
    score.close()
    assert pushed.max() == pytest.approx(0.3 * MOTOR.rated_torque) and pushed.min() < 0.5 * pushed.max()
    assert np.ptp(scale) == 0.0 < scale[0]


def test_the_variants_inertia_is_the_range_that_dynamics_ask_for():
    score = RobustScore("tmcm1636", "inertia", "qbl4208", 1, num_threads=1, dynamics=find_dynamics("soft", "1/3"))
    assert [variant.inertia for variant in score.variants] == [1.0, 3.0, 1.0, 1.0]  # nothing twice
    assert score.variants[1].name == "load inertia x 3"
    score.close()


def test_variants_are_parallel_machines_with_their_parameters(two_mass):
    stiffness = two_mass._drives.machine.parameters["load.stiffness"].reshape(4, 6)
    inertia = two_mass._drives.machine.parameters["load.inertia"].reshape(4, 6)
    assert stiffness[0] / stiffness[0, 0] == pytest.approx([1, 1, 1, 0.8, 1, 1])
    assert inertia[0] / inertia[0, 0] == pytest.approx([1, 2, 0.5, 1, 1, 1])


def test_a_longer_rest_shows_the_swing_that_begins_after_the_load_step_and_changes_nothing_else():
    """Between two counts an axis swings once its integrator has brought it there; these gains were once an oracle's."""
    machine = next(one for one in load_suite("public") if one.name == "inertia-qbl4208-3")
    gains = np.array([[4314, 2207, 6585, 960, 929]])
    with closing(Yardstick([machine], 1)) as judge:
        whole = judge.score(gains)
        judge._score._rest = 0.0
        short = judge.score(gains)
    assert short.slack > 0.0 > whole.slack
    assert whole.performance == short.performance and (whole.j == short.j).all()
    with open_group([machine], 1) as target:
        drives = target.drives
        write_gains(drives, gains)
        motion.enable(drives, mode="pp")
        motion.move_to(drives, np.rint(0.57 * target.increments()).astype(np.int64), relative=True)
        drives.advance(0.1)
        current = drives.record([cia402.TORQUE_ACTUAL], 0.5)[cia402.TORQUE_ACTUAL] * ampere_per_count(drives)
    assert current.std() > RESTING * target.motor.rated_current


def test_repeats_are_runs_with_other_noises_and_places_and_a_score_is_their_mean():
    repeated, alone, gains = bench("two_mass", 2, repeats=3), bench("two_mass", 2), times(1.4, 2)
    seeds = repeated._drives.inside.noise_seeds.reshape(2, 3, len(VARIANTS))
    assert (seeds == seeds[:1, :, :1]).all(), "variants are compared under the same noise, and machines are"
    assert seeds[0, 0, 0] == alone._drives.inside.noise_seeds[0], "the first run is that of a score without repeats"
    found = []
    for k, seed in enumerate(seeds[0, :, 0]):
        alone._drives.inside.noise_seeds[:] = seed
        alone._place[:] = k / 3.0  # of a count of the encoder
        found.append(alone.score(gains))
    scores = repeated.score(gains)
    repeated.close(), alone.close()
    assert len({one.performance[0] for one in found}) == 3
    np.testing.assert_allclose(scores.performance, np.mean([one.performance for one in found], axis=0))
    # Loops have no noise; what swings at rest counts by its RMS.
    for alike in found:
        np.testing.assert_array_equal(scores.clearance, alike.clearance)
        np.testing.assert_array_equal(scores.overshoot, alike.overshoot)
    of_loops = find_dynamics("standard").slack(scores.clearance[:, 0], scores.clearance[:, 1:], scores.overshoot)
    np.testing.assert_allclose(scores.slack, np.minimum(of_loops, 1.0 - scores.rest[:, 0] / RESTING))
    np.testing.assert_allclose(scores.robust_cost, robust_cost(scores.performance, scores.slack))
    np.testing.assert_allclose(scores.j, np.mean([one.j for one in found], axis=0))
    np.testing.assert_allclose(scores.terms.settling, np.mean([one.terms.settling for one in found], axis=0))
    np.testing.assert_allclose(scores.swing, np.max([one.swing for one in found], axis=0))
    np.testing.assert_allclose(scores.rest, np.sqrt(np.mean([one.rest**2 for one in found], axis=0)))


def test_a_score_depends_on_machine_and_gains_alone(two_mass):
    first = two_mass.score(times(1.0))
    two_mass.score(times(6.0))
    again = two_mass.score(times(1.0))
    for a, b in zip(first.terms, again.terms, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(first.robust_cost, again.robust_cost)
    assert np.ptp(first.robust_cost) == 0.0  # four equal machines


@pytest.mark.parametrize(("variant", "factor"), [("velocity P x 1.5", 1.5), ("velocity P x 0.67", 0.67)])
def test_a_variant_of_the_gains_is_the_machine_with_those_gains(two_mass, variant, factor):
    k = [variant.name for variant in two_mass.variants].index(variant)
    found = two_mass.score(times(1.0))
    gains = times(1.0)
    gains[:, P] = np.rint(gains[:, P] * factor)
    there = two_mass.score(gains)
    assert there.j[0, 0] == pytest.approx(found.j[0, k])
    assert there.clearance[0, 0] == pytest.approx(found.clearance[0, k])


def test_too_much_and_too_little_gain_perform_worse(two_mass):
    slow, right, shaking = (float(two_mass.score(times(f)).performance[0]) for f in (0.2, 1.0, 8.0))
    assert slow > 1.1 * right
    assert shaking > 1.2 * right


def test_too_much_and_too_little_gain_cost_more():
    score = bench("inertia", 3)
    gains = np.concatenate([bandwidths(20.0, 4.0), bandwidths(80.0, 30.0), bandwidths(1000.0, 30.0)])
    found = score.score(gains)
    score.close()
    slow, right, shaking = found.robust_cost
    assert slow > 1.3 * right and shaking > 3.0 * right
    assert found.slack[0] > 0.0 and found.slack[1] > 0.0 > found.slack[2]  # slow is worse by its performance alone
    assert shaking > 30.0 > slow


def test_a_machine_that_cannot_be_enabled_performs_as_a_trip_and_is_farther_off_than_any():
    score = bench("inertia", 3)
    with EmulatedDrives(load="inertia", num_machines=3, num_threads=1) as drives:
        score.set_machines(drives.machine.parameters, np.array([24.0, 5.0, 24.0]))  # under-voltage
    right = bandwidths(80.0, 30.0)
    found = score.score(np.concatenate([right, right, bandwidths(1000.0, 30.0)]))
    score.close()
    assert found.performance[1] == 30.0 and found.terms.tripped[1].all()
    assert found.slack[1] == TRIPPED and found.robust_cost[1] == pytest.approx(30.0 * (2.0 - np.exp(-5.0)))
    assert found.robust_cost[0] < 10.0
    assert found.slack.min() == TRIPPED, "nothing is farther off, however it swings"
    assert found.robust_cost.max() == found.robust_cost[1]


def test_a_machine_is_as_good_as_its_worst_axis():
    score = bench("gantry", 1)
    gains = bandwidths(45.0, 15.0, axes=2)
    found = []
    for one_axis in (gains, bandwidths(20.0, 4.0, axes=2)):
        worse = one_axis.copy()
        worse[1, P] *= 20
        found += [score.score(one_axis), score.score(worse)]
    score.close()
    calm, worse, slow, shaking = found
    assert float(worse.performance[0]) > 2.0 * float(calm.performance[0])
    assert worse.clearance[0, 0] < 0.0 < calm.clearance[0, 0]
    assert float(shaking.robust_cost[0]) > 2.0 * float(slow.robust_cost[0])  # the slow ones keep all margins


@pytest.mark.parametrize("axis", [0, 1])
def test_of_two_axes_the_loop_with_the_least_clearance_counts(axis):
    """One axis alone close to its border leaves the machine less slack, whichever it is."""
    score = bench("gantry", 1)
    gains = bandwidths(20.0, 4.0, axes=2)
    both = float(score.score(gains).clearance[0, 0])
    gains[axis, P] *= 2
    assert 0.0 < float(score.score(gains).clearance[0, 0]) < both
    score.close()


def test_soft_standard_and_stiff_ask_different_margins_of_one_machine():
    """Its performance is that of one machine; what is left of the constraints is less the more they ask."""
    found = {}
    for name in ("soft", "standard", "stiff"):
        score = bench("inertia", 1, dynamics=name)
        found[name] = score.score(bandwidths(100.0, 30.0))
        score.close()
    soft, standard, stiff = found.values()
    assert soft.slack[0] < standard.slack[0] < stiff.slack[0]
    assert soft.slack[0] < 0.0 < standard.slack[0], "50 degrees are enough for standard and too few for soft"
    assert soft.performance[0] == standard.performance[0] == stiff.performance[0]
    assert soft.robust_cost[0] > 30.0 > standard.robust_cost[0] > stiff.robust_cost[0] >= stiff.performance[0]


def test_a_score_does_not_depend_on_where_the_machine_stood_when_it_was_set():
    """A robot's inertia is another where the last move ended, and a run begins where the load starts."""
    score = bench("robot", 1)
    gains = np.repeat(CALM, 6, axis=0)
    with EmulatedDrives(load="robot", num_machines=1, num_threads=1) as drives:
        parameters, supply = drives.machine.parameters, drives.machine.supply[:1]
        first = score.score(gains)
        score.set_machines(parameters, supply)
    again = score.score(gains)
    score.close()
    np.testing.assert_array_equal(first.clearance, again.clearance)
    np.testing.assert_array_equal(first.robust_cost, again.robust_cost)


def test_a_constant_load_pulls_in_every_variant_and_through_the_load_step():
    """At rest the motor's torque is what pulls at it, whatever holds it: K_t i = -(constant + load step)."""
    torque = np.array([0.03, -0.05])
    score = RobustScore("tmcm1636", "inertia", "qbl4208", 2, num_threads=1, friction="none")
    with score._drives as drives:
        machine = drives.machine
        parameters = {name: np.full(2, value[0]) for name, value in machine.parameters.items()}
        score.set_machines(parameters | {"motor.cogging_torque": np.zeros(2)}, np.full(2, MOTOR.voltage))
        inertia = np.full(2, parameters["motor.inertia"] + parameters["load.inertia"])
        score.set_moves(plan_move(MOTOR, inertia, np.full(2, 65536.0), np.full(2, np.inf)))
        score.set_constant_load(torque)
        score.score(rule_gains(DEVICE, MOTOR, inertia))
        at_rest = drives.record([0x6077], 0.25)[0x6077][-100:].mean(axis=0) * 1e-3
    step = -0.3 * MOTOR.rated_torque
    K_t = 1.5 * MOTOR.n_p * parameters["motor.psi_m"][0]
    expected = np.repeat(-(torque + step) / K_t, len(score.variants))
    assert at_rest == pytest.approx(expected, abs=0.03)


def test_swing_is_the_worst_of_the_windows_of_a_watch():
    """Two axes, 50 ms, rated 2 A: one alternates by +-0.5 A in its second half, one ramps by 10 mA per ms."""
    t = np.arange(50)
    alternating = np.where(t < 25, 0.0, 0.5 * (-1.0) ** t)
    assert swing(np.stack([alternating, 0.01 * t], axis=1), 2.0) == pytest.approx([0.5, 0.005])


def test_a_jump_between_two_windows_is_seen_by_neither():
    assert swing(np.repeat([0.0, 5.0], 25)[:, None], 2.0) == pytest.approx([0.0])


# --- without a machine: what is set, in which order, and what is made of what is recorded -----------------------------
SCALE = 65536 / (2 * np.pi)


class Machines:
    """Emulated drives of two machines, three runs and two axes, which do what a test says."""

    def __init__(self, frees=None, loaded=None):
        self.num_axes, self.device, self.motor, self.log = 12, DEVICE, MOTOR, []
        self.load = SimpleNamespace(
            parameters=[SimpleNamespace(name=name, field=field) for name, field in
                        (("inertia", "body_inertia"), ("mass", "body_mass"), ("stiffness", "jnt_stiffness"),
                         ("contact", "contact_stiffness"), ("stuff", "density"), ("friction", "dof_frictionloss"))]
        )  # fmt: skip
        log = self.log

        class Machine:
            supply, diverged = np.full(12, 24.0), np.zeros(6, bool)
            parameters = MappingProxyType({"stage.velocity_filter": np.array([100.0, 200.0, 400.0] * 2)})

            def reset(self):
                log.append("reset")

            def set_all(self, values, where):
                log.append(({name: value.tolist() for name, value in values.items()}, where.tolist()))

            def __setattr__(self, name, value):
                log.append((name, np.asarray(value).tolist()))
                self.__dict__[name] = value

        self.machine = Machine()
        self.records = [frees, loaded]

    def record(self, objects, seconds):
        self.log.append(("record", list(objects), round(seconds, 6)))
        rows, known = round(seconds / 1e-3), self.records.pop(0) or {}
        zero = np.zeros((rows, 12), int)
        found = {name: zero + known.get(name, 0) for name in objects}
        found[STATUS] = zero + 0x0637 if STATUS not in known else zero + known[STATUS]
        return found


POSITION, CURRENT, STATUS = 0x6064, 0x6077, 0x6041


def scored(variants=VARIANTS[:3], repeats=1, **recorded):
    """A score of two machines of two axes, three runs of each."""
    made = StepperScore.__new__(StepperScore)  # which runs as a servo's does, and needs no loops
    made._settling_scale = partial(RobustScore._settling_scale, made)
    made.variants, made.num_machines, made.repeats = variants[: 3 // repeats], 2, repeats
    made._runs, made._axes, made._rest = 3, (2, 3, 2), 0.0
    made.dynamics, made._has_loops = find_dynamics("standard"), False
    made._drives = Machines(**recorded)
    made._constant, made._load_torque = np.zeros(6), -0.25
    made._factors = np.tile(np.repeat([1.0, 2.0, 3.0], 2), 2)
    made._t_0, made._reference, made._place = np.full(12, 0.01), np.ones((2, 2)), np.zeros(12)
    one = np.full(12, 10_000)
    made._move = Move(one * np.tile([1, -1], 6), one, one, np.full(12, SCALE), 4096 / (2 * np.pi))
    return made


LOAD = {f"load.{name}": np.ones(2) for name in ("inertia", "mass", "stiffness", "contact", "stuff", "friction")}


def test_machines_have_their_parameters_in_all_variants_each_with_its_factor():
    made = scored((STEPPER_VARIANTS[1], STEPPER_VARIANTS[3], STEPPER_VARIANTS[0]))
    two = np.array([1.0, 2.0])
    given = {f"load.{name}": two for name in ("inertia", "mass", "stiffness", "contact", "stuff", "friction")}
    made.set_machines(given | {"motor.R_s": two}, np.array([20.0, 30.0]))
    (values, where), supply, reset = made._drives.log
    heavy, soft, plain = ([k * x for k in (1.0, 2.0) for x in row] for row in
                          ((1.3, 1.0, 1.0), (1.0, 0.8, 1.0), (1.0, 1.0, 1.0)))  # fmt: skip
    expected = {"load.inertia": heavy, "load.mass": heavy, "load.stuff": heavy, "load.stiffness": soft,
                "load.contact": soft, "load.friction": plain, "motor.R_s": plain}  # fmt: skip
    assert values == {name: pytest.approx(row) for name, row in expected.items()}
    assert where == [True] * 6 and supply == ("supply", [20.0] * 6 + [30.0] * 6) and reset == "reset"
    expected = 4.0 * small_time_constants(DEVICE, np.array([100.0, 200.0, 400.0] * 2))
    np.testing.assert_allclose(made._t_0, np.repeat(expected, 2))


def test_how_motors_are_wired_changes_nothing_of_a_score():
    made = scored()
    made.set_machines(LOAD | {name: np.ones(2) for name in [*WIRING, "motor.R_s"]}, np.full(2, 24.0))
    assert set(made._drives.log[0][0]) == {"motor.R_s", *LOAD}


def test_only_machines_that_are_asked_for_are_set():
    made = scored()
    made.set_machines(LOAD, np.array([20.0, 30.0]), np.array([False, True]))
    assert made._drives.log[0][1] == [False] * 3 + [True] * 3
    assert made._drives.log[1] == ("supply", [24.0] * 6 + [30.0] * 6)
    made.set_constant_load(np.array([0.1, -0.2]))
    assert made._constant.tolist() == [0.1] * 3 + [-0.2] * 3
    move = Move(*(np.array([1, 2, 3, 4]) * k for k in (1, 10, 100, 1000.0)), 7.0)
    made.set_moves(move, np.array([False, True]))
    assert made._move.distance.tolist() == [10_000, -10_000] * 3 + [3, 4] * 3
    assert made._move.velocity.tolist() == [10_000] * 6 + [30, 40] * 3
    assert made._move.acceleration.tolist() == [10_000] * 6 + [300, 400] * 3
    assert made._move.increments.tolist() == [SCALE] * 6 + [3000.0, 4000.0] * 3 and made._move.counts == 7.0
    made.set_moves(move)
    assert made._move.distance.tolist() == [1, 2] * 3 + [3, 4] * 3


@pytest.fixture
def unmoved(monkeypatch):
    """What a run does to drives besides, in its order."""
    done = []
    monkeypatch.setattr(module, "ampere_per_count", lambda drives: 1e-3)
    for name in ("write_gains", "write_profile", "power_up", "start"):

        def note(drives, *more, name=name):
            drives.log.append(name)
            done.append((name, *more))

        monkeypatch.setattr(module, name, note)
    return done


def test_a_run_is_a_move_and_then_a_load_step(unmoved):
    made = scored()
    made._constant = np.array([0.1, 0.1, 0.1, -0.2, -0.2, -0.2])
    gains = np.array([[1000, 200, 800, 100, 50]] * 4)
    terms, disturbance, swings = made._run(gains)
    constant, loaded = made._constant.tolist(), (made._constant - 0.25).tolist()
    objects = [POSITION, CURRENT, Role.TORQUE_ERROR, STATUS]
    assert made._drives.log == [
        ("load_torque", constant), "reset", "write_gains", "write_profile", "power_up", "start",
        ("record", objects, 0.15), ("load_torque", loaded), ("record", objects, 0.1),
    ]  # fmt: skip
    written = unmoved[0][1]
    assert written[:, 2].tolist() == [800, 800, 1600, 1600, 2400, 2400] * 2
    assert unmoved[1][1] is made._move and unmoved[3][1].tolist() == made._move.distance.tolist()
    assert terms.settling.shape == disturbance.shape == swings.moving.shape == (2, 3, 2)
    assert not terms.tripped.any() and (terms.disturbance == 1.0).all()
    # It stands still: 10,000 increments from its target, out of the band for 90 ms, and for 100 ms under load.
    np.testing.assert_allclose(terms.settling, 10.0)
    np.testing.assert_allclose(disturbance, 10_000 / SCALE * 0.1)
    assert not terms.noise.any() and not terms.overshoot.any() and not swings.resting.any()


def test_what_is_counted_in_a_run_by_hand(unmoved):
    """Ripple is of the demanded current, the actual one and its error; swings are of the actual one."""
    direction = np.tile([1, -1], 6)
    there = 10_000 * direction
    ripple = np.where(np.arange(SETTLED)[:, None] % 2, 0, 70)
    free = {POSITION: there + 500 * direction * (np.arange(SETTLED)[:, None] == 80), CURRENT: ripple,
            Role.TORQUE_ERROR: 2 * ripple}  # fmt: skip
    under = {POSITION: there + np.where(np.arange(12) < 6, 100, 0)}
    made = scored(frees=free, loaded=under)
    terms, disturbance, swings = made._run(np.array([[1, 1, 1, 1, 1]] * 4))
    np.testing.assert_allclose(terms.noise, 3 * 0.07 / MOTOR.rated_current)
    np.testing.assert_allclose(terms.overshoot, 0.05)
    np.testing.assert_allclose(swings.moving, 0.07 / MOTOR.rated_current)
    np.testing.assert_allclose(disturbance[0], 100 / SCALE * 0.1)
    np.testing.assert_allclose(disturbance[1], made._move.least_error)


def test_a_fault_of_an_axis_and_what_left_physics_of_a_machine_trip(unmoved):
    made = scored(loaded={STATUS: np.where(np.arange(12) == 3, 0x0238, 0x0637) * np.ones((100, 1), int)})
    made._drives.machine.diverged = np.array([False, False, False, False, False, True])
    terms, *_ = made._run(np.array([[1, 1, 1, 1, 1]] * 4))
    assert terms.tripped.reshape(-1).tolist() == [k in (3, 10, 11) for k in range(12)]


def test_a_drive_that_tells_no_error_of_its_current_has_the_actual_one(unmoved):
    made = scored()
    made._drives.device = SimpleNamespace(roles={}, gains=DEVICE.gains)
    made._run(np.array([[1, 1, 1, 1, 1]] * 4))
    assert made._drives.log[6] == ("record", [POSITION, CURRENT, STATUS], 0.15)


def by_hand(settling, noise=0.0):
    values = np.asarray(settling, float)
    zero = 0.0 * values
    return Terms(values, zero + 1.0, zero + noise, zero, values > 1e9)


def test_a_machine_is_its_worst_axis_and_its_robust_cost_half_its_worst_variant():
    """J of two axes: 32^0.4 is 4, 243^0.4 is 9."""
    made = scored()
    terms = by_hand([[[1.0, 32.0], [1.0, 1.0], [243.0, 1.0]], [[32.0, 32.0], [1.0, 32.0], [1.0, 1.0]]])
    moving = resting = np.arange(12.0).reshape(2, 3, 2)
    made._reference = np.array([[2.0, 2.0], [1.0, 1.0]])
    found = made._scores(terms, np.ones((2, 3, 2)) * [[[2.0]], [[1.0]]], CurrentSwings(moving, resting))
    np.testing.assert_allclose(found.j, [[4.0, 1.0, 9.0], [4.0, 4.0, 1.0]])
    np.testing.assert_allclose(found.performance, [0.5 * 4.0 + 0.5 * 9.0, 4.0])
    assert found.terms.settling.tolist() == [[32.0, 1.0, 243.0], [32.0, 32.0, 1.0]]
    assert found.swing.tolist() == [[1.0, 3.0, 5.0], [7.0, 9.0, 11.0]]
    assert found.rest.tolist() == found.swing.tolist()


def test_runs_that_are_repeated_count_by_their_mean_and_a_swing_by_its_largest():
    made = scored(repeats=3)
    terms = by_hand([[[1.0, 1.0], [32.0, 1.0], [1.0, 243.0]], [[1.0, 1e10], [1.0, 1.0], [1.0, 1.0]]])
    three = np.arange(12.0).reshape(2, 3, 2)
    found = made._scores(terms, np.ones((2, 3, 2)), CurrentSwings(three, three))
    np.testing.assert_allclose(found.performance, [(4.0 + 9.0 + 1.0) / 3.0, (30.0 + 2.0) / 3.0])
    np.testing.assert_allclose(found.j, [[14.0 / 3.0], [32.0 / 3.0]])
    np.testing.assert_allclose(found.terms.settling[0], [(1.0 + 32.0 + 243.0) / 3.0])
    assert found.terms.tripped.tolist() == [[False], [True]]
    assert found.swing.tolist() == [[5.0], [11.0]]
    np.testing.assert_allclose(found.rest**2, [[(1.0 + 9.0 + 25.0) / 3.0], [(49.0 + 81.0 + 121.0) / 3.0]])


def test_a_steppers_scale_is_the_disturbance_of_the_rules_nominal_runs_of_machines_that_are_asked_for():
    made = scored(repeats=3)
    e = np.array([[[1.0, 2.0], [3.0, 4.0], [5.0, 9.0]]] * 2)
    made._run = lambda gains: (by_hand(np.ones((2, 3, 2))), e, CurrentSwings(e, e))
    made.score_rule(None, np.array([True, False]))
    assert made._reference.tolist() == [[3.0, 5.0], [1.0, 1.0]]
    made.repeats, made.variants = 1, VARIANTS[:3]
    found = made.score_rule(None)
    assert made._reference.tolist() == [[1.0, 2.0], [1.0, 2.0]]
    assert found.terms.disturbance[0, 0] == 1.0
    assert made.score(None).j.tolist() == found.j.tolist()


# --- without a machine: what the constraints make of a performance ----------------------------------------------------
class Few(NamedTuple):
    """What stands for linear machines here: a number of each."""

    number: np.ndarray


def constrained(monkeypatch, clearance, overshoot=0.0, rest=0.0, tripped=False, performance=4.0):
    """Two machines of three variants and two axes, the second wide of every border; return their scores."""
    made, asked = scored(), []
    made._has_loops, made._loops = True, Few(np.arange(6))

    def loop_clearance(dynamics, rates, machines, gains, variants):
        asked.append((dynamics, machines, gains))
        assert variants == 3
        return np.array([*clearance, 1.5, 1.5, 1.5]), np.array([overshoot, 0.0])

    monkeypatch.setattr(module, "loop_clearance", loop_clearance)
    monkeypatch.setattr(module, "LinearMachines", Few)
    monkeypatch.setattr(module, "CascadeGains", SimpleNamespace(of=lambda device, raw: raw))
    monkeypatch.setattr(module, "LoopRates", SimpleNamespace(of=lambda device: None))
    terms = by_hand([[[1.0, 1.0]] * 3] * 2)
    terms = terms._replace(tripped=np.broadcast_to(np.array([tripped, False])[:, None, None], (2, 3, 2)))
    swings = CurrentSwings(np.zeros((2, 3, 2)), np.broadcast_to(np.array([rest, 0.0])[:, None, None], (2, 3, 2)))
    scores = made._scores(terms, np.ones((2, 3, 2)), swings)._replace(performance=np.array([performance, 4.0]))
    return made._constrained(scores, np.array([[1000, 200, 800, 100, 50]] * 4)), asked[0]


@pytest.mark.parametrize(("given", "slack"), [
    ({"clearance": [1.3, 1.3, 1.3]}, 0.3),
    ({"clearance": [0.8, 1.3, 1.3]}, -0.2),
    ({"clearance": [1.3, 0.3, 1.3]}, -0.25),   # a variant is asked for 0.4: 0.3 / 0.4 - 1
    ({"clearance": [1.3, 1.3, 0.44]}, 0.1),
    ({"clearance": [1.3, 1.3, 1.3], "overshoot": 0.18}, 0.1),   # of 20 %
    ({"clearance": [1.3, 1.3, 1.3], "overshoot": 0.3}, -0.5),
    ({"clearance": [1.3, 1.3, 1.3], "overshoot": np.inf}, -4.0),
    ({"clearance": [1.3, 1.3, 1.3], "rest": 0.045}, 0.1),       # of 5 % of the rated current
    ({"clearance": [1.3, 1.3, 1.3], "rest": 0.1}, -1.0),
    ({"clearance": [1.3, 1.3, 1.3], "rest": 3.0}, TRIPPED),     # -59: no farther off than a trip
    ({"clearance": [1.3, 1.3, 1.3], "tripped": True}, TRIPPED),
    ({"clearance": [-1.0, -1.0, -1.0], "overshoot": np.inf, "tripped": True}, TRIPPED),
])  # fmt: skip
def test_the_slack_is_the_least_of_all_constraints(monkeypatch, given, slack):
    found, _ = constrained(monkeypatch, **given)
    assert found.slack == pytest.approx([slack, 0.5])
    performance = [4.0, 4.0]
    assert found.robust_cost == pytest.approx(robust_cost(np.array(performance), np.array([slack, 0.5])))
    assert found.clearance.tolist() == [given["clearance"], [1.5] * 3]
    assert found.overshoot.tolist() == [given.get("overshoot", 0.0), 0.0]


def test_loops_are_asked_for_with_each_variants_gains_and_once_of_runs_that_are_repeated(monkeypatch):
    _, (dynamics, machines, raw) = constrained(monkeypatch, clearance=[1.0, 1.0, 1.0])
    assert dynamics is find_dynamics("standard") and machines.number.tolist() == list(range(6))
    assert raw[:, :, 2].tolist() == [[800, 800], [1600, 1600], [2400, 2400]] * 2
    made = scored(repeats=3)
    made._has_loops, made._loops, made._factors = True, Few(np.arange(6)), np.ones(12)
    asked = []
    monkeypatch.setattr(
        module, "loop_clearance", lambda *of: (asked.append(of[2].number.tolist()), (np.ones(2), np.zeros(2)))[1]
    )
    three = np.zeros((2, 3, 2))
    scores = made._scores(by_hand(three + 1.0), np.ones((2, 3, 2)), CurrentSwings(three, three))
    assert made._constrained(scores, np.ones((4, 5))).clearance.shape == (2, 1)
    assert asked == [[0, 3]]


def test_where_there_is_no_linear_model_the_robust_cost_is_the_performance():
    made = scored()
    made._run = lambda gains: (
        by_hand([[[32.0, 1.0]] * 3] * 2),
        np.ones((2, 3, 2)),
        CurrentSwings(*np.ones((2, 2, 3, 2))),
    )
    found = made.score(None)
    np.testing.assert_array_equal(found.robust_cost, found.performance)
    assert found.slack.tolist() == [np.inf, np.inf] and np.isnan(found.clearance).all()
    assert found.clearance.shape == (2, 3) and np.isnan(found.overshoot).all()


def test_a_load_step_is_three_tenths_of_the_rated_torque_against_the_move():
    for name, lever in (("inertia", 1.0), ("belt", None)):
        score = RobustScore("tmcm1636", name, "qbl4208", 1, num_threads=1)
        packed = one(find_load(name))
        lever = np.abs(way(packed).joints @ packed.plant.disturbance[:, 0]).max()
        assert score._load_torque == pytest.approx(-0.3 * MOTOR.rated_torque / lever)
        assert score._reference.tolist() == [[1.0]] and score._t_0.tolist() == [1.0] * score._drives.num_axes
        score.close()


@pytest.mark.parametrize("load", ["inertia", "two_mass", "gantry"])
def test_what_hangs_on_a_spring_lags_by_its_share_and_its_anti_resonance(load):
    """Of two masses: sqrt(load / whole) / (2 pi anti-resonance); of a rotor whose springs lead to no mass none."""
    with emulated(load=load, num_threads=1) as target:
        lags = elastic_lags(target.drives)
        if load == "two_mass":
            plant = true_plant(target.drives)
            share = 1.0 - plant.rotor_inertia / plant.inertia
            assert lags == pytest.approx(np.sqrt(share) / (2.0 * np.pi * plant.anti_resonance), rel=1e-6)
        else:
            np.testing.assert_allclose(lags, 0.0, atol=1e-9)
