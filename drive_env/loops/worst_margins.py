"""Margins of machines as sampled by their drives' loops: the worst outer loop of each."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drive_env.loops.margins import margins
from drive_env.loops.sampled import STILL, CascadeGains, LinearMachines, LoopRates, closed_loops, open_loops, window
from mechanics.arrays import Floats

UNSTABLE_MS = 100.0  # Ms of unstable loops, and its upper limit
LOWEST, HIGHEST, POINTS = 0.02, 0.49, 4000  # frequencies: from [Hz], up to of the velocity loop's rate, how many


class WorstMargins(NamedTuple):
    """Phase margin [degrees], gain margin [dB] and Ms of each machine's outer loops, the worst of each, (machines,).

    For a stable machine the phase margin is the least distance from -180 degrees to either side; for an unstable one
    the values are 0, 0 and 100. The gain margin is that for a rising gain only.
    """

    phase_deg: Floats
    gain_db: Floats
    ms: Floats


def worst_margins(rates: LoopRates, machines: LinearMachines, gains: CascadeGains) -> WorstMargins:
    """Return the margins of machines; for several axes the worst axis, with the others' loops closed."""
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
