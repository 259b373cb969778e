"""Controllers of Tracking: the feed-forward that they are taught by, and those that ship."""

from __future__ import annotations

import numpy as np
import pytest

from agents.evaluation.evaluation import evaluate
from agents.evaluation.loop_sensitivity import check_kept, measure_sensitivity
from agents.evaluation.sim_versus_bus import on_both_sides
from agents.policies.agent_file import AgentFile
from agents.policies.baselines import feed_forward
from agents.policies.guard import GuardLimits
from agents.policies.policy import policy_of
from agents.shipped import TUNER, shipped, shipped_names
from agents.tasks import _is_of_task
from drive_env.envs.suite import TASKS
from drive_env.envs.tracking import TrackingConfig
from drive_env.loops.dynamics import find_dynamics

CONTROLLERS = [name for name in shipped_names() if name != TUNER]
OF_TASKS = [name for name in CONTROLLERS if AgentFile.load(shipped(name)).environment in TASKS]
ERROR = "RMS following error [rev]"


@pytest.mark.parametrize(
    ("mode", "lags", "action"),
    [
        ("csp", None, 0.096),  # (0.030 s * 2 rev/s + 3e-4 s^2 * 40 rev/s^2) of 1.25 * 0.3 * 2 rev
        ("csp", (0.06, 0.0), 0.16),
        ("csv", None, 0.2133),  # (60/s * 0.02 rev + 0.010 s * 40 rev/s^2) of 1.25 * 0.3 * 20 rev/s
    ],
)
def test_feed_forward_is_lag_times_motion(mode, lags, action):
    config = TrackingConfig(load="two_mass", mode=mode, action="offset")
    row = np.zeros((1, 8), np.float32)
    row[0, [0, 5, 6]] = 0.01, 0.1, 0.12  # 0.02 rev behind; 2 rev/s, and 2.4 rev/s 10 ms later
    assert feed_forward(config, lags).act(row) == pytest.approx(np.array([[action]]), abs=1e-4)


# --- what ships -------------------------------------------------------------------------------------------------------
@pytest.mark.every(4)
@pytest.mark.parametrize("name", CONTROLLERS)
def test_the_shipped_controllers_perform_as_their_cards_say(name):
    made = AgentFile.load(shipped(name))
    found = evaluate(policy_of(made), made.environment, made.configuration, episodes=16, seed=77_000)
    assert found.interval(ERROR).median < 2.0 * made.card["figures"][ERROR]["median"]
    assert not found.violations


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(one, marks=[pytest.mark.slow] * (one == "arm_path")) for one in OF_TASKS]
)
def test_an_agent_of_a_task_keeps_margins_on_other_machines_than_its_card_tells_of(name):
    made = AgentFile.load(shipped(name))
    assert made.card["margins"]["Ms greatest"] <= find_dynamics(made.card["margins"]["dynamics"]).ms
    check_kept(measure_sensitivity(policy_of(made), made.environment, machines=8, seed=0), find_dynamics("stiff"))


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_shipped_controller_acts_the_same_over_can_in_lockstep(name):
    """Machines that are drawn, each in this process and behind its own hub."""
    made = AgentFile.load(shipped(name))
    options = made.configuration if name in OF_TASKS else {**made.configuration, "duration": 0.1}
    patient = GuardLimits(saturation=None, stall=30.0)
    both = on_both_sides(policy_of(made), made.environment, options, machines=2, seed=5, lockstep=True, guard=patient)
    assert both.missing == {} and len(both.bus.episodes) == 2
    for one, two in zip(both.inside.episodes, both.bus.episodes, strict=True):
        assert len(one.actions) >= 100 and np.any(one.actions != 0.0)
        assert np.array_equal(one.actions, two.actions) and np.array_equal(one.observations, two.observations)


def test_weights_of_a_frozen_task_may_lack_newer_terms_that_weigh_nothing():
    assert _is_of_task({"follow": 1.0}, {"follow": 1.0, "pace": 0.0})
    assert not _is_of_task({"follow": 1.0}, {"follow": 1.0, "pace": 0.5})
    assert not _is_of_task({"follow": 2.0}, {"follow": 1.0, "pace": 0.0})
