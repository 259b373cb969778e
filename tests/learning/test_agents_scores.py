"""The figures by which a policy is judged, each against episodes made by hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from agents.evaluation import scores
from agents.evaluation.scores import Episode

STEPS = 40


def episode(observations, terms=None, first=None, last=None):
    rewards = np.linspace(-1.0, 0.0, len(observations) - 1)
    return Episode(0, observations, np.zeros((STEPS, 1)), rewards, terms or {}, False, "", first or {}, last or {})


def tracking(axes=1, pole=False):
    """Return observations of which every entry of step k is k, another for each column."""
    columns = 8 * axes + 2 * pole
    return np.zeros((STEPS + 1, columns))


def test_the_following_error_is_the_worst_axis_s_in_revolutions():
    rows = tracking(axes=2)
    rows[1:, 0], rows[1:, 8] = 0.1, np.tile([0.3, -0.3], STEPS // 2)
    rows[0] = 1000.0  # what was before the first step does not count
    rows[1:, 1] = 7.0
    assert scores.following_error(episode(rows), SimpleNamespace(amplitude=2.0)) == pytest.approx(0.6)


def test_the_current_is_the_worst_axis_s_as_a_share_of_its_limit():
    rows = tracking(axes=2)
    rows[1:, 4], rows[1:, 12] = -0.5, 0.25
    rows[1:, 3] = rows[1:, 5] = 9.0
    assert scores.current(episode(rows), None) == pytest.approx(0.5)


def test_the_pole_is_judged_by_its_angle_and_not_by_its_rate():
    rows = tracking(pole=True)
    rows[1:, -2], rows[1:, -1] = np.tile([0.02, -0.02], STEPS // 2), 5.0
    with_pole = SimpleNamespace(task=SimpleNamespace(joint="pole"))
    assert scores.pole(episode(rows), with_pole) == pytest.approx(0.02)
    assert np.isnan(scores.pole(episode(rows), SimpleNamespace(task=SimpleNamespace(joint=None))))


def test_an_episode_that_ends_early_has_lasted_that_share_of_its_time():
    rows = tracking()[: STEPS // 4 + 1]
    assert scores.upright(episode(rows), SimpleNamespace(steps=STEPS)) == pytest.approx(0.25)


def test_trials_that_were_stopped_are_counted_where_they_cost_something():
    terms = {"abort": np.array([0.0, -0.5, 0.0, -0.5])}
    assert scores.stopped(episode(tracking(), terms), SimpleNamespace(abort_cost=0.5)) == pytest.approx(0.5)
    assert np.isnan(scores.stopped(episode(tracking(), terms), SimpleNamespace(abort_cost=0.0)))


@pytest.mark.parametrize(("robust_cost", "kept"), [(1.0, 1.0), (29.9, 1.0), (30.1, 0.0), (45.0, 0.0)])
def test_the_hidden_score_is_the_answers_robust_cost_and_whether_it_keeps_the_constraints(robust_cost, kept):
    figures = {figure.name: figure for figure in scores.FIGURES["ServoDrive/GainTuning-v0"]}
    cost, share = figures["robust cost (emulator)"], figures["constraints kept (emulator) [share]"]
    told = episode(tracking(), {}, {"robust_cost": 4.0}, {"robust_cost": robust_cost})
    assert cost.compute(told, None) == robust_cost and share.compute(told, None) == kept
    assert cost.lower_is_better and not share.lower_is_better
    assert np.isnan(cost.compute(episode(tracking()), None)) and np.isnan(share.compute(episode(tracking()), None))


def test_the_return_is_the_sum_of_rewards():
    rewards = np.linspace(-1.0, 0.0, STEPS)
    assert scores.total(episode(tracking()), None) == pytest.approx(rewards.sum())
