"""`drive-tune auto --by agent`: a trained agent tries gains on the axes, instead of auto's own design."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

from agents.shipped import TUNER
from agents.tuner.known_range import outside
from agents.tuner.open_tuner import open_tuner, remark, titles_of_trials
from agents.tuner.tuning_run import method_of
from tuning.commands.methods import OpenedMethod

if TYPE_CHECKING:
    from agents.tuner.tune_target import TrialShown
    from tuning.auto.one_button import Method
    from tuning.target import Target

J = (
    "The cost J (less is better) counts settling time, stiffness, noise and",
    "overshoot of a move, its reversal and a move with 1.5 times velocity P, which",
    "shows how near the gains are to oscillation.",
)


def open_method(
    agent: str | None,
    device: str,
    trials: int | None,
    dynamics: str | None,
    load: str | None,
    tell: Callable[[str], None],
) -> OpenedMethod:
    """Return the method of an agent, by default the shipped one; arguments and errors as in `tuning.commands.methods`.

    Args:
        agent: A name or a file; None for the shipped one.
        device: Name of the device, or its path.
        trials: Number of trials; None for the agent's own.
        dynamics: Name of the required dynamics, as the user gave it; None for the agent's own.
        load: Name of an emulated machine's load; None on a bus.
        tell: Called with each line for the user.
    """
    name = agent or TUNER
    policy = open_tuner(name, device, trials, dynamics)

    def method(target: Target) -> Method:
        doubts = outside(policy.bundle, target, load)
        for doubt in doubts:
            print(f"drive-tune: {doubt}", file=sys.stderr)
        known = target.device.gains
        outer, titles = known.columns_of("velocity", "position"), titles_of_trials(known)
        widths = [max(len(title) + 1, 11) for title in titles]

        def say(what: str) -> None:
            for line in J:
                tell(line)
            tell(f"trial{''.join(f' {title:>{w}}' for title, w in zip(titles, widths, strict=True))} {'J':>8}")

        def show(trial: TrialShown) -> None:
            figures = "".join(f" {value:>{w}}" for value, w in zip(trial.gains[0, outer], widths, strict=True))
            tell(f"{trial.number or 'rule':>5}{figures} {trial.measured[0]:>8.3f}  {remark(trial)}".rstrip())

        return method_of(policy, name, doubts, show, say)

    count = policy.bundle.configuration["trials"]
    return OpenedMethod(f"1 + {count} trials of gains that the agent proposes", math.inf, method)
