"""Evaluate a policy in episodes, on emulated machines or on a bus: score, interval, violations.

On emulated machines many environments run at the same time, each with its own machine. On a bus (or `as_on_a_bus`,
which hides the machine so that the environment acts as it would there) their number is that of the drives.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from agents.evaluation.scores import Episode, Interval, figures, interval
from agents.plain import plain
from agents.policies.guard import LIMITS, PATIENT, GuardedPolicy, GuardLimits, come_to_rest, stopping, unchanged
from agents.seeds import EVALUATION
from agents.tasks import configuration_of, environment_name, make_environments, row_of, without_machines
from agents.tuner.tune_target import TRIAL_SECONDS
from drive_env.drives.interface import Drives, Observer
from drive_env.drives.observed import ObservedDrives
from drive_env.envs import environment_of
from drive_env.realtime_section import undisturbed
from drive_env.whole_file import write_whole
from mechanics.reading.untrusted import read_json
from tuning.runs.inputs import as_kept, found_again, hashes, inputs_in

LANES = 64
TOLD = 0.5  # s between two updates of a progress bar, which take a millisecond
STEP_SECONDS: dict[str, Callable[[Any], float]] = {"ServoDrive/Tracking-v0": lambda config: 1.0 / config.rate,
                "ServoDrive/GainScheduling-v0": lambda config: config.step,
                "ServoDrive/GainTuning-v0": lambda config: TRIAL_SECONDS}  # fmt: skip
TRIAL_OF = {
    "gains": "trial_gains",
    "measured": "trial_measured",
    "robust_cost": "trial_robust_cost",
}  # of incumbent, of trial
FIXED_STEPS = ("ServoDrive/Tracking-v0", "ServoDrive/GainScheduling-v0")  # fault resets lengthen a trial


@dataclass
class Evaluation:
    """The results of episodes.

    Attributes:
        policy: Its name.
        environment: Name of the environment.
        configuration: Its options.
        side: "emulator", "emulator as on a bus", or the bus.
        seeds: Seeds of the episodes.
        values: Figure -> value of each episode.
        lower_is_better: Figure -> direction.
        violations: Cause of an early end -> number of episodes.
        pace: Time of the steps over their nominal time; 1 in lockstep, or if steps have no fixed time.
        late: Share of the SYNCs within a step that were more than a cycle late; 0 in lockstep.
        episodes: The recorded episodes; not saved with the report.
    """

    policy: str
    environment: str
    configuration: dict[str, Any]
    side: str
    seeds: list[int]
    values: dict[str, list[float]]
    lower_is_better: dict[str, bool]
    violations: dict[str, int]
    pace: float = 1.0
    late: float = 0.0
    episodes: list[Episode] = field(default_factory=list, repr=False)

    @property
    def score(self) -> str:
        """Name of the figure that is the score."""
        return next(iter(self.values))

    def interval(self, name: str) -> Interval:
        """Return mean, 95 % interval and median of a figure."""
        return interval(self.values[name])

    def save(self, path: str | Path) -> Path:
        """Write the report as JSON."""
        path = Path(path)
        table = {key: value for key, value in vars(self).items() if key != "episodes"}
        if inputs := inputs_in(self.configuration):
            table["inputs"] = hashes(inputs)
        table["intervals"] = {name: self.interval(name)._asdict() for name in self.values}
        write_whole(path, json.dumps(plain(as_kept(table)), indent=1))
        return path

    @classmethod
    def load(cls, path: str | Path) -> Evaluation:
        """Read a report.

        Raises:
            ValueError: If the file is not a report.
        """
        try:
            table = read_json(path)
            table.pop("intervals")
            inputs = table.pop("inputs", None)
            table["configuration"] = found_again(table["configuration"], inputs, Path(path).parent, alone=True)
            table["values"] = {name: [float(one) for one in values] for name, values in table["values"].items()}
            return cls(**table)
        except OSError as error:
            raise ValueError(f"{path} cannot be read: {error.strerror}") from None
        except (ValueError, KeyError, TypeError, AttributeError):
            raise ValueError(f"{path} is not a report of `drive-agent evaluate`; give its report.json") from None


class _NoMachine(Observer):
    """Makes drives hide their emulated machine from their user."""

    hides_machine = True


def as_on_a_bus(drives: Drives) -> Drives:
    """Return emulated drives without their machine, so that environments act as on a bus."""
    return ObservedDrives(drives, _NoMachine())


@dataclass(frozen=True)
class GivenDrives:
    """Drives for a policy, instead of the environment's own emulated machines.

    Attributes:
        drives: The drives; their gains, offsets and mode are restored after an evaluation.
        sensor: As for `Tracking`.
        guard: Limits of the policy; those of guard.LIMITS by default.
        side: Name of the drives in the report.
    """

    drives: Drives
    sensor: Any = None
    guard: GuardLimits | None = None
    side: str = "bus"


def evaluate(
    policy: Any,
    environment: str,
    configuration: Mapping[str, Any] | None = None,
    *,
    name: str = "policy",
    episodes: int = 64,
    seed: int = EVALUATION[0],
    on: GivenDrives | None = None,
    told: Callable[[float], None] = lambda share: None,
    at_once: int | None = None,
) -> Evaluation:
    """Run episodes and return the results.

    Args:
        policy: The policy: `act(observations)`, shape (environments, entries), and `reset(mask)`.
        environment: Name of the environment.
        configuration: Its options.
        name: Name of the policy, for the report.
        episodes: Number of episodes, with the seeds `seed`, `seed` + 1, ...
        seed: Seed of the first one.
        on: Drives to act on; None: the environment's own emulated machines.
        told: Called with the finished share.
        at_once: Parallel episodes on emulated machines; None: those of `environments_for`.

    Raises:
        PolicyStoppedError: If the guard stopped the policy; given drives are then at rest and disabled.
        ValueError: For an invalid configuration.
    """
    environment = environment_name(environment)
    options = dict(configuration or {})
    if on is None:
        count, how = at_once or environments_for(episodes), {"autoreset_mode": "NextStep"}
    else:
        options = without_machines(environment, options)
        count, how = _num_envs_of(environment, on.drives, options), _how_to_act_on(on)
    with ExitStack() as care:
        if on is not None:
            care.enter_context(unchanged(on.drives))
            care.enter_context(stopping(on.drives))
        lanes: Any = make_environments(environment, count, options, **how)
        if on is not None and not on.drives.time_waits:
            care.enter_context(undisturbed())
        try:
            watched = _guarded(policy, lanes, environment, on)
            care.callback(watched.close)
            if on is not None:
                watched.warm_up(np.zeros(lanes.observation_space.shape, np.float32))
            seeds = range(seed, seed + episodes)
            recorded, pace = _all_rounds(watched, lanes, environment, seeds, all_end=on is not None, told=told)
            if on is not None:
                come_to_rest(on.drives)
            config = lanes.config
            found = configuration_of(lanes)
        finally:
            lanes.close()
    evaluation = summary(recorded, config, found, environment, name, "emulator" if on is None else on.side)
    if on is not None and not on.drives.time_waits and on.drives.bus is not None:
        timing = on.drives.bus.total_timing
        evaluation.late = timing.late / max(timing.cycles, 1)
        evaluation.pace = pace if environment_of(environment) in FIXED_STEPS else 1.0
    return evaluation


def _how_to_act_on(on: GivenDrives) -> dict[str, Any]:
    """Return the options of environments on given drives."""
    how = {"drives": on.drives, "autoreset_mode": "Disabled"}
    return how if on.sensor is None else how | {"sensor": on.sensor}


def _guarded(policy: Any, lanes: Any, environment: str, on: GivenDrives | None) -> GuardedPolicy:
    """Return the policy in a guard, with the limits for given drives or, on emulated machines, with very wide ones."""
    limits = PATIENT if on is None else on.guard or LIMITS[environment_of(environment)]
    space = lanes.single_action_space
    return GuardedPolicy(policy, space.low, space.high, STEP_SECONDS[environment_of(environment)](lanes.config), limits)


def _all_rounds(
    policy: Any, lanes: Any, environment: str, seeds: range, all_end: bool, told: Callable[[float], None]
) -> tuple[list[Episode], float]:
    """Return an episode of every seed, run in parallel in all environments, and the steps' time over its nominal one.

    Args:
        policy: The policy.
        lanes: The environments.
        environment: Their name.
        seeds: Seeds of the episodes.
        all_end: As for `_episodes`.
        told: Called with the finished share.
    """
    step, steps = STEP_SECONDS[environment_of(environment)](lanes.config), row_of(environment).steps(lanes.config)
    recorded: list[Episode] = []
    spent, due = 0.0, 0.0
    for first in range(0, len(seeds), lanes.num_envs):
        wanted = min(lanes.num_envs, len(seeds) - first)

        def tell(done: int, first: int = first, wanted: int = wanted) -> None:
            told((first + wanted * min(done / steps, 1.0)) / len(seeds))

        own = [seeds.start + first + lane for lane in range(lanes.num_envs)]  # the last round may go beyond `seeds`
        found, seconds = _episodes(policy, lanes, own, all_end=all_end, told=tell)
        recorded += found[:wanted]
        spent += seconds
        due += step * max(len(episode.rewards) for episode in found)
    return recorded, spent / due if recorded else 1.0


def environments_for(episodes: int) -> int:
    """Return the number of parallel episodes on emulated machines, for a number of episodes."""
    return min(episodes, LANES)


def joined(parts: Sequence[Evaluation]) -> Evaluation:
    """Join evaluations of one policy on one side."""
    first = parts[0]
    names = [name for name in first.values if all(name in part.values for part in parts)]
    violations: dict[str, int] = {}
    for part in parts:
        for what, count in part.violations.items():
            violations[what] = violations.get(what, 0) + count
    return replace(
        first,
        seeds=[seed for part in parts for seed in part.seeds],
        values={name: [value for part in parts for value in part.values[name]] for name in names},
        lower_is_better={name: first.lower_is_better[name] for name in names},
        violations=violations,
        pace=float(np.mean([part.pace for part in parts])),
        late=float(np.mean([part.late for part in parts])),
        episodes=[episode for part in parts for episode in part.episodes],
    )


def summary(
    episodes: Sequence[Episode], config: Any, configuration: dict[str, Any], environment: str, policy: str, side: str
) -> Evaluation:
    """Return the results of recorded episodes."""
    rows = figures(environment, config)
    values = {row.name: [row.compute(episode, config) for episode in episodes] for row in rows}
    values = {name: found for name, found in values.items() if np.isfinite(found).any()}
    violations: dict[str, int] = {}
    for episode in episodes:
        if episode.terminated:
            what = episode.fault or "ended early"
            violations[what] = violations.get(what, 0) + 1
    better = {row.name: row.lower_is_better for row in rows if row.name in values}
    seeds = [episode.seed for episode in episodes]
    return Evaluation(
        policy, environment, configuration, side, seeds, values, better, violations, episodes=list(episodes)
    )


def _episodes(
    policy: Any, lanes: Any, seeds: Sequence[int], all_end: bool, told: Callable[[int], None]
) -> tuple[list[Episode], float]:
    """Return an episode of every environment, and the time that its steps took [s].

    Args:
        policy: The policy.
        lanes: The environments.
        seeds: One for each environment.
        all_end: Whether all episodes end with the first that does, since a reset would move the other drives.
        told: Called with the number of finished steps, at most every TOLD.
    """
    count = lanes.num_envs
    observation, begun = lanes.reset(seed=list(seeds))
    policy.reset(None)
    policy.told(begun.get("parameters"), np.ones(count, bool))
    first = [_of_environment(begun, lane) for lane in range(count)]
    rows: list[Any] = [_seen(observation)]
    actions: list[Any] = []
    rewards: list[Any] = []
    terms: dict[str, list[Any]] = {}
    lengths = np.zeros(count, np.int64)
    fell = np.zeros(count, bool)
    faults: list[str] = [""] * count
    last: list[dict[str, Any]] = [{} for _ in range(count)]
    open_ = np.ones(count, bool)
    trials = [{name: begun[name] for name in TRIAL_OF if name in begun}]  # the first one is of the initial gains
    start = last_told = time.perf_counter()
    while open_.any():
        action = policy.act(rows[-1])
        observation, reward, terminated, truncated, info = _stepped(policy, lanes, action, open_)
        rows.append(_seen(observation))
        actions.append(np.array(action, np.float32).reshape(count, -1))
        rewards.append(reward)
        for name, value in info.get("reward_terms", {}).items():
            terms.setdefault(name, []).append(np.array(value, float))
        trials.append({name: info[own] for name, own in TRIAL_OF.items() if own in info})
        lengths += open_
        ended = open_ & (terminated | truncated)
        for lane in map(int, np.flatnonzero(ended)):
            fell[lane] = terminated[lane]
            last[lane] = _of_environment(info, lane)
            faults[lane] = str(last[lane].get("fault", "") or "")
        open_ &= ~ended
        if (now := time.perf_counter()) - last_told > TOLD:
            last_told = now
            told(len(rewards))
        if all_end and ended.any():
            for lane in map(int, np.flatnonzero(open_)):
                last[lane] = _of_environment(info, lane)
            break
    seconds = time.perf_counter() - start
    if "trial_gains" in info and (answer := policy.answer(rows[-1])) is not None:
        _stay_with(lanes.gains_of(answer), trials, last)
    episodes = [
        Episode(
            seeds[lane],
            np.stack([row[lane] for row in rows[: lengths[lane] + 1]]),
            np.stack([row[lane] for row in actions[: lengths[lane]]]),
            np.array([row[lane] for row in rewards[: lengths[lane]]], float),
            {name: np.array([row[lane] for row in values[: lengths[lane]]]) for name, values in terms.items()},
            bool(fell[lane]),
            faults[lane],
            first[lane],
            last[lane],
        )
        for lane in range(count)
    ]
    return episodes, seconds


def _stepped(policy: Any, lanes: Any, action: Any, open_: Any) -> Any:
    """Make a step; a policy that knows its machines is notified of those whose payload changes within an episode."""
    found = lanes.step(action)
    if hasattr(lanes.config, "payload"):
        policy.told(found[4].get("parameters"), open_)
    return found


def _stay_with(gains: Any, trials: Sequence[Mapping[str, Any]], last: Sequence[dict[str, Any]]) -> None:
    """Replace the incumbents at the end of episodes by a tuner's own answers, which are gains that it tried.

    Args:
        gains: The answers, (environments, axes, count).
        trials: The info of every trial of all environments, by the names of TRIAL_OF.
        last: The info of each environment's last step; changed.
    """
    for lane, told in enumerate(last):
        for trial in trials:
            if np.array_equal(trial["gains"][lane], gains[lane]):
                told.update({name: values[lane] for name, values in trial.items()})
                break
        else:
            raise ValueError(f"the tuner answered gains that it had not tried: {gains[lane].tolist()}")


def _seen(observation: Any) -> Any:
    """Return a copy of the policy's part of an observation: for a dict its entry `observation`."""
    return np.array(observation["observation"] if isinstance(observation, dict) else observation)


def _of_environment(info: Mapping[str, Any], lane: int) -> dict[str, Any]:
    found = {}
    for key, value in info.items():
        if key.startswith("_") or isinstance(value, Mapping) or np.ndim(value) < 1:
            continue
        found[key] = value[lane]
    return found


def _num_envs_of(environment: str, drives: Drives, options: Mapping[str, Any]) -> int:
    """Return the number of environments for given drives: each has the axes of the load."""
    from mechanics.loads import find_load

    load = options.get("load")
    if load is None:
        import importlib

        task = row_of(environment)
        module = importlib.import_module(f"drive_env.envs.{task.short}")
        load = getattr(module, f"{task.kind}Config")().load
    axes = find_load(load).num_axes
    if drives.num_axes % axes:
        raise ValueError(f"the load {load!r} has {axes} axes and {drives.num_axes} drives were given; name all --node")
    return int(drives.num_axes // axes)
