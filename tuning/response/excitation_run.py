"""Excites axes that move at a steady speed in both directions, and returns excitation and response.

Dry friction is constant while an axis does not change direction: so the excitation is added to a steady speed larger
than its own, within the travel. It continues through the reversal and repeats exactly; the evaluated samples begin when
the effects of the reversal have decayed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from drive_env import cia402, motion
from drive_env.dictionary.entries import ObjectName
from drive_env.dictionary.roles import Role
from drive_env.drives.currents import ampere_per_count, to_counts
from drive_env.drives.interface import CYCLE, Drives
from drive_env.drives.speeds import per_increment
from drive_env.trials.positioning import wrapped
from mechanics.arrays import Floats, Integers, Mask
from tuning.response.excitation import Lines, periodic
from tuning.target import Target

SET_POINT = {"velocity": (cia402.TARGET_VELOCITY, 0), "position": (cia402.TARGET_POSITION, 0)}
OFFSET = {
    "velocity": (cia402.VELOCITY_OFFSET, 0),
    "position": (cia402.POSITION_OFFSET, 0),
}  # added to the set-point by the drive
SEEN = {"velocity": cia402.VELOCITY_ACTUAL, "position": cia402.POSITION_ACTUAL}
MODE = {"velocity": "csv", "position": "csp"}
INTERPOLATION = ((cia402.INTERPOLATION_PERIOD, 1), (cia402.INTERPOLATION_PERIOD, 2))
RAMP, SETTLING = 30, 70  # cycles: of a change of speed, and until its effects have decayed
FADE = 20  # cycles
IN_RAMPS = 0.3  # share of the excitation while the speed changes
LOOK = 20  # cycles at rest over which the holding current is averaged
REST, RETURN = 30, 50  # cycles until an axis is at rest, and of its return; more if that would be too fast
BACK = 0.8  # of the return: an axis that overshoots must not leave its travel
SETTLED = 200  # cycles until axes that were switched off are at rest
NEAR = 0.02  # rad from the first position, within which an axis does not return


class Pass(NamedTuple):
    """The samples of a run at steady speed; periods one after the other, in SI units.

    set_point: Played set-point less the steady motion, shape (periods * samples, axes).
    answer: Response as sampled on the bus, same shape.
    current: 6077h [A], same shape.
    fast_set_point, fast_answer: The same at the velocity loop's rate, from a trace; empty without one.
    peak_current: Greatest 6077h, also during ramps [A], shape (axes,).
    enabled: Whether the axis was enabled all the time, shape (axes,).
    """

    set_point: Floats
    answer: Floats
    current: Floats
    fast_set_point: Floats
    fast_answer: Floats
    peak_current: Floats
    enabled: Mask


class Shaker:
    """Runs excitations on the axes of a target; as a context it restores states and modes, without an error.

    Args:
        target: The axes.
        loop: "velocity" (csv) or "position" (csp).
        where: Axes to excite, shape (num_axes,).
        lines: Frequencies.
        kind: "multisine" or "chirp".
    """

    def __init__(self, target: Target, loop: str, where: Mask, lines: Lines, kind: str) -> None:
        self._target, self._drives, self._loop, self._where = target, target.drives, loop, where
        self._lines, self._kind = lines, kind
        self.radians = 2.0 * math.pi / np.maximum(np.asarray(self._drives.read(Role.POSITION_SCALE), float), 1.0)
        # Per count of the loop's set-point.
        self.per_count = self.radians / per_increment(self._drives, SEEN[loop])
        self.traced_time = 0.0  # s that passed in traces, which the target's clock does not count
        self.fastest = np.full(target.num_axes, 0.4 * target.speed)  # rad/s, greatest speed on the way back

    def __enter__(self) -> Shaker:
        drives, where = self._drives, self._where
        self._were_on = _enabled(drives)
        self._modes = drives.read(cia402.MODE)
        self._interpolation = [drives.read(name) for name in INTERPOLATION]
        # Interpolation of 1 ms: a set-point is reached when the next one comes.
        for name, value in zip(INTERPOLATION, (1, -3), strict=True):
            drives.write(name, value, where=where)
        # A drive without this object adds no offset.
        has_offset = OFFSET[self._loop] in self._target.device.bindings
        self._offset = np.asarray(drives.read(OFFSET[self._loop]), float) if has_offset else np.zeros(len(where))
        motion.enable(drives, mode=MODE[self._loop], where=where)
        self._origin = drives.read(cia402.POSITION_ACTUAL)
        return self

    def __exit__(self, *error: Any) -> None:
        drives, where = self._drives, self._where
        running = where & _enabled(drives)
        if running.any() and error[0] is None:
            self._go_back(running)
        off = where & ~self._were_on
        if off.any():
            motion.disable(drives, where=off & _enabled(drives))
        for name, values in zip(INTERPOLATION, self._interpolation, strict=True):
            drives.write(name, values, where=where)
        _give_modes_back(drives, self._modes, where)

    def run(self, amplitude: Floats, speed: Floats, passes: int, periods: int, *, traced: bool = False) -> Pass:
        """Run in both directions; the axes end at rest.

        Args:
            amplitude: Amplitude of each line's velocity [rad/s], shape (n, axes).
            speed: Signed steady speed of the first pass [rad/s], shape (axes,).
            passes: Number of passes, in alternating direction.
            periods: Number of evaluated periods in each pass.
            traced: Record at the velocity loop's rate as well; on emulated drives only.
        """
        steady, inside = self.steady(speed, passes, periods)
        turning = np.any(np.diff(steady, axis=0, prepend=0.0) != 0.0, axis=1)
        omega = 2.0 * math.pi * self._lines.f[:, None]
        sized = amplitude if self._loop == "velocity" else amplitude / omega
        wave = periodic(self._kind, self._lines, sized * self._where)
        cycles = len(steady)
        # A change of speed takes current itself: the excitation is reduced during it, and increases again afterwards.
        from_end = np.minimum(np.arange(cycles), np.arange(cycles)[::-1])
        level = np.convolve(np.where(turning, IN_RAMPS, 1.0), np.full(FADE, 1.0 / FADE), "same")
        fade = (level * np.clip(from_end / FADE, 0.0, 1.0))[:, None]
        path = steady if self._loop == "velocity" else self._position(steady)
        # Every second pass plays the excitation backwards: non-linear effects then differ, and reduce the coherence.
        back = np.repeat(np.arange(passes) % 2 == 1, cycles // passes + 1)[:cycles, None]
        row = np.arange(cycles) % self._lines.samples
        shaking = np.where(back, wave[::-1][row], wave[row])
        raw = np.rint((path + fade * shaking) / self.per_count - self._offset)
        seen, fast, enabled = self._play(raw.astype(np.int64), traced)
        played = (raw + self._offset) * self.per_count - path
        chosen = np.flatnonzero(inside)
        answer = np.asarray(seen[SEEN[self._loop]], float)
        if self._loop == "position":
            answer = wrapped(answer - self._origin) + self._origin
        windows = 0 if fast is None else len(fast[0]) // cycles
        quick = [np.empty((0, raw.shape[1]))] * 2
        if fast is not None:
            within = np.repeat(inside, windows)
            quick = [(signal - np.repeat(path, windows, axis=0))[within] for signal in fast]
        ampere = ampere_per_count(self._drives)
        return Pass(
            played[chosen],
            (answer * self.per_count - path)[chosen],
            np.asarray(seen[cia402.TORQUE_ACTUAL][chosen] * ampere),
            quick[0],
            quick[1],
            np.abs(seen[cia402.TORQUE_ACTUAL]).max(axis=0) * ampere,
            enabled,
        )

    def hold(self) -> Floats:
        """Return the currents that hold the axes at rest [A], shape (axes,)."""
        trace = self._drives.record([cia402.TORQUE_ACTUAL], (REST + LOOK) * CYCLE)
        return np.asarray(trace[cia402.TORQUE_ACTUAL][REST:].mean(axis=0) * ampere_per_count(self._drives))

    def steady(self, speed: Floats, passes: int, periods: int) -> tuple[Floats, Mask]:
        """Return the steady velocity of every cycle, (cycles, axes), and which cycles are evaluated."""
        rows, inside, before = [], [], np.zeros_like(speed)
        long = SETTLING + periods * self._lines.samples
        for k in range(passes + 1):
            now = speed * (-1.0) ** k if k < passes else np.zeros_like(speed)
            # A reversal is twice the change of speed.
            ramp = RAMP if k in (0, passes) else 2 * RAMP
            share = (np.arange(1, ramp + 1) / ramp)[:, None]
            rows.append(before + share * (now - before))
            inside.append(np.zeros(ramp, bool))
            if k < passes:
                rows.append(np.tile(now, (long, 1)))
                inside.append(np.arange(long) >= SETTLING)
            before = now
        return np.concatenate(rows), np.concatenate(inside)

    def _position(self, velocity: Floats) -> Floats:
        start = self._drives.read(cia402.POSITION_ACTUAL) * self.radians
        return np.asarray(start + np.cumsum(velocity, axis=0) * CYCLE)

    def _play(self, raw: Integers, traced: bool) -> tuple[dict[int, Integers], tuple[Floats, Floats] | None, Mask]:
        name = SET_POINT[self._loop]
        duration = len(raw) * CYCLE
        rest = self._drives.read(name)
        play: dict[ObjectName, ArrayLike] = {name: np.where(self._where, raw, rest)}
        if not traced:
            objects = [SEEN[self._loop], cia402.TORQUE_ACTUAL, cia402.STATUSWORD]
            trace = self._drives.record(objects, duration, play)
            return (
                {key: trace[key] for key in objects[:2]},
                None,
                cia402.matches(trace[cia402.STATUSWORD], cia402.OPERATION_ENABLED).all(axis=0),
            )
        from drive_env.emulator.loop_trace import trace_loops

        self.traced_time += duration
        signals = {"velocity": ("velocity_demand", "omega_meas"), "position": ("position_demand", "theta_meas")}
        names = signals[self._loop]
        fast = trace_loops(self._drives, [*names, "torque_meas"], duration, play).signals
        windows = len(fast[names[0]]) // len(raw)
        seen = {SEEN[self._loop]: np.rint(fast[names[1]][::windows] / self.per_count).astype(np.int64)}
        seen[cia402.TORQUE_ACTUAL] = to_counts(self._drives, fast["torque_meas"][::windows])
        return seen, (fast[names[0]], fast[names[1]]), _enabled(self._drives)

    def _go_back(self, where: Mask) -> None:
        """Bring the axes close to their first positions."""
        drives = self._drives
        drives.advance(REST * CYCLE)
        off = wrapped(drives.read(cia402.POSITION_ACTUAL) - self._origin) * self.radians * where * BACK
        if np.abs(off).max() < NEAR:
            return
        cycles = max(RETURN, math.ceil(float((np.abs(off) / self.fastest).max()) * 2.0 / CYCLE))
        t = (np.arange(cycles) + 0.5) / cycles
        shape = (1.0 - np.cos(2.0 * math.pi * t))[:, None]
        velocity = -off / (cycles * CYCLE) * shape
        velocity[-1] = 0.0
        if self._loop == "position":
            velocity = np.concatenate([velocity, np.zeros((SETTLING, velocity.shape[1]))])
        path = velocity if self._loop == "velocity" else self._position(velocity)
        name = SET_POINT[self._loop]
        raw = np.rint(path / self.per_count - self._offset).astype(np.int64)
        drives.record([cia402.POSITION_ACTUAL], len(raw) * CYCLE, {name: np.where(where, raw, drives.read(name))})


@contextmanager
def at_rest(target: Target, loop: str, where: Mask) -> Iterator[None]:
    """Enable axes in a loop's mode during the block, so that each holds its position while another one is excited."""
    drives = target.drives
    modes, off = drives.read(cia402.MODE), where & ~_enabled(drives)
    if loop == "velocity" and off.any():
        drives.write(SET_POINT[loop], 0, where=off)
    motion.enable(drives, mode=MODE[loop], where=where)
    try:
        yield
    finally:
        if (now := off & _enabled(drives)).any():
            motion.disable(drives, where=now)
        _give_modes_back(drives, modes, where)


def _give_modes_back(drives: Drives, modes: Integers, where: Mask) -> None:
    """Restore the modes of axes; those that stay enabled take commands in the restored mode."""
    names = {number: name for name, number in cia402.MODES.items()}
    for mode in np.unique(modes[where]).tolist():
        changed = where & (modes == mode) & (drives.read(cia402.MODE) != mode)
        goes_on = changed & _enabled(drives) if mode in names else changed & False
        if goes_on.any():
            motion.select_mode(drives, names[mode], goes_on)
        if mode and (changed & ~goes_on).any():
            drives.write(cia402.MODE, mode, where=changed & ~goes_on)


@contextmanager
def let_go(target: Target, where: Mask, shaken: Mask) -> Iterator[None]:
    """Switch axes off during the block: linked axes that are not excited must follow freely."""
    drives = target.drives
    on = where & _enabled(drives)
    if on.any():
        motion.disable(drives, where=on)
    try:
        yield
    finally:
        if on.any():
            # All come to rest and are enabled together: enabled while others move, they would stop askew and strain the
            # machine; and gains that are good for all of them may be bad for one alone.
            alone = shaken & _enabled(drives)
            motion.disable(drives, where=alone)
            drives.advance(SETTLED * CYCLE)
            motion.enable(drives, where=on | alone)


def _enabled(drives: Drives) -> Mask:
    return np.asarray(cia402.matches(drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED))
