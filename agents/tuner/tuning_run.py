"""A run of a trained tuner on a drive: a run of auto with the agent's trials instead of its search."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from agents.tuner.tune_target import TrialShown, best_good, tune_target

if TYPE_CHECKING:
    from tuning.auto.bench import AutoBench
    from tuning.auto.one_button import Find, Method
    from tuning.auto.stages import Basis, RecordedGains


def method_of(
    policy: Any, name: str, doubts: Sequence[str], show: Callable[[TrialShown], None], say: Callable[[str], None]
) -> Method:
    """Return the method of auto that tries a policy's gains instead of its own design.

    Args:
        policy: A policy for GainTuning; PolicyError in the run if it returns non-finite numbers.
        name: Name of the agent, for the certificate.
        doubts: Reservations of the certificate from the beginning.
        show: Called after every trial.
        say: Called before the first trial.
    """
    from tuning.auto.one_button import Method

    return Method(f"agent {name}", finder(policy, doubts, show, say), math.inf)


def finder(policy: Any, doubts: Sequence[str], show: Callable[[TrialShown], None], say: Callable[[str], None]) -> Find:
    """Return the function that finds gains in a run of auto, by a policy's trials; arguments as for `method_of`."""

    def find(bench: AutoBench, basis: Basis, _: Any) -> RecordedGains:
        for doubt in doubts:
            bench.reserve(bench.going, doubt)
        say("trials")
        return make_trials(bench, basis, policy, show)

    return find


def make_trials(bench: AutoBench, basis: Basis, policy: Any, show: Callable[[TrialShown], None]) -> RecordedGains:
    """Make the policy's trials, and return its answer; create the proving ground, and reject axes without one."""
    from dataclasses import replace

    from agents.tuner.kept_margins import KeptMargins
    from drive_env.safety.envelope import SafetyError, swinging_allowed
    from tuning.auto.bench import BY_TRIAL
    from tuning.auto.correction import proving_ground
    from tuning.auto.stages import RecordedGains

    target, going = bench.target, bench.going
    if not going.all():
        bench.stop(going, "another axis was rejected, and an agent tunes all of them or none")
        return RecordedGains.only(basis.before)
    low, high = bench.room()
    try:
        # The trials detect oscillation by themselves within 50 ms, stop, and continue.
        with bench.spending(going), swinging_allowed(target.drives):
            tuned = tune_target(
                replace(target, low=low, high=high), policy, show=show, calm=basis.calm,
                margins=KeptMargins.of(bench, basis),
            )  # fmt: skip
    except SafetyError as error:
        bench.stop(going, f"the envelope stopped the trials: {error}")
        return RecordedGains.only(basis.before)
    lanes, tried = target.axes_per_machine, RecordedGains.only(tuned.gains)
    ground = proving_ground(bench, basis)
    ground.aborts += np.repeat(np.sum([trial.aborted for trial in tuned.trials], axis=0), lanes)
    ground.moves += tuned.moves
    bench.watch_following(going)
    proof, verified = tried.proof.copy(), tried.verified.copy()
    for machine in range(target.num_axes // lanes):
        own = slice(machine * lanes, (machine + 1) * lanes)
        answer = tuned.trials[int(tuned.answers[machine])]
        if not answer.good[machine]:
            kept = any(trial.kept[machine] for trial in tuned.trials)
            why = ("every trial was stopped, the baseline rule's too" if kept else
                   f"none of the trials keeps {bench.dynamics.name} dynamics by the identified plant")  # fmt: skip
            bench.stop(np.arange(target.num_axes) // lanes == machine, why)
            continue
        if lowered := sum(bool(trial.lowered[machine]) for trial in tuned.trials):
            for journal in bench.journals[own]:
                journal.note(f"{lowered} of the agent's {len(tuned.trials) - 1} proposals broke {bench.dynamics.name} "
                             "dynamics by the identified plant, and lower gains were tried")  # fmt: skip
        proof[own], verified[own] = float(answer.measured[machine]), BY_TRIAL
        for journal in bench.journals[own]:
            journal.note(_answer(tuned.trials, answer, machine))
        if tuned.overruled[machine]:
            for journal in bench.journals[own]:
                journal.note(
                    "the agent's own choice was stopped in its trial, or breaks the dynamics by the identified plant; "
                    "the best trial that was not and does not is kept"
                )
    return replace(tried, proof=proof, verified=verified)


def _answer(trials: Sequence[TrialShown], answer: TrialShown, machine: int) -> str:
    """Return which trial the agent chooses for a machine, and why if another one measured better."""
    which = f"trial {answer.number}" if answer.number else "the baseline rule's gains"
    cost, best = float(answer.measured[machine]), best_good(trials, machine)
    if best is None or best.measured[machine] >= cost:
        return f"the agent chooses {which}, the best: J {cost:.3f}"
    return (
        f"the agent chooses {which}, J {cost:.3f}: by its estimate from all trials, the J of "
        f"{best.measured[machine]:.3f} of trial {best.number} would not be repeated"
    )
