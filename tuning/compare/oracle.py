"""The constrained oracle of emulated machines: the best gains that keep the constraints, by search on the truth.

No tuner can find them by experiments. They are searched on the true machine by its true robust cost: random sets of
gains over all bandwidths, then differential evolution (Storn and Price, doi:10.1023/A:1008202821328, with the steps
towards the best of JADE, doi:10.1109/TEVC.2009.2014613). The gains of all axes of a machine are searched together. The
crossover of the current loop is limited to between 0.3 and 1 times that with 60 degrees of phase margin, since the
constraints are those of the outer loops.

The gains of the suites' machines for standard dynamics are stored in oracles.csv. They are scored again whenever they
are used: a row that no longer fits its machine or the score is detected, and searched again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drive_env.devices.gains import has_linear_model, si_scales
from drive_env.loops.dynamics import DEFAULT, Dynamics, find_dynamics
from drive_env.loops.true_plant import terminal_resistance
from drive_env.whole_file import write_table
from mechanics.arrays import Floats, Integers, Mask
from mechanics.reading.untrusted import read_rows
from tuning.auto.design import CURRENT_CROSSOVER, CURRENT_LAG, LEAST_TORQUE
from tuning.compare.suite import SuiteMachine, groups
from tuning.compare.yardstick import REPEATS, Yardstick

KEPT = Path(__file__).with_name("oracles.csv")
HEAD = ("device", "machine", "digest", "gains", "performance", "slack")
STALE = 0.05  # relative: a stored performance that differs by more belongs to an outdated score
POPULATION, REPEATED = 48, 3  # sets of gains, and runs of each with other moves and noise
DRAWS = 2304  # random sets of a machine of one axis; fewer with more axes
GENERATIONS = {1: 45, 2: 45}  # by number of axes
MANY_AXES = 12  # generations for machines with more axes: each takes seconds
BANDS = 16  # of bandwidth; the best draws of each are in the first population
# Natural logarithms of the draws' gains over the baseline rule's: of all outer gains together, and of each one
# separately.
TOGETHER, EACH = (-2.5, 2.2), (-1.2, 1.2)
FINALISTS = 16  # of the last population, scored with all repeats
SPREAD = 0.01  # relative spread of cost in the better half of the population at which the search ends


class Oracle(NamedTuple):
    """The best gains of a machine, raw, shape (axes, count), their robust performance, and their slack."""

    gains: Integers
    performance: float
    slack: float


def find_oracles(
    machines: Sequence[SuiteMachine],
    num_threads: int | None = None,
    progress: Callable[[float], None] = lambda share: None,
    kept: Path | None = KEPT,
    dynamics: str | Dynamics = DEFAULT,
) -> dict[str, Oracle]:
    """Return the oracles of machines by name: the stored ones that are still valid, and newly searched ones.

    Oracles are stored for standard dynamics only.

    Args:
        machines: Machines of a suite, or your own.
        num_threads: As in `EmulatedDrives`.
        progress: Called with the share that is done.
        kept: File of the stored oracles; None searches all.
        dynamics: Requirements on the loops.
    """
    rows = {} if kept is None or not are_kept(dynamics) else read_oracles(kept)
    found: dict[str, Oracle] = {}
    known = [machine for machine in machines if digest(machine) in rows]
    for indices in groups(known):
        group = [known[k] for k in indices]
        gains = np.concatenate([rows[digest(machine)].gains for machine in group])
        with closing(Yardstick(group, num_threads)) as yardstick:
            scores = yardstick.score(gains)
        for k, machine in enumerate(group):
            row, now = rows[digest(machine)], float(scores.performance[k])
            # If no gains keep a machine's constraints, its row stays valid.
            if (scores.slack[k] > 0.0 or row.slack <= 0.0) and abs(now / row.performance - 1.0) < STALE:
                found[machine.name] = row._replace(performance=now, slack=float(scores.slack[k]))
    left = [machine for machine in machines if machine.name not in found]
    for number, machine in enumerate(left):
        progress(number / len(left))
        found[machine.name] = search_oracle(machine, num_threads, dynamics=dynamics)
    progress(1.0)
    return found


def are_kept(dynamics: str | Dynamics) -> bool:
    """Return whether the file stores oracles for these dynamics."""
    return replace(find_dynamics(dynamics), name=DEFAULT) == find_dynamics(DEFAULT)


def search_oracle(
    machine: SuiteMachine, num_threads: int | None = None, seed: int = 0, dynamics: str | Dynamics = DEFAULT
) -> Oracle:
    """Search the oracle of a machine; the seed determines the random draws."""
    rng = np.random.default_rng(seed)
    # Gains that come to rest at some positions may limit-cycle at others: if all do, the search counts every run.
    for repeats in (REPEATED, REPEATS):
        with closing(Yardstick([machine], num_threads, repeats, POPULATION, dynamics)) as yardstick:
            last = _evolved(yardstick, _Box.of(yardstick), rng)
        with closing(Yardstick([machine], num_threads, copies=FINALISTS, dynamics=dynamics)) as yardstick:
            scores = yardstick.score(last[:FINALISTS].reshape(-1, last.shape[-1]))
        best = int(scores.robust_cost.argmin())
        if scores.slack[best] > 0.0:
            break
    return Oracle(last[best], float(scores.performance[best]), float(scores.slack[best]))


class _Box(NamedTuple):
    """The searched range: logarithms of raw gains, shape (axes, count). outer: Columns of the outer loops."""

    rule: Floats
    least: Floats
    most: Floats
    outer: Mask

    @classmethod
    def of(cls, yardstick: Yardstick) -> _Box:
        """Return the range for a machine."""
        device, axes = yardstick.device, yardstick.axes
        rule = np.log(np.maximum(yardstick.rule_gains[:axes], 1).astype(float))
        least, most = np.zeros_like(rule), np.log(np.broadcast_to(device.gains.highest, rule.shape).astype(float))
        if has_linear_model(device):
            L = float(yardstick.parameters["motor.L_q"][0])
            R = float(terminal_resistance(yardstick.parameters, yardstick.motor.kind)[0])
            for axis in range(axes):
                scales = si_scales(device, float(yardstick.supply[axis]))
                p, i = device.gains.column("current", "P"), device.gains.column("current", "I")
                most[axis, p] = rule[axis, p] = np.log(
                    scales["current", "P"].raw(CURRENT_CROSSOVER * device.current_rate / CURRENT_LAG * L)
                )
                least[axis, p] = most[axis, p] + np.log(LEAST_TORQUE)
                # Zero of the PI at the pole of the winding.
                least[axis, i] = most[axis, i] = rule[axis, i] = np.log(
                    max(float(scales["current", "I"].raw(R / L)), 1.0)
                )
        outer = np.array([row.loop != "current" for row in device.gains.rows])
        # Not below the draws: a load step is too short to show that an axis without integral does not return.
        least[:, outer] = (rule + device.gains.powers * (TOGETHER[0] + EACH[0]))[:, outer].clip(min=0.0)
        return cls(rule, least, most, outer)

    def whole(self, x: Floats) -> Integers:
        """Convert points to raw gains, shape (points, axes, count)."""
        return np.rint(np.exp(np.clip(x, self.least, self.most))).astype(np.int64)


def _evolved(yardstick: Yardstick, box: _Box, rng: np.random.Generator) -> Integers:
    """Return the last population, shape (sets, axes, count), the best first."""

    def cost(x: Floats) -> Floats:
        gains = box.whole(x)
        return yardstick.score(gains.reshape(-1, gains.shape[-1])).robust_cost

    x = _first(yardstick, box, rng)
    worth = cost(x)
    n, axes = len(x), yardstick.axes
    for _ in range(GENERATIONS.get(axes, MANY_AXES)):
        order = np.argsort(worth, kind="stable")
        if worth[order[n // 2]] < (1.0 + SPREAD) * worth[order[0]]:
            break
        best = x[order[rng.integers(0, n // 8, n)]]
        first, second = x[rng.integers(0, n, n)], x[rng.integers(0, n, n)]
        F = rng.uniform(0.4, 0.9, (n, 1, 1))
        # Half of the trials change one axis only: what suits an axis may not suit another.
        alone = np.arange(axes) == rng.integers(0, axes, (n, 1))
        crossed = (rng.random((n, 1)) < 0.5) | alone
        new = np.where(crossed[..., None], x + F * (best - x) + F * (first - second), x)
        new = np.clip(new, box.least, box.most)
        found = cost(new)
        better = found < worth
        x, worth = np.where(better[:, None, None], new, x), np.where(better, found, worth)
    return box.whole(x[np.argsort(worth, kind="stable")])


def _first(yardstick: Yardstick, box: _Box, rng: np.random.Generator) -> Floats:
    """Return the first population: in each band of bandwidth the most promising draws that keep the constraints."""
    rounds = max(DRAWS // (POPULATION * yardstick.axes), 4)
    shape = (rounds * POPULATION, *box.rule.shape)
    together = rng.uniform(*TOGETHER, (shape[0], 1, 1)) * box.outer
    powers = yardstick.device.gains.powers
    # The same draw for all axes of a machine, in each axis' own scale.
    reach = powers * (together + rng.uniform(*EACH, (shape[0], 1, shape[2])))
    x = np.clip(box.rule + reach, box.least, box.most)
    gains = box.whole(x)
    slack = np.concatenate([yardstick.loop_slack(part.reshape(-1, shape[2])) for part in np.split(gains, rounds)])
    promise = -(x * powers * box.outer).sum(axis=(1, 2))
    band = np.digitize(together.max(axis=(1, 2)) + together.min(axis=(1, 2)), np.linspace(*TOGETHER, BANDS + 1)[1:-1])
    order = np.lexsort((np.where(slack > 0.0, promise, 1e9 - slack), band))
    place = np.concatenate([np.arange(np.count_nonzero(band == k)) for k in range(BANDS)])  # within its band
    chosen = order[np.argsort(place, kind="stable")[:POPULATION]]
    return np.asarray(x[chosen])


# --- the file ---------------------------------------------------------------------------------------------------------
def digest(machine: SuiteMachine) -> str:
    """Return a hash of all fields of a machine."""
    return hashlib.sha256(repr(machine).encode()).hexdigest()[:16]


def read_oracles(path: Path = KEPT) -> dict[str, Oracle]:
    """Read oracles from a file, by the digest of their machine."""
    found = {}
    for _, _, key, gains, performance, slack in islice(read_rows(path), 1, None):
        axes = np.array([axis.split() for axis in gains.split("|")], np.int64)
        found[key] = Oracle(axes, float(performance), float(slack))
    return found


def write_oracles(path: Path, machines: Iterable[SuiteMachine], oracles: dict[str, Oracle]) -> None:
    """Write the oracles of machines: gains of an axis in the order of the drive's set, axes separated by |."""
    rows = []
    for machine in machines:
        found = oracles[machine.name]
        gains = " | ".join(" ".join(map(str, axis)) for axis in found.gains)
        figures = f"{found.performance:.4g}", f"{found.slack:.4g}"
        rows.append((machine.device, machine.name, digest(machine), gains, *figures))
    write_table(path, [HEAD, *rows], "\n")
