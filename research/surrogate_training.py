"""Training of the surrogate tuner: trials on emulated machines, then a network that says what gains are worth.

    python -m research.surrogate_training --out surrogate.npz --seed 0

Round by round: trials of random gains on machines of every row of `TRAINING`, then of gains that the surrogate of the
round before proposes, so that it learns where it is sent. Each set of machines has dynamics of its own. With --trials
FOLDER the trials are kept there, and those that are there are not made again: a training that was stopped goes on. With
OMP_NUM_THREADS=1 it takes 10 minutes of a core; NumPy's threads do nothing for matrices this small but wait for each
other, three times as long.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.policies.agent_file import AgentFile, installed
from agents.tuner.known_range import HOLDS
from agents.tuner.surrogate import IDENTIFIED, SHOWN, SurrogatePolicy, context_of
from drive_env.loops.dynamics import DEFAULT, find_dynamics, known_dynamics
from drive_env.trials.score import TRIP
from mechanics.untrusted import read_arrays
from tuning.bootstrap import bootstrap_interval

Floats = NDArray[np.float64]
Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

ENVIRONMENT = "ServoDrive/GainTuning-v0"
DEVICE = "tmcm1636"
GAINS = ("velocity_p", "velocity_i", "position_p")
# A step reaches any gains that are tried, from wherever the incumbent is.
CONFIGURATION: dict[str, Any] = {"gains": list(GAINS), "trials": 10, "step": 5.0}
# Of what is tried, ln over the rule's. The constrained oracles of the public suite (tuning/compare/oracles.csv) lie in
# -2.3...1.1, -3.7...1.6 and -2.5...1.3, nine tenths of them in -1.6...1.0, -1.3...1.3 and -2.2...1.2.
LOW, HIGH = (-2.6, -2.6, -3.0), (1.4, 1.7, 1.7)
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
LANES = 128  # machines of a row and set
STRAY = 0.2  # of the way from soft to stiff dynamics: how far the margins of a set may part from each other
# Random gains, ln over the rule's: a share is drawn about where optima lie, where velocity P and position P go
# together, the rest evenly from the range.
TOGETHER, ABOUT, SPREAD, SHARE = (0.9, 0.3, 1.2), (0.0, 0.2, 0.0), (0.3, 0.7, 0.3), 0.6
FARTHEST = 3.0
SHAKES, SHAKE = (0.3, 1.0, 2.0), 0.15  # of proposals, for news: one of the factors, and the standard deviation
FIRST_SEED = 1001  # of a training's machines; its rounds' are a thousand apart
NETWORKS = 3  # of what is made; a round's proposals come from one
MACHINES, UNSEEN = 26, 457_000  # of a row, and the seed of machines that figures are measured on
LIMITS = (
    "velocity P and I and position P only",
    "too cautious on rigid axes: its answers cost more there than the baseline rule's",
    "drive-tune auto, which designs gains on models of the machine, is better: this agent shows what learning reaches",
)
# The best of a few on machines of seed 555,000: of curiosities from -0.3 to 0.8, and of cautions from 0 to 2.
SETTINGS = {"curiosity": 0.4, "caution": 0.5}


class Round(NamedTuple):
    """A round of a training: sets of machines of every row, and trials of each machine."""

    sets: int
    trials: int


ROUNDS = (Round(sets=4, trials=8), *(Round(sets=1, trials=10) for _ in range(4)))  # the first of random gains


class Answers(NamedTuple):
    """What a tuner left machines with, (rows, machines) each.

    ratio: The robust cost of its answer over the rule's. kept: Whether its answer keeps the constraints. incumbent: The
    ratio of the best trial by measured terms. best: That of the best trial by the robust cost. aborted: Share of the
    trials that were stopped. rule: Whether the rule's gains keep the constraints.
    """

    ratio: Floats
    kept: Mask
    incumbent: Floats
    best: Floats
    aborted: Floats
    rule: Mask


@contextmanager
def machines_of(load: str, motor: str, count: int, **options: Any) -> Iterator[Any]:
    """Make the environment with random machines of a row, options in place of the configuration's."""
    from drive_env.envs.gain_tuning import GainTuning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of machines that their motors can hardly move: they are tuned, too
        env = GainTuning(count, device=DEVICE, load=load, motor=motor, config=CONFIGURATION, **options)
        try:
            yield env
        finally:
            env.close()


def collect(load: str, motor: str, machines: int, trials: int, seed: int, agent: AgentFile | None = None) -> Any:
    """Return `TrialData` on random machines: of random gains, or of what an agent proposes, shaken a little."""
    from research.surrogate_fit import TrialData

    rng = np.random.default_rng(seed)
    G = len(GAINS)
    columns: tuple[list[Array], ...] = ([], [], [])
    dynamics = _random_dynamics(rng)
    policy = None if agent is None else asked_for(agent, dynamics)
    with machines_of(load, motor, machines, trials=trials, step=2.0 * FARTHEST, dynamics=dynamics) as env:
        observation, _ = env.reset(seed=seed)
        context = context_of(observation[:, :IDENTIFIED], _shown(observation), find_dynamics(dynamics))
        for _ in range(trials):
            if policy is None:
                wanted = _random_gains(rng, machines)
                action = wanted - observation[:, IDENTIFIED + G : IDENTIFIED + 2 * G]
            else:
                shake = SHAKE * rng.choice(SHAKES, (machines, 1))
                action = policy.act(observation) + shake * rng.standard_normal((machines, G))
            observation, _, _, _, info = env.step(action.astype(np.float32))
            worth = np.log(info["trial_robust_cost"])
            found = (observation[:, IDENTIFIED : IDENTIFIED + G], _shown(observation), worth)
            for column, value in zip(columns, found, strict=True):
                column.append(np.asarray(value, np.float32))
    return TrialData(context, *(np.stack(column, axis=1) for column in columns))


def _random_gains(rng: np.random.Generator, count: int) -> Floats:
    """Return ln of gains over the rule's, (count, gains)."""
    shape = (count, len(GAINS))
    likely = rng.random((count, 1)) < SHARE
    about = ABOUT + np.array(TOGETHER) * rng.standard_normal((count, 1))
    drawn = np.where(likely, rng.normal(about, SPREAD), rng.uniform(LOW, HIGH, shape))
    return np.clip(drawn, -FARTHEST, FARTHEST)


def _random_dynamics(rng: np.random.Generator) -> str:
    """Return the margins of dynamics somewhere between soft and stiff ones, as text."""
    soft, stiff = (find_dynamics(name) for name in ("soft", "stiff"))
    share = np.clip(rng.uniform() + STRAY * rng.standard_normal(3), 0.0, 1.0)
    pairs = zip(share, ("phase_deg", "gain_db", "ms"), strict=True)
    phase, gain, ms = (x * getattr(stiff, name) + (1.0 - x) * getattr(soft, name) for x, name in pairs)
    return f"{phase:.1f}/{gain:.1f}/{ms:.2f}"


def asked_for(agent: AgentFile, dynamics: str) -> SurrogatePolicy:
    """Return an agent's policy that is asked for dynamics."""
    return SurrogatePolicy(replace(agent, configuration={**agent.configuration, "dynamics": dynamics}))


def _shown(observation: Array) -> Array:
    at = IDENTIFIED + 2 * len(GAINS)
    return np.asarray(observation[:, at : at + SHOWN], np.float32)


def bundle_of(arrays: Mapping[str, Array], card: Mapping[str, Any]) -> AgentFile:
    """Return the agent."""
    settings = {"gains": len(GAINS), "step": CONFIGURATION["step"], "low": list(LOW), "high": list(HIGH), **SETTINGS}
    versions = installed("drive-env", "numpy", "torch", "mujoco", "numba")
    return AgentFile("surrogate", arrays, settings, ENVIRONMENT, dict(CONFIGURATION), card, versions)


def train(
    seed: int = 0,
    *,
    rounds: Sequence[Round] = ROUNDS,
    machines_at_once: int = LANES,
    rows: Sequence[tuple[str, str]] = TRAINING,
    kept: Path | None = None,
    progress: Callable[[str, float], None] = lambda what, share: None,
) -> AgentFile:
    """Return a surrogate trained from nothing, or from the trials that were kept.

    Args:
        seed: Of machines, trials and networks.
        rounds: What is tried; the first round's gains are random.
        machines_at_once: Machines in a set.
        rows: Load and motor.
        kept: Folder of the trials of a training with the same arguments; nothing is kept if not given.
        progress: Called with what is under way and how much of it is done.
    """
    from research.surrogate_fit import fit, join

    parts: list[Any] = []
    agent, arrays = None, {}
    for number, (sets, trials) in enumerate(rounds):
        what = f"round {number + 1} of {len(rounds)}"
        each = [(k, j) for k in range(sets) for j in range(len(rows))]
        for done, (k, j) in enumerate(each):
            own = int(np.random.SeedSequence((FIRST_SEED + 1000 * number + seed, k, j)).generate_state(1)[0])
            file = None if kept is None else kept / f"trials_{seed}_{number}_{k}_{j}.npz"
            parts.append(_kept(file) or _keep(file, collect(*rows[j], machines_at_once, trials, own, agent)))
            progress(f"{what}: trials", (done + 1) / len(each))
        networks = 1 if number + 1 < len(rounds) else NETWORKS
        arrays = fit(join(parts), seed, networks, partial(progress, f"{what}: networks"))
        agent = bundle_of(arrays, {})
    card = {
        "trained": f"{len(rounds)} rounds of trials on emulated machines, the robust cost known; networks by torch",
        "distribution": [f"{load} on {motor}" for load, motor in rows],
        "machines": sum(len(part.worth) for part in parts),
        "trials": sum(part.worth.size for part in parts),
        "seed": seed,
        HOLDS: {
            "devices": [DEVICE],
            "axes of a machine": 1,
            "motors": sorted({motor for _, motor in rows}),
            "loads": sorted({load for load, _ in rows}),
        },
        "limits": list(LIMITS),
    }
    return bundle_of(arrays, card)


def _kept(file: Path | None) -> Any:
    from research.surrogate_fit import TrialData

    if file is None or not file.exists():
        return None
    stored = read_arrays(file)
    return TrialData(**{name: stored[name] for name in TrialData._fields})


def _keep(file: Path | None, trials: Any) -> Any:
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        beside = file.with_name(f"{file.stem}_part.npz")  # a run that dies leaves no half of it
        np.savez_compressed(beside, allow_pickle=False, **trials._asdict())
        beside.replace(file)
    return trials


def judge(
    policy: Any, machines: int, seed: int, rows: Sequence[tuple[str, str]] = TRAINING, dynamics: str = DEFAULT
) -> Answers:
    """Let a tuner tune machines that it was not trained on, and score what it leaves by what dynamics ask for."""
    found = []
    for load, motor in rows:
        with machines_of(load, motor, machines, dynamics=dynamics) as env:
            observation, info = env.reset(seed=seed)
            tried, costs, aborted = [info["gains"]], [info["robust_cost"]], []
            policy.reset()
            for _ in range(env.config.trials):
                observation, _, _, _, info = env.step(policy.act(observation))
                tried.append(info["trial_gains"])
                costs.append(info["trial_robust_cost"])
                aborted.append(info["aborted"])
            answer = env.gains_of(policy.answer(observation))
            ratio = np.array(costs) / costs[0]
            same = np.all(np.array(tried) == answer, axis=(2, 3))  # (trials, machines)
            if not same.any(axis=0).all():
                raise RuntimeError("the tuner answered gains that it had not tried")
            of_answer = ratio[same.argmax(axis=0), np.arange(machines)]
            found.append((of_answer, of_answer * costs[0] < TRIP, info["robust_cost"] / costs[0], ratio.min(axis=0),
                          np.mean(aborted, axis=0), costs[0] < TRIP))  # fmt: skip
    return Answers(*(np.array(column) for column in zip(*found, strict=True)))


def figures_of(ratios: Floats) -> dict[str, Any]:
    """Return the card's figures: robust cost over the rule's, with 95 % intervals (bootstrap over machines)."""
    flat = ratios.ravel()
    figures: dict[str, Any] = {}
    for name, of in (
        ("median", lambda x: np.median(x, axis=-1)),
        ("p95", lambda x: np.quantile(x, 0.95, axis=-1)),
        ("share more than 5 % worse", lambda x: np.mean(x > 1.05, axis=-1)),
    ):
        figures[name] = round(float(of(flat)), 3)
        figures[f"{name}, 95 % interval"] = [round(end, 3) for end in bootstrap_interval(of, flat)]
    return figures


def judged(made: AgentFile) -> AgentFile:
    """Return the agent with figures in its card, of machines that it was not trained on."""
    of = {name: judge(asked_for(made, name), MACHINES, UNSEEN, dynamics=name) for name in known_dynamics()}
    answers = of[DEFAULT]
    figures = {
        "what": "robust cost of the answer over the baseline rule's, 10 trials, machines not trained on; standard "
        "dynamics; of the agent alone, without the check of margins that drive-agent tune adds",
        "machines": answers.ratio.size,
        "seed": UNSEEN,
        **figures_of(answers.ratio),
        "median of the best trial": _median(answers.best),
        "trials that were stopped": round(float(answers.aborted.mean()), 3),
        "constraints kept": _share(answers.kept),
        "constraints kept by the rule": _share(answers.rule),
        "median of each row": {_name(row): _median(ratio) for row, ratio in zip(TRAINING, answers.ratio, strict=True)},
        "constraints kept of each row": {
            _name(row): _share(kept) for row, kept in zip(TRAINING, answers.kept, strict=True)
        },
        "other dynamics": {
            name: {"median": _median(found.ratio), "constraints kept": _share(found.kept)}
            for name, found in of.items()
            if name != DEFAULT
        },
    }
    return replace(made, card={**made.card, "figures": figures})


def _name(row: tuple[str, str]) -> str:
    return " on ".join(row)


def _median(values: Floats) -> float:
    return round(float(np.median(values)), 3)


def _share(values: Mask) -> float:
    return round(float(np.mean(values)), 3)


def main() -> None:
    """Train from the command line."""
    from rich.progress import Progress

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="file of the agent (.npz)")
    parser.add_argument("--seed", type=int, default=0, help="seed of machines, trials and networks")
    parser.add_argument("--trials", type=Path, help="folder to keep trials in, and to take them from")
    arguments = parser.parse_args()
    with Progress() as bar:
        task = bar.add_task("training", total=1.0)
        made = train(
            arguments.seed,
            kept=arguments.trials,
            progress=lambda what, share: bar.update(task, description=what, completed=share),
        )
    made = judged(made)
    print(
        f"{made.card['figures']['median']} of the rule's robust cost in the median, written to "
        f"{made.save(arguments.out)}"
    )


if __name__ == "__main__":
    main()
