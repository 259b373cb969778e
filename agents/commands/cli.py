"""The command `drive-agent`: it assembles the commands of this folder, one file per command."""

from __future__ import annotations

import importlib

from drive_env.commands.program import Program, Quiet, Verbose, Version, say_as_much

app = Program("drive-agent")

PANELS = {"Use an agent": ("evaluate", "margins", "export"), "Make one": ("train", "search", "benchmark")}
for panel, names in PANELS.items():
    for name in names:
        module = importlib.import_module(f"agents.commands.{name}")
        app.command(name, rich_help_panel=panel)(getattr(module, name))
app.moved({"tune": "drive-tune auto --by agent"})


@app.callback()
def drive_agent(version: Version = False, quiet: Quiet = False, verbose: Verbose = False) -> None:
    """Train and evaluate agents for servo drives, and use them: on emulated drives, and on real ones over CAN.

    Exit codes: 0 done, 1 stopped by the drive, the bus or the agent's limits, 2 a mistake in the command, 130 Ctrl-C,
        141 the output was closed.
    """
    say_as_much(quiet, verbose)


main = app.run


if __name__ == "__main__":
    main()
