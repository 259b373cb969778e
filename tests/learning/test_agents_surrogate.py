"""The surrogate tuner: its network against torch, what it learns, proposes, answers and remembers; what ships."""

from __future__ import annotations

import json

import numpy as np
import pytest

from agents.policies.agent_file import MAX_BYTES, AgentFile
from agents.policies.policy import PolicyError, load_policy, policy_of
from agents.shipped import find_agent, shipped, shipped_names
from agents.tuner.surrogate import CONTEXT, IDENTIFIED, SHOWN, SurrogatePolicy
from drive_env.envs.gain_tuning import GainTuningConfig
from research import surrogate_training as training
from research.tuner_recipes import RECIPES, TrainingMachines, laws

RECIPE = RECIPES["tmcm1636"]
G = len(RECIPE.gains)
ENTRIES = IDENTIFIED + 2 * G + 2 * SHOWN
LOW, HIGH = np.array(RECIPE.low), np.array(RECIPE.high)


def trials(machines=1_000, count=6, seed=0):
    """Trials of machines whose best gains nothing tells but a trial, the rule's excepted: it shows how far they are."""
    from research.surrogate_fit import TrialData

    rng = np.random.default_rng(seed)
    best = rng.uniform(-1.0, 1.0, (machines, 1, G))
    gains = rng.uniform(LOW, HIGH, (machines, count, G))
    context = np.zeros((machines, CONTEXT))
    shown = np.zeros((machines, count, SHOWN))
    shown[..., :G] = gains - best
    worth = np.abs(gains - best).sum(axis=2) - 2.0
    return TrialData(*(column.astype(np.float32) for column in (context, gains, shown, worth)))


def fitted(epochs):
    fitting = pytest.importorskip("research.surrogate_fit", reason="fitting takes torch", exc_type=ImportError)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fitting, "BATCH", 32)  # many steps for little data
        patch.setattr(fitting, "EPOCHS", epochs)
        return training.bundle_of(RECIPE, fitting.fit(trials(), RECIPE.reach, 0, 2), {})


@pytest.fixture(scope="module")
def bundle():
    """A tuner that has hardly learnt: for what holds of any."""
    return fitted(1)


@pytest.fixture
def policy(bundle):
    return SurrogatePolicy(bundle)


@pytest.fixture(scope="module")
def learnt():
    return SurrogatePolicy(fitted(30))


def observation(lanes, seed=1):
    """Observations of machines with one axis, the last entry the trials left."""
    values = np.random.default_rng(seed).normal(0.0, 0.3, (lanes, ENTRIES + 1))
    return values.astype(np.float32)


def after(gains, shown=0.0):
    """An observation after a trial of gains, (environments, G) over the rule's, from the rule's gains as incumbent."""
    gains = np.atleast_2d(gains)
    seen = np.zeros((len(gains), ENTRIES + 1), np.float32)
    seen[:, IDENTIFIED : IDENTIFIED + G] = gains
    at = IDENTIFIED + 2 * G
    seen[:, at : at + G] = shown
    return seen


def says(median, scale=lambda gains: 0.0 * gains[..., 0]):
    """What stands in for the networks: functions of gains."""
    return lambda memory, gains: (median(gains), scale(gains))


# --- the network ------------------------------------------------------------------------------------------------------
def test_trials_of_rounds_with_fewer_are_joined_and_the_missing_count_for_nothing():
    fitting = pytest.importorskip("research.surrogate_fit", reason="fitting takes torch", exc_type=ImportError)
    long, short = trials(40, 6, seed=1), trials(30, 4, seed=2)
    joined = fitting.join([long, short])
    assert joined.worth.shape == (70, 6) and joined.gains.shape == (70, 6, G)
    np.testing.assert_array_equal(joined.worth[40:, :4], short.worth)
    assert np.isnan(joined.worth[40:, 4:]).all() and np.isfinite(joined.worth[:40]).all()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fitting, "EPOCHS", 1)
        first = fitting.fit(joined, RECIPE.reach, 0, 1)
        joined.gains[40:, 4:], joined.shown[40:, 4:] = 5.0, -5.0
        again = fitting.fit(joined, RECIPE.reach, 0, 1)
    for name, array in first.items():
        np.testing.assert_array_equal(array, again[name], err_msg=name)


@pytest.mark.slow
def test_the_networks_are_torchs(bundle, policy):
    torch = pytest.importorskip("torch")
    from research.surrogate_fit import SurrogateNetwork

    rng = np.random.default_rng(2)
    machines, tried, asked = 5, 4, 7
    shapes = ((machines, CONTEXT), (machines, asked, G), (machines, tried, G), (machines, tried, SHOWN))
    context, gains, before, shown = (rng.normal(size=shape).astype(np.float32) for shape in shapes)
    known = rng.random((machines, tried)) < 0.6
    known[:, 0] = True
    for k, network in enumerate(policy._networks):
        twin = SurrogateNetwork(G)
        state = {
            name.replace("_weight", ".weight").replace("_bias", ".bias"): torch.tensor(array[k].astype(np.float32).T)
            for name, array in bundle.arrays.items()
            if name in ("nearness",) or name.endswith(("_weight", "_bias"))
        }
        twin.load_state_dict(state)
        with torch.no_grad():
            expected = twin(*map(torch.tensor, (context, gains, before, shown, known))).numpy()
        median, ln_scale = network.ask(network.read(context, before, shown, known), gains)
        assert median == pytest.approx(expected[..., 0], abs=1e-4)
        assert ln_scale == pytest.approx(np.clip(expected[..., 1], -3.5, 1.0), abs=1e-4)


@pytest.mark.slow
def test_neither_the_order_of_trials_matters_nor_what_is_not_known(policy):
    rng = np.random.default_rng(3)
    context, gains, shown = (rng.normal(size=s).astype(np.float32) for s in ((2, CONTEXT), (2, 4, G), (2, 4, SHOWN)))
    known = np.array([[True, True, False, True]] * 2)
    network, asked = policy._networks[0], rng.normal(size=(2, 5, G)).astype(np.float32)
    first = network.ask(network.read(context, gains, shown, known), asked)
    order = [3, 2, 0, 1]
    gains[:, 2], shown[:, 2] = 7.0, -7.0  # the unknown one
    second = network.ask(network.read(context, gains[:, order], shown[:, order], known[:, order]), asked)
    assert second[0] == pytest.approx(first[0], abs=1e-5)
    assert second[1] == pytest.approx(first[1], abs=1e-5)


@pytest.mark.slow
def test_training_learns_to_foresee_from_other_trials_and_to_judge_a_trial_by_itself(learnt):
    """The mean error of ln J over machines not trained on: nothing known, others known, the trial itself known."""
    test = trials(200, seed=5)
    asked = test.gains[:, -1:]

    def error(known):
        learnt.reset()
        learnt._take(after(np.zeros((200, G))))
        for k in known:
            learnt._take(after(test.gains[:, k], shown=test.shown[:, k, :G]))
        return np.abs(learnt._ask(learnt._read(), asked)[0] - test.worth[:, -1:]).mean()

    nothing, others, itself = error([]), error(range(5)), error(range(6))
    assert others < 0.7 * nothing
    assert itself < 0.7 * nothing


# --- what it proposes -------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_the_next_trial_is_the_best_of_all_candidates_wherever_the_incumbent_is(policy, monkeypatch):
    best = np.array([0.4, -1.5, 1.2], np.float32)
    monkeypatch.setattr(policy, "_ask", says(lambda gains: np.abs(gains - best).sum(axis=-1)))
    seen = after(np.zeros((2, G)))
    incumbent = np.array([0.3, -0.3, 0.9], np.float32)
    seen[1, IDENTIFIED + G : IDENTIFIED + 2 * G] = incumbent
    action = training.STEP * policy.act(seen)
    assert action[0] == pytest.approx(best, abs=0.3)
    assert action[1] + incumbent == pytest.approx(action[0], abs=1e-6)


@pytest.mark.slow
def test_trials_lie_within_the_range_and_the_action_is_a_share_of_the_step(bundle, monkeypatch):
    narrow = AgentFile(bundle.kind, bundle.arrays, {**bundle.settings, "step": 0.5}, "none")
    for one, step in ((bundle, training.STEP), (narrow, 0.5)):
        policy = SurrogatePolicy(one)
        monkeypatch.setattr(policy, "_ask", says(lambda gains: -gains.sum(axis=-1)))
        action = policy.act(after(np.zeros((1, G))))[0]
        assert np.all(step * action <= HIGH + 1e-6)
        assert np.abs(action).max() <= 1.0
    assert action == pytest.approx([1.0, 1.0, 1.0])


@pytest.mark.slow
def test_curiosity_seeks_what_is_not_known(bundle, monkeypatch):
    reached = {}
    for curiosity in (0.0, 2.0):
        policy = SurrogatePolicy(
            AgentFile(bundle.kind, bundle.arrays, {**bundle.settings, "curiosity": curiosity}, "none")
        )
        far = says(lambda gains: gains[..., 2], scale=lambda gains: gains[..., 2])
        monkeypatch.setattr(policy, "_ask", far)
        reached[curiosity] = training.STEP * policy.act(after(np.zeros((1, G))))[0, 2]
    assert reached[0.0] < LOW[2] + 0.1
    assert reached[2.0] > HIGH[2] - 0.1


@pytest.mark.slow
def test_it_finds_what_only_trials_tell(learnt):
    """Machines of the kind that was trained on, in five trials: each says where to look next."""
    best = np.random.default_rng(6).uniform(-1.0, 1.0, (30, 1, G))[:, 0]
    tried = np.zeros((30, G))
    distance = []
    for _ in range(6):
        distance.append(np.abs(tried - best).sum(axis=1))
        shown = tried - best if np.any(tried) else 0.0  # the rule's trial shows nothing
        tried = training.STEP * learnt.act(after(tried, shown=shown))  # the rule stays the incumbent
    assert np.mean(distance[3]) < 0.6 * np.mean(distance[1])
    assert np.mean(np.min(distance[1:], axis=0)) < 0.4 * np.mean(distance[0])


# --- what it answers --------------------------------------------------------------------------------------------------
TRIED = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.5]])


@pytest.mark.parametrize(("median", "scale", "answer"), [
    ((0.0, -0.1, -0.2, -0.3), (0.0, 0.0, 0.0, 0.0), 3),  # the least median
    ((0.0, +0.1, +0.2, +0.3), (0.0, 0.0, 0.0, 0.0), 0),  # nothing is better: the rule's gains
    ((0.0, -0.1, -0.2, -0.3), (0.0, 0.0, 0.0, 1.0), 2),  # caution: of what is sure
])  # fmt: skip
def test_the_answer_is_the_trial_with_the_least_median_that_is_sure(bundle, monkeypatch, median, scale, answer):
    policy = SurrogatePolicy(AgentFile(bundle.kind, bundle.arrays, {**bundle.settings, "caution": 1.0}, "none"))
    for gains in TRIED[:-1]:
        policy._take(after(gains))
    monkeypatch.setattr(policy, "_ask", lambda memory, gains: (np.array([median]), np.array([scale])))
    last = after(TRIED[-1])
    last[:, IDENTIFIED + G : IDENTIFIED + 2 * G] = TRIED[1]  # the incumbent, from which an action counts
    assert training.STEP * policy.answer(last)[0] == pytest.approx(TRIED[answer] - TRIED[1], abs=1e-6)


def test_the_axes_of_a_machine_stay_with_one_trial(policy, monkeypatch):
    """Two axes, of which either likes another trial; the third one is second best for both."""
    medians = np.array([[0.0, -3.0, 1.0, -1.0], [0.0, 1.0, -3.0, -1.0]])
    monkeypatch.setattr(policy, "_ask", lambda memory, gains: (medians[:, : gains.shape[1]], 0.0 * gains[..., 0]))
    steps = [np.concatenate([after(gains)[0, :-1]] * 2 + [np.zeros(1)]) for gains in TRIED]
    for seen in steps[:-1]:
        policy._take(seen)
    assert training.STEP * policy.answer(steps[-1]) == pytest.approx(np.tile(TRIED[3], 2), abs=1e-6)


# --- what it remembers ------------------------------------------------------------------------------------------------
def test_lanes_know_nothing_of_each_other(bundle):
    steps = [observation(3, seed) for seed in range(4)]
    together = SurrogatePolicy(bundle)
    found = [together.act(step) for step in steps]
    for lane in range(3):
        alone = SurrogatePolicy(bundle)
        assert [alone.act(step[lane]) for step in steps] == [pytest.approx(f[lane], abs=1e-4) for f in found]


def test_reset_forgets_the_lanes_of_its_mask(bundle):
    steps = [observation(2, seed) for seed in range(4)]
    policy, fresh = SurrogatePolicy(bundle), SurrogatePolicy(bundle)
    for step in steps[:3]:
        policy.act(step)
    policy.reset(np.array([True, False]))
    again = policy.act(steps[3])
    assert again[0] == pytest.approx(fresh.act(steps[3][0]), abs=1e-4)
    assert policy._known.sum(axis=1).tolist() == [1, 4]
    policy.reset()
    assert policy.act(steps[3]) == pytest.approx(SurrogatePolicy(bundle).act(steps[3]), abs=1e-4)


def test_what_is_no_observation_is_told(policy):
    with pytest.raises(PolicyError, match=r"takes 42 entries per axis and one more, not 40"):
        policy.act(np.zeros(40))
    with pytest.raises(PolicyError, match="holds NaN"):
        policy.act(np.full(ENTRIES + 1, np.nan))


# --- training and judging ---------------------------------------------------------------------------------------------
def test_figures_are_those_of_the_machines():
    ratios = np.array([[0.2] * 50, [0.4] * 44 + [1.2] * 6])
    found = training.figures_of(ratios)
    assert found["median"] == pytest.approx(0.3)
    assert found["share more than 5 % worse"] == pytest.approx(0.06)
    assert found["p95"] == pytest.approx(1.2)
    low, high = found["share more than 5 % worse, 95 % interval"]
    assert low == pytest.approx(0.06 - 1.96 * np.sqrt(0.06 * 0.94 / 100), abs=0.02)
    assert high == pytest.approx(0.06 + 1.96 * np.sqrt(0.06 * 0.94 / 100), abs=0.02)


class Constant:
    """A tuner that tries one change from the incumbent for ever, and answers another."""

    def __init__(self, change, answer):
        self._change, self._answer = change, answer

    def reset(self, mask=None):
        pass

    def act(self, seen):
        return np.full((len(seen), G), self._change, np.float32)

    def answer(self, seen):
        return np.full((len(seen), G), self._answer, np.float32)


def test_a_tuner_that_answers_the_rules_gains_has_the_rules_hidden_j_and_one_that_tried_nothing_else_may_not(
    monkeypatch,
):
    monkeypatch.setattr(training, "TRIALS", 1)
    one = RECIPE._replace(rows=(TrainingMachines("inertia", "ec_i_40"),))
    found = training.judge(one, Constant(0.0, 0.0), 2, 5)
    assert found.ratio == pytest.approx(1.0) and found.best == pytest.approx(1.0)
    with pytest.raises(RuntimeError, match="answered gains that it had not tried"):
        training.judge(one, Constant(0.0, 0.5), 2, 5)


@pytest.mark.slow
def test_training_from_nothing_makes_a_tuner_repeats_and_goes_on_from_kept_trials(tmp_path):
    rounds = (training.Round(sets=1, trials=8), training.Round(sets=1, trials=10))
    one = RECIPE._replace(rows=(TrainingMachines("inertia", "ec_i_40"),))
    few = training.Budget(rounds, machines=2, networks=3, judged=2)
    first = training.train(one, 3, budget=few, kept=tmp_path)
    (tmp_path / "trials_3_1_0_0.npz").unlink()  # stopped in its second round
    for other in (training.train(one, 3, budget=few, kept=tmp_path), training.train(one, 3, budget=few)):
        for name, array in first.arrays.items():
            assert np.array_equal(array, other.arrays[name]), name
    assert first.card["machines"] == 2 * 2 and first.card["trials"] == 2 * 8 + 2 * 10
    assert training.judge(one, policy_of(first), 2, 5).ratio.shape == (1, 2)


@pytest.mark.slow
@pytest.mark.parametrize("device", sorted(RECIPES))
def test_a_recipe_makes_a_tuner_of_its_device_with_figures(device, tmp_path, monkeypatch):
    """From the command line, of its first row's machines."""
    pytest.importorskip("research.surrogate_fit", reason="fitting takes torch", exc_type=ImportError)
    one = RECIPES[device]._replace(rows=RECIPES[device].rows[:1], dynamics=("standard",))
    monkeypatch.setitem(training.RECIPES, device, one)
    few = training.Budget((training.Round(1, 2), training.Round(1, 2)), machines=2, networks=1, judged=2)
    monkeypatch.setitem(training.BUDGETS, "quick", few)
    file = tmp_path / "mine.npz"
    training.main(["--device", device, "--budget", "quick", "--out", str(file)])
    made = AgentFile.load(file)
    assert GainTuningConfig(**made.configuration).device == device
    assert made.card["holds for"]["devices"] == [device] and made.card["trials"] == 2 * 2 * 2
    assert made.card["figures"]["machines"] == 2
    assert made.card["figures"]["median of the factory's gains"] > 0.0
    assert len(made.settings["low"]) == len(one.gains)
    # What it ends with is a trial, and the figure is that of the same machines and trials.
    again = training.judge(one, policy_of(made), 2, made.card["figures"]["seed"])
    assert np.median(again.ratio) == pytest.approx(made.card["figures"]["median"], abs=1e-3)


def test_a_load_of_more_times_has_that_inertia_stiffness_and_friction_and_the_same_frequencies():
    row = TrainingMachines("two_mass", "am3041_e", 16.0)
    small, large = (dict(laws(RECIPES["tgz_d"], row._replace(times=times)).laws) for times in (1.0 + 1e-12, 16.0))
    scaled = {f"load.{name}" for name in ("inertia", "stiffness", "damping", "coulomb", "breakaway", "viscous")}
    for name, law in small.items():
        times = 16.0 if name in scaled else 1.0
        assert (large[name].low, large[name].high) == pytest.approx((times * law.low, times * law.high)), name
    assert scaled <= set(small)
    assert laws(RECIPES["tmcm1636"], RECIPES["tmcm1636"].rows[0]) is None, "as it ships"


# --- what ships -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", shipped_names())
def test_a_shipped_agent_is_small_and_has_a_card(name):
    path = shipped(name)
    assert path.stat().st_size < MAX_BYTES
    card = AgentFile.load(path).card
    assert {"trained", "distribution", "figures", "limits"} <= set(card)


def test_agents_are_found_by_name_or_file(tmp_path):
    assert find_agent("gain_tuning") == shipped("gain_tuning")
    assert find_agent(str(tmp_path / "mine.npz")) == tmp_path / "mine.npz"
    with pytest.raises(ValueError, match="no agent named 'nobody' ships; there are arm_path, gain_tuning, "):
        find_agent("nobody")


@pytest.mark.slow
def test_the_shipped_tuner_performs_as_its_card_says():
    """On the card's own machines, of every kind, figure by figure: they are drawn from a seed and never trained on."""
    card = AgentFile.load(shipped("gain_tuning")).card["figures"]
    machines = training.BUDGETS["full"].judged
    found = training.judge(RECIPE, load_policy(shipped("gain_tuning")), machines, card["seed"])
    assert found.ratio.size == card["machines"] >= 200
    for name, figure in training.figures_of(found.ratio).items():
        np.testing.assert_allclose(figure, card[name], atol=0.03, err_msg=name)
    for row, ratio in zip(RECIPE.rows, found.ratio, strict=True):
        assert np.median(ratio) == pytest.approx(card["median of each row"][row.name], abs=0.05), row.name
    assert found.aborted.mean() == pytest.approx(card["trials that were stopped"], abs=0.03)


def test_the_shipped_tuner_is_of_this_trainings_kind():
    """What acts is what the documented command makes: settings and configuration are those of the code."""
    ships, made = AgentFile.load(shipped("gain_tuning")), training.bundle_of(RECIPE, {}, {})
    assert (ships.kind, ships.configuration) == (made.kind, made.configuration)
    assert ships.settings == json.loads(json.dumps(dict(made.settings)))


@pytest.mark.parametrize("phase", range(3))
def test_what_was_stopped_in_any_phase_is_no_answer(phase, monkeypatch):
    """Though the network thinks most of it."""
    policy = load_policy(shipped("gain_tuning"))
    first, second = np.zeros((2, 2, 43), np.float32)  # two machines
    second[:, 4:7] = 1.0  # the trial's gains, ln over the rule's
    second[0, 10 + 5 * phase + 4] = 1.0  # of the first machine it was stopped
    policy.act(first)
    monkeypatch.setattr(policy, "_ask", lambda memory, gains: (-gains.sum(axis=-1), np.zeros(gains.shape[:2])))
    assert (policy.bundle.settings["step"] * policy.answer(second)).tolist() == [[0.0] * 3, [1.0] * 3]
