"""The surrogate tuner: its networks against torch, its process against closed forms, its memory; what ships."""

from __future__ import annotations

import numpy as np
import pytest

from agents import surrogate_training as training
from agents.bundle import MAX_BYTES, Bundle
from agents.evaluation import evaluate
from agents.policy import PolicyError, load_policy, policy_of
from agents.shipped import find_agent, shipped, shipped_names
from agents.surrogate import IDENTIFIED, SHOWN, Ensemble, SurrogatePolicy

ENTRIES = IDENTIFIED + 6 + 2 * SHOWN


def trials(count=2_500, seed=0):
    """Data whose worth is known: a bowl around gains that the first entry of the context moves."""
    rng = np.random.default_rng(seed)
    context, gains, shown = (rng.normal(size=(count, n)).astype(np.float32) for n in (IDENTIFIED + SHOWN, 3, SHOWN))
    worth = np.square(gains - 0.3 * context[:, :1]).sum(axis=1) - 1.0
    return training.Data(context, gains, shown, worth.astype(np.float32))


@pytest.fixture(scope="module")
def bundle():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "BATCH", 128)  # many steps for little data
        return training.bundle_of(training.fit(trials(), 0), {})


@pytest.fixture
def policy(bundle):
    return SurrogatePolicy(bundle)


def observation(lanes, seed=1):
    """Observations of machines with one axis, the last entry the trials left."""
    values = np.random.default_rng(seed).normal(0.0, 0.3, (lanes, ENTRIES + 1))
    return values.astype(np.float32)


def test_the_networks_are_torchs(bundle):
    torch = pytest.importorskip("torch")
    inputs = np.random.default_rng(2).normal(size=(50, IDENTIFIED + SHOWN + 3)).astype(np.float32)
    arrays = {name.removeprefix("f_"): torch.tensor(np.asarray(a, np.float32)) for name, a in bundle.arrays.items()}
    x = ((torch.tensor(inputs) - arrays["mean"]) * arrays["scale"]).clamp(-6.0, 6.0)
    outputs = []
    for k in range(training.NETWORKS):
        h = torch.nn.functional.silu(x @ arrays["w0"][k] + arrays["b0"][k])
        h = torch.nn.functional.silu(h @ arrays["w1"][k] + arrays["b1"][k])
        outputs.append(h @ arrays["w2"][k] + arrays["b2"][k])
    mean, deviation = Ensemble(bundle, "f")(inputs)
    assert mean == pytest.approx(torch.stack(outputs).mean(dim=0).numpy(), abs=1e-5)
    assert deviation == pytest.approx(torch.stack(outputs).std(dim=0, correction=0).numpy(), abs=1e-5)


def test_training_finds_the_bowl(policy):
    test = trials(400, seed=5)
    for ensemble, inputs in (
        (policy._unseen, [test.context, test.gains]),
        (policy._seen, [test.context, test.gains, test.shown]),
    ):
        found = ensemble(np.concatenate(inputs, axis=1))[0]
        assert np.corrcoef(found, test.worth)[0, 1] > 0.8


def test_it_proposes_what_the_training_says_is_best(policy):
    """The bowl's bottom lies at 0.3 of the context's first entry: from the rule's gains it is sought there."""
    seen = np.zeros((2, ENTRIES + 1), np.float32)
    seen[:, 0] = (2.0, -2.0)
    action = policy.act(seen)
    assert np.all(action[0] > 0.0) and np.all(action[1] < 0.0)
    assert np.all(np.abs(action) <= training.STEP)


def test_the_process_is_that_of_the_book(policy):
    """One trial: mean v k r / (v + n) and variance v - (v k)^2 / (v + n), k = exp(-d^2 / 2 l^2)."""
    policy.act(observation(1))
    candidates = (policy._tried[:, 0] + np.array([[0.0, 0.0, 0.0], [0.3, -0.4, 0.0]], np.float32))[None]
    v, length, n = (training.SETTINGS[name] for name in ("variance", "length", "noise"))
    k = np.exp(-0.5 * np.array([0.0, 0.25]) / length**2)
    mean, deviation = policy._process(candidates, np.array([[0.8]], np.float32))
    assert mean[0] == pytest.approx(v * k * 0.8 / (v + n), rel=1e-4)
    assert deviation[0] ** 2 == pytest.approx(v - (v * k) ** 2 / (v + n), rel=1e-3)


def test_a_trial_that_disappoints_moves_the_next_one(bundle):
    """The same machine, once after a trial that showed what was expected, once after one that showed far worse."""
    asked = []
    for worse in (0.0, 3.0):
        policy = SurrogatePolicy(bundle)
        policy.act(np.zeros(ENTRIES + 1, np.float32))
        policy._worth[:] += worse
        asked.append(policy._process(policy._tried + 0.1, policy._worth - policy._ask(policy._tried)[0])[0][0, 0])
    assert asked[1] > asked[0] + 1.0


def test_it_stays_near_what_was_better_than_expected_and_leaves_what_was_worse(bundle):
    """Networks that know nothing: only the process speaks, and its deviation where nothing was tried."""
    blank = Bundle(bundle.kind, {name: 0.0 * array for name, array in bundle.arrays.items()}, bundle.settings, "none")
    distance = {}
    for surprise in (-3.0, 0.0, 3.0):
        policy = SurrogatePolicy(blank)
        policy.act(np.zeros(ENTRIES + 1, np.float32))
        policy._worth[:] = surprise
        distance[surprise] = np.linalg.norm(policy._propose(np.zeros((1, 3), np.float32)))
    assert distance[-3.0] < 0.2
    assert distance[0.0] > 0.9 and distance[3.0] > 0.9


def test_lanes_know_nothing_of_each_other(bundle):
    steps = [observation(3, seed) for seed in range(4)]
    together = SurrogatePolicy(bundle)
    found = [together.act(step) for step in steps]
    for lane in range(3):
        alone = SurrogatePolicy(bundle)
        assert [alone.act(step[lane]) for step in steps] == [pytest.approx(f[lane], abs=1e-6) for f in found]


def test_reset_forgets_the_lanes_of_its_mask(bundle):
    steps = [observation(2, seed) for seed in range(4)]
    policy, fresh = SurrogatePolicy(bundle), SurrogatePolicy(bundle)
    for step in steps[:3]:
        policy.act(step)
    policy.reset(np.array([True, False]))
    again = policy.act(steps[3])
    assert again[0] == pytest.approx(fresh.act(steps[3][0]), abs=1e-6)
    policy.reset()
    assert policy.act(steps[3]) == pytest.approx(SurrogatePolicy(bundle).act(steps[3]), abs=1e-6)


def test_what_is_no_observation_is_told(policy):
    with pytest.raises(PolicyError, match=r"takes 42 entries per axis and one more, not 40"):
        policy.act(np.zeros(40))
    with pytest.raises(PolicyError, match="holds what is no number"):
        policy.act(np.full(ENTRIES + 1, np.nan))


@pytest.mark.slow
def test_training_from_nothing_makes_a_tuner_and_repeats():
    made = [training.train(3, sets=(1, 1), lanes=2, rows=[("inertia", "ec_i_40")]) for _ in range(2)]
    for name, array in made[0].arrays.items():
        assert np.array_equal(array, made[1].arrays[name]), name
    assert made[0].card["trials"] == 2 * 2 * 10
    assert training.judge(policy_of(made[0]), 2, 5, [("inertia", "ec_i_40")]).shape == (1, 2)


# --- what ships -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", shipped_names())
def test_a_shipped_agent_is_small_and_has_a_card(name):
    path = shipped(name)
    assert path.stat().st_size < MAX_BYTES
    card = Bundle.load(path).card
    assert {"trained", "distribution", "figures", "limits"} <= set(card)


def test_agents_are_found_by_name_or_file(tmp_path):
    assert find_agent("gain_tuning") == shipped("gain_tuning")
    assert find_agent(str(tmp_path / "mine.npz")) == tmp_path / "mine.npz"
    with pytest.raises(ValueError, match="no agent named 'nobody' ships; there are gain_tuning, tracking_"):
        find_agent("nobody")


def test_the_shipped_tuner_performs_as_its_card_says():
    """On machines of a seed of their own: below the rule by far, and rarely worse."""
    ratios = training.judge(load_policy(shipped("gain_tuning")), 16, 4242, training.TRAINING[:4])
    card = Bundle.load(shipped("gain_tuning")).card["figures"]
    assert np.median(ratios) < 1.3 * card["median"]
    assert np.mean(ratios > 1.05) < 0.15


@pytest.mark.parametrize("name", [name for name in shipped_names() if name.startswith("tracking")])
def test_the_shipped_controllers_perform_as_their_cards_say(name):
    bundle = Bundle.load(shipped(name))
    found = evaluate(policy_of(bundle), bundle.environment, bundle.configuration, episodes=16, seed=77_000)
    figure = "RMS following error [rev]"
    card = bundle.card["figures"][figure]
    assert found.interval(figure).median < 2.0 * card["median"]
    assert not found.violations
