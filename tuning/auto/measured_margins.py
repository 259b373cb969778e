"""The loops of an axis with any gains, computed from its measured velocity loop: margins, and slack to the dynamics."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from drive_env.loops.dynamics import OFF_NOMINAL
from drive_env.loops.linear_model import controllers, velocity_filter_response, velocity_plant
from drive_env.loops.margins import is_as_stable
from drive_env.trials.score import VARIANTS
from mechanics.arrays import Complex, Floats, Integers
from tuning.response.measured_loop import seen_margins

if TYPE_CHECKING:
    from drive_env.loops.dynamics import Dynamics
    from drive_env.loops.linear_model import Plant
    from drive_env.loops.margins import Margins
    from tuning.response.measured_loop import MeasuredLoop

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
