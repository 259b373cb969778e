"""Margins of outer loops with the present gains and payload, compared with required ones."""

from __future__ import annotations

import numpy as np

from drive_env.drives.interface import Drives, device_of
from drive_env.loops.dynamics import HIGHEST, Dynamics
from drive_env.loops.sampled import CascadeGains, LinearMachines, LoopRates, loops_around, mean_velocity, window
from drive_env.loops.true_plant import true_machines
from drive_env.saved_state import Saved
from mechanics.arrays import Floats, Integers, Mask

LOWEST, POINTS = 2.0, 100  # frequencies: from [Hz], number; enough for rigid machines


class OnlineMargins(Saved):
    """Compares the outer loops of emulated machines with the margins of some dynamics, in every step.

    Args:
        drives: The drives, of a device whose cascade has a linear model.
        dynamics: The required margins.
        mode: "csp" for both loops, or "csv" for the velocity loop alone.
    """

    STATE = ("_plant", "_corner")

    def __init__(self, drives: Drives, dynamics: Dynamics, mode: str) -> None:
        self._drives, self._dynamics, self._loops = drives, dynamics, 2 if mode == "csp" else 1
        self._rates = LoopRates.of(device_of(drives))
        true = true_machines(drives)
        count, axes = true.supply.shape
        self._f = np.tile(np.geomspace(LOWEST, HIGHEST * self._rates.velocity_rate, POINTS), (count, 1))
        self._plant = np.zeros((count, POINTS, axes, axes), complex)  # rotor's velocity per demanded current
        self._corner = np.ones((count, axes))  # of the velocity filters [Hz]

    def take_in(self, raw: Integers, where: Mask) -> None:
        """Linearise machines in their present state.

        Args:
            raw: Gains of all axes, of which those of the current loops are used, (num_axes, count).
            where: Machines, (machines,).
        """
        found = LinearMachines(*(part[where] for part in true_machines(self._drives)))
        one = window(self._rates, found, self._gains(raw, where))
        self._plant[where] = mean_velocity(self._rates, one, self._f[where])
        self._corner[where] = found.velocity_filter

    def share(self, raw: Integers) -> Floats:
        """Return the least clearance (`Dynamics`) of each machine's loops with these gains, within 0...1, (machines,).

        It is 1 if all margins are kept, 0 if a loop is unstable.
        """
        every = np.ones(len(self._f), bool)
        loops = loops_around(self._rates, self._plant, self._corner, self._gains(raw, every), self._f)[: self._loops]
        # Stable loops do not encircle -1: their phase returns to its start.
        turned = [np.unwrap(np.angle(1.0 + loop), axis=-1)[..., -1] for loop in loops]
        kept = [np.where(np.abs(turn) < 0.5 * np.pi, self._dynamics.clearance(loop), 0.0)
                for turn, loop in zip(turned, loops, strict=True)]  # fmt: skip
        return np.asarray(np.clip(np.min(kept, axis=0).min(axis=-1), 0.0, 1.0))

    def _gains(self, raw: Integers, where: Mask) -> CascadeGains:
        return CascadeGains.of(device_of(self._drives), raw.reshape(len(self._f), -1, raw.shape[-1])[where])
