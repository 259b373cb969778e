"""Figures of a recorded move: step, disturbance, effort and ringing, for many axes at once.

A record is a time vector t [s], shape (n,), and signals of shape (n,) for one axis or (n, num_axes) for many; every
figure then has shape () or (num_axes,). A figure that does not exist (never rises, never settles) is nan, never an
exception and never inf. An axis with a sample that is not finite has diverged: all its figures are nan and it counts as
oscillating; other axes are not affected. Only invalid arguments raise ValueError.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanics.arrays import Floats, Integers, Mask

ROUNDING = 1e-9  # of the record: a sample may lie outside a time limit by this, since t = k * dt is rounded

# Oscillation, see `oscillation`; the first three in units of the amplitude to be found.
SWING = 1.3  # a sine sampled four times per period shows 1.41 to 2 amplitudes from valley to peak
LATE_SWING = 0.8  # one whole period cut out of a sine has a swing of 1 to 2 amplitudes
RMS = 0.4  # a sine has 0.71; white noise with an rms of 1 % of a step has 0.2 of a 5 % amplitude
DECAY = 0.5  # late swing over early swing; one whole period of a steady sine may show 0.5
REVERSALS = 3  # a response with a damping of 0.35 or more has at most two
TRANSIENT = 0.2  # leading share of the record in which no swing is measured


@dataclass(frozen=True)
class StepMetrics:
    """The figures of one step response; each figure has shape () or (num_axes,)."""

    rise_time: Floats  # s, 10 % to 90 %
    settling_time: Floats  # s after the step
    overshoot: Floats  # fraction of the step height
    undershoot: Floats  # fraction of the step height
    steady_state_error: Floats  # unit of y, reference - y
    iae: Floats  # unit of y * s
    itae: Floats  # unit of y * s^2
    oscillating: Mask
    oscillation_frequency: Floats  # Hz


@dataclass(frozen=True)
class DisturbanceMetrics:
    """The figures of one load step; each figure has shape () or (num_axes,)."""

    dip: Floats  # unit of y, magnitude
    recovery_time: Floats  # s after the load step
    iae: Floats  # unit of y * s


@dataclass(frozen=True)
class CurrentMetrics:
    """The effort of a move; each figure has shape () or (num_axes,)."""

    peak: Floats  # A
    rms: Floats  # A
    saturation_share: Floats  # fraction of the samples


def step_metrics(
    t: ArrayLike,
    y: ArrayLike,
    reference: ArrayLike,
    *,
    t_step: float,
    t_end: float | None = None,
    initial: ArrayLike | None = None,
    band: float = 0.02,
    tail: float = 0.1,
    oscillation_amplitude: float = 0.05,
) -> StepMetrics:
    """Return all figures of a step response between t_step and t_end; steps up and down are treated alike.

    Args:
        t: Sample times [s], strictly increasing, shape (n,).
        y: Response, shape (n,) or (n, num_axes).
        reference: Set-point [unit of y]: one number, one per axis (num_axes,), or a signal of the shape of y. Rise,
            settling, overshoot and undershoot refer to its value at t_end, the errors to its course.
        t_step: Time of the step [s]; the figures use the samples from here on.
        t_end: End of the evaluated window [s]; None is the last sample.
        initial: Value before the step [unit of y], () or (num_axes,); None is the last sample not later than t_step.
        band: Half width of the settling band [fraction of the step height].
        tail: Last part of the window, over which the steady-state error is averaged [fraction].
        oscillation_amplitude: Smallest amplitude that counts as ringing [fraction of the step height].

    Raises:
        ValueError: If the shapes do not fit, t does not increase, t_step or t_end lies outside the record, a fraction
            lies outside (0, 1), or the step height is zero, since overshoot is then undefined.

    """
    times, signal = _record(t, y)
    for name, fraction in (("band", band), ("tail", tail), ("oscillation_amplitude", oscillation_amplitude)):
        _check_fraction(name, fraction)
    window = _window(times, t_step, t_end, "t_step")
    target = _per_sample(reference, signal, "reference")
    final = target[window.stop - 1]
    start = _before(times, signal, t_step) if initial is None else _per_axis(initial, signal, "initial")
    height = final - start
    if np.any(height == 0):
        raise ValueError(
            f"step height is zero on {np.count_nonzero(height == 0)} of {height.size} axes (reference equals initial); "
            "overshoot needs a step: leave these axes out or give initial="
        )
    elapsed = times[window] - t_step
    with np.errstate(over="ignore", invalid="ignore"):
        error = target - signal
        diverged = _diverged(error) | ~np.isfinite(height)
        error = error[window]
        progress = (signal[window] - start) / height
        oscillating, frequency = oscillation(elapsed, error, amplitude=oscillation_amplitude * np.abs(height))
        return StepMetrics(
            rise_time=_or_nan(rise_time(elapsed, progress), diverged),
            settling_time=_or_nan(settling_time(elapsed, progress, band=band), diverged),
            overshoot=_or_nan(overshoot(progress), diverged),
            undershoot=_or_nan(undershoot(progress), diverged),
            steady_state_error=_or_nan(steady_state_error(elapsed, error, tail=tail), diverged),
            iae=_or_nan(iae(elapsed, error), diverged),
            itae=_or_nan(itae(elapsed, error), diverged),
            oscillating=oscillating | diverged,
            oscillation_frequency=_or_nan(frequency, diverged),
        )


def disturbance_metrics(
    t: ArrayLike, y: ArrayLike, reference: ArrayLike, *, t_load: float, t_end: float | None = None, band: float = 0.1
) -> DisturbanceMetrics:
    """Return dip, recovery time and IAE of a load step between t_load and t_end.

    The deviation is y minus its last sample not later than t_load. dip = max |deviation| [unit of y]. Recovery time
    [s] runs from t_load until |deviation| stays within band * dip up to t_end, the crossing linearly interpolated;
    nan if the last sample is outside, 0 without a dip. IAE = integral of |reference - y| [unit of y * s].

    Args:
        t: Sample times [s], strictly increasing, shape (n,).
        y: Response, shape (n,) or (n, num_axes).
        reference: Set-point [unit of y]: one number, one per axis (num_axes,), or a signal of the shape of y.
        t_load: Time of the load step [s]; the figures use the samples from here on.
        t_end: End of the evaluated window [s]; None is the last sample.
        band: Half width of the recovery band [fraction of the dip].

    Raises:
        ValueError: As in `step_metrics`, except for the step height.

    """
    times, signal = _record(t, y)
    _check_fraction("band", band)
    window = _window(times, t_load, t_end, "t_load")
    target = _per_sample(reference, signal, "reference")
    elapsed = times[window] - t_load
    with np.errstate(over="ignore", invalid="ignore"):
        error = target - signal
        diverged = _diverged(error)
        deviation = signal[window] - _before(times, signal, t_load)
        dip = peak(deviation)
        return DisturbanceMetrics(
            dip=_or_nan(dip, diverged),
            recovery_time=_or_nan(_time_to_stay(elapsed, deviation, band * dip), diverged),
            iae=_or_nan(iae(elapsed, error[window]), diverged),
        )


def current_metrics(i: ArrayLike, *, i_max: ArrayLike, tol: float = 0.01) -> CurrentMetrics:
    """Return peak and RMS current [A] and the share of samples at the limit.

    Args:
        i: Current [A], evenly sampled, shape (n,) or (n, num_axes).
        i_max: Current limit [A], positive, shape () or (num_axes,).
        tol: A sample is saturated if |i| >= (1 - tol) * i_max [fraction].

    Raises:
        ValueError: If there is no sample, i_max is not positive or tol lies outside (0, 1).

    """
    current = _signal(i, "i")
    _check_fraction("tol", tol)
    limit = _per_axis(i_max, current, "i_max")
    if not np.all(limit > 0):
        raise ValueError(f"i_max={np.min(limit):g} A must be positive; give the current limit as a magnitude")
    diverged = _diverged(current)
    with np.errstate(over="ignore", invalid="ignore"):
        return CurrentMetrics(
            peak=_or_nan(peak(current), diverged),
            rms=_or_nan(rms(current), diverged),
            saturation_share=_or_nan(np.mean(np.abs(current) >= (1 - tol) * limit, axis=0), diverged),
        )


def rise_time(t: Floats, progress: Floats) -> Floats:
    """Return the time [s] from the first crossing of 10 % to the first of 90 %, linearly interpolated.

    progress = (y - initial) / (reference - initial), shape (n,) or (n, num_axes). nan if 90 % is never reached.
    """
    return np.asarray(_first_crossing(t, progress, 0.9) - _first_crossing(t, progress, 0.1))


def settling_time(t: Floats, progress: Floats, *, band: float) -> Floats:
    """Return the time [s] from which |1 - progress| <= band up to the last sample, linearly interpolated.

    t runs from the step. nan if the last sample is outside the band, 0 if no sample is.
    """
    return _time_to_stay(t, progress - 1, band)


def overshoot(progress: Floats) -> Floats:
    """Return max(progress) - 1, the farthest beyond the reference [fraction of the step height], at least 0."""
    return np.asarray(np.maximum(progress.max(axis=0) - 1, 0))


def undershoot(progress: Floats) -> Floats:
    """Return -min(progress), the farthest from initial away from the reference [fraction of height], at least 0."""
    return np.asarray(np.maximum(-progress.min(axis=0), 0))


def steady_state_error(t: Floats, error: Floats, *, tail: float) -> Floats:
    """Return the mean of error = reference - y [its unit] over the samples in the last `tail` [fraction] of t."""
    return np.asarray(error[_index_at(t, t[-1] - tail * (t[-1] - t[0])) :].mean(axis=0))


def iae(t: Floats, error: Floats) -> Floats:
    """Return the integral of |error| dt [unit of error * s] by the trapezoid rule."""
    return _weighted_sum(_trapezoid_weights(t), np.abs(error))


def itae(t: Floats, error: Floats) -> Floats:
    """Return the integral of t |error| dt [unit of error * s^2] by the trapezoid rule; t runs from the step."""
    return _weighted_sum(_trapezoid_weights(t) * t, np.abs(error))


def peak(x: Floats) -> Floats:
    """Return max |x| [unit of x]."""
    return np.asarray(np.maximum(x.max(axis=0), -x.min(axis=0)))


def rms(x: Floats) -> Floats:
    """Return the root of the mean square [unit of x] of even samples."""
    return np.asarray(np.sqrt(_weighted_sum(np.full(len(x), 1.0 / len(x)), x * x)))


def oscillation(t: ArrayLike, x: ArrayLike, *, amplitude: ArrayLike) -> tuple[Mask, Floats]:
    """Return whether x, an error or a current, rings without decaying, and the frequency [Hz], nan without ringing.

    Nothing is detrended: a ramp, an offset or a slow settling has no reversal. The first fifth of the record is omitted
    as a transient, the rest is divided into an early and a late half; the swing of a half is the smaller of its largest
    fall and its largest rise. x rings if
    1. the late half spans 1.3 amplitudes from valley to peak, with a standard deviation of 0.4 (not noise),
    2. its swing is at least 0.8 amplitudes and half the early one (not decaying),
    3. x reverses at least three times in the record, by 1.3 amplitudes each time (not one overshoot).
    The record needs 3.5 periods for a reliable result: 5 Hz needs 0.7 s, and 0.15 s is enough from 23 Hz; with fewer
    periods ringing may be mistaken for a transient. At 1 kHz it works up to 450 Hz. Decaying and steady ringing are
    distinguished after 2.3 periods with a damping of 0.2 to 0.35, after 4 with 0.1. Noise must stay below 0.2
    amplitudes rms. The frequency is the highest line of the Hann spectrum, for evenly spaced samples.

    Args:
        t: Sample times [s] from the step on, strictly increasing, shape (n,).
        x: Signal, shape (n,) or (n, num_axes). An axis that is not finite has diverged and counts as ringing.
        amplitude: Smallest amplitude (half of peak to peak) that counts [unit of x], () or (num_axes,).

    Raises:
        ValueError: If the shapes do not fit, t does not increase or amplitude is not positive.

    """
    times, signal = _record(t, x)
    smallest = np.broadcast_to(_per_axis(amplitude, signal, "amplitude"), signal.shape[1:]).ravel()
    if np.any(smallest <= 0):
        raise ValueError(f"amplitude={smallest.min():g} must be positive; give what still counts as steady, unit of x")
    columns = signal.reshape(len(signal), len(smallest))
    early, late = (_index_at(times, times[0] + share * (times[-1] - times[0])) for share in (TRANSIENT, 0.6))
    diverged = _diverged(columns)
    with np.errstate(over="ignore", invalid="ignore"):
        # Peak to peak is cheap and an upper bound of the swing: most axes of a grid need no further test.
        (rings,) = np.nonzero((np.ptp(columns[late:], axis=0) >= SWING * smallest) & ~diverged)
    rings = rings[columns[late:, rings].std(axis=0) >= RMS * smallest[rings]]
    late_swing = _swing(columns[late:, rings])
    lasting = (late_swing >= LATE_SWING * smallest[rings]) & (late_swing >= DECAY * _swing(columns[early:late, rings]))
    rings = rings[lasting]
    if rings.size:  # the only loop over time; most records do not need it
        rings = rings[_reversals(columns[:, rings], SWING * smallest[rings]) >= REVERSALS]
    oscillating, frequency = diverged, np.full(smallest.shape, np.nan)
    if rings.size:
        oscillating[rings] = True
        frequency[rings] = _strongest_line(times[early:], columns[early:, rings])
    return oscillating.reshape(signal.shape[1:]), frequency.reshape(signal.shape[1:])


def _swing(x: Floats) -> Floats:
    """Return the smaller of the largest fall and the largest rise within x [unit of x]."""
    fall = (np.maximum.accumulate(x) - x).max(axis=0, initial=0.0)
    rise = (x - np.minimum.accumulate(x)).max(axis=0, initial=0.0)
    return np.asarray(np.minimum(fall, rise))


def _reversals(x: Floats, swing: Floats) -> Integers:
    """Return how often each column of x turns around and then moves by `swing` the other way."""
    high, low = x[0], x[0]
    direction, count = np.zeros((2, *high.shape), dtype=np.int64)
    for row in x[1:]:
        high, low = np.maximum(high, row), np.minimum(low, row)
        turn = np.where((direction <= 0) & (row - low >= swing), 1, 0)
        turn = np.where((direction >= 0) & (high - row >= swing), -1, turn)
        turned = turn != 0
        count += turned & (direction != 0)
        direction = np.where(turned, turn, direction)
        high, low = np.where(turned, row, high), np.where(turned, row, low)
    return np.asarray(count)


def _strongest_line(t: Floats, x: Floats) -> Floats:
    """Return the frequency [Hz] of the highest line of the Hann spectrum, by a parabola through its logarithm."""
    centred = t - t.mean()
    detrended = x - x.mean(axis=0) - np.outer(centred, centred @ x / (centred @ centred))
    spectrum = np.abs(np.fft.rfft(detrended * np.hanning(len(t))[:, None], axis=0))
    line = 1 + spectrum[1:-1].argmax(axis=0)[None]
    below, at, above = (
        np.log(np.take_along_axis(spectrum, line + shift, axis=0)[0] + np.finfo(float).tiny) for shift in (-1, 0, 1)
    )
    offset = np.clip(0.5 * (below - above) / (below - 2 * at + above), -0.5, 0.5)
    return np.asarray((line[0] + offset) * (len(t) - 1) / (len(t) * (t[-1] - t[0])))


def _first_crossing(t: Floats, x: Floats, level: float) -> Floats:
    """Return the time [s] at which x first reaches the level, t[0] if it starts there, nan if it never does."""
    reached = x >= level
    after = reached.argmax(axis=0)
    before = np.maximum(after - 1, 0)
    x_before, x_after = _pick(x, before), _pick(x, after)
    share = _divide(level - x_before, x_after - x_before)
    crossing = np.where(after == 0, t[0], t[before] + share * (t[after] - t[before]))
    return np.where(_pick(reached, after), crossing, np.nan)


def _time_to_stay(t: Floats, x: Floats, limit: ArrayLike) -> Floats:
    """Return the time [s] from which |x| <= limit up to the end, 0 if always, nan if not at the last sample."""
    outside = np.abs(x) > limit
    last = len(t) - 1 - outside[::-1].argmax(axis=0)
    after = np.minimum(last + 1, len(t) - 1)
    x_last, x_after = _pick(x, last), _pick(x, after)
    share = _divide(x_last - np.copysign(limit, x_last), x_last - x_after)
    entry = np.where(outside[-1], np.nan, t[last] + share * (t[after] - t[last]))
    return np.where(_pick(outside, last), entry, 0.0)


def _pick(x: NDArray[Any], k: Integers) -> NDArray[Any]:
    return np.asarray(np.take_along_axis(x, np.asarray(k)[None], axis=0)[0])


def _divide(a: Floats, b: Floats) -> Floats:
    """Return a / b, 0 if b is 0: then the neighbouring sample decides and the quotient is not used."""
    return np.divide(a, b, out=np.zeros(np.shape(a)), where=np.asarray(b != 0))


def _weighted_sum(weights: Floats, x: Floats) -> Floats:
    """Return the sum of weights * x over samples, added in the order of the samples.

    A matrix product would round differently depending on the number of axes; an axis must give identical results alone.
    """
    return np.asarray(np.cumsum(weights.reshape(-1, *(1,) * (x.ndim - 1)) * x, axis=0)[-1])


def _trapezoid_weights(t: Floats) -> Floats:
    """Return weights w [s] with which w @ x is the trapezoid integral of x."""
    half = np.diff(t) / 2
    return np.asarray(np.append(half, 0.0) + np.append(0.0, half))


def _diverged(x: Floats) -> Mask:
    """Return which axes have a sample that is not finite."""
    return np.asarray(~np.isfinite(x).all(axis=0))


def _or_nan(figure: Floats, diverged: Mask) -> Floats:
    """Return the figure, nan if the axis diverged or the arithmetic overflowed."""
    return np.where(diverged | ~np.isfinite(figure), np.nan, figure)


def _index_at(t: Floats, time: float) -> int:
    """Return the first sample at or after the time [s]."""
    return int(np.searchsorted(t, time - ROUNDING * (t[-1] - t[0])))


def _before(t: Floats, y: Floats, time: float) -> Floats:
    """Return the last sample of y not later than the time [s]."""
    return np.asarray(y[np.searchsorted(t, time + ROUNDING * (t[-1] - t[0])) - 1])


def _window(t: Floats, start: float, end: float | None, name: str) -> slice:
    """Return the samples from start to end [s]."""
    slack = ROUNDING * (t[-1] - t[0])
    if not t[0] - slack <= start < t[-1]:
        raise ValueError(
            f"{name}={start:g} s lies outside the record of {t[0]:g} s to {t[-1]:g} s; choose {name} within it, "
            "before its last sample"
        )
    if end is None:
        end = float(t[-1])
    if not start < end <= t[-1] + slack:
        raise ValueError(f"t_end={end:g} s lies outside {name}={start:g} s to {t[-1]:g} s; choose t_end within them")
    window = slice(_index_at(t, start), int(np.searchsorted(t, end + slack)))
    if window.stop - window.start < 2:
        raise ValueError(
            f"empty window: {name}={start:g} s to t_end={end:g} s holds {window.stop - window.start} samples of at "
            "least 2; widen it or sample faster"
        )
    return window


def _record(t: ArrayLike, y: ArrayLike) -> tuple[Floats, Floats]:
    """Convert t and y to float arrays and check that their shapes fit."""
    times, signal = np.asarray(t, dtype=np.float64), _signal(y, "signal")
    if times.ndim != 1 or len(signal) != times.size:
        raise ValueError(
            f"t of shape {times.shape} does not fit a signal of shape {signal.shape}; give t as (n,) and the signal "
            "as (n,) or (n, num_axes)"
        )
    if not np.all(np.diff(times) > 0):
        k = int(np.argmin(np.diff(times) > 0))
        raise ValueError(
            f"t is not strictly increasing: t[{k}]={times[k]:g} s, t[{k + 1}]={times[k + 1]:g} s; "
            "sort the record and drop repeated samples"
        )
    return times, signal


def _signal(x: ArrayLike, name: str) -> Floats:
    signal = np.asarray(x, dtype=np.float64)
    if signal.ndim not in (1, 2) or not len(signal):
        raise ValueError(f"{name} has shape {signal.shape}; give at least one sample as (n,) or (n, num_axes)")
    return signal


def _per_axis(x: ArrayLike, signal: Floats, name: str) -> Floats:
    values = np.asarray(x, dtype=np.float64)
    if values.shape not in ((), signal.shape[1:]):
        raise ValueError(
            f"{name} of shape {values.shape} does not fit a signal of shape {signal.shape}; give one number or an "
            f"array of shape {signal.shape[1:]}"
        )
    return values


def _per_sample(x: ArrayLike, signal: Floats, name: str) -> Floats:
    values = np.asarray(x, dtype=np.float64)
    return np.broadcast_to(values if values.shape == signal.shape else _per_axis(values, signal, name), signal.shape)


def _check_fraction(name: str, value: float) -> None:
    if not 0 < value < 1:
        raise ValueError(f"{name}={value:g} must lie in (0, 1); give a fraction, 0.02 for 2 %")
