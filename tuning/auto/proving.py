"""Trials of gains on the drives: a move, its reversal and a gain probe.

An axis that oscillates or goes into fault is stopped within 50 ms and gets stable gains. On a bus the safety envelope
may react first: it quick-stops all drives, and the trial is repeated machine by machine to find the one that caused it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from drive_env import cia402, motion
from drive_env.devices.gains import cascade_columns, loop_scales, small_time_constants
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
    PROFILE,
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

ASTRAY = 0.2  # of the move: greatest remaining error at the end of a passed trial
# Of the move, and counts of the encoder: an axis farther than both from the start of a trial is first brought back.
NEAR, NEAR_COUNTS = 0.03, 5.0
RETURN_MOVES, RETURN_SPEED = 3.0, 0.5  # moves: longest short return; share of the speed limit for longer ones
RECOVERIES = 6  # attempts to reset a fault; RETURN_LOOK lies between them
SETTLING = 0.03  # s at rest before a trial, after the set-point was moved to the axis
STOPPING, STOPPING_LOOK = 400, 20  # cycles: longest wait for standstill, and time between two checks
HOLDING, PATIENCE = 400, 2  # before a recorded move: cycles to wait for rest; windows for which an axis may oscillate
STEP_COUNTS = 1.5  # of the encoder: smaller changes are neither motion nor a step
STILL_SHAKING = 2  # windows in a row: the trial stops an axis in the first one
RETURN_LOOKS, RETURN_LOOK = 8, 0.05  # number of checks whether an axis is back, and the time between them [s]
OVERSHOOT = 0.6  # of the move: more overshoot counts as unstable
ENABLING = 5.0  # s, longest wait until an axis is enabled: some align their encoder first
SHORTEST = 16.0  # counts of the encoder: a shorter move proves nothing
# After a recorded move it is checked whether the axis is at rest, at several positions within one encoder count: a loop
# at its stability limit may oscillate between two counts at one position and rest at another. Number of positions,
# windows of 25 ms at each, how many of them are skipped, and the greatest current (RMS about its mean, over the rated
# one), without measurement noise.
PLACES, REST, SETTLED, RESTLESS = 3, 6, 2, 0.05
STEP_SIZE, STEPPING = 50, 200  # counts of a csp step, and cycles recorded after it
# Slow loops, as on a soft shaft, need more time and a larger step: time constants of position loop and integrator that
# a motion lasts at least, its greatest extension [s], and the current of a step by P gains over that of dry friction
# and cogging.
ARRIVING, LONGEST, KICK = 4.0, 1.5, 4.0
# Moves: greatest such step of an axis that turns freely, within the window of following errors; and how far friction
# may hold an axis from its end: what does not move has passed no trial.
FREE_STEP, HELD = 8.0, 0.9
STEP_ANGLE = STEP_SIZE / 4096 * 2.0 * math.pi  # rad, for finer encoders
QUIETENING, NOISE_CYCLES = 50, 100  # cycles with slow outer loops: until an axis is quiet, and to measure the noise


OBJECTS = [cia402.POSITION_ACTUAL, cia402.TORQUE_ACTUAL, cia402.STATUSWORD]  # recorded in every motion


class Proof(NamedTuple):
    """The results of a trial: J by measured terms, (num_axes,), and why each axis fails, "" if it passes.

    stopped: Axes that oscillated or went into fault, (num_axes,).
    """

    cost: Floats
    reason: tuple[str, ...]
    stopped: Mask

    @property
    def passed(self) -> Mask:
        """Axes that passed, shape (num_axes,)."""
        return np.array([not reason for reason in self.reason])


class Shown(NamedTuple):
    """A recorded move: times [s], (n,); demanded and actual angle from its start [rad] and current [A], (n, num_axes).

    where: Axes that made it, (num_axes,).
    reason: Why each axis fails, "" if it passes.
    cost: J by its measured terms, (num_axes,).
    swing: Current at rest afterwards, at several positions within an encoder count, over the rated one (RMS over all
        positions), (num_axes,).
    noise: Part of it caused by the measurement of the current, (num_axes,); 0 if not measured because the swing is
        below its limit.
    left: Error that was left at the end, over the move, (num_axes,); 0 where it is no more than fast loops may leave.
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
    left: Floats

    @property
    def restless(self) -> Mask:
        """Axes that oscillated at rest, (num_axes,)."""
        return self.where & (without_noise(self.swing, self.noise) > RESTLESS)

    def replaced(self, later: Shown) -> Shown:
        """Return the recordings joined: the axes of the later one are taken from that."""
        every: Any = zip(self[1:], later[1:], strict=True)  # all fields except the times
        demand, actual, current, _, reason, *figures = (np.where(later.where, new, old) for old, new in every)
        return Shown(self.t, demand, actual, current, self.where | later.where, tuple(map(str, reason)), *figures)


def without_noise(swing: Floats | float, noise: Floats | float) -> Floats:
    """Return the current's swing without measurement noise; both are RMS and independent."""
    return np.asarray(np.sqrt(np.maximum(np.square(swing) - np.square(noise), 0.0)))


class ProvingGround:
    """Trials on a target: each axis moves from its present position to the longer side of its travel.

    Args:
        target: The drives.
        plants: Model of each axis; None for an axis that takes no part.
        room: Signed angles that each rotor may turn from here [rad], low and high, each (num_axes,).
        safe: Stable gains, (num_axes, count), for an axis that is stopped.
        reference: Gains whose softness under a load counts as 1, (num_axes, count).
        held: Current that a weight takes, and least current of dry friction [A], (num_axes,) or one value for all.
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
        # After a stop, an oscillating load may keep even safe gains oscillating; the softer fallback gains let it
        # decay.
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
        self._size = np.maximum(np.abs(self.move.distance), 1)  # of the move, in increments
        self._counts: Floats = np.abs(self.move.distance) / self._count  # counts of the encoder in a move
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
        """Start the next move of axes with unlimited travel at their present position; others are brought back."""
        free = where & np.isinf(self.target.low) & np.isinf(self.target.high)
        self._origin = np.where(free, self.target.drives.read(cia402.POSITION_ACTUAL), self._origin)

    def recover(self, where: Mask) -> None:
        """Reset faults of axes, and hold them with stable gains; an axis whose fault cannot be reset stays in it."""
        where = self.target.together(where)
        write_gains(self.target.drives, self.safe, where)
        for _ in range(RECOVERIES):
            self._trials.recover(where)
            if not (where & self._trials.down()).any():
                break
            # The energy of the braking must leave the DC link first.
            self.target.drives.advance(RETURN_LOOK)
        self._shaken |= where

    def run(self, gains: Integers, where: Mask) -> Proof:
        """Try gains, raw integers of shape (num_axes, count), on some axes; results of the others are undefined.

        Linked axes move together, all with these gains. If the envelope stops all drives, the trial is repeated machine
        by machine to find the one that caused it.
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

        Linked axes move together, all with these gains.
        """
        drives, rated = self.target.drives, self.target.motor.rated_current
        where = self.target.together(where)
        self._fallback.begin()
        self._begin(where)
        self._hold_still(where)
        longer = self._longer(gains, where)
        stop_causes(drives)  # discards earlier ones
        write_gains(drives, gains, where)
        write_profile(drives, self.move, where)
        away = self._origin + self._direction * self.move.distance
        start(drives, wrapped(away).astype(np.int64), where)
        self.moves[where] += 1
        objects = [*OBJECTS, *([cia402.POSITION_DEMAND] if is_recorded(drives) else [])]
        traces, stopped = [], np.zeros(self.target.num_axes, bool)
        for _ in range((TRIAL + longer) // WATCH):
            traces.append(drives.record(objects, WATCH * CYCLE))
            stopped |= self._stop(where & ~stopped & self._shakes(traces[-1]))
        swing = self._swing(away, where & ~stopped)
        measured = self._noise(gains, where & ~stopped & (swing > RESTLESS) & (swing < OSCILLATION))
        seen = {name: np.concatenate([part[name] for part in traces]) for name in objects}
        position, current = seen[cia402.POSITION_ACTUAL], seen[cia402.TORQUE_ACTUAL] * self._ampere
        demanded = seen.get(cia402.POSITION_DEMAND)
        if demanded is None:
            demanded = computed(self._origin, away, self.move, TRIAL + longer)
        demand, actual = (wrapped(values - self._origin) / self.move.increments for values in (demanded, position))
        way = np.sign(self._direction * self.move.distance)
        error = wrapped(position - away) * way / self._size
        left = np.abs(error[-1])
        reason = self._reasons(gains, stopped[None], error.max(axis=0), left, stop_causes(drives))
        settling, noise, overshoot = move_terms(position.astype(float), current, self.move, self._t_0, rated, away, way)
        # Axes that take no part may have invalid gains.
        known = self.target.device.gains
        soft = softness(known, np.where(where[:, None], gains, self._reference)) / softness(known, self._reference)
        costs = cost(Terms(settling, soft, noise, overshoot, stopped))
        self.aborts[stopped] += 1
        self._shaken |= stopped
        self._gone(where)
        t = np.arange(TRIAL, dtype=np.float64) * CYCLE
        rows = t, demand[:TRIAL], actual[:TRIAL], current[:TRIAL]
        left = left * (left > self._astray())
        return Shown(*rows, where, reason, costs, swing, measured, left)

    def step(self, gains: Integers, where: Mask) -> Floats:
        """Return the overshoot of a csp set-point step, there and back, over the step, (num_axes,).

        The step is STEP_SIZE counts of an encoder with 4096 counts, or of a coarser one of the motor: small enough for
        the loops to stay linear, and large enough for noise not to matter. With slow loops it is larger, up to the
        move: dry friction and cogging would hold the axis until the integrator has wound up. A first step, there and
        back, is not counted: it releases what dry friction has stored in the integrator. Linked axes step together. The
        step tests the loops only: feed-forward, which would respond to the step itself, is off during it.
        """
        drives, where = self.target.drives, self.target.together(where)
        self._fallback.begin()
        self._begin(where)
        self._hold_still(where)
        write_gains(drives, self.target.device.gains.without_feed_forward(gains), where)
        cycles = STEPPING + self._longer(gains, where)
        size = self._step_size(gains)
        here = drives.read(cia402.POSITION_ACTUAL)
        motion.select_mode(drives, "csp", where)
        worst = np.zeros(self.target.num_axes)
        try:
            begin = drives.read(cia402.TARGET_POSITION)
            for end, way in ((here + size, 0), (here, 0), (here + size, 1), (here, -1)):
                rows = np.tile(np.where(where, wrapped(end), begin), (cycles, 1)).astype(np.int64)
                seen = drives.record(OBJECTS, cycles * CYCLE, play={cia402.TARGET_POSITION: rows})
                beyond = (way * np.sign(size) * wrapped(seen[cia402.POSITION_ACTUAL] - end)).max(axis=0)
                worst = np.maximum(worst, beyond / np.abs(size))
        finally:
            motion.select_mode(drives, "pp", where)
        write_gains(drives, gains, where)
        self._begin_without_a_step(where)
        return np.where(where & (np.abs(size) > self._dead_zone(gains)), worst, np.nan)

    def _step_size(self, gains: Integers) -> Integers:
        """Return the signed steps of the set-point in csp [inc], towards the end of the next move, (num_axes,)."""
        free = np.isinf(self.target.low) & np.isinf(self.target.high)
        least = np.maximum(STEP_SIZE * self._count, STEP_ANGLE * self.move.increments)
        most = np.where(free, FREE_STEP, 1.0) * self._size
        size = np.maximum(least, np.minimum(KICK * self._dead_zone(gains), most))
        return np.asarray(np.rint(size * np.sign(self._direction * self.move.distance)), np.int64)

    def _dead_zone(self, gains: Integers) -> Floats:
        """Return the errors at which P gains alone overcome dry friction and cogging [inc], (num_axes,)."""
        motor, (_, _, velocity, _, position) = self.target.motor, self._in_si(gains)
        held = np.maximum(np.asarray(self._held[1]), 0.0) + motor.cogging_torque / motor.torque_constant
        return np.asarray(held * self.move.increments / np.maximum(velocity * position, 1e-9))

    def _in_si(self, gains: Integers) -> list[Floats]:
        """Return the cascade's gains of all axes: duty/A, a share, A s/rad, a share, 1/s, (num_axes,) each."""
        scales = loop_scales(self.target.device)
        return [scales[k].value(gains[:, k]) for k in cascade_columns(self.target.device)]

    def _longer(self, gains: Integers, where: Mask) -> int:
        """Return how many cycles more than a trial lasts slow loops need to arrive: whole windows, 0 for most axes."""
        *_, integral, position = self._in_si(gains)
        rates = position, integral * self.target.device.velocity_rate
        lag = sum(1.0 / np.maximum(rate, 1e-9) for rate in rates)
        more = np.max(ARRIVING * lag, where=where, initial=0.0) - (TRIAL - PROFILE) * CYCLE
        return WATCH * math.ceil(np.clip(more, 0.0, LONGEST) / (WATCH * CYCLE))

    def noise(self, gains: Integers, where: Mask) -> Floats:
        """Measure the noise of the measured current at rest, over the rated current (RMS).

        Args:
            gains: Gains that the axes get afterwards, (num_axes, count); the current loop uses them.
            where: Axes, (num_axes,); axes linked with them take part, too.
        """
        where = self.target.together(where)
        self._begin(where)
        return self._noise(gains, where)

    def _noise(self, gains: Integers, where: Mask) -> Floats:
        """Return the noise of enabled axes, (num_axes,); 0 for the others.

        The outer loops are slow during the measurement, so that they do not amplify it. An oscillation of these is
        slow, too, and adds little: noise is independent in every sample, and its change is sqrt(2) of its RMS value.
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
        """Return the swing of the current at rest at several positions, over the rated one (RMS over all of them).

        Args:
            at: Positions of the axes [inc]; they end within a count of it, on the side they came from.
            where: Axes to check; one that oscillates is stopped.
        """
        drives, rated = self.target.drives, self.target.motor.rated_current
        back = -np.sign(self._direction * self.move.distance)
        squares, worst = np.zeros((2, self.target.num_axes))
        for place in range(PLACES):
            if place:
                # At least one increment: increments may be as coarse as counts.
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
        """Wait for rest with the present gains, and start from there: a frequency response leaves an axis turning.

        An axis that still oscillates after PATIENCE windows of 25 ms is stopped.
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
        """Return which axes oscillated in a recording, or are not enabled at its end."""
        shaking = shakes(seen[cia402.TORQUE_ACTUAL] * self._ampere, self.target.motor.rated_current)
        return np.asarray(shaking | ~cia402.matches(seen[cia402.STATUSWORD][-1], cia402.OPERATION_ENABLED))

    def _stop(self, where: Mask) -> Mask:
        """Give stable gains to axes and those linked with them; return all of these."""
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
        self._trials.longer = self._longer(gains, where)
        if self._trials.longer:
            self._hold_still(where)
        self.moves[where] += len(PHASES)
        stop_causes(self.target.drives)  # discards earlier ones
        tried = self._trials.run(gains, self.safe, self.move, self._origin, self._direction, where)
        self._gone(where)
        known = self.target.device.gains
        costs = measured_cost(tried.costs(softness(known, gains) / softness(known, self._reference)))
        causes = stop_causes(self.target.drives)
        stopped = where & tried.aborted.any(axis=0)
        self.aborts[stopped] += 1
        self._shaken |= stopped
        # The error at the end of the move, or the present distance from its end: the demand may have stopped, too.
        now = np.abs(wrapped(self.target.drives.read(cia402.POSITION_ACTUAL) - self._origin)) / self._size
        left = np.maximum(np.abs(tried.error[-1]), now)
        overshoot = tried.terms.overshoot[:2].max(axis=0)
        return Proof(costs, self._reasons(gains, tried.aborted, overshoot, left, causes), stopped)

    def _gone(self, where: Mask) -> None:
        """Set the start of the next move to the end of this one, in the other direction."""
        self._origin = np.where(where, self._origin + self._direction * self.move.distance, self._origin)
        self._direction = np.where(where, -self._direction, self._direction)

    def _begin(self, where: Mask) -> None:
        """Enable axes that are off with stable gains, and bring axes back to the start of the next move."""
        drives = self.target.drives
        down = self.target.together(where & self._trials.down())
        if down.any():
            write_gains(drives, self.safe, down)
            self._come_to_rest(down)
        motion.select_mode(drives, "pp", where)
        self._return(where)
        self._begin_without_a_step(where)

    def _come_to_rest(self, where: Mask) -> None:
        """Enable axes in csv and wait until they are at rest.

        An axis that still turns is taken over at its speed: slow gains stop it sooner by velocity than by position.
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
        """Bring axes back to the start of the next move that were stopped, fell, or moved away."""
        drives = self.target.drives
        near = np.maximum(NEAR * np.abs(self.move.distance), NEAR_COUNTS * self._count)
        off = np.abs(wrapped(drives.read(cia402.POSITION_ACTUAL) - self._origin))
        # A long way must not take long, and a weight that goes down must not overcharge the DC link.
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
            # Wait for the whole time: an oscillating load would be blamed on the next gains.
            seen = drives.record([cia402.POSITION_ACTUAL], RETURN_LOOK)[cia402.POSITION_ACTUAL]
            if not np.any(astray & (np.abs(wrapped(seen - self._origin)).max(axis=0) > near)):
                break
        self._shaken &= ~astray

    def _begin_without_a_step(self, where: Mask) -> None:
        """Move the set-point to the present positions of the axes.

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

    def _astray(self) -> Floats:
        """Return the greatest error that may be left without dry friction, over the move, (num_axes,)."""
        return np.maximum(ASTRAY, 5.0 / np.maximum(self._counts, 1.0))

    def _reasons(
        self, gains: Integers, stopped: Mask, overshoot: Floats, left: Floats, causes: Sequence[str]
    ) -> tuple[str, ...]:
        """Return why axes fail; "" if they pass.

        An error may remain at which dry friction holds the axis against its P gains, up to HELD.

        Args:
            gains: Raw, (num_axes, count).
            stopped: Axes that were stopped, one row per phase, (phases, num_axes).
            overshoot: Over the move, (num_axes,).
            left: Error at the end of the move, over the move, (num_axes,).
            causes: Emergencies of the drives during the trial.
        """
        held = np.minimum(self._dead_zone(gains) / self._size, HELD)
        most_left = np.maximum(self._astray(), held)
        most_beyond = np.maximum(OVERSHOOT, held)
        reasons = []
        for axis, phases in enumerate(stopped.T):
            reason = ""
            if phases.any():
                phase = PHASE_TITLES[int(phases.argmax())]
                reason = f"stopped in the {phase}: it oscillated or went into fault (cut off within 50 ms)"
                if causes[axis] != UNTOLD:
                    reason += f"; the drive reported {causes[axis]}"
            elif overshoot[axis] > most_beyond[axis]:
                far, most = 100.0 * overshoot[axis], 100.0 * most_beyond[axis]
                reason = f"its overshoot was {far:.0f} % of the move; {most:.0f} % is allowed"
            elif left[axis] > most_left[axis]:
                far, most = 100.0 * left[axis], 100.0 * most_left[axis]
                reason = f"its error at the end was {far:.0f} % of the move; {most:.0f} % is allowed"
            reasons.append(reason)
        return tuple(reasons)
