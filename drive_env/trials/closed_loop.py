"""One trial of the gains of a stepper's closed loop: a ramp that overloads the motor, and how the axis catches up.

Within the motor's torque the corrections of a closed loop have no effect. So the ramp of the trial asks for more than
the run current gives: the axis falls behind by `BEHIND` full steps, and the corrections bring it back to the demand. A
light load is overloaded by a smaller run current during the trial. Only signals of a master are used: encoder, demand,
and 6077h, which is the torque current once the encoder commutates.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from drive_env import cia402
from drive_env.devices import Device
from drive_env.devices.gain_set import ClosedLoop
from drive_env.dictionary.roles import Role
from drive_env.drives.currents import ampere_per_count
from drive_env.drives.interface import CYCLE, Drives, device_of
from drive_env.drives.raw_gains import read_gains, write_gains
from drive_env.motors import Motor
from drive_env.phase_current import amplitude, holding_torque, rated_setting, run_and_standby
from drive_env.trials.gain_trial import PHASES, Identified, Trials
from drive_env.trials.open_loop import OPEN, TOOTH, OpenLoopTrials, with_run_current
from drive_env.trials.oscillation import OSCILLATION
from drive_env.trials.positioning import PROFILE, TRAVEL_SHARE, TRIAL, Move, move_terms, wrapped, write_profile
from drive_env.trials.score import Terms, cost
from mechanics.arrays import Floats, Integers, Mask

BEHIND = 3.0  # full steps by which the axis falls behind the ramp; up to one the field holds it
OVERLOAD = 4.0  # acceleration of the ramp over that which the trial's run current gives
FAST = 1.5  # speed of the ramp over the rated one, up to which the supply can drive the rated current
_LEFT = 1.0 - 1.0 / OVERLOAD
LEAST_SHARE = 0.3  # of the rated current: with less the detent torque dominates
FRICTION_SHARE = 0.5  # of the trial's torque: greatest share of friction and constant load
PROBE = 0.8  # run current of the probe over that of the trial: increases the overload
CLOSING, LONGEST_CLOSING = 0.6, 3.2  # s: the rotor settles in 0.4 s, at most 3 s
LOOK = 0.05  # s between two checks
SWINGING = 2.0  # times the change of the current by the rotor's own swing: a larger one is an oscillation of the loop


def swing_change(motor: Motor, inertia: Floats, current: Floats) -> Floats:
    """Return the change of the torque current per ms [A, RMS] during the largest swing of a rotor, (num_axes,).

    After an overload the rotor swings in its field at sqrt(n_p T / J), and the torque current goes from limit to limit
    until the swing has decayed: this is no oscillation of the loop.

    Args:
        motor: The motor.
        inertia: Total inertia at the rotor [kg m^2].
        current: Amplitude of the run current [A].
    """
    omega = np.sqrt(motor.n_p * holding_torque(motor, current) / inertia)
    return np.asarray(current * omega * CYCLE / np.sqrt(2.0))


class ClosedLoopTrial(NamedTuple):
    """The result of a trial, with the interface of `gain_trial.Trial`."""

    terms: Terms  # its disturbance is (1 + b/t_0), with the time b by which the axis is behind its demand
    following: Floats
    aborted: Mask
    error: Floats
    culprit: Mask

    def costs(self, softness: Floats) -> Floats:
        """Return J by measured terms of every phase, (phases, num_axes); `softness` is a factor of E_d/E_0."""
        return cost(self.terms._replace(disturbance=self.terms.disturbance * softness, tripped=self.aborted))


def full_step(motor: Motor) -> float:
    """Return a full step [rad]."""
    return 2.0 * np.pi / (TOOTH * motor.n_p)


def held_in_trial(device: Device, motor: Motor, share: Floats) -> Floats:
    """Return the torque [N m] that a share of the rated run current can hold, (num_axes,)."""
    return holding_torque(motor, share * float(amplitude(device, rated_setting(device, motor))))


def trial_share(device: Device, motor: Motor, found: Identified) -> Floats:
    """Return the share of the rated run current with which the axes fall behind a ramp by `BEHIND`, (num_axes,)."""
    speed = FAST * motor.rated_speed
    torque = found.inertia * speed**2 * _LEFT / (2.0 * BEHIND * full_step(motor))
    taken = motor.torque_constant * (found.coulomb + np.abs(found.offset) + found.viscous * speed)
    # Saturation of the iron, as in `phase_current.current_for`.
    needed = np.maximum(torque, taken / FRICTION_SHARE) / motor.torque_constant
    current = needed / np.sqrt(np.maximum(1.0 - motor.saturation * needed**2, 1e-6))
    return np.clip(current / float(amplitude(device, rated_setting(device, motor))), LEAST_SHARE, 1.0)


def plan_overload(device: Device, motor: Motor, found: Identified, scaler: ArrayLike, reach: ArrayLike) -> Move:
    """Plan a move of 60 ms whose ramp asks for `OVERLOAD` times the torque of the trial's run current.

    Until the motor reaches the ramp's speed v with torque T, it falls behind by J v^2 (1 - 1/r) / 2 T, with the
    overload r: a heavy load gets a slower ramp.

    Args:
        device: The drive.
        motor: The motor.
        found: The identified axes, (num_axes,).
        scaler: Increments per revolution.
        reach: Signed angle that the rotor may turn [rad].
    """
    to, time = np.asarray(reach, float), PROFILE * CYCLE
    share = trial_share(device, motor, found)
    given = held_in_trial(device, motor, share) / found.inertia
    acceleration = OVERLOAD * given
    fastest = np.minimum(FAST * motor.rated_speed, np.sqrt(2.0 * BEHIND * full_step(motor) * given / _LEFT))
    speed = np.minimum(fastest, 0.5 * acceleration * time)
    angle = np.minimum(speed * (time - speed / acceleration), TRAVEL_SHARE * np.abs(to))
    # A short way takes its 60 ms at a lower speed.
    root = np.sqrt(np.maximum((acceleration * time) ** 2 - 4.0 * acceleration * angle, 0.0))
    speed = 0.5 * (acceleration * time - root)
    increments = np.broadcast_to(np.asarray(scaler, float), angle.shape) / (2.0 * np.pi)
    return Move(
        np.rint(np.copysign(angle, to) * increments).astype(np.int64),
        np.ceil(speed * increments).astype(np.int64) + 1,
        np.ceil(np.maximum(acceleration * increments, 1.0)).astype(np.int64),
        increments,
        motor.encoder_counts / (2.0 * np.pi),
        share,
    )


class ClosedLoopTrials(OpenLoopTrials):
    """Runs trials on steppers with closed loop, as `Trials` does on servo drives.

    The machine is identified with open loop; then the loop is closed, until `leave` restores it.
    """

    STATE = (*OpenLoopTrials.STATE, "_closes", "_inertia")
    computes_demand = False  # the lag behind the demand is what shows the loop, so the demand must be recorded

    def __init__(self, drives: Drives, motor: Motor, axes: int, t_0: float, closed: ClosedLoop) -> None:
        super().__init__(drives, motor, axes, t_0)
        self._closed = closed
        self._closes = np.zeros(drives.num_axes if drives is not None else 0, bool)
        self._inertia = np.full(self._closes.shape, np.inf)

    def recover(self, where: Mask) -> None:
        """Bring axes to pp, enabled, and close the loops of identified ones."""
        super().recover(where)
        self._watch_no_window()
        self._close(where & self._closes, LONGEST_CLOSING)

    def power_up(self, where: Mask) -> None:
        """Enable newly switched-on drives in pp, and close loops, in a fixed number of milliseconds."""
        super().power_up(where)
        if self._closes.any():
            self._drives.write(Role.LOOP_MODE, self._closed.mode, where=where & self._closes)
            self._drives.advance(CLOSING)

    def identify(self, reach: Floats, where: Mask) -> tuple[Identified, Integers]:
        """Identify with open loop, and mark the loops to be closed."""
        drives = self._drives
        self._closes &= ~where
        drives.write(Role.LOOP_MODE, OPEN, where=where)
        drives.advance(LOOK)
        found, origin = super().identify(reach, where)
        self._closes |= where
        self._inertia = np.where(where, found.inertia, self._inertia)
        return found, origin

    def go(self, target: Integers, where: Mask) -> None:
        """Start a move to a position of the encoder, which is the drive's own with closed loop."""
        closed = where & self._closes
        if closed.any():
            Trials.go(self, target, closed)
        if np.any(where & ~closed):
            super().go(target, where & ~closed)

    def run(  # type: ignore[override]
        self, gains: Integers, incumbent: Integers, move: Move, origin: Integers, direction: Integers, where: Mask
    ) -> ClosedLoopTrial:
        """Try gains in a move from the origin, back, and there again with less current; otherwise as `Trials.run`."""
        drives, count = self._drives, self._drives.num_axes
        away = origin + direction * move.distance
        shape = (len(PHASES), count)
        aborted = np.zeros(shape, bool)
        stopped, culprit = ~self._is_closed() & where, np.zeros(count, bool)
        settling, noise, overshoot, following = (np.zeros(shape) for _ in range(4))
        first_error = np.zeros((TRIAL, count))
        size = np.maximum(np.abs(move.distance), 1)
        write_profile(drives, move, where)
        for phase, target in enumerate((away, origin, away)):
            tried = self._tried(gains, move, is_probe=phase == len(PHASES) - 1)
            write_gains(drives, np.where(stopped[:, None], incumbent, tried), where)
            position, demand, current, stopped, new = self._phase(target, incumbent, stopped, where)
            culprit |= new
            aborted[phase] = stopped
            sign = np.where(move.distance < 0, -1, 1) * direction * (-1 if phase == 1 else 1)
            settling[phase], noise[phase], overshoot[phase] = self._terms(position, current, move, target, sign)
            assert demand is not None, "it is recorded, or the drive refuses"
            error = wrapped(demand - position)
            following[phase] = np.abs(error / self._following_scale(move)).sum(axis=0) * CYCLE
            if phase == 0:
                first_error = error / size
        write_gains(drives, np.where(stopped[:, None], incumbent, gains), where)
        terms = Terms(settling, 1.0 + following / self._t_0, noise, overshoot, aborted)
        return ClosedLoopTrial(terms, np.maximum(following, 0.5 * CYCLE), aborted, first_error, culprit)

    def _tried(self, gains: Integers, move: Move, *, is_probe: bool) -> Integers:
        """Return the gains of a phase of the trial: with the trial's or the probe's run current."""
        return with_run_current(device_of(self._drives), gains, (PROBE if is_probe else 1.0) * move.share)

    def _terms(
        self, position: Floats, current: Floats, move: Move, target: Integers, sign: Integers
    ) -> tuple[Floats, Floats, Floats]:
        """Return t_s/t_0, n and os of a phase, (num_axes,) each."""
        ampere = current * ampere_per_count(self._drives)
        return move_terms(position, ampere, move, self._t_0, self._motor.rated_current, target, sign)

    def _shaking(self, trace: Mapping[Any, Integers]) -> Mask:
        """Return which axes' currents change more from ms to ms than those of a stable loop and a swinging rotor."""
        change = np.diff(trace[cia402.TORQUE_ACTUAL] * ampere_per_count(self._drives), axis=0)
        run, _ = run_and_standby(device_of(self._drives), read_gains(self._drives))
        most = np.maximum(
            OSCILLATION * self._motor.rated_current, SWINGING * swing_change(self._motor, self._inertia, run)
        )
        return np.asarray(np.sqrt(np.mean(change**2, axis=0)) > most)

    def _following_scale(self, move: Move) -> Floats:
        """Return the scale of the integral of |demand - encoder| [inc]."""
        return np.maximum(np.abs(move.distance), 1).astype(float)

    def _close(self, where: Mask, longest: float) -> None:
        """Close open loops and wait until the encoder commutates; the trial stops an axis whose loop stays open."""
        drives = self._drives
        if not np.any(opened := where & ~self._is_closed()):
            return
        drives.write(Role.LOOP_MODE, self._closed.mode, where=opened)
        for _ in range(round(longest / LOOK)):
            drives.advance(LOOK)
            if not np.any(opened & ~self._is_closed()):
                break

    def _is_closed(self) -> Mask:
        """Return which loops are closed; load angle control also needs the encoder to commutate."""
        drives = self._drives
        asked = drives.read(Role.LOOP_MODE) == self._closed.mode
        return np.asarray(asked & (self._closed.is_pid | (drives.read(Role.LOOP_INITIALISED) != 0)))
