"""Margins of an axis with any gains, and slack to the dynamics: from its measured velocity loop, or their lower bounds.

Bounds replace margins that were not measured: the worst corner of the identified intervals of the axis.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from drive_env.loops.dynamics import OFF_NOMINAL
from drive_env.loops.linear_model import (
    controllers,
    outer_loop,
    velocity_filter_response,
    velocity_open_loop,
    velocity_plant,
)
from drive_env.loops.margins import is_as_stable, margins
from drive_env.trials.score import VARIANTS
from mechanics.arrays import Complex, Floats, Integers
from tuning.response.measured_loop import MODEL_LOW, MODEL_POINTS, NYQUIST, AtLeast, seen_margins

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.devices.gains import RawGains
    from drive_env.loops.dynamics import Dynamics
    from drive_env.loops.linear_model import Plant
    from drive_env.loops.margins import Margins
    from tuning.identify.identified_axis import Identification
    from tuning.response.measured_loop import MeasuredLoop

# Estimates whose intervals are varied, and their fields in a plant; the first two are varied together, since they
# change the outer loops only a little.
WINDING = {"resistance": "R", "inductance": "L"}
MECHANICS = {
    "inertia": "inertia", "velocity_filter": "velocity_filter", "loop_delay": "delay",
    "anti_resonance": "anti_resonance", "resonance": "resonance", "damping": "damping",
}  # fmt: skip
LEAST = 0.1  # of a value, as lower end of an interval that reaches to 0
AT_ONCE = 64  # sets of gains whose loops are computed at once
LOOPS = "velocity", "position"  # the judged loops
# Factors of velocity P that the loops must tolerate.
FACTORS = {variant.velocity_p: variant.name for variant in VARIANTS if variant.velocity_p != 1.0}


class MeasuredAxis:
    """The outer loops of an axis with any gains: the measured loop times the change of the linear model.

    Args:
        response: The measured velocity loop.
        axis: Number of the axis.
        plant: The identified axis, for other gains of the torque loop.
    """

    def __init__(self, response: MeasuredLoop, axis: int, plant: Plant) -> None:
        fit = response.fits[axis]
        self._device = response.device
        self._plant = plant if fit is None or fit.reason else fit.plant
        f, L, trusted = response.refined(axis)
        # Between the lines, and where they are incoherent, the fitted model is used if it fits.
        seen = np.isfinite(L) & (trusted | (fit is not None and fit.is_good))
        self._f, self._measured, self._trusted = f[seen], L[seen], trusted[seen]
        self._gains = response.gains[axis]
        self._z = np.exp(2j * math.pi * self._f / self._device.velocity_rate)
        self._angle = velocity_filter_response(self._device, self._plant, self._f) * (
            self._device.velocity_rate * (1.0 - 1.0 / self._z)
        )

    def open_loops(self, gains: Integers) -> dict[str, Complex]:
        """Return the open loops for raw gains, (sets, count), by name: (sets, n) each."""
        now = [controllers(self._device, row) for row in gains]
        regulators = np.array([one.velocity(self._z) for one in now])
        inner = np.array([velocity_plant(self._device, self._plant, row, self._f) for row in gains])
        then = controllers(self._device, self._gains).velocity(self._z)
        before = velocity_plant(self._device, self._plant, self._gains, self._f)
        velocity = self._measured * regulators * inner / (then * before)
        outer = np.array([one.position for one in now])[:, None]
        return {"velocity": velocity, "position": outer * velocity / (1.0 + velocity) / self._angle}

    def margins(self, gains: Integers) -> dict[str, Margins]:
        """Return the margins of the judged loops with gains, (count,)."""
        loops = self.open_loops(gains[None])
        return {loop: seen_margins(self._f, loops[loop][0], self._trusted) for loop in LOOPS}

    def slack(self, dynamics: Dynamics, gains: Integers) -> Floats:
        """Return the relative slack of the judged loops to the dynamics, (sets,), with variants of velocity P.

        Args:
            dynamics: Requirements on the loops.
            gains: Raw, (sets, count).
        """
        parts = [gains[first : first + AT_ONCE] for first in range(0, len(gains), AT_ONCE)]
        return np.concatenate([self._slack(dynamics, part) for part in parts])

    def kept(self, dynamics: Dynamics, gains: Integers) -> dict[str, float]:
        """Return the kept share of the dynamics with other velocity P, by the name of the variant.

        Args:
            dynamics: The dynamics that count as 1.
            gains: Raw, (count,).
        """
        other = self._device.gains.with_velocity_p(np.tile(gains, (len(FACTORS), 1)), np.array(list(FACTORS)))
        return {
            name: max(float(kept), 0.0)
            for name, kept in zip(FACTORS.values(), self._clearance(dynamics, other), strict=True)
        }

    def _slack(self, dynamics: Dynamics, gains: Integers) -> Floats:
        known = self._device.gains
        least = self._clearance(dynamics, gains) - 1.0
        for factor in FACTORS:
            other = known.with_velocity_p(gains, np.full(len(gains), factor))
            least = np.minimum(least, self._clearance(dynamics, other) / OFF_NOMINAL - 1.0)
        return np.asarray(least)

    def _clearance(self, dynamics: Dynamics, gains: Integers) -> Floats:
        """Return the least clearance of the judged loops, (sets,); below 0 if a loop would be unstable."""
        before, now = self.open_loops(self._gains[None]), self.open_loops(gains)
        least = np.full(len(gains), np.inf)
        for loop in LOOPS:
            stable = is_as_stable(before[loop], now[loop])  # the measured loop was stable with its gains
            clearance = dynamics.clearance(now[loop])
            least = np.minimum(least, np.where(stable, clearance, -np.minimum(clearance, 1.0)))
        return least


def why_unbounded(identified: Identification) -> str:
    """Return why the model of an identified axis gives no bound of its margins; "" if it gives one."""
    fit = identified.fit
    if fit is None or fit.reason:
        return f"its frequency response was not identified: {identified.estimates['resonance'].reason}"
    if not fit.is_good:
        return f"the linear model does not fit the axis: the error is {fit.misfit:.1f} times the noise"
    pair = [fit.estimates[name] for name in ("anti_resonance", "resonance")]
    # Twins work with an assumed value, bounds need an identified one.
    if fit.plant.is_elastic and not all(one.is_known for one in pair):
        # Both are refused by the same check of the response, mostly for the same reason.
        reasons = dict.fromkeys(one.reason for one in pair if one.reason)
        return f"its resonance is not known for certain: {'; '.join(reasons)}"
    return ""


def at_least_by_model(device: Device, plant: Plant, identified: Identification, gains: RawGains) -> dict[str, AtLeast]:
    """Return lower bounds of both outer loops' margins, by the linear model at all corners of the intervals.

    Args:
        device: The drive.
        plant: The identified axis.
        identified: Its identification; `why_unbounded` must return "".
        gains: Raw gains, shape (count,).

    Returns:
        Bounds by loop, "velocity" and "position"; nan if the loop is unstable at a corner, or a P gain is 0.
    """
    nothing = AtLeast(math.nan, math.nan)
    if device.gains.opens(gains, "current", "velocity", "position"):
        return {"velocity": nothing, "position": nothing}
    assert identified.fit is not None, "what is bounded has one"
    second = identified.fit.second
    f = np.geomspace(MODEL_LOW, NYQUIST * device.velocity_rate, MODEL_POINTS)
    found: dict[str, list[tuple[float, float]]] = {"velocity": [], "position": []}
    for corner in (plant, *_corners(plant, identified)):
        velocity = velocity_open_loop(device, corner, gains, f)
        velocity = velocity if second is None else velocity * second.response(f)
        for loop, L in (("velocity", velocity), ("position", outer_loop(device, corner, gains, f, velocity))):
            one = margins(f, L)
            # A loop whose gain never reaches 1 has an infinite phase margin; 180 degrees stand for it.
            found[loop].append((180.0 if math.isnan(one.phase_deg) else one.phase_deg, one.gain_db))
    least = {loop: AtLeast(*map(float, np.min(rows, axis=0))) for loop, rows in found.items()}
    return {loop: one if min(one) > 0.0 else nothing for loop, one in least.items()}


def _corners(plant: Plant, identified: Identification) -> Iterator[Plant]:
    """Yield the axis at all corners of its intervals; values that were not identified are not varied."""

    def ends(names: Mapping[str, str]) -> dict[str, tuple[float, float]]:
        told = {field: identified.estimates.get(name) for name, field in names.items()}
        known = [(field, one) for field, one in told.items() if one is not None and one.is_known]
        return {field: (max(one.low, LEAST * one.value), one.high) for field, one in known}

    winding, mechanics = ends(WINDING), ends(MECHANICS)
    for side in (0, 1):
        coils: dict[str, Any] = {field: both[side] for field, both in winding.items()}
        for chosen in product(*mechanics.values()):
            values = coils | dict(zip(mechanics, chosen, strict=True))
            if values.get("anti_resonance", 0.0) < values.get("resonance", math.inf):
                yield replace(plant, **values)
