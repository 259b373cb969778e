"""The margins of machines as their drives' loops sample them: of each the worst outer loop."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drive_env.loops.margins import margins
from drive_env.loops.sampled import STILL, CascadeGains, LinearMachines, LoopRates, closed_loops, open_loops, window
from mechanics.arrays import Floats

UNSTABLE_MS = 100.0  # Ms of unstable loops, and the greatest there is
LOWEST, HIGHEST, POINTS = 0.02, 0.49, 4000  # frequencies: from [Hz], up to of the velocity loop's rate, how many


class WorstMargins(NamedTuple):
    """Phase margin [degrees], gain margin [dB] and Ms of each machine's outer loops, the worst of each, (machines,).

    Of a stable machine the phase is the least distance from -180 degrees, to either side; of an unstable one they are
    0, 0 and 100. Gain is how far it may rise; how far it may fall is not among them.
    """

    phase_deg: Floats
    gain_db: Floats
    ms: Floats


def worst_margins(rates: LoopRates, machines: LinearMachines, gains: CascadeGains) -> WorstMargins:
    """Return the margins of machines; of one with several axes the worst of all axes, the others' loops closed."""
    one = window(rates, machines, gains)
    f = np.geomspace(LOWEST, HIGHEST * rates.velocity_rate, POINTS)
    loops = open_loops(rates, machines, gains, np.tile(f, (len(machines.A), 1)), one)
    rows = []
    for velocity, position, growth in zip(*loops, closed_loops(rates, machines, gains, one).growth, strict=True):
        found = [margins(f, loop) for loop in (*velocity, *position)]
        ms = min(max(each.ms for each in found), UNSTABLE_MS)
        worst = np.fmin.reduce([abs(each.phase_deg) for each in found]), min(each.gain_db for each in found), ms
        rows.append(worst if growth <= STILL else (0.0, 0.0, UNSTABLE_MS))
    return WorstMargins(*np.array(rows, float).T)
