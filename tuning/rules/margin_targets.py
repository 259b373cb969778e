"""Margin targets: the greatest integers with which every loop keeps a phase and a gain margin.

The pairs are those of a manufacturer's tuning tool, Kollmorgen's Performance Servo Tuner: 45 degrees and 8 dB, and
softer 55/12, 60/20 and 65/35. Integers are searched on the sampled model (linear_model.py), so that the margins include
delay, filter, resonance and rounding.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from drive_env.loops.linear_model import controllers, current_open_loop, mean_velocity, velocity_plant
from drive_env.loops.margins import Margins, margins
from mechanics.arrays import Complex
from tuning.rules.proposal import Proposal, Rule, Workbench

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.devices.gains import Part
    from drive_env.loops.linear_model import Plant
    from drive_env.motors import Motor


TARGETS = {"margin_45": (45.0, 8.0), "margin_55": (55.0, 12.0), "margin_60": (60.0, 20.0), "margin_65": (65.0, 35.0)}

POINTS = 1200  # number of frequencies: half a percent apart, so that no weakly damped resonance is missed
INTEGRATION = 4.0  # T_i times the velocity loop's crossover: the integral part costs 14 degrees
CURRENT_P, CURRENT_I = ("current", "P"), ("current", "I")
VELOCITY_P, VELOCITY_I, POSITION_P = ("velocity", "P"), ("velocity", "I"), ("position", "P")
STEP = 1.06  # ratio of successive trial values of a gain, until the first that fails


def margin_rule(phase_deg: float, gain_db: float) -> Rule:
    """Return the rule that keeps these margins in every loop."""

    def rule(device: Device, motor: Motor, plant: Plant) -> Proposal:
        return propose(device, plant, phase_deg, gain_db)

    return rule


def propose(device: Device, plant: Plant, phase_deg: float, gain_db: float) -> Proposal:
    """Return the greatest integers with which current, velocity and position loop each keep the margins.

    Args:
        device: The drive.
        plant: The axis.
        phase_deg: Phase margin to keep [degrees].
        gain_db: Gain margin to keep [dB].
    """
    bench = Workbench(device, plant)

    def enough(found: Margins) -> bool:
        # A loop whose gain is below 1 at all frequencies has an infinite phase margin.
        phase = math.inf if math.isnan(found.phase_deg) else found.phase_deg
        return phase >= phase_deg and found.gain_db >= gain_db

    f = np.geomspace(2.0, 0.49 * device.current_rate, POINTS)
    torque_i = bench.integer(CURRENT_I, plant.R / plant.L)
    unit = current_open_loop(device, plant, bench.so_far({CURRENT_I: torque_i}), f)
    torque_p = _greatest(bench, CURRENT_P, lambda p: margins(f, p * unit), enough, phase_deg, gain_db)
    bench.raw(CURRENT_P, torque_p)
    bench.raw(CURRENT_I, torque_i)

    f = np.geomspace(0.2, 0.49 * device.velocity_rate, POINTS)
    z = np.exp(2j * math.pi * f / device.velocity_rate)
    inner = velocity_plant(device, plant, bench.so_far(), f)
    slope = plant.torque_constant / plant.inertia

    def velocity(p: int) -> Complex:
        raw = bench.so_far({VELOCITY_P: p, VELOCITY_I: _integral(bench, p, slope)})
        return np.asarray(controllers(device, raw).velocity(z) * inner)

    velocity_p = _greatest(bench, VELOCITY_P, lambda p: margins(f, velocity(p)), enough, phase_deg, gain_db)
    bench.raw(VELOCITY_P, velocity_p)
    bench.raw(VELOCITY_I, _integral(bench, velocity_p, slope))

    raw = bench.so_far()
    angle = mean_velocity(device, plant, raw, f) / device.velocity_rate / (1.0 - 1.0 / z)
    regulator = controllers(device, raw)
    unit = regulator.position * regulator.velocity(z) * angle / (1.0 + velocity(velocity_p))
    position_p = _greatest(bench, POSITION_P, lambda p: margins(f, p * unit), enough, phase_deg, gain_db)
    bench.raw(POSITION_P, position_p)
    return bench.proposal()


def _integral(bench: Workbench, velocity_p: int, slope: float) -> int:
    crossover = bench.si(VELOCITY_P, velocity_p) * slope
    return bench.integer(VELOCITY_I, crossover / INTEGRATION)


def _greatest(
    bench: Workbench,
    part: Part,
    margins_of: Callable[[int], Margins],
    enough: Callable[[Margins], bool],
    phase_deg: float,
    gain_db: float,
) -> int:
    """Return the greatest integer below the first that fails the margins; 1, with a note, if 1 already fails."""
    _, title, _, highest, *_ = bench.row(part)
    last, trial = 0, 1
    while trial <= highest and enough(margins_of(trial)):
        last = trial
        trial = max(trial + 1, math.ceil(trial * STEP)) if trial < highest else highest + 1
        trial = highest if last < highest < trial else trial
    if last == 0:
        found = margins_of(1)
        bench.note(
            f"{title}: no integer keeps {phase_deg:g} degrees and {gain_db:g} dB: 1, the least, has "
            f"{found.phase_deg:.0f} degrees and {found.gain_db:.1f} dB"
        )
        return 1
    if last == highest:
        bench.note(f"{title} ends at {highest}, the greatest integer, with margin to spare")
        return last
    low, high = last, trial
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if enough(margins_of(middle)) else (low, middle)
    return low
