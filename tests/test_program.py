"""What the three programs have in common: version, how much they say, completion, names that there are."""

from __future__ import annotations

import importlib.metadata
import io
import json
import logging
import os
import subprocess
import sys
import warnings

import pytest
import typer
from typer.testing import CliRunner

import agents.commands.cli
import drive_env.commands.cli
import tuning.commands.cli
from drive_env.commands import compiling
from drive_env.commands.program import Quiet, Verbose, say_as_much
from mechanics import kernel_files

APPS = {
    "drive-env": drive_env.commands.cli.app,
    "drive-tune": tuning.commands.cli.app,
    "drive-agent": agents.commands.cli.app,
}


@pytest.mark.parametrize("name", APPS)
def test_the_version_is_that_of_the_package(name):
    result = CliRunner().invoke(APPS[name], ["--version"], prog_name=name)
    assert (result.exit_code, result.stdout) == (0, f"{name} {importlib.metadata.version('drive-env')}\n")


@pytest.mark.parametrize("name", APPS)
def test_quiet_and_verbose_exclude_each_other(name):
    command = {"drive-env": "list", "drive-tune": "rules", "drive-agent": "evaluate"}[name]
    result = CliRunner().invoke(APPS[name], ["--quiet", "--verbose", command])
    assert result.exit_code == 2
    assert "--quiet and --verbose exclude each other" in result.stderr


def run(program, *arguments, **environment):
    return subprocess.run(
        [sys.executable, "-c", f"import sys; sys.argv[0] = {program!r}; from drive_env import commands as c; "
         f"c.{program.replace('-', '_')}()", *arguments],
        env=os.environ | environment, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip


@pytest.mark.parametrize(("program", "begun", "commands"), [
    ("drive-env", "sc", {"scan", "scope"}),
    ("drive-tune", "r", {"response", "rules", "rank"}),
    ("drive-agent", "ev", {"evaluate"}),
])  # fmt: skip
def test_a_shell_completes_commands(program, begun, commands):
    variable = f"_{program.replace('-', '_').upper()}_COMPLETE"
    done = run(program, **{variable: "complete_bash", "COMP_WORDS": f"{program} {begun}", "COMP_CWORD": "1"})
    assert set(done.stdout.split()) >= commands, done.stderr


@pytest.mark.parametrize(("more", "there", "absent"), [
    ((), ("tmcm1636", "qbl4208", "two_mass"), ()),
    (("motors",), ("qbl4208",), ("tmcm1636", "two_mass")),
])  # fmt: skip
def test_what_there_is_is_listed(more, there, absent):
    result = CliRunner().invoke(drive_env.commands.cli.app, ["list", *more], env={"COLUMNS": "80"})
    assert result.exit_code == 0
    names = {line.split()[0] for line in result.stdout.splitlines() if line.strip()}
    assert set(there) <= names and not set(absent) & names
    data = json.loads(CliRunner().invoke(drive_env.commands.cli.app, ["list", *more, "--json"]).stdout)
    assert {name for rows in data.values() for name in rows} >= set(there)


def test_a_kind_of_names_that_there_is_not_is_answered_with_those_that_there_are():
    result = CliRunner().invoke(drive_env.commands.cli.app, ["list", "motor"])
    assert result.exit_code == 2
    assert "there are devices, motors, loads, not 'motor'; did you mean 'motors'?" in result.stderr


def test_quiet_shows_errors_and_no_progress_bar():
    loud, quiet = (
        run("drive-tune", *more, "response", "--load", "inertia", "--out", "/dev/null/nowhere")
        for more in ((), ("--quiet",))
    )
    assert loud.returncode == quiet.returncode != 0
    assert quiet.stderr.startswith("drive-tune: ")


def test_quiet_hides_bars_and_warnings(capfd):
    from rich.console import Console

    from drive_env.commands.options import progress_on

    app = typer.Typer()

    @app.callback()
    def main(quiet: Quiet = False, verbose: Verbose = False) -> None:
        say_as_much(quiet, verbose)

    @app.command()
    def work() -> None:
        with progress_on(Console(stderr=True, force_terminal=True)) as progress:
            progress.update(progress.add_task("working", total=1.0), completed=1.0)
        logging.getLogger("drive_env").warning("something odd")

    shown = {}
    try:
        for option in ((), ("--quiet",)):
            shown[option] = CliRunner().invoke(app, [*option, "work"])
    finally:
        logging.disable(logging.NOTSET)
    assert [result.exit_code for result in shown.values()] == [0, 0]
    assert "working" in shown[()].output
    assert shown["--quiet",].output == ""


def test_kernels_are_compiled_ahead_and_once():
    first, second = (CliRunner().invoke(drive_env.commands.cli.app, ["compile", "--json"]) for _ in range(2))
    assert (first.exit_code, second.exit_code) == (0, 0), first.output
    assert json.loads(second.stdout)["compiled"] == 0
    again = CliRunner().invoke(drive_env.commands.cli.app, ["compile"])
    assert again.stdout.strip().startswith("nothing to compile: the kernels of these sources are in ")


@pytest.mark.slow
def test_after_that_drives_and_environments_compile_nothing(tmp_path):
    cache = {"DRIVE_ENV_CACHE": str(tmp_path)}
    done = run("drive-env", "compile", **cache)
    assert "kernels in " in done.stdout, done.stderr
    again = run("drive-env", "--verbose", "compile", **cache)
    assert "nothing to compile" in again.stdout
    assert "compiling" not in again.stderr


def test_kernels_that_cannot_be_kept_are_told(tmp_path, monkeypatch):
    monkeypatch.setattr(compiling, "STEPS", {})
    monkeypatch.setenv("DRIVE_ENV_CACHE", str(tmp_path / "none"))
    result = CliRunner().invoke(drive_env.commands.cli.app, ["compile"])
    assert result.exit_code == 2
    assert f"no kernel could be kept in {tmp_path / 'none'}; name a folder" in result.stderr


@pytest.mark.parametrize(("terminal", "quiet", "told"), [(True, False, 1), (True, True, 0), (False, False, 0)])
def test_a_cold_start_says_once_that_it_compiles_where_somebody_sits_before_it(monkeypatch, terminal, quiet, told):
    class Stream(io.StringIO):
        def isatty(self) -> bool:
            return terminal

    kernels = logging.getLogger("mechanics.kernel_files")
    monkeypatch.setattr(kernels, "handlers", [])
    monkeypatch.setattr(kernels, "level", kernels.level)
    monkeypatch.setattr(kernels, "propagate", True)
    monkeypatch.setattr(sys, "stderr", Stream())
    kernel_files._tell_compiling.cache_clear()
    try:
        with warnings.catch_warnings():
            say_as_much(quiet, False)
        for _ in range(2):
            kernel_files._tell_compiling()
        assert sys.stderr.getvalue().count("compiling the kernels: once for this installation") == told
    finally:
        logging.disable(logging.NOTSET)
