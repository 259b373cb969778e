"""Dynamics: the margins that outer loops must keep, by name or as numbers, and the loops' distance from them.

The three margins of an open loop are one region around -1 that it must not enter: |L| = 1 within the phase margin, real
L within the gain margin to either side, and the circle of radius 1/Ms. Its *clearance* is the factor by which the
region could grow until the open loop enters it: 1 if a margin is just kept, 0 at -1, and below 0 if the closed loop is
unstable. It changes continuously with the gains, unlike a phase margin when a resonance begins to cross over.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drive_env.loops.sampled import STILL, ClosedLoops, closed_loops, open_loops, step_overshoot, window
from mechanics.arrays import Complex, Floats
from mechanics.reading.untrusted import read_toml

if TYPE_CHECKING:
    from drive_env.loops.sampled import CascadeGains, LinearMachines, LoopRates


DEFAULT = "standard"
# Demand on a machine that differs from its tuning (load inertia at both ends of its range, stiffness x 0.8, velocity P
# x 1.5 and x 0.67): a region smaller by this factor. 45 degrees, 8 dB and Ms 2 become 18 degrees, 3.2 dB and Ms 5.
OFF_NOMINAL = 0.4
INERTIA_RANGE = (0.5, 2.0)  # of the load, over that of the tuning
WIDEST_RANGE = (0.2, 5.0)
LOWEST, HIGHEST, POINTS = 1.0, 0.49, 240  # frequencies: lowest [Hz], highest over the velocity loop's rate, number
REGION_POINTS = 181  # of the edge of a region
NEAR = np.linspace(-3.0, 3.0, 9)  # around a resonance of the closed loops, in half widths
UNSTABLE = 100.0  # 1/s: a motion that grows at this rate has a clearance of -1


@dataclass(frozen=True)
class Dynamics:
    """Margins that loops must keep.

    Attributes:
        name: "soft", "standard", "stiff", or the numbers.
        phase_deg: Phase margin [degrees].
        gain_db: Gain margin, up and down [dB].
        ms: Greatest sensitivity |1 / (1 + L)|.
        overshoot: Overshoot of a step of the set-point in csp, over the step.
        inertia_range: Least and greatest load inertia, over that of the tuning, at which loops must keep a region
            smaller by `OFF_NOMINAL`.
    """

    name: str
    phase_deg: float
    gain_db: float
    ms: float
    overshoot: float
    inertia_range: tuple[float, float] = INERTIA_RANGE

    def clearance(self, open_loop: Complex) -> Floats:
        """Return the factor by which the region around -1 could grow, for stable loops.

        Args:
            open_loop: L at increasing frequencies, dense enough for every resonance, (..., n).
        """
        gain, phase, each = self._distance(open_loop)
        least = each.min(axis=-1)
        turned = np.abs(np.diff(phase)) < 180.0 / self.phase_deg  # otherwise it wraps at 0 degrees
        for value, other, where in ((gain, phase, True), (phase, gain, turned)):
            first, second = value[..., :-1], value[..., 1:]
            crosses = (first * second <= 0.0) & (first != second) & where
            share = first / np.where(crosses, first - second, 1.0)
            # The other coordinate there; a phase that wraps within the step is nearly 180 degrees.
            there = np.abs(other[..., :-1] + share * np.diff(other))
            there = np.where(crosses & (turned | (value is phase)), there, np.inf)
            least = np.minimum(least, there.min(axis=-1))
        return np.asarray(least)

    def _distance(self, L: Complex) -> tuple[Floats, Floats, Floats]:
        """Return gain and phase from -1, each over its margin, and the size of the region whose edge passes there."""
        with np.errstate(divide="ignore", invalid="ignore"):
            gain = 20.0 / math.log(10.0) * np.log(np.abs(L)) / self.gain_db
            phase = np.degrees(np.angle(-L)) / self.phase_deg
        # Between the ends of both margins the circle lies farther out, but for slivers along |L| = 1 and the real axis:
        # this closes the region.
        corner = (np.sqrt(np.abs(phase)) + np.sqrt(np.abs(gain))) ** 2
        return gain, phase, np.minimum(corner, self.ms * np.abs(1.0 + L))

    def region(self) -> tuple[Floats, Floats]:
        """Return the edge of the region around -1: phase [degrees] from -180 and gain [dB], (n,) each."""
        around = np.linspace(0.0, 2.0 * math.pi, REGION_POINTS)
        phase, gain = np.cos(around) * self.phase_deg, np.sin(around) * self.gain_db
        inside, outside = np.zeros(REGION_POINTS), np.full(REGION_POINTS, 3.0)
        for _ in range(40):
            middle = 0.5 * (inside + outside)
            L = -(10.0 ** (middle * gain / 20.0)) * np.exp(1j * np.radians(middle * phase))
            within = self._distance(L)[2] < 1.0
            inside, outside = np.where(within, middle, inside), np.where(within, outside, middle)
        return inside * phase, inside * gain

    def slack(self, nominal: Floats, variants: Floats, overshoot: Floats) -> Floats:
        """Return the relative distance of machines from violating a constraint: 0 if one is just kept, (machines,).

        Args:
            nominal: Clearance of the present loops, (machines,).
            variants: Clearance with changed inertia, stiffness and velocity P, (machines, variants).
            overshoot: Overshoot of a csp step, over the step, (machines,).
        """
        # At the stability limit the step overshoots by nearly all of it.
        least = np.minimum(nominal - 1.0, 1.0 - np.minimum(overshoot, 1.0) / self.overshoot)
        return np.asarray(np.minimum(least, (variants / OFF_NOMINAL - 1.0).min(axis=-1, initial=np.inf)))


@cache
def known_dynamics() -> dict[str, Dynamics]:
    """Return the dynamics by name, in the order of their table."""
    table = read_toml(Path(__file__).with_suffix(".toml"))
    return {
        name: Dynamics(name, float(row["phase_deg"]), float(row["gain_db"]), float(row["ms"]), float(row["overshoot"]))
        for name, row in table.items()
    }


def find_dynamics(text: str | Dynamics, inertia_range: str | tuple[float, float] | None = None) -> Dynamics:
    """Return dynamics by name, or by numbers: "45/8/2.0" is a phase margin in degrees, a gain margin in dB and Ms.

    The allowed overshoot of a csp step is then interpolated over Ms between the named ones.

    Args:
        text: Name or numbers.
        inertia_range: Least and greatest load inertia over that of the tuning, e.g. "0.5/2"; that of `text` by default.

    Raises:
        ValueError: For another name, numbers that no loop can keep, or a range without the present load.
    """
    found = text if isinstance(text, Dynamics) else _by_text(text)
    return found if inertia_range is None else replace(found, inertia_range=_range(inertia_range))


def _range(given: str | tuple[float, float]) -> tuple[float, float]:
    asked = (
        f"inertia range {given!r}: give the least and the greatest load inertia over the one it is tuned with, as 0.5/2"
    )
    try:
        low, high = (float(part) for part in (given.split("/") if isinstance(given, str) else given))
    except (TypeError, ValueError):
        raise ValueError(asked) from None
    if not WIDEST_RANGE[0] <= low <= 1.0 <= high <= WIDEST_RANGE[1]:
        raise ValueError(
            f"{asked}; the least lies between {WIDEST_RANGE[0]:g} and 1, the greatest between 1 and {WIDEST_RANGE[1]:g}"
        )
    return low, high


def _by_text(text: str) -> Dynamics:
    known = known_dynamics()
    if text in known:
        return known[text]
    asked = f"dynamics {text!r}: give {', '.join(known)}, or phase margin/gain margin/Ms as 45/8/2.0"
    try:
        phase, gain, ms = (float(part) for part in text.split("/"))
    except ValueError:
        raise ValueError(asked) from None
    if not (0.0 < phase < 90.0 and 0.0 < gain < 40.0 and 1.0 < ms < 10.0):
        raise ValueError(f"{asked}; a phase margin lies between 0 and 90 degrees, a gain margin between 0 and 40 dB, "
                         "and Ms between 1 and 10")  # fmt: skip
    rows = sorted(known.values(), key=lambda one: one.ms)
    overshoot = float(np.interp(ms, [one.ms for one in rows], [one.overshoot for one in rows]))
    return Dynamics(text, phase, gain, ms, overshoot)


def loop_clearance(
    dynamics: Dynamics, rates: LoopRates, machines: LinearMachines, gains: CascadeGains, variants: int = 1
) -> tuple[Floats, Floats]:
    """Return the least clearance of machines' outer loops, and the overshoot of csp steps.

    Args:
        dynamics: The margins to keep.
        rates: The drive's rates.
        machines: The machines.
        gains: Their gains.
        variants: Number of consecutive machines that are variants of one machine, itself first; its step is that of the
            first.

    Returns:
        Clearance, -1 to 0 if a machine is unstable, (machines,), and the largest overshoot over the step,
        (machines / variants,).
    """
    one = window(rates, machines, gains)
    closed = closed_loops(rates, machines, gains, one)
    poles = np.linalg.eigvals(closed.A)
    growth = np.log(np.maximum(np.abs(poles).max(axis=-1), 1e-300))
    highest = HIGHEST * rates.velocity_rate
    base = np.broadcast_to(np.geomspace(LOWEST, highest, POINTS), (len(poles), POINTS))
    turn = np.abs(np.angle(poles)) * rates.velocity_rate / (2.0 * math.pi)
    width = np.abs(np.log(np.maximum(np.abs(poles), 1e-3))) * rates.velocity_rate / (2.0 * math.pi)
    near = (turn[..., None] + width[..., None] * NEAR).reshape(len(poles), -1)
    f = np.sort(np.concatenate([base, np.clip(near, LOWEST, highest)], axis=1), axis=1)
    loops = open_loops(rates, machines, gains, f, one)
    least = np.minimum(dynamics.clearance(loops.velocity), dynamics.clearance(loops.position)).min(axis=-1)
    unstable = np.clip(-growth * rates.velocity_rate / UNSTABLE, -1.0, 0.0)
    found = np.where(growth > STILL, unstable, least)
    as_is = ClosedLoops(*(part[::variants] for part in closed))
    overshoot = step_overshoot(rates, as_is, growth=growth[::variants]).max(axis=-1)
    return np.nan_to_num(found, nan=-1.0), overshoot
