"""The observation of GainTuning, from identification, trials and true machine: rows with bounds, and their values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from drive_env.motors import Motor
from drive_env.trials.gain_trial import PHASES, Identified, Trial
from mechanics.arrays import Floats, Singles

RATIO_MAX = 100.0  # of a true parameter over its default


class ObservationRow(NamedTuple):
    """An entry of the observation: name, unit, bounds."""

    name: str
    unit: str
    low: float
    high: float


IDENTIFIED = (
    ObservationRow("ln of total inertia over three rotors", "1", -5.0, 7.0),
    ObservationRow("dry friction", "rated current", 0.0, 5.0),
    ObservationRow("viscous friction at rated speed", "rated current", 0.0, 5.0),
    ObservationRow("constant load", "rated current", -5.0, 5.0),
)
PHASE = (
    ObservationRow("ln t_s/t_0", "1", 0.0, 5.0),
    ObservationRow("ln(1 + n/3 %)", "1", 0.0, 7.0),
    ObservationRow("overshoot", "the move", 0.0, 5.0),
    ObservationRow("ln of the following error's integral over the rule's", "1", -10.0, 10.0),
    ObservationRow("stopped: it oscillated or went into fault", "1", 0.0, 1.0),
)
COST = ObservationRow("ln J by measured terms, of the machine", "1", -10.0, 4.0)
TRIED = (*PHASE * len(PHASES), COST)
WAVE = ObservationRow("error of the move", "the move", -5.0, 5.0)
LEFT = ObservationRow("trials left", "those of an episode", 0.0, 1.0)


def rows_of(axes: int, gains: int, waveform: int, highest: int) -> list[ObservationRow]:
    """Return the entries: those of each axis, then those of the environment; the last trial's before the incumbent's.

    Args:
        axes: Number of axes.
        gains: Number of gains in the action.
        waveform: Points of the last move's error.
        highest: Greatest integer of any gain.
    """
    log_gain = ObservationRow("ln of a gain over the rule's", "1", -math.log(highest), math.log(highest))
    axis = [*IDENTIFIED, *[log_gain] * (2 * gains), *TRIED, *TRIED, *[WAVE] * waveform]
    return [*axis * axes, LEFT]


def identified_entries(found: Identified, motor: Motor) -> Floats:
    """Return the values of IDENTIFIED, shape (num_axes, 4)."""
    return np.stack(
        [
            np.log(np.maximum(found.inertia, 1e-12) / (3.0 * motor.inertia)),
            found.coulomb / motor.rated_current,
            found.viscous * motor.rated_speed / motor.rated_current,
            found.offset / motor.rated_current,
        ],
        axis=-1,
    )


def tried_entries(tried: Trial, following: Floats, measured: Floats) -> Floats:
    """Return the values of TRIED, shape (num_axes, 16).

    Args:
        tried: The trial.
        following: The following error of the rule's trial, shape (phases, num_axes).
        measured: J by measured terms of each axis's environment, shape (num_axes,).
    """
    terms = tried.terms
    rows = np.stack(
        [
            np.log(terms.settling),
            np.log1p(terms.noise / 0.03),
            terms.overshoot,
            np.log(tried.following / following),
            tried.aborted.astype(float),
        ],
        axis=-1,
    )
    flat = rows.transpose(1, 0, 2).reshape(len(measured), -1)
    return np.concatenate([flat, np.log(measured)[:, None]], axis=1)


def true_entries(parameters: Mapping[str, Floats], defaults: Mapping[str, Floats]) -> Singles:
    """Return each true parameter's relative difference from its default, shape (environments, parameters)."""
    true = np.stack(
        [
            (parameters[name] - default) / np.where(default == 0.0, 1.0, np.abs(default))
            for name, default in defaults.items()
        ],
        axis=-1,
    )
    return np.clip(true, -RATIO_MAX, RATIO_MAX).astype(np.float32)
