"""A training run as one file: Stable-Baselines3's own .zip with the parts that it leaves out.

SB3 saves networks, optimisers and counters. Added are `drive_agent.json` (the run), the normaliser, the replay buffer
and the states of all random generators, so that the file alone can be resumed, exported and evaluated. Like every file
of SB3 it contains pickles, and unpickling can run any code of its writer: it is loaded only with `trust`, even to
resume a run, since nothing in a folder proves who wrote it. The file's description of its run is JSON and needs no
trust.
"""

from __future__ import annotations

import inspect
import io
import json
import pickle
import random
import zipfile
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from agents.training.algorithms import algorithm_class, need
from drive_env.whole_file import write_whole
from mechanics.reading.untrusted import MOST_TEXT, member_names, parse_json, read_member

MOST_UNPACKED = 16_000_000_000  # bytes of a replay buffer: a million observations of a thousand entries, twice
# Required keys of a run's JSON and their types; it is read before any trust is given.
_OF_A_RUN = {"algorithm": str, "environment": str, "configuration": dict, "timesteps": int, "run": dict}
PLAIN = "data"  # description of the model in a file of Stable-Baselines3: JSON with pickles in it
RUN, NORMALISER, BUFFER, RANDOM = "drive_agent.json", "normaliser.pkl", "replay_buffer.pkl", "random_states.pkl"


class CheckpointError(ValueError):
    """The file is not a checkpoint of drive-agent, or damaged; the message has the remedy."""


class UntrustedError(CheckpointError):
    """A file would run code of its writer, and `trust` was not given."""


def save(path: Path, model: Any, normaliser: Any, run: dict[str, Any]) -> None:
    """Write a checkpoint; the file is complete or missing."""
    memory = io.BytesIO()
    model.save(memory)
    with zipfile.ZipFile(memory, "a", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr(RUN, json.dumps(run, indent=1))
        archive.writestr(RANDOM, pickle.dumps(random_states(model)))
        if normaliser is not None:
            archive.writestr(NORMALISER, pickle.dumps(normaliser))
        if getattr(model, "replay_buffer", None) is not None:
            archive.writestr(BUFFER, pickle.dumps(model.replay_buffer, protocol=5))
    write_whole(path, memory.getvalue())


def read_run(path: Path) -> dict[str, Any]:
    """Return a checkpoint's description of its run.

    Raises:
        CheckpointError: If the file is not a checkpoint.
    """
    text = _read(path, RUN)
    try:
        run: Any = parse_json(text)
    except ValueError as error:
        raise CheckpointError(f"{path} is not a checkpoint of drive-agent: {error}") from None
    if not isinstance(run, dict) or any(not isinstance(run.get(name), kind) for name, kind in _OF_A_RUN.items()):
        raise CheckpointError(f"{path} is not a checkpoint of drive-agent: {RUN} lacks {', '.join(_OF_A_RUN)}")
    if not isinstance(run["run"].get("seed"), int) or not isinstance(run["run"].get("hyperparameters"), dict):
        raise CheckpointError(f"{path} is not a checkpoint of drive-agent: {RUN} has no seed, or no hyper-parameters")
    return run


def check_trust(path: Path, trust: bool) -> None:
    """Raise UntrustedError unless the writer of a checkpoint is trusted."""
    if not trust:
        raise UntrustedError(
            f"{path} holds pickles: loading it runs code that its author put there, with your rights (your files, "
            "your network, the drives). If it is yours, or from a person whose programs you would run here, give "
            "--trust (in Python trust=True); an agent.npz runs no code and needs no trust"
        )


def is_plain(path: Path) -> bool:
    """Return whether a file is of Stable-Baselines3 itself, without the parts of drive-agent."""
    try:
        names = member_names(path)
    except (OSError, ValueError):
        return False
    return PLAIN in names and RUN not in names


def load_plain(path: Path, *, trust: bool = False) -> Any:
    """Return the model of a file of Stable-Baselines3 itself, of any algorithm of its packages.

    Raises:
        CheckpointError: For another file, or one whose policy's class none of them has; UntrustedError without
            `trust`; MissingPackageError without Stable-Baselines3.
    """
    check_trust(path, trust)
    need("stable_baselines3")
    try:
        said: Any = parse_json(_read(path, PLAIN))
        module = said["policy_class"]["__module__"]
    except (ValueError, TypeError, KeyError) as error:
        raise CheckpointError(f"{path} is not a file of Stable-Baselines3: {error}") from None
    kinds = [kind for kind in _algorithms() if module in {one.__module__ for one in kind.policy_aliases.values()}]
    if not kinds:
        raise CheckpointError(
            f"{path} has a policy of {module}, which no algorithm of Stable-Baselines3 has by itself; wrap it in a "
            "function and give that (module:function)"
        )
    # Some share their policies: the one with most of the file's options is meant.
    kind = max(kinds, key=lambda one: len(set(inspect.signature(one).parameters) & set(said)))
    return kind.load(path, device="cpu")


def _algorithms() -> list[Any]:
    """Return the algorithms of Stable-Baselines3 and, if it is installed, of its contributions."""
    found = []
    for name in ("stable_baselines3", "sb3_contrib"):
        with suppress(ImportError):
            found += [kind for kind in vars(import_module(name)).values() if hasattr(kind, "policy_aliases")]
    return found


def load(path: Path, env: Any = None, *, trust: bool = False) -> tuple[Any, Any]:
    """Return model and normaliser of a checkpoint; the model without an environment, if none is given.

    Args:
        path: The file.
        env: The VecEnv, to which the normaliser is added; None for none.
        trust: Whether its writer is trusted: their code is run.

    Raises:
        CheckpointError: If the file is not a checkpoint; UntrustedError without `trust`.
    """
    run = read_run(path)
    check_trust(path, trust)
    names = member_names(path)
    normaliser = pickle.loads(_read(path, NORMALISER)) if NORMALISER in names else None
    if normaliser is not None and env is not None:
        normaliser.set_venv(env)
        env = normaliser
    model = algorithm_class(run["algorithm"]).load(path, env=env, device="cpu")
    if BUFFER in names and env is not None:
        model.replay_buffer = pickle.loads(_read(path, BUFFER))
        model.replay_buffer.device = model.device
    return model, normaliser


def random_states(model: Any) -> dict[str, Any]:
    """Return the states of the random generators that a training draws from."""
    import torch

    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),
        "torch": torch.get_rng_state().numpy(),
        "actions": model.action_space.np_random.bit_generator.state,
    }


def restore_random_states(path: Path, model: Any) -> None:
    """Restore the states of the random generators from a trusted checkpoint."""
    import torch

    states = pickle.loads(_read(path, RANDOM))
    random.setstate(states["python"])
    np.random.set_state(states["numpy"])
    torch.set_rng_state(torch.from_numpy(states["torch"]))
    model.action_space.np_random.bit_generator.state = states["actions"]


def _read(path: Path, name: str) -> bytes:
    try:
        return read_member(path, name, MOST_TEXT if name == RUN else MOST_UNPACKED)
    except FileNotFoundError:
        raise CheckpointError(f"there is no file {path}") from None
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise CheckpointError(f"{error}; give a checkpoint (.zip) that drive-agent wrote") from None
    except KeyError:
        raise CheckpointError(
            f"{path} is not a checkpoint of drive-agent: it holds no {name}. A bare file of Stable-Baselines3 lacks "
            "the environment and the normaliser: `drive-agent evaluate` runs it with --environment and --config, here "
            "and on a bus; to continue or export an agent train it with `drive-agent train`"
        ) from None
