"""Margins of an open loop from its frequency response: phase, gain, crossover, bandwidth, greatest sensitivity."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mechanics.arrays import Complex, Floats, Integers, Mask


class Margins(NamedTuple):
    """The margins of an open loop; nan where the measured frequencies do not give one.

    phase_deg: Least distance from -180 degrees where the gain is 1 [degrees]; negative is unstable.
    gain_db: Least factor, in dB, by which the gain may rise before the loop oscillates; infinite if the phase never
        reaches -180 degrees with a gain below 1; nan if it may do so at frequencies that are not trusted, with more
        gain; negative: by how much the gain must fall for the loop to be stable.
    crossover_hz: Lowest frequency from which on the gain is below 1 until the next crossing [Hz].
    bandwidth_hz: Frequency at which the closed loop's gain has fallen by 3 dB [Hz].
    ms: Greatest sensitivity |1 / (1 + L)|.
    phase_hz, gain_hz: Frequencies of phase_deg and gain_db [Hz]: with a resonance there are several crossings.
    """

    phase_deg: float
    gain_db: float
    crossover_hz: float
    bandwidth_hz: float
    ms: float
    phase_hz: float = math.nan
    gain_hz: float = math.nan


def margins(f: ArrayLike, open_loop: ArrayLike, trusted: ArrayLike | None = None) -> Margins:
    """Return the margins of an open loop, interpolated between its frequencies.

    Args:
        f: Frequencies [Hz], increasing, shape (n,).
        open_loop: L, complex, shape (n,).
        trusted: Which frequencies count, shape (n,); an interval counts if both ends do.

    Raises:
        ValueError: For shapes that do not fit, or frequencies that do not increase.
    """
    at, L = np.asarray(f, float), np.asarray(open_loop, complex)
    good = np.ones(at.shape, bool) if trusted is None else np.asarray(trusted, bool)
    if at.ndim != 1 or at.shape != L.shape or good.shape != at.shape or at.size < 2:
        raise ValueError(
            f"frequencies {at.shape}, open loop {L.shape} and mask {good.shape} must be rows of one length"
        )
    if np.any(np.diff(at) <= 0.0) or at[0] <= 0.0:
        raise ValueError("frequencies must be above 0 and increase")
    good = good & np.isfinite(L)
    L = np.where(good, L, 1.0)
    log_gain, off = np.log(np.abs(L)), np.angle(-L)  # off: angle from -180 degrees
    both = good[1:] & good[:-1]
    gains = _crossings(at, log_gain, both & (log_gain[:-1] * log_gain[1:] <= 0.0) & (log_gain[:-1] != log_gain[1:]))
    # A jump of the angle by more than half a turn is its wrap at 0 degrees, not a crossing of -180.
    turned = np.abs(np.diff(off)) < math.pi
    phases = _crossings(at, off, both & turned & (off[:-1] * off[1:] <= 0.0) & (off[:-1] != off[1:]))
    continuous = np.unwrap(off)
    phase = crossover = phase_at = math.nan
    if gains.size:
        angles = (np.interp(np.log(gains), np.log(at), continuous) + math.pi) % (2.0 * math.pi) - math.pi
        least = int(np.argmin(np.abs(angles)))
        phase, phase_at = math.degrees(float(angles[least])), float(gains[least])
        falling = gains[[log_gain[np.searchsorted(at, x, side="right") - 1] > 0.0 for x in gains]]
        crossover = float(falling[0]) if falling.size else float(gains[0])
    known = np.flatnonzero(good)
    unseen = _unseen(known, log_gain)
    if unseen.size:
        # The gain passes 1 between trusted frequencies: the phase there is unknown, and may be the worst.
        phase = phase_at = math.nan
        crossover = math.nan if not crossover < at[known[unseen[0]]] else crossover
    gain, gain_at = _gain_margin(at, log_gain, off, phases)
    left, right = known[:-1], known[1:]
    hidden = (right - left > 1) & (off[left] * off[right] < 0.0) & (np.abs(off[left] - off[right]) < math.pi)
    if hidden.any():
        # The phase passes -180 degrees between trusted frequencies; the gain there may be the greater of both ends'.
        worst = -20.0 / math.log(10.0) * float(np.maximum(log_gain[left], log_gain[right])[hidden].max())
        gain, gain_at = (math.nan, math.nan) if worst < gain else (gain, gain_at)
    closed = np.where(good, np.abs(L / (1.0 + L)), math.nan)
    sensitivity = 1.0 / np.abs(1.0 + L[good]) if good.any() else np.array([math.nan])
    return Margins(phase, gain, crossover, _bandwidth(at, closed), float(sensitivity.max()), phase_at, gain_at)


def is_as_stable(before: Complex, now: Complex) -> Mask:
    """Return whether closed loops are as stable with one open loop as with another, shape (...) of (..., n).

    They are if 1 + L encircles 0 as often.
    """
    turned = np.unwrap(np.angle((1.0 + now) / (1.0 + before)), axis=-1)
    return np.asarray(np.abs(turned[..., -1] - turned[..., 0]) < math.pi)


def _unseen(known: Integers, log_gain: Floats) -> Integers:
    """Return the trusted frequencies that are followed by untrusted ones in which the gain passes 1."""
    return np.flatnonzero((np.diff(known) > 1) & (np.diff(np.sign(log_gain[known])) != 0.0))


def _crossings(f: Floats, value: Floats, where: Mask) -> Floats:
    """Return the frequencies at which a value passes 0 in the chosen intervals, by a straight line over log f."""
    k = np.flatnonzero(where)
    share = value[k] / (value[k] - value[k + 1])
    return np.asarray(np.exp(np.log(f[k]) + share * np.log(f[k + 1] / f[k])))


def _gain_margin(f: Floats, log_gain: Floats, off: Floats, phases: Floats) -> tuple[float, float]:
    """Return the gain margin [dB] and its frequency [Hz], from the crossings of -180 degrees at `phases` [Hz]."""
    if not phases.size:
        return math.inf, math.nan
    margin = -20.0 / math.log(10.0) * np.interp(np.log(phases), np.log(f), log_gain)
    before = np.searchsorted(f, phases, side="right") - 1
    falling = off[np.clip(before, 0, len(off) - 1)] > 0.0
    # Nyquist: unstable if, with a gain above 1, the phase falls through -180 degrees more often than it rises.
    beyond = margin < 0.0
    count = beyond & falling if np.count_nonzero(beyond & falling) > np.count_nonzero(beyond & ~falling) else ~beyond
    if not count.any():
        return math.inf, math.nan
    k = np.flatnonzero(count)[margin[count].argmin()]
    return float(margin[k]), float(phases[k])


def _bandwidth(f: Floats, closed: Floats) -> float:
    known = np.flatnonzero(np.isfinite(closed))
    if not known.size:
        return math.nan
    level = math.sqrt(0.5)
    above = closed[known] >= level
    if not above[0]:
        return math.nan
    fallen = np.flatnonzero(~above)
    if not fallen.size:
        return math.nan
    k = known[fallen[0]]
    before = known[fallen[0] - 1]
    share = math.log(closed[before] / level) / math.log(closed[before] / closed[k])
    return float(f[before] * (f[k] / f[before]) ** share)
