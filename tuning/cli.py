"""The command `drive-tune`."""

from __future__ import annotations

import os
import signal
import sys
import warnings
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

# Whatever takes long to import (the compiler, MuJoCo, matplotlib) is imported by the command that needs it.
app = typer.Typer(
    name="drive-tune",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
USER_ERROR, INTERRUPTED = 2, 130
INTERRUPTED_TEXT = "drive-tune: interrupted; nothing was written"
BEST_ROWS = 10
TABLE_FIGURES = ("settling [s]", "overshoot [%]", "dip [rpm]", "ripple [A]")


@app.callback()
def drive_tune() -> None:
    """Find gains for servo drives, on emulated machines."""


@app.command("sweep")
def sweep_command(
    config: Annotated[Path | None, typer.Option(help="Experiment (TOML); by default the one that ships.")] = None,
    device: Annotated[str | None, typer.Option(help="Drive, in place of the experiment's.")] = None,
    motor: Annotated[str | None, typer.Option(help="Motor, in place of the experiment's.")] = None,
    load: Annotated[str | None, typer.Option(help="Load, in place of the experiment's.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed, in place of the experiment's.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the results, new or empty.", show_default="runs/<timestamp>-sweep")
    ] = None,
    show_config: Annotated[bool, typer.Option("--show-config", help="Print the experiment and stop.")] = False,
    list_names: Annotated[
        bool, typer.Option("--list", help="List devices, gains, motors, loads and metrics, and stop.")
    ] = False,
) -> None:
    """Try a grid of gains, each on the same emulated machine with the same velocity and load torque step.

    Prints the best and writes results.csv, heatmap.png, best_response.png and settings.toml, from which
    `drive-tune sweep --config settings.toml` repeats the run to the last digit.
    """
    overrides = {"device": device, "motor": motor, "load": load, "seed": seed}
    try:
        if list_names:
            _list_names()
        elif show_config:
            _show_config(config, overrides)
        else:
            _sweep(config, overrides, out)
    except KeyboardInterrupt:  # here, not in main: typer would end with a code of its own
        _interrupted()


def main() -> None:
    """Run the command; a user's mistake ends with one line and exit code 2, Ctrl-C with 130."""
    try:
        app()
    except KeyboardInterrupt:
        _interrupted()


def _fail(error: Exception) -> NoReturn:
    print(f"drive-tune: {error}", file=sys.stderr)
    sys.exit(USER_ERROR)


def _interrupted() -> NoReturn:
    print(INTERRUPTED_TEXT, file=sys.stderr)
    sys.exit(INTERRUPTED)


def _sweep(config: Path | None, overrides: dict[str, Any], out: Path | None) -> None:
    from rich.console import Console

    from tuning import provenance
    from tuning.experiment import ExperimentError, load_experiment

    console = Console()
    folder = provenance.run_folder("sweep") if out is None else out
    try:
        provenance.check_folder(folder)
        experiment = load_experiment(config, **overrides)
    except (ExperimentError, OSError) as error:
        _fail(error)
    for line in provenance.differences(experiment.versions):
        console.print(f"note: {line}", highlight=False)

    from tuning import sweep

    result = _run_with_progress(sweep, experiment, console)
    try:
        result.save(folder)
    except OSError as error:
        _fail(error)
    _print_result(console, result, folder)


def _run_with_progress(sweep: Any, experiment: Any, console: Any) -> Any:
    from rich.progress import BarColumn, Progress, SpinnerColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn

    texts = {
        "compiling": "loading the kernels (the first time: 40 seconds)",
        "simulating": f"simulating {experiment.size()} machines",
    }
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
    )

    said: set[str] = set()

    def say(message: Warning | str, *_: object, **__: object) -> None:
        """Show a warning, of a machine that its motor cannot move, as a line and once."""
        if str(message) not in said:
            said.add(str(message))
            console.print(f"note: {message}", highlight=False)

    def stop(*_: object) -> None:
        # Not by an exception: raised while the compiler calls back into Python it would be printed and lost. Nothing
        # has been written yet.
        console.show_cursor(True)
        print(f"\n{INTERRUPTED_TEXT}", file=sys.stderr, flush=True)
        os._exit(INTERRUPTED)

    before = signal.signal(signal.SIGINT, stop)
    try:
        with Progress(*columns, console=console) as progress, warnings.catch_warnings():
            warnings.showwarning = say
            task = progress.add_task(texts["compiling"], total=1.0)
            return sweep.run(
                experiment, lambda what, share: progress.update(task, description=texts[what], completed=share)
            )
    finally:
        signal.signal(signal.SIGINT, before)


def _print_result(console: Any, result: Any, folder: Path) -> None:
    usable = int((result.score < float("inf")).sum())
    if usable:
        console.print(_best_table(result, min(BEST_ROWS, usable)))
    counts = ", ".join(
        f"{int(result.columns[flag].sum())} {word}"
        for flag, word in (("oscillates", "oscillate"), ("fault", "end in fault"), ("diverged", "diverge"))
    )
    lines = [f"{usable} of {len(result.order)} points are usable; {counts}."]
    if not usable:
        lines.append("No point is usable: choose other ranges; heatmap.png and results.csv show what there is.")
    lines += [f"{name} changes nothing in this excitation." for name in result.without_effect()]
    speed = result.simulated / result.wall
    lines.append(f"simulated {result.simulated:.0f} s of drive time in {result.wall:.2f} s: {speed:.0f} x real time")
    lines.append(f"written to {folder}: results.csv, heatmap.png, best_response.png, settings.toml")
    console.print("\n".join(lines), highlight=False, markup=False, soft_wrap=True)


def _best_table(result: Any, count: int) -> Any:
    from rich import box
    from rich.table import Table

    metric = result.experiment.metric.name
    figures = [name for name in TABLE_FIGURES if not name.startswith(f"{metric} [")]
    # Seven columns fit a terminal of 80 characters.
    columns = [*result.objects, result.score_column, *figures[: max(0, 6 - len(result.objects))]]
    table = Table(title=f"The best {count} of {len(result.order)} points by {metric}", box=box.SIMPLE_HEAD)
    table.add_column("#", justify="right")
    for name in columns:
        # Seconds are read as milliseconds; a bracket would be taken for markup.
        text = name.replace("score", metric).replace("[s]", "[ms]").replace(" [", "\n\\[")
        table.add_column(text, justify="right", no_wrap=True)
    for row in result.best(count):
        cells = (1e3 * row[name] if name.endswith("[s]") else row[name] for name in columns)
        table.add_row(str(row["rank"]), *(str(cell) if isinstance(cell, int) else f"{cell:.4g}" for cell in cells))
    return table


def _show_config(config: Path | None, overrides: dict[str, Any]) -> None:
    from tuning.experiment import DEFAULT, ExperimentError, load_experiment

    try:
        experiment = load_experiment(config, **overrides)
    except ExperimentError as error:
        _fail(error)
    if any(value is not None for value in overrides.values()):
        text = experiment.to_toml(experiment.versions)
    else:
        text = (config or DEFAULT).read_text(encoding="utf-8")
    sys.stdout.write(text)


def _list_names() -> None:
    from rich.console import Console
    from rich.table import Table

    from drive_env.devices import device_names, find_device
    from drive_env.motors import MOTORS
    from mechanics.loads import LOADS
    from tuning.experiment import gain_objects
    from tuning.metrics import METRICS, TRACKING

    devices = [find_device(name) for name in device_names()]
    gains = [(device, entry) for device in devices for entry in gain_objects(device, device.new_dictionary())]
    combined = f"{TRACKING.meaning} (weights {', '.join(TRACKING.weights)})"
    tables = {
        "devices": [(device.name, device.title) for device in devices],
        "gains to sweep": [
            (f"{e.index:04X}h:{e.sub:02X}", f"{e.name}, {e.low}...{e.high} ({d.name})") for d, e in gains
        ],
        "motors": [(motor.name, motor.title) for motor in MOTORS.values()],
        "loads": [(load.name, load.meaning) for load in LOADS.values()],
        "metrics": [(f"{TRACKING.name} [{TRACKING.unit}]", combined)]
        + [(f"{row.name} [{row.unit}]", row.meaning) for row in METRICS.values()],
    }
    console = Console()
    for title, rows in tables.items():
        table = Table(title=title, title_justify="left", box=None, show_header=False, pad_edge=False)
        for name, meaning in rows:
            table.add_row(name.replace("[", "\\["), meaning)
        console.print(table)
        console.print()


if __name__ == "__main__":
    main()
