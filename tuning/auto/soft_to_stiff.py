"""Gains of an axis from soft to stiff, selected by one number, designed with its measured velocity loop."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from drive_env.devices.gains import cascade_columns, si_scales
from drive_env.loops.dynamics import Dynamics, find_dynamics, known_dynamics
from mechanics.arrays import Floats, Integers
from tuning.auto.design import design_by_loops
from tuning.auto.loop_model import LoopModel, model_of
from tuning.auto.measured_margins import MeasuredAxis
from tuning.rules.cascade import NOISE
from tuning.rules.lags import velocity_noise

if TYPE_CHECKING:
    from drive_env.motors import Motor
    from tuning.response.measured_loop import MeasuredLoop


class SoftToStiff(NamedTuple):
    """Gains designed for each of the named dynamics, the softest first, with interpolation between them.

    gains: Raw, (dynamics, count).
    slack: Relative slack to their dynamics, (dynamics,); below 0 if no gains keep them.
    columns: Columns of the cascade's gains; others, such as a feed-forward, are not changed.
    """

    gains: Integers
    slack: Floats
    columns: tuple[int, ...]

    def dynamics(self, place: float) -> Dynamics:
        """Return the dynamics at a place, 0 for the softest to 1 for the stiffest, interpolated between named ones."""
        rows = list(known_dynamics().values())
        at = place * (len(rows) - 1)
        if at == round(at):
            return rows[round(at)]
        limits = [(one.phase_deg, one.gain_db, one.ms) for one in rows]
        phase, gain, ms = (np.interp(at, range(len(rows)), column) for column in zip(*limits, strict=True))
        return find_dynamics(f"{phase:.1f}/{gain:.1f}/{ms:.2f}")

    def at(self, place: float, present: Sequence[int]) -> tuple[int, ...]:
        """Return raw gains at a place, 0 to 1, with logarithmic interpolation; `present` are those in force."""
        found = list(present)
        for k in self.columns:
            logs = np.log(np.maximum(self.gains[:, k], 1))
            found[k] = round(math.exp(float(np.interp(place * (len(logs) - 1), range(len(logs)), logs))))
        return tuple(found)


def soft_to_stiff(
    measured: MeasuredLoop, motor: Motor, axis: int, say: Callable[[float], None] = lambda share: None
) -> SoftToStiff:
    """Design gains for each of the named dynamics by a measured velocity loop and the model fitted to it.

    Args:
        measured: The velocity loop.
        motor: The motor; variants of the load's inertia do not change its rotor's.
        axis: Index in the measurement.
        say: Called with the share that is done; an exception from it ends the design.

    Raises:
        ValueError: If the response was not measured well enough to compute it for other gains.
    """
    fit, device = measured.fits[axis], measured.device
    if fit is None or not fit.is_good:
        why = "there is none" if fit is None else fit.reason or f"a model misses it by {fit.misfit:.1f} times its noise"
        raise ValueError(f"the response of the velocity loop cannot be computed with other gains: {why}")
    loops = MeasuredAxis(measured, axis, fit.plant)
    quiet = NOISE * motor.rated_current / velocity_noise(device, fit.plant)
    most = max(math.floor(si_scales(device, fit.plant.supply)["velocity", "P"].raw(quiet)), 1)
    found = []
    for number, dynamics in enumerate(rows := list(known_dynamics().values())):
        say(number / len(rows))
        model = model_of(device, motor, fit.plant, dynamics, measured=True)
        found.append(design_by_loops(device, fit.plant, partial(_slack, model, loops, dynamics), most))
    gains, kept = zip(*found, strict=True)
    return SoftToStiff(np.array(gains), np.array(kept), tuple(cascade_columns(device)))


def _slack(model: LoopModel, loops: MeasuredAxis, dynamics: Dynamics, gains: Integers, nominal: bool) -> Floats:
    """Return the slack of rows of gains to dynamics by the model and, unless `nominal`, also by the measured loops."""
    by_model = model.slack(dynamics, gains[:, None], nominal=nominal)
    return by_model if nominal else np.minimum(by_model, loops.slack(dynamics, gains))
