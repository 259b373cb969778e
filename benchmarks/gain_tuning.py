"""Figures of GainTuning: steps per second and core, and trials of 250 ms, variants of the robust cost among them."""

from __future__ import annotations

import time

import numpy as np

from drive_env.envs.gain_tuning import GainTuning
from drive_env.trials.gain_trial import PHASES

FEW, MANY, STEPS = 8, 64, 12


def rates(load: str, environments: int) -> tuple[float, float]:
    """Return steps and trials per second on one core, with random actions, observation and reward included."""
    env = GainTuning(environments, load=load, num_threads=1, trials=STEPS)
    rng = np.random.default_rng(0)
    try:
        env.reset(seed=0)
        assert env._score is not None
        best = float("inf")  # as everywhere here: the fastest is the one least disturbed
        for _ in range(STEPS):
            action = rng.uniform(-0.7, 0.7, env.action_space.shape).astype(np.float32)
            start = time.perf_counter()
            env.step(action)
            best = min(best, time.perf_counter() - start)
        # A step runs the phases of one machine after another, the variants of the robust cost side by side.
        return environments / best, environments * (len(PHASES) + len(env._score.variants)) / best
    finally:
        env.close()


def figures() -> dict[str, float]:
    """Return all figures of GainTuning."""
    found = {}
    for load, count in (("two_mass", FEW), ("two_mass", MANY), ("belt", MANY)):
        steps, trials = rates(load, count)
        name = f"GainTuning, {load}, {count} environments, 1 core"
        found |= {f"{name}: env-steps/s": steps, f"{name}: trials of 250 ms/s": trials}
    return found
