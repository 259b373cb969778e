"""The command `drive-tune`: registers the commands of this folder."""

from __future__ import annotations

from drive_env.commands.program import Program, Quiet, Verbose, Version, say_as_much
from tuning.commands.auto import auto
from tuning.commands.commission import commission
from tuning.commands.identify import identify
from tuning.commands.rank import rank
from tuning.commands.response import response
from tuning.commands.rules import rules
from tuning.commands.sweep import sweep
from tuning.commands.undo import undo
from tuning.commands.verify import verify

app = Program("drive-tune", "interrupted; nothing was written")

PANELS = {
    "A drive, emulated or on a bus": (commission, identify, response, rules, auto),
    "Many emulated machines": (sweep, rank),
    "What a change leaves": (verify, undo),
}
for panel, commands in PANELS.items():
    for command in commands:
        app.command(rich_help_panel=panel)(command)
app.moved({"optimise": "drive-tune auto --by tpe"})


@app.callback()
def drive_tune(version: Version = False, quiet: Quiet = False, verbose: Verbose = False) -> None:
    """Tune servo drives: emulated ones, and with --bus real ones, inside the safety envelope.

    Exit codes: 0 done, 1 the drive or the bus said no, 2 a mistake in the command, 130 Ctrl-C, 141
    the reader of the output has gone.
    """
    say_as_much(quiet, verbose)


main = app.run


if __name__ == "__main__":
    main()
