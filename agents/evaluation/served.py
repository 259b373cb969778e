"""Machines drawn from a task's distributions, and their drives served on a bus as real ones would be.

In real time `drive-env serve` runs in a separate process, so that policy and drive share no interpreter; in lockstep it
runs in a thread of this process, since no time passes while it waits.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from drive_env.bus.config import Machine
from drive_env.drives.interface import Drives

STARTING = 180.0  # s until a served bus is up, including compilation of kernels missing in the cache
ENDING = 20.0  # s
_CHANNEL = re.compile(r'channel="(socket://[^"]+)"')


class ServeError(RuntimeError):
    """`drive-env serve` did not start; the message has its output."""


class Served(NamedTuple):
    """A machine on a bus: its address, and the emulated drives if they are in this process."""

    channel: str
    nodes: tuple[int, ...]
    drives: Drives | None = None


def draw_machines(config: Any, count: int, seed: int) -> list[Machine]:
    """Return machines of a task's configuration, drawn anew for each number; nodes are counted from 1.

    Properties without a key in a bus file keep their defaults: supply, temperatures, and the delays of the bus.

    Args:
        config: An environment's configuration; its distributions, or the shipped ones of its load.
        count: Number of machines.
        seed: Machine k of a seed is the same for any count.

    Raises:
        ValueError: For a load that is not a name, or friction that is not served.
    """
    from drive_env.emulator.emulated_drives import EmulatedDrives
    from drive_env.randomisation.random_machines import BESIDE, Distributions, RandomMachines, laws_of, shipped

    if not isinstance(config.load, str) or config.friction != "stribeck":
        raise ValueError(
            f"load {config.load} with friction {config.friction!r} is not served; take a load by name, with stribeck"
        )
    with EmulatedDrives(config.device, config.load, config.motor, count, num_threads=1) as drives:
        axes, laws = drives.load.num_axes, config.distributions
        if laws is None:
            laws = config.load if config.load in shipped() else {"parameters": {}}
        if isinstance(laws, str) and laws in shipped():
            laws = laws_of(laws, drives.device, drives.machine.parameters)
        random = RandomMachines(drives, Distributions.load(laws))
        random.redraw([np.random.default_rng((seed, k)) for k in range(count)])
        drawn = [name for name in random.distributions.laws if name not in BESIDE]
        return [
            Machine(
                config.device,
                config.load,
                config.motor,
                tuple(range(1, axes + 1)),
                parameters={name: float(random.values[name][k]) for name in drawn},
            )
            for k in range(count)
        ]


@contextmanager
def in_lockstep(machine: Machine, seed: int) -> Iterator[Served]:
    """Serve a machine in a thread of this process; time passes by SYNC."""
    from drive_env.bus.hub import Hub
    from drive_env.bus.server import Server
    from drive_env.bus.world import World

    drives = emulated(machine, seed)
    world = World()
    world.add(drives, machine.nodes)
    hub = Hub()
    try:
        with Server(world, hub):
            yield Served(hub.channel, machine.nodes, drives)
    finally:
        world.close()


@contextmanager
def in_real_time(machine: Machine, seed: int) -> Iterator[Served]:
    """Serve a machine by `drive-env serve` in real time, in a separate process.

    It has a separate bus, too, since the PDOs of several drives would fill 1 Mbit/s.

    Raises:
        ServeError: If it does not come up.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bus.toml"
        path.write_text(_bus_toml(machine, seed), encoding="utf-8")
        command = [sys.executable, "-c", "from drive_env.programs import drive_env; drive_env()", "serve"]
        process = subprocess.Popen(
            [*command, "--config", str(path), "--port", "0"],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        try:
            yield Served(_channel_of(process), machine.nodes)
        finally:
            process.terminate()
            try:
                process.wait(ENDING)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def emulated(machine: Machine, seed: int) -> Any:
    """Return the drives of a machine in this process: the same as those of a bus, noise included."""
    from drive_env.emulator.emulated_drives import EmulatedDrives

    return EmulatedDrives(
        machine.device, machine.load, machine.motor, seed=seed, parameters=machine.parameters, num_threads=1
    )


def _bus_toml(machine: Machine, seed: int) -> str:
    parameters = ", ".join(f'"{name}" = {value!r}' for name, value in machine.parameters.items())
    return f"""seed = {seed}
[[machines]]
device = "{machine.device}"
load = "{machine.load}"
motor = "{machine.motor}"
nodes = {list(machine.nodes)}
parameters = {{ {parameters} }}
"""


def _channel_of(process: subprocess.Popen[str]) -> str:
    """Return the channel that the process announces; its later lines are read and forgotten."""
    said: deque[str] = deque(maxlen=5)
    found: list[str] = []
    told = threading.Event()

    def listen(lines: IO[str]) -> None:
        for line in lines:
            said.append(line.strip())
            if (match := _CHANNEL.search(line)) and not found:
                found.append(match[1])
                told.set()
        told.set()

    assert process.stdout is not None
    threading.Thread(target=listen, args=(process.stdout,), name="serve", daemon=True).start()
    told.wait(STARTING)
    if not found:
        raise ServeError(f"drive-env serve did not start within {STARTING:g} s: {' | '.join(said) or 'no output'}")
    return found[0]
