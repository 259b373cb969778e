"""The highest speed of a stepper with its load: the pull-out torque there equals the friction.

Above the speed at which the voltage reaches the supply, the phase currents are not sines, and no closed form holds.
They are integrated over some periods at constant speed: each phase gets the whole supply, with either sign, until its
current reaches that of the table. The pull-out torque is the maximum over all lags of the rotor behind the field.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from drive_env.firmware.common.warming import NOMINAL
from drive_env.motors import COPPER, Motor
from mechanics.arrays import Floats
from mechanics.kernels.compiled import cached, stage

STEPS = 160  # of the electrical period, a multiple of 4
SETTLING = 4.0  # time constants L/R until the currents repeat
SINES, COSINES = (of(2.0 * np.pi * np.arange(STEPS) / STEPS) for of in (np.sin, np.cos))
LEAST_LAG, MOST_LAG = math.radians(30.0), math.radians(178.0)  # of the rotor, between which the greatest torque is
LAGS, SPEEDS = 8, 10  # golden-section steps for the lag, bisections for the speed
FASTEST = 2.0 * math.pi * 60.0  # rad/s, upper end of the search
GOLDEN = 0.6180339887498949
# Parameters of a machine that the speed depends on; friction of motor and load is added.
ELECTRICAL = ("motor.R_s", "motor.L_s", "motor.psi_m", "motor.saturation", "supply.voltage")


def highest_speeds(motor: Motor, current: ArrayLike, parameters: Mapping[str, ArrayLike]) -> Floats:
    """Return the highest speeds [rad/s] at which machines with a disc on the shaft stay in step, (machines,).

    Within 3 % of the speed at which a slow ramp of the emulator loses steps, unless a resonance does so before.

    Args:
        motor: The stepper.
        current: Amplitude of its phase currents [A], one, or one per machine.
        parameters: By name, (machines,) each, as in `info["parameters"]` of an environment.
    """
    values = {name: np.asarray(parameters[name], float) for name in ELECTRICAL}
    warmer = np.asarray(parameters["start.winding"], float) - NOMINAL
    bridge = np.asarray(parameters["stage.on_resistance"], float)
    values["motor.R_s"] = values["motor.R_s"] * (1.0 + COPPER * warmer) + bridge
    values["motor.psi_m"] = values["motor.psi_m"] * (1.0 + motor.flux_temperature * warmer)
    friction = [
        np.asarray(parameters[f"motor.{name}"], float) + parameters[f"load.{name}"] for name in ("coulomb", "viscous")
    ]
    rows = np.stack(np.broadcast_arrays(*values.values(), np.asarray(current, float), *friction), axis=-1)
    found = np.empty(rows.shape[:-1])
    _search(motor.n_p, np.ascontiguousarray(rows), found)
    return found


@stage
def mean_torque(n_p: int, row: Floats, speed: float, lag: float) -> float:
    """Return the mean torque [N m] at a speed [rad/s] and a lag behind the field [rad], of a row of `_search`."""
    R, L, psi_m, saturation, supply, current = row[0], row[1], row[2], row[3], row[4], row[5]
    w = n_p * speed
    dt = 2.0 * math.pi / (w * STEPS)
    most = dt / L * supply
    last = STEPS * (1 + math.ceil(SETTLING * L / R * w / (2.0 * math.pi)))
    behind, along = math.sin(lag), math.cos(lag)
    i_a, i_b, torque = current, 0.0, 0.0
    for k in range(last):
        sine, cosine = SINES[k % STEPS], COSINES[k % STEPS]
        s, c = sine * along - cosine * behind, cosine * along + sine * behind
        psi = psi_m / math.sqrt(1.0 + saturation * (i_a * i_a + i_b * i_b))
        free_a = i_a + dt / L * (psi * w * s - R * i_a)
        free_b = i_b - dt / L * (psi * w * c + R * i_b)
        i_a = min(max(current * cosine, free_a - most), free_a + most)
        i_b = min(max(current * sine, free_b - most), free_b + most)
        if k >= last - STEPS // 4:  # a quarter of a period later, one phase is as the other was
            torque += n_p * psi * (i_b * c - i_a * s)
    return torque / (STEPS // 4)


@stage
def pull_out_torque(n_p: int, row: Floats, speed: float) -> float:
    """Return the greatest torque [N m] at a speed [rad/s], by the golden section."""
    low, high = LEAST_LAG, MOST_LAG
    inner, outer = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
    left, right = mean_torque(n_p, row, speed, inner), mean_torque(n_p, row, speed, outer)
    for _ in range(LAGS):
        if left > right:
            high, outer, right = outer, inner, left
            inner = high - GOLDEN * (high - low)
            left = mean_torque(n_p, row, speed, inner)
        else:
            low, inner, left = inner, outer, right
            outer = low + GOLDEN * (high - low)
            right = mean_torque(n_p, row, speed, outer)
    return max(left, right)


@cached(allocates=False)
def _search(n_p: int, rows: Floats, found: Floats) -> None:
    """Write the highest speed [rad/s] of each row: R, L, psi, saturation, supply, current, dry and viscous friction."""
    for k in range(rows.shape[0]):
        row = rows[k]
        holding = n_p * row[2] * row[5] / math.sqrt(1.0 + row[3] * row[5] * row[5])  # the pull-out torque is less
        low, high = 0.0, min(FASTEST, max(holding - row[6], 0.0) / max(row[7], 1e-12))
        for _ in range(SPEEDS):
            speed = 0.5 * (low + high)
            if pull_out_torque(n_p, row, speed) > row[6] + row[7] * speed:
                low = speed
            else:
                high = speed
        found[k] = low
