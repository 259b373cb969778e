"""What the three programs have before their commands: the version, and how much is said besides results."""

from __future__ import annotations

import logging
import warnings
from typing import Annotated

import typer

from drive_env import __version__
from drive_env.commands.compile_bar import show_compiling

PACKAGES = ("mechanics", "drive_env", "tuning", "agents")


def _tell_version(context: typer.Context, asked: bool) -> None:
    if asked:
        print(f"{context.find_root().info_name} {__version__}")
        raise typer.Exit


Version = Annotated[
    bool, typer.Option("--version", callback=_tell_version, is_eager=True, help="Print the version and stop.")
]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print results and errors only: no progress, no warnings.")]
Verbose = Annotated[bool, typer.Option("--verbose", help="Print more about what is done.")]


def say_as_much(quiet: bool, verbose: bool) -> None:
    """Let warnings and the log of our packages through, or not.

    Raises:
        typer.BadParameter: For both.
    """
    if quiet and verbose:
        raise typer.BadParameter("--quiet and --verbose exclude each other")
    if quiet:
        warnings.simplefilter("ignore")
        logging.disable(logging.WARNING)
    else:  # a program that is silent for half a minute seems to hang
        show_compiling()
    if verbose:
        logging.basicConfig(format="%(message)s")
        for name in PACKAGES:
            logging.getLogger(name).setLevel(logging.INFO)
