"""The file of an agent, and acting with it: whole, small, checked, and without anything but NumPy."""

from __future__ import annotations

import json
import subprocess
import sys
import warnings

import numpy as np
import pytest
from rigs.agent_files import ACTIONS, ENTRIES, bundle, observations

from agents.plain import plain
from agents.policies import policy as runtime
from agents.policies.agent_file import ABOUT, AgentFile, BundleError
from agents.policies.policy import ACTIVATIONS, PolicyError, load_policy, measure_latency, policy_of


# --- the file ---------------------------------------------------------------------------------------------------------
def test_what_is_saved_is_loaded(tmp_path):
    made = bundle()
    found = AgentFile.load(made.save(tmp_path / "agent.npz"))
    assert found.arrays.keys() == made.arrays.keys() and found.hash == made.hash
    for name, array in made.arrays.items():
        assert np.array_equal(found.arrays[name], array) and found.arrays[name].dtype == array.dtype
    for name in ("kind", "settings", "environment", "configuration", "card", "versions"):
        assert getattr(found, name) == getattr(made, name)


def test_equal_agents_make_equal_files(tmp_path):
    one, two = (bundle().save(tmp_path / name).read_bytes() for name in ("a.npz", "b.npz"))
    assert one == two


def test_the_normaliser_is_inside_and_there_is_one_file(tmp_path):
    bundle().save(tmp_path / "agent.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["agent.npz"]
    with np.load(tmp_path / "agent.npz", allow_pickle=False) as stored:
        assert {"observation_mean", "observation_scale", ABOUT} <= set(stored.files)


def test_a_changed_file_is_refused(tmp_path):
    path = bundle().save(tmp_path / "agent.npz")
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    arrays["bias_0"] = arrays["bias_0"] + np.float32(1e-3)
    np.savez(path, **arrays)
    with pytest.raises(BundleError, match="was changed after it was written"):
        AgentFile.load(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "there is no file"),
        (b"", "is not an agent"),
        (b"PK\x03\x04 no", "is not an agent"),
        (b"hello", "is not an agent"),
    ],
)
def test_a_file_that_is_none_is_told(tmp_path, content, message):
    path = tmp_path / "agent.npz"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(BundleError, match=message):
        AgentFile.load(path)


def another_npz(path):
    np.savez(path, weights=np.zeros(3))


def another_about(path):
    np.savez(path, about=np.frombuffer(b'{"format": "drive-agent", "format_version": 1}', np.uint8))


def array(path):
    with path.open("wb") as file:
        np.save(file, np.zeros(3))


def picture(path):
    path.write_bytes(b"\x89PNG\r\n\x1a\n")


@pytest.mark.parametrize("write", [another_npz, array, picture])
def test_a_file_of_another_program_is_told_without_numpys_advice(tmp_path, write):
    path = tmp_path / "other.npz"
    write(path)
    with pytest.raises(BundleError) as error:
        AgentFile.load(path)
    assert str(error.value) == (
        f"{path} is not an agent; give the .npz that drive-agent train writes, or the name of an agent that ships"
    )


def test_what_cannot_be_read_is_told(tmp_path):
    path = tmp_path / "folder.npz"
    path.mkdir()
    with pytest.raises(
        BundleError, match=r"cannot read .*folder\.npz: .*; give the \.npz that drive-agent train writes"
    ):
        AgentFile.load(path)
    with pytest.raises(BundleError, match=r"half\.npz is not an agent; give"):
        another_about(tmp_path / "half.npz")
        AgentFile.load(tmp_path / "half.npz")


def test_pickles_are_not_opened(tmp_path):
    path = tmp_path / "agent.npz"
    np.savez(path, **{ABOUT: np.array([{"format": "drive-agent"}], object)})
    with pytest.raises(BundleError, match="is not an agent"):
        AgentFile.load(path)


def test_another_format_is_told(tmp_path):
    path = tmp_path / "agent.npz"
    about = json.dumps({"format": "drive-agent", "format_version": 2}).encode()
    np.savez(path, **{ABOUT: np.frombuffer(about, np.uint8)})
    with pytest.raises(BundleError, match="has format 2 and this drive-env reads 1"):
        AgentFile.load(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"arrays": {"weight_0": np.array([np.nan])}}, "'weight_0' holds NaN or infinity: the training diverged"),
        ({"arrays": {"weight_0": np.array([None])}}, "a bundle holds numbers"),
        ({"arrays": {"about": np.zeros(1)}}, "choose another name"),
    ],
)
def test_what_cannot_be_stored_is_told(changes, message):
    with pytest.raises(BundleError, match=message):
        bundle(**changes)


def test_a_file_is_at_most_a_megabyte(tmp_path):
    noise = np.random.default_rng(0).standard_normal(200_000)
    with pytest.raises(BundleError, match="1000000 are allowed; use a smaller network"):
        bundle(arrays={"weight_0": noise}).save(tmp_path / "agent.npz")
    assert not list(tmp_path.iterdir())


def test_a_card_holds_what_json_holds(tmp_path):
    card = {"figures": np.float64(2.0), "row": (1, np.arange(2)), "fall": float("inf")}
    with pytest.raises(BundleError, match=r"use bundle\.plain"):
        bundle(card=card).save(tmp_path / "agent.npz")
    assert plain(card) == {"figures": 2.0, "row": [1, [0, 1]], "fall": "inf"}
    bundle(card=plain(card)).save(tmp_path / "agent.npz")


# --- acting -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("output", ["clip", "tanh"])
def test_numpy_gives_what_torch_gives(activation, output):
    torch = pytest.importorskip("torch")
    made = bundle(activation=activation, output=output)
    a = {name: torch.as_tensor(array) for name, array in made.arrays.items()}
    functions = {"tanh": torch.tanh, "relu": torch.relu, "elu": torch.nn.functional.elu,
                 "leaky_relu": torch.nn.functional.leaky_relu, "silu": torch.nn.functional.silu}  # fmt: skip
    rows = observations(64) * 5.0
    x = torch.clamp((torch.as_tensor(rows) - a["observation_mean"]) * a["observation_scale"], -10, 10).float()
    for k in (0, 1):
        x = functions[activation](x @ a[f"weight_{k}"] + a[f"bias_{k}"])
    x = x @ a["weight_2"] + a["bias_2"]
    low, high = a["action_low"], a["action_high"]
    expected = torch.clamp(x, low, high) if output == "clip" else low + 0.5 * (torch.tanh(x) + 1.0) * (high - low)
    assert np.allclose(policy_of(made).act(rows), expected.numpy(), atol=1e-5)


def test_one_observation_gives_one_action_and_a_lane_is_the_same_among_others():
    policy = policy_of(bundle())
    rows = observations()
    together = policy.act(rows)
    assert together.shape == (4, ACTIONS) and together.dtype == np.float32
    assert policy.act(rows[2]).shape == (ACTIONS,)
    assert np.allclose(policy.act(rows[2]), together[2], atol=1e-6)


def test_a_recurrent_agent_remembers_each_lane_and_forgets_where_it_is_told():
    policy, fresh = policy_of(bundle("lstm")), policy_of(bundle("lstm"))
    rows = observations()
    first = policy.act(rows)
    assert not np.array_equal(policy.act(rows), first)
    policy.reset(np.array([True, False, True, False]))
    third = policy.act(rows)
    assert np.array_equal(third[[0, 2]], first[[0, 2]]) and not np.array_equal(third[1], first[1])
    policy.reset(None)
    assert np.array_equal(policy.act(rows), fresh.act(rows))


@pytest.mark.parametrize("kind", ["mlp", "lstm"])
@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_no_number_goes_in_or_comes_out(kind, wrong):
    policy = policy_of(bundle(kind))
    row = observations()[0]
    row[3] = wrong
    with pytest.raises(PolicyError, match="entry 3 of the observation is not a number"):
        policy.act(row)
    arrays = dict(bundle(kind).arrays)
    arrays["weight_1"] = np.full_like(arrays["weight_1"], 3e38)
    arrays["weight_2"] = np.full_like(arrays["weight_2"], 3e38)
    with pytest.raises(PolicyError, match="the policy's output is not a number"):
        policy_of(bundle(kind, arrays=arrays, activation="relu")).act(observations()[0] + 10.0)


def test_an_observation_of_another_shape_is_told():
    with pytest.raises(PolicyError, match=r"takes 6 entries, .* not \(5,\); check that it is for this environment"):
        policy_of(bundle()).act(np.zeros(5))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "tree"}, "an agent of kind 'tree' needs a newer drive-env; this one has mlp, lstm"),
        ({"settings": {"activation": "gelu", "output": "clip"}}, "activation is 'gelu'; there are tanh, relu"),
        ({"settings": {"activation": "tanh", "output": "none"}}, "output is 'none'; there are clip, tanh"),
    ],
)
def test_what_is_not_known_here_is_told(changes, message):
    with pytest.raises(BundleError, match=message):
        policy_of(bundle(**changes))


def test_another_kind_is_another_row(monkeypatch):
    monkeypatch.setitem(runtime.KINDS, "echo", f"{__name__}:Echo")
    assert policy_of(bundle("echo")).act(1.5) == 1.5


class Echo:
    def __init__(self, made):
        self.bundle = made

    def act(self, observation):
        return observation


def test_acting_needs_numpy_alone(tmp_path):
    path = bundle().save(tmp_path / "agent.npz")
    program = (
        "import sys; from agents.policies.policy import load_policy; import numpy as np;"
        f"action = load_policy({str(path)!r}).act(np.zeros({ENTRIES}));"
        "heavy = {'torch', 'gymnasium', 'mujoco', 'numba', 'scipy', 'yaml', 'stable_baselines3', 'can', 'drive_env'};"
        "print(len(action), sorted(heavy & {name.partition('.')[0] for name in sys.modules}))"
    )
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["2", "[]"]


def test_latency_is_measured():
    found = measure_latency(load_latency().act, ENTRIES, calls=200)
    assert 0.0 < found.median <= found.p99 <= found.worst < 1.0
    assert "median" in str(found) and "µs" in str(found)


def load_latency():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return policy_of(bundle(hidden=(64, 64)))


def test_a_saved_agent_acts_as_before(tmp_path):
    made = bundle()
    path = made.save(tmp_path / "agent.npz")
    assert np.array_equal(load_policy(path).act(observations()), policy_of(made).act(observations()))
