"""What every environment must do, on every load: one contract for GainTuning, GainScheduling and Tracking."""

from __future__ import annotations

import contextlib
import json
import re
import warnings
from contextlib import contextmanager

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from drive_env.envs.gain_scheduling import GainScheduling
from drive_env.envs.gain_tuning import GainTuning
from drive_env.envs.stable_baselines import DriveVecEnv
from drive_env.envs.tracking import Tracking
from mechanics.loads import LOADS

# Class, and the options of a short episode.
KINDS = {
    "Tracking": (Tracking, {"duration": 0.03}),
    "GainScheduling": (GainScheduling, {"duration": 0.03}),
    "GainTuning": (GainTuning, {"trials": 2}),
}
EVERY_KIND = pytest.mark.parametrize("kind", KINDS)
EVERY_KIND_AND_LOAD = pytest.mark.parametrize(
    ("kind", "load"),
    [
        pytest.param(kind, load, marks=pytest.mark.slow)  # takes a second
        if kind == "GainTuning" and load not in ("two_mass", "inverted_pendulum")
        else (kind, load)
        for kind in KINDS
        for load in LOADS
    ],
)


@contextmanager
def lanes_of(kind, num_envs=1, **options):
    environment, short = KINDS[kind]
    lanes = environment(num_envs, **{"num_threads": 1, **short, **options})
    try:
        yield lanes
    finally:
        lanes.close()


def actions(lanes, steps, first=0):
    """Return a random agent's actions, (steps, environments, ...); those of number k are those of seed first + k."""
    low, high = lanes.single_action_space.low, lanes.single_action_space.high
    rows = [
        np.random.default_rng((11, first + lane)).uniform(low, high, (steps, *low.shape))
        for lane in range(lanes.num_envs)
    ]
    return np.stack(rows, axis=1).astype(np.float32)


def steps_of(lanes):
    """Return the steps of an episode."""
    config = lanes.config
    if isinstance(lanes, GainTuning):
        return config.trials
    return config.steps if isinstance(lanes, Tracking) else round(config.duration / config.step)


def run(lanes, given, seed=0):
    """Return observations (steps + 1, n, ...), rewards, terminated and truncated (steps, n), and infos."""
    observations = [lanes.reset(seed=seed)[0]]
    rewards, ends, cuts, infos = [], [], [], []
    for action in given:
        observation, reward, terminated, truncated, info = lanes.step(action)
        observations.append(observation)
        rewards.append(reward)
        ends.append(terminated)
        cuts.append(truncated)
        infos.append(info)
    return np.array(observations), np.array(rewards), np.array(ends), np.array(cuts), infos


def break_machine(lanes, lane):
    """Push one machine out of physics, now and in every cycle to come until it is mended."""
    lanes.drives.machine.load_torque = np.where(np.arange(lanes.num_envs) == lane, 1e12, 0.0)


def mend_machine(lanes):
    lanes.drives.machine.load_torque = 0.0


# --- the interface ----------------------------------------------------------------------------------------------------
@pytest.mark.every(12)
@EVERY_KIND_AND_LOAD
def test_the_checkers_of_gymnasium_and_stable_baselines_find_nothing_to_say(kind, load):
    from stable_baselines3.common.env_checker import check_env as check_for_stable_baselines

    single = gymnasium.make(f"ServoDrive/{kind}-v0", load=load, num_threads=1, **KINDS[kind][1])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(single.unwrapped, skip_render_check=True)
        check_for_stable_baselines(single.unwrapped, warn=True)
    single.close()


@EVERY_KIND
def test_make_and_make_vec(kind):
    environment, short = KINDS[kind]
    options = {"num_threads": 1, **short}
    several = gymnasium.make_vec(f"ServoDrive/{kind}-v0", 3, vectorization_mode="vector_entry_point", **options)
    single = gymnasium.make(f"ServoDrive/{kind}-v0", **options)
    assert isinstance(several, environment)
    first, _ = several.reset(seed=5)
    alone, _ = single.reset(seed=5)
    assert np.array_equal(first[0], alone)
    assert first.shape == (3, *single.observation_space.shape)
    for space in (single.observation_space, single.action_space):
        assert space.dtype == np.float32 and space.is_bounded()
    several.close()
    single.close()


# What makes an episode of two steps, and its default number.
HORIZONS = {
    "Tracking": ({"duration": 0.002}, 1000),
    "GainScheduling": ({"duration": 0.02}, 200),
    "GainTuning": ({"trials": 2}, 10),
}


@EVERY_KIND
def test_the_spec_tells_the_steps_of_an_episode(kind):
    """Gymnasium's wrappers ask for it, as TimeAwareObservation does; the environment alone truncates."""
    short, default = HORIZONS[kind]
    name = f"ServoDrive/{kind}-v0"
    for options, steps in (({}, default), (short, 2)):
        with contextlib.closing(gymnasium.make(f"drive_env:{name}", num_threads=1, **options)) as single:
            assert single.spec.max_episode_steps == steps and single.spec.reward_threshold is None
            assert gymnasium.wrappers.TimeAwareObservation(single).max_timesteps == steps
        with contextlib.closing(gymnasium.make_vec(name, 2, num_threads=1, **options)) as several:
            assert several.spec.max_episode_steps == steps
    timed = gymnasium.wrappers.TimeAwareObservation(gymnasium.make(name, num_threads=1, **short))
    with contextlib.closing(timed):
        timed.reset(seed=0)
        ends = [timed.step(timed.action_space.sample())[2:4] for _ in range(2)]
    assert ends == [(False, False), (False, True)]
    with contextlib.closing(gymnasium.make(single.spec)) as again:
        assert again.spec.max_episode_steps == 2


@EVERY_KIND
def test_stable_baselines_gets_the_lanes_own_arrays(kind):
    with lanes_of(kind, 3, autoreset_mode="SameStep") as lanes:
        env = DriveVecEnv(lanes)
        handed = []
        step = lanes.step
        lanes.step = lambda given: handed.append(step(given)) or handed[-1]
        env.seed(2)
        assert np.array_equal(env.reset(), lanes.reset(seed=2)[0])
        for given in actions(lanes, steps_of(lanes)):
            observation, _, ended, infos = env.step(given)
            assert observation is handed[-1][0]
        assert ended.all()
        assert np.array_equal(infos[1]["terminal_observation"], handed[-1][4]["final_obs"][1])
        assert infos[1]["TimeLimit.truncated"]


# --- the docstring ----------------------------------------------------------------------------------------------------
def rows_of(text):
    """Return the tables of a docstring's spaces, each as rows of index, name, unit, low and high."""
    tables, is_one = [], False
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if not line.strip().startswith("|"):
            is_one = False
        elif cells == ["index", "name", "unit", "low", "high"]:
            tables.append([])
            is_one = True
        elif is_one and set(cells) != {"---"}:
            assert len(cells) == 5, line
            tables[-1].append(cells)
    return tables


def place(text, letters):
    """Return what an index says, as 7, 3+G, 8a + 2 or 35+2G+W."""
    spelled = re.sub(r"(\d)([A-Za-z])", r"\1*\2", text)
    return int(eval(spelled, {"__builtins__": {}}, letters))


def told(table, letters):
    """Return index -> (low, high) of the rows of a table."""
    found = {}
    for index, name, unit, low, high in table:
        ends = [place(end, letters) for end in index.split("...")]
        copied = re.search(r"as (\S+) \.\.\.", name)
        for k in range(ends[0], ends[-1] + 1):
            assert k not in found, f"{index} is told twice"
            if copied:
                found[k] = found[place(copied[1], letters) + k - ends[0]]
                continue
            assert name and unit, index
            found[k] = tuple(float(bound.replace("pi", str(np.pi))) for bound in (low, high))
    return found


DESCRIBED = [
    ("Tracking", {"load": "two_mass"}, {}),
    ("Tracking", {"load": "cart_pendulum"}, {}),
    ("Tracking", {"load": "gantry"}, {}),
    ("GainScheduling", {"load": "belt"}, {"G": 3}),
    ("GainScheduling", {"load": "gantry", "gains": ("position_p",)}, {"G": 1}),
    ("GainTuning", {"load": "inertia"}, {"G": 3, "W": 0}),
    ("GainTuning", {"load": "gantry", "gains": ("velocity_p", "position_p"), "waveform": 7}, {"G": 2, "W": 7}),
]


@pytest.mark.parametrize(("kind", "options", "letters"), DESCRIBED)
def test_the_docstring_has_a_row_for_every_entry_of_the_spaces(kind, options, letters):
    action_table, *tables = rows_of(KINDS[kind][0].__doc__)
    with lanes_of(kind, **options) as lanes:
        axes = lanes.drives.num_axes
        acting, seen = lanes.single_action_space, lanes.single_observation_space
    entries = []
    for a in range(axes):
        one = told(tables[0], {**letters, "a": a, "A": axes})
        entries += [one[k] for k in sorted(one)]
    if kind == "GainTuning" or options["load"] == "cart_pendulum":
        rest = told(tables[1], {"A": axes})
        assert min(rest) == (-1 if kind == "GainTuning" else len(entries))
        entries += [rest[k] for k in sorted(rest)]
    assert np.allclose(np.stack([seen.low, seen.high], 1), entries, atol=0.01)
    one = [told(action_table, {**letters, "a": a}) for a in range(axes)]
    assert np.allclose(np.stack([acting.low, acting.high], 1), [bound for axis in one for bound in axis.values()])


# --- the same seed, the same episode ----------------------------------------------------------------------------------
@EVERY_KIND
@pytest.mark.parametrize(
    ("sizes", "counts"),
    [
        (((1, 0, 1), (1, 5, 1), (8, 0, 1)), {0: 2, 5: 2}),
        pytest.param(
            ((1, 0, 1), (1, 70, 1), (8, 0, 1), (64, 0, 1), (72, 0, 2)), {0: 4, 70: 2, 5: 3}, marks=pytest.mark.slow
        ),
    ],
    ids=["8", "72"],
)
def test_an_episode_is_the_same_alone_and_among_others_and_under_2_threads(kind, sizes, counts):
    """An autoreset is within. 72 machines are two groups, each with a thread of its own; 70 is in the second."""
    found = {}
    options = {"distributions": "inertia", "load": "inertia"}
    for num_envs, first, threads in sizes:
        with lanes_of(kind, num_envs, num_threads=threads, **options) as lanes:
            seeds = [20 + first + lane for lane in range(num_envs)]
            results = run(lanes, actions(lanes, steps_of(lanes) + 3, first), seed=seeds)[:4]
        for lane in range(num_envs):
            if first + lane in (0, 5, 70):
                found.setdefault(first + lane, []).append([column[:, lane] for column in results])
    assert {lane: len(runs) for lane, runs in found.items()} == counts
    for one, *others in found.values():
        for other in others:
            for expected, seen in zip(one, other, strict=True):
                np.testing.assert_array_equal(seen, expected)
    assert not np.array_equal(found[0][0][0], found[5][0][0])


@EVERY_KIND
def test_an_environment_that_is_reset_alone_begins_its_seed_anew_and_the_others_go_on(kind):
    with lanes_of(kind, 2, autoreset_mode="Disabled") as lanes:
        given = actions(lanes, 2)
        undisturbed = run(lanes, given, seed=[3, 4])[0]
        lanes.reset(seed=[3, 4])
        lanes.step(given[0])
        again, _ = lanes.reset(seed=[None, 4], options={"reset_mask": np.array([False, True])})
        np.testing.assert_array_equal(again[1], undisturbed[0, 1])
        np.testing.assert_array_equal(lanes.step(given[1])[0][0], undisturbed[2, 0])


@EVERY_KIND
def test_no_two_environments_of_neighbouring_seeds_have_the_same_machine(kind):
    """168 machines of 21 seeds and 8 environments, twice: the episode after is of another one again."""
    laws = {"parameters": {"motor.R_s": {"law": "uniform", "low": 0.9, "high": 1.1, "of": "default"}}}
    drawn = []
    with lanes_of(kind, 8, distributions=laws, load="inertia") as lanes:
        machines = lanes._machines
        for seed in range(21):
            lanes._reset_environments = lambda mask, options: (machines.redraw(lanes.rngs, mask), {})
            for given in (seed, None):
                lanes.reset(seed=given)
                drawn += machines.values["motor.R_s"].tolist()
    assert len(set(drawn)) == len(drawn) == 2 * 21 * 8


def randomised(kind):
    """Return options under which all is drawn that can be."""
    return {"distributions": "two_mass", "load": "two_mass"} if kind == "Tracking" else {}


# --- autoreset --------------------------------------------------------------------------------------------------------
@EVERY_KIND
def test_autoreset_modes_tell_the_same_episodes_and_their_final_observations(kind):
    with lanes_of(kind, 2, autoreset_mode="NextStep") as lanes:
        steps = steps_of(lanes)
        given = actions(lanes, steps + 1)
        assert lanes.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
        next_step = run(lanes, given)
    observations, rewards, terminated, truncated, infos = next_step
    assert truncated[:, 0].tolist() == [False] * (steps - 1) + [True, False] and not terminated.any()
    assert rewards[steps].tolist() == [0.0, 0.0]  # the step of the reset
    assert "final_obs" not in infos[-1]

    with lanes_of(kind, 2, autoreset_mode="SameStep") as lanes:
        same_step = run(lanes, given[:steps])
    info = same_step[4][-1]
    np.testing.assert_array_equal(same_step[0][:steps], observations[:steps])
    np.testing.assert_array_equal(np.stack(list(info["final_obs"])), observations[steps])
    np.testing.assert_array_equal(same_step[0][steps], observations[steps + 1])  # the next episode's first
    np.testing.assert_array_equal(same_step[1], rewards[:steps])
    assert info["_final_obs"].all() and same_step[3][-1].all()
    assert info["final_info"]["reward_terms"].keys() == infos[0]["reward_terms"].keys()

    with lanes_of(kind, 2, autoreset_mode="Disabled") as lanes:
        disabled = run(lanes, given[:steps])
        np.testing.assert_array_equal(disabled[0], observations[: steps + 1])
        with pytest.raises(gymnasium.error.ResetNeeded, match="environment 0 has ended"):
            lanes.step(given[0])
        again, _ = lanes.reset(options={"reset_mask": np.array([True, True])})
        np.testing.assert_array_equal(again, observations[steps + 1])


@pytest.mark.parametrize("kind", ["Tracking", "GainScheduling"])
def test_a_lane_that_trips_is_terminated_named_and_begins_anew_alone(kind):
    """The enable input of environment 1 opens; what 0 and 2 see does not change. GainTuning goes on after a fault."""
    options = {"duration": 0.4, "autoreset_mode": "SameStep"}
    with lanes_of(kind, 3, **options) as lanes:
        given = actions(lanes, 12)
        undisturbed = run(lanes, given)
    with lanes_of(kind, 3, **options) as lanes:
        lanes.reset(seed=0)
        ended = []
        for k, action in enumerate(given):
            if k == 4:
                lanes.drives.machine.enable_input = np.tile([True, False, True], (lanes._axes, 1)).T.reshape(-1)
            observation, reward, terminated, truncated, info = lanes.step(action)
            lanes.drives.machine.enable_input = lanes.drives.machine.enable_input | terminated.any()
            assert not truncated.any() and not terminated[[0, 2]].any()
            np.testing.assert_array_equal(observation[[0, 2]], undisturbed[0][k + 1, [0, 2]])
            np.testing.assert_array_equal(reward[[0, 2]], undisturbed[1][k, [0, 2]])
            if terminated[1]:
                ended.append(k)
                assert info["final_info"]["fault"][1] == "shutdown_switch"
                assert info["final_obs"][1].shape == observation[1].shape and info["final_obs"][0] is None
                assert reward[1] < undisturbed[1][k, 1] - 5.0
    assert len(ended) == 1 and ended[0] in (4, 5)


# --- an environment that is broken
# --------------------------------------------------------------------------------------------
@EVERY_KIND
@pytest.mark.filterwarnings("ignore:machine 1 left the range of physics:RuntimeWarning")
def test_a_broken_machine_leaves_the_others_bit_identical(kind):
    with lanes_of(kind, 9) as lanes:
        steps = steps_of(lanes)
        given = actions(lanes, steps)
        undisturbed = run(lanes, given)
    with lanes_of(kind, 9) as lanes:
        lanes.reset(seed=0)
        if kind == "GainTuning":  # a trial begins with a reset
            phase = lanes._trials._phase
            lanes._trials._phase = lambda *arguments: (break_machine(lanes, 1), phase(*arguments))[1]
        others = np.arange(9) != 1
        seen = 0
        for k, action in enumerate(given):
            broken = k in (0, 1)
            if broken:
                break_machine(lanes, 1)
            observation, reward, terminated, truncated, info = lanes.step(action)
            assert not terminated[1] or "diverged" in info["fault"][1]
            seen += lanes.drives.machine.diverged[1]
            if broken:
                mend_machine(lanes)
            np.testing.assert_array_equal(observation[others], undisturbed[0][k + 1, others])
            np.testing.assert_array_equal(reward[others], undisturbed[1][k, others])
            np.testing.assert_array_equal(terminated[others], undisturbed[2][k, others])
            np.testing.assert_array_equal(truncated[others], undisturbed[3][k, others])
            assert lanes.observation_space.contains(observation)
            assert np.isfinite(reward).all()
    assert seen


# --- what info carries ------------------------------------------------------------------------------------------------
@EVERY_KIND
def test_info_carries_reward_terms_true_parameters_and_named_faults(kind):
    with lanes_of(kind, 2, **randomised(kind)) as lanes:
        _, begun = lanes.reset(seed=0)
        reward, info = (result := lanes.step(actions(lanes, 1)[0]))[1], result[4]
        true = lanes.drives.machine.parameters
        weights = getattr(lanes.config, "weights", dict.fromkeys(info["reward_terms"], 1.0))
    for name, values in true.items():
        np.testing.assert_array_equal(begun["parameters"][name], values)
    signs = {"trip": -1.0} if kind == "Tracking" else {}
    total = sum(weights[name] * signs.get(name, 1.0) * term for name, term in info["reward_terms"].items())
    np.testing.assert_allclose(reward, total, rtol=1e-12)
    assert len(np.unique(begun["parameters"]["load.coulomb"])) == 2  # every environment has its own machine


# --- the curriculum ---------------------------------------------------------------------------------------------------
SCHEDULE = {
    "parameters": {"motor.psi_m": {"law": "choice", "values": [0.9, 1.1], "of": "default"}},
    "curriculum": {"steps": [0, 30], "stage": [0.0, 1.0]},
}


@EVERY_KIND
def test_a_curriculum_is_a_schedule_over_the_distributions(kind):
    with lanes_of(kind, 4, distributions=SCHEDULE) as lanes:
        lanes.stage = lanes.curriculum.stage_at(0)
        narrow = lanes.reset(seed=0)[1]["parameters"]["motor.psi_m"] / lanes.drives.motor.psi_m
        lanes.stage = lanes.curriculum.stage_at(30)
        wide = lanes.reset(seed=0)[1]["parameters"]["motor.psi_m"] / lanes.drives.motor.psi_m
        with pytest.raises(ValueError, match=r"stage of the curriculum must lie in 0\.\.\.1, not 1\.5"):
            lanes.stage = 1.5
    assert np.all(narrow == 1.0)
    assert sorted(set(np.round(wide, 6))) == [0.9, 1.1]


@EVERY_KIND
def test_stable_baselines_view_follows_the_schedule(kind):
    with lanes_of(kind, 2, distributions=SCHEDULE, autoreset_mode="SameStep") as lanes:
        env = DriveVecEnv(lanes)
        env.reset()
        assert lanes.stage == 0.0
        for k in range(1, 4):
            env.step(actions(lanes, 1)[0])
            assert lanes.stage == pytest.approx(2 * k / 30)


# --- another kind of drive --------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("kind", "load"),
    [
        ("Tracking", "gantry"),
        ("GainScheduling", "inertia"),
        pytest.param("GainTuning", "inertia", marks=pytest.mark.slow),  # takes some seconds
        pytest.param("GainTuning", "gantry", marks=pytest.mark.slow),
    ],
)
def test_an_amplifier_on_mains_is_a_drive_like_any_other(kind, load):
    """The TGZ: torques in parts of a peak current, speeds by 6094h, a D-Mode of its own; random machines."""
    with lanes_of(kind, 2, device="tgz_d", load=load) as lanes:
        steps = steps_of(lanes)
        observations, rewards, ends, cuts, _ = run(lanes, actions(lanes, steps))
        assert all(lanes.observation_space.contains(one) for one in observations)
        assert np.isfinite(rewards).all()
        assert not ends.any() and cuts[-1].all()
        assert (np.ptp(observations, axis=0) > 0.0).any(axis=-1).all(), "both machines move"
        again = run(lanes, actions(lanes, steps))[0]
        np.testing.assert_array_equal(observations, again)


# --- a wrong configuration --------------------------------------------------------------------------------------------
@EVERY_KIND
@pytest.mark.parametrize(("options", "says"), [
    ({"device": "tmcm"}, "no device is named 'tmcm'; there are tgz_d, tgz_d_2026"),
    ({"load": "crane"}, "no load is named 'crane'; there are arm, ball_screw, belt"),
    ({"motor": "big"}, "qbl4208"),
    ({"friction": "wet"}, "no friction is named 'wet'; there are none, coulomb_viscous, stribeck, lugre"),
    ({"distributions": "sand"}, "no set of distributions is named 'sand'; there are arm"),
    ({"autoreset_mode": "Never"}, "'NextStep', 'SameStep', 'Disabled', not 'Never'"),
    ({"render_mode": "ansi"}, "render_mode is one of None, 'rgb_array', 'human', not 'ansi'"),
    ({"colour": 1}, "there is no option 'colour'; there are load, device, motor"),
    ({"stage": 2.0}, r"must lie in 0\.\.\.1, not 2"),
    ({"stage": "half"}, "stage must be a number, not 'half'"),
    ({"num_threads": 1.5}, "num_threads must be a whole number or left out, not 1.5"),
    ({"motor": 7}, "motor must be a motor's name, the path of its file, or a Motor( or left out)?, not 7"),
])  # fmt: skip
def test_a_wrong_value_names_the_valid_ones(kind, options, says):
    with pytest.raises(ValueError, match=says):
        KINDS[kind][0](1, **options)


def test_stable_baselines_wants_the_next_episode_in_the_step_that_ends_one():
    with lanes_of("Tracking", 2) as lanes, pytest.raises(ValueError, match="SameStep"):
        DriveVecEnv(lanes)


@EVERY_KIND
def test_a_configuration_comes_back_from_json(kind):
    """As agents and datasets keep it: JSON has no infinity, which Tracking's `fall` is where nothing falls."""
    from agents.tasks import configuration_of

    with lanes_of(kind) as lanes:
        kept = json.loads(json.dumps(configuration_of(lanes), allow_nan=False))
        with lanes_of(kind, config=kept) as again:
            assert again.config == lanes.config


@EVERY_KIND
def test_a_load_of_ones_own(kind):
    from mechanics import Load

    own = LOADS["inertia"].mjcf
    for load in (own, str(own), Load(own, joints=("shaft",))):
        with lanes_of(kind, 1, load=load) as lanes:
            lanes.reset(seed=0)
            assert lanes.observation_space.contains(lanes.step(actions(lanes, 1)[0])[0])


# --- a million steps --------------------------------------------------------------------------------------------------
# Steps in all, over every load; a step of GainTuning is three moves of 250 ms, and as much again for each variant.
MILLION = {"Tracking": 1_000_000, "GainScheduling": 1_000_000, "GainTuning": 20_000}
LANES = {"Tracking": 256, "GainScheduling": 256, "GainTuning": 64}


@pytest.mark.slow
@EVERY_KIND_AND_LOAD
def test_random_agents_on_randomised_machines_stay_in_the_spaces(kind, load):
    """No exception, no warning, no observation outside its box, no reward that is not finite."""
    num_envs = LANES[kind]
    long = {"Tracking": {"duration": 0.5}, "GainScheduling": {"duration": 0.5}, "GainTuning": {"trials": 4}}[kind]
    if kind == "Tracking":
        long["distributions"] = load
    environment = KINDS[kind][0]
    lanes = environment(num_envs, load=load, num_threads=2, autoreset_mode="SameStep", **long)
    low, high = lanes.action_space.low, lanes.action_space.high
    rng = np.random.default_rng(0)
    lanes.reset(seed=0)
    for k in range(-(-MILLION[kind] // len(LOADS) // num_envs)):
        scale = 0.2 if k % 200 < 100 else 1.0
        observation, reward, *_ = lanes.step((scale * rng.uniform(low, high)).astype(np.float32))
        assert observation.dtype == np.float32
        assert lanes.observation_space.contains(observation), np.argwhere(
            (observation < lanes.observation_space.low) | (observation > lanes.observation_space.high)
        )
        assert np.isfinite(reward).all()
    lanes.close()
