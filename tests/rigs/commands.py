"""Commands of drive-tune, run in this process."""

from __future__ import annotations

from typer.testing import CliRunner

from tuning.commands.cli import app


def drive_tune(*arguments):
    """Run a command on a wide terminal; a mistake of ours is no exit code."""
    done = CliRunner(env={"COLUMNS": "200"}).invoke(app, [str(argument) for argument in arguments])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done
