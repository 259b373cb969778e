"""Trials of gains on a target: it is identified first, then gains are tried in moves, and costed from its signals.

The bench connects optimisers and drives: it starts from safe gains, keeps each axis within its travel, has an
oscillating axis stopped within 50 ms, and counts time and moves.
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
CALM = 0.1  # s until the axis' earlier motion has decayed
ASTRAY = 0.2  # of the move: an axis farther from the start of a trial is first brought back
MOST_WAITING = 8  # durations of a trial: longest wait until it is back
SOFTENINGS = 3  # of gains from the data sheet, if an axis oscillates with them
MOST_STOPS = 3  # stops of consecutive trials by the safety envelope before the search ends
BEYOND = 0.1  # slope of the cost above the value at which J saturates
E_D_EXPONENT = 0.4  # of E_d/E_0 in J (drive_env/trials/score.py)
_UNCUT = 1e-3
STALL = 60.0  # s that a sampler may compute while an enabled axis stands still

OBJECTIVES = ("speed", "robustness", "current")


def leave_oscillations_to_trials(drives: Drives) -> None:
    """Keep the envelope from ending a search when a trial itself stops an axis, or the sampler computes for long."""
    if drives.safety is not None:
        drives.safety.change(replace(drives.safety.limits, oscillation=False, stall=STALL))


class Tried(NamedTuple):
    """The result of a trial of gains on the machines.

    cost: ln J by measured terms of the worst axis of each machine, shape (num_machines,); above ln 30, where J
        saturates, it grows at a tenth of the rate.
    objectives: In the order of `OBJECTIVES`, smaller is better, shape (num_machines, 3): ln t_s/t_0 of the slower of
        move and reversal; ln of J of the worst phase (with velocity P x 1.5 among them) over the mean J of move and
        reversal; RMS increment of the current over the rated one [%], in open loop the RMS of the set currents.
    aborted: Stopped in any phase, shape (num_machines,).
    fragile: Still oscillating with the last good gains after it had been stopped, shape (num_machines,): these must be
        discarded.
    causes: Emergencies of the machine's drives during the trial as text, shape (num_machines,); "" without one.
    """

    cost: Floats
    objectives: Floats
    aborted: Mask
    fragile: Mask
    causes: NDArray[np.str_]


class TrialBench:
    """Trials of gains on all machines of a target at once.

    Args:
        target: The target to tune; its drives may have any gains, even 0.
        anew: Reset emulated machines to rest at position 0 before every trial, so that its result depends only on
            machine, gains and its number; drives on a bus continue from their present positions.
        gains: Names of the gains to be tried; with a gain that acts only in a closed loop, the loop is closed.

    Attributes:
        t_0: Settling time to which others are relative [s].
        began: Positions of the axes before their first trial [inc], shape (num_axes,).
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
        """The runner of the trials."""
        return self._trials

    @property
    def reach(self) -> Floats:
        """Signed angle from the first positions to the farther end of the travel [rad], shape (num_axes,)."""
        return self._reach

    @property
    def origin(self) -> Integers:
        """Positions at which the next trial starts [inc], shape (num_axes,)."""
        return self._origin

    def identify(self) -> None:
        """Identify inertia and friction with gains from the data sheet; plan the moves, the rule's and safe gains."""
        target, drives = self.target, self.target.drives
        if self._anew:
            machine_of(drives).reset()
        present = read_gains(drives)
        gains = self.method.keep(self.method.first(target.supply), present)
        write_gains(drives, gains)  # written before anything is enabled: the drives may have any gains
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
        drives.advance(TRIAL * CYCLE)  # with the first gains an axis may still oscillate
        if self.method.measures_current:
            self._fallback.calm = self.safe

    @property
    def worst(self) -> tuple[float, ...]:
        """The values of the objectives for gains that failed completely."""
        return math.log(1.0 + (SETTLED - PROFILE) * CYCLE / self.t_0), math.log(TRIP), 100.0

    def _moved(self, gains: Integers) -> tuple[Identified, Integers]:
        """Move there and back for identification; switch off axes that oscillate, and repeat with softer gains.

        Raises:
            RuntimeError: If an axis oscillates with all of these gains.
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
        """Try gains in a move, its reversal and the gain probe; stopped axes get the last good gains back.

        Args:
            gains: Raw integers in the order of the device's set, shape (num_axes, count).
            where: Machines that take part, shape (num_machines,); results of the others are meaningless.
        """
        target = self.target
        axes = self._where if where is None else np.repeat(where, target.axes_per_machine)
        self._start_trial()
        self._return(axes)
        self._fallback.begin()
        told_causes(target.drives)  # discards earlier ones
        try:
            tried = self._trials.run(gains, self.incumbent, self.move, self._origin, self._direction, axes)
        except SafetyError as error:  # the envelope has stopped all drives
            return self._stopped(axes, error)
        self._stops = 0
        # These gains stay until the next trial, instead of the probe's.
        write_gains(target.drives, np.where(self._fallback.calmed[:, None], self.safe, self.incumbent), axes)
        self._trials.recover(axes)
        if not (self._anew or self._trials.returns):  # the next trial goes back from the end of this move
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
        """Return the emergencies of each machine since they were last read, each text once."""
        lanes, told = self.target.axes_per_machine, told_causes(self.target.drives)
        machines = (told[k : k + lanes] for k in range(0, len(told), lanes))
        return np.array([", ".join(dict.fromkeys(filter(None, axes))) for axes in machines], np.str_)

    def _stopped(self, axes: Mask, error: SafetyError) -> Tried:
        """Return the result of a trial that the envelope ended: all axes that took part are stopped."""
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
        """Return the cost of every axis, shape (num_axes,); even above the saturation of J, slower gains cost more."""
        relative = self.method.softness(gains) / self.method.softness(self.rule)
        # J saturates at 30; with a smaller E_d, which is a factor of J, it does not.
        uncut = tried.costs(relative * _UNCUT) * _UNCUT**-E_D_EXPONENT
        worth = np.log(measured_cost(np.where(tried.aborted, TRIP, uncut)))
        end = np.log(TRIP)
        return np.asarray(np.where(worth > end, end + BEYOND * (worth - end), worth))

    def _objectives(self, tried: Trial) -> Floats:
        """Return the objectives of every axis, shape (num_axes, 3)."""
        terms, moves = tried.terms, tried.aborted[:2].any(axis=0)
        # A stopped move has no settling time: it gets the greatest value.
        speed = np.where(moves, self.worst[0], np.log(terms.settling[:2].max(axis=0)))
        # E_d/E_0 is left out: a probe with 1.5 times the gain always has less of it.
        j = self.method.cost(terms._replace(tripped=tried.aborted))
        worse = np.log(np.where(tried.aborted.any(axis=0), TRIP, j.max(axis=0) / j[:2].mean(axis=0)))
        return np.stack([speed, worse, 100.0 * self.method.current(terms)[:2].mean(axis=0)], axis=-1)

    def leave(self, gains: Integers) -> None:
        """Write final gains, restore the other settings, and switch off axes that were off before; at standstill."""
        drives = self.target.drives
        write_gains(drives, gains)
        for name, values in self._profile.items():
            drives.write(name, values)
        if (off := ~self._was_enabled).any():
            drives.write(
                cia402.CONTROLWORD, cia402.SHUTDOWN, where=off
            )  # Shutdown: the drive does not continue to an old set-point when it is enabled again
        self._trials.leave()

    def _start_trial(self) -> None:
        if self._anew:
            machine_of(self.target.drives).reset()
        self._trials.recover(self._where)

    def _return(self, axes: Mask) -> None:
        """Bring axes that tripped and moved away back to the start of the next trial, with the last good gains."""
        drives = self.target.drives
        astray = self._astray(axes)
        if not astray.any():
            return
        write_gains(drives, self.incumbent, astray)
        write_profile(drives, self.move, astray)
        self._trials.go(self._origin, astray)
        # The ramp takes at most as long as the longest way at its speed; slow gains then creep against friction.
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
        """Return the axes that are too far from the start of the next trial, shape (num_axes,)."""
        way = np.abs(wrapped(self.target.drives.read(cia402.POSITION_ACTUAL) - self._origin))
        return np.asarray(axes & (way > ASTRAY * np.maximum(np.abs(self.move.distance), 1)))


def first_gains(target: Target) -> Integers:
    """Return gains computed from the data sheet alone, shape (num_axes, count)."""
    return method_of(target.device, target.motor).first(target.supply)
