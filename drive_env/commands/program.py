"""Options of the three programs before their commands: the version, and how much they print besides results."""

from __future__ import annotations

import inspect
import logging
import sys
import warnings
from collections.abc import Mapping
from typing import Annotated, Any, NoReturn

import typer

from drive_env import __version__
from drive_env.commands.compile_bar import show_compiling
from drive_env.programs import INTERRUPTED, USER_ERROR

PACKAGES = ("mechanics", "drive_env", "tuning", "agents")
AGAIN = 10.0  # s after which a repeated line is printed again
OTHER_NAMES = {"position": "node"}  # second names of options: on EtherCAT a node is known by its position


def _option_named(name: str) -> str:
    """Return an option's own name, without hyphens, for any of its names."""
    return OTHER_NAMES.get(name, name)


# What is common to all commands of a program.
CONTEXT: dict[str, Any] = {"help_option_names": ["-h", "--help"], "token_normalize_func": _option_named}


class RepeatedLines(logging.Filter):
    """Suppresses a line that was printed a moment ago: a lost bus fails every frame of a stop with the same line."""

    def __init__(self) -> None:
        super().__init__()
        self._printed: dict[str, float] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a record is to be printed."""
        text, now = record.getMessage(), record.created
        self._printed = {one: at for one, at in self._printed.items() if now - at < AGAIN}
        is_new = text not in self._printed
        self._printed.setdefault(text, now)
        return is_new


def _tell_version(context: typer.Context, asked: bool) -> None:
    if asked:
        print(f"{context.find_root().info_name} {__version__}")
        raise typer.Exit


Version = Annotated[
    bool, typer.Option("--version", callback=_tell_version, is_eager=True, help="Print the version and stop.")
]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print results and errors only: no progress, no warnings.")]
Verbose = Annotated[bool, typer.Option("--verbose", help="Print more about what is done.")]


def answer_old_name(program: str, old: str, new: str) -> NoReturn:
    """End a command that was called by its old name, naming the new one."""
    print(f"{program}: `{program} {old}` is `{new}` now", file=sys.stderr)
    raise typer.Exit(USER_ERROR)


class Program(typer.Typer):
    """The application of a program: contains its commands, and `run` runs the requested one.

    Args:
        name: Name of the program.
        interrupted: Message for a command that Ctrl-C ends before it can print one itself.
    """

    def __init__(self, name: str, interrupted: str = "interrupted") -> None:
        super().__init__(
            name=name,
            no_args_is_help=True,
            rich_markup_mode="markdown",  # in "rich", units in brackets would be parsed as markup
            pretty_exceptions_enable=False,
            context_settings=CONTEXT,
        )
        self._interrupted = f"{name}: {interrupted}"

    def moved(self, names: Mapping[str, str]) -> None:
        """Answer old names of commands with the new ones, for one version; nothing is executed.

        Args:
            names: The whole new command by the old name.
        """
        settings = {"ignore_unknown_options": True, "allow_extra_args": True}
        for old, new in names.items():

            def answer(old: str = old, new: str = new) -> None:
                answer_old_name(str(self.info.name), old, new)

            answer.__signature__ = inspect.Signature()  # type: ignore[attr-defined]  # what typer reads
            self.command(old, hidden=True, add_help_option=False, context_settings=settings)(answer)

    def run(self) -> None:
        """Run the command; Ctrl-C ends it with 130."""
        try:
            self()
        except KeyboardInterrupt:
            print(self._interrupted, file=sys.stderr)
            sys.exit(INTERRUPTED)


def say_as_much(quiet: bool, verbose: bool) -> None:
    """Show or hide warnings and the log of our packages.

    Raises:
        typer.BadParameter: If both are given.
    """
    if quiet and verbose:
        raise typer.BadParameter("--quiet and --verbose exclude each other")
    if quiet:
        warnings.simplefilter("ignore")
        logging.disable(logging.WARNING)
    else:  # a program that is silent for half a minute seems to hang
        show_compiling()
    printer = logging.lastResort  # prints warnings while no handler is configured
    if printer is not None and not any(isinstance(one, RepeatedLines) for one in printer.filters):
        printer.addFilter(RepeatedLines())
    if verbose:
        logging.basicConfig(format="%(message)s")
        for name in PACKAGES:
            logging.getLogger(name).setLevel(logging.INFO)
