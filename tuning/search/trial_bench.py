"""Trials of gains on what is to be tuned: identified first, then tried in moves, and costed from what a drive shows.

The bench is where optimisers meet drives: it starts from gains that are safe, keeps each axis within its travel, has
what oscillates stopped within 50 ms, and counts what the drives had to do.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drive_env import cia402
from drive_env.dictionary.roles import Role
from drive_env.drives.currents import ampere_per_count
from drive_env.drives.interface import CYCLE, Drives, axis_number, machine_of
from drive_env.drives.observed import ObservedDrives
from drive_env.drives.raw_gains import read_gains, write_gains
from drive_env.safety.envelope import SafetyError
from drive_env.trials.gain_trial import Identified, Trial, measured_cost
from drive_env.trials.method import method_of
from drive_env.trials.positioning import PROFILE, SETTLED, TRIAL, longer_way, wrapped, write_profile
from drive_env.trials.score import TRIP
from mechanics.arrays import Floats, Integers, Mask
from tuning.fallback_gains import FallbackGains
from tuning.identify.connected_motors import check_motors
from tuning.identify.working_state import GUESS
from tuning.link_energy import trial_reach
from tuning.oscillation_watch import SOFTER, OscillationError, OscillationWatch
from tuning.stop_causes import told_causes
from tuning.target import Target

MOVES_OF_IDENTIFICATION, MOVES_OF_TRIAL = 2, 3
CALM = 0.1  # s until what an axis did before has died away
ASTRAY = 0.2  # of the move: an axis farther than that from where a trial starts is brought back first
MOST_WAITING = 8  # times as long as a trial, at most, until it is back
SOFTENINGS = 3  # of gains from the data sheet, with which an axis may oscillate
MOST_STOPS = 3  # by the safety envelope, one trial after the other, before the search ends
BEYOND = 0.1  # how fast the cost grows where J has come to its end
E_D_EXPONENT = 0.4  # of E_d/E_0 in J (drive_env/trials/score.py)
_UNCUT = 1e-3
STALL = 60.0  # s: so long a sampler may think while an axis stands still, enabled

OBJECTIVES = ("speed", "robustness", "current")


def leave_oscillations_to_trials(drives: Drives) -> None:
    """Keep the envelope from ending a search where a trial stops an axis itself, or the sampler computes for long."""
    if drives.safety is not None:
        drives.safety.change(replace(drives.safety.limits, oscillation=False, stall=STALL))


class Tried(NamedTuple):
    """What a trial of the machines' gains showed.

    cost: ln J by measured terms, of the worst axis of each machine, (num_machines,); above ln 30, where J ends, it goes
        on growing a tenth as fast.
    objectives: In the order of `OBJECTIVES`, all to be small, (num_machines, 3): ln t_s/t_0 of the slower of move and
        reversal; ln of how much worse the worst phase is than move and reversal, the probe with velocity P x 1.5
        among them; RMS increment of the current over the rated one [%], in open loop the RMS of the currents that are
        set.
    aborted: Stopped in any phase, (num_machines,).
    fragile: Shook on with the incumbent's gains after it had been stopped, (num_machines,): not gains to keep.
    causes: Emergencies of the machine's drives meanwhile, texts, (num_machines,); "" without one.
    """

    cost: Floats
    objectives: Floats
    aborted: Mask
    fragile: Mask
    causes: NDArray[np.str_]


class TrialBench:
    """Trials of gains on a target, all of its machines at once.

    Args:
        target: What is tuned; the drives may have any gains, also none.
        anew: Put emulated machines to rest at zero before every trial, so that a trial follows from machine, gains
            and its number alone; drives on a bus go on from where they are.
        gains: Names of those that will be tried; with one that acts in a closed loop alone the loop is closed.

    Attributes:
        t_0: Settling times are relative to this [s].
        began: Where the axes were before their first trial [inc], (num_axes,).
    """

    def __init__(self, target: Target, *, anew: bool = False, gains: tuple[str, ...] = ()) -> None:
        self.target = target
        self.num_machines = target.num_axes // target.axes_per_machine
        self.aborts = np.zeros(target.num_axes, np.int64)
        self.moves = np.zeros(target.num_axes, np.int64)
        self._anew = anew and target.drives.machine is not None
        motor = target.motor
        self.method = method_of(target.device, motor, gains)
        self.t_0 = self.method.t_0()
        self.highest = self.method.highest()
        self._fallback = FallbackGains(target.num_axes, motor.rated_current)
        self._drives = ObservedDrives(target.drives, self._fallback)
        self._trials = self.method.trials(self._drives, target.axes_per_machine)
        self._reach = longer_way(target.low, target.high)
        self._where = np.ones(target.num_axes, bool)
        self._direction = np.ones(target.num_axes, np.int64)
        self._was_enabled = ~self._trials.down()
        self._profile = {
            name: target.drives.read(name)
            for name in (cia402.PROFILE_VELOCITY, cia402.PROFILE_ACCELERATION, cia402.PROFILE_DECELERATION)
        }
        self._stops = 0

    @property
    def trials(self) -> Any:
        """What runs the trials."""
        return self._trials

    @property
    def reach(self) -> Floats:
        """How far the rotors may turn from where they began, the longer way, with its sign [rad], (num_axes,)."""
        return self._reach

    @property
    def origin(self) -> Integers:
        """Where the next trial starts [inc], (num_axes,)."""
        return self._origin

    def identify(self) -> None:
        """Find inertia and friction with gains from the data sheet alone; plan the moves, the rule's and safe gains."""
        target, drives = self.target, self.target.drives
        if self._anew:
            machine_of(drives).reset()
        present = read_gains(drives)
        gains = self.method.keep(self.method.first(target.supply), present)
        write_gains(drives, gains)  # before anything is enabled: the drives may have any
        check_motors(target.drives)
        self._trials.recover(self._where)
        drives.advance(CALM)
        self.identified, self._origin = self._moved(gains)
        self.began = self._origin.copy()
        self._trials.recover(self._where)
        reach = self._reach
        if self.method.measures_current:
            reach = trial_reach(target, self.identified.inertia, self.identified.offset, reach)
        self.move = self.method.plan(self.identified, drives.read(Role.POSITION_SCALE), reach)
        self.rule, self.safe = (
            self.method.keep(rule(self.identified, self.move, target.supply), present)
            for rule in (self.method.rule, self.method.safe)
        )
        self.incumbent = self.safe.copy()
        write_gains(drives, self.safe)
        drives.advance(TRIAL * CYCLE)  # the first gains may leave an axis swinging
        if self.method.measures_current:
            self._fallback.calm = self.safe

    @property
    def worst(self) -> tuple[float, ...]:
        """The objectives of gains of which it is known only that they are no good."""
        return math.log(1.0 + (SETTLED - PROFILE) * CYCLE / self.t_0), math.log(TRIP), 100.0

    def _moved(self, gains: Integers) -> tuple[Identified, Integers]:
        """Move there and back for identification; an axis that oscillates is switched off, and moves with softer gains.

        Raises:
            RuntimeError: If one oscillates with any.
        """
        target, drives = self.target, self.target.drives
        if not self.method.measures_current:
            self.moves += MOVES_OF_IDENTIFICATION
            return self._trials.identify(self._reach, self._where)
        noise = target.device.stage["adc_noise"].high
        scaler = drives.read(Role.POSITION_SCALE)
        holding = drives.read(cia402.TORQUE_ACTUAL) * ampere_per_count(drives)
        for _ in range(SOFTENINGS):
            began = drives.read(cia402.POSITION_ACTUAL)
            watch = OscillationWatch(self._where, np.full(target.num_axes, target.current), noise)
            watched = ObservedDrives(self._drives, watch)
            trials = self.method.trials(watched, target.axes_per_machine)
            self.moves += MOVES_OF_IDENTIFICATION
            with suppress(OscillationError):
                reach = trial_reach(target, GUESS * target.motor.inertia, holding, self._reach)
                found = trials.identify(reach, self._where)
            if not watch.swung.any():
                return found
            softer = target.device.gains.softened(gains, SOFTER, "velocity", "position")
            gains = np.where(watch.swung[:, None], softer, gains)
            write_gains(drives, gains, watch.swung)
            self._trials.recover(self._where)
            drives.advance(CALM)
            self._reach = self._reach - wrapped(drives.read(cia402.POSITION_ACTUAL) - began) / scaler * 2.0 * np.pi
        number = axis_number(drives, int(np.flatnonzero(watch.swung)[0]))
        raise RuntimeError(
            f"axis {number} oscillates in the moves of identification, even with 1/{SOFTER ** (SOFTENINGS - 1)} of the "
            "gains that its motor's data sheet gives; check motor and wiring"
        )

    def run(self, gains: Integers, where: Mask | None = None) -> Tried:
        """Try gains in a move, its reversal and the gain probe; what is stopped gets the incumbent back.

        Args:
            gains: Raw integers, shape (num_axes, count) in the order of the device's set.
            where: Machines that take part, (num_machines,); the others' figures mean nothing.
        """
        target = self.target
        axes = self._where if where is None else np.repeat(where, target.axes_per_machine)
        self._start_trial()
        self._return(axes)
        self._fallback.begin()
        told_causes(target.drives)  # of before
        try:
            tried = self._trials.run(gains, self.incumbent, self.move, self._origin, self._direction, axes)
        except SafetyError as error:  # the envelope has stopped all drives
            return self._stopped(axes, error)
        self._stops = 0
        # Until the next trial, and not those of the probe.
        write_gains(target.drives, np.where(self._fallback.calmed[:, None], self.safe, self.incumbent), axes)
        self._trials.recover(axes)
        if not (self._anew or self._trials.returns):  # it ends where its move did, and the next one goes the other way
            self._origin = np.where(axes, self._origin + self._direction * self.move.distance, self._origin)
            self._direction = np.where(axes, -self._direction, self._direction)
        self.moves[axes] += MOVES_OF_TRIAL
        stopped = tried.aborted.any(axis=0)
        self.aborts[axes & stopped] += 1
        objectives = self._objectives(tried)
        shape = (self.num_machines, target.axes_per_machine)
        causes = self._causes()
        fragile = axes & self._fallback.calmed
        return Tried(
            self._cost(gains, tried).reshape(shape).max(axis=1),
            objectives.reshape(*shape, -1).max(axis=1),
            np.any(stopped.reshape(shape), axis=1),
            np.any(fragile.reshape(shape), axis=1),
            causes,
        )

    def _causes(self) -> NDArray[np.str_]:
        """Return the emergencies since they were read last, of each machine; what several axes told stands once."""
        lanes, told = self.target.axes_per_machine, told_causes(self.target.drives)
        machines = (told[k : k + lanes] for k in range(0, len(told), lanes))
        return np.array([", ".join(dict.fromkeys(filter(None, axes))) for axes in machines], np.str_)

    def _stopped(self, axes: Mask, error: SafetyError) -> Tried:
        """Return the result of a trial that the envelope ended: everything that took part is stopped."""
        self._stops += 1
        if self._stops > MOST_STOPS:
            raise error
        write_gains(self.target.drives, self.incumbent, axes)
        self._trials.recover(axes)
        self.moves[axes] += 1
        self.aborts[axes] += 1
        shape = (self.num_machines, self.target.axes_per_machine)
        machines = np.any(axes.reshape(shape), axis=1)
        return Tried(
            np.full(shape[0], np.log(TRIP)),
            np.tile(self.worst, (shape[0], 1)),
            machines,
            np.zeros(shape[0], bool),
            self._causes(),
        )

    def _cost(self, gains: Integers, tried: Trial) -> Floats:
        """Return the cost of every axis, (num_axes,): what is slow beyond J's end is still told from what is slower."""
        relative = self.method.softness(gains) / self.method.softness(self.rule)
        # J is cut off at 30; with less of E_d, which enters as a factor, it is not.
        uncut = tried.costs(relative * _UNCUT) * _UNCUT**-E_D_EXPONENT
        worth = np.log(measured_cost(np.where(tried.aborted, TRIP, uncut)))
        end = np.log(TRIP)
        return np.asarray(np.where(worth > end, end + BEYOND * (worth - end), worth))

    def _objectives(self, tried: Trial) -> Floats:
        """Return the objectives of every axis, (num_axes, 3)."""
        terms, moves = tried.terms, tried.aborted[:2].any(axis=0)
        # Of a move that was stopped it is known only that it is no good: the slowest there is.
        speed = np.where(moves, self.worst[0], np.log(terms.settling[:2].max(axis=0)))
        # Without E_d/E_0, of which a probe with 1.5 times the gain has less in any case.
        j = self.method.cost(terms._replace(tripped=tried.aborted))
        worse = np.log(np.where(tried.aborted.any(axis=0), TRIP, j.max(axis=0) / j[:2].mean(axis=0)))
        return np.stack([speed, worse, 100.0 * self.method.current(terms)[:2].mean(axis=0)], axis=-1)

    def leave(self, gains: Integers) -> None:
        """Leave the drives with gains, otherwise as they were found, at standstill."""
        drives = self.target.drives
        write_gains(drives, gains)
        for name, values in self._profile.items():
            drives.write(name, values)
        if (off := ~self._was_enabled).any():
            drives.write(
                cia402.CONTROLWORD, cia402.SHUTDOWN, where=off
            )  # shutdown: a set-point is not taken up again when enabled anew
        self._trials.leave()

    def _start_trial(self) -> None:
        if self._anew:
            machine_of(self.target.drives).reset()
        self._trials.recover(self._where)

    def _return(self, axes: Mask) -> None:
        """Bring axes back with the incumbent that are not where the next trial starts: one tripped, and fell or ran."""
        drives = self.target.drives
        astray = self._astray(axes)
        if not astray.any():
            return
        write_gains(drives, self.incumbent, astray)
        write_profile(drives, self.move, astray)
        self._trials.go(self._origin, astray)
        # The ramp takes at most as long as the farthest way at its speed; slow gains then creep against friction.
        way = np.abs(wrapped(drives.read(cia402.POSITION_ACTUAL) - self._origin))
        longest = np.max(way / self.move.velocity, where=astray, initial=0.0)
        drives.advance(math.ceil(longest / CYCLE) * CYCLE)
        for _ in range(MOST_WAITING):
            drives.advance(TRIAL * CYCLE)
            if not self._astray(astray).any():
                break
        self.moves[astray] += 1
        self._trials.recover(astray)

    def _astray(self, axes: Mask) -> Mask:
        """Return which of the axes are too far from where the next trial starts, (num_axes,)."""
        way = np.abs(wrapped(self.target.drives.read(cia402.POSITION_ACTUAL) - self._origin))
        return np.asarray(axes & (way > ASTRAY * np.maximum(np.abs(self.move.distance), 1)))


def first_gains(target: Target) -> Integers:
    """Return gains from the data sheet alone, shape (num_axes, count)."""
    return method_of(target.device, target.motor).first(target.supply)
