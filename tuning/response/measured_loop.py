"""A measured loop: its lines, which of them are trusted, and the values between them."""

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


COHERENT = 0.95  # from which on a line is trusted
FINE = 10  # points between two lines, where margins are looked for
SMOOTHING = 1.5  # lines, standard deviation
DRAWS, DRAWN_SEED, SURE = 100, 20, 2.5  # plants within a fit's intervals, and the percentile that is "at least"
MODEL_POINTS, MODEL_LOW, NYQUIST = 400, 2.0, 0.49  # frequencies of a model: how many, from [Hz], up to of its rate


class Loops(NamedTuple):
    """Both outer loops of an axis by one measurement: frequencies [Hz], complex open loops, trusted lines.

    All of shape (n,). The position loop is that of the measured velocity loop, closed, and of the position P.
    """

    f: Floats
    velocity: Complex
    position: Complex
    trusted: Mask

    def margins(self) -> dict[str, margins_.Margins]:
        """Return the margins of both by name, by their trusted lines; nan for those that they do not show."""
        both = {"velocity": self.velocity, "position": self.position}
        return {name: seen_margins(self.f, L, self.trusted) for name, L in both.items()}


class AtLeast(NamedTuple):
    """Lower bounds of margins that were not measured; nan without a bound."""

    phase_deg: float
    gain_db: float


@dataclass(frozen=True)
class MeasuredLoop:
    """A loop as measured; arrays are (n,) over frequencies or (n, axes).

    Attributes:
        device: What was measured.
        loop: "velocity" or "position".
        f: Frequencies [Hz].
        open_loop: L; nan where nothing was measured.
        coherence: Of set-point with answer and with error, the lower of the two, 0...1.
        traced: Which frequencies come from an emulator's trace at the velocity loop's rate; no bus shows them.
        gains: Raw gains in force, shape (axes, count).
        fits: The fitted linear model of each axis; None for the position loop.
        peak_speed, peak_current: Of the shaking [rad/s], [A], shape (axes,).
        drive_time: Time that passed on the drives [s].
        notes: Of each axis, for people.
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

    @property
    def trusted(self) -> Mask:
        """Which lines are coherent enough to be taken as truth, (n, axes)."""
        return np.asarray((self.coherence >= COHERENT) & np.isfinite(self.open_loop))

    @property
    def closed_loop(self) -> Complex:
        """From set-point to answer."""
        return np.asarray(self.open_loop / (1.0 + self.open_loop))

    def margins(self, axis: int = 0) -> margins_.Margins:
        """Return the margins of an axis, by its trusted lines; nan for those that they do not show."""
        return seen_margins(*self.refined(axis))

    def refined(self, axis: int = 0) -> tuple[Floats, Complex, Mask]:
        """Return frequencies, open loop, and which of them are trusted, between the lines too.

        Where the linear model fits, what is measured is its quotient with the model, which changes slowly, also where
        a resonance is narrower than the lines' distance: averaged over neighbours and interpolated, it has a fraction
        of a line's noise. Without a fit the lines stand as they are.
        """
        fit, L, good = self.fits[axis], self.open_loop[:, axis], self.trusted[:, axis]
        if fit is None or not fit.is_good or good.sum() < 2:
            return self.f, L, good
        lines = np.arange(len(self.f))
        at = np.interp(np.arange(FINE * (len(self.f) - 1) + 1) / FINE, lines, self.f)
        model, fine = (fit.open_loop(self.device, self.gains[axis], x) for x in (self.f, at))
        # A line says as much as its coherence: its weight is one over its variance.
        clear = np.clip(self.coherence[:, axis], 0.0, 1.0 - 1e-6)
        certain = np.where(np.isfinite(L) & (clear > 0.5), clear / (1.0 - clear), 0.0)
        near = certain * np.exp(-0.5 * ((lines - np.arange(len(at))[:, None] / FINE) / SMOOTHING) ** 2)
        quotient = np.where(certain > 0.0, L / model, 0.0)
        total = near.sum(axis=1)
        # Neighbours together may be as certain as one line must be.
        known = total >= COHERENT / (1.0 - COHERENT)
        return at, fine * np.where(known, near @ quotient / np.maximum(total, np.finfo(float).tiny), 1.0), known

    def loops(
        self, gains: Sequence[int] | Integers, axis: int = 0, *, plant: Plant | None = None, refined: bool = True
    ) -> Loops:
        """Return the loops with other gains from a measured velocity loop: changed as those change the linear model.

        What is not in the model, as friction or a second resonance, was measured; gains of the outer loops change it by
        a factor that is known exactly, those of the torque loop by what the winding makes of them.

        Args:
            gains: Raw gains, shape (count,).
            axis: Number of the axis.
            plant: The axis, for other gains of the torque loop; what was fitted by default.
            refined: Between the lines too, as `refined` has them; else the lines as they are.

        Raises:
            ValueError: For the response of a position loop.
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
        """Return the loop at other frequencies [Hz], (n,), by the fitted model and by what an axis measured over it."""
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
        """Return lower bounds of a loop's margins, by the fitted model, everything within its intervals.

        Args:
            loop: "velocity" or "position".
            gains: Raw gains, shape (count,).
            axis: Number of the axis.
        """
        fit = self.fits[axis]
        if fit is None or not fit.is_good or (fit.plant.is_elastic and not fit.estimates["resonance"].is_known):
            return AtLeast(math.nan, math.nan)  # what was refused as a resonance may be the play of a gear
        f = np.geomspace(MODEL_LOW, NYQUIST * self.device.velocity_rate, MODEL_POINTS)
        found = []
        for drawn in fit.drawn(np.random.default_rng(DRAWN_SEED), DRAWS):
            L = drawn.open_loop(self.device, np.asarray(gains), f)
            one = margins_.margins(f, L if loop == "velocity" else outer_loop(self.device, drawn.plant, gains, f, L))
            # A loop whose gain never passes 1, or whose phase never reaches -180 degrees, has all the margin there is.
            found.append((180.0 if math.isnan(one.phase_deg) else one.phase_deg, one.gain_db))
        return AtLeast(*(float(value) for value in np.percentile(found, SURE, axis=0, method="lower")))

    def replaced(self, other: MeasuredLoop, where: Mask) -> MeasuredLoop:
        """Return this with another measurement of some axes, (axes,), in place of theirs."""
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
        )

    def estimates(self, axis: int = 0) -> dict[str, Estimate]:
        """Return inertia, velocity_filter, loop_delay, anti_resonance, resonance and damping of an axis.

        Each has its interval, or the reason why it is refused.

        Raises:
            ValueError: For the response of a position loop, or of an axis without one; its notes say why.
        """
        fit = self.fits[axis]
        if fit is None and self.loop == "velocity":
            raise ValueError(f"there is no response of axis {axis}: {'; '.join(self.notes[axis]) or 'not measured'}")
        if fit is None:
            raise ValueError(f"the {self.loop} loop does not give the axis model; measure the velocity loop")
        return fit.estimates


def seen_margins(f: Floats, open_loop: Complex, trusted: Mask) -> margins_.Margins:
    """Return margins of a loop by its trusted lines, arrays (n,), without a gain margin that was not measured.

    A phase of -180 degrees that was not reached may lie above the frequencies looked at.
    """
    found = margins_.margins(f, open_loop, trusted)
    return found if math.isfinite(found.gain_db) else found._replace(gain_db=math.nan)


def merged(results: Sequence[MeasuredLoop]) -> MeasuredLoop:
    """Return measurements of different axes as one; each axis was in one of them."""
    whole = results[0]
    for other in results[1:]:
        whole = whole.replaced(other, np.asarray(np.isfinite(other.open_loop).any(axis=0)))
    return whole
