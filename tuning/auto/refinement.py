"""Refine gains on the drives where the digital twins do not know the axis well enough.

Where the gains found on twins did not win against the rule's as these are, the axis has what no twin has: play,
friction that sticks, a second resonance. The drive itself then tells what is better: gains are changed by steps that
have helped such axes, each is tried as with a heavier load, too, and what is better must stand at rest. Nothing is
computed meanwhile, so that it is the same on a bus.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env.gains import cascade_columns
from drive_env.safety.envelope import SafetyError
from tuning.auto.bench import MOVE_TIME, TRIAL_TIME
from tuning.auto.choice import CLEARLY, reset, take
from tuning.auto.measured_margins import SENSITIVITY, SOUGHT, sensitivity

if TYPE_CHECKING:
    from tuning.auto.bench import AutoBench
    from tuning.auto.proving import ProvingGround
    from tuning.auto.stages import Basis, RecordedGains
    from tuning.target import Target

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

# What velocity P, velocity I, position P and torque P are multiplied by, in the order in which it is tried; what helps
# is tried again. On true machines with play, sticking friction or three masses the best gains that stand had 2 to 7
# times the rule's position P and 0.2 to 0.6 of its velocity I.
STEPS = np.array([
    (1.0, 0.65, 1.5, 1.0), (1.0, 1.0, 1.4, 1.0), (0.8, 1.0, 1.0, 1.0), (1.25, 1.0, 1.0, 1.0), (1.0, 0.65, 1.0, 1.0),
    (1.0, 1.0, 1.0, 1.6), (1.0, 1.5, 1.0, 1.0), (1.0, 1.0, 0.75, 1.0), (1.0, 1.0, 1.0, 0.6),
])  # fmt: skip
TRIES, BETTER = 12, 0.97  # trials at the most, and of the least J so far: what is better by less may be so by chance
OVERTIME = 22.0  # s beyond the budget


def refine(bench: AutoBench, basis: Basis, recorded: RecordedGains, target: Target) -> RecordedGains:
    """Refine the gains of machines of one axis whose twins did not find better ones than the rule's as these are.

    Args:
        bench: The drives.
        basis: What was identified.
        recorded: The gains, and what they have shown.
        target: The drives, whose time is not counted.
    """
    ground, where = bench.ground, to_refine(bench, recorded)
    if ground is None or recorded.shown is None or not where.any():
        return recorded
    try:
        climb = _Climb(bench, ground, basis, recorded, where)
        climb.run()
    except SafetyError as error:
        bench.note(where, f"the envelope stopped a trial of refined gains: {error}")
        return recorded
    # What they began with has made its trial once more, whatever became of it.
    recorded = replace(
        recorded,
        proof=np.where(where, climb.first, recorded.proof),
        proven=np.where(where[:, None], recorded.gains, recorded.proven),
    )
    better = bench.going & where & (climb.cost < CLEARLY * climb.first)
    if not better.any():
        return recorded
    taken, changed = take(bench, basis, recorded, climb.gains, better, climb.cost, target)
    for k in map(int, np.flatnonzero(changed)):
        bench.journals[k].note(
            f"gains refined in {climb.tries[k]} trials on the drive, of which its digital twins do not know enough: "
            f"the measured cost J of a trial fell from {climb.first[k]:.2f} to {climb.cost[k]:.2f}"
        )
    return taken


def to_refine(bench: AutoBench, recorded: RecordedGains) -> Mask:
    """Return the axes that are refined, (num_axes,): those whose margins with other gains the measured loop tells."""
    if bench.target.axes_per_machine > 1 or recorded.response is None:
        return np.zeros(bench.target.num_axes, bool)
    lowered = np.zeros_like(recorded.won) if recorded.rule is None else recorded.rule.lowered
    searched = np.isfinite(recorded.cost)  # what an agent has tried on the drive is its own
    return np.asarray(bench.going & searched & ~(recorded.won & ~lowered) & ~recorded.kept & ~recorded.unseen)


class _Climb:
    """A climb of each axis by steps of `STEPS`.

    Attributes:
        gains: The best so far, (num_axes, count).
        first, cost: J of a trial with those at the beginning and with the best so far, (num_axes,).
        tries: Trials after the first, (num_axes,).
    """

    def __init__(
        self, bench: AutoBench, ground: ProvingGround, basis: Basis, recorded: RecordedGains, where: Mask
    ) -> None:
        self._bench, self._ground, self._basis, self._recorded = bench, ground, basis, recorded
        self._where = where
        self.gains = recorded.gains.copy()
        self.first = self.cost = np.full(bench.target.num_axes, np.inf)
        self.tries = np.zeros(bench.target.num_axes, np.int64)
        self._step = np.zeros(bench.target.num_axes, np.int64)  # the number of each axis' next
        self._since = np.zeros(bench.target.num_axes, np.int64)  # steps since one has helped

    def run(self) -> None:
        """Climb until no step helps, the time is over, or the trials are used up."""
        self.first = self.cost = self._trial(self.gains, self._where)
        open_ = self._where & np.isfinite(self.first)
        while open_.any():
            tried, open_ = self.gains.copy(), open_ & self._bench.affordable(TRIAL_TIME + MOVE_TIME - OVERTIME)
            for k in map(int, np.flatnonzero(open_)):
                gains = self._next(k)
                open_[k] = gains is not None
                tried[k] = tried[k] if gains is None else gains
            if not open_.any():
                break
            self.tries[open_] += 1
            cost = self._trial(tried, open_)
            better = open_ & (cost < BETTER * self.cost) & self._stand(tried, open_ & (cost < BETTER * self.cost))
            self.gains = np.where(better[:, None], tried, self.gains)
            self.cost = np.where(better, cost, self.cost)
            self._step = np.where(open_ & ~better, (self._step + 1) % len(STEPS), self._step)
            self._since = np.where(better, 0, self._since + open_)
            open_ = open_ & self._bench.going & (self.tries < TRIES) & (self._since < len(STEPS))

    def _next(self, k: int) -> Integers | None:
        """Return the next gains of an axis that are far enough from instability by its measured loop, None if none."""
        target, columns = self._bench.target, cascade_columns(self._bench.target.device)
        torque_p, _, velocity_p, velocity_i, position_p = columns
        response = self._recorded.response
        assert response is not None, "it was measured"
        highest = target.device.gains.highest
        now = sensitivity(target, self._basis, response, self.gains[k], k)
        while self._since[k] < len(STEPS):
            row = self.gains[k].astype(float)
            row[[velocity_p, velocity_i, position_p, torque_p]] *= STEPS[self._step[k]]
            gains: Integers = np.clip(np.rint(row), 1, highest).astype(np.int64)
            near = sensitivity(target, self._basis, response, gains, k)
            if not np.array_equal(gains, self.gains[k]) and (near <= SOUGHT or near <= min(now, SENSITIVITY)):
                return gains
            self._step[k] = (self._step[k] + 1) % len(STEPS)
            self._since[k] += 1
        return None

    def _trial(self, gains: Integers, where: Mask) -> Floats:
        """Return J of a trial of axes, infinite where it did not pass, (num_axes,)."""
        with self._bench.spending(where):
            proof = self._ground.run(gains, where, heavier=True)
        faulted = self._reset()
        return np.where(where & proof.passed & ~faulted, proof.cost, np.inf)

    def _stand(self, gains: Integers, where: Mask) -> Mask:
        """Return which axes pass a move with gains, and stand at rest after it."""
        if not where.any():
            return where
        with self._bench.spending(where):
            moved = self._ground.show(gains, where)
        failed = np.array([bool(why) for why in moved.reason]) | self._reset()
        return np.asarray(where & ~failed & ~moved.restless)

    def _reset(self) -> Mask:
        """Reset the faults of axes, which are the tried gains' doing; return which had one."""
        return reset(self._bench, "gains were refined, and the fault cannot be reset")
