"""Fit the rule of drive_env/gains.py: `python -m research.fit_rule` tries sets of constants on random machines.

Every set of constants is scored by the mean of ln robust cost over all machines of all loads: the mean of a logarithm,
so that a machine's own scale does not count.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drive_env.dictionary.roles import Role
from drive_env.emulator.emulated_drives import EmulatedDrives
from drive_env.envs.randomisation import Distributions, RandomMachines
from drive_env.gains import BASELINE_RULE, Rule, rule_gains
from drive_env.trials.positioning import plan_move, reach
from drive_env.trials.score import RobustScore, Scores
from mechanics.shaft import shaft_load

Floats = NDArray[np.float64]

LOADS = ("inertia", "two_mass", "three_mass", "belt", "ball_screw", "geared_joint")
# Low and high of each constant; drawn log-uniformly but for the exponent. Torque is computed from R and L, not fitted.
RANGES = {"speed": (0.03, 0.6), "inertia": (0.0, 2.0), "integration": (1.0, 40.0), "position": (0.1, 1.0)}
SETS, LOCAL = 150, 60  # sets, of which the last are drawn around the best so far
SPREAD = 0.12  # of a local draw, as a share of the range


class RuleFit(NamedTuple):
    """A set of constants and its mean of ln robust cost."""

    rule: Rule
    score: float


class Bench:
    """Random machines of one load, ready to be scored with a rule."""

    def __init__(self, load: str, motor: str, machines: int, seed: int, num_threads: int | None = None) -> None:
        with EmulatedDrives(load=load, motor=motor, num_machines=machines, num_threads=1) as drives:
            drawn = RandomMachines(drives, Distributions.load(load))
            drawn.redraw([np.random.default_rng((seed, lane)) for lane in range(machines)])
            self.device, self.motor = drives.device, drives.motor
            loads = [shaft_load(group.load).inertia + group.load.armature for group in drives.inside.groups]
            self.inertia: Floats = np.concatenate(loads).reshape(-1)
            axes = drives.load.num_axes
            self.score_of = RobustScore("tmcm1636", load, motor, machines, num_threads=num_threads)
            self.score_of.set_machines(drives.machine.parameters, drives.machine.supply.reshape(machines, axes)[:, 0])
            scaler = drives.read(Role.POSITION_SCALE)
            self.score_of.set_moves(plan_move(self.motor, self.inertia, scaler, np.tile(reach(load), machines)))

    def score(self, rule: Rule) -> Scores:
        """Return the scores of a rule's gains on these machines."""
        return self.score_of.score(rule_gains(self.device, self.motor, self.inertia, rule))


def candidates(seed: int, best: list[RuleFit]) -> Iterator[Rule]:
    """Yield sets of constants, at first over the whole ranges, then around the first of `best`, which the caller keeps.

    The constants in force come first, so that a fit never ends worse.
    """
    rng = np.random.default_rng(seed)
    yield BASELINE_RULE
    for k in range(1, SETS):
        constants = {}
        for name, (low, high) in RANGES.items():
            log = low > 0.0
            a, b = (math.log(low), math.log(high)) if log else (low, high)
            if k < SETS - LOCAL:
                value = rng.uniform(a, b)
            else:
                now = getattr(best[0].rule, name)
                value = (math.log(now) if log else now) + SPREAD * (b - a) * rng.standard_normal()
                value = min(max(value, a), b)
            constants[name] = math.exp(value) if log else value
        yield BASELINE_RULE._replace(**constants)


def fit(benches: list[Bench], seed: int = 0) -> list[RuleFit]:
    """Return all sets that were tried, the best first."""
    best: list[RuleFit] = []
    for rule in candidates(seed, best):
        logs = np.concatenate([np.log(bench.score(rule).robust_cost) for bench in benches])
        best.append(RuleFit(rule, float(logs.mean())))
        best.sort(key=lambda one: one.score)
    return best


def main() -> None:
    """Fit, and print the constants and what they are worth on machines that were not fitted to."""
    parser = argparse.ArgumentParser(prog="python -m research.fit_rule", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--machines", type=int, default=48, help="machines of each load (48)")
    parser.add_argument("--motor", default="qbl4208", help="motor (qbl4208)")
    parser.add_argument("--seed", type=int, default=0, help="seed of machines and constants (0)")
    options = parser.parse_args()
    found = fit([Bench(load, options.motor, options.machines, options.seed) for load in LOADS], options.seed)
    best = found[0]
    print(best.rule, f"mean ln robust cost {best.score:.3f}; before {dict(found)[BASELINE_RULE]:.3f}")
    for load in LOADS:
        bench = Bench(load, options.motor, options.machines, options.seed + 1)
        scores = bench.score(best.rule)
        low, middle, high = np.percentile(scores.robust_cost, (5, 50, 95))
        print(f"{load}: robust cost {middle:.2f} ({low:.2f} ... {high:.2f}) on {options.machines} unseen machines")


if __name__ == "__main__":
    main()
