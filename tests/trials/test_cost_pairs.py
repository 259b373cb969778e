"""The robust cost against an engineer's judgement: pairs of tunings of which one is better beyond dispute.

Both sets of a row are scored on the same emulated machine as the score does it, with the baseline rule's gains as its
reference. Gains are by the bandwidths that they mean on the axis's true inertia.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from drive_env import EmulatedDrives
from drive_env.devices import find_device
from drive_env.devices.gains import bandwidth_gains, cascade_columns, rule_gains
from drive_env.dictionary.roles import Role
from drive_env.motors import find_motor
from drive_env.trials.positioning import plan_move, reach
from drive_env.trials.score import RobustScore
from tuning.identify.moved_inertia import moved_inertia

MOTORS = {"tmcm1636": "qbl4208", "tgz_d": "am3041_e"}
RULE = "the baseline rule's"


class Set(NamedTuple):
    """Bandwidths of velocity and position loop [Hz], integration time over 1/w of the velocity loop; P's factors."""

    velocity: float
    position: float
    integration: float = 5.0
    velocity_p: float = 1.0
    position_p: float = 1.0
    current: float = 1000.0


NONE = 200.0  # of an integration time: no integral to speak of


def gains_of(wanted, device, motor, inertia, supply):
    """Return the raw gains of a machine's axes, (axes, count)."""
    if wanted == RULE:
        return rule_gains(device, motor, inertia, supply=supply)
    raw = np.array(
        [
            bandwidth_gains(
                device, motor, J, current_hz=wanted.current, velocity_hz=wanted.velocity, position_hz=wanted.position,
                integration=wanted.integration, supply=supply,
            )
            for J in inertia
        ]
    )  # fmt: skip
    columns = cascade_columns(device)
    raw[:, columns[2]] = np.rint(raw[:, columns[2]] * wanted.velocity_p)
    raw[:, columns[4]] = np.rint(raw[:, columns[4]] * wanted.position_p)
    return raw


def scores_of(device_name, load, parameters, sets, dynamics="standard", repeats=3):
    """Return the scores of sets on one machine, in their order."""
    device, motor, count = find_device(device_name), find_motor(MOTORS[device_name]), len(sets)
    score = RobustScore(device_name, load, motor, count, num_threads=1, dynamics=dynamics, repeats=repeats)
    with EmulatedDrives(device_name, load, motor, count, distinct=1, num_threads=1, parameters=parameters) as drives:
        inertia = np.concatenate([moved_inertia(group.load) for group in drives.inside.groups])
        supply = float(drives.machine.supply[0])
        score.set_machines(drives.machine.parameters, np.full(count, supply))
        scale = drives.read(Role.POSITION_SCALE)
        score.set_moves(plan_move(motor, inertia.reshape(-1), scale, np.tile(reach(load), count)))
    J = inertia.reshape(count, -1)[0]
    found = score.score(np.concatenate([gains_of(wanted, device, motor, J, supply) for wanted in sets]))
    score.close()
    return found


HEAVY = {"load.inertia": 5e-5}  # a disc of ten rotor inertias
LIGHT = {"load.mass": 4.0}  # half a table
T, G = "tmcm1636", "tgz_d"

PAIRS = [
    # rigid
    (T, "inertia", {}, Set(85, 35), RULE, "45 degrees and 8 dB against a step that overshoots by 29 %"),
    (T, "inertia", {}, Set(80, 40), Set(80, 40, position_p=2.0), "it crosses over above the velocity loop"),
    (T, "inertia", {}, Set(80, 40), Set(40, 20), "as well damped, and twice as fast"),
    (T, "inertia", {}, Set(40, 20), Set(10, 5), "both have all margins; the slow one gives way under load"),
    (T, "inertia", {}, Set(80, 30, 4), Set(80, 30, NONE), "without an integral it stays off its place under load"),
    (T, "inertia", {}, Set(80, 30, 4), Set(80, 30, 1), "T_i = 1/w costs the phase that P had"),
    (T, "inertia", {}, Set(80, 30), Set(80, 30, velocity_p=3.2), "6 % below the edge of oscillation"),
    (T, "inertia", {}, Set(20, 8), Set(80, 30, velocity_p=6), "sluggish is better than unstable"),
    (T, "inertia", {}, Set(80, 35), Set(80, 35, current=150), "a slow current loop takes the velocity loop's phase"),
    (T, "inertia", HEAVY, Set(40, 16), Set(15, 6), "as well damped, and nearly three times as fast"),
    (T, "inertia", HEAVY, Set(40, 16), Set(40, 16, velocity_p=4), "each count of the encoder is amperes then"),
    (G, "inertia", {}, Set(95, 35), RULE, "45 degrees and 8 dB against 30 % of overshoot, and a swing at rest"),
    (G, "inertia", {}, Set(60, 20), Set(20, 7), "as well damped, and three times as fast"),
    (G, "inertia", {}, Set(90, 35, 4), Set(90, 35, 1), "T_i = 1/w"),
    (G, "inertia", {}, Set(60, 20, 4), Set(60, 20, NONE), "without an integral it stays off its place under load"),
    # elastic
    (T, "belt", {}, Set(25, 12), Set(25, 12, position_p=2.5), "position P beyond the velocity loop: 27 % of overshoot"),
    (T, "belt", {}, Set(25, 10), Set(12, 5), "both have all margins, one is twice as fast"),
    (T, "belt", {}, Set(25, 8, 3), Set(60, 8, 3), "the belt's resonance is about to swing"),
    (T, "two_mass", {}, Set(16, 7, 3), Set(4, 1.5, 3), "80/140 Hz: stiff against too slow, both with all margins"),
    (T, "two_mass", {}, Set(4, 1), Set(3, 0.6), "both have all margins, one is a third faster"),
    (T, "two_mass", {}, Set(16, 7, 3), Set(16, 7, NONE), "without an integral it stays off its place under load"),
    (T, "two_mass", {}, Set(16, 7), Set(60, 7), "velocity P at the edge: the shaft swings with 10 % more"),
    (T, "two_mass", {}, Set(8, 3), Set(80, 10), "sluggish is better than unstable"),
    (G, "two_mass", {}, Set(60, 20), Set(60, 60), "position loop as fast as the velocity loop"),
    (G, "two_mass", {}, Set(60, 20), Set(15, 5), "both have all margins, one is four times as fast"),
    (T, "three_mass", {}, Set(20, 8, 3), Set(10, 4, 3), "both have all margins, one is twice as fast"),
    (T, "three_mass", {}, Set(20, 8, 3), Set(20, 25, 3), "position loop beyond the velocity loop"),
    (T, "ball_screw", {}, Set(55, 20), Set(25, 10), "both have all margins, one is twice as fast"),
    (T, "ball_screw", {}, Set(55, 20), Set(55, 20, 1), "T_i = 1/w"),
    (T, "ball_screw", LIGHT, Set(55, 20), Set(55, 20, velocity_p=3), "unstable"),
    (G, "ball_screw", {}, Set(60, 20), Set(60, 20, position_p=3), "position loop as fast as the velocity loop"),
    (T, "geared_joint", {}, Set(20, 8), Set(10, 4), "both have all margins, one is twice as fast"),
    (T, "geared_joint", {}, Set(20, 8), Set(20, 28), "position loop beyond the velocity loop"),
    (T, "geared_joint", {}, Set(20, 7, 3), Set(20, 7, NONE), "without an integral it stays off its place under load"),
    (T, "gantry", {}, Set(45, 15), Set(20, 7), "both have all margins, one is twice as fast"),
    (T, "gantry", {}, Set(45, 15), Set(45, 60), "both axes together overshoot by 32 %; alone each holds the other one"),
    (T, "gantry", {}, Set(45, 15, 4), Set(45, 15, NONE), "without an integral it stays off its place under load"),
    (T, "gantry", {}, Set(30, 6), Set(45, 15, velocity_p=4), "sluggish is better than unstable"),
]  # fmt: skip


@pytest.mark.every(12)
@pytest.mark.parametrize(("device", "load", "parameters", "better", "worse", "reason"), PAIRS)
def test_the_better_tuning_costs_less(device, load, parameters, better, worse, reason):
    found = scores_of(device, load, parameters, [better, worse])
    assert found.slack[0] > 0.0, f"the better one keeps all constraints: {found.slack}, {found.clearance}, {found.rest}"
    costs = found.robust_cost
    assert costs[0] < costs[1] - 1e-9, f"{reason}: {costs}, slack {found.slack}"


@pytest.mark.parametrize(("device", "load", "better", "worse", "reason"), [
    (T, "inertia", Set(80, 30, velocity_p=1.6), Set(80, 30, velocity_p=3.2), "half of the edge against the edge"),
    (T, "two_mass", Set(40, 7), Set(60, 7), "half of the edge against 20 % below it"),
    (T, "belt", Set(25, 30), Set(25, 60), "the farther beyond the velocity loop, the worse"),
    (T, "geared_joint", Set(40, 8), Set(40, 8, velocity_p=2.0), "stable against unstable"),
    (G, "inertia", Set(95, 95), Set(95, 35, velocity_p=4.0), "an overshoot against an oscillation"),
    (T, "inertia", Set(80, 80), Set(80, 160), "the farther beyond the velocity loop, the worse"),
])  # fmt: skip
def test_of_two_that_break_a_constraint_the_one_that_breaks_it_by_less_costs_less(device, load, better, worse, reason):
    found = scores_of(device, load, {}, [better, worse])
    assert (found.slack < 0.0).all(), found.slack
    assert 30.0 < found.robust_cost[0] < found.robust_cost[1] - 1e-9, f"{reason}: {found.robust_cost}"


def test_there_are_rows_of_every_kind_of_machine():
    assert len(PAIRS) >= 20 and {row[0] for row in PAIRS} == set(MOTORS)
    loads = {"inertia", "two_mass", "three_mass", "belt", "ball_screw", "geared_joint", "gantry"}
    assert {row[1] for row in PAIRS} == loads


@pytest.mark.parametrize(("dynamics", "better"), [("soft", 0), ("standard", 1), ("stiff", 1)])
def test_which_of_two_is_better_depends_on_the_dynamics_asked_for(dynamics, better):
    """A set with 62 degrees and one twice as fast with 47 degrees."""
    found = scores_of("tmcm1636", "inertia", {}, [Set(50, 20), Set(90, 35)], dynamics)
    assert int(found.robust_cost.argmin()) == better
