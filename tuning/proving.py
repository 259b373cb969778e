"""Gains on trial: a move, its reversal and the gain probe on the drives themselves, and what they prove.

What oscillates or trips is stopped within 50 ms and goes on with the gains that are known to hold. On a bus the
envelope may be faster: it quick-stops all drives, so that the trial is repeated axis by axis to see which one it was.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drive_env import motion
from drive_env.envs.gain_trial import PHASES, Trial, Trials, measured_cost, softness
from drive_env.gains import small_time_constants, write_gains
from drive_env.positioning import (
    CURRENT,
    CYCLE,
    DEMAND,
    POSITION,
    TRIAL,
    Move,
    plan_move,
    start,
    wrapped,
    write_profile,
)
from drive_env.safety import SafetyError
from drive_env.score import TRIP, Terms

if TYPE_CHECKING:
    from tuning.linear_model import Plant
    from tuning.target import Target

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

ASTRAY = 0.2  # of the move: what is still farther away at a trial's end does not pass
# Of the move, and of the encoder: an axis farther than both from where a trial starts is brought back first.
NEAR, NEAR_COUNTS = 0.03, 5.0
RETURN_LOOKS, RETURN_LOOK = 8, 0.05  # looks whether it is back, and the time between them [s]
OVERSHOOT = 0.6  # of the move: what overshoots by more is called unstable
ENABLING = 5.0  # s, the longest wait for an axis that is switched on: some align their encoder first
SHORTEST = 16.0  # counts of the encoder: a move that is shorter proves nothing


class Proof(NamedTuple):
    """What a trial showed of every axis, each of shape (num_axes,).

    cost: J by measured terms. stopped: Whether it oscillated, tripped, or left its envelope in any phase.
    in_probe_only: Whether that was with the probe's velocity P alone.
    reason: Why it does not pass, "" if it does. ripple: RMS increment of the current over the rated one, of the worst
    phase. overshoot: Of the move, the largest of move and reversal. settling: t_s/t_0, mean of move and reversal.
    """

    cost: Floats
    stopped: Mask
    in_probe_only: Mask
    reason: tuple[str, ...]
    ripple: Floats
    overshoot: Floats
    settling: Floats

    @property
    def passed(self) -> Mask:
        """Which axes passed, shape (num_axes,)."""
        return np.array([not reason for reason in self.reason])


class Shown(NamedTuple):
    """A recorded move: times [s], (n,); demand and actual angle from its start [rad] and current [A], (n, num_axes)."""

    t: Floats
    demand: Floats
    actual: Floats
    current: Floats


@contextmanager
def shaken_on_purpose(drives: Any) -> Iterator[None]:
    """Keep the envelope of a bus from taking an excitation for an oscillation; its other limits stay in force."""
    envelope = getattr(drives, "safety", None)
    if envelope is None:
        yield
        return
    limits = envelope.limits
    envelope.limits = replace(limits, oscillation=False)
    try:
        yield
    finally:
        envelope.limits = limits


class ProvingGround:
    """Trials on a target, from where its axes stand, the longer way, each in its own travel.

    Args:
        target: The drives.
        plants: What each axis is; None where that is not known: such an axis takes no part.
        room: How far each rotor may turn from here [rad], low and high, each (num_axes,).
        safe: Gains that hold, (num_axes, 5): what is stopped goes on with them.
        reference: Gains whose softness under a load counts as 1, (num_axes, 5).
    """

    def __init__(
        self,
        target: Target,
        plants: Sequence[Plant | None],
        room: tuple[Floats, Floats],
        safe: Integers,
        reference: Integers,
    ) -> None:
        self.target = target
        self.safe = safe
        self._reference = reference
        low, high = room
        self.reach: Floats = np.where(high >= -low, high, low)
        motor, drives = target.motor, target.drives
        inertia = np.array([motor.inertia if plant is None else plant.inertia for plant in plants])
        corner = [target.device.stage["velocity_filter"].default if p is None else p.velocity_filter for p in plants]
        self.move: Move = plan_move(motor, inertia, drives.read((0x2058, 0)), self.reach)
        t_0 = 4.0 * small_time_constants(target.device, np.array(corner))
        self._trials = Trials(drives, motor, target.axes_per_machine, t_0)  # type: ignore[arg-type]
        self._origin = drives.read(POSITION)
        self._direction = np.ones(target.num_axes, np.int64)
        self._shaken = np.zeros(target.num_axes, bool)
        self.moves = np.zeros(target.num_axes, np.int64)
        self.aborts = np.zeros(target.num_axes, np.int64)
        self.violations = np.zeros(target.num_axes, np.int64)

    def too_short(self) -> Mask:
        """Return which axes have no way to go that would prove anything."""
        counts = np.abs(self.move.distance) / self.move.increments * self.move.counts
        return np.asarray(counts < SHORTEST)

    def run(self, gains: Integers, where: Mask) -> Proof:
        """Try gains, raw integers of shape (num_axes, 5), on some axes; the others' figures mean nothing."""
        count, lanes = self.target.num_axes, self.target.axes_per_machine
        try:
            return self._proof(gains, self._run(gains, where), where)
        except SafetyError as error:
            if where.sum() <= lanes:
                return self._refused(str(error), where)
        proofs = []
        for lane in range(count // lanes):
            one = where & (np.arange(count) // lanes == lane)
            if one.any():
                try:
                    proofs.append((one, self._proof(gains, self._run(gains, one), one)))
                except SafetyError as error:
                    proofs.append((one, self._refused(str(error), one)))
        return _merged(proofs)

    def show(self, gains: Integers, where: Mask) -> Shown:
        """Record one move with gains that passed, for the record."""
        drives = self.target.drives
        self._begin(where)
        write_gains(drives, gains, where)
        write_profile(drives, self.move, where)
        away = self._origin + self._direction * self.move.distance
        start(drives, wrapped(away).astype(np.int64), where)
        self.moves[where] += 1
        trace = drives.record([POSITION, DEMAND, CURRENT], TRIAL * CYCLE)
        demand, actual = (wrapped(trace[name] - self._origin) / self.move.increments for name in (DEMAND, POSITION))
        self._origin = np.where(where, away, self._origin)
        self._direction = np.where(where, -self._direction, self._direction)
        return Shown(trace.t, demand, actual, trace[CURRENT] * 1e-3)

    def _run(self, gains: Integers, where: Mask) -> Trial:
        self._begin(where)
        self.moves[where] += len(PHASES)
        tried = self._trials.run(gains, self.safe, self.move, self._origin, self._direction, where)
        # A trial ends where its move did, and the next one goes the other way.
        self._origin = np.where(where, self._origin + self._direction * self.move.distance, self._origin)
        self._direction = np.where(where, -self._direction, self._direction)
        return tried

    def _begin(self, where: Mask) -> None:
        """Enable axes with gains that hold where they are not enabled yet, and bring back what went astray."""
        drives = self.target.drives
        down = where & self._trials.down()
        if down.any():
            write_gains(drives, self.safe, down)
            motion.enable(drives, mode="pp", where=down, timeout=ENABLING)
        self._return(where)

    def _return(self, where: Mask) -> None:
        """Bring back what is not where it should be: what was stopped went on with slower gains, or fell, or ran."""
        drives = self.target.drives
        near = np.maximum(NEAR * np.abs(self.move.distance), NEAR_COUNTS / self.move.counts * self.move.increments)
        off = np.abs(wrapped(drives.read(POSITION) - self._origin))
        astray = where & ((off > near) | self._shaken)
        if not astray.any():
            return
        write_gains(drives, self.safe, astray)
        write_profile(drives, self.move, astray)
        start(drives, wrapped(self._origin).astype(np.int64), astray)
        self.moves[astray] += 1
        for _ in range(RETURN_LOOKS):
            # All the while: a load that was shaken swings on, and would be taken for the next gains' doing.
            seen = drives.record([POSITION], RETURN_LOOK)[POSITION]
            if not np.any(astray & (np.abs(wrapped(seen - self._origin)).max(axis=0) > near)):
                break
        self._shaken &= ~astray

    def _refused(self, why: str, where: Mask) -> Proof:
        """Take note that the envelope stopped a trial."""
        write_gains(self.target.drives, self.safe, where)
        self.violations[where] += 1
        self.aborts[where] += 1
        self._trials.recover(where)
        count = self.target.num_axes
        zero = np.zeros(count)
        return Proof(zero + TRIP, zero == 0.0, zero != 0.0, (why,) * count, zero, zero, zero)

    def _proof(self, gains: Integers, tried: Trial, where: Mask) -> Proof:
        terms: Terms = tried.terms
        cost = measured_cost(tried.costs(softness(gains) / softness(self._reference)))
        stopped: Mask = np.asarray(tried.aborted.any(axis=0))
        self.aborts[where & stopped] += 1
        self._shaken |= where & stopped
        overshoot = terms.overshoot[:2].max(axis=0)
        left = np.abs(tried.error[TRIAL - 1])
        counts = np.maximum(np.abs(self.move.distance) / self.move.increments * self.move.counts, 1.0)
        reasons = []
        for axis in range(self.target.num_axes):
            if stopped[axis]:
                phase = PHASES[int(tried.aborted[:, axis].argmax())]
                reason = f"it oscillated or tripped in the {phase} and was stopped within 50 ms"
            elif overshoot[axis] > OVERSHOOT:
                reason = (
                    f"it overshot by {100.0 * overshoot[axis]:.0f} % of the move; {100.0 * OVERSHOOT:.0f} % is allowed"
                )
            elif left[axis] > max(ASTRAY, 5.0 / counts[axis]):
                reason = (
                    f"it was {100.0 * left[axis]:.0f} % of the move away at the end; {100.0 * ASTRAY:.0f} % is allowed"
                )
            else:
                reason = ""
            reasons.append(reason)
        in_probe_only: Mask = np.asarray(stopped & ~tried.aborted[:2].any(axis=0))
        return Proof(
            cost,
            stopped,
            in_probe_only,
            tuple(reasons),
            terms.noise.max(axis=0),
            overshoot,
            terms.settling[:2].mean(axis=0),
        )


def _merged(proofs: Sequence[tuple[Mask, Proof]]) -> Proof:
    """Return one proof of those of single lanes; of axes that took part in none it says what the first one says."""
    first = proofs[0][1]
    reasons = list(first.reason)
    columns: dict[str, Any] = {name: getattr(first, name).copy() for name in Proof._fields if name != "reason"}
    for where, proof in proofs[1:]:
        for name, column in columns.items():
            column[where] = getattr(proof, name)[where]
        for axis in map(int, np.flatnonzero(where)):
            reasons[axis] = proof.reason[axis]
    return Proof(reason=tuple(reasons), **columns)
