"""A trained tuner on a target: the environment's trials on given drives, chosen by a policy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.policies.policy import load_policy
from agents.shipped import TUNER, shipped
from agents.tuner.known_range import outside
from drive_env.devices import find_device
from drive_env.trials.positioning import longer_way
from mechanics.arrays import Floats, Integers, Mask

if TYPE_CHECKING:
    from agents.policies.guard import GuardedPolicy, GuardLimits
    from agents.tuner.kept_margins import KeptMargins
    from drive_env.devices import Device
    from drive_env.drives.interface import Drives
    from drive_env.envs.gain_tuning import GainTuning
    from tuning.outcome import Outcome
    from tuning.target import Target


TRIAL_SECONDS = 0.75
WIDEST = 10.4  # ln of the range of a gain
PATIENCE = 2  # windows of 25 ms for which an axis may oscillate; with the incumbent's gains it then decays or continues


class TrialShown(NamedTuple):
    """A trial of every machine of a target.

    number: 0 is the baseline rule's gains.
    gains: Raw integers, (num_axes, count) in the order of the device's gain set.
    measured: J by measured terms of the machine's worst axis, (num_machines,).
    aborted, better: Whether it was stopped; whether it became the incumbent, (num_machines,).
    faults: Names of emergencies, a tuple for each machine.
    kept: Whether the gains keep the margins by the identified plant, as far as it is known, (num_machines,).
    lowered: Whether the policy proposed higher gains, which violate them, (num_machines,).
    """

    number: int
    gains: Integers
    measured: Floats
    aborted: Mask
    better: Mask
    faults: tuple[tuple[str, ...], ...]
    kept: Mask
    lowered: Mask

    @property
    def good(self) -> Mask:
        """Return the machines whose answer these gains can be, (num_machines,)."""
        return ~self.aborted & self.kept


class Tuned(NamedTuple):
    """The result: final gains, raw (num_axes, count), all trials, and the number of each machine's final trial.

    The final trial is the one that the policy chooses (`answer`), if it was not stopped and its gains keep the margins;
    otherwise the best such trial by measured terms; without any such trial it is trial 0, the baseline rule's.
    overruled: Machines that got other gains than the policy chose.
    """

    gains: Integers
    trials: tuple[TrialShown, ...]
    answers: Integers
    overruled: Mask

    @property
    def moves(self) -> int:
        """Number of moves of each axis."""
        from tuning.search.trial_bench import MOVES_OF_IDENTIFICATION, MOVES_OF_TRIAL

        return MOVES_OF_IDENTIFICATION + MOVES_OF_TRIAL * len(self.trials)


def tune_target(
    target: Target,
    policy: Any,
    *,
    show: Callable[[TrialShown], None] = lambda trial: None,
    trials: int | None = None,
    calm: Integers | None = None,
    margins: KeptMargins | None = None,
) -> Tuned:
    """Tune a target with a policy for GainTuning; the drives have the answer's gains and are disabled afterwards.

    Args:
        target: The drives; they may have any gains, also none.
        policy: The policy that proposes gains, with its `bundle` for the configuration.
        show: Called after every trial.
        trials: Number of trials; None for the agent's own number.
        calm: Gains for an axis that oscillates even after its trial was stopped, (num_axes, count), since the
            incumbent's may be close to instability, too. None: those of the data sheet.
        margins: Margins for all gains: a proposal that violates them is lowered before it is tried. None: no margins
            are known.

    Raises:
        ValueError: If the drive lacks a gain that the policy changes, or a rule for it.
        PolicyStoppedError: If the policy returns non-finite numbers, or no answer within the envelope's limit for a
            stall (on emulated drives within `guard.PATIENT.stall`): the drives are at rest and disabled.
        RuntimeError: If a drive cannot be cleared any more.
    """
    from agents.policies.guard import GuardedPolicy, stopping
    from drive_env import motion
    from drive_env.drives.observed import ObservedDrives
    from drive_env.drives.raw_gains import write_gains
    from tuning.fallback_gains import FallbackGains
    from tuning.search.trial_bench import first_gains

    fallback = FallbackGains(target.num_axes, target.motor.rated_current, windows=PATIENCE)
    fallback.calm = first_gains(target) if calm is None else calm
    drives = ObservedDrives(target.drives, fallback)
    env = _environment(target, drives, policy.bundle.configuration, trials)
    space: Any = env.single_action_space
    watched = GuardedPolicy(policy, space.low, space.high, TRIAL_SECONDS, _limits_of(drives))
    try:
        watched.warm_up(np.zeros(env.observation_space.shape or (), np.float32))
        with stopping(drives):
            share = _step_of(policy.bundle.configuration) / WIDEST
            shown, observation = _make_trials(env, watched, show, margins, share)
            answer = watched.answer(observation)
            wanted = None if answer is None else _flat(env.gains_of(share * answer))
            axes = target.axes_per_machine
            answers = np.array([_answer(shown, machine, axes, wanted) for machine in range(env.num_envs)])
            gains = np.stack([shown[answers[axis // axes]].gains[axis] for axis in range(target.num_axes)])
            motion.disable(drives)
            write_gains(drives, gains)
    finally:
        watched.close()
        env.close()
    same = np.ones(target.num_axes, bool) if wanted is None else np.all(wanted == gains, axis=1)
    overruled = np.logical_not(same.reshape(-1, axes).all(axis=1))
    return Tuned(gains, tuple(shown), answers, overruled)


def _environment(target: Target, drives: Drives, trained: Mapping[str, Any], trials: int | None) -> GainTuning:
    """Return the environment of a tuner's training, on a target's drives, which get the rule's gains.

    Args:
        target: The target.
        drives: Its drives, watched.
        trained: The agent's configuration.
        trials: Number of trials; None for the agent's own.
    """
    from drive_env.drives.raw_gains import write_gains
    from drive_env.envs.gain_tuning import GainTuning
    from tuning.search.trial_bench import first_gains

    configuration = dict(trained) | ({} if trials is None else {"trials": trials})
    configuration["gains"] = gains_for(trained, target.device)
    configuration["step"] = WIDEST  # lowered gains may be farther from the incumbent than a policy's steps
    write_gains(drives, first_gains(target))  # before anything is enabled: the drives may have any
    return GainTuning(
        target.num_axes // target.axes_per_machine,
        drives=drives,
        reach=longer_way(target.low, target.high),
        device=target.device.name,
        motor=target.motor,
        **{name: value for name, value in configuration.items() if name not in NOT_OF_DRIVES},
    )


def _make_trials(
    env: GainTuning,
    policy: GuardedPolicy,
    show: Callable[[TrialShown], None],
    margins: KeptMargins | None,
    share: float,
) -> tuple[list[TrialShown], Floats]:
    """Return all trials of an episode, the baseline rule's first, and the policy's observation at its end.

    Args:
        env: The environment.
        policy: The policy that proposes gains.
        show: Called after every trial.
        margins: Margins for all gains, or None.
        share: The step of the policy's training over that of the environment.

    Raises:
        RuntimeError: If a drive cannot be cleared any more.
    """
    observation, info = env.reset(seed=0)
    policy.reset()
    rule, machines = _flat(info["gains"]), env.num_envs

    def of_machines(axes: Mask) -> Mask:
        return np.asarray(axes.reshape(machines, -1).all(axis=1))

    kept = np.ones(machines, bool) if margins is None else of_machines(margins.kept(rule))
    shown = [TrialShown(0, rule, info["measured"], info["aborted"], ~info["aborted"], tuple(info["faults"]), kept,
                        np.zeros(machines, bool))]  # fmt: skip
    show(shown[-1])
    known = find_device(env.config.device).gains
    for number in range(1, env.config.trials + 1):
        action = share * np.clip(policy.act(observation), -1.0, 1.0)
        proposed = _flat(env.gains_of(action))
        if margins is not None:
            change = known.change(margins.lowered(proposed), _flat(info["gains"]), known.columns(env.config.chosen))
            action = change.reshape(machines, -1) / WIDEST
        before = info["measured"]
        observation, _, terminated, _, info = env.step(action)
        tried = _flat(info["trial_gains"])
        shown.append(
            TrialShown(
                number,
                tried,
                info["trial_measured"],
                info["aborted"],
                info["measured"] < before,
                tuple(info["faults"]),
                np.ones(machines, bool) if margins is None else of_machines(margins.kept(tried)),
                ~of_machines((proposed == tried).all(axis=1)),
            )
        )
        show(shown[-1])
        if terminated.all():
            names = ", ".join(shown[-1].faults[0]) or "it stays disabled"
            raise RuntimeError(f"the drive's fault cannot be reset after trial {number}: {names}")
    return shown, observation


def _step_of(trained: Mapping[str, Any]) -> float:
    """Return an agent's longest step from the incumbent in a trial."""
    from drive_env.envs.gain_tuning import GainTuningConfig

    return float(trained.get("step", GainTuningConfig.step))


def gains_for(configuration: Mapping[str, Any], device: Device) -> tuple[str, ...]:
    """Return a device's names of the gains that an agent changes.

    An agent sees and changes gains relative to those of the baseline rule: names and scales are irrelevant, only the
    gains' functions in the cascade count.

    Raises:
        ValueError: If the device lacks such a gain, or names no cascade, and there is no rule for it.
    """
    from drive_env.devices.gains import per_chip
    from drive_env.envs.gain_tuning import GainTuningConfig

    trained = GainTuningConfig(**{name: configuration[name] for name in ("device", "gains") if name in configuration})
    theirs = find_device(trained.device).gains
    parts = [theirs.rows[k] for k in theirs.columns(trained.chosen)]
    columns = [device.gains.column(gain.loop, gain.part) for gain in parts]
    missing = [f"no {gain.part} of the {gain.loop} loop" for gain, k in zip(parts, columns, strict=True) if k is None]
    if missing:
        raise ValueError(
            f"{device.name} has {', '.join(missing)} among its gains, which the agent changes; train an agent for it "
            "(drive-agent train gain-tuning), or use drive-tune auto --by tpe"
        )
    per_chip(device)  # without a cascade there is no rule to start from
    return tuple(device.gains.names[k] for k in columns if k is not None)


def best_good(trials: Sequence[TrialShown], machine: int) -> TrialShown | None:
    """Return a machine's best trial by measured terms among possible answers, or None."""
    good = [trial for trial in trials if trial.good[machine]]
    return min(good, key=lambda trial: float(trial.measured[machine]), default=None)


def _answer(trials: Sequence[TrialShown], machine: int, axes: int, wanted: Integers | None) -> int:
    """Return the number of the trial with a machine's final gains."""
    own = slice(machine * axes, (machine + 1) * axes)
    if wanted is not None:
        for trial in trials:
            if np.array_equal(trial.gains[own], wanted[own]) and trial.good[machine]:
                return trial.number
    best = best_good(trials, machine)
    return 0 if best is None else best.number


# Options of the environment for random machines, or defined by the target.
NOT_OF_DRIVES = ("distributions", "privileged", "stage", "load", "motor", "device", "travel", "friction", "num_threads")


def surrogate(target: Target, rng: np.random.Generator) -> Outcome:
    """Tune a target with the shipped agent, as a tuner of `drive-tune rank` (entry point `drive_env.tuners`)."""
    from tuning.outcome import Outcome
    from tuning.target import timed

    with timed(target) as (watched, clock):
        policy = load_policy(shipped(TUNER))
        found = tune_target(watched, policy)
    lanes = target.axes_per_machine
    aborts = np.sum([trial.aborted for trial in found.trials], axis=0)
    zero = np.zeros(target.num_axes, np.int64)
    return Outcome(
        found.gains,
        np.full(target.num_axes, clock.seconds),
        zero + found.moves,
        np.repeat(aborts, lanes),
        zero,
        ("; ".join(outside(policy.bundle, target, target.machine)),) * target.num_axes,
    )


def _limits_of(drives: Drives) -> GuardLimits:
    """Return a policy's limits: it may stay at an end of its range, and compute for a long time at standstill."""
    from agents.policies.guard import PATIENT, GuardLimits

    envelope = drives.safety
    return PATIENT if envelope is None else GuardLimits(saturation=None, stall=envelope.limits.stall)


def _flat(gains: NDArray[Any]) -> Integers:
    return np.asarray(gains, np.int64).reshape(-1, gains.shape[-1])
