"""Training of the surrogate tuner: trials on emulated machines, then networks that say what those were worth.

    python -m agents.surrogate_training --out surrogate.npz

Round by round: trials of random gains around the incumbent on machines of every row of `TRAINING`, then of gains that
the surrogate of the round before proposes, so that it learns where it is sent.
"""

from __future__ import annotations

import argparse
import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.bundle import Bundle, installed
from agents.surrogate import CLIP, IDENTIFIED, SHOWN, SurrogatePolicy

Floats = NDArray[np.float64]
Array = NDArray[np.float32]

ENVIRONMENT = "ServoDrive/GainTuning-v0"
GAINS = ("velocity_p", "velocity_i", "position_p")
CONFIGURATION = {"gains": list(GAINS), "trials": 10}
STEP = 0.7  # the action's bound
# Load and motor of the machines, each from the load's shipped distributions.
TRAINING = (
    ("two_mass", "qbl4208"),
    ("belt", "qbl4208"),
    ("inertia", "ec_i_40"),
    ("ball_screw", "teknic_m2310p"),
    ("three_mass", "qbl4208"),
    ("geared_joint", "ec_45_flat"),
    ("vertical_screw", "re_40"),
    ("fan", "re_35"),
)
ROUNDS = 3  # of trials, the first of random gains
LANES = 128  # machines of a row and set
SETS = (3, 2, 1)  # sets of a row, by round
REACH = (0.25, 0.5, 0.7)  # of random changes
SHAKE = 0.15  # standard deviation of what is added to proposals, so that there is news
NETWORKS, HIDDEN, EPOCHS, BATCH, RATE = 3, 128, 25, 1024, 4e-3
HUBER = 0.5  # of ln J: what is farther off counts linearly
MACHINES, UNSEEN = 26, 888_000  # of a row, and the seed of machines that figures are measured on
LIMITS = "machines with one drive, of kinds and ranges like those trained on; velocity P and I and position P only"
# Of the Gaussian process on what f gets wrong, and how it is used: found on machines of other seeds, by a handful of
# tries.
SETTINGS = {"variance": 0.15, "length": 0.5, "noise": 0.05, "curiosity": 0.5, "wariness": 0.5}


class Data(NamedTuple):
    """Trials: context (n, 20), ln of gains over the rule's (n, 3), what they showed (n, 16), ln of hidden J's ratio."""

    context: Array
    gains: Array
    shown: Array
    worth: Array


def join(parts: Sequence[Data]) -> Data:
    """Return the trials of all parts."""
    return Data(*(np.concatenate(columns).astype(np.float32) for columns in zip(*parts, strict=True)))


def collect(load: str, motor: str, machines: int, seed: int, policy: Any = None) -> Data:
    """Return trials on random machines: of random gains, or of what a policy proposes, shaken a little."""
    from drive_env.envs.gain_tuning import GainTuning

    rng = np.random.default_rng(seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of machines that their motors can hardly move: they are tuned, too
        env = GainTuning(machines, load=load, motor=motor, gains=GAINS, trials=CONFIGURATION["trials"])
        try:
            observation, info = env.reset(seed=seed)
            rule = info["hidden"]
            context, parts = _context(observation), []
            if policy is not None:
                policy.reset()
            for _ in range(int(CONFIGURATION["trials"])):  # type: ignore[call-overload]
                if policy is None:
                    reach = rng.choice(REACH, size=(machines, 1))
                    action = rng.uniform(-1.0, 1.0, (machines, len(GAINS))) * reach
                else:
                    action = policy.act(observation) + rng.normal(0.0, SHAKE, (machines, len(GAINS)))
                observation, _, _, _, info = env.step(np.clip(action, -STEP, STEP).astype(np.float32))
                worth = np.log(info["trial_hidden"] / rule)
                parts.append(Data(context, observation[:, IDENTIFIED : IDENTIFIED + len(GAINS)],
                                  _shown(observation), worth))  # fmt: skip
        finally:
            env.close()
    return join(parts)


def fit(data: Data, seed: int, progress: Callable[[float], None] = lambda share: None) -> dict[str, Array]:
    """Return the arrays of both ensembles."""
    context, gains, shown, worth = data
    arrays: dict[str, Array] = {}
    inputs = {"f": np.concatenate([context, gains], axis=1), "g": np.concatenate([context, gains, shown], axis=1)}
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # networks this small are slower on several; and the result is the same everywhere
    for k, (name, x) in enumerate(inputs.items()):
        mean, scale = x.mean(axis=0), 1.0 / (x.std(axis=0) + 1e-6)
        arrays[f"{name}_mean"], arrays[f"{name}_scale"] = mean, scale
        normal = np.clip((x - mean) * scale, -CLIP, CLIP).astype(np.float32)
        networks = []
        for number in range(NETWORKS):
            networks.append(_fit_one(normal, worth, seed + number))
            progress((k * NETWORKS + number + 1) / (len(inputs) * NETWORKS))
        for part, values in zip(("w0", "b0", "w1", "b1", "w2", "b2"), zip(*networks, strict=True), strict=True):
            # Half precision: a thousandth of ln J is nobody's business, and the file is half as large.
            arrays[f"{name}_{part}"] = np.stack(values).astype(np.float16)
    torch.set_num_threads(threads)
    return arrays


def _fit_one(inputs: Array, worth: Array, seed: int) -> tuple[Array, ...]:
    """Return weights (in, out) and biases of a network."""
    import torch

    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    x, y = torch.from_numpy(inputs), torch.from_numpy(worth)
    net = torch.nn.Sequential(
        torch.nn.Linear(x.shape[1], HIDDEN), torch.nn.SiLU(), torch.nn.Linear(HIDDEN, HIDDEN), torch.nn.SiLU(),
        torch.nn.Linear(HIDDEN, 1),
    )  # fmt: skip
    optimiser = torch.optim.AdamW(net.parameters(), RATE / 2.0, weight_decay=1e-3)
    steps = EPOCHS * math.ceil(len(x) / BATCH)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps)
    for _ in range(EPOCHS):
        order = torch.randperm(len(x), generator=generator)
        for rows in order.split(BATCH):
            loss = torch.nn.functional.huber_loss(net(x[rows])[:, 0], y[rows], delta=HUBER)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    with torch.no_grad():
        layers = [net[k] for k in (0, 2, 4)]
        found = [array for layer in layers for array in (layer.weight.T.numpy().copy(), layer.bias.numpy().copy())]
    found[4], found[5] = found[4][:, 0], found[5][0]
    return tuple(found)


def bundle_of(arrays: dict[str, Array], card: dict[str, Any]) -> Bundle:
    """Return the agent."""
    settings = {"gains": len(GAINS), "step": STEP, **SETTINGS}
    versions = installed("drive-env", "numpy", "torch", "mujoco", "numba")
    return Bundle("surrogate", arrays, settings, ENVIRONMENT, CONFIGURATION, card, versions)


def train(
    seed: int = 0,
    *,
    sets: Sequence[int] = SETS,
    lanes: int = LANES,
    rows: Sequence[tuple[str, str]] = TRAINING,
    progress: Callable[[str, float], None] = lambda what, share: None,
) -> Bundle:
    """Return a surrogate trained from nothing.

    Args:
        seed: Of machines, trials and networks.
        sets: Sets of machines of every row, by round.
        lanes: Machines in a set.
        rows: Load and motor.
        progress: Called with what is under way and how much of all is done.
    """
    parts: list[Data] = []
    policy, arrays = None, {}
    started = time.monotonic()
    whole = sum(sets) * len(rows)
    for number, count in enumerate(sets):
        for k in range(count):
            for j, (load, motor) in enumerate(rows):
                own = np.random.SeedSequence((seed, number, k, j)).generate_state(1)[0]
                parts.append(collect(load, motor, lanes, int(own), policy))
                progress(f"trials of round {number + 1} of {len(sets)}", len(parts) / whole)
        arrays = fit(join(parts), seed)
        policy = SurrogatePolicy(bundle_of(arrays, {}))
    card = {
        "trained": f"{len(sets)} rounds of trials on emulated machines, hidden J known; networks by torch",
        "distribution": [f"{load} on {motor}" for load, motor in rows],
        "machines": sum(sets) * lanes * len(rows),
        "trials": sum(len(part.worth) for part in parts),
        "seed": seed,
        "minutes": round((time.monotonic() - started) / 60.0, 1),
    }
    return bundle_of(arrays, card)


def judge(policy: Any, machines: int, seed: int, rows: Sequence[tuple[str, str]] = TRAINING) -> Floats:
    """Return hidden J of the answer over the rule's of machines that were not trained on, (rows, machines)."""
    from drive_env.envs.gain_tuning import GainTuning

    ratios = []
    for load, motor in rows:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            env = GainTuning(machines, load=load, motor=motor, gains=GAINS, trials=CONFIGURATION["trials"])
            try:
                observation, info = env.reset(seed=seed)
                rule = info["hidden"]
                policy.reset()
                for _ in range(env.config.trials):
                    observation, _, _, _, info = env.step(policy.act(observation))
                ratios.append(info["hidden"] / rule)
            finally:
                env.close()
    return np.array(ratios)


def figures_of(ratios: Floats) -> dict[str, Any]:
    """Return what a card says of hidden J over the rule's: median with its 95 % interval (bootstrap), tail, losers."""
    flat = ratios.ravel()
    medians = np.median(np.random.default_rng(0).choice(flat, (2000, flat.size)), axis=1)
    return {
        "median": round(float(np.median(flat)), 3),
        "median, 95 % interval": [round(float(x), 3) for x in np.quantile(medians, (0.025, 0.975))],
        "p95": round(float(np.quantile(flat, 0.95)), 3),
        "share more than 5 % worse": round(float(np.mean(flat > 1.05)), 4),
    }


def _context(observation: Array) -> Array:
    return np.concatenate([observation[:, :IDENTIFIED], _shown(observation)], axis=1)


def _shown(observation: Array) -> Array:
    at = IDENTIFIED + 2 * len(GAINS)
    return np.asarray(observation[:, at : at + SHOWN])


def main() -> None:
    """Train from the command line."""
    from rich.progress import Progress

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="file of the agent (.npz)")
    parser.add_argument("--seed", type=int, default=0, help="seed of machines, trials and networks")
    arguments = parser.parse_args()
    with Progress() as bar:
        task = bar.add_task("training", total=1.0)
        made = train(arguments.seed, progress=lambda what, share: bar.update(task, description=what, completed=share))
    ratios = judge(SurrogatePolicy(made), MACHINES, UNSEEN + arguments.seed)
    figures = {
        "what": "hidden J of the answer over the fitted rule's, 10 trials, machines not trained on",
        "machines": ratios.size,
        "seed": UNSEEN + arguments.seed,
        **figures_of(ratios),
        "median of each row": {
            f"{load} on {motor}": round(float(np.median(row)), 3)
            for (load, motor), row in zip(TRAINING, ratios, strict=True)
        },
    }
    made = replace(made, card={**made.card, "figures": figures, "limits": LIMITS})
    print(f"{figures['median']} of the rule's hidden J in the median, written to {made.save(arguments.out)}")


if __name__ == "__main__":
    main()
