"""The baseline rule against the truth: it keeps standard dynamics on rigid axes of any drive, motor and load."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from drive_env import EmulatedDrives
from drive_env.devices import find_device
from drive_env.devices.gains import BASELINE_RULE, rule_gains
from drive_env.loops.dynamics import find_dynamics, loop_clearance
from drive_env.loops.sampled import CascadeGains, LoopRates
from drive_env.loops.true_plant import true_machines
from drive_env.loops.worst_margins import worst_margins
from drive_env.randomisation.random_machines import Distributions, RandomMachines
from drive_env.trials.method import SAFE_RULE
from drive_env.trials.score import RobustScore
from tuning.identify.moved_inertia import moved_inertia

STANDARD = find_dynamics("standard")
ON_ALL = [
    (name, motor) for name in ("tmcm1636", "tmcm1636_fw109", "tgz_d", "tgz_s") for motor in find_device(name).motors
]
SHIPPED = find_device("tmcm1636").stage["velocity_filter"].default


class Found(NamedTuple):
    """What a rule's gains do on machines, (machines,) each."""

    phase_deg: np.ndarray
    gain_db: np.ndarray
    ms: np.ndarray
    clearance: np.ndarray
    overshoot: np.ndarray
    slack: np.ndarray  # their variants among them


def on_drawn_machines(device, motor, load="inertia", count=6, velocity_filter=SHIPPED, rule=BASELINE_RULE):
    """Return what the rule's gains, for the inertia as a perfect identification has it, do on drawn machines."""
    with EmulatedDrives(device, load, motor, count, num_threads=1) as drives:
        drawn = RandomMachines(drives, Distributions.load(load).of_machine(drives.machine.parameters))
        drawn.redraw([np.random.default_rng((17, k)) for k in range(count)])
        machine = drives.machine
        machine.set_all({"stage.velocity_filter": np.full(count, float(velocity_filter))}, np.ones(count, bool))
        moved = np.concatenate([moved_inertia(group.load) for group in drives.inside.groups])[:, 0]
        inertia = moved * drives.motor.psi_m / machine.parameters["motor.psi_m"]
        known = zip(inertia, machine.supply, strict=True)
        raw = np.concatenate([rule_gains(drives.device, drives.motor, J, rule, supply=volts) for J, volts in known])
        rates, true = LoopRates.of(drives.device), true_machines(drives)
        gains = CascadeGains.of(drives.device, raw[:, None, :])
        margins, (clearance, overshoot) = (
            worst_margins(rates, true, gains),
            loop_clearance(STANDARD, rates, true, gains),
        )
        score = RobustScore(device, load, motor, count, num_threads=1)
        score.set_machines(machine.parameters, machine.supply)
    slack = score.loop_slack(raw)
    score.close()
    return Found(*margins, clearance, overshoot, slack)


@pytest.mark.every(48)
@pytest.mark.parametrize("velocity_filter", [SHIPPED, 150.0, 800.0])
@pytest.mark.parametrize(("device", "motor"), ON_ALL)
def test_on_drawn_rigid_machines_the_rule_keeps_standard_dynamics(device, motor, velocity_filter):
    """No drive tells its velocity filter: the rule counts on the one that is shipped, and has room for the slowest."""
    found = on_drawn_machines(device, motor, velocity_filter=velocity_filter)
    assert found.phase_deg.min() >= 45.0 and found.gain_db.min() >= 8.0 and found.ms.max() <= 2.0
    assert found.clearance.min() >= 1.0 and found.overshoot.max() <= 0.2
    assert found.slack.min() > 0.0  # double and half the load inertia, velocity P x 1.5 and x 0.67 among the machines


def test_on_an_elastic_axis_it_may_oscillate_where_the_safe_rule_does_not():
    """It knows inertia and lags alone: a spring takes identification."""
    rule, safe = (on_drawn_machines("tmcm1636", "qbl4208", "two_mass", rule=one) for one in (BASELINE_RULE, SAFE_RULE))
    assert rule.clearance.min() < 0.0 < safe.clearance.min()
