"""Opens any policy: an agent file, a checkpoint of Stable-Baselines3, ONNX, or a Python callable.

The form of the text selects it: the name of a shipped agent, agent.npz, checkpoint.zip (ours, or what
Stable-Baselines3's `save` writes), agent.onnx, or module:function.
"""

from __future__ import annotations

import hashlib
import importlib
import inspect
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from agents.policies.policy import ACTOR, load_policy
from agents.shipped import shipped, shipped_names
from mechanics.reading.untrusted import read_bytes
from tuning.runs.inputs import found_again

CHECKPOINT = ".zip"  # ending of a file of Stable-Baselines3, which contains pickles


class PolicyNotFoundError(ValueError):
    """There is no such policy, or it cannot be used; the message has the remedy."""


@dataclass
class LoadedPolicy:
    """A policy and its description.

    Attributes:
        name: As the user wrote it.
        policy: The policy: `act(observation)`, `reset(mask)`.
        environment: Name of the environment that it was trained in; None if unknown.
        configuration: The environment's options in training.
        card: Its description.
    """

    name: str
    policy: Any
    environment: str | None = None
    configuration: Mapping[str, Any] = field(default_factory=dict)
    card: Mapping[str, Any] = field(default_factory=dict)


def open_policy(text: str, *, trust: bool = False) -> LoadedPolicy:
    """Return the policy named by a text.

    Args:
        text: The name.
        trust: Whether the author of a checkpoint is trusted: loading it runs code that it contains. Other files run no
            code, and a Python function is the user's own.

    Raises:
        PolicyNotFoundError: If it does not name a policy; BundleError or CheckpointError for an invalid file;
            UntrustedError for a checkpoint without `trust`.
    """
    if is_checkpoint(text):
        return _checkpoint(text, trust)
    for ending, opened in OPENERS.items():
        if text.lower().endswith(ending):
            return opened(text)
    if ":" in text:
        return _callable(text)
    if text in shipped_names():
        return replace(_bundle(str(shipped(text))), name=text)
    from agents.policies.baselines import BASELINES, SUITE_TASKS

    baselines = sorted({name for rows in (*BASELINES.values(), *SUITE_TASKS.values()) for name in rows})
    raise PolicyNotFoundError(
        f"{text!r} is not a policy; give an agent that ships ({', '.join(shipped_names())}), a file "
        f"({', '.join((*OPENERS, CHECKPOINT))}), a Python function (module:function) or a baseline "
        f"({', '.join(baselines)})"
    )


def opened(
    text: str, environment: str | None, configuration: Mapping[str, Any], *, trust: bool = False
) -> LoadedPolicy:
    """Return the policy named by a text, or the baseline in its environment with these options.

    Args:
        text: The name.
        environment: Name of the environment; required for a baseline.
        configuration: The environment's options.
        trust: As for `open_policy`.
    """
    from agents.policies.baselines import baseline
    from agents.tasks import make_environments

    if not is_baseline(text):
        return open_policy(text, trust=trust)
    if environment is None:
        raise ValueError(f"policy {text} does not name its environment; give --environment")
    lanes: Any = make_environments(environment, 1, configuration)
    actions, config = lanes.single_action_space.shape[0], lanes.config
    lanes.close()
    return LoadedPolicy(text, baseline(text, environment, config, actions), environment)


def names_a_file(text: str) -> bool:
    """Return whether a text names a policy by its file."""
    return text.lower().endswith((*OPENERS, CHECKPOINT))


def is_baseline(text: str) -> bool:
    """Return whether a text names a baseline, which exists in several environments."""
    from agents.policies.baselines import BASELINES, SUITE_TASKS

    return any(text in rows for rows in (*BASELINES.values(), *SUITE_TASKS.values()))


class CallablePolicy:
    """A Python function of an observation; it is called with those of all environments, shape (environments, entries).

    A class, or an object with `act`, is used unchanged.
    """

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self._function = function

    def act(self, observation: Any) -> Any:
        """Return the function's actions."""
        return np.asarray(self._function(observation), np.float32)

    def reset(self, mask: Any = None) -> None:
        """Do nothing."""


class ModelPolicy:
    """A model of Stable-Baselines3 with its normaliser, acting without noise."""

    def __init__(self, model: Any, normaliser: Any) -> None:
        self.model, self._normaliser = model, normaliser
        self._state: Any = None
        self._begins: Any = None

    def act(self, observation: Any) -> Any:
        """Return the model's action."""
        rows: Any = np.atleast_2d(observation)
        lanes = len(rows)
        if hasattr(self.model.observation_space, "spaces"):  # the actor needs no entries of the critic
            spaces = self.model.observation_space.spaces
            rows = {key: rows if key == ACTOR else np.zeros((lanes, *spaces[key].shape)) for key in spaces}
        if self._normaliser is not None:
            rows = self._normaliser.normalize_obs(rows)
        if self._begins is None or len(self._begins) != lanes:
            self._begins = np.ones(lanes, bool)
        action, self._state = self.model.predict(rows, self._state, self._begins, deterministic=True)
        self._begins = np.zeros(lanes, bool)
        return action[0] if np.ndim(observation) == 1 else action

    def reset(self, mask: Any = None) -> None:
        """Begin a new episode, in all environments or where the mask is true: clear a recurrent model's state."""
        if mask is None or self._begins is None:
            self._state = self._begins = None
        else:
            self._begins = self._begins | mask


def _bundle(text: str) -> LoadedPolicy:
    policy = load_policy(text)
    bundle = policy.bundle
    return LoadedPolicy(text, policy, bundle.environment, bundle.configuration, bundle.card)


def _onnx(text: str) -> LoadedPolicy:
    from agents.policies.onnx_policy import OnnxPolicy

    policy = OnnxPolicy(text)
    return LoadedPolicy(text, policy, policy.environment, policy.configuration, policy.card)


def is_checkpoint(text: str) -> bool:
    """Return whether a text names a checkpoint, the only type of file that runs its writer's code."""
    return text.lower().endswith(CHECKPOINT)


def described_checkpoint(text: str) -> LoadedPolicy:
    """Return the description of a checkpoint, its policy None: none of its writer's code is run.

    A file of Stable-Baselines3 itself does not name its environment.

    Raises:
        CheckpointError: If the file is not a checkpoint.
    """
    from agents.training import checkpoint

    if checkpoint.is_plain(Path(text)):
        return LoadedPolicy(text, None)
    run = checkpoint.read_run(Path(text))
    card = {"trained": f"{run['algorithm']}, {run['timesteps']} steps", "seeds": {"training": run["run"]["seed"]}}
    configuration = found_again(run["configuration"], run.get("inputs"), Path(text).parent, alone=True)
    return LoadedPolicy(text, None, run["environment"], configuration, card)


def _checkpoint(text: str, trust: bool) -> LoadedPolicy:
    from agents.training import checkpoint

    described = described_checkpoint(text)
    if checkpoint.is_plain(Path(text)):
        return replace(described, policy=ModelPolicy(checkpoint.load_plain(Path(text), trust=trust), None))
    model, normaliser = checkpoint.load(Path(text), trust=trust)
    return replace(described, policy=ModelPolicy(model, normaliser))


def find_object(text: str) -> Any:
    """Import the object of module:name; the present folder's modules count, too.

    Raises:
        PolicyNotFoundError: If there is no such object, or its module cannot be imported.
    """
    module, colon, name = text.partition(":")
    if not colon or not name:
        raise PolicyNotFoundError(f"{text!r} must be module:function")
    folder = str(Path.cwd())
    if folder not in sys.path:  # a console script's path lacks it, but the user's function is there
        sys.path.insert(0, folder)
    try:
        found = importlib.import_module(module)
    except ImportError as error:
        raise PolicyNotFoundError(f"{text}: module {module!r} cannot be imported: {error}") from None
    except Exception as error:  # a foreign module may raise anything when it is imported
        raise PolicyNotFoundError(f"{text}: module {module!r} fails: {type(error).__name__}: {error}") from error
    if not hasattr(found, name):
        functions = [key for key, value in vars(found).items() if callable(value) and not key.startswith("_")]
        raise PolicyNotFoundError(f"{text}: {module} has no {name!r}; it has {', '.join(functions) or 'nothing'}")
    return getattr(found, name)


def source_of(text: str) -> str:
    """Return the hash of the file that holds module:function; "" if the text names no function, or it has no file.

    The module's own imports are not included.
    """
    if ":" not in text:
        return ""
    found = sys.modules[getattr(find_object(text), "__module__", text.partition(":")[0])]
    path = getattr(found, "__file__", None)
    return hashlib.sha256(read_bytes(path)).hexdigest() if path else ""


def _callable(text: str) -> LoadedPolicy:
    policy = find_object(text)
    if inspect.isclass(policy):
        try:
            policy = policy()
        except TypeError as error:
            raise PolicyNotFoundError(f"{text} cannot be made without arguments: {error}") from None
    if not hasattr(policy, "act"):
        if not callable(policy):
            raise PolicyNotFoundError(f"{text} is a {type(policy).__name__}; a policy is a function of an observation")
        policy = CallablePolicy(policy)
    elif not hasattr(policy, "reset"):
        policy = CallablePolicy(policy.act)
    return LoadedPolicy(text, policy)


# Ending of a file that runs no code of its writer -> function that opens it.
OPENERS: dict[str, Callable[[str], LoadedPolicy]] = {".npz": _bundle, ".onnx": _onnx}
