"""The command `drive-agent`: it assembles the commands of this folder, one file per command."""

from __future__ import annotations

import importlib

import typer

from agents.commands.options import interrupted
from drive_env.commands.program import CONTEXT, Quiet, Verbose, Version, say_as_much

app = typer.Typer(
    name="drive-agent",
    no_args_is_help=True,
    rich_markup_mode="markdown",  # in "rich", units in brackets would be taken for markup
    pretty_exceptions_enable=False,
    context_settings=CONTEXT,
)

PANELS = {
    "Use an agent": ("tune", "evaluate", "margins", "export"),
    "Make one": ("train", "search", "benchmark"),
}
for panel, names in PANELS.items():
    for name in names:
        module = importlib.import_module(f"agents.commands.{name}")
        app.command(name, rich_help_panel=panel)(getattr(module, name))


@app.callback()
def drive_agent(version: Version = False, quiet: Quiet = False, verbose: Verbose = False) -> None:
    """Train and evaluate agents for servo drives, and use them: on emulated drives, and on real ones over CAN.

    Exit codes: 0 done, 1 stopped by the drive, the bus or the agent's limits, 2 a mistake in the command, 130 Ctrl-C,
        141 the output was closed.
    """
    say_as_much(quiet, verbose)


def main() -> None:
    """Run the command; Ctrl-C ends it with 130."""
    try:
        app()
    except KeyboardInterrupt:
        interrupted()


if __name__ == "__main__":
    main()
