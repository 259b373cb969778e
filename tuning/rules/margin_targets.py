"""Margin targets: the greatest integers with which every loop keeps its phase and gain margin.

The pairs are those of a maker's tuning tool, Kollmorgen's Performance Servo Tuner: 45 degrees and 8 dB, and softer
55/12, 60/20 and 65/35. Integers are searched on the sampled model itself (linear_model.py), so that delay, filter,
resonance and rounding are all in the margins that are kept.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env.gains import RAW_MAX, Gains
from tuning.response.linear_model import controllers, current_open_loop, mean_velocity, velocity_plant
from tuning.response.margins import Margins, margins
from tuning.rules.proposal import Proposal, Rule, Workbench

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.motors import Motor
    from tuning.response.linear_model import Plant

Complex = NDArray[np.complex128]

TARGETS = {"margin_45": (45.0, 8.0), "margin_55": (55.0, 12.0), "margin_60": (60.0, 20.0), "margin_65": (65.0, 35.0)}

POINTS = 1200  # frequencies: half a percent apart, so that a weakly damped resonance is not stepped over
INTEGRATION = 4.0  # T_i times the velocity loop's crossover: the integral part costs 14 degrees
STEP = 1.06  # from one trial value of a gain to the next, until the first that fails


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
        # A loop whose gain is below 1 everywhere has all the margin there is.
        phase = math.inf if math.isnan(found.phase_deg) else found.phase_deg
        return phase >= phase_deg and found.gain_db >= gain_db

    f = np.geomspace(2.0, 0.49 * device.current_rate, POINTS)
    torque_i = min(max(round(65536.0 / device.current_rate * plant.R / plant.L), 1), RAW_MAX)
    unit = current_open_loop(device, plant, (1, torque_i, 1, 1, 1), f)
    torque_p = _greatest(bench, "torque P", lambda p: margins(f, p * unit), enough, phase_deg, gain_db)
    bench.raw("torque_p", torque_p)
    bench.raw("torque_i", torque_i)

    f = np.geomspace(0.2, 0.49 * device.velocity_rate, POINTS)
    z = np.exp(2j * math.pi * f / device.velocity_rate)
    inner = velocity_plant(device, plant, (torque_p, torque_i, 1, 1, 1), f)
    slope = plant.torque_constant / plant.inertia

    def velocity(p: int) -> Complex:
        raw = Gains(torque_p, torque_i, p, _integral(bench, device, p, slope), 1)
        return np.asarray(controllers(device, raw).velocity(z) * inner)

    velocity_p = _greatest(bench, "velocity P", lambda p: margins(f, velocity(p)), enough, phase_deg, gain_db)
    bench.raw("velocity_p", velocity_p)
    velocity_i = _integral(bench, device, velocity_p, slope)
    bench.raw("velocity_i", velocity_i)

    raw = Gains(torque_p, torque_i, velocity_p, velocity_i, 1)
    angle = mean_velocity(device, plant, raw, f) / device.velocity_rate / (1.0 - 1.0 / z)
    regulator = controllers(device, raw)
    unit = regulator.position * regulator.velocity(z) * angle / (1.0 + velocity(velocity_p))
    position_p = _greatest(bench, "position P", lambda p: margins(f, p * unit), enough, phase_deg, gain_db)
    bench.raw("position_p", position_p)
    return bench.proposal()


def _integral(bench: Workbench, device: Device, velocity_p: int, slope: float) -> int:
    crossover = bench.si("velocity_p", velocity_p) * slope
    return min(max(round(65536.0 / device.velocity_rate * crossover / INTEGRATION), 1), RAW_MAX)


def _greatest(
    bench: Workbench,
    title: str,
    margins_of: Callable[[int], Margins],
    enough: Callable[[Margins], bool],
    phase_deg: float,
    gain_db: float,
) -> int:
    """Return the greatest integer below the first that fails, 1 with a note if that fails itself."""
    last, trial = 0, 1
    while trial <= RAW_MAX and enough(margins_of(trial)):
        last = trial
        trial = max(trial + 1, math.ceil(trial * STEP)) if trial < RAW_MAX else RAW_MAX + 1
        trial = RAW_MAX if last < RAW_MAX < trial else trial
    if last == 0:
        found = margins_of(1)
        bench.note(
            f"no integer of {title} keeps {phase_deg:g} degrees and {gain_db:g} dB: 1, the least, has "
            f"{found.phase_deg:.0f} degrees and {found.gain_db:.1f} dB"
        )
        return 1
    if last == RAW_MAX:
        bench.note(f"{title} ends at {RAW_MAX}, the greatest integer, with margin to spare")
        return last
    low, high = last, trial
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if enough(margins_of(middle)) else (low, middle)
    return low
