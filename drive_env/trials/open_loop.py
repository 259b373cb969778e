"""One trial of the currents of an open-loop stepper: a move, the reversal, and the current probe.

No loop is closed, and no torque current is measured: 6077h, if it exists, is the size of the set current. A master can
compare the encoder with the step counter: their difference is the load angle, whose sine is the torque over the holding
torque, and it jumps by four full steps if the motor loses steps. Inertia, friction, settling, load angle, vibration and
lost steps are all computed from it. The cost of the currents is known from their settings.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drive_env import cia402
from drive_env.devices import Device
from drive_env.devices.gain_set import RUN
from drive_env.dictionary.roles import Role
from drive_env.drives import motion
from drive_env.drives.interface import CYCLE, Drives, axis_number, device_of
from drive_env.drives.raw_gains import read_gains, write_gains
from drive_env.drives.speeds import per_increment
from drive_env.motors import Motor
from drive_env.phase_current import amplitude, holding_torque, rated_setting, run_and_standby
from drive_env.trials.gain_trial import PHASES, Identified, Trials, clear, momentum_balance, samples_in_motion
from drive_env.trials.positioning import (
    ACCELERATION_SHARE,
    BAND,
    BAND_COUNTS,
    PROFILE,
    SETTLED,
    TRIAL,
    WATCH,
    Move,
    highest_ramp,
    plan_move,
    start,
    wrapped,
    write_profile,
)
from drive_env.trials.rotor_swing import EXPLAINED, LENGTH, FreeSwing, inertia_of_swings
from drive_env.trials.score import below_trip
from mechanics.arrays import Floats, Integers, Mask

PROBE = 0.8  # run current of the probe over that of the trial
LOST = 2.0  # full steps between field and rotor: beyond the unstable balance, from where it falls to the next tooth
TOOTH = 4.0  # full steps by which a rotor falls behind when it loses steps
BAND_STEPS = 0.05  # of a full step, least settling band: dry friction holds an axis away from the field's angle
ENCODER, NO_WINDOW = 0, 0  # values of 606Ah and 6065h
OPEN = 0  # of `Role.LOOP_MODE`
STILL = 20  # samples at rest over which demand and encoder are compared
REST, LONGEST_ROLL = 0.25, 100  # full steps between two checks, of a rotor at rest; greatest number of checks
TURNING_BACK = 10  # ms within which a swinging rotor reverses
LEAST_WAY = 0.25  # of a move, that an encoder must show
# Total inertias, in rotors, for which the moves of identification are planned, in this order, until no steps are lost.
TRIED_ROTORS = (3.0, 12.0, 48.0, 192.0)

# The swing by which the inertia of a light load is found: its step and the distance of its two positions [full steps],
# time for the last swing to decay [s], speed and ramps in full steps, up to the drive's limits.
SWING_STEP, SWING_APART, SWING_REST = 0.25, 0.5, 0.1
SWING_ROOM = 1.5  # full steps of travel that a swing with overshoot needs
STEEP = {cia402.PROFILE_VELOCITY: 1e3, cia402.PROFILE_ACCELERATION: 2e7, cia402.PROFILE_DECELERATION: 2e7}
_STEEPNESS = tuple(STEEP)
HIGHEST_SHARE = 0.95  # of the greatest value that a drive accepts
RAMP_ANGLE = 0.3  # sine of the load angle in the ramp, above which the ramp gives the inertia
STIFF_SHARE = 0.6  # of the ramp's inertia: a smaller result means that the rotor swung against an elastic load

# Scales of the terms of J.
LOAD_ANGLE = 0.5  # full steps, 45 degrees electrical: 30 % of the torque are left
VIBRATION = 0.1  # full steps from millisecond to millisecond
OVERSHOOT_FREE, OVERSHOOT_SCALE = 0.02, 0.1


# Share of the holding torque that a ramp may apply suddenly: the rotor then swings beyond the angle of the torque, and
# returns up to 0.725 of it (equal areas under the sine of the torque). AT_SPEED is a reserve for the missing current at
# speed.
PULLED_AT_ONCE = 0.725
AT_SPEED = 0.9
LEAST_ACCELERATION = 0.15  # of the rated torque, even if friction takes nearly all of it


def acceleration_share(device: Device, motor: Motor, taken: ArrayLike = 0.0) -> Floats:
    """Return the share of the rated torque that may accelerate an axis in a trial without lost steps in its probe.

    Args:
        device: The drive, which may be limited below the motor's rated current.
        motor: The motor.
        taken: Torque of friction and a constant load [N m], (num_axes,).
    """
    held = holding_torque(motor, PROBE * amplitude(device, rated_setting(device, motor)))
    free = AT_SPEED * PULLED_AT_ONCE * held - np.asarray(taken, float) - motor.cogging_torque
    return np.asarray(np.clip(free / motor.rated_torque, LEAST_ACCELERATION, ACCELERATION_SHARE))


class OpenLoopTerms(NamedTuple):
    """The terms of J of an open-loop stepper, all of the same shape.

    settling: t_s/t_0.
    disturbance: E_d/E_0.
    noise: Vibration of the rotor about the field [full steps].
    overshoot: Over the move.
    tripped: A fault, or lost steps.
    load_angle: Greatest load angle [full steps]; one is 90 degrees electrical.
    effort: Mean square of the set currents over the rated one.
    """

    settling: Floats
    disturbance: Floats
    noise: Floats
    overshoot: Floats
    tripped: Mask
    load_angle: Floats
    effort: Floats

    def each(self, function: Callable[[NDArray[Any]], NDArray[Any]]) -> OpenLoopTerms:
        """Return the terms with a function applied to each."""
        return OpenLoopTerms(*map(function, self))


def open_loop_cost(terms: OpenLoopTerms) -> Floats:
    """Return J of an open-loop stepper from its terms, in their shape.

    J = (t_s/t_0)^0.4 (E_d/E_0)^0.4 q^0.4 (1 + (a/0.5)^2)^0.2 (1 + (n/0.1)^2)^0.2 (1 + max(0, os - 2 %)/10 %)

    with q the effort, a the load angle and n the vibration in full steps; beyond 15 it is bent as in `score.cost`, and
    lost steps cost 30. The ripple of the current in a servo's J is missing, since the drive does not measure its
    current.
    """
    raw = (
        terms.settling**0.4
        * terms.disturbance**0.4
        * terms.effort**0.4
        * (1.0 + (terms.load_angle / LOAD_ANGLE) ** 2) ** 0.2
        * (1.0 + (terms.noise / VIBRATION) ** 2) ** 0.2
        * (1.0 + np.maximum(0.0, terms.overshoot - OVERSHOOT_FREE) / OVERSHOOT_SCALE)
    )
    return below_trip(raw, terms.tripped)


class OpenLoopTrial(NamedTuple):
    """The result of a trial, with the interface of `gain_trial.Trial`; stopped axes had lost steps or tripped.

    lost: Whether steps were lost, (phases, num_axes).
    """

    terms: OpenLoopTerms  # its disturbance is 1
    following: Floats
    aborted: Mask
    error: Floats
    culprit: Mask
    lost: Mask

    def costs(self, softness: Floats) -> Floats:
        """Return J by measured terms of every phase, (phases, num_axes).

        Args:
            softness: Softness of the trial's currents over that of the rule's, (num_axes,), as a factor of E_d/E_0.
        """
        disturbance = np.broadcast_to(softness, self.aborted.shape)
        return open_loop_cost(self.terms._replace(disturbance=disturbance, tripped=self.aborted))


def unmeasured(device: Device) -> str:
    """Return why an open loop has no torque current to score, for messages."""
    if (cia402.TORQUE_ACTUAL, 0) in device.bindings:
        return "in open loop 6077h is the size of the current that is set"
    return "no 6077h"


def _highest(drives: Drives, name: int) -> float:
    """Return the greatest value of an object that drives accept, less a reserve for rounding of the profile."""
    high = device_of(drives).new_dictionary().find(name).high
    assert high is not None, "ramps and speeds are numbers"
    return HIGHEST_SHARE * high


def encoder_age(device: Device) -> float:
    """Return the age of an encoder's count when it is read [s]: it is sampled once per period of the motion loops."""
    return 1.0 / device.velocity_rate


def open_loop_softness(device: Device, gains: Integers) -> Floats:
    """Return a number proportional to the deflection by a load at rest, (num_axes,): one over the standby current.

    Load steps are impossible on a bus; but a rotor in its field is turned by T / (n_p T_hold), and the holding torque
    follows from the current.
    """
    return np.asarray(1.0 / run_and_standby(device, gains)[1])


def effort(device: Device, motor: Motor, gains: Integers) -> Floats:
    """Return the mean square of the set currents over the rated one, (num_axes,): copper loss of a trial.

    The run current counts during the profile, the standby current during the rest. Effects that lower the current
    (CoolStep) or delay it (the standby delay) are ignored, since a bus does not show them.
    """
    run, standby = run_and_standby(device, gains)
    share = PROFILE / TRIAL
    return np.asarray((share * run**2 + (1.0 - share) * standby**2) / motor.rated_current**2)


def with_run_current(device: Device, gains: Integers, factor: float | Floats) -> Integers:
    """Scale the run current of gains, shape (n, count), by a factor, rounded down."""
    column = device.gains.column(*RUN)
    assert column is not None, "an open loop has a run current"
    changed = gains.copy()
    changed[:, column] = np.clip(np.floor(gains[:, column] * factor), 1, device.gains.rows[column].highest)
    return changed


class OpenLoopTrials(Trials):
    """Runs trials on open-loop steppers, as `Trials` does on servo drives; the axes of a machine are stopped together.

    During trials nothing reacts to the load reading unless `acts_by_load` is set: no stall stops an axis, no CoolStep
    lowers its current. While the drives are disabled, 606Ah is set to the encoder, a closed loop is opened, and 6065h
    is switched off, since it would keep axes with lost steps from being enabled again; `sensor`, `loop` and `window`
    are the values before. Positions are the encoder's; lost steps are added to the targets that the step counter gets.
    """

    STATE: tuple[str, ...] = ("sensor", "window", "loop", "acts_by_load", "_speeds", "_zero", "_fell")

    def __init__(self, drives: Drives, motor: Motor, axes: int, t_0: float) -> None:
        super().__init__(drives, motor, axes, t_0)
        self.sensor: Integers | None = None
        self.window: Integers | None = None
        self.loop: Integers | None = None
        self.acts_by_load = False
        self._speeds: dict[Role, Integers] = {}  # speeds of load detection and CoolStep before the trials
        self._zero: Floats | None = None
        self._fell = False  # steps were lost, and the rotor may still be moving to the next tooth

    def recover(self, where: Mask) -> None:
        """Bring axes in any state to pp, enabled, with the encoder as position sensor."""
        drives = self._drives
        now = drives.read(cia402.SENSOR_SELECTION)
        if self.sensor is None:
            self.sensor, self.window = now, drives.read(cia402.FOLLOWING_WINDOW)
            self._open_loop()
            if np.any(self.window):
                drives.write(cia402.FOLLOWING_WINDOW, NO_WINDOW)
        self._let_load_alone(where)
        blind = where & (now != ENCODER)
        if blind.any():
            on = blind & ~self.down()
            if on.any():
                motion.disable(drives, where=on)
            drives.write(cia402.SENSOR_SELECTION, ENCODER, where=blind)
        if not drives.time_waits and np.all(self.down()):
            self._prepare(self._recorded())
        super().recover(where)

    def _recorded(self) -> list[Any]:
        """Return all objects of a trial: some drives cannot change their mapping while an axis is enabled."""
        objects: list[Any] = [cia402.POSITION_ACTUAL, cia402.POSITION_DEMAND, cia402.STATUSWORD]
        return [*objects, cia402.TORQUE_ACTUAL] if device_of(self._drives).gains.closed_loops else objects

    def power_up(self, where: Mask) -> None:
        """Enable newly switched-on drives in pp, with the encoder as position sensor."""
        self._drives.write(cia402.SENSOR_SELECTION, ENCODER, where=where)
        self._watch_no_window()
        self._let_load_alone(where)
        super().power_up(where)

    def _let_load_alone(self, where: Mask) -> None:
        """Disable reactions to the load reading: stop on stall with speed 0, CoolStep with a speed above all."""
        drives, device = self._drives, device_of(self._drives)
        if self.acts_by_load:
            return
        for role in (Role.STALL_SPEED, Role.COOLSTEP_SPEED):
            if (key := device.roles.get(role)) is not None:
                now = drives.read(role)
                self._speeds.setdefault(role, now)
                off = 0 if role is Role.STALL_SPEED else device.new_dictionary().find(key).high
                assert off is not None, "a speed is a number"
                if np.any(acting := where & (now != off)):
                    drives.write(role, off, where=acting)

    def _watch_no_window(self) -> None:
        """Switch 6065h off, which newly switched-on drives have on: the encoder shows axes that fall behind."""
        drives = self._drives
        if np.any(watched := drives.read(cia402.FOLLOWING_WINDOW) != NO_WINDOW):
            drives.write(cia402.FOLLOWING_WINDOW, NO_WINDOW, where=watched)

    def _open_loop(self) -> None:
        """Open the loops that drives have closed: with a closed loop the load angle has another meaning."""
        drives = self._drives
        if Role.LOOP_MODE in device_of(drives).roles:
            self.loop = drives.read(Role.LOOP_MODE)
            if np.any(closed := self.loop != OPEN):
                drives.write(Role.LOOP_MODE, OPEN, where=closed)

    def leave(self) -> None:
        """Restore 606Ah, 6065h, the loop's mode and the speeds of load detection; the axes must be disabled."""
        if self.loop is not None and np.any(opened := self._drives.read(Role.LOOP_MODE) != self.loop):
            self._drives.write(Role.LOOP_MODE, self.loop, where=opened)
        for role, values in self._speeds.items():
            if np.any(off := self._drives.read(role) != values):
                self._drives.write(role, values, where=off)
        if self.sensor is not None:
            assert self.window is not None, "both are read at once"
            if np.any(drifted := self._drives.read(cia402.FOLLOWING_WINDOW) != self.window):
                self._drives.write(cia402.FOLLOWING_WINDOW, self.window, where=drifted)
            changed = self._drives.read(cia402.SENSOR_SELECTION) != self.sensor
            if changed.any():
                self._drives.write(cia402.SENSOR_SELECTION, self.sensor, where=changed)

    def go(self, target: Integers, where: Mask) -> None:
        """Start a move to a position of the encoder."""
        start(self._drives, wrapped(target + self.shift()).astype(np.int64), where)

    def identify(self, reach: Floats, where: Mask) -> tuple[Identified, Integers]:
        """Identify axes by their load angles in moves there and back with the present currents; return starts [inc].

        The inertia is unknown: an axis that loses steps in moves for a light load repeats them more slowly, while the
        others stand.

        Raises:
            RuntimeError: If an encoder hardly moved.
        """
        drives, motor, count = self._drives, self._motor, self._drives.num_axes
        drives.advance(STILL * CYCLE)
        self._zero = None
        self.shift()
        origin = drives.read(cia402.POSITION_ACTUAL)
        scaler = drives.read(Role.POSITION_SCALE)
        most, share = highest_ramp(device_of(drives)), acceleration_share(device_of(drives), motor)
        left = where.copy()
        found, before = None, None
        for rotors in TRIED_ROTORS:
            move = plan_move(motor, np.full(count, rotors * motor.inertia), scaler, reach, most, share)
            if before is not None and np.all((move.distance == before)[left]):
                continue  # limited by speed or travel instead of inertia: it would lose the same steps
            before = move.distance
            seen, position, lost = self._identify_by(move, origin, reach, left)
            # Axes that take no part keep the values of the first move: a plan cannot use an inertia of 0.
            found = Identified(*(np.where(left, a, b) for a, b in zip(seen, found or seen, strict=True)))
            self._check_moved(position, move, left & ~lost)
            if not np.any(again := left & lost):
                break
            left = again
            self._start_anew(left, np.asarray(scaler / (TOOTH * motor.n_p), float))
            origin = np.where(left, drives.read(cia402.POSITION_ACTUAL), origin)
        self._check_moved(position, move, left)
        assert found is not None, "some move is the first"
        return found, origin

    def _start_anew(self, where: Mask, full_step: Floats) -> None:
        """Bring axes that lost steps to rest, enabled, and count their steps from here."""
        drives = self._drives
        if np.any(on := where & ~self.down()):  # the steps end, and the rotor synchronises with the field
            drives.write(cia402.CONTROLWORD, cia402.ENABLE_OPERATION | cia402.HALT, where=on)
        drives.advance(STILL * CYCLE)
        self._come_to_rest(full_step)
        self.recover(where)
        drives.advance(STILL * CYCLE)
        now = wrapped(drives.read(cia402.POSITION_DEMAND) - drives.read(cia402.POSITION_ACTUAL))
        self._zero = np.where(where, now, 0.0 if self._zero is None else self._zero)

    def _identify_by(self, move: Move, origin: Integers, reach: Floats, where: Mask) -> tuple[Identified, Floats, Mask]:
        """Move there and back, and swing; return the identified axes, the encoder's way, and axes that lost steps."""
        drives, motor = self._drives, self._motor
        write_profile(drives, move, where)
        objects = [cia402.POSITION_ACTUAL, cia402.POSITION_DEMAND]
        traces = []
        self._prepare(objects)
        for target in (origin + move.distance, origin):
            shift = self.shift()
            self.go(target, where)
            trace = self._record(objects, TRIAL)
            traces.append((trace[cia402.POSITION_ACTUAL], trace[cia402.POSITION_DEMAND] - shift))
        position, demand = (np.concatenate(parts) for parts in zip(*traces, strict=True))
        angle = wrapped(position - origin) / move.increments
        lag = wrapped(demand - position) / move.increments
        tooth = 2.0 * np.pi / motor.n_p
        lost = (np.abs(lag) > LOST / TOOTH * tooth).any(axis=0) | self.down()
        held = holding_torque(motor, run_and_standby(device_of(drives), read_gains(drives))[0])
        lag -= np.gradient(wrapped(demand - origin) / move.increments, axis=0) / CYCLE * encoder_age(device_of(drives))
        # The sine of the rotor's angle in the field gives its torque; converted to a current by the torque constant.
        current = held * np.sin(motor.n_p * lag) / motor.torque_constant
        speed = np.gradient(angle, CYCLE, axis=0)
        moving = samples_in_motion(speed, TURNING_BACK)
        found = momentum_balance(angle, speed, current, motor, moving=moving)
        has_room = where & ~lost & (np.abs(reach) > SWING_ROOM * 2.0 * np.pi / (TOOTH * motor.n_p))
        if not has_room.any():
            return found, position, lost
        swing = self._swing(origin, move, has_room, held)
        # With a heavy load the ramp is more precise than the swing, in which an elastic load takes no part.
        light = has_room & (swing.inertia * move.acceleration / move.increments < RAMP_ANGLE * held)
        light &= swing.inertia > STIFF_SHARE * found.inertia
        if (trusted := light & (swing.explained > EXPLAINED)).any():
            inertia = np.where(trusted, swing.inertia, found.inertia)
            known = momentum_balance(angle, speed, current, motor, inertia, moving)
            found = Identified(*(np.where(trusted, a, b) for a, b in zip(known, found, strict=True)))
        return found, position, lost

    def _swing(self, origin: Integers, move: Move, where: Mask, held: Floats) -> FreeSwing:
        """Let the rotors swing after steps of a quarter of a full step, here and half a full step from here."""
        drives, motor = self._drives, self._motor
        full_step = 2.0 * np.pi * move.increments / (TOOTH * motor.n_p)
        toward = np.where(move.distance < 0, -1.0, 1.0) * full_step
        before = {name: drives.read(name) for name in _STEEPNESS}
        for name in _STEEPNESS:
            most = np.minimum(STEEP[name] * full_step * per_increment(drives, name), _highest(drives, name))
            drives.write(name, most.astype(np.int64), where=where)
        objects = [cia402.POSITION_ACTUAL, cia402.POSITION_DEMAND]
        places = []
        self._prepare(objects)
        for place in (0.0, SWING_APART):
            self.go(np.rint(origin + place * toward).astype(np.int64), where)
            drives.advance(SWING_REST)
            self.go(np.rint(origin + (place + SWING_STEP) * toward).astype(np.int64), where)
            trace = self._record(objects, LENGTH)
            places.append([wrapped(trace[name] - trace[name][0]) / move.increments for name in objects])
        self.go(origin, where)
        drives.advance(SWING_REST)
        for name, value in before.items():
            drives.write(name, value, where=where)
        position, demand = (np.stack(parts) for parts in zip(*places, strict=True))
        return inertia_of_swings(demand, position, held, encoder_age(device_of(drives)), motor)

    def run(  # type: ignore[override]
        self, gains: Integers, incumbent: Integers, move: Move, origin: Integers, direction: Integers, where: Mask
    ) -> OpenLoopTrial:
        """Try currents in a move from the origin, back, and there again with less; otherwise as `Trials.run`.

        If an axis loses steps or goes into fault, its machine stops, gets the incumbent gains back and continues.
        """
        drives, device, count = self._drives, device_of(self._drives), self._drives.num_axes
        away = origin + direction * move.distance
        shape = (len(PHASES), count)
        aborted, lost = np.zeros(shape, bool), np.zeros(shape, bool)
        stopped, culprit = np.zeros((2, count), bool)
        settling, noise, overshoot, following, load_angle, efforts = (np.zeros(shape) for _ in range(6))
        first_error = np.zeros((TRIAL, count))
        size = np.maximum(np.abs(move.distance), 1).astype(float)
        full_step = 2.0 * np.pi * move.increments / (TOOTH * self._motor.n_p)
        write_profile(drives, move, where)
        probe = with_run_current(device, gains, PROBE)
        for phase, (target, tried) in enumerate(((away, gains), (origin, gains), (away, probe))):
            used = np.where(stopped[:, None], incumbent, tried)
            write_gains(drives, used, where)
            position, lag, stopped, new, fell = self._try(target, incumbent, stopped, where, full_step)
            culprit |= new
            aborted[phase], lost[phase] = stopped, fell
            sign = np.where(move.distance < 0, -1, 1) * direction * (-1 if phase == 1 else 1)
            settling[phase], noise[phase], overshoot[phase], load_angle[phase] = open_loop_terms(
                position, lag, move, self._t_0, target, sign, full_step
            )
            efforts[phase] = effort(device, self._motor, used)
            following[phase] = np.maximum(np.abs(lag / size).sum(axis=0), 0.5) * CYCLE
            if phase == 0:
                first_error = lag / size
        terms = OpenLoopTerms(settling, np.ones(shape), noise, overshoot, aborted, load_angle, efforts)
        return OpenLoopTrial(terms, following, aborted, first_error, culprit, lost)

    def _try(
        self, target: Integers, incumbent: Integers, stopped: Mask, where: Mask, full_step: Floats
    ) -> tuple[Floats, Floats, Mask, Mask, Mask]:
        """Move; return position, lag, machines stopped so far, axes that newly caused it, and those with lost steps."""
        drives = self._drives
        if self._fell:
            self._come_to_rest(full_step)
        shift = self.shift()
        objects = [cia402.POSITION_ACTUAL, cia402.POSITION_DEMAND, cia402.STATUSWORD]
        positions, lags = [], []
        culprit, fell = np.zeros((2, len(stopped)), bool)
        self._prepare(objects)
        start(drives, wrapped(target + shift).astype(np.int64), where)
        for _ in range(TRIAL // WATCH):
            trace = self._record(objects, WATCH)
            lag = wrapped(trace[cia402.POSITION_DEMAND] - trace[cia402.POSITION_ACTUAL] - shift)
            positions.append(trace[cia402.POSITION_ACTUAL])
            lags.append(lag)
            down = where & ~cia402.matches(trace[cia402.STATUSWORD][-1], cia402.OPERATION_ENABLED)
            out = where & (np.abs(lag) > LOST * full_step).any(axis=0)
            fell |= out
            self._fell = self._fell or bool(out.any())
            new = self._whole_lanes(down | out) & where & ~stopped
            if new.any():
                write_gains(drives, incumbent, new)
                stopped = stopped | new
                culprit |= new & (down | out)
            if (on := (new | out) & ~down).any():  # the steps end, and the rotor synchronises with the field
                drives.write(cia402.CONTROLWORD, cia402.ENABLE_OPERATION | cia402.HALT, where=on)
            if down.any():
                clear(drives, down)
        return np.concatenate(positions), np.concatenate(lags), stopped, culprit, fell

    def _come_to_rest(self, full_step: Floats) -> None:
        """Wait until no rotor moves: a heavy load rolls over many teeth before it synchronises."""
        drives = self._drives
        for _ in range(LONGEST_ROLL):
            before = drives.read(cia402.POSITION_ACTUAL)
            drives.advance(STILL * CYCLE)
            if np.all(np.abs(wrapped(drives.read(cia402.POSITION_ACTUAL) - before)) < REST * full_step):
                break
        self._fell = False

    def shift(self) -> Floats:
        """Return the step counter's lead over the encoder [inc]: the first lead, plus whole teeth.

        Only lost steps are compensated, not the angle by which load and friction turn the rotor in the field.
        """
        drives = self._drives
        now = wrapped(drives.read(cia402.POSITION_DEMAND) - drives.read(cia402.POSITION_ACTUAL))
        if self._zero is None:
            self._zero = now
        tooth = np.asarray(drives.read(Role.POSITION_SCALE), float) / self._motor.n_p
        return np.asarray(np.rint(self._zero + tooth * np.rint((now - self._zero) / tooth)))

    def _check_moved(self, position: Floats, move: Move, where: Mask) -> None:
        way = np.abs(wrapped(position - position[0])).max(axis=0)
        still = np.flatnonzero(where & (way < LEAST_WAY * np.abs(move.distance)))
        if still.size:
            k = int(still[0])
            number = axis_number(self._drives, k)
            raise RuntimeError(
                f"axis {number}: the encoder showed {way[k]:.0f} of {abs(int(move.distance[k]))} increments of a move "
                "at rated current: it is not connected, its scale or direction is wrong, or the motor does not turn; "
                "without an encoder nothing is seen of an open-loop stepper that could be scored"
            )


def open_loop_terms(
    position: Floats, lag: Floats, move: Move, t_0: float | Floats, target: Integers, sign: Integers, full_step: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return t_s/t_0, vibration [full steps], overshoot and load angle [full steps] of a move, (num_axes,) each.

    Args:
        position: Position by the encoder, from the set-point on, one row per ms, (SETTLED or more, num_axes).
        lag: Demand less encoder [inc], same shape.
        move: The move.
        t_0: Time to which settling is relative [s].
        target: Target [inc].
        sign: Direction, 1 or -1.
        full_step: Increments per full step.
    """
    size = np.maximum(np.abs(move.distance), 1).astype(float)
    width = np.maximum(np.maximum(BAND * size, BAND_COUNTS / move.counts * move.increments), BAND_STEPS * full_step)
    error = wrapped(target - position[:SETTLED])
    settling = 1.0 + np.minimum(1.0, np.abs(error[PROFILE:]) / width).sum(axis=0) * CYCLE / t_0
    vibration = np.sqrt(np.mean(np.diff(lag[:PROFILE], axis=0) ** 2, axis=0)) / full_step
    beyond = np.maximum((-error * sign).max(axis=0), 0.0) / size
    return settling, vibration, beyond, np.abs(lag[:SETTLED]).max(axis=0) / full_step
