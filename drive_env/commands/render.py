"""`drive-env render`: film an emulated run, the machine beside the scope."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from drive_env.commands.options import USER_ERROR, fail
from drive_env.commands.progress import progress_on
from drive_env.programs import CLOSED, output_is_closed
from mechanics.reading.untrusted import read_text

# Slow imports (the compiler, MuJoCo, matplotlib) are made when they are needed.


def render(
    config: Annotated[Path | None, typer.Option(help="Run (TOML file); the one that ships by default.")] = None,
    device: Annotated[str | None, typer.Option(help="Device, instead of the run's.")] = None,
    motor: Annotated[str | None, typer.Option(help="Motor, instead of the run's.")] = None,
    load: Annotated[str | None, typer.Option(help="Load, instead of the run's.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed, instead of the run's.")] = None,
    slow: Annotated[
        float | None,
        typer.Option(help="Seconds of film per second of run; 1 is real time. [default: a film of about 8 s]"),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="New film: a name that ends in .gif, .webp, .apng, .png or .mp4 (needs ffmpeg), or a folder for PNGs.",
            show_default="<load>.gif",
        ),
    ] = None,
    view: Annotated[
        bool, typer.Option("--view", help="Open MuJoCo's interactive viewer, too; needs a display.")
    ] = False,
    show_config: Annotated[bool, typer.Option("--show-config", help="Print the run and stop.")] = False,
) -> None:
    """Film an emulated drive: the machine on the left, position, velocity and current on the right.

    By default a move there and back that suits load and motor, then a load torque step; --config changes it.
    """
    from drive_env.pictures.demonstration import DEFAULT, DemonstrationError, load_demonstration
    from drive_env.pictures.opengl import OpenGLError, has_display, new_context
    from drive_env.pictures.picture_files import PictureFileError, check_out

    try:
        row = load_demonstration(config, device=device, motor=motor, load=load, seed=seed, slow=slow)
        if show_config:
            sys.stdout.write(_with_overrides(config or DEFAULT, device=device, motor=motor, load=load, seed=seed))
            return
        film = None if view and out is None else check_out(out or Path(f"{Path(row.load).stem}.gif"))
        if film is not None and film.is_file():
            raise PictureFileError(f"{film} exists already, and files are not overwritten; choose another --out")
        if view and not has_display():
            raise OpenGLError(
                "--view needs a display and there is none (DISPLAY and WAYLAND_DISPLAY are unset); leave it out, and "
                "a film is written"
            )
        if film is not None:
            new_context(16, 16).free()  # before the run and any import of MuJoCo, which would fail without it
        _render(row, film, view)
    except (DemonstrationError, OpenGLError, PictureFileError) as error:
        fail(error, USER_ERROR)
    except OSError as error:
        if isinstance(error, BrokenPipeError) and output_is_closed():
            raise typer.Exit(CLOSED) from None
        fail(f"{error.filename or out}: {error.strerror or error}; choose another --out", USER_ERROR)


def _render(row: Any, film: Path | None, view: bool) -> None:
    from rich.console import Console

    console = Console()
    with progress_on(console) as progress:
        # The kernels compile once, on the first run ever: 30 seconds.
        task = progress.add_task("simulating", total=1.0)
        from drive_env.pictures.demonstration import perform
        from drive_env.pictures.render import render_run
        from drive_env.pictures.render import view as open_viewer

        recording = perform(row, lambda share: progress.update(task, completed=share))
        if film is not None:
            task = progress.add_task("drawing", total=1.0)
            count = render_run(recording, film, row.picture, lambda share: progress.update(task, completed=share))
    for t, text in recording.events:
        console.print(f"{t:7.3f} s  {text}", highlight=False, markup=False, soft_wrap=True)
    if film is not None:
        console.print(f"written to {film}: {count} frames", highlight=False, markup=False, soft_wrap=True)
    if view:
        open_viewer(recording, row.picture.slow or 1.0)


def _with_overrides(config: Path, **overrides: str | int | None) -> str:
    """Return the run's TOML with comments and overridden values."""
    text = read_text(config)
    for key, value in overrides.items():
        if value is not None:
            line = f"{key} = {json.dumps(value)}"
            found = re.search(rf"(?m)^{key}\s*=\s*(\"[^\"]*\"|'[^']*'|\d+)", text)
            text = f"{text[: found.start()]}{line}{text[found.end() :]}" if found else f"{line}\n{text}"
    return text
