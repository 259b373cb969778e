"""`python -m benchmarks`: prints tables and writes JSON.

Every figure is the best of several repetitions: on a shared machine the fastest is the one least disturbed. The bound
is measured in the same run: the drives without mechanics plus MuJoCo's packed step without drives.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import mujoco
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks import bus, environments, ethercat, gain_tuning, studio, sweeps, training
from drive_env import EmulatedDrives, motion
from drive_env.default_device import DEFAULT_DEVICE
from drive_env.devices import device_names, find_device
from drive_env.dictionary.position_scale import velocity_ratio
from drive_env.drives.speeds import rpm_of_unit
from drive_env.emulator.emulated_drives import MOST_MACHINES
from drive_env.emulator.inertia_check import MisfitWarning
from mechanics.loads import LOADS

SIZES = (1, 8, 64, 1024, 16384)
LOAD = "two_mass"
OBSERVED = ("Position actual value", "Velocity actual value", "Torque actual value")
SPEED_PPS = 1_000_000
SLOW_PPS = 200_000  # no load comes to its end stops
DEVICE_SPEED = "180 rpm"  # that every device's usual motor reaches in open loop, too
ARM = "robot"  # six joints


def best_time(function: Callable[[], Any], repetitions: int = 5) -> float:
    """Return the shortest of several run times [s]."""
    times = []
    for _ in range(repetitions):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def running_drives(
    machines: int, threads: int, load: str = LOAD, speed: int | str = SPEED_PPS, device: str = DEFAULT_DEVICE
) -> EmulatedDrives:
    drives = EmulatedDrives(device, load, num_machines=machines, num_threads=threads)
    motion.enable(drives, mode="pv")
    if isinstance(speed, str) and velocity_ratio(drives.device.roles) is not None:
        speed = round(float(speed.split()[0]) / float(rpm_of_unit(drives)[0]))  # counts of a unit of the drive's own
    drives.write("Target velocity", speed)
    drives.advance(0.01)
    return drives


def ticks() -> dict[str, float]:
    """Return ns per drive and current tick, all firmware stages included, for one live lane and for eight."""
    result = {}
    cycles = 2000
    for name, machines in (("1 lane", 1), ("8 lanes", 8)):
        drives = running_drives(machines, 1)
        group = drives.inside.groups[0]
        seconds = best_time(
            lambda g=group, d=drives: d.device.firmware.run_drives_alone(d.inside.records, g.rates, cycles)
        )
        result[name] = seconds / (cycles * group.rates.windows * group.rates.ticks * machines) * 1e9
    return result


def device_ticks() -> dict[str, float]:
    """Return ns per drive and current tick of each device's firmware, eight live lanes, in turn."""
    cycles, runs = 2000, {}
    for name in device_names():
        if find_device(name).variant_of:
            continue
        drives = running_drives(8, 1, "inertia", DEVICE_SPEED, name)
        group = drives.inside.groups[0]
        per_tick = 1e9 / (cycles * group.rates.windows * group.rates.ticks * 8)
        runs[name] = (
            per_tick,
            lambda g=group, d=drives: d.device.firmware.run_drives_alone(d.inside.records, g.rates, cycles),
        )
    best = dict.fromkeys(runs, float("inf"))
    for _ in range(5):
        for name, (per_tick, run) in runs.items():
            best[name] = min(best[name], best_time(run, 1) * per_tick)
    return best | {f"{name} over tmcm1636": best[name] / best["tmcm1636"] for name in best if name != "tmcm1636"}


def arms() -> dict[str, dict[str, float]]:
    """Return the speed of 64 six-joint arms on one core with the drives of each device that has axes enough."""
    rows = {}
    for name in device_names():
        device = find_device(name)
        if device.variant_of or device.num_axes not in (1, 6):
            continue
        row = bound(ARM, 64, DEVICE_SPEED, name)
        rows[name] = row | {"arm-seconds per second": row["x real time"] / 6}
    return rows


def bound(
    load: str = LOAD, machines: int = 64, speed: int | str = SLOW_PPS, device: str = DEFAULT_DEVICE
) -> dict[str, float]:
    """Return microseconds per axis and millisecond on one core: the parts alone, the whole, and the ratio.

    The parts are measured in turn, so that a slower moment of the machine slows all of them.
    """
    drives = running_drives(machines, 1, load, speed, device)
    groups, cycles, run_alone = drives.inside.groups, 40, drives.device.firmware.run_drives_alone
    moving = [(group.load.data.qpos.copy(), group.load.data.qvel.copy()) for group in groups]

    def physics() -> None:
        for group in groups:
            mujoco.mj_step(group.load.model, group.load.data, cycles * group.rates.windows)

    whole = alone = steps = float("inf")
    for _ in range(8):
        whole = min(whole, best_time(lambda: drives.advance(cycles * 1e-3), 1))
        alone = min(alone, best_time(lambda: run_alone(drives.inside.records, groups[0].rates, cycles), 1))
        kept = [(group.load.data.qpos.copy(), group.load.data.qvel.copy()) for group in groups]
        for group, (qpos, qvel) in zip(groups, moving, strict=True):
            # Forces of the last step would drive it away, and springs are not MuJoCo's.
            group.load.data.qpos[:], group.load.data.qvel[:], group.load.data.qfrc_applied[:] = qpos, qvel, 0.0
        steps = min(steps, best_time(physics, 1))
        for group, (qpos, qvel) in zip(groups, kept, strict=True):
            group.load.data.qpos[:], group.load.data.qvel[:] = qpos, qvel
    axes = drives.num_axes
    drives.close()
    per_axis = 1e6 / (cycles * axes)
    return {
        "drive alone": alone * per_axis,
        "packed mj_step alone": steps * per_axis,
        "bound": (alone + steps) * per_axis,
        "emulator": whole * per_axis,
        "share of bound": (alone + steps) / whole,
        "x real time": cycles * 1e-3 * axes / whole,
    }


def throughput(sizes: tuple[int, ...]) -> list[dict[str, float]]:
    """Return steps of 1 ms per second: in one call for many milliseconds, and as an environment makes them."""
    rows: list[dict[str, float]] = []
    for machines in sizes:
        for count in (1, 2):
            drives = running_drives(machines, count)
            cycles = max(10, min(400, 100_000 // machines))
            whole = best_time(lambda d=drives, n=cycles: d.advance(n * 1e-3), 3)
            steps = max(3, min(200, 20_000 // machines))

            def env_steps(d: EmulatedDrives = drives, n: int = steps) -> None:
                for _ in range(n):
                    d.write("Target velocity", SPEED_PPS)
                    d.advance(0.001)
                    for name in OBSERVED:
                        d.read(name)

            env = best_time(env_steps, 3)
            advance = cycles * machines / whole
            one = advance if count == 1 else rows[-1]["advance"]
            rows.append(
                {
                    "machines": machines,
                    "threads": count,
                    "advance": advance,
                    "over one thread": advance / one,
                    "as an environment": steps * machines / env,
                }
            )
            drives.close()
    return rows


def construction(quick: bool = False) -> dict[str, float]:
    """Return seconds to make a large set of machines, alike and drawn, each in a fresh process whose memory is new."""
    count = 4096 if quick else MOST_MACHINES
    made = (
        "import sys, time; from drive_env import EmulatedDrives; EmulatedDrives(load=sys.argv[1], num_machines=65);"
        "t = time.perf_counter();"
        "EmulatedDrives(load=sys.argv[1], num_machines=int(sys.argv[2]), randomise=sys.argv[3] == 'drawn');"
        "print(time.perf_counter() - t)"
    )
    result = {}
    for load in ("inertia", LOAD):
        for kind in ("alike", "drawn"):
            command = [sys.executable, "-W", "ignore", "-c", made, load, str(count), kind]
            runs = [float(subprocess.run(command, capture_output=True, text=True, check=True).stdout) for _ in range(3)]
            result[f"{count:,} machines, {load}, {kind} [s]"] = min(runs)
    return result


def start_up() -> dict[str, float]:
    """Return seconds of a fresh process: import, first result with an empty cache, first result with a full one."""
    first = (
        "import time; t = time.perf_counter(); import drive_env; a = time.perf_counter() - t;"
        "d = drive_env.EmulatedDrives(); d.advance(0.001); print(a, time.perf_counter() - t)"
    )
    result = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in ("cold compile", "cached"):
            environment = {**os.environ, "DRIVE_ENV_CACHE": folder}
            run = subprocess.run(
                [sys.executable, "-c", first], env=environment, capture_output=True, text=True, check=True
            )
            imported, seconds = (float(word) for word in run.stdout.split())
            result[f"first result, {name} [s]"] = seconds
            result["import drive_env [s]"] = imported
    return result


def parts_of(quick: bool) -> dict[str, Callable[[], Any]]:
    """Return the function that measures each table, by its title: figures by name, rows by name, or rows."""
    parts: dict[str, Callable[[], Any]] = {
        "ns per drive and tick": ticks,
        "us per axis and ms, 64 machines, 1 thread": bound,
        "ns per drive and tick, by device, 8 lanes": device_ticks,
        "64 arms of six axes, 1 thread: us per axis and ms": arms,
        "per load: us per axis and ms, 64 machines, 1 thread, 5 physics steps per ms": lambda: {
            load: {"axes": row.num_axes} | bound(load) for load, row in LOADS.items()
        },
        "bus": bus.figures,
        "EtherCAT": ethercat.figures,
        "studio": studio.figures,
        "environments": environments.figures,
        "gain tuning": gain_tuning.figures,
        "training": training.figures,
        "sweeps": lambda: sweeps.figures(quick),
        "construction": lambda: construction(quick),
    }
    if not quick:
        parts["start-up"] = start_up
    parts[f"1 ms steps per second, {LOAD}"] = lambda: throughput(SIZES[:-1] if quick else SIZES)
    return parts


def print_table(console: Console, title: str, figures: Any) -> None:
    """Print figures by name as two columns, rows by name or rows with their own."""
    if isinstance(figures, list):
        columns, rows = tuple(figures[0]), [tuple(row.values()) for row in figures]
    elif isinstance(first := next(iter(figures.values())), dict):
        columns, rows = ("name", *first), [(name, *row.values()) for name, row in figures.items()]
    else:
        columns, rows = ("what", "figure"), list(figures.items())
    table = Table(*columns, title=title, title_justify="left")
    for row in rows:
        table.add_row(*(f"{cell:,.3g}" if isinstance(cell, float) and abs(cell) < 1000 else f"{cell:,.0f}"
                        if isinstance(cell, float) else str(cell) for cell in row))  # fmt: skip
    console.print(table)


def main() -> None:
    """Measure, print each table as soon as it is there, and write them all as JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"), help="folder of the JSON file")
    parser.add_argument("--quick", action="store_true", help="leave out the largest size and the cold compile")
    parser.add_argument("--only", default="", metavar="WORD", help="measure only the tables with this in their title")
    options = parser.parse_args()
    parts = {title: part for title, part in parts_of(options.quick).items() if options.only in title}
    if not parts:
        parser.error(f"--only {options.only}: no table; there are {', '.join(parts_of(options.quick))}")
    console = Console()
    warnings.simplefilter("ignore", MisfitWarning)  # a load may be heavy for a motor: it is the time that counts
    result: dict[str, Any] = {}
    with Progress(console=console, transient=True) as progress:
        for title in progress.track(parts, description="tables"):
            result[title] = parts[title]()
            print_table(progress.console, title, result[title])
    result |= {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores",
        "versions": {name: version(name) for name in ("drive-env", "numpy", "numba", "mujoco")},
    }
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "benchmarks.json"
    path.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    console.print(f"written to {path}")


if __name__ == "__main__":
    main()
