"""`drive-tune sweep`: try a grid of gains, each point on its own emulated machine."""

from __future__ import annotations

import os
import signal
import sys
import warnings
from pathlib import Path
from typing import Annotated, Any

import typer

from drive_env.commands.progress import progress_on
from drive_env.commands.tables import Column, print_lines, print_names, print_table
from tuning.commands.options import (
    INTERRUPTED,
    Cluster,
    Resume,
    Workers,
    errors_as_exit_codes,
    fail,
    what_an_interrupt_leaves,
)

BEST_ROWS = 10
TABLE_FIGURES = (
    "settling [s]", "overshoot [%]", "dip [rpm]", "ripple [A]", "behind [s]", "load_angle [full steps]", "effort [%]",
)  # fmt: skip


def sweep(
    config: Annotated[Path | None, typer.Option(help="Experiment (TOML file); the one that ships by default.")] = None,
    device: Annotated[str | None, typer.Option(help="Device, instead of the experiment's.")] = None,
    motor: Annotated[str | None, typer.Option(help="Motor (name or TOML file), instead of the experiment's.")] = None,
    load: Annotated[str | None, typer.Option(help="Load, instead of the experiment's.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed, instead of the experiment's.")] = None,
    machines: Annotated[
        int | None,
        typer.Option(help="Machines that try each point; several are drawn by the seed, and the worst counts."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the results, new or empty.", show_default="runs/<timestamp>-sweep")
    ] = None,
    closed_loop: Annotated[
        bool, typer.Option("--closed-loop", help="Of a stepper: close its loop, and sweep the loop's gains.")
    ] = False,
    pid: Annotated[
        bool, typer.Option("--pid", help="Of a stepper: have its position PID regulate it, and sweep the PID's gains.")
    ] = False,
    show_config: Annotated[bool, typer.Option("--show-config", help="Print the experiment and stop.")] = False,
    workers: Workers = None,
    cluster: Cluster = None,
    resume: Resume = False,
    list_names: Annotated[
        bool, typer.Option("--list", help="List devices, gains, motors, loads and metrics, and stop.")
    ] = False,
) -> None:
    """Try a grid of gains, each on the same emulated machines with the same velocity and load torque step.

    Prints the best and writes results.csv, heatmap.png, best_response.png and settings.toml, with which `drive-tune
    sweep --config settings.toml` repeats the run to the last digit: files of your own (motor, load, device) are copied
    to inputs/ beside it. A stopped run continues with --out and --resume, with identical results, and only with the
    files as they were.
    """
    overrides: dict[str, Any] = {"device": device, "motor": motor, "load": load, "seed": seed, "machines": machines}
    with errors_as_exit_codes():
        if (closed_loop or pid) and config is not None:
            raise ValueError(
                "--closed-loop and --pid choose the experiment that ships; leave them out with --config: the loop is "
                "closed wherever a gain of it is swept"
            )
        if closed_loop and pid:
            raise ValueError("--closed-loop and --pid choose different experiments; give one of them")
        if closed_loop or pid:
            from drive_env.devices.gain_set import LOAD_ANGLE, PID_ON_RAMP

            overrides["closed_loop"] = PID_ON_RAMP if pid else LOAD_ANGLE
        if list_names:
            _list_names()
        elif show_config:
            _show_config(config, overrides)
        else:
            from tuning.runs import provenance

            if resume and out is None:
                raise ValueError("--resume needs --out: the folder into which the run was to write")
            from tuning.runs.unfinished import telling_what_is_kept

            folder = provenance.run_folder("sweep") if out is None else out
            try:
                with telling_what_is_kept(folder):
                    _sweep(config, overrides, folder, workers, cluster, resume)
            except KeyboardInterrupt:
                fail(what_an_interrupt_leaves(folder), INTERRUPTED)


def _sweep(
    config: Path | None, overrides: dict[str, Any], folder: Path, workers: int | None, cluster: str | None, resume: bool
) -> None:
    from rich.console import Console

    from tuning.runs import provenance, unfinished
    from tuning.runs.experiment import load_experiment
    from tuning.runs.pools import open_pool
    from tuning.runs.sweep_files import save_sweep

    console = Console()
    provenance.check_folder(folder)
    if config is None and resume and not any(value is not None for value in overrides.values()):
        config = unfinished.settings_of(folder)
    experiment = load_experiment(config, **overrides).with_inputs()
    for line in provenance.differences(experiment.versions):
        _note(console, line)
    settings = provenance.HEADER + experiment.to_toml(provenance.versions())
    with unfinished.shard_log(folder, settings, resume=resume, inputs=experiment.inputs()) as log:
        if log.done:
            _note(console, f"continues a stopped run; {len(log.done)} shards are done")
        with open_pool(workers, cluster) as pool:
            for line in pool.differences():
                _note(console, line)
            elsewhere = workers is not None or cluster is not None
            result = _run_with_progress(experiment, console, pool if elsewhere else None, log, folder)
    save_sweep(result, folder)
    unfinished.discard(folder)
    _print_result(result, folder)


def _note(console: Any, text: str) -> None:
    console.print(f"note: {text}", highlight=False, markup=False)


def _run_with_progress(experiment: Any, console: Any, pool: Any, log: Any, folder: Path) -> Any:
    from tuning.runs import unfinished
    from tuning.runs.inputs import forget_copies
    from tuning.runs.sweep import run

    texts = {
        "compiling": "loading the kernels (the first time: 30 seconds)",
        "simulating": f"simulating {experiment.size() * experiment.machines} machines",
    }

    said: set[str] = set()

    def say(message: Warning | str, *_: object, **__: object) -> None:
        """Print each different warning once, such as one about a machine that its motor cannot move."""
        if str(message) not in said:
            said.add(str(message))
            _note(console, str(message))

    def stop(*_: object) -> None:
        # No exception: raised in a callback of the compiler into Python, it would be printed and lost.
        console.show_cursor(True)
        forget_copies()
        if not log.holds_results:
            unfinished.discard(folder)
        print(f"\ndrive-tune: {what_an_interrupt_leaves(folder)}", file=sys.stderr, flush=True)
        os._exit(INTERRUPTED)

    before = signal.signal(signal.SIGINT, stop)
    try:
        with progress_on(console) as progress, warnings.catch_warnings():
            warnings.showwarning = say
            task = progress.add_task(texts["compiling"], total=1.0)
            return run(
                experiment,
                lambda what, share: progress.update(task, description=texts.get(what, what), completed=share),
                pool=pool,
                log=log,
            )
    finally:
        signal.signal(signal.SIGINT, before)


def _print_result(result: Any, folder: Path) -> None:
    usable = int((result.score < float("inf")).sum())
    if usable:
        _print_best(result, min(BEST_ROWS, usable))
    counts = ", ".join(
        f"{int(result.columns[flag].sum())} {word}"
        for flag, word in (
            ("oscillates", "oscillate"),
            ("fault", "end in fault" if not result.response.is_open_loop else "end in fault or lose steps"),
            ("diverged", "diverge"),
        )
    )
    several = result.experiment.machines
    each = f" on each of {several} machines" if several > 1 else ""
    lines = [f"{usable} of {len(result.order)} points are usable{each}; {counts}."]
    if not usable and result.columns["fault"].all():
        lines.append(
            "Every point ended in fault or at a limit switch, whatever its gains: for a load with little travel lower "
            "velocity_rpm or duration, else load_torque (`drive-tune sweep --show-config`)."
        )
    elif not usable:
        lines.append("No point is usable: choose other ranges; heatmap.png and results.csv show all points.")
    if result.response.is_open_loop:
        from drive_env.devices import find_device
        from drive_env.trials.open_loop import unmeasured

        lines.append(
            f"No torque current is measured ({unmeasured(find_device(result.experiment.device))}): there is no ripple "
            "and no peak current; effort is the square of the run current that is set, load angle and lost steps are "
            "by the encoder."
        )
    elif not result.response.measures_current:
        lines.append(
            "No torque current is measured (a PID does not commutate: 6077h is the size of the current that is set): "
            "there is no ripple and no peak current; vibration is by the encoder."
        )
    lines += [f"{name} has no effect in this experiment." for name in result.without_effect()]
    if result.simulated > 0.0:
        lines.append(
            f"simulated {result.simulated:.0f} s of drive time in {result.wall:.2f} s: "
            f"{result.simulated / result.wall:.0f} x real time"
        )
    lines.append(f"written to {folder}: results.csv, heatmap.png, best_response.png, settings.toml")
    print_lines(lines)


def _print_best(result: Any, count: int) -> None:
    metric = result.experiment.metric.name
    figures = [name for name in TABLE_FIGURES if name in result.columns and not name.startswith(f"{metric} [")]
    # Seven columns fit a terminal with 80 characters.
    shown = [*result.objects, result.score_column, *figures[: max(0, 6 - len(result.objects))]]
    # Seconds are printed as milliseconds.
    titles = [name.replace("score", metric).replace("[s]", "[ms]").replace(" [", "\n[") for name in shown]
    rows = []
    for row in result.best(count):
        cells = (1e3 * row[name] if name.endswith("[s]") else row[name] for name in shown)
        rows.append([str(row["rank"]), *(str(cell) if isinstance(cell, int) else f"{cell:.4g}" for cell in cells)])
    title = f"The best {count} of {len(result.order)} points by {metric}"
    print_table([Column("#"), *map(Column, titles)], rows, title)


def _show_config(config: Path | None, overrides: dict[str, Any]) -> None:
    from mechanics.reading.untrusted import read_text
    from tuning.runs.experiment import load_experiment, shipped_experiment

    experiment = load_experiment(config, **overrides)
    if any(value is not None for value in overrides.values()):
        text = experiment.to_toml(experiment.versions)
    else:
        text = read_text(config or shipped_experiment(None))
    sys.stdout.write(text)


def _list_names() -> None:
    from drive_env.devices import device_names, find_device
    from drive_env.motors import MOTORS
    from mechanics.loads import LOADS
    from tuning.runs.experiment import gain_objects
    from tuning.runs.metrics import (
        CLOSED_LOOP_METRICS,
        CLOSED_LOOP_TRACKING,
        METRICS,
        OPEN_LOOP_METRICS,
        OPEN_LOOP_TRACKING,
        PID_TRACKING,
        TRACKING,
    )

    devices = [find_device(name) for name in device_names()]
    gains: dict[tuple[str, str], list[str]] = {}  # object and description -> names of the devices that have it
    for device in devices:
        for e in gain_objects(device, device.new_dictionary()):
            gains.setdefault((f"{e.index:04X}h:{e.sub:02X}", f"{e.name}, {e.low}...{e.high}"), []).append(device.name)
    told: dict[str, str] = {}
    for (key, meaning), names in gains.items():
        text = f"{meaning} ({', '.join(names)})"
        told[key] = f"{told[key]}; {text}" if key in told else text
    combined = f"{TRACKING.meaning} (weights {', '.join(TRACKING.weights)})"
    print_names(
        {
            "devices": {device.name: device.title for device in devices},
            "gains to sweep": told,
            "motors": {motor.name: motor.title for motor in MOTORS.values()},
            "loads": {load.name: load.meaning for load in LOADS.values()},
            "metrics": {f"{TRACKING.name} [{TRACKING.unit}]": combined}
            | {f"{row.name} [{row.unit}]": row.meaning for row in METRICS.values()},
            "metrics of open-loop steppers": {f"{TRACKING.name} [{TRACKING.unit}]": OPEN_LOOP_TRACKING.meaning}
            | {
                f"{row.name} [{row.unit}]": row.meaning for row in OPEN_LOOP_METRICS.values() if row.name not in METRICS
            },
            "metrics of steppers in closed loop": {f"{TRACKING.name} [{TRACKING.unit}]": CLOSED_LOOP_TRACKING.meaning}
            | {
                f"{row.name} [{row.unit}]": row.meaning
                for row in CLOSED_LOOP_METRICS.values()
                if row.name not in METRICS
            },
            "metrics of a stepper's position PID, without ripple and peak": {
                f"{TRACKING.name} [{TRACKING.unit}]": PID_TRACKING.meaning
            },
        }
    )
