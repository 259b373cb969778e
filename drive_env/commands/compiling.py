"""`drive-env compile`: compile the kernels in advance, so that the first run does not wait for it."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Annotated

import typer

from drive_env.commands.options import Json, errors_as_exit_codes, print_result
from drive_env.commands.progress import progress_on
from drive_env.default_device import DEFAULT_DEVICE


def compile_kernels(
    devices: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[DEVICE]...", help="Devices by name, or your own by path.", show_default=DEFAULT_DEVICE
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Compile the kernels of devices and store them, so that no program waits half a minute for its first result.

    Once is enough for an installation: kernels are kept in the user's cache, or in DRIVE_ENV_CACHE, under a hash of
    the sources that they are made from. Do it in advance for workers of a cluster, and in a container's image.
    """
    from rich.console import Console

    from mechanics.kernels.compiled import user_cache_folder

    with errors_as_exit_codes():
        steps = _steps(devices or [DEFAULT_DEVICE])
        folder = user_cache_folder()
        before, began = set(folder.rglob("*.kernel")), time.monotonic()
        with progress_on(Console(stderr=True), transient=True) as progress:
            task = progress.add_task("", total=float(len(steps)))
            for name, use in steps.items():
                progress.update(task, description=f"kernels of {name}")
                use()
                progress.advance(task)
        after = set(folder.rglob("*.kernel"))
        if not after:
            raise OSError(f"no kernel could be stored in {folder}; set DRIVE_ENV_CACHE to a writable folder")
        compiled = len(after - before)
        seconds = time.monotonic() - began
    told = f"compiled {compiled} kernels in {seconds:.0f} s; they are stored in {folder}"
    if not compiled:
        told = f"nothing to compile: the kernels of these sources are in {folder}"
    print_result({"compiled": compiled, "seconds": round(seconds, 1), "folder": str(folder)}, [told], json)


def _steps(devices: list[str]) -> dict[str, Callable[[], None]]:
    """Return the steps that compile the kernels of devices, by their titles on the progress bar.

    Raises:
        ValueError: For an unknown device.
    """
    from drive_env.devices import find_device

    found = [(find_device(name).name, name) for name in devices]
    return {title: partial(_use_drives, name) for title, name in found} | {"environments": _use_environments}


def _use_drives(device: str) -> None:
    """Run emulated drives like other programs, also on a bus; the third call of `record` is a prepared one."""
    from drive_env import EmulatedDrives, motion
    from drive_env.bus.world import World

    with EmulatedDrives(device=device) as drives:
        World(lockstep=True).add(drives, [1])
        motion.enable(drives, "csv")
        for _ in range(3):
            drives.record(["Statusword"], 0.002, play={"Target velocity": [[0] * drives.num_axes] * 2})


def _use_environments() -> None:
    """Take a step in environments whose bus has delays."""
    import gymnasium
    import numpy as np

    import drive_env.envs  # noqa: F401  # it registers them

    with_delays = gymnasium.make_vec("ServoDrive/Tracking-v0", num_envs=2, distributions="two_mass")
    try:
        with_delays.reset(seed=0)
        with_delays.step(np.zeros(with_delays.action_space.shape, np.float32))
    finally:
        with_delays.close()
