"""What the three programs have in common: version, how much they say, completion, names that there are."""

from __future__ import annotations

import io
import json
import logging
import os
import re
import subprocess
import sys
import warnings
from collections import defaultdict
from contextlib import contextmanager, nullcontext

import pytest
import typer
from numba.core import event
from rich.console import Console
from typer.testing import CliRunner

import agents.commands.cli
import drive_env.commands.cli
import tuning.commands.cli
from drive_env.commands import compile_bar, compiling, progress
from drive_env.commands.program import AGAIN, Quiet, RepeatedLines, Verbose, say_as_much
from drive_env.commands.progress import progress_on
from mechanics.kernels import kernel_files

APPS = {
    "drive-env": drive_env.commands.cli.app,
    "drive-tune": tuning.commands.cli.app,
    "drive-agent": agents.commands.cli.app,
}


def test_a_line_that_was_printed_a_moment_ago_is_left_out():
    repeated = RepeatedLines()

    def passes(at, text):
        record = logging.LogRecord("drive_env", logging.WARNING, "", 0, text, (), None)
        record.created = at
        return repeated.filter(record)

    assert [passes(0.0, "lost"), passes(0.1, "lost"), passes(0.2, "stopped"), passes(0.2, "lost")] == [1, 0, 1, 0]
    assert passes(AGAIN, "lost") and not passes(AGAIN + 0.1, "lost")


@pytest.mark.parametrize("name", APPS)
def test_the_version_is_that_of_the_package(name):
    result = CliRunner().invoke(APPS[name], ["--version"], prog_name=name)
    assert (result.exit_code, result.stdout) == (0, f"{name} {drive_env.__version__}\n")


@pytest.mark.parametrize(("program", "old", "new"), [
    *(("drive-env", old, f"drive-env parameters {old}") for old in ("backup", "diff", "restore", "commission")),
    *(("drive-env", old, f"drive-env frames {old}") for old in ("log", "replay")),
    *(("drive-env", old, f"drive-env export {old} FILE --device DEVICE") for old in ("eds", "esi")),
    ("drive-tune", "optimise", "drive-tune auto --by tpe"),
    ("drive-agent", "tune", "drive-tune auto --by agent"),
])  # fmt: skip
@pytest.mark.parametrize("more", [[], ["--help"], ["--channel", "can0", "--yes", "x"]], ids=" ".join)
def test_an_old_name_answers_with_the_new_one_and_does_nothing(program, old, new, more):
    result = CliRunner().invoke(APPS[program], [old, *more])
    assert (result.exit_code, result.output) == (2, f"{program}: `{program} {old}` is `{new}` now\n")


@pytest.mark.parametrize(
    "more", [["a.eds"], ["--dcf", "--device", "tmcm1636", "a.EDS"], ["a.dcf", "--help"]], ids=" ".join
)
def test_a_file_to_export_alone_is_answered_with_the_commands_and_not_written(more, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(APPS["drive-env"], ["export", *more])
    assert (result.exit_code, list(tmp_path.iterdir())) == (2, [])
    assert result.stderr == "drive-env: `drive-env export FILE` is `drive-env export eds|dcf FILE` now\n"


@pytest.mark.parametrize("name", APPS)
def test_quiet_and_verbose_exclude_each_other(name):
    command = {"drive-env": "list", "drive-tune": "rules", "drive-agent": "evaluate"}[name]
    result = CliRunner().invoke(APPS[name], ["--quiet", "--verbose", command])
    assert result.exit_code == 2
    assert "--quiet and --verbose exclude each other" in result.stderr


def run(program, *arguments, **environment):
    return subprocess.run(
        [sys.executable, "-c", f"import sys; sys.argv[0] = {program!r}; from drive_env import programs as c; "
         f"c.{program.replace('-', '_')}()", *arguments],
        env=os.environ | environment, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip


@pytest.mark.every(4)
@pytest.mark.parametrize(("program", "begun", "commands"), [
    ("drive-env", "sc", {"scan", "scope"}),
    ("drive-env", "parameters ", {"backup", "diff", "restore", "commission"}),
    ("drive-tune", "r", {"response", "rules", "rank"}),
    ("drive-agent", "ev", {"evaluate"}),
])  # fmt: skip
def test_a_shell_completes_commands(program, begun, commands):
    variable = f"_{program.replace('-', '_').upper()}_COMPLETE"
    words = {"COMP_WORDS": f"{program} {begun}", "COMP_CWORD": str(len(begun.split(" ")))}
    done = run(program, **{variable: "complete_bash"}, **words)
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


@pytest.mark.slow
def test_quiet_shows_errors_and_no_progress_bar():
    loud, quiet = (
        run("drive-tune", *more, "response", "--load", "inertia", "--out", "/dev/null/nowhere")
        for more in ((), ("--quiet",))
    )
    assert loud.returncode == quiet.returncode != 0
    assert quiet.stderr.startswith("drive-tune: ")


def test_quiet_hides_bars_and_warnings(capfd):
    from rich.console import Console

    from drive_env.commands.progress import progress_on

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


def test_every_device_that_is_named_is_used_once(monkeypatch):
    used = []
    monkeypatch.setattr(compiling, "_use_drives", used.append)
    monkeypatch.setattr(compiling, "_use_environments", lambda: used.append("environments"))
    result = CliRunner().invoke(drive_env.commands.cli.app, ["compile", "tgz_d", "tmcm6212", "tgz_d"])
    assert result.exit_code == 0, result.output
    assert used == ["tgz_d", "tmcm6212", "environments"]


def test_a_device_that_is_not_there_is_named_before_anything_compiles(monkeypatch):
    monkeypatch.setattr(compiling, "_use_drives", None)
    result = CliRunner().invoke(drive_env.commands.cli.app, ["compile", "tmcm1636", "tmcm9999"])
    assert result.exit_code == 2
    assert "tmcm9999" in result.stderr


@pytest.mark.slow
def test_after_that_drives_and_environments_compile_nothing(tmp_path):
    cache = {"DRIVE_ENV_CACHE": str(tmp_path)}
    counted = (
        "import sys; sys.stderr.isatty = lambda: True\n"
        "from drive_env.commands import compile_bar, compiling\n"
        "bar = compile_bar.show_compiling(); compiling.compile_kernels(); print('functions', bar.done)"
    )
    done = subprocess.run(
        [sys.executable, "-c", counted], env=os.environ | cache, capture_output=True, text=True, check=True
    )
    assert "kernels in " in done.stdout, done.stderr
    # What the bar's length is made of is what Numba compiles, about.
    functions = int(done.stdout.split()[-1])
    assert functions == pytest.approx(sum(compile_bar.FUNCTIONS.values()), rel=0.15)
    again = run("drive-env", "--verbose", "compile", **cache)
    assert "nothing to compile" in again.stdout
    assert "compiling" not in again.stderr


def test_kernels_that_cannot_be_kept_are_told(tmp_path, monkeypatch):
    monkeypatch.setattr(compiling, "_steps", lambda devices: {})
    monkeypatch.setenv("DRIVE_ENV_CACHE", str(tmp_path / "none"))
    result = CliRunner().invoke(drive_env.commands.cli.app, ["compile"])
    assert result.exit_code == 2
    assert (
        f"no kernel could be stored in {tmp_path / 'none'}; set DRIVE_ENV_CACHE to a writable folder" in result.stderr
    )


# --- a cold start ---------------------------------------------------------------------------------------------------
@pytest.fixture
def compiling_seen(monkeypatch):
    """What compiles three kernels of two functions each; returns what stderr got."""
    kernels = logging.getLogger(compile_bar.KERNELS)
    monkeypatch.setattr(kernels, "handlers", [])
    monkeypatch.setattr(kernels, "level", kernels.level)
    monkeypatch.setattr(event, "_registered", defaultdict(list))
    monkeypatch.setattr(progress, "shown", [])
    monkeypatch.setattr(compile_bar, "shown", progress.shown)
    monkeypatch.setattr(compile_bar, "FUNCTIONS", dict.fromkeys(compile_bar.ALWAYS, 2))
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "xterm")
    kernel_files._tell_compiling.cache_clear()

    def compile_all(folder, terminal, quiet, around=nullcontext):
        class Stream(io.StringIO):
            def isatty(self) -> bool:
                return terminal

        monkeypatch.setattr(sys, "stderr", Stream())
        monkeypatch.setattr(logging.getLogger(), "handlers", [])  # pytest's, which none of our programs has
        with warnings.catch_warnings():
            say_as_much(quiet, False)
        with around():
            for name in compile_bar.ALWAYS:
                files = kernel_files.KernelFiles(folder, f"{name}-1.py311", "stamp")
                assert files.load("key") is None
                for _ in range(2):
                    with event.trigger_event("numba:compile"):
                        pass
                files.save("key", "kernel")
                assert files.load("key") == "kernel"
        return sys.stderr.getvalue()

    yield compile_all
    logging.disable(logging.NOTSET)


def test_a_cold_start_says_so_with_a_bar_that_counts_what_is_compiled(compiling_seen, tmp_path):
    seen = compiling_seen(tmp_path, terminal=True, quiet=False)
    assert seen.count("compiling the kernels: once for this installation") == 1
    bar = logging.getLogger(compile_bar.KERNELS).handlers[0]
    assert (bar.done, bar.total) == (6, 6)
    # 80 columns hold it, it went on from kernel to kernel, and it left the terminal as it was.
    shares = [int(share) for share in re.findall(r"compiling, once .*?(\d+)%", seen)]
    assert shares == sorted(shares) and {0, 33, 67, 100} <= set(shares)
    assert seen.count("\x1b[?25l") == seen.count("\x1b[?25h") == 3  # the cursor


def test_it_is_a_line_of_the_bars_that_are_there(compiling_seen, tmp_path):
    @contextmanager
    def working():
        with progress_on(Console(file=io.StringIO())), progress_on(Console(file=sys.stderr)) as bars:
            bars.add_task("working", total=1.0)
            yield
            assert [task.visible for task in bars.tasks] == [True, False]

    seen = compiling_seen(tmp_path, terminal=True, quiet=False, around=working)
    assert "compiling, once" in seen and seen.count("\x1b[?25l") == 1


@pytest.mark.parametrize(("terminal", "quiet", "lines"), [(False, False, 1), (False, True, 0), (True, True, 0)])
def test_without_a_terminal_it_is_a_line_and_with_quiet_nothing(compiling_seen, tmp_path, terminal, quiet, lines):
    seen = compiling_seen(tmp_path, terminal, quiet)
    assert seen.count("compiling the kernels: once for this installation") == lines
    assert len(seen.splitlines()) == lines
