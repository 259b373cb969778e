"""Trials of gains on the drives: a move, its reversal and a gain probe.

An axis that oscillates or goes into fault is stopped within 50 ms and gets gains that are known to be stable. On a bus
the safety envelope may be faster: it quick-stops all drives, and the trial is repeated machine by machine to find which
one caused it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from drive_env import cia402, motion
from drive_env.devices.gains import small_time_constants
from drive_env.dictionary.roles import Role
from drive_env.drives.currents import ampere_per_count
from drive_env.drives.interface import CYCLE
from drive_env.drives.observed import ObservedDrives
from drive_env.drives.raw_gains import write_gains
from drive_env.drives.trace import Trace
from drive_env.safety.envelope import SafetyError
from drive_env.trials.demand import computed, is_recorded
from drive_env.trials.gain_trial import PHASE_TITLES, PHASES, Trials, measured_cost, softness
from drive_env.trials.oscillation import OSCILLATION, shakes
from drive_env.trials.positioning import (
    TRIAL,
    WATCH,
    Move,
    highest_ramp,
    longer_way,
    move_terms,
    plan_move,
    start,
    wrapped,
    write_profile,
)
from drive_env.trials.score import TRIP, Terms, cost
from mechanics.arrays import Floats, Integers, Mask
from tuning.fallback_gains import FallbackGains
from tuning.link_energy import bearable_speed, trial_reach
from tuning.oscillation_watch import SOFTER
from tuning.stop_causes import UNTOLD, stop_causes

if TYPE_CHECKING:
    from drive_env.loops.linear_model import Plant
    from tuning.target import Target

ASTRAY = 0.2  # of the move: what is still farther away at a trial's end does not pass
# Of the move, and of the encoder: an axis farther than both from where a trial starts is brought back first.
NEAR, NEAR_COUNTS = 0.03, 5.0
RETURN_MOVES, RETURN_SPEED = 3.0, 0.5  # moves that are as short a way as one; of the speed limit, on longer ones
RECOVERIES = 6  # attempts to reset a fault, with such a time between them
SETTLING = 0.03  # s at rest before a trial, once the set-point is where the axis is
STOPPING, STOPPING_LOOK = 400, 20  # cycles: the longest wait for axes to stand, and how often it is looked
HOLDING, PATIENCE = 400, 2  # before a move for the record: cycles to wait for rest, windows for which an axis may shake
STEP_COUNTS = 1.5  # of the encoder: what is less is no motion, and no step
STILL_SHAKING = 2  # windows in a row: in the first one an axis is stopped
RETURN_LOOKS, RETURN_LOOK = 8, 0.05  # looks whether it is back, and the time between them [s]
OVERSHOOT = 0.6  # of the move: what overshoots by more is called unstable
ENABLING = 5.0  # s, the longest wait for an axis that is switched on: some align their encoder first
SHORTEST = 16.0  # counts of the encoder: a move that is shorter proves nothing
# After a move for the record it is looked whether the axis stands, in so many places of an encoder count: a loop at its
# edge swings between two counts in one place, and stands in another. Windows of 25 ms in each, how many of them pass
# before, and what the current may swing (RMS about its mean, over the rated one), without the noise of its measurement.
PLACES, REST, SETTLED, RESTLESS = 3, 6, 2, 0.05
STEP_SIZE, STEPPING = 50, 200  # counts of a step of csp, and cycles that are looked at after it
STEP_ANGLE = STEP_SIZE / 4096 * 2.0 * math.pi  # rad, of the finer encoders
QUIETENING, NOISE_CYCLES = 50, 100  # with slow outer loops: until an axis is quiet, and that show the noise


OBJECTS = [cia402.POSITION_ACTUAL, cia402.TORQUE_ACTUAL, cia402.STATUSWORD]  # recorded in every motion


class Proof(NamedTuple):
    """The results of a trial: J by measured terms, (num_axes,), and why each axis does not pass, "" if it does.

    stopped: Axes that oscillated or went into fault, (num_axes,).
    """

    cost: Floats
    reason: tuple[str, ...]
    stopped: Mask

    @property
    def passed(self) -> Mask:
        """Which axes passed, shape (num_axes,)."""
        return np.array([not reason for reason in self.reason])


class Shown(NamedTuple):
    """A recorded move: times [s], (n,); demanded and actual angle from its start [rad] and current [A], (n, num_axes).

    where: Axes that made it, (num_axes,). reason: Of each axis, why it does not pass, "" if it does. cost: J by its
    measured terms, (num_axes,). swing: Of the current at rest afterwards, in several places of an encoder count, over
    the rated one (RMS over all), (num_axes,). noise: What the measurement of the current makes of that, alike; 0 where
    it was not measured, since the swing is small enough as it is.
    """

    t: Floats
    demand: Floats
    actual: Floats
    current: Floats
    where: Mask
    reason: tuple[str, ...]
    cost: Floats
    swing: Floats
    noise: Floats

    @property
    def restless(self) -> Mask:
        """Which axes shook at rest, (num_axes,)."""
        return self.where & (without_noise(self.swing, self.noise) > RESTLESS)

    def replaced(self, later: Shown) -> Shown:
        """Return this with the axes of a later recording in their place."""
        every: Any = zip(self[1:], later[1:], strict=True)  # all but the times
        demand, actual, current, _, reason, *figures = (np.where(later.where, new, old) for old, new in every)
        return Shown(self.t, demand, actual, current, self.where | later.where, tuple(map(str, reason)), *figures)


def without_noise(swing: Floats | float, noise: Floats | float) -> Floats:
    """Return how much a current swings apart from the noise of its measurement; both RMS, and independent."""
    return np.asarray(np.sqrt(np.maximum(np.square(swing) - np.square(noise), 0.0)))


class ProvingGround:
    """Trials on a target, from where its axes stand, the longer way, each in its own travel.

    Args:
        target: The drives.
        plants: The model of each axis; an axis with None takes no part.
        room: How far each rotor may turn from here [rad], low and high, each (num_axes,).
        safe: Gains known to be stable, (num_axes, count); an axis that is stopped gets them.
        reference: Gains whose softness under a load counts as 1, (num_axes, count).
        held: Currents that a weight takes, and dry friction at least [A], (num_axes,) or one for all.
    """

    def __init__(
        self,
        target: Target,
        plants: Sequence[Plant | None],
        room: tuple[Floats, Floats],
        safe: Integers,
        reference: Integers,
        held: tuple[ArrayLike, ArrayLike] = (0.0, 0.0),
    ) -> None:
        # What a stop leaves swinging may feed safe gains as well; those that follow let the load ring down.
        self._fallback = FallbackGains(target.num_axes, target.motor.rated_current, STILL_SHAKING)
        self._fallback.calm = target.device.gains.softened(safe, SOFTER, "velocity", "position")
        self.target = target = replace(target, drives=ObservedDrives(target.drives, self._fallback))
        self.safe = safe
        self._reference = reference
        motor, drives = target.motor, target.drives
        self._ampere = ampere_per_count(drives)
        inertia = np.array([motor.inertia if plant is None else plant.inertia for plant in plants])
        inertia = target.slowest(inertia)
        self._inertia, self._held = inertia, held
        ends = (-1, target.axes_per_machine if target.linked else 1)
        reach = trial_reach(target, inertia, held[0], longer_way(*room)).reshape(ends)
        shortest = np.abs(reach).argmin(axis=1)
        reach = np.repeat(reach[np.arange(len(reach)), shortest], ends[1])
        corner = [target.device.stage["velocity_filter"].default if p is None else p.velocity_filter for p in plants]
        self.move: Move = plan_move(
            motor, inertia, drives.read(Role.POSITION_SCALE), reach, highest_ramp(target.device)
        )
        self._count: Floats = self.move.increments / self.move.counts  # increments
        self._size = np.maximum(np.abs(self.move.distance), 1)  # of the move, likewise
        self._counts: Floats = np.abs(self.move.distance) / self._count  # of the encoder in a move
        top = RETURN_SPEED * target.speed * self.move.increments
        self._fastest: Floats = np.maximum(top / np.maximum(self.move.velocity, 1), 1.0)
        self._t_0 = 4.0 * small_time_constants(target.device, np.array(corner))
        self._trials = Trials(drives, motor, target.axes_per_machine, self._t_0)  # type: ignore[arg-type]
        self._origin = drives.read(cia402.POSITION_ACTUAL)
        self._direction = np.ones(target.num_axes, np.int64)
        self._shaken = np.zeros(target.num_axes, bool)
        self.moves = np.zeros(target.num_axes, np.int64)
        self.aborts = np.zeros(target.num_axes, np.int64)
        self.violations = np.zeros(target.num_axes, np.int64)

    def too_short(self) -> Mask:
        """Return which axes have too short a travel for a useful trial."""
        return np.asarray(self._counts < SHORTEST)

    def way_back(self) -> Floats:
        """Return how long it may take to bring axes back before their next move [s], (num_axes,)."""
        return np.where(self._shaken, RETURN_LOOKS * RETURN_LOOK + SETTLING, 0.0)

    def begin_here(self, where: Mask) -> None:
        """Take where axes are as where the next move begins, of those that turn freely; the others are brought back."""
        free = where & np.isinf(self.target.low) & np.isinf(self.target.high)
        self._origin = np.where(free, self.target.drives.read(cia402.POSITION_ACTUAL), self._origin)

    def recover(self, where: Mask) -> None:
        """Reset faults of axes, and hold them with gains known to be stable; one that cannot stays as it is."""
        where = self.target.together(where)
        write_gains(self.target.drives, self.safe, where)
        for _ in range(RECOVERIES):
            self._trials.recover(where)
            if not (where & self._trials.down()).any():
                break
            # What a brake has put into the link must leave it first.
            self.target.drives.advance(RETURN_LOOK)
        self._shaken |= where

    def run(self, gains: Integers, where: Mask) -> Proof:
        """Try gains, raw integers of shape (num_axes, count), on some axes; the others' figures are undefined.

        Linked axes move together, all of them with these gains. Where the envelope stops all drives, machine by machine
        tries them again, so that the one that caused it is known.
        """
        where, lanes = self.target.together(where), self.target.axes_per_machine
        try:
            return self._run(gains, where)
        except SafetyError as error:
            if where.sum() <= lanes:
                return self._refused(str(error), where)
        cost, reason = np.full(len(where), TRIP), np.full(len(where), "", object)
        stopped = np.zeros(len(where), bool)
        machines = np.arange(len(where)) // lanes
        for machine in np.unique(machines[where]):
            one = where & (machines == machine)
            proof = self.run(gains, one)
            cost, reason = np.where(one, proof.cost, cost), np.where(one, proof.reason, reason)
            stopped |= proof.stopped
        return Proof(cost, tuple(reason), stopped)

    def show(self, gains: Integers, where: Mask) -> Shown:
        """Record one move with gains; an axis that oscillates or goes into fault gets stable gains within 50 ms.

        Linked axes move together, all of them with these gains.
        """
        drives, rated = self.target.drives, self.target.motor.rated_current
        where = self.target.together(where)
        self._fallback.begin()
        self._begin(where)
        self._hold_still(where)
        stop_causes(drives)  # of before
        write_gains(drives, gains, where)
        write_profile(drives, self.move, where)
        away = self._origin + self._direction * self.move.distance
        start(drives, wrapped(away).astype(np.int64), where)
        self.moves[where] += 1
        objects = [*OBJECTS, *([cia402.POSITION_DEMAND] if is_recorded(drives) else [])]
        traces, stopped = [], np.zeros(self.target.num_axes, bool)
        for _ in range(TRIAL // WATCH):
            traces.append(drives.record(objects, WATCH * CYCLE))
            stopped |= self._stop(where & ~stopped & self._shakes(traces[-1]))
        swing = self._swing(away, where & ~stopped)
        measured = self._noise(gains, where & ~stopped & (swing > RESTLESS) & (swing < OSCILLATION))
        seen = {name: np.concatenate([part[name] for part in traces]) for name in objects}
        position, current = seen[cia402.POSITION_ACTUAL], seen[cia402.TORQUE_ACTUAL] * self._ampere
        demanded = seen.get(cia402.POSITION_DEMAND)
        if demanded is None:
            demanded = computed(self._origin, away, self.move, TRIAL)
        demand, actual = (wrapped(values - self._origin) / self.move.increments for values in (demanded, position))
        way = np.sign(self._direction * self.move.distance)
        error = wrapped(position - away) * way / self._size
        reason = self._reasons(stopped[None], error.max(axis=0), np.abs(error[-1]), stop_causes(drives))
        settling, noise, overshoot = move_terms(position.astype(float), current, self.move, self._t_0, rated, away, way)
        # Of axes that take no part the gains may be none.
        known = self.target.device.gains
        soft = softness(known, np.where(where[:, None], gains, self._reference)) / softness(known, self._reference)
        costs = cost(Terms(settling, soft, noise, overshoot, stopped))
        self.aborts[stopped] += 1
        self._shaken |= stopped
        self._gone(where)
        t = np.arange(len(demand), dtype=np.float64) * CYCLE
        return Shown(t, demand, actual, current, where, reason, costs, swing, measured)

    def step(self, gains: Integers, where: Mask) -> Floats:
        """Return how far axes go beyond a step of their set-point in csp, there and back, over the step, (num_axes,).

        The step is STEP_SIZE counts of an encoder of 4096, or of a coarser one of the motor: small enough for the loops
        to stay linear, and large enough for friction and noise not to matter. A first one, there and back, does not
        count: by it the integrator lets go of what dry friction has kept in it. Linked axes step together. It is there
        for the loops: a feed-forward, which answers the jump with a push of its own, is off meanwhile.
        """
        drives, where = self.target.drives, self.target.together(where)
        self._fallback.begin()
        self._begin(where)
        self._hold_still(where)
        write_gains(drives, self.target.device.gains.without_feed_forward(gains), where)
        size = np.rint(np.maximum(STEP_SIZE * self._count, STEP_ANGLE * self.move.increments)).astype(np.int64)
        here = drives.read(cia402.POSITION_ACTUAL)
        motion.select_mode(drives, "csp", where)
        worst = np.zeros(self.target.num_axes)
        try:
            begin = drives.read(cia402.TARGET_POSITION)
            for end, way in ((here + size, 0), (here, 0), (here + size, 1), (here, -1)):
                rows = np.tile(np.where(where, wrapped(end), begin), (STEPPING, 1)).astype(np.int64)
                seen = drives.record(OBJECTS, STEPPING * CYCLE, play={cia402.TARGET_POSITION: rows})
                beyond = (way * wrapped(seen[cia402.POSITION_ACTUAL] - end)).max(axis=0)
                worst = np.maximum(worst, beyond / size)
        finally:
            motion.select_mode(drives, "pp", where)
        write_gains(drives, gains, where)
        self._begin_without_a_step(where)
        return np.where(where, worst, np.nan)

    def noise(self, gains: Integers, where: Mask) -> Floats:
        """Return the noise of the measured current at rest, over the rated current (RMS).

        Args:
            gains: That they have afterwards, (num_axes, count); the current loop works with these.
            where: Axes, (num_axes,); those that pull at the same thing take part, too.
        """
        where = self.target.together(where)
        self._begin(where)
        return self._noise(gains, where)

    def _noise(self, gains: Integers, where: Mask) -> Floats:
        """Return the noise of axes that are enabled, (num_axes,); 0 of the others.

        The outer loops are slow meanwhile, so that they do not amplify it. Their own swing, should they have one, is
        slow as well and counts for little: noise is new in every sample, and changes by sqrt(2) of its RMS value.
        """
        noise = np.zeros(self.target.num_axes)
        where = self.target.together(where)
        if not where.any():
            return noise
        drives, outer = self.target.drives, self.target.device.gains.columns_of("velocity", "position")
        slow = gains.copy()
        slow[:, outer] = self.safe[:, outer]
        write_gains(drives, slow, where)
        drives.advance(QUIETENING * CYCLE)
        current = drives.record([cia402.TORQUE_ACTUAL], NOISE_CYCLES * CYCLE)[cia402.TORQUE_ACTUAL] * self._ampere
        change = np.sqrt(0.5 * np.mean(np.diff(current, axis=0) ** 2, axis=0))
        write_gains(drives, gains, where)
        return np.where(where, np.minimum(current.std(axis=0), change) / self.target.motor.rated_current, noise)

    def _swing(self, at: Integers, where: Mask) -> Floats:
        """Return how much the current swings at rest in several places, over the rated one (RMS over all of them).

        Args:
            at: Where the axes are [inc]; they end within a count of it, on the side from which they came.
            where: Axes that are looked at; one that oscillates is stopped.
        """
        drives, rated = self.target.drives, self.target.motor.rated_current
        back = -np.sign(self._direction * self.move.distance)
        squares, worst = np.zeros((2, self.target.num_axes))
        for place in range(PLACES):
            if place:
                # Increments may be as coarse as counts.
                apart = np.maximum(np.rint(place * self._count / PLACES), place)
                start(drives, wrapped(at + back * apart).astype(np.int64), where)
            seen = []
            for _ in range(REST):
                window = drives.record([cia402.TORQUE_ACTUAL, cia402.STATUSWORD], WATCH * CYCLE)
                stopped = self._stop(where & self._shakes(window))
                worst[stopped] = OSCILLATION
                self._shaken |= stopped
                seen.append(window[cia402.TORQUE_ACTUAL])
            squares += np.concatenate(seen[SETTLED:]).var(axis=0) / PLACES
        return np.maximum(worst, np.sqrt(squares) * self._ampere / rated)

    def _hold_still(self, where: Mask) -> None:
        """Come to rest with the present gains, and start from there: a frequency response leaves an axis turning.

        An axis that still swings after a second window of 25 ms is stopped.
        """
        windows = np.zeros(self.target.num_axes, np.int64)
        for _ in range(HOLDING // WATCH):
            seen = self.target.drives.record(OBJECTS, WATCH * CYCLE)
            windows = np.where(self._shakes(seen), windows + 1, 0)
            self._stop(where & (windows == PATIENCE))
            if not np.any(where & ~self._stands(seen[cia402.POSITION_ACTUAL])):
                break
        self._begin_without_a_step(where)

    def _shakes(self, seen: Trace) -> Mask:
        """Return which axes oscillated in a recording, or are off at its end."""
        shaking = shakes(seen[cia402.TORQUE_ACTUAL] * self._ampere, self.target.motor.rated_current)
        return np.asarray(shaking | ~cia402.matches(seen[cia402.STATUSWORD][-1], cia402.OPERATION_ENABLED))

    def _stop(self, where: Mask) -> Mask:
        """Give axes, and those linked with them, stable gains; return which got them."""
        where = self.target.together(where)
        if where.any():
            write_gains(self.target.drives, self.safe, where)
        return where

    def _stands(self, positions: Integers) -> Mask:
        """Return which axes were at rest in a recording of their positions, (cycles, num_axes)."""
        return np.asarray(np.abs(wrapped(positions - positions[-1])).max(axis=0) <= STEP_COUNTS * self._count)

    def _run(self, gains: Integers, where: Mask) -> Proof:
        self._fallback.begin()
        self._begin(where)
        self.moves[where] += len(PHASES)
        stop_causes(self.target.drives)  # of before
        tried = self._trials.run(gains, self.safe, self.move, self._origin, self._direction, where)
        self._gone(where)
        known = self.target.device.gains
        costs = measured_cost(tried.costs(softness(known, gains) / softness(known, self._reference)))
        causes = stop_causes(self.target.drives)
        stopped = where & tried.aborted.any(axis=0)
        self.aborts[stopped] += 1
        self._shaken |= stopped
        # Behind its demand at the end of the move, or from where it should be now: a demand may stand still, too.
        now = np.abs(wrapped(self.target.drives.read(cia402.POSITION_ACTUAL) - self._origin)) / self._size
        left = np.maximum(np.abs(tried.error[TRIAL - 1]), now)
        return Proof(costs, self._reasons(tried.aborted, tried.terms.overshoot[:2].max(axis=0), left, causes), stopped)

    def _gone(self, where: Mask) -> None:
        """Count on from where a move has ended: the next one goes the other way."""
        self._origin = np.where(where, self._origin + self._direction * self.move.distance, self._origin)
        self._direction = np.where(where, -self._direction, self._direction)

    def _begin(self, where: Mask) -> None:
        """Enable axes that are off, with stable gains, and bring those back that are not where they should be."""
        drives = self.target.drives
        down = self.target.together(where & self._trials.down())
        if down.any():
            write_gains(drives, self.safe, down)
            self._come_to_rest(down)
        motion.select_mode(drives, "pp", where)
        self._return(where)
        self._begin_without_a_step(where)

    def _come_to_rest(self, where: Mask) -> None:
        """Enable axes and wait until they are at rest: one that still turns is taken over at its speed.

        Slow gains stop it sooner by its velocity than by its position.
        """
        drives = self.target.drives
        motion.enable(drives, mode="csv", where=where, timeout=ENABLING)
        drives.write(cia402.TARGET_VELOCITY, 0, where=where)
        for _ in range(STOPPING // STOPPING_LOOK):
            seen = drives.record([cia402.POSITION_ACTUAL], STOPPING_LOOK * CYCLE)[cia402.POSITION_ACTUAL]
            if not np.any(where & ~self._stands(seen)):
                break
        self.begin_here(where)

    def _return(self, where: Mask) -> None:
        """Bring axes back that are not where they should be, since they were stopped, fell, or ran away."""
        drives = self.target.drives
        near = np.maximum(NEAR * np.abs(self.move.distance), NEAR_COUNTS * self._count)
        off = np.abs(wrapped(drives.read(cia402.POSITION_ACTUAL) - self._origin))
        # A long way is not to take long, and a weight that goes down by it not to overcharge the DC link.
        faster = np.clip(off / (RETURN_MOVES * np.maximum(np.abs(self.move.distance), 1)), 1.0, self._fastest)
        way, speed, ramp = (
            row / self.move.increments for row in (off, faster * self.move.velocity, faster * self.move.acceleration)
        )
        faster *= bearable_speed(self.target, self._inertia, *self._held, way, speed, ramp)
        back = self.move._replace(
            velocity=np.ceil(self.move.velocity * faster).astype(np.int64),
            acceleration=np.ceil(self.move.acceleration * faster).astype(np.int64),
        )
        astray = self.target.together(where & ((off > near) | self._shaken))
        if not astray.any():
            return
        write_gains(drives, self.safe, astray)
        write_profile(drives, back, astray)
        start(drives, wrapped(self._origin).astype(np.int64), astray)
        self.moves[astray] += 1
        longest = np.max(off / back.velocity, where=astray, initial=0.0)
        for _ in range(max(RETURN_LOOKS, math.ceil(longest / RETURN_LOOK) + 2)):
            # All the while: a load that was shaken swings on, and would be taken for the next gains' doing.
            seen = drives.record([cia402.POSITION_ACTUAL], RETURN_LOOK)[cia402.POSITION_ACTUAL]
            if not np.any(astray & (np.abs(wrapped(seen - self._origin)).max(axis=0) > near)):
                break
        self._shaken &= ~astray

    def _begin_without_a_step(self, where: Mask) -> None:
        """Set the set-point to where the axes are.

        The remaining error of slow gains, or a rotation during commutation alignment, would be a step for fast gains,
        and its transient would look like an oscillation.
        """
        drives = self.target.drives
        here = drives.read(cia402.POSITION_ACTUAL)
        off = where & (np.abs(wrapped(here - self._origin)) > STEP_COUNTS * self._count)
        if not off.any():
            return
        self._origin = np.where(off, here, self._origin)
        write_profile(drives, self.move, off)
        start(drives, wrapped(self._origin).astype(np.int64), off)
        drives.advance(SETTLING)

    def _refused(self, why: str, where: Mask) -> Proof:
        """Record that the envelope stopped a trial."""
        write_gains(self.target.drives, self.safe, where)
        self.violations[where] += 1
        self.aborts[where] += 1
        self._trials.recover(where)
        return Proof(np.full(len(where), TRIP), (why,) * len(where), where)

    def _reasons(self, stopped: Mask, overshoot: Floats, left: Floats, causes: Sequence[str]) -> tuple[str, ...]:
        """Return why axes do not pass, "" where they do.

        Args:
            stopped: Whether they were stopped, a row for each phase, (phases, num_axes).
            overshoot: Of the move, (num_axes,).
            left: Of the move, what was missing at its end, (num_axes,).
            causes: What the drives have told meanwhile.
        """
        most_left = np.maximum(ASTRAY, 5.0 / np.maximum(self._counts, 1.0))
        reasons = []
        for axis, phases in enumerate(stopped.T):
            reason = ""
            if phases.any():
                phase = PHASE_TITLES[int(phases.argmax())]
                reason = f"stopped in the {phase}: it oscillated or went into fault (cut off within 50 ms)"
                if causes[axis] != UNTOLD:
                    reason += f"; the drive reported {causes[axis]}"
            elif overshoot[axis] > OVERSHOOT:
                far, most = 100.0 * overshoot[axis], 100.0 * OVERSHOOT
                reason = f"its overshoot was {far:.0f} % of the move; {most:.0f} % is allowed"
            elif left[axis] > most_left[axis]:
                far, most = 100.0 * left[axis], 100.0 * ASTRAY
                reason = f"its error at the end was {far:.0f} % of the move; {most:.0f} % is allowed"
            reasons.append(reason)
        return tuple(reasons)
