"""Lower bounds of margins that were not measured: the worst corner of the identified intervals of an axis."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from drive_env.loops.linear_model import outer_loop, velocity_open_loop
from drive_env.loops.margins import margins
from tuning.response.measured_loop import MODEL_LOW, MODEL_POINTS, NYQUIST, AtLeast

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.devices.gains import RawGains
    from drive_env.loops.linear_model import Plant
    from tuning.identify.identified_axis import Identification

# Estimates whose intervals are varied, and their fields in a plant; the first two are varied together, since they
# change the outer loops only a little.
WINDING = {"resistance": "R", "inductance": "L"}
MECHANICS = {
    "inertia": "inertia", "velocity_filter": "velocity_filter", "loop_delay": "delay",
    "anti_resonance": "anti_resonance", "resonance": "resonance", "damping": "damping",
}  # fmt: skip
LEAST = 0.1  # of a value, as lower end of an interval that reaches to 0


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
