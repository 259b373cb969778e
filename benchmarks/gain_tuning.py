"""Figure of GainTuning: trials of 250 ms per second and core, the robust cost's variants counted as trials."""

from __future__ import annotations

import time

import numpy as np

from drive_env.envs.gain_tuning import GainTuning
from drive_env.trials.gain_trial import PHASES

LANES, STEPS = 64, 12


def trials_per_second(load: str = "two_mass", lanes: int = LANES) -> float:
    """Return trials per second on one core, with random actions, observation and reward included."""
    env = GainTuning(lanes, load=load, num_threads=1, trials=STEPS)
    rng = np.random.default_rng(0)
    try:
        env.reset(seed=0)
        assert env._score is not None
        # A step runs the phases of one machine after another, the variants of the robust cost side by side.
        trials = lanes * (len(PHASES) + len(env._score.variants))
        best = float("inf")  # as everywhere here: the fastest is the one least disturbed
        for _ in range(STEPS):
            action = rng.uniform(-0.7, 0.7, env.action_space.shape).astype(np.float32)
            start = time.perf_counter()
            env.step(action)
            best = min(best, time.perf_counter() - start)
        return trials / best
    finally:
        env.close()


def figures() -> dict[str, float]:
    """Return all figures of GainTuning."""
    return {
        f"{load}, {LANES} environments, 1 core [trials of 250 ms/s]": trials_per_second(load)
        for load in ("two_mass", "belt")
    }
