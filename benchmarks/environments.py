"""Figures of the environments: Tracking vectorised and single, GainScheduling, memory.

What is compared is measured in turn, so that a slower moment of the machine slows both.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from drive_env.envs.gain_scheduling import GainScheduling
from drive_env.envs.tracking import Tracking
from drive_env.envs.vector_environment import SingleEnvironment

LANES = 64
MANY_ENVS = 1024
ROUNDS = 12
MEMORY = (
    "import re, sys, numpy as np; from pathlib import Path; from drive_env.envs.tracking import Tracking;"
    "n = int(sys.argv[1]); envs = Tracking(n, num_threads=1); envs.reset(seed=0);"
    "[envs.step(np.zeros((n, 1), np.float32)) for _ in range(5)];"
    "print(re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text())[1])"
)


def times_in_turn(functions: list[Callable[[], Any]], calls: int) -> list[float]:
    """Return the shortest time of a call of each function [s]."""
    best = [float("inf")] * len(functions)
    for _ in range(ROUNDS):
        for k, function in enumerate(functions):
            start = time.perf_counter()
            for _ in range(calls):
                function()
            best[k] = min(best[k], (time.perf_counter() - start) / calls)
    return best


def random_steps(lanes: Tracking) -> Callable[[], Any]:
    """Return a function that takes one step with random actions."""
    given = np.random.default_rng(0).uniform(-1, 1, (256, *(lanes.action_space.shape or ()))).astype(np.float32)
    count = iter(range(10**9))
    return lambda: lanes.step(given[next(count) % 256])


def vectorised(num_envs: int, threads: tuple[int, ...], calls: int) -> dict[str, float]:
    """Return env-steps/s, whole episodes with their resets included, and overhead over bare `advance`."""
    found: dict[str, float] = {}
    sets = [Tracking(num_envs, num_threads=count) for count in threads]
    functions: list[Callable[[], Any]] = []
    for lanes in sets:
        lanes.reset(seed=0)
        functions += [random_steps(lanes), lambda drives=lanes.drives: drives.advance(0.001)]
    times = times_in_turn(functions, calls)
    whole = []
    for lanes, step in zip(sets, functions[::2], strict=True):
        lanes.reset(seed=0)
        episode = lanes.config.steps + 1
        rounds = 3 if num_envs == LANES else 1
        whole.append(min(times_in_turn_once(step, episode) for _ in range(rounds)))
    for k, count in enumerate(threads):
        name = f"Tracking, two_mass, {num_envs} environments, {count} thread{'s' if count > 1 else ''}"
        found[f"{name}: env-steps/s"] = num_envs / times[2 * k]
        found[f"{name}: env-steps/s with autoreset"] = num_envs / whole[k]
        found[f"{name}: overhead over advance"] = times[2 * k] / times[2 * k + 1] - 1.0
    if len(threads) > 1:
        found[f"Tracking, two_mass, {num_envs} environments: two threads over one"] = times[0] / times[2]
    for lanes in sets:
        lanes.close()
    return found


def times_in_turn_once(function: Callable[[], Any], calls: int) -> float:
    """Return the mean time of a call [s]."""
    start = time.perf_counter()
    for _ in range(calls):
        function()
    return (time.perf_counter() - start) / calls


def gain_scheduling() -> dict[str, float]:
    """Return steps/s of 10 ms, their overhead over bare `advance`, and the time of a reset of all environments [ms]."""
    lanes = GainScheduling(LANES, num_threads=1)
    lanes.reset(seed=0)
    given = np.random.default_rng(0).uniform(-1, 1, (256, *(lanes.action_space.shape or ()))).astype(np.float32)
    count = iter(range(10**9))
    # 150 calls in a row, so that payloads change as often as they do.
    functions = [lambda: lanes.step(given[next(count) % 256]), lambda: lanes.drives.advance(lanes.config.step)]
    step, advance = times_in_turn(functions, 150)
    (reset,) = times_in_turn([lanes.reset], 1)
    lanes.close()
    name = f"GainScheduling, {lanes.config.load}, {LANES} lanes"
    return {
        f"{name}: env-steps/s of 10 ms": LANES / step,
        f"{name}: overhead over advance": step / advance - 1.0,
        f"{name}: reset [ms]": reset * 1e3,
    }


def alone() -> dict[str, float]:
    """Return steps/s of the single environment, and of bare `advance` of its drives."""
    env = SingleEnvironment(Tracking(1, autoreset_mode="Disabled", num_threads=1, duration=1e6 / 1000))
    env.reset(seed=0)
    action = np.zeros(1, np.float32)
    drives = env.vector.drives  # type: ignore[attr-defined]
    step, advance = times_in_turn([lambda: env.step(action), lambda: drives.advance(0.001)], 300)
    env.close()
    return {"Tracking, single Env.step/s": 1.0 / step, "Tracking, single, bare advance/s": 1.0 / advance}


def memory() -> dict[str, float]:
    """Return the largest memory of a process with many environments and with one [MB]; on Linux only."""
    if sys.platform != "linux":
        return {}
    found = {}
    for lanes in (1, MANY_ENVS):
        run = subprocess.run([sys.executable, "-c", MEMORY, str(lanes)], capture_output=True, text=True, check=True)
        found[f"memory of a process, {lanes} environments [MB]"] = int(run.stdout) / 1024
    return found


def figures() -> dict[str, float]:
    """Return all figures of the environments."""
    return {
        **vectorised(LANES, (1,), 200),
        **vectorised(MANY_ENVS, (1, 2), 20),
        **alone(),
        **gain_scheduling(),
        **memory(),
    }


if __name__ == "__main__":
    for name, figure in figures().items():
        print(f"{name:75} {figure:12,.3f}")
