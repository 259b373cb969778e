"""A sweep of three shards as a process, for tests that interrupt it."""

from __future__ import annotations

import subprocess
import sys
import time

from rigs.served_drives import environment
from tuning.runs.unfinished import SHARDS, unfinished_folder

PATIENCE = 300.0  # s, for a computer that stands still for minutes


# 2304 points in three shards, 100 ms each.
GRID = """
device = "tmcm1636"
motor = "qbl4208"
load = "inertia"
seed = 3

[[sweep]]
object = "2042h:01"
low = 100
high = 3000
count = 48
spacing = "log"

[[sweep]]
object = "2042h:02"
low = 100
high = 3000
count = 48
spacing = "log"

[excitation]
velocity_rpm = 1000.0
velocity_time = 0.01
acceleration_rpm_per_s = 100000.0
load_torque = -0.05
load_time = 0.06
duration = 0.1
sampling_period = 0.001

[metric]
name = "iae"
"""
FILES = ("results.csv", "settings.toml", "heatmap.png", "best_response.png")


def contents(folder):
    return {name: (folder / name).read_bytes() for name in FILES}


def arguments(config, out, *more):
    return [
        sys.executable,
        "-m",
        "tuning.commands.cli",
        "sweep",
        "--config",
        str(config),
        "--out",
        str(out),
        *map(str, more),
    ]


def run_command(config, out, *more):
    return subprocess.run(
        arguments(config, out, *more), env=environment(), capture_output=True, text=True, timeout=PATIENCE, check=False
    )


def start_and_wait_for_a_shard(config, out, *more):
    """Return the command, running, with at least one shard done and the rest not."""
    log = unfinished_folder(out) / SHARDS
    process = subprocess.Popen(
        arguments(config, out, *more), env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    deadline, size, before = time.monotonic() + PATIENCE, 0, -1
    # A shard counts once it is written whole: a run that is killed before leaves nothing to continue from.
    while not (size > 1000 and size == before) and process.poll() is None:
        assert time.monotonic() < deadline, "no shard was done"
        time.sleep(0.01)
        size, before = log.stat().st_size if log.exists() else 0, size
    return process
