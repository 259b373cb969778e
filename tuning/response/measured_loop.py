"""A measured loop: its lines, their mask of trusted ones, and values between the lines."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from drive_env.loops import margins as margins_
from drive_env.loops.linear_model import controllers, outer_loop, velocity_open_loop
from mechanics.arrays import Complex, Floats, Integers, Mask

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.loops.linear_model import Plant
    from tuning.estimate import Estimate
    from tuning.response.plant_fit import PlantFit


COHERENT = 0.95  # least coherence of a trusted line
FINE = 10  # points between two lines, at which margins are searched
SMOOTHING = 1.5  # lines, standard deviation of the averaging
DRAWS, DRAWN_SEED, SURE = 100, 20, 2.5  # plants drawn within a fit's intervals; percentile as lower bound
MODEL_POINTS, MODEL_LOW, NYQUIST = 400, 2.0, 0.49  # frequencies of a model: number, lowest [Hz], highest over its rate


class Loops(NamedTuple):
    """Both outer loops of an axis from one measurement: frequencies [Hz], complex open loops, trusted lines.

    All of shape (n,). The position loop is computed from the measured velocity loop and position P.
    """

    f: Floats
    velocity: Complex
    position: Complex
    trusted: Mask

    def margins(self) -> dict[str, margins_.Margins]:
        """Return the margins of both by name, from their trusted lines; nan for those not measured."""
        both = {"velocity": self.velocity, "position": self.position}
        return {name: seen_margins(self.f, L, self.trusted) for name, L in both.items()}


class AtLeast(NamedTuple):
    """Lower bounds of margins that were not measured; nan without a bound."""

    phase_deg: float
    gain_db: float


@dataclass(frozen=True)
class MeasuredLoop:
    """A measured loop; arrays are (n,) over frequencies or (n, axes).

    Attributes:
        device: Device of the drives.
        loop: "velocity" or "position".
        f: Frequencies [Hz].
        open_loop: L; nan if not measured.
        coherence: The lower one of set-point with response and set-point with error, 0...1.
        traced: Frequencies that come from an emulator's trace at the velocity loop's rate; a bus cannot show them.
        gains: Raw gains during the measurement, shape (axes, count).
        fits: The fitted linear model of each axis; None for the position loop.
        peak_speed, peak_current: Peaks of the excitation [rad/s], [A], shape (axes,).
        drive_time: Time that passed on the drives [s].
        notes: Notes on each axis, for users.
        oscillation: Frequency at which an axis oscillates by itself [Hz], 0 if it does not, shape (axes,).
    """

    device: Device
    loop: str
    f: Floats
    open_loop: Complex
    coherence: Floats
    traced: Mask
    gains: Integers
    fits: tuple[PlantFit | None, ...]
    peak_speed: Floats
    peak_current: Floats
    drive_time: float
    notes: tuple[tuple[str, ...], ...]
    oscillation: Floats

    @property
    def trusted(self) -> Mask:
        """Lines that are coherent enough to be trusted, (n, axes)."""
        return np.asarray((self.coherence >= COHERENT) & np.isfinite(self.open_loop))

    @property
    def closed_loop(self) -> Complex:
        """Closed loop, from set-point to response."""
        return np.asarray(self.open_loop / (1.0 + self.open_loop))

    def margins(self, axis: int = 0) -> margins_.Margins:
        """Return the margins of an axis from its trusted lines; nan for those not measured."""
        return seen_margins(*self.refined(axis))

    def refined(self, axis: int = 0) -> tuple[Floats, Complex, Mask]:
        """Return frequencies, open loop, and which of them are trusted, also between the lines.

        If the linear model fits, the measurement's quotient with the model is averaged over neighbours and
        interpolated: it changes slowly, even where a resonance is narrower than the lines' spacing, and then has a
        fraction of a line's noise. Without a fit the lines are returned unchanged.
        """
        fit, L, good = self.fits[axis], self.open_loop[:, axis], self.trusted[:, axis]
        if fit is None or not fit.is_good or good.sum() < 2:
            return self.f, L, good
        lines = np.arange(len(self.f))
        at = np.interp(np.arange(FINE * (len(self.f) - 1) + 1) / FINE, lines, self.f)
        model, fine = (fit.open_loop(self.device, self.gains[axis], x) for x in (self.f, at))
        # The weight of a line is one over its variance, which follows from its coherence.
        clear = np.clip(self.coherence[:, axis], 0.0, 1.0 - 1e-6)
        certain = np.where(np.isfinite(L) & (clear > 0.5), clear / (1.0 - clear), 0.0)
        near = certain * np.exp(-0.5 * ((lines - np.arange(len(at))[:, None] / FINE) / SMOOTHING) ** 2)
        quotient = np.where(certain > 0.0, L / model, 0.0)
        total = near.sum(axis=1)
        # Several neighbours together may be as certain as one trusted line.
        known = total >= COHERENT / (1.0 - COHERENT)
        return at, fine * np.where(known, near @ quotient / np.maximum(total, np.finfo(float).tiny), 1.0), known

    def loops(
        self, gains: Sequence[int] | Integers, axis: int = 0, *, plant: Plant | None = None, refined: bool = True
    ) -> Loops:
        """Return the loops with other gains, from a measured velocity loop: changed as the linear model changes.

        Effects that are not in the model, such as friction or a second resonance, are measured; gains of the outer
        loops change the loop by an exactly known factor, those of the torque loop by the model of the winding.

        Args:
            gains: Raw gains, shape (count,).
            axis: Number of the axis.
            plant: The axis, for other gains of the torque loop; the fitted one by default.
            refined: Include points between the lines, as in `refined`; else only the lines.

        Raises:
            ValueError: For a measured position loop.
        """
        fit = self.fits[axis]
        if fit is None:
            raise ValueError(f"a measured {self.loop} loop does not give the others; measure the velocity loop")
        then, now, known = self.gains[axis], np.asarray(gains), plant or fit.plant
        lines = self.f, self.open_loop[:, axis], self.trusted[:, axis]
        f, L, trusted = self.refined(axis) if refined else lines
        current = self.device.gains.columns_of("current")
        if np.array_equal(then[current], now[current]):
            z = np.exp(2j * math.pi * f / self.device.velocity_rate)
            ratio = controllers(self.device, now).velocity(z) / controllers(self.device, then).velocity(z)
        else:
            ratio = velocity_open_loop(self.device, known, now, f) / velocity_open_loop(self.device, known, then, f)
        velocity = L * ratio
        return Loops(f, velocity, outer_loop(self.device, fit.plant, now, f, velocity), trusted)

    def extended(self, f: Floats, axis: int = 0) -> MeasuredLoop:
        """Return the loop at other frequencies [Hz], (n,): the fitted model times the measured deviation from it."""
        fit = self.fits[axis]
        assert fit is not None and fit.is_good, "a model fits"
        at, L, _ = self.refined(axis)
        off = np.log(L / fit.open_loop(self.device, self.gains[axis], at))
        ends = {"left": off[0], "right": 0.0}
        open_loop = fit.open_loop(self.device, self.gains[axis], f) * np.exp(np.interp(f, at, off, **ends))
        rows = np.ones(self.open_loop.shape[1])
        return replace(
            self, f=f, open_loop=open_loop[:, None] * rows, coherence=np.ones((len(f), len(rows))),
            traced=np.zeros(len(f), bool),
        )  # fmt: skip

    def at_least(self, loop: str, gains: Sequence[int] | Integers, axis: int = 0) -> AtLeast:
        """Return lower bounds of a loop's margins, from models drawn within the fit; nan without a good fit.

        Args:
            loop: "velocity" or "position".
            gains: Raw gains, shape (count,).
            axis: Number of the axis.
        """
        fit = self.fits[axis]
        if fit is None or not fit.is_good or (fit.plant.is_elastic and not fit.estimates["resonance"].is_known):
            return AtLeast(math.nan, math.nan)  # a refused resonance may be the backlash of a gear
        f = np.geomspace(MODEL_LOW, NYQUIST * self.device.velocity_rate, MODEL_POINTS)
        found = []
        for drawn in fit.drawn(np.random.default_rng(DRAWN_SEED), DRAWS):
            L = drawn.open_loop(self.device, np.asarray(gains), f)
            one = margins_.margins(f, L if loop == "velocity" else outer_loop(self.device, drawn.plant, gains, f, L))
            # A loop whose gain never passes 1, or whose phase never reaches -180 degrees, has an infinite margin.
            found.append((180.0 if math.isnan(one.phase_deg) else one.phase_deg, one.gain_db))
        return AtLeast(*(float(value) for value in np.percentile(found, SURE, axis=0, method="lower")))

    def replaced(self, other: MeasuredLoop, where: Mask) -> MeasuredLoop:
        """Replace the measurement of some axes, (axes,), by another one."""
        return replace(
            self,
            open_loop=np.where(where, other.open_loop, self.open_loop),
            coherence=np.where(where, other.coherence, self.coherence),
            gains=np.where(where[:, None], other.gains, self.gains),
            fits=tuple(b if m else a for a, b, m in zip(self.fits, other.fits, where, strict=True)),
            peak_speed=np.where(where, other.peak_speed, self.peak_speed),
            peak_current=np.where(where, other.peak_current, self.peak_current),
            drive_time=self.drive_time + other.drive_time,
            notes=tuple(b if m else a for a, b, m in zip(self.notes, other.notes, where, strict=True)),
            oscillation=np.where(where, other.oscillation, self.oscillation),
        )

    def estimates(self, axis: int = 0) -> dict[str, Estimate]:
        """Return inertia, velocity_filter, loop_delay, anti_resonance, resonance and damping of an axis.

        Each has its interval, or the reason of its refusal.

        Raises:
            ValueError: For a measured position loop, or an axis without a response; its notes say why.
        """
        fit = self.fits[axis]
        if fit is None and self.loop == "velocity":
            raise ValueError(f"there is no response of axis {axis}: {'; '.join(self.notes[axis]) or 'not measured'}")
        if fit is None:
            raise ValueError(f"the {self.loop} loop does not give the axis model; measure the velocity loop")
        return fit.estimates


def seen_margins(f: Floats, open_loop: Complex, trusted: Mask) -> margins_.Margins:
    """Return margins of a loop from its trusted lines, arrays (n,); an infinite gain margin becomes nan.

    If -180 degrees was not reached, that may happen above the measured frequencies.
    """
    found = margins_.margins(f, open_loop, trusted)
    return found if math.isfinite(found.gain_db) else found._replace(gain_db=math.nan)


def merged(results: Sequence[MeasuredLoop]) -> MeasuredLoop:
    """Join measurements of different axes; each axis was measured in one of them."""
    whole = results[0]
    for other in results[1:]:
        whole = whole.replaced(other, np.asarray(np.isfinite(other.open_loop).any(axis=0) | (other.oscillation > 0.0)))
    return whole
