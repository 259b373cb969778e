"""What all environments share, on an environment that counts: its episode is as long as its generator says."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode

import drive_env  # noqa: F401 - registers
from drive_env.envs.vector_environment import SingleEnvironment, VectorEnvironment, merge, merge_info


class Counting(VectorEnvironment):
    """Observation: [draw, steps]; odd environments are terminated, even ones truncated, after 3 + number steps."""

    def __init__(self, num_envs, **options):
        super().__init__(num_envs, Box(0, 1000, (2,), np.float32), Box(-1, 1, (1,), np.float32), **options)
        self.steps = np.zeros(num_envs, int)
        self.drawn = np.zeros(num_envs)
        self.actions = []

    def _reset_environments(self, mask, options):
        for lane in np.flatnonzero(mask):
            self.drawn[lane] = self.rngs[lane].integers(1, 1000)
        self.steps[mask] = 0
        return self._observation(), {"drawn": self.drawn.copy()}

    def _step_environments(self, action):
        self.actions.append(np.array(action))
        self.steps += 1
        ended = self.steps >= 3 + np.arange(self.num_envs)
        odd = np.arange(self.num_envs) % 2 == 1
        return self._observation(), np.ones(self.num_envs), ended & odd, ended & ~odd, {"count": self.steps.copy()}

    def _observation(self):
        return np.stack([self.drawn, self.steps], 1).astype(np.float32)


def zeros(lanes):
    return np.zeros((lanes.num_envs, 1), np.float32)


def steps_seen(lanes, number):
    return [lanes.step(zeros(lanes)) for _ in range(number)]


def test_a_lane_of_a_seed_is_the_same_among_any_number():
    many = Counting(8).reset(seed=5)[0]
    assert len({tuple(row) for row in many}) == 8
    for number in range(1, 8):
        assert np.array_equal(Counting(number).reset(seed=5)[0], many[:number])
    alone = [Counting(1).reset(seed=seed)[0][0] for seed in (7, 5, 12)]
    assert np.array_equal(Counting(3).reset(seed=[7, 5, 12])[0], alone)  # a seed of its own makes it a single one
    assert np.array_equal(alone[1], many[0])


def test_neighbouring_seeds_have_nothing_in_common():
    """Environment k of a seed draws from a sequence of its own, and from no other seed's."""
    numbers = []
    for seed in range(21):
        lanes = Counting(8)
        lanes.reset(seed=seed)
        numbers += [rng.integers(0, 2**63) for rng in lanes.rngs]
    assert len(set(numbers)) == 21 * 8


def test_without_a_seed_each_lane_goes_on_with_its_generator():
    lanes, alone = Counting(4), Counting(1)
    first = lanes.reset(seed=[1, 2, 3, 4])[0]
    second = lanes.reset()[0]
    assert np.all(first[:, 0] != second[:, 0])
    alone.reset(seed=3)
    assert np.array_equal(alone.reset()[0][0], second[2])


def test_next_step_mode_hands_out_the_last_observation_and_begins_one_step_later():
    lanes = Counting(2)
    first = lanes.reset(seed=0)[0]
    found = steps_seen(lanes, 5)
    observation, reward, terminated, truncated, info = found[2]
    assert observation[0].tolist() == [first[0, 0], 3] and truncated.tolist() == [True, False] and "drawn" not in info
    observation, reward, terminated, truncated, info = found[3]
    assert observation[0, 1] == 0 and observation[0, 0] != first[0, 0]
    assert observation[1].tolist() == [first[1, 0], 4]  # the neighbour goes on, and ends
    assert reward.tolist() == [0.0, 1.0] and terminated.tolist() == [False, True] and not truncated.any()
    assert info["_drawn"].tolist() == [True, False]
    assert found[4][0][:, 1].tolist() == [1, 0]


def test_same_step_mode_hands_out_both_observations_at_once():
    lanes = Counting(2, autoreset_mode="SameStep")
    first = lanes.reset(seed=0)[0]
    observation, reward, _, truncated, info = steps_seen(lanes, 3)[-1]
    assert truncated.tolist() == [True, False] and reward.tolist() == [1.0, 1.0]
    assert observation[0, 1] == 0 and observation[0, 0] != first[0, 0] and observation[1, 1] == 3
    assert info["final_obs"][0].tolist() == [first[0, 0], 3] and info["final_obs"][1] is None
    assert info["_final_obs"].tolist() == [True, False]
    assert info["final_info"]["count"][0] == 3
    observation, *_, info = lanes.step(zeros(lanes))
    assert observation[:, 1].tolist() == [1, 0] and info["_final_obs"].tolist() == [False, True]


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_the_next_episode_is_the_same_in_every_mode(mode):
    lanes = Counting(1, autoreset_mode=mode)
    lanes.reset(seed=4)
    begun = [row[0][0, 0] for row in steps_seen(lanes, 12)]
    alone = Counting(1, autoreset_mode="Disabled")
    alone.reset(seed=4)
    expected = [alone.reset()[0][0, 0] for _ in range(2)]
    assert list(dict.fromkeys(begun))[1:3] == expected


def test_disabled_mode_waits_for_the_user():
    lanes = Counting(2, autoreset_mode=AutoresetMode.DISABLED)
    first = lanes.reset(seed=0)[0]
    steps_seen(lanes, 3)
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"environment 0 has ended.*reset_mask"):
        lanes.step(zeros(lanes))
    observation = lanes.reset(options={"reset_mask": np.array([True, False])})[0]
    assert observation[0, 1] == 0 and observation[1].tolist() == [first[1, 0], 3]
    assert lanes.step(zeros(lanes))[0][:, 1].tolist() == [1, 4]


def test_a_masked_reset_seeds_the_masked_lanes_alone():
    lanes, other = Counting(2), Counting(2)
    for each in (lanes, other):
        each.reset(seed=0)
    lanes.reset(seed=9, options={"reset_mask": np.array([True, False])})
    assert lanes.reset()[0][1, 0] == other.reset()[0][1, 0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"autoreset_mode": "never"}, r"'NextStep', 'SameStep', 'Disabled', not 'never'"),
        ({"render_mode": "ansi"}, r"None, 'rgb_array', 'human', not 'ansi'"),
        ({"num_envs": 0}, "1 or more, not 0"),
    ],
)
def test_a_wrong_value_names_the_valid_ones(options, message):
    with pytest.raises(ValueError, match=message):
        Counting(**{"num_envs": 2, **options})


@pytest.mark.parametrize("mask", [np.zeros(2, bool), np.ones(3, bool), np.ones(2)])
def test_a_mask_that_is_none_is_refused(mask):
    lanes = Counting(2)
    lanes.reset(seed=0)
    with pytest.raises(ValueError, match=r"reset_mask must be a boolean array of shape \(2,\)"):
        lanes.reset(options={"reset_mask": mask})


def test_the_first_reset_begins_every_environment():
    with pytest.raises(ValueError, match="the first reset must be of all environments"):
        Counting(2).reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(gymnasium.error.ResetNeeded):
        Counting(1).step(np.zeros((1, 1), np.float32))
    with pytest.raises(ValueError, match="3 seeds do not fit 2 environments"):
        Counting(2).reset(seed=[1, 2, 3])


def test_one_lane_is_a_view():
    one = SingleEnvironment(Counting(1, autoreset_mode="Disabled"))
    observation, info = one.reset(seed=6)
    assert np.array_equal(observation, Counting(3).reset(seed=6)[0][0])
    assert info == {"drawn": observation[0]}
    for _ in range(3):
        observation, reward, terminated, truncated, info = one.step(np.zeros(1, np.float32))
    assert observation[1] == 3 and (terminated, truncated) == (False, True) and info == {"count": 3}
    assert isinstance(reward, float)
    with pytest.raises(gymnasium.error.ResetNeeded):
        one.step(np.zeros(1, np.float32))
    with pytest.raises(ValueError, match="num_envs=1"):
        SingleEnvironment(Counting(2, autoreset_mode="Disabled"))


def test_dicts_of_arrays_merge_lane_by_lane():
    mask = np.array([True, False])
    space = Dict({"a": Box(0, 9, (2,), np.float32)})
    mixed = merge({"a": np.ones((2, 2))}, {"a": np.zeros((2, 2))}, mask)
    assert mixed["a"].tolist() == [[1, 1], [0, 0]] and set(mixed) == set(space)
    info = merge_info({"new": np.array([1, 2])}, {"old": np.array([3, 4]), "_old": np.array([True, False])}, mask)
    assert info["_new"].tolist() == [True, False] and info["_old"].tolist() == [False, False]


def test_import_registers_the_environments():
    for name in ("GainTuning", "GainScheduling", "Tracking"):
        assert f"ServoDrive/{name}-v0" in gymnasium.registry
