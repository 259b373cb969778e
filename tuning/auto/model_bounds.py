"""Lower bounds of margins that were not measured: the worst corner of what was identified of an axis."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from drive_env.loops.linear_model import outer_loop, velocity_open_loop
from drive_env.loops.margins import margins
from tuning.response.measured_loop import GOOD_MISFIT, MODEL_LOW, MODEL_POINTS, NYQUIST, AtLeast

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.devices.gains import RawGains
    from drive_env.loops.linear_model import Plant
    from tuning.identify.identified_axis import Identification

# Estimates whose intervals have corners, and what a plant calls them; the first two go up and down together, since
# they change the outer loops by little.
WINDING = {"resistance": "R", "inductance": "L"}
MECHANICS = {
    "inertia": "inertia", "velocity_filter": "velocity_filter", "loop_delay": "delay",
    "anti_resonance": "anti_resonance", "resonance": "resonance", "damping": "damping",
}  # fmt: skip
LEAST = 0.1  # of a value, where its interval reaches down to nothing


def why_unbounded(identified: Identification) -> str:
    """Return why the model of an identified axis gives no bound of its margins, "" if it does."""
    fit = identified.fit
    if fit is None or fit.reason:
        return f"its frequency response was not identified: {identified.estimates['resonance'].reason}"
    if fit.misfit > GOOD_MISFIT:
        return f"the linear model does not fit the axis: the error is {fit.misfit:.1f} times the noise"
    pair = [fit.estimates[name] for name in ("anti_resonance", "resonance")]
    # Twins make do with a guess.
    if fit.plant.is_elastic and not all(one.is_known for one in pair):
        # Both are refused by the same look at the response, mostly for the same reason.
        reasons = dict.fromkeys(one.reason for one in pair if one.reason)
        return f"its resonance is not known for certain: {'; '.join(reasons)}"
    return ""


def at_least_by_model(device: Device, plant: Plant, identified: Identification, gains: RawGains) -> dict[str, AtLeast]:
    """Return what the margins of both outer loops are at least, by the linear model at all corners of the intervals.

    Args:
        device: The drive.
        plant: The identified axis.
        identified: Its intervals; `why_unbounded` must have nothing against them.
        gains: Raw gains, shape (count,).

    Returns:
        By loop, "velocity" and "position"; nan where the loop is unstable at a corner, or a P gain is 0.
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
            # A loop whose gain never passes 1 has all the phase there is.
            found[loop].append((180.0 if math.isnan(one.phase_deg) else one.phase_deg, one.gain_db))
    least = {loop: AtLeast(*map(float, np.min(rows, axis=0))) for loop, rows in found.items()}
    return {loop: one if min(one) > 0.0 else nothing for loop, one in least.items()}


def _corners(plant: Plant, identified: Identification) -> Iterator[Plant]:
    """Yield an axis at all corners of its intervals; what was not identified stays as it is."""

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
