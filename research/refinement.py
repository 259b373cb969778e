"""A controller's last layer, refined by the cross-entropy method: least error at no more current than its rival's.

    drive-agent train tracking --load two_mass --seed 1 --out runs/two_mass      # and gantry
    python -m research.refinement runs/two_mass/agent.npz --out two_mass.npz
    python -m research.refinement --load cart_pendulum --out cart_pendulum.npz     # a linear law
    python -m research.tracking_comparison two_mass.npz --card

These commands make the controllers that ship.

A policy gradient weighs current against error at a price, and does not hear of the few machines in a hundred that an
agent sets oscillating. Here whole episodes count, as they are judged: the mean RMS error of many machines, and what
their mean RMS current has above that of the cascade with feed-forward. The search goes in few directions: the changes
of the last layer that add an entry of the observation to the action. Axes that pull one load act as one, on the mean of
what they see, since what they pull against each other is current for nothing.

Without an agent it begins as the load's baseline, which is linear.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.policies.agent_file import AgentFile, installed, plain
from agents.policies.baselines import baseline
from agents.policies.policy import policy_of
from agents.training.tasks import configuration_of, make_environments

Floats = NDArray[np.float64]
Array = NDArray[np.float32]

ENVIRONMENT = "ServoDrive/Tracking-v0"
AXIS_ENTRIES = 8  # of an axis in Tracking's observation
ERROR, CURRENT = 0, 4
UNBOUNDED = 1e6  # for features, which are no action
FELL = 1.0  # of the amplitude: the error of an episode that ended early
RIDGE = 1e-6  # of the features' mean square, in the fit of directions
EVERY = 5  # steps between two observations that directions are fitted to
LEAST_DEVIATION = 0.1  # of the first one: what the search keeps


@dataclass(frozen=True)
class RefinementSearch:
    """What is searched for, and how.

    Attributes:
        start: Baseline that it begins as where no agent is given; "" where one is needed.
        options: Configuration of the environment then.
        rival: Baseline whose current is the limit; "" for none: the environment's own reward counts.
        limit: Of the mean RMS current, over the rival's.
        price: Of current above it, in shares of the rival's error.
        share: Of the change found that is taken: chosen by error and current on development machines.
        entries: Those of an axis, 0...7, and of the load, from 8, whose directions are searched; () for all.
        deviation: First standard deviation of what a direction adds to the action, per standard deviation of its entry.
        pool: Machines of the training.
        hard: Those of them whose current the start raises most, which every candidate is tried on.
        machines: Others that a generation draws from the pool.
        limits: Of the controller that comes of it, for its card, where it begins as a baseline.
        candidates, elite, generations: Of the cross-entropy method.
    """

    start: str = ""
    options: tuple[tuple[str, Any], ...] = ()
    rival: str = "feed_forward"
    limit: float = 0.975
    price: float = 12.0
    share: float = 1.0
    entries: tuple[int, ...] = ()
    deviation: float = 0.01
    pool: int = 512
    hard: int = 12
    machines: int = 20
    limits: tuple[str, ...] = ()
    candidates: int = 20
    elite: int = 5
    generations: int = 24


# Load -> how its controller is refined.
SEARCHES = {
    "two_mass": RefinementSearch(share=0.85),
    "gantry": RefinementSearch(hard=4, machines=16, pool=256, deviation=0.008, share=1.75),
    "cart_pendulum": RefinementSearch(
        start="feed_forward",
        # Swinging counts four times: with the environment's own weights nothing beats following closely, swing or not.
        options=(("mode", "csp"), ("action", "offset"), ("duration", 3.0), ("weights", {"load": 4.0})),
        rival="",
        entries=(8, 9),  # the pendulum's: the drive sees to the cart
        deviation=0.1,
        pool=128,
        hard=0,
        machines=12,
        limits=(
            "swings less for a larger following error: what the reward weighs, weights.load 4",
            "damps swinging that its own moves cause; it does not swing a load up",
        ),
    ),
}


class Played(NamedTuple):
    """What episodes brought.

    error: RMS following error of the worst axis, share of the amplitude, shape (n,).
    current: RMS current of the worst axis, share of the limit, shape (n,).
    reward: Mean of a step's, shape (n,).
    """

    error: Floats
    current: Floats
    reward: Floats

    def of(self, where: Any) -> Played:
        """Return that of some environments, or in another shape."""
        return Played(*(values[where] for values in self))


def refine(
    bundle: AgentFile, search: RefinementSearch, seed: int = 0, told: Callable[[int, float], None] | None = None
) -> AgentFile:
    """Return a controller with a refined last layer.

    Args:
        bundle: The controller, a network of fully connected layers.
        search: How.
        seed: Of machines and candidates.
        told: Called with the generation and the cost of the mean controller in it.

    Raises:
        ValueError: If the bundle is none of that kind.
    """
    if bundle.environment != ENVIRONMENT or bundle.kind != "mlp":
        raise ValueError(
            f"a network (mlp) for {ENVIRONMENT} can be refined, not {bundle.kind} for {bundle.environment}"
        )
    first, rng = machine_seed(seed), np.random.default_rng(seed)
    features, start = features_of(bundle), acting_as_one(last_layer(bundle))
    pool = _environments(bundle, search.pool)
    try:
        seeds = np.arange(first, first + search.pool)
        directions = directions_of(pool, features, start, seeds)
        directions = directions[:, search.entries or slice(None)]
        own = play(pool, features, start[None], seeds)
        rival = own
        if search.rival:
            axes = pool.single_action_space.shape[0]
            rival = play_policy(pool, baseline(search.rival, ENVIRONMENT, pool.config, axes), seeds)
    finally:
        pool.close()
    order = np.argsort(rival.current - own.current, kind="stable")
    hard, others = order[: search.hard], order[search.hard :]
    envs = _environments(bundle, search.candidates * (search.hard + search.machines))
    mean = np.zeros(directions.shape[-1])
    deviation = np.full(mean.shape, search.deviation)
    ranks = np.arange(search.elite, 0, -1.0)
    ranks /= ranks.sum()
    try:
        for generation in range(search.generations):
            some = np.concatenate([hard, rng.choice(others, search.machines, replace=False)])
            weight = np.repeat([search.hard / search.pool, 1.0 - search.hard / search.pool],
                               [search.hard, search.machines])  # fmt: skip
            weight /= np.repeat([max(search.hard, 1), search.machines], [search.hard, search.machines])
            candidates = mean + deviation * rng.standard_normal((search.candidates, len(mean)))
            candidates[0] = mean
            layers = start + changes(directions, candidates, start.shape[1])
            found = play(envs, features, layers, np.tile(seeds[some], search.candidates))
            shape = (search.candidates, len(some))
            costs = cost(Played(*(row.reshape(shape) for row in found)), rival.of(some), weight, search)
            if told is not None:
                told(generation, float(costs[0]))
            best = candidates[np.argsort(costs, kind="stable")[: search.elite]]
            spread = np.sqrt(ranks @ np.square(best - mean))
            deviation = np.maximum(0.8 * deviation + 0.2 * spread, LEAST_DEVIATION * search.deviation)
            mean = 0.5 * (mean + ranks @ best)
    finally:
        envs.close()
    return with_last_layer(bundle, start + changes(directions, search.share * mean[None], start.shape[1])[0])


def cost(found: Played, rival: Played, weight: Floats, search: RefinementSearch) -> Floats:
    """Return the cost of candidates, shape (candidates,).

    Args:
        found: Of the candidates, each of shape (candidates, machines).
        rival: Of the rival on the same machines, each of shape (machines,).
        weight: Of the machines, shape (machines,), of sum 1.
        search: Limit and price.
    """
    if not search.rival:
        return np.asarray(-(found.reward @ weight))
    error = found.error @ weight / (rival.error @ weight)
    # Both the means' ratio and the machines' mean ratio: neither the heaviest machines alone nor the lightest count.
    current = 0.5 * (found.current @ weight / (rival.current @ weight) + (found.current / rival.current) @ weight)
    return np.asarray(error + search.price * np.maximum(0.0, current - search.limit))


# --- the last layer ---------------------------------------------------------------------------------------------------
def linear(load: str, search: RefinementSearch) -> AgentFile:
    """Return the baseline that a search begins as, as a network of one layer."""
    options = {"load": load, "distributions": load, **dict(search.options)}
    envs: Any = make_environments(ENVIRONMENT, 1, options)
    entries, axes = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    configuration = configuration_of(envs)
    envs.close()
    law = baseline(search.start, ENVIRONMENT, envs.config, axes)
    probe = 1e-3  # small enough that no action is cut off
    weight = np.asarray(law.act(probe * np.eye(entries, dtype=np.float32)), np.float32) / np.float32(probe)
    arrays = {
        "observation_mean": np.zeros(entries),
        "observation_scale": np.ones(entries),
        "action_low": -np.ones(axes, np.float32),
        "action_high": np.ones(axes, np.float32),
        "weight_0": weight,
        "bias_0": np.zeros(axes, np.float32),
    }
    settings = {"activation": "tanh", "output": "clip", "observation_clip": None}
    card = {
        "trained": f"begun as {search.start}",
        "distribution": load,
        "seeds": {},
        "figures": {},
        "limits": [f"trained on the load {load!r} alone", *search.limits],
    }
    return AgentFile(
        "mlp", arrays, settings, ENVIRONMENT, configuration, card, installed("drive-env", "numpy", "mujoco")
    )


def features_of(bundle: AgentFile) -> Callable[[Any], Array]:
    """Return the function from observations (environments, entries) to the last layer's input and 1."""
    number = _last(bundle)
    width = bundle.arrays[f"weight_{number}"].shape[0]
    bound = np.full(width, UNBOUNDED, np.float32)
    arrays = {**bundle.arrays, f"weight_{number}": np.eye(width, dtype=np.float32), "action_low": -bound,
              f"bias_{number}": np.zeros(width, np.float32), "action_high": bound}  # fmt: skip
    policy = policy_of(replace(bundle, arrays=arrays, settings={**bundle.settings, "output": "clip"}))
    return lambda observation: np.pad(policy.act(observation), ((0, 0), (0, 1)), constant_values=1.0)


def last_layer(bundle: AgentFile) -> Floats:
    """Return weights of the last layer and, as the last row, its biases, shape (features, axes)."""
    number = _last(bundle)
    return np.vstack([bundle.arrays[f"weight_{number}"], bundle.arrays[f"bias_{number}"]]).astype(float)


def with_last_layer(bundle: AgentFile, layer: Floats) -> AgentFile:
    """Return a bundle with another last layer, as `last_layer` has it."""
    number, layer = _last(bundle), layer.astype(np.float32)
    return replace(bundle, arrays={**bundle.arrays, f"weight_{number}": layer[:-1], f"bias_{number}": layer[-1]})


def acting_as_one(layer: Floats) -> Floats:
    """Return a last layer whose axes all do the mean of what they did."""
    return np.repeat(layer.mean(axis=1, keepdims=True), layer.shape[1], axis=1)


def directions_of(envs: Any, features: Callable[[Any], Array], layer: Floats, seeds: NDArray[Any]) -> Floats:
    """Return the changes of the last layer that add entries of the observation, shape (features, directions).

    There is one for each of an axis' entries, of the mean over the axes, and one for each of the load's; each adds its
    entry in standard deviations, as well as the features can by least squares over states that the controller visits.
    """
    axes = layer.shape[1]
    seen, inside = [], []
    observation, _ = envs.reset(seed=seeds.tolist())
    for step in range(envs.config.steps):
        row = features(observation)
        if step % EVERY == 0:
            seen.append(np.array(observation, float))
            inside.append(row.astype(float))
        observation, *_ = envs.step(np.clip(row @ layer, -1.0, 1.0).astype(np.float32))
    x, h = np.concatenate(seen), np.concatenate(inside)
    own = x[:, : AXIS_ENTRIES * axes].reshape(len(x), axes, AXIS_ENTRIES).mean(axis=1)
    entries = np.hstack([own, x[:, AXIS_ENTRIES * axes :]])
    entries /= np.maximum(entries.std(axis=0), 1e-9)
    squares = h.T @ h / len(h)
    squares += RIDGE * np.trace(squares) / len(squares) * np.eye(len(squares))
    return np.asarray(np.linalg.solve(squares, h.T @ entries / len(h)))


def changes(directions: Floats, weights: Floats, axes: int) -> Floats:
    """Return what weights of the directions, shape (candidates, directions), change: (candidates, features, axes)."""
    return np.repeat((weights @ directions.T)[:, :, None], axes, axis=2)


# --- episodes ---------------------------------------------------------------------------------------------------------
def play(envs: Any, features: Callable[[Any], Array], layers: Floats, seeds: NDArray[Any]) -> Played:
    """Return what an episode of every environment brought.

    Args:
        envs: Of Tracking.
        features: What the last layers see.
        layers: A last layer for each candidate, shape (candidates, features, axes); each has as many environments.
        seeds: Of the environments.
    """
    given = layers.astype(np.float32)

    def act(observation: Any) -> Array:
        rows = features(observation)
        found: Array = np.matmul(rows.reshape(len(given), -1, rows.shape[1]), given).reshape(len(rows), -1)
        return found

    return _play(envs, act, seeds)


def play_policy(envs: Any, policy: Any, seeds: NDArray[Any]) -> Played:
    """Return what an episode of every environment brought a policy."""
    return _play(envs, policy.act, seeds)


def _play(envs: Any, act: Callable[[Any], Array], seeds: NDArray[Any]) -> Played:
    steps, axes = envs.config.steps, envs.single_action_space.shape[0]
    observation, _ = envs.reset(seed=seeds.tolist())
    squares, rewards = np.zeros((2, envs.num_envs, axes)), np.zeros(envs.num_envs)
    standing = np.ones(envs.num_envs, bool)
    for _ in range(steps):
        observation, reward, terminated, _, _ = envs.step(np.clip(act(observation), -1.0, 1.0))
        standing &= ~terminated
        rows = observation[:, : AXIS_ENTRIES * axes].reshape(-1, axes, AXIS_ENTRIES)
        squares += np.square(rows[:, :, (ERROR, CURRENT)], dtype=float).transpose(2, 0, 1)
        rewards += np.where(standing, reward, 0.0)
    error, current = np.sqrt(squares / steps).max(axis=2)
    return Played(np.where(standing, error, FELL), current, rewards / steps)


def machine_seed(seed: int) -> int:
    """Return the seed of a search's first machine; the others' follow by one."""
    return int(np.random.SeedSequence([seed, zlib.crc32(b"refinement")]).generate_state(1)[0]) >> 1


def _environments(bundle: AgentFile, count: int) -> Any:
    return make_environments(ENVIRONMENT, count, bundle.configuration, autoreset_mode="NextStep")


def _last(bundle: AgentFile) -> int:
    return max(int(name.removeprefix("weight_")) for name in bundle.arrays if name.startswith("weight_"))


def main() -> None:
    """Refine from the command line."""
    from rich.console import Console
    from rich.progress import Progress

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("agent", nargs="?", type=Path, help="the controller (.npz); without it the load's baseline")
    parser.add_argument("--load", choices=list(SEARCHES), help="load, if the agent does not name it")
    parser.add_argument("--out", type=Path, required=True, help="file of the refined one (.npz)")
    parser.add_argument("--seed", type=int, default=0, help="seed of machines and candidates")
    arguments = parser.parse_args()
    try:
        bundle, search = _given(arguments.agent, arguments.load)
        with Progress(console=Console(stderr=True)) as bar:
            task = bar.add_task("generations", total=search.generations)

            def show(generation: int, found: float) -> None:
                bar.update(task, completed=generation + 1, description=f"cost {found:.3f}")

            made = refine(bundle, search, arguments.seed, show)
    except ValueError as error:
        parser.error(str(error))
    trained = f"{bundle.card['trained']}; last layer refined by the cross-entropy method (research.refinement)"
    seeds = {**bundle.card.get("seeds", {}), "refinement": arguments.seed}
    card = {**bundle.card, "trained": trained, "seeds": seeds, "refinement": plain(search.__dict__), "figures": {}}
    print(f"written to {replace(made, card=card).save(arguments.out)}")


def _given(path: Path | None, load: str | None) -> tuple[AgentFile, RefinementSearch]:
    """Return what is refined, and how."""
    if path is None:
        if load is None or not SEARCHES[load].start:
            begins = ", ".join(name for name, search in SEARCHES.items() if search.start)
            raise ValueError(f"give an agent to refine, or one of the loads that begin as a baseline: --load {begins}")
        return linear(load, SEARCHES[load]), SEARCHES[load]
    bundle = AgentFile.load(path)
    name = str(bundle.configuration.get("load"))
    if load not in (None, name) or name not in SEARCHES:
        raise ValueError(f"{path} is for the load {name!r}; there are searches for {', '.join(SEARCHES)}")
    return bundle, SEARCHES[name]


if __name__ == "__main__":
    main()
