"""How `drive-tune auto --by` finds gains: the methods, the options that each has, and what each does on the drives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from drive_env.programs import import_method

if TYPE_CHECKING:
    from tuning.auto.one_button import Method
    from tuning.target import Target

DESIGN, AGENT, RULE = "design", "agent", "rule"
RULE_BY_DEFAULT = "margin_55"  # it knows the resonance, and keeps standard dynamics by the model
METHODS = (DESIGN, AGENT, RULE)
# Of `MethodOptions`: how each is typed, and the methods to which it means something.
HAVE = {"rule": ("--rule", (RULE,)), "agent": ("--agent", (AGENT,)), "trials": ("--trials", (AGENT,))}

By = Annotated[
    str,
    typer.Option(
        "--by",
        help="How gains are found: design (on digital twins), agent (a trained agent's trials) or rule (a tuning "
        "rule's, from the identified axis).",
    ),
]


@dataclass(frozen=True, kw_only=True)
class MethodOptions:
    """The options that only some methods have; one that is not given has its default here."""

    rule: Annotated[
        str | None, typer.Option("--rule", help="With --by rule: the rule by name.", show_default="margin_55")
    ] = None
    agent: Annotated[
        str | None,
        typer.Option(
            "--agent",
            help="With --by agent: one that ships, by name, or a file (.npz).",
            show_default="gain_tuning",
        ),
    ] = None
    trials: Annotated[
        int | None,
        typer.Option("--trials", help="With --by agent: number of trials.", show_default="the agent's own, 10"),
    ] = None

    def check(self, by: str) -> None:
        """Raise ValueError for a method that does not exist, or an option that the method does not have."""
        if by not in METHODS:
            raise ValueError(f"no method is named {by!r}; there are {', '.join(METHODS)}")
        for f in fields(self):
            option, have = HAVE[f.name]
            if getattr(self, f.name) != f.default and by not in have:
                raise ValueError(
                    f"{option} has no meaning with --by {by}; leave it out, or choose --by {' or '.join(have)}"
                )


class OpenedMethod(NamedTuple):
    """A method that is known to suit the device.

    plan: What it does with the drives, for a dry run.
    budget: Longest drive time for each axis [s]; infinite where the number of trials says how long it takes.
    method: Return how a run finds gains on drives.
    """

    plan: str
    budget: float
    method: Callable[[Target], Method]


def open_method(
    by: str, options: MethodOptions, device: str, dynamics: str | None, load: str | None, tell: Callable[[str], None]
) -> OpenedMethod:
    """Return the method of `--by`; no drive is opened yet.

    Args:
        by: One of `METHODS`.
        options: Its own.
        device: Name of the device, or its path.
        dynamics: What the loops must keep, as the user named it.
        load: Name of an emulated machine's load; None on a bus.
        tell: Called with a line for the user, as it goes on.

    Raises:
        ValueError: For a rule or an agent that does not exist, or a device that the method cannot tune.
    """
    from drive_env.devices import find_device
    from drive_env.devices.gains import check_linear_model
    from tuning.auto.one_button import BUDGET, by_rule
    from tuning.auto.one_button import DESIGN as WITH_TWINS

    if by == AGENT:
        opened: OpenedMethod = import_method(AGENT).open_method(
            options.agent, device, options.trials, dynamics, load, tell
        )
        return opened
    known = find_device(device)
    if by == RULE or not known.gains.is_open_loop:
        check_linear_model(known)
    if by == RULE:
        method = by_rule(options.rule or RULE_BY_DEFAULT)
        return OpenedMethod(
            f"a trial of the gains that the {method.tuner} proposes", method.budget, lambda target: method
        )
    return OpenedMethod("trials of gains that are designed on digital twins", BUDGET, lambda target: WITH_TWINS)
