"""Measures open loops of axes in closed loop: a multisine or a chirp on the set-point, with the coherence.

The set-point is the instrument: it is known exactly and independent of noise, so that the open loop is the quotient of
two cross-spectra with it, response over error, without the bias by noise inside the loop that response over input has.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from drive_env import cia402
from drive_env.drives.currents import ampere_per_count, read_current_limit
from drive_env.drives.interface import CYCLE
from drive_env.drives.raw_gains import read_gains
from drive_env.loops.linear_model import Plant, controllers
from drive_env.safety.envelope import swinging_allowed
from drive_env.trials.oscillation import shakes, strongest_frequency
from mechanics.arrays import Complex, Floats, Integers, Mask
from tuning.lateness import told_lateness
from tuning.link_energy import LINK_SHARE, fed_back, link_energy
from tuning.oscillation_watch import OscillationError, shaken, watch_of
from tuning.response.dead_time import dead_time_resistance
from tuning.response.excitation import CREST, Lines, dimension, peak, plan_lines
from tuning.response.excitation_run import MODE, RAMP, SETTLING, Pass, Shaker, at_rest, let_go
from tuning.response.held_samples import split, unhold
from tuning.response.measured_loop import COHERENT, MeasuredLoop, merged
from tuning.response.plant_fit import PlantFit, Seen, fit_plant
from tuning.response.transfer import directions, transfer
from tuning.rules.lags import velocity_noise
from tuning.stop_causes import stop_causes
from tuning.target import check_measurable, timed

if TYPE_CHECKING:
    from drive_env.devices import Device
    from tuning.target import Target


LOOPS = ("velocity", "position")
RANGE = {"velocity": (5.0, 400.0), "position": (5.0, 50.0)}  # Hz
RESOLUTION = 5.0  # Hz
# Least coherence of a fitted line, which is weighted by its noise; and information, in trusted lines, that the fitted
# lines must have together.
FITTED, WORTH = 0.5, 4.0
BUS_LIMIT = 400.0  # Hz; above, samples of a bus contain more of the images than of the line
TRACED_TOP = 495.0  # Hz, greatest frequency of the set-points in a traced measurement
TRACE_LIMIT = 1000.0  # Hz
PASSES, PERIODS = 2, 3  # of a measurement; the trial before it has one of each
SOFTER = 2  # how many times the gains of an axis that oscillates are lowered
CONFIRMING, LESS = 6, 0.5  # passes if confirmed, and share of the excitation in their second half


# Load of an axis over its limits, in the trial and in the measurement.
TRIAL_SPEED, TRIAL_CURRENT = 0.1, 0.4
SPEED, CURRENT = 0.45, 0.9
TRIAL_SWING, SWING = 0.42, 0.65  # RMS over 25 ms, above which the axis oscillates by itself
SLOWER, TINY = 0.9, 1e-6  # factor, applied until a run does not overcharge the DC link; J
ONE_FREQUENCY = 0.5  # of an oscillation's power, within 10 Hz of its frequency; for noise it is 0.05
RETURN_SHARE = 0.5  # of the greatest speed at which the DC link can take the energy of a stop
IN_RAMP = 0.5  # of the current of the excitation, for changing the speed
TRAVEL = 0.85
OVER_NOISE = 5.0  # least RMS of the excited velocity over the encoder's noise, even if the motion then reverses


@dataclass(frozen=True)
class Signal:
    """The excitation of a loop.

    Attributes:
        kind: "multisine" or "chirp".
        low: Lowest frequency [Hz]; None selects the loop's own, also for `high`.
        high: Highest frequency [Hz], at most 400; a traced measurement always goes beyond. With 4,096 counts per turn
            little is coherent above 200 Hz, and power there is missing below; distinct features, such as resonances,
            are still found.
        resolution: Spacing of the frequencies [Hz]; a period lasts its inverse.
    """

    kind: str = "multisine"
    low: float | None = None
    high: float | None = None
    resolution: float = RESOLUTION


MULTISINE = Signal()


def measure(
    target: Target,
    loop: str = "velocity",
    *,
    where: Mask | None = None,
    signal: Signal = MULTISINE,
    traced: bool = False,
    confirmed: bool = False,
    softened: bool = False,
    periods: int = PERIODS,
    progress: Callable[[float], None] | None = None,
    after_motion: Callable[[], None] | None = None,
) -> MeasuredLoop:
    """Measure a loop's frequency response on its axes; they return to their first positions and states.

    Axes of one machine are excited one after the other, machines at the same time. The other axes hold their positions;
    linked ones are switched off and follow.

    Args:
        target: The axes.
        loop: "velocity", in csv, or "position", in csp.
        where: Axes to measure; all by default. The others get nan.
        signal: The excitation.
        traced: Also measure above 400 Hz, by the emulator's trace at the velocity loop's rate.
        confirmed: Measure longer, and again with half the amplitude: a resonance that differs then is refused.
        softened: Divide the velocity gains of an axis that oscillates in the trial by 4, at most twice, and leave them
            so; its drives must be watched (`tuning.oscillation_watch`).
        periods: Number of evaluated periods of every pass: more reduce the noise, and take more time.
        progress: Called with the share that is done.
        after_motion: Called once the axes are back, before the response is evaluated. That takes about a second, longer
            than an envelope in real time leaves an axis enabled without a command.

    Raises:
        ValueError: For an unknown loop or kind, impossible frequencies, a trace on a bus, or a drive without a linear
            model of its loops.
    """
    lines, top = _planned(target, loop, signal, traced)
    axes = np.ones(target.num_axes, bool) if where is None else np.asarray(where, bool)
    if not axes.any():
        raise ValueError("no axis is chosen")
    check_measurable(target.device, (MODE[loop],))  # it determines the amplitudes; checked before anything moves
    closed = _closed_loops(target, loop)
    if not (axes & closed).any():
        raise ValueError("a P gain is 0 on every axis and the loop is open: give the drives gains first")
    position = np.arange(target.num_axes) % target.axes_per_machine
    measurements = []
    holds = target.axes_per_machine > 1 and not target.linked
    with at_rest(target, loop, axes & closed) if holds else nullcontext():
        for k in range(target.axes_per_machine):
            chosen = axes & closed & (position == k)
            if not chosen.any():
                continue
            measurement = _Measurement(
                target, loop, chosen, lines, top, signal.kind, traced, confirmed, softened, periods
            )

            def show(share: float, k: int = k) -> None:
                if progress is not None:
                    progress((k + share) / target.axes_per_machine)

            free = let_go(target, axes & ~chosen, chosen) if target.linked else nullcontext()
            with free, swinging_allowed(target.drives):
                measurement.excite(show)
            measurements.append(measurement)
    if after_motion is not None:
        after_motion()
    whole = merged([measurement.evaluate() for measurement in measurements])
    open_loop = "a gain is 0 and the loop is open: give the drive gains first"
    notes = tuple(
        (*own, open_loop) if without else own for own, without in zip(whole.notes, axes & ~closed, strict=True)
    )
    return replace(whole, notes=notes)


def _planned(target: Target, loop: str, signal: Signal, traced: bool) -> tuple[Lines, float]:
    """Return the excited lines, and the highest frequency [Hz] seen by a bus; ValueError for impossible ones."""
    if loop not in LOOPS:
        raise ValueError(
            f"no loop is named {loop!r}; there are {', '.join(LOOPS)}; the current loop cannot be measured on a bus"
        )
    if traced and target.drives.machine is None:
        raise ValueError(
            "a trace at the velocity loop's rate exists on emulated drives only; on a bus up to 400 Hz can be measured"
        )
    lowest, highest = RANGE[loop]
    # The trace begins where a bus ends: a gap between them could hide a margin.
    top = BUS_LIMIT if traced else highest if signal.high is None else signal.high
    if top > BUS_LIMIT:
        raise ValueError(f"highest frequency {top:g} Hz must be at most {BUS_LIMIT:g} Hz, the limit on a bus")
    # In a trace, a set-point held at f also appears at 1000 Hz - f: lines up to nearly half of it leave no gap.
    low = lowest if signal.low is None else signal.low
    return plan_lines(low, TRACED_TOP if traced else top, signal.resolution, 1.0 / CYCLE), top


def _closed_loops(target: Target, loop: str) -> Mask:
    """Return which axes have P gains above 0 in all loops that the measurement needs."""
    loops = ("current", "velocity") if loop == "velocity" else ("current", "velocity", "position")
    known = target.device.gains
    needed = [known.rows[k].key for each in loops if (k := known.column(each, "P")) is not None]
    return np.asarray(np.all([target.drives.read(key) > 0 for key in needed], axis=0))


class _Measurement:
    """One measurement of several axes at the same time: a trial, the run proper, and their results."""

    def __init__(
        self, target: Target, loop: str, where: Mask, lines: Lines, top: float, kind: str, traced: bool,
        confirmed: bool, softened: bool, periods: int,
    ) -> None:  # fmt: skip
        self._top, self._softened, self._periods = top, softened, periods
        self._passes, self._confirmed = (CONFIRMING if confirmed else PASSES), confirmed
        self._target, self._loop, self._lines, self._kind, self._traced = target, loop, lines, kind, traced
        self._device: Device = target.device
        self._notes: list[list[str]] = [[] for _ in range(target.num_axes)]
        self._where = where
        self._less: Pass | None = None  # with less excitation, if confirmed
        self._stoppable: Floats = np.full(target.num_axes, np.inf)  # greatest speed for a stop by the DC link [rad/s]

    def excite(self, progress: Callable[[float], object]) -> None:
        """Move the axes and keep their samples."""
        target = self._target
        self._gains = read_gains(target.drives)
        where = self._where
        with timed(target) as (counted, clock):
            shaker = Shaker(counted, self._loop, where, self._lines, self._kind)
            with shaker:
                room = np.where(target.high >= -target.low, target.high, target.low) * TRAVEL
                sign = np.sign(room)
                limit = self._current_limit()
                # Read immediately after the trial: friction at rest would change the current.
                self._holding = counted.drives.read(cia402.TORQUE_ACTUAL) * ampere_per_count(counted.drives)
                self._friction = np.zeros(target.num_axes)
                speed = self._trial_speed(shaker, np.abs(room))
                trial = self._trial(shaker, limit, speed, sign)
                self._know_friction(trial, shaker.hold(), sign)
                progress(0.2)
                rough = transfer(trial.set_point, trial.answer, self._lines)[0]
                room = np.abs(room) - speed * _duration(1, self._lines)
                amplitude, speed = self._amplitude(shaker, rough, trial, room, limit)
                shaker.fastest = np.minimum(shaker.fastest, RETURN_SHARE * self._stoppable)
                with shaken(counted.drives, SWING * limit):
                    self._seen = shaker.run(amplitude, sign * speed, self._passes, self._periods, traced=self._traced)
                    progress(0.5 if self._confirmed else 0.9)
                    if self._confirmed:
                        self._less = shaker.run(LESS * amplitude, sign * speed, self._passes, self._periods)
        self._drive_time = clock.seconds + shaker.traced_time
        stopped = where & ~self._seen.enabled
        self._late = told_lateness(counted.drives)
        for axis in np.flatnonzero(where) if self._late else ():
            self._notes[axis].insert(0, self._late)
        causes = stop_causes(counted.drives) if stopped.any() else []
        for axis in np.flatnonzero(stopped):
            self._notes[axis].append(f"the drive stopped during the measurement: {causes[axis]}")
        watch = watch_of(counted.drives)
        swung = where & watch.swung if watch else where & False
        self._oscillation = self._note_oscillation(self._seen, where & self._seen.enabled & ~swung)
        if watch:
            self._oscillation = np.where(swung, watch.frequency, self._oscillation)
        self._note_limits(self._seen.peak_current, where & (self._oscillation == 0.0))
        progress(1.0)

    def evaluate(self) -> MeasuredLoop:
        """Return the response, computed from the axes' motion."""
        result = self._evaluate(self._where & self._seen.enabled & (self._oscillation == 0.0))
        return replace(result, oscillation=self._oscillation)

    # --- amplitudes -----------------------------------------------------------------------------------------------
    def _current_limit(self) -> Floats:
        """Return the greatest permitted current [A]: the user's limit, or the drive's own."""
        return np.asarray(np.minimum(self._target.current, read_current_limit(self._target.drives)))

    def _trial(self, shaker: Shaker, limit: Floats, speed: Floats, sign: Floats) -> Pass:
        """Return the response to a weak excitation; an axis that oscillates first gets softer gains, if allowed."""
        drives = self._target.drives
        watch = watch_of(drives)
        for left in reversed(range(SOFTER + 1)):
            amplitude = self._trial_amplitude(speed, limit)
            try:
                # Stiff gains take all the current to follow the trial's ramps, soft ones of an identification do not.
                with shaken(drives, TRIAL_SWING * limit if self._softened else np.full(len(limit), np.inf)):
                    trial = shaker.run(amplitude, sign * speed, 1, 1)
            except OscillationError:
                if not (self._softened and left):
                    raise
            if watch is None or not self._softened or not (self._where & watch.swung).any() or not left:
                break
            self._gains = watch.soften(drives, self._where & watch.swung, self._gains, MODE[self._loop])
        return trial

    def _trial_speed(self, shaker: Shaker, room: Floats) -> Floats:
        speed = np.minimum(TRIAL_SPEED * self._target.speed, 0.4 * room / _duration(1, self._lines))
        held = LINK_SHARE * link_energy(self._target)
        while (over := self._falling(shaker, speed, 1, 1) > held).any():
            speed = np.where(over, SLOWER * speed, speed)
        return speed

    def _falling(self, shaker: Shaker, speed: Floats, passes: int, periods: int) -> Floats:
        """Return the energy that weights feed back into the DC link in a run at these speeds [J], (num_axes,)."""
        steady, _ = shaker.steady(speed, passes, periods)
        return fed_back(self._target.motor, steady, CYCLE, 0.0, self._holding, self._friction)

    def _know_friction(self, trial: Pass, at_rest: Floats, sign: Floats) -> None:
        """Compute dry friction and holding current [A] from the currents in motion and at rest afterwards.

        A weight feeds energy back, friction does not. In motion along `sign` the current is weight + friction; against
        it -weight + friction, which is at least the current at rest, where friction can hold any part up to its own
        value.
        """
        moving = trial.current.mean(axis=0)
        self._friction = np.maximum(0.5 * sign * (moving - at_rest), 0.0)
        self._holding = np.maximum(np.abs(moving), np.abs(at_rest)) - self._friction

    def _trial_amplitude(self, speed: Floats, limit: Floats) -> Floats:
        n = len(self._lines.f)
        # A reversing motion is acceptable in the trial; an invisible one is not.
        largest = np.maximum(0.8 * speed, OVER_NOISE * CREST * self._noise())
        by_speed = largest / CREST / math.sqrt(n / 2.0)
        by_current = (
            TRIAL_CURRENT * limit / CREST / math.sqrt(n / 2.0) / np.maximum(np.abs(self._current_gain()), 1e-12)
        )
        return np.asarray(np.minimum(by_speed, by_current))

    def _amplitude(
        self, shaker: Shaker, rough: Complex, trial: Pass, room: Floats, limit: Floats
    ) -> tuple[Floats, Floats]:
        """Return amplitudes and steady speeds of the run proper, computed from the trial."""
        lines, omega = self._lines, 2.0 * math.pi * self._lines.f[:, None]
        gain, error = _bounded(rough, 1e-3, 10.0), _bounded(1.0 - rough, 0.02, 10.0)
        current = _bounded(self._current_gain() * error, 1e-12, np.inf)
        load = np.abs(trial.current.mean(axis=0))
        available = np.maximum(CURRENT * (limit - load), 0.1 * limit)
        # Speed per current at the lowest lines, times w: the acceleration per current, for the ramps.
        low = slice(0, max(4, len(lines.f) // 10))
        mobility = np.median(np.abs(gain / current * omega)[low], axis=0)
        top = SPEED * self._target.speed
        by_ramp = IN_RAMP * available * mobility * RAMP * CYCLE
        by_way = room / _duration(self._periods, lines)
        fastest = np.minimum(np.minimum(top, by_ramp), by_way)
        # On a short way, a steady speed would be too slow for the encoder: the motion then reverses.
        largest = np.minimum(np.maximum(0.9 * fastest, OVER_NOISE * CREST * self._noise()), 0.9 * top)
        amplitude = dimension(lines, np.abs(current), np.abs(gain), available, largest)
        way = peak(self._kind, lines, amplitude, gain / omega)
        flowing, shaken = (peak(self._kind, lines, amplitude, answer) for answer in (current, gain))
        tiny = np.finfo(float).tiny
        # A stop feeds back J w^2 / 2, an oscillation 2 J w dw, which the DC link must take; losses are a reserve.
        inertia, held = self._target.motor.torque_constant / mobility, link_energy(self._target)
        energy = held / inertia
        self._stoppable, returned = np.sqrt(2.0 * energy), np.sqrt(energy / (2.0 * 1.1))
        shares = [
            available / (flowing + tiny), largest / (shaken + tiny), 0.5 * np.maximum(room, 1e-9) / (way + tiny),
            returned / (shaken + tiny),
        ]  # fmt: skip
        fits = np.min(shares, axis=0)
        amplitude, shaken = amplitude * fits, shaken * fits
        speed = np.minimum(1.1 * shaken, fastest)
        # A descending weight has already charged the link before the stop.
        while True:
            falling = self._falling(shaker, speed, self._passes, self._periods)
            over = falling > LINK_SHARE * np.maximum(held - 0.5 * inertia * (speed + shaken) ** 2, 0.0) + TINY
            if not over.any():
                break
            amplitude, shaken, speed = (np.where(over, SLOWER * one, one) for one in (amplitude, shaken, speed))
        for axis in np.flatnonzero(self._where & (speed < 0.9 * shaken)):
            why = "its travel is too short" if by_way[axis] <= fastest[axis] else "its limits are too narrow"
            self._notes[axis].append(
                f"{why} for a steady speed: the motion reversed, so that friction is part of the response"
            )
        return amplitude, speed

    def _current_gain(self) -> Complex:
        """Return demanded current per velocity of the set-point with open loop, complex (n, axes)."""
        f = self._lines.f
        z = np.exp(2j * math.pi * f / self._device.velocity_rate)
        columns = []
        for row in self._gains:
            regulator = controllers(self._device, row)
            gain = regulator.velocity(z)
            # In a position loop, the inner velocity loop amplifies by up to 1.5.
            columns.append(gain if self._loop == "velocity" else 1.5 * gain * regulator.position / (2j * math.pi * f))
        return np.stack(columns, axis=1)

    def _noise(self) -> float:
        motor = self._target.motor
        plant = Plant.from_data_sheet(self._device, motor, motor.voltage, motor.inertia)
        return velocity_noise(self._device, plant)

    def _note_oscillation(self, seen: Pass, where: Mask) -> Floats:
        """Return the frequency of axes that oscillate [Hz], else 0: their currents do not repeat with the signal."""
        shape = (self._passes, self._periods, self._lines.samples, len(where))
        current = seen.current.reshape(shape)
        own = (current - current.mean(axis=1, keepdims=True)).reshape(self._passes, -1, len(where))
        found = where & shakes(own.reshape(-1, len(where)), self._target.motor.rated_current)
        # Evaluate the pass with the strongest oscillation: its phase differs from pass to pass.
        strongest = own[own.std(axis=1).argmax(axis=0), :, np.arange(len(where))].T
        frequency, share = strongest_frequency(strongest)
        found &= share > ONE_FREQUENCY  # noise has all frequencies
        for axis in np.flatnonzero(found):
            told = f"the loop oscillates at {frequency[axis]:.0f} Hz, whatever it is shaken with"
            also = ", or late SYNCs make its current swing so"
            self._notes[axis].append(f"{told}{also if self._late else ''}: lower its gains, velocity P first")
        return np.where(found, frequency, 0.0)

    def _note_limits(self, peak: Floats, where: Mask) -> None:
        limit = read_current_limit(self._target.drives)
        for axis in np.flatnonzero(where & (peak > 0.98 * limit)):
            self._notes[axis].append(
                f"the current reached its limit, {limit[axis]:.2f} A, more than the excitation: the loop oscillates, "
                "or nearly so"
            )

    # --- evaluation -----------------------------------------------------------------------------------------------
    def _evaluate(self, where: Mask) -> MeasuredLoop:
        seen, less = self._seen, self._less
        lines = self._lines._replace(f=self._lines.f[self._lines.f <= self._top])
        f = lines.f
        closed, coherence, spread = transfer(seen.set_point, seen.answer, lines)
        parts, distortion = directions(seen.set_point, seen.answer, lines, self._passes)
        weaker = None if less is None else transfer(less.set_point, less.answer, lines)
        open_loop = np.full(closed.shape, np.nan, complex)
        fits: list[PlantFit | None] = [None] * closed.shape[1]
        for axis in map(int, np.flatnonzero(where)):
            images = np.zeros(len(f), complex)
            if self._loop == "velocity":
                fit = self._fit(
                    axis, f, (closed[:, axis], coherence[:, axis], spread[:, axis]), [part[:, axis] for part in parts],
                    float(distortion[axis]), seen.current[:, axis],
                    None if weaker is None else (weaker[0][:, axis], weaker[1][:, axis], weaker[2][:, axis]),
                )  # fmt: skip
                fits[axis] = fit
                images = split(self._device, f, _closed_by(self._device, fit, self._gains[axis]))[1]
            T = unhold(self._device, f, closed[:, axis], images)
            open_loop[:, axis] = T / (1.0 - T)
        coherence = np.where(where, coherence, 0.0)
        traced = np.zeros(len(f), bool)
        if self._traced:
            fast = _fast(seen, self._lines)
            f = np.concatenate([f, fast[0]])
            open_loop = np.concatenate([open_loop, np.where(where, fast[1], np.nan)])
            coherence = np.concatenate([coherence, np.where(where, fast[2], 0.0)])
            traced = np.concatenate([traced, np.ones(len(fast[0]), bool)])
        speed = np.abs(seen.answer).max(axis=0) if self._loop == "velocity" else np.full(len(where), np.nan)
        return MeasuredLoop(
            self._device, self._loop, f, open_loop, coherence, traced, self._gains, tuple(fits), speed,
            seen.peak_current, self._drive_time, tuple(tuple(notes) for notes in self._notes), np.zeros(len(where)),
        )  # fmt: skip

    def _fit(
        self, axis: int, f: Floats, measured: _Transfer, parts: Sequence[Complex], distortion: float, current: Floats,
        weaker: _Transfer | None,
    ) -> PlantFit:  # fmt: skip
        target, device = self._target, self._device
        supply = float(target.supply[axis])
        start = Plant.from_data_sheet(device, target.motor, supply, 3.0 * target.motor.inertia)
        lines, good = _fitted(f, measured)
        fit = fit_plant(
            device, self._gains[axis], *lines, start, [part[good] for part in parts], distortion,
            dead_time_resistance(device, target.motor, supply, current),
            None if weaker is None else _fitted(f, weaker)[0],
        )  # fmt: skip
        if not (fit.reason or fit.is_good):
            self._notes[axis].append(
                f"the linear model does not fit (error {fit.misfit:.1f} times the noise); margins are read from the "
                "measured frequencies alone"
            )
        if fit.reason:
            self._notes[axis].append(f"excitation too weak: {fit.reason}")
        return fit


_Transfer = tuple[Complex, Floats, Floats]  # of one axis, as returned by `transfer`


def _fitted(f: Floats, measured: _Transfer) -> tuple[Seen, Mask]:
    """Return the lines to fit, and their mask: those with some coherence if they suffice, else the trusted ones."""
    closed, coherence, spread = measured
    good = coherence >= FITTED
    clear = np.minimum(coherence[good], COHERENT)
    if np.sum(clear / (1.0 - clear)) < WORTH * COHERENT / (1.0 - COHERENT):
        good = coherence >= COHERENT
    return Seen(f[good], closed[good], spread[good]), good


def _closed_by(device: Device, fit: PlantFit, gains: Integers) -> Callable[[Floats], Complex]:
    def closed(at: Floats) -> Complex:
        L = fit.open_loop(device, gains, at)
        return np.asarray(L / (1.0 + L))

    return closed


def _bounded(value: Complex, low: float, high: float) -> Complex:
    """Limit the size of complex numbers; the trial is too rough beyond these limits."""
    size = np.maximum(np.abs(value), np.finfo(float).tiny)
    return np.asarray(np.where(value == 0.0, low, value * np.clip(size, low, high) / size))


def _duration(periods: int, lines: Lines) -> float:
    """Return how long an axis moves in one direction [s], as time at full speed."""
    return (2 * RAMP + SETTLING + periods * lines.samples) * CYCLE


def _fast(seen: Pass, lines: Lines) -> tuple[Floats, Complex, Floats]:
    """Return frequencies above the bus's limit, open loop and coherence there, from the trace.

    The excitation there consists of the images of the held set-points.
    """
    windows = len(seen.fast_answer) // len(seen.answer)
    first = int(BUS_LIMIT / lines.rate * lines.samples) + 1
    last = int(TRACE_LIMIT / lines.rate * lines.samples)
    bins = np.arange(first, last + 1)
    all_lines = Lines(bins * lines.rate / lines.samples, lines.samples * windows, lines.rate * windows)
    closed, coherence, _ = transfer(seen.fast_set_point, seen.fast_answer, all_lines)
    # Only the lines and their images are excited; holding removes multiples of the bus's rate.
    folded = np.minimum(bins % lines.samples, -bins % lines.samples)
    lit = np.isin(folded, lines.bins)
    return all_lines.f[lit], (closed / (1.0 - closed))[lit], coherence[lit]
