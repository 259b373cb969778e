"""One trial of the gains of a stepper's position PID: a move that the motor follows, the reversal, the gain probe.

A PID moves the field until the encoder is at the step counter's position; the encoder does not commutate. With the
ramp's velocity it compensates the angle by which load and friction turn the rotor in its field; alone it makes the
whole motion. Within the motor's torque every move shows both, so that the move is a servo's; that of a PID alone is as
short as its lag allows. No torque current is measured (6077h is the size of the set current): the encoder shows
vibration. The effect of a load step follows from the gains, as for a servo: see `load_step_error`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drive_env import cia402
from drive_env.devices import Device
from drive_env.devices.gain_set import PID_ALONE, ClosedLoop
from drive_env.dictionary.roles import Role
from drive_env.drives.interface import CYCLE, device_of
from drive_env.motors import Motor
from drive_env.phase_current import holding_torque
from drive_env.trials.closed_loop import ClosedLoopTrials, full_step
from drive_env.trials.gain_trial import Identified
from drive_env.trials.open_loop import LOST, TOOTH, open_loop_terms
from drive_env.trials.positioning import (
    BAND_COUNTS,
    QUIET,
    SETTLED,
    TRAVEL_SHARE,
    TRIAL,
    Move,
    plan_move,
    wrapped,
    write_profile,
)
from drive_env.trials.score import LOAD_SHARE, NOISE
from mechanics.arrays import Floats, Integers, Mask

PID_P, PID_I = ("correction", "velocity"), ("correction", "velocity, integral")  # loop and part in the gain set
P_UNIT, I_UNIT, PRESCALER = 256.0, 65536.0, 128.0  # units of 202Bh: 1/s; of 202Ch, 202Dh; prescaler of the clock
CLOCK = 16e6  # Hz, of the motion controller
MICROSTEPS, MODEL_STEP = 256.0, 1e-4  # per full step, as commissioned; s
PROBE = 1.5  # P of the probe over that of the trial
ALONE = 8.0  # full steps, longest move of a PID alone, which is behind by a third of it
VIBRATION = 0.1  # full steps, the encoder's RMS change per millisecond that counts like 3 % of a servo's ripple
# RMS change of this change in one check [full steps]: a light rotor that swings at the beginning of a ramp causes 0.2,
# one that oscillates or rolls over its teeth 0.33 and more.
SHAKES = 0.3
# Steady speeds [rev/s] at which gains are checked after a search: trials are too short to show a rotor that swings with
# the steps of a speed. Duration of each, and of a ramp before it [s], and least swing that is reported [full steps,
# RMS].
STEADY_SPEEDS, STEADY, RAMP, SWING = (0.25, 0.5, 1.0, 2.0), 0.4, 0.15, 0.1
LONGEST_WAY_BACK, BACK, LOOK = 2.0, 0.5, 0.05  # s, full steps, s: an axis that slipped catches up before the next phase


def load_step_error(device: Device, motor: Motor, loop: ClosedLoop, gains: Integers) -> Floats:
    """Return the integral of |error| during a load step [microsteps s], by a model of the gains, (n,).

    The field is an integrator, and a load of 0.3 of the rated torque immediately turns the rotor in it by e (TMC4361
    data sheet; f is the clock, div 256 if 202Eh is 0):

        de/dt (1 + 2021h 128 div / f) = -(202Bh / 256 e + 202Ch f / 2^23 int e), at most 202Fh

    and 0 within 2022h. The rotor's own swing, which limits the gains, is not modelled: trials show it.
    """
    columns = dict(zip(loop.gains.values(), device.gains.columns_of_loop(loop), strict=True))

    def of(name: str) -> Floats:
        return np.asarray(gains[:, columns[name]], float)

    clock = CLOCK / PRESCALER  # Hz
    p, i = of("correction_velocity_p") / P_UNIT, of("correction_velocity_i") * clock / I_UNIT
    slower = 1.0 + of("correction_position_p") * np.where((d := of("derivative_divider")) > 0.0, d, 256.0) / clock
    largest, most = of("correction_sum_limit") * I_UNIT / clock, of("correction_velocity_limit")
    share = LOAD_SHARE * motor.rated_torque / float(holding_torque(motor, motor.rated_current))
    e = np.full(len(gains), np.arcsin(share) / (0.5 * np.pi) * MICROSTEPS)
    total, area = np.zeros(len(gains)), np.zeros(len(gains))
    for _ in range(round((TRIAL - SETTLED) * CYCLE / MODEL_STEP)):
        outside = np.abs(e) > of("correction_tolerance")
        total = np.where(outside, np.clip(total + e * MODEL_STEP, -largest, largest), total)
        speed = np.where(outside, np.clip((p * e + i * total) / slower, -most, most), 0.0)
        e = e - speed * MODEL_STEP
        area = area + np.abs(e) * MODEL_STEP
    return np.asarray(area)


def pid_time(loop: ClosedLoop) -> float:
    """Return the time constant [s] of the P part with which a search begins."""
    return P_UNIT / float(next(iter(loop.first.values())))


def plan_pid(motor: Motor, loop: ClosedLoop, found: Identified, scaler: ArrayLike, reach: ArrayLike) -> Move:
    """Plan a move of 60 ms as `plan_move` does; for a PID alone at most `ALONE` full steps long."""
    to = np.asarray(reach, float)
    if loop.kind == PID_ALONE:
        to = np.copysign(np.minimum(np.abs(to), ALONE * full_step(motor) / TRAVEL_SHARE), to)
    return plan_move(motor, found.inertia, scaler, to)


def pid_terms(
    position: Floats, lag: Floats, move: Move, t_0: float | Floats, target: Integers, sign: Integers, step: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return t_s/t_0, vibration in units of J's ripple, and overshoot of a move; arguments as `open_loop_terms`."""
    settling, _, overshoot, _ = open_loop_terms(position, lag, move, t_0, target, sign, step)
    change = wrapped(np.diff(position[QUIET:SETTLED], axis=0))
    vibration = np.sqrt(np.mean(change**2, axis=0)) / step
    return settling, vibration / VIBRATION * NOISE, overshoot


def steps_of(move: Move, motor: Motor) -> Floats:
    """Return the increments per full step, (num_axes,)."""
    return np.asarray(2.0 * np.pi * move.increments / (TOOTH * motor.n_p))


def following_scale(move: Move, motor: Motor, loop: ClosedLoop) -> Floats:
    """Return the scale of |demand - encoder| [inc]: a full step, or the move for a PID alone."""
    if loop.kind == PID_ALONE:
        return np.maximum(np.abs(move.distance), 1).astype(float)
    return steps_of(move, motor)


class PidTrials(ClosedLoopTrials):
    """Runs trials on steppers whose position a PID controls, as `ClosedLoopTrials` does.

    An axis that oscillates or rolls over its teeth is stopped, and catches up before the next phase.
    """

    def _tried(self, gains: Integers, move: Move, *, is_probe: bool) -> Integers:
        known = device_of(self._drives).gains
        column = known.column(*PID_P)
        assert column is not None, "a PID has a P part"
        return known.scaled(gains, PROBE, [column]) if is_probe else gains

    def _terms(
        self, position: Floats, current: Floats, move: Move, target: Integers, sign: Integers
    ) -> tuple[Floats, Floats, Floats]:
        # The load angle, which `open_loop_terms` returns, does not count for a PID.
        step = steps_of(move, self._motor)
        return pid_terms(position, np.zeros_like(position), move, self._t_0, target, sign, step)

    def _following_scale(self, move: Move) -> Floats:
        return following_scale(move, self._motor, self._closed)

    def steady_swings(self, reach: Floats, where: Mask) -> Floats:
        """Return the rotors' swing at `STEADY_SPEEDS` [full steps, RMS], (speeds, num_axes); nan without enough room.

        Args:
            reach: Signed angle that they may turn from here [rad].
            where: Axes to check.
        """
        drives = self._drives
        scale = np.asarray(drives.read(Role.POSITION_SCALE), float)
        step = scale / (TOOTH * self._motor.n_p)
        found = np.full((len(STEADY_SPEEDS), drives.num_axes), np.nan)
        origin = drives.read(cia402.POSITION_ACTUAL)
        for k, speed in enumerate(STEADY_SPEEDS):
            way = speed * (STEADY + 2.0 * RAMP)  # rev
            fits = where & (2.0 * np.pi * way < np.abs(reach)) & (2.0 * np.pi * speed < self._motor.rated_speed)
            if not fits.any():
                continue
            velocity = np.ceil(speed * scale)
            move = Move(
                np.rint(np.copysign(way, reach) * scale).astype(np.int64), velocity.astype(np.int64),
                np.ceil(velocity / RAMP).astype(np.int64), scale / (2.0 * np.pi), 1.0,
            )  # fmt: skip
            write_profile(drives, move, fits)
            self.go(origin + move.distance, fits)
            drives.advance(2.0 * RAMP)
            seen = drives.record(cia402.POSITION_ACTUAL, STEADY - RAMP)[cia402.POSITION_ACTUAL]
            drives.advance(4.0 * RAMP)
            self.go(origin, fits)
            drives.advance(STEADY + 4.0 * RAMP)
            path = wrapped(seen - seen[0])
            t = np.arange(len(path))
            line = np.polynomial.polynomial.polyval(t, np.polynomial.polynomial.polyfit(t, path, 1)).T
            found[k] = np.where(fits, np.std(path - line, axis=0) / step, np.nan)
        return found

    def _shaking(self, trace: Mapping[Any, Integers]) -> Mask:
        """Return which axes change their speed faster than a ramp does, or fall behind a ramp by lost steps."""
        scale = np.asarray(self._drives.read(Role.POSITION_SCALE), float)
        step = scale / (TOOTH * self._motor.n_p)
        change = np.diff(wrapped(np.diff(trace[cia402.POSITION_ACTUAL], axis=0)), axis=0)
        most = np.maximum(SHAKES * step, BAND_COUNTS * scale / self._motor.encoder_counts)
        shakes = np.sqrt(np.mean(change**2, axis=0)) > most
        if self._closed.kind == PID_ALONE:  # it is always behind its demand
            return np.asarray(shakes)
        lag = np.abs(wrapped(trace[cia402.POSITION_DEMAND] - trace[cia402.POSITION_ACTUAL]))
        return np.asarray(shakes | (lag > LOST * step).any(axis=0))

    def _phase(
        self, target: Integers, incumbent: Integers, stopped: Mask, where: Mask
    ) -> tuple[Floats, Floats | None, Floats, Mask, Mask]:
        found = super()._phase(target, incumbent, stopped, where)
        if (slipped := found[3] & ~stopped & where).any():
            self._make_up(slipped)
        return found

    def _make_up(self, where: Mask) -> None:
        """Wait until axes have caught up with their demand with the incumbent gains, at most LONGEST_WAY_BACK."""
        drives = self._drives
        near = BACK * np.asarray(drives.read(Role.POSITION_SCALE), float) / (TOOTH * self._motor.n_p)
        for _ in range(round(LONGEST_WAY_BACK / LOOK)):
            behind = np.abs(wrapped(drives.read(cia402.POSITION_DEMAND) - drives.read(cia402.POSITION_ACTUAL)))
            if np.all(behind[where] < near[where]):
                return
            drives.advance(LOOK)
