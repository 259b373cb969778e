"""A training run as one file: Stable-Baselines3's own .zip with what it leaves out beside it.

SB3 saves networks, optimisers and counters. Added are `drive_agent.json` (the run), the normaliser, the replay buffer
and the states of all random generators, so that the file alone can be resumed, exported and evaluated. Like every file
of SB3 it holds pickles: open only your own.
"""

from __future__ import annotations

import io
import json
import pickle
import random
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

RUN, NORMALISER, BUFFER, RANDOM = "drive_agent.json", "normaliser.pkl", "replay_buffer.pkl", "random_states.pkl"


class CheckpointError(ValueError):
    """A file is no checkpoint of ours, or damaged; the message says what to do."""


def save(path: Path, model: Any, normaliser: Any, run: dict[str, Any]) -> None:
    """Write a checkpoint; the file is whole or not there."""
    beside = path.with_name(path.name + ".part")
    memory = io.BytesIO()
    model.save(memory)
    with zipfile.ZipFile(memory, "a", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr(RUN, json.dumps(run, indent=1))
        archive.writestr(RANDOM, pickle.dumps(random_states(model)))
        if normaliser is not None:
            archive.writestr(NORMALISER, pickle.dumps(normaliser))
        if getattr(model, "replay_buffer", None) is not None:
            archive.writestr(BUFFER, pickle.dumps(model.replay_buffer, protocol=5))
    path.parent.mkdir(parents=True, exist_ok=True)
    beside.write_bytes(memory.getvalue())
    beside.replace(path)


def read_run(path: Path) -> dict[str, Any]:
    """Return what a checkpoint says of its run.

    Raises:
        CheckpointError: If it is none.
    """
    run: dict[str, Any] = json.loads(_read(path, RUN))
    return run


def load(path: Path, env: Any = None) -> tuple[Any, Any]:
    """Return model and normaliser of a checkpoint; the model without an environment, if none is given.

    Args:
        path: The file.
        env: The VecEnv without a normaliser, which is put around it.

    Raises:
        CheckpointError: If the file is none.
    """
    from agents.training import algorithm_class

    run = read_run(path)
    names = _names(path)
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
    """Put the random generators back to where they were when the checkpoint was written."""
    import torch

    states = pickle.loads(_read(path, RANDOM))
    random.setstate(states["python"])
    np.random.set_state(states["numpy"])
    torch.set_rng_state(torch.from_numpy(states["torch"]))
    model.action_space.np_random.bit_generator.state = states["actions"]


def _names(path: Path) -> list[str]:
    with zipfile.ZipFile(path) as archive:
        return archive.namelist()


def _read(path: Path, name: str) -> bytes:
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.read(name)
    except FileNotFoundError:
        raise CheckpointError(f"there is no file {path}") from None
    except zipfile.BadZipFile:
        raise CheckpointError(f"{path} is no checkpoint: it is no .zip, or not whole") from None
    except KeyError:
        raise CheckpointError(
            f"{path} is no checkpoint of drive-agent: it holds no {name}. A bare file of Stable-Baselines3 lacks the "
            "environment and the normaliser; wrap it in a function and give that (module:function)"
        ) from None
