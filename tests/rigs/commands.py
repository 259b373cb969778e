"""Commands of drive-tune, run in this process."""

from __future__ import annotations

from typer.testing import CliRunner

from tuning.commands.cli import app


def drive_tune(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])
