"""A controller of Tracking beside the cascades that it must beat: ratios of error and of current, machine by machine.

    python -m research.tracking_comparison tracking_two_mass --episodes 64 --seed 43000

All follow the same references with the same machines; a ratio's interval comes from drawing machines anew, both values
of a machine together.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.evaluation.scores import FIGURES, Episode, Interval, current, figures, following_error, interval, pole
from agents.policies.agent_file import AgentFile
from agents.policies.baselines import ControlLaw, feed_forward, nothing
from agents.policies.policy import policy_of
from agents.shipped import find_agent
from agents.training.tasks import make_environments
from agents.training.train import with_figures
from drive_env.gains import RAW_MAX
from tuning.bootstrap import bootstrap_interval

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.emulator.emulated_drives import EmulatedDrives

Floats = NDArray[np.float64]

ENVIRONMENT = "ServoDrive/Tracking-v0"
LANES = 64  # machines side by side
AXIS_ENTRIES = 8  # of an axis in Tracking's observation
ERROR, SPEED = 0, 3
LATENCY = 0.003  # s, from a sample to what follows from it, in the mean of the distributions' buses: leads by so much
SPAN = 3  # samples to either side, over which acceleration is taken
COMPARED = (following_error, current, pole)


class Rival(NamedTuple):
    """A cascade with feed-forward.

    mode: csp with a lead through 60B0h, or csv with the position loop in the master and 60B1h.
    tuned: Whether each drive's velocity P is made for its machine's inertia, which keeps the commissioned bandwidth.
    identified: Whether the lead is identified on each machine, with the very moves that it is judged by; else its
        constants are those of baselines.py, for all machines of the load.
    """

    mode: str
    tuned: bool = False
    identified: bool = False


RIVALS = {
    "csp with 60B0h": Rival("csp"),
    "csv with 60B1h": Rival("csv"),
    "csp with 60B0h identified on each machine": Rival("csp", identified=True),
    "csp tuned to each machine with 60B0h identified on it": Rival("csp", tuned=True, identified=True),
}


class Compared(NamedTuple):
    """What a comparison says.

    own: Figure -> values of the controller, shape (episodes,).
    ratios: Rival -> figure -> the controller's mean over the rival's, with its 95 % interval; `median` is that of the
        machines' ratios.
    fell: Episodes of the controller that ended early.
    """

    own: Mapping[str, Floats]
    ratios: Mapping[str, Mapping[str, Interval]]
    fell: int

    def table(self) -> dict[str, Any]:
        """Return the figures as a card has them, the ratios by rival as "against"."""
        against = {rival: {name: found._asdict() for name, found in row.items()} for rival, row in self.ratios.items()}
        own = {name: interval(values)._asdict() for name, values in self.own.items()}
        return {**own, "ended early": self.fell, **({"against": against} if against else {})}


def compare(
    bundle: AgentFile,
    episodes: int = 64,
    seed: int = 43_000,
    rivals: Sequence[str] = tuple(RIVALS),
    told: Callable[[float], None] | None = None,
) -> Compared:
    """Return how a controller does beside rivals.

    Args:
        bundle: The controller, of Tracking; with rivals one whose action is the offset.
        episodes: How many, each with a machine and a reference of its own.
        seed: Of the first one.
        rivals: Rows of RIVALS.
        told: Called with the share that is done.

    Raises:
        ValueError: If the bundle is none of that kind.
    """
    if bundle.environment != ENVIRONMENT:
        raise ValueError(f"a controller of {ENVIRONMENT} is compared, not one of {bundle.environment}")
    if rivals and not _adds(bundle):
        raise ValueError("cascades are rivals of a controller with action = 'offset'; this one acts directly")
    policy = policy_of(bundle)
    rows: dict[str | None, dict[str, Floats]] = {}
    fell = 0
    for number, name in enumerate((None, *rivals)):
        rival = RIVALS[name] if name is not None else None
        changes = {} if rival is None else {"mode": rival.mode}
        envs: Any = make_environments(ENVIRONMENT, min(LANES, episodes), {**bundle.configuration, **changes})
        try:
            found: list[tuple[Episode, ...]] = []
            commissioned = (
                envs.drives.read(velocity_p(envs.drives.device)) if rival is not None and rival.tuned else None
            )
            for first in range(0, episodes, LANES):
                seeds = list(range(seed + first, seed + first + envs.num_envs))
                law = policy if rival is None else _law(rival, envs, seeds, commissioned)
                played = _play(envs, law, seeds, commissioned)
                found.append(played[: episodes - first])
                if told is not None:
                    told((number + min(1.0, (first + LANES) / episodes)) / (1 + len(rivals)))
            kept = [episode for some in found for episode in some]
            values = {row.name: np.array([row.compute(one, envs.config) for one in kept])
                      for row in figures(ENVIRONMENT, envs.config)}  # fmt: skip
            rows[name] = {key: row for key, row in values.items() if np.isfinite(row).all()}
            fell += rival is None and sum(episode.terminated for episode in kept)
        finally:
            envs.close()
    own = rows.pop(None)
    compared = [row.name for row in FIGURES[ENVIRONMENT] if row.compute in COMPARED and row.name in own]
    ratios = {str(name): {key: ratio(own[key], row[key]) for key in compared} for name, row in rows.items()}
    return Compared(own, ratios, fell)


def ratio(values: Any, others: Any) -> Interval:
    """Return mean over mean with its percentile bootstrap interval (95 %), pairs kept; `median` is of the pairs.

    Args:
        values: Of some episodes, shape (n,).
        others: Of the same ones.
    """
    values, others = np.asarray(values, float), np.asarray(others, float)
    low, high = bootstrap_interval(lambda x, y: x.mean(axis=1) / y.mean(axis=1), values, others)
    middle = float(np.median(values / others))
    return Interval(float(values.mean() / others.mean()), low, high, middle, len(values))


def identified_lags(error: Floats, speed: Floats, acceleration: Floats) -> Floats:
    """Return the lags of a cascade behind its reference, times speed [s] and times acceleration [s^2].

    They are the least squares of error = lag speed + lag_of_speed acceleration over a move without feed-forward, of the
    axis' own motion: an offset o leads it from G r to G (r + o), which is r if G o = r - G r, the error.

    Args:
        error: Reference less position [rev], shape (steps, environments, axes).
        speed: Of the axis [rev/s], the same shape.
        acceleration: Of the axis [rev/s^2], the same shape.

    Returns:
        Shape (2, environments, axes).
    """
    causes = np.stack([speed, acceleration])
    squares = np.einsum("istu,jstu->tuij", causes, causes)
    found = np.linalg.solve(squares, np.einsum("istu,stu->tui", causes, error)[..., None])[..., 0]
    return np.moveaxis(found, -1, 0)


def velocity_p(device: Device) -> tuple[int, int]:
    """Return the object of a device's velocity P."""
    return device.gains.keys[device.gains.names.index("velocity_p")]


def tune(drives: EmulatedDrives, commissioned: NDArray[np.int64]) -> None:
    """Make velocity P of emulated drives for the inertia of each machine, as a perfect identification finds it.

    Args:
        drives: The drives.
        commissioned: Raw velocity P for the inertia that the presets were computed for, shape (axes,).
    """
    from drive_env.envs.tracking_cycle import COMMISSIONED_INERTIA
    from tuning.identify.moved_inertia import moved_inertia

    motor = drives.motor
    inertia = np.concatenate([moved_inertia(group.load).reshape(-1) for group in drives.inside.groups])
    # What a drive measures is inertia over torque constant.
    share = np.repeat(drives.machine.parameters["motor.psi_m"] / motor.psi_m, drives.load.num_axes)
    wanted = commissioned * inertia / share / (COMMISSIONED_INERTIA * motor.inertia)
    drives.write(velocity_p(drives.device), np.clip(np.rint(wanted), 1, RAW_MAX).astype(np.int64))


def _law(rival: Rival, envs: Any, seeds: Sequence[int], commissioned: NDArray[np.int64] | None) -> ControlLaw:
    """Return a rival's feed-forward for the machines of these seeds."""
    if not rival.identified:
        return feed_forward(envs.config)
    axes, config = envs.single_action_space.shape[0], envs.config
    played = _play(envs, nothing(axes), seeds, commissioned)
    rows = np.stack([one.observations[1:, : axes * AXIS_ENTRIES].reshape(-1, axes, AXIS_ENTRIES) for one in played], 1)
    error, speed = config.amplitude * rows[..., ERROR].astype(float), config.speed * rows[..., SPEED].astype(float)
    inner = slice(SPAN, len(speed) - SPAN)
    acceleration = (speed[2 * SPAN :] - speed[: -2 * SPAN]) * (config.rate / (2 * SPAN))
    lag, lag_of_speed = identified_lags(error[inner], speed[inner], acceleration)
    return feed_forward(config, (lag, lag_of_speed + LATENCY * lag))


def _play(envs: Any, policy: Any, seeds: Sequence[int], commissioned: NDArray[np.int64] | None) -> tuple[Episode, ...]:
    """Return an episode of every environment; given the commissioned velocity P, the cascades are tuned before."""
    steps, count = envs.config.steps, envs.num_envs
    observation, _ = envs.reset(seed=list(seeds))
    if commissioned is not None:
        tune(envs.drives, commissioned)
    policy.reset(None)
    observations = np.zeros((steps + 1, *observation.shape), np.float32)
    actions = np.zeros((steps, *envs.action_space.shape), np.float32)
    rewards, length, fell = np.zeros((steps, count)), np.full(count, steps), np.zeros(count, bool)
    observations[0] = observation
    for k in range(steps):
        actions[k] = policy.act(observations[k])
        observations[k + 1], rewards[k], terminated, _, _ = envs.step(actions[k])
        length = np.where(terminated & ~fell, k + 1, length)
        fell |= terminated
    return tuple(
        Episode(seed, observations[: steps + 1, lane], actions[:steps, lane], rewards[:steps, lane], {},
                bool(fell[lane]), "", {}, {})
        for lane, (seed, steps) in enumerate(zip(seeds, length, strict=True))
    )  # fmt: skip


def _adds(bundle: AgentFile) -> bool:
    """Return whether a controller adds to a cascade, instead of being the only one."""
    return bundle.configuration.get("action") == "offset"


def main() -> None:
    """Compare from the command line."""
    from rich.console import Console
    from rich.progress import Progress

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("agent", help="one that ships, or a file (.npz)")
    parser.add_argument("--episodes", type=int, default=64, help="machines, each with a reference of its own")
    parser.add_argument("--seed", type=int, default=43_000, help="seed of the first one")
    parser.add_argument("--card", action="store_true", help="write the figures into the agent's card")
    arguments = parser.parse_args()
    try:
        if arguments.episodes < 1 or arguments.seed < 0:
            raise ValueError(f"--episodes {arguments.episodes} must be 1 or more, --seed {arguments.seed} 0 or more")
        path = find_agent(arguments.agent)
        bundle = AgentFile.load(path)
        with Progress(console=Console(stderr=True)) as bar:
            task = bar.add_task("episodes", total=1.0)
            found = compare(bundle, arguments.episodes, arguments.seed, tuple(RIVALS) if _adds(bundle) else (),
                            told=lambda at: bar.update(task, completed=at))  # fmt: skip
    except ValueError as error:
        parser.error(str(error))
    for name, values in found.own.items():
        print(f"{name}: {text(interval(values), '.4g')}")
    print(f"ended early: {found.fell} of {arguments.episodes}")
    for rival, rows in found.ratios.items():
        print(f"over {rival}:")
        for name, row in rows.items():
            print(f"  {name}: {text(row, '.3f')}")
    if arguments.card:
        seeds = {"evaluation": f"{arguments.seed}...{arguments.seed + arguments.episodes - 1}"}
        with_figures(bundle, found.table(), seeds).save(path)
        print(f"written to the card of {path}")


def text(row: Interval, form: str) -> str:
    """Return an interval in words."""
    return f"{row.mean:{form}} (95 % of {row.low:{form}} to {row.high:{form}}), median {row.median:{form}}"


if __name__ == "__main__":
    main()
