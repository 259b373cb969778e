"""Training of the surrogate tuner: trials on emulated machines, then a network that predicts the cost of gains.

    python -m research.surrogate_training --out surrogate.npz --seed 0
    python -m research.surrogate_training --out surrogate_tgz.npz --device tgz_d --budget short

Round by round: trials of random gains on machines of every row of the device's recipe (`tuner_recipes.py`), then of
gains that the surrogate of the round before proposes, so that it learns where it is sent. Each set of machines has
dynamics of its own. With --trials FOLDER the trials are kept there, and those that are there are not made again: a
training that was stopped goes on. With OMP_NUM_THREADS=1 the whole budget takes 10 minutes of a core; NumPy's threads
do nothing for matrices this small but wait for each other, three times as long.
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

from agents.policies.agent_file import AgentFile, installed
from agents.tuner.known_range import HOLDS
from agents.tuner.surrogate import IDENTIFIED, SHOWN, SurrogatePolicy, context_of
from agents.tuner.tune_target import WIDEST
from drive_env.devices import find_device
from drive_env.envs.gain_tuning import GainTuning, GainTuningConfig
from drive_env.loops.dynamics import DEFAULT, find_dynamics
from drive_env.trials.score import TRIP
from mechanics.arrays import Floats, Mask, Singles
from mechanics.reading.untrusted import read_arrays
from research.tuner_recipes import RECIPES, Recipe, TrainingMachines, laws
from tuning.bootstrap import bootstrap_interval

ENVIRONMENT = "ServoDrive/GainTuning-v0"
TRIALS = 10  # of an episode
STEP = 5.0  # reaches any gains that are tried, from wherever the incumbent is
STRAY = 0.2  # of the way from soft to stiff dynamics: how far the margins of a set may part from each other
SHARE = 0.6  # of random gains: what is drawn about where optima lie; the rest comes evenly from the range
FARTHEST = 3.0
SHAKES, SHAKE = (0.3, 1.0, 2.0), 0.15  # of proposals, for news: one of the factors, and the standard deviation
FIRST_SEED = 1001  # of a training's machines; its rounds' are a thousand apart
UNSEEN = 457_000  # seed of machines that figures are measured on
# The best of a few on machines of seed 555,000: of curiosities from -0.3 to 0.8, and of cautions from 0 to 2.
SETTINGS = {"curiosity": 0.4, "caution": 0.5}


class Round(NamedTuple):
    """A round of a training: sets of machines of every row, and trials of each machine."""

    sets: int
    trials: int


class Budget(NamedTuple):
    """The budget of a training.

    rounds: The first of random gains. machines: Of a row and set. networks: Of what is made; a round's proposals come
    from one. judged: Machines of a row that figures are measured on.
    """

    rounds: tuple[Round, ...]
    machines: int
    networks: int
    judged: int


BUDGETS = {
    "full": Budget((Round(4, 8), *[Round(1, 10)] * 4), machines=128, networks=3, judged=26),  # what ships
    "short": Budget((Round(2, 8), *[Round(1, 10)] * 2), machines=64, networks=2, judged=16),
    "quick": Budget((Round(1, 3), Round(1, 3)), machines=4, networks=1, judged=2),  # whether a recipe runs
}


class Answers(NamedTuple):
    """The gains that a tuner left on machines, (rows, machines) each.

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
def machines_of(recipe: Recipe, row: TrainingMachines, count: int, **options: Any) -> Iterator[Any]:
    """Make the environment with random machines of a row, options in place of the configuration's."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of machines that their motors can hardly move: they are tuned, too
        env = GainTuning(
            count, device=recipe.device, load=row.load, motor=row.motor, distributions=laws(recipe, row),
            config=configuration(recipe), **options,
        )  # fmt: skip
        try:
            yield env
        finally:
            env.close()


def configuration(recipe: Recipe) -> dict[str, Any]:
    """Return the configuration of an agent; of the device that `GainTuning` has by itself it need not name it."""
    own = {} if recipe.device == GainTuningConfig.device else {"device": recipe.device}
    return {**own, "gains": list(recipe.gains), "trials": TRIALS, "step": STEP}


def collect(
    recipe: Recipe, row: TrainingMachines, machines: int, trials: int, seed: int, agent: AgentFile | None = None
) -> Any:
    """Return `TrialData` on random machines: of random gains, or of an agent's proposals, shaken a little."""
    from research.surrogate_fit import TrialData

    rng = np.random.default_rng(seed)
    G = len(recipe.gains)
    columns: tuple[list[Singles], ...] = ([], [], [])
    dynamics = _random_dynamics(rng, recipe.dynamics)
    policy = None if agent is None else asked_for(agent, dynamics)
    with machines_of(recipe, row, machines, trials=trials, step=2.0 * FARTHEST, dynamics=dynamics) as env:
        observation, _ = env.reset(seed=seed)
        context = context_of(observation[:, :IDENTIFIED], _shown(observation, G), find_dynamics(dynamics))
        for _ in range(trials):
            if policy is None:
                wanted = _random_gains(rng, recipe, machines)
                change = wanted - observation[:, IDENTIFIED + G : IDENTIFIED + 2 * G]
            else:
                shake = SHAKE * rng.choice(SHAKES, (machines, 1))
                change = STEP * policy.act(observation) + shake * rng.standard_normal((machines, G))
            observation, _, _, _, info = env.step(change / env.config.step)
            worth = np.log(info["trial_robust_cost"])
            found = (observation[:, IDENTIFIED : IDENTIFIED + G], _shown(observation, G), worth)
            for column, value in zip(columns, found, strict=True):
                column.append(np.asarray(value, np.float32))
    return TrialData(context, *(np.stack(column, axis=1) for column in columns))


def _random_gains(rng: np.random.Generator, recipe: Recipe, count: int) -> Floats:
    """Return ln of gains over the rule's, (count, gains)."""
    shape = (count, len(recipe.gains))
    likely = rng.random((count, 1)) < SHARE
    about = recipe.about + np.array(recipe.together) * rng.standard_normal((count, 1))
    drawn = np.where(likely, rng.normal(about, recipe.spread), rng.uniform(recipe.low, recipe.high, shape))
    return np.clip(drawn, -FARTHEST, FARTHEST)


def _random_dynamics(rng: np.random.Generator, names: Sequence[str]) -> str:
    """Return the margins of dynamics somewhere between the first and the last of these, as text."""
    soft, stiff = find_dynamics(names[0]), find_dynamics(names[-1])
    share = np.clip(rng.uniform() + STRAY * rng.standard_normal(3), 0.0, 1.0)
    pairs = zip(share, ("phase_deg", "gain_db", "ms"), strict=True)
    phase, gain, ms = (x * getattr(stiff, name) + (1.0 - x) * getattr(soft, name) for x, name in pairs)
    return f"{phase:.1f}/{gain:.1f}/{ms:.2f}"


def asked_for(agent: AgentFile, dynamics: str) -> SurrogatePolicy:
    """Return an agent's policy that is asked for dynamics."""
    return SurrogatePolicy(replace(agent, configuration={**agent.configuration, "dynamics": dynamics}))


def _shown(observation: Singles, gains: int) -> Singles:
    at = IDENTIFIED + 2 * gains
    return np.asarray(observation[:, at : at + SHOWN], np.float32)


def bundle_of(recipe: Recipe, arrays: Mapping[str, Singles], card: Mapping[str, Any]) -> AgentFile:
    """Return the agent."""
    ends = {"low": list(recipe.low), "high": list(recipe.high)}
    settings = {"gains": len(recipe.gains), "step": STEP, **ends, **SETTINGS}
    versions = installed("drive-env", "numpy", "torch", "mujoco", "numba")
    return AgentFile("surrogate", arrays, settings, ENVIRONMENT, configuration(recipe), card, versions)


def train(
    recipe: Recipe,
    seed: int = 0,
    *,
    budget: Budget = BUDGETS["full"],
    kept: Path | None = None,
    progress: Callable[[str, float], None] = lambda what, share: None,
) -> AgentFile:
    """Return a surrogate trained from nothing, or from the trials that were kept.

    Args:
        recipe: Of the device.
        seed: Of machines, trials and networks.
        budget: What is tried.
        kept: Folder of the trials of a training with the same arguments; nothing is kept if not given.
        progress: Called with what is under way and how much of it is done.
    """
    from research.surrogate_fit import fit, join

    parts: list[Any] = []
    agent, arrays = None, {}
    rounds, rows = budget.rounds, recipe.rows
    for number, (sets, trials) in enumerate(rounds):
        what = f"round {number + 1} of {len(rounds)}"
        each = [(k, j) for k in range(sets) for j in range(len(rows))]
        for done, (k, j) in enumerate(each):
            own = int(np.random.SeedSequence((FIRST_SEED + 1000 * number + seed, k, j)).generate_state(1)[0])
            file = None if kept is None else kept / f"trials_{seed}_{number}_{k}_{j}.npz"
            parts.append(_kept(file) or _keep(file, collect(recipe, rows[j], budget.machines, trials, own, agent)))
            progress(f"{what}: trials", (done + 1) / len(each))
        networks = 1 if number + 1 < len(rounds) else budget.networks
        arrays = fit(join(parts), recipe.reach, seed, networks, partial(progress, f"{what}: networks"))
        agent = bundle_of(recipe, arrays, {})
    card = {
        "trained": f"{len(rounds)} rounds of trials on emulated machines, the robust cost known; networks by torch",
        "distribution": [row.name for row in rows],
        "machines": sum(len(part.worth) for part in parts),
        "trials": sum(part.worth.size for part in parts),
        "seed": seed,
        HOLDS: {
            "devices": [recipe.device],
            "axes of a machine": 1,
            "motors": sorted({row.motor for row in rows}),
            "loads": sorted({row.load for row in rows}),
        },
        "limits": list(recipe.limits),
    }
    return bundle_of(recipe, arrays, card)


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


def judge(recipe: Recipe, policy: Any, machines: int, seed: int, dynamics: str = DEFAULT) -> Answers:
    """Let a tuner tune machines that it was not trained on, and score its gains by the dynamics' requirements."""
    found = []
    for row in recipe.rows:
        with machines_of(recipe, row, machines, dynamics=dynamics) as env:
            observation, info = env.reset(seed=list(range(seed, seed + machines)))
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


def factory_cost(recipe: Recipe, machines: int, seed: int) -> Floats:
    """Return the robust cost of the factory's gains over the rule's on the machines of `judge`, (rows, machines)."""
    device = find_device(recipe.device)
    columns = device.gains.columns(recipe.gains)
    dictionary = device.new_dictionary()
    factory = np.array([dictionary.find(device.gains.keys[k]).default for k in columns], float)
    found = []
    for row in recipe.rows:
        with machines_of(recipe, row, machines, trials=1, step=WIDEST) as env:
            _, info = env.reset(seed=list(range(seed, seed + machines)))
            change = np.log(np.maximum(factory, 1.0)) - np.log(info["gains"][:, 0][:, columns])
            _, _, _, _, after = env.step(change / WIDEST)
            found.append(after["trial_robust_cost"] / info["robust_cost"])
    return np.array(found)


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


def judged(recipe: Recipe, made: AgentFile, machines: int) -> AgentFile:
    """Return the agent with figures in its card, of machines of each row that it was not trained on."""
    of = {name: judge(recipe, asked_for(made, name), machines, UNSEEN, name) for name in recipe.dynamics}
    answers = of[DEFAULT]
    figures = {
        "what": f"robust cost of the answer over that of {recipe.rule}, {TRIALS} trials, machines not trained on; "
        "standard dynamics; of the agent alone, without the check of margins that drive-tune auto --by agent adds",
        "machines": answers.ratio.size,
        "seed": UNSEEN,
        **figures_of(answers.ratio),
        "median of the best trial": _median(answers.best),
        "median of the factory's gains": _median(factory_cost(recipe, machines, UNSEEN)),
        "trials that were stopped": round(float(answers.aborted.mean()), 3),
        "constraints kept": _share(answers.kept),
        "constraints kept by the rule": _share(answers.rule),
        "median of each row": {row.name: _median(each) for row, each in zip(recipe.rows, answers.ratio, strict=True)},
        "constraints kept of each row": {
            row.name: _share(each) for row, each in zip(recipe.rows, answers.kept, strict=True)
        },
        "other dynamics": {
            name: {"median": _median(found.ratio), "constraints kept": _share(found.kept)}
            for name, found in of.items()
            if name != DEFAULT
        },
    }
    return replace(made, card={**made.card, "figures": figures})


def _median(values: Floats) -> float:
    return round(float(np.median(values)), 3)


def _share(values: Mask) -> float:
    return round(float(np.mean(values)), 3)


def main(words: Sequence[str] | None = None) -> None:
    """Train from the command line, or from these words of one."""
    from rich.progress import Progress

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="file of the agent (.npz)")
    parser.add_argument("--device", choices=RECIPES, default="tmcm1636", help="drive that is tuned")
    parser.add_argument("--budget", choices=BUDGETS, default="full", help="how much is tried; quick: whether it runs")
    parser.add_argument("--seed", type=int, default=0, help="seed of machines, trials and networks")
    parser.add_argument("--trials", type=Path, help="folder to keep trials in, and to take them from")
    arguments = parser.parse_args(words)
    recipe, budget = RECIPES[arguments.device], BUDGETS[arguments.budget]
    with Progress() as bar:
        task = bar.add_task("training", total=1.0)
        made = train(
            recipe,
            arguments.seed,
            budget=budget,
            kept=arguments.trials,
            progress=lambda what, share: bar.update(task, description=what, completed=share),
        )
    made = judged(recipe, made, budget.judged)
    print(
        f"{made.card['figures']['median']} of the robust cost of {recipe.rule} in the median, written to "
        f"{made.save(arguments.out)}"
    )


if __name__ == "__main__":
    main()
