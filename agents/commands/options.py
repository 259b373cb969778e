"""Options, result folders and exit codes that the commands of `drive-agent` share."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from drive_env.commands.options import INTERRUPTED as INTERRUPTED
from drive_env.commands.options import REFUSED as REFUSED
from drive_env.commands.options import USER_ERROR as USER_ERROR
from drive_env.commands.options import Bitrate as Bitrate
from drive_env.commands.options import Channel as Channel
from drive_env.commands.options import Interface as Interface
from drive_env.commands.options import Json as Json
from drive_env.commands.options import Nodes as Nodes
from drive_env.commands.options import ending_by
from drive_env.commands.options import print_json as print_json
from tuning.commands.options import Cluster as Cluster
from tuning.commands.options import Workers as Workers
from tuning.runs.provenance import run_folder

if TYPE_CHECKING:
    from tuning.runs.pools import Pool

# Slow imports (torch, the compiler, MuJoCo, matplotlib) are made by the command that needs them.

# Packages of the extra `agents`, which training and ONNX need.
OF_EXTRA = ("torch", "stable_baselines3", "sb3_contrib", "tensorboard", "onnx", "onnxruntime", "yaml")
EXTRA = "pip install 'drive-env[agents]'"

Environment = Annotated[str, typer.Argument(help="gain_tuning, gain_scheduling or tracking.")]
Algorithm = Annotated[str, typer.Option("--algorithm", "-a", help="ppo, sac, recurrent_ppo, tqc or crossq.")]
Preset = Annotated[str, typer.Option("--preset", help="quick (minutes) or full (half an hour).")]
Load = Annotated[str | None, typer.Option("--load", help="Load, instead of the configuration's.")]
Config = Annotated[Path | None, typer.Option("--config", help="Hyper-parameters (YAML), instead of the shipped ones.")]
Seed = Annotated[int, typer.Option("--seed", help="Seed of all random numbers.")]
Steps = Annotated[
    int | None, typer.Option("--steps", help="Number of steps in all environments together, instead of the preset's.")
]
Out = Annotated[
    Path | None, typer.Option("--out", help="Folder for the results, new or empty.", show_default="a new one in runs/")
]
Trust = Annotated[
    bool,
    typer.Option(
        "--trust",
        help="Load a checkpoint (.zip) although it holds pickles: loading it runs code that its author put there.",
    ),
]


def new_folder(path: Path | None, name: str) -> Path:
    """Return an empty folder for results; by default one named after time and command.

    Raises:
        ValueError: If it is not empty.
    """
    if path is None:
        path = run_folder(name)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise ValueError(f"--out {path} is not empty; choose a new folder")
    return path


@contextmanager
def elsewhere(workers: int | None, cluster: str | None, again: str) -> Iterator[Pool | None]:
    """Yield the pool of --workers or --cluster; None without either.

    Args:
        workers: As for `open_pool`.
        cluster: As for `open_pool`.
        again: Advice for lost work.
    """
    if workers is None and cluster is None:
        yield None
        return
    from tuning.runs.pools import open_pool

    with open_pool(workers, cluster, again) as pool:
        for line in pool.differences():
            print(f"note: {line}", file=sys.stderr)
        yield pool


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[[float], None]]:
    """Show a progress bar on stderr, if that is a terminal; the yielded function takes the finished share."""
    if not sys.stderr.isatty():
        yield lambda share: None
        return
    from tuning.commands.options import progress_bar as bar

    with bar(title) as show:
        yield show


@contextmanager
def errors_as_exit_codes() -> Iterator[None]:
    """End with one line: exit code 1 for errors of drive, bus or limits, 2 for the user's mistake, 130 for Ctrl-C."""
    from agents.policies.policy import PolicyError
    from drive_env.fieldbus.errors import BusError, RefusedError
    from drive_env.safety.envelope import SafetyError
    from tuning.runs.pools import PoolError

    with ending_by(
        fail, refused=(PolicyError, SafetyError, BusError, RefusedError, PoolError, TimeoutError),
        mistakes=(ImportError,),
    ):  # fmt: skip
        try:
            yield
        except ModuleNotFoundError as error:
            remedy = f"; {EXTRA}" if (error.name or "").partition(".")[0] in OF_EXTRA else ""
            fail(f"{error}{remedy}")


def fail(error: object, code: int = USER_ERROR) -> NoReturn:
    """End the command with a red line on stderr."""
    typer.secho(f"drive-agent: {error}", fg=typer.colors.RED, err=True)
    raise typer.Exit(code)
