"""The methods of `drive-tune auto --by`: their options, and what each does with the drives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, NamedTuple

import typer

from drive_env.programs import import_method
from tuning.commands.options import Cluster, Resume, Workers, errors_as_exit_codes

if TYPE_CHECKING:
    from tuning.auto.one_button import Method
    from tuning.target import Target

DESIGN, AGENT, RULE = "design", "agent", "rule"
SEARCH_FILES = ("trials.csv", "trials.png", "settings.toml")  # that a search writes besides
SEARCHES = ("tpe", "cmaes", "gp", "random", "grid")  # the samplers of tuning.search
METHODS = (DESIGN, AGENT, *SEARCHES, RULE)
RULE_BY_DEFAULT = "margin_55"  # it includes the resonance in its margins, and keeps standard dynamics by the model
# Options of `MethodOptions`: how each is typed if that is not its name; and its methods, by default the searches.
TYPED = {"objectives": "--objective", "gains": "--gain"}
HAVE = {"rule": (RULE,), "agent": (AGENT,), "trials": (AGENT, *SEARCHES)}  # the others are of the searches

By = Annotated[
    str,
    typer.Option(
        "--by",
        help="How gains are found: design (on digital twins), agent (a trained agent's trials), tpe, cmaes, gp, random "
        "or grid (a search by trials), or rule (a tuning rule's, from the identified axis).",
    ),
]


def _from_file(context: typer.Context, path: Path | None) -> Path | None:
    """Use settings.toml of a search, if given, as defaults of all other options."""
    if path is not None:
        with errors_as_exit_codes():
            from tuning.search.trials_files import load_options

            context.default_map = load_options(path)
    return path


@dataclass(frozen=True, kw_only=True)
class MethodOptions:
    """The options that only some methods have, with their defaults."""

    PANEL: ClassVar[str] = "How gains are found"
    rule: Annotated[
        str | None, typer.Option("--rule", help="With --by rule: the rule by name.", show_default=RULE_BY_DEFAULT)
    ] = None
    agent: Annotated[
        str | None,
        typer.Option(
            "--agent", help="With --by agent: one that ships, by name, or a file (.npz).", show_default="gain_tuning"
        ),
    ] = None
    trials: Annotated[
        int | None,
        typer.Option(
            "--trials",
            help="Trials of an agent or of a search; each takes 0.75 s of drive time.",
            show_default="the agent's own, 10; 30 of a search",
        ),
    ] = None
    config: Annotated[
        Path | None,
        typer.Option(
            "--config",
            is_eager=True,
            callback=_from_file,
            help="Search: settings.toml of an earlier one, which is repeated; other options replace what it says.",
        ),
    ] = None
    objectives: Annotated[
        list[str] | None,
        typer.Option(
            "--objective",
            help="Search: cost, or several of speed, robustness and current; the Pareto front of trials is then shown.",
            show_default="cost",
        ),
    ] = None
    gains: Annotated[
        list[str] | None,
        typer.Option(
            "--gain",
            help="Search: gain to search; may be given several times.",
            show_default="those of the velocity and position loop",
        ),
    ] = None
    width: Annotated[
        float | None,
        typer.Option(
            "--width",
            help="Search: it covers the rule's gains divided by e^WIDTH to multiplied by e^WIDTH.",
            show_default="ln 6",
        ),
    ] = None
    safe: Annotated[
        bool | None,
        typer.Option(
            "--safe/--bold",
            help="Search: start from slow gains, and go on in small steps from gains that were tried without "
            "oscillation.",
            show_default="safe on a bus",
        ),
    ] = None
    searches: Annotated[
        int,
        typer.Option(
            "--searches", help="Search of an emulated machine: how many, each with its own seed; the best is taken."
        ),
    ] = 1
    workers: Workers = None
    cluster: Cluster = None
    resume: Resume = False
    journal: Annotated[
        Path | None,
        typer.Option(
            "--journal", help="Search: journal file of Optuna, which keeps it and from which it can be continued."
        ),
    ] = None

    def check(self, by: str) -> None:
        """Raise ValueError for an unknown method, or an option that the method does not have."""
        if by not in METHODS:
            raise ValueError(f"no method is named {by!r}; there are {', '.join(METHODS)}")
        for f in fields(self):
            have = HAVE.get(f.name, SEARCHES)
            if getattr(self, f.name) != f.default and by not in have:
                option = TYPED.get(f.name, f"--{f.name}")
                raise ValueError(
                    f"{option} has no meaning with --by {by}; leave it out, or choose --by {' or '.join(have)}"
                )


class OpenedMethod(NamedTuple):
    """A method that fits the device.

    plan: What it does with the drives, for a dry run.
    budget: Greatest drive time for each axis [s]; infinite if the number of trials limits it.
    method: Returns, for opened drives, how a run finds gains.
    files: What it writes besides those of every run.
    """

    plan: str
    budget: float
    method: Callable[[Target], Method]
    files: tuple[str, ...] = ()


def open_method(
    by: str, options: MethodOptions, device: str, dynamics: str | None, load: str | None, tell: Callable[[str], None]
) -> OpenedMethod:
    """Return the method of `--by`, except a search; no drive is opened yet.

    Args:
        by: One of `METHODS`.
        options: The options of methods.
        device: Name or path of the device.
        dynamics: Dynamics as the user gave them; None for standard ones.
        load: Name of an emulated machine's load; None on a bus.
        tell: Called with each progress line for the user.

    Raises:
        ValueError: For an unknown rule or agent, or a device that the method cannot tune.
    """
    from drive_env.devices import find_device
    from tuning.auto.one_button import BUDGET, by_rule
    from tuning.auto.one_button import DESIGN as WITH_TWINS
    from tuning.identify.working_state import check_identifiable

    if by == AGENT:
        opened: OpenedMethod = import_method(AGENT).open_method(
            options.agent, device, options.trials, dynamics, load, tell
        )
        return opened
    known = find_device(device)
    if by == RULE or not known.gains.is_open_loop:
        check_identifiable(known)
    if by == RULE:
        ruled = by_rule(options.rule or RULE_BY_DEFAULT)
        return OpenedMethod(f"a trial of the gains that the {ruled.tuner} proposes", ruled.budget, lambda target: ruled)
    return OpenedMethod("trials of gains that are designed on digital twins", BUDGET, lambda target: WITH_TWINS)
