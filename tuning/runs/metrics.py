"""What a sweep measures of every point: the table of metrics, and the combined one that ranks by default.

Speeds are in rpm, as drive engineers read them. For every metric less is better; one that does not exist (never
settles) is nan.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drive_env.trials import response

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A current that swings by this share of the limit without decaying is a limit cycle; noise at usable gains stays below
# 0.03.
RINGING_CURRENT = 0.2
# Encoder noise at good gains reaches 10 % of the dip, and would keep an axis from ever recovering.
RECOVERY_BAND = 0.2


class MoveRecording(NamedTuple):
    """One move of many machines: n samples of p points."""

    t: Floats  # s, shape (n,)
    reference_rpm: Floats  # velocity set-point, shape (n,)
    speed_rpm: Floats  # actual velocity, shape (n, p)
    current: Floats  # A of i_q, shape (n, p)
    current_limit: Floats  # A, shape (p,)
    t_step: float  # s
    t_load: float  # s

    def point(self, k: int) -> MoveRecording:
        """Return the recording of point k alone."""
        return self._replace(
            speed_rpm=self.speed_rpm[:, [k]].copy(),
            current=self.current[:, [k]].copy(),
            current_limit=self.current_limit[[k]],
        )


class Figures(NamedTuple):
    """What response.py says of a recording; errors [rpm] are set-point less actual."""

    recording: MoveRecording
    step: response.StepMetrics
    disturbance: response.DisturbanceMetrics
    current: response.CurrentMetrics
    step_error: Floats  # shape (samples, p), from the step to the load step
    load_error: Floats  # shape (samples, p), from the load step on


class Metric(NamedTuple):
    """A row: name, unit, meaning, and the function from figures to one number per point, shape (p,)."""

    name: str
    unit: str
    meaning: str
    function: Callable[[Figures], Floats]


def figures(recording: MoveRecording) -> Figures:
    """Return the figures of a recording: the step up to the load torque, the disturbance from there to the end."""
    t, speed = recording.t, recording.speed_rpm
    reference = np.broadcast_to(recording.reference_rpm[:, None], speed.shape)
    error = reference - speed
    first, load = _index(t, recording.t_step), _index(t, recording.t_load)
    return Figures(
        recording=recording,
        step=response.step_metrics(t, speed, reference, t_step=recording.t_step, t_end=recording.t_load, initial=0.0),
        disturbance=response.disturbance_metrics(t, speed, reference, t_load=recording.t_load, band=RECOVERY_BAND),
        current=response.current_metrics(recording.current[first:], i_max=recording.current_limit),
        step_error=error[first : load + 1],
        load_error=error[load:],
    )


def oscillates(found: Figures) -> Mask:
    """Return which points ring without decaying, in the velocity or in the current, shape (p,)."""
    recording = found.recording
    window = slice(_index(recording.t, recording.t_step), _index(recording.t, recording.t_load) + 1)
    ringing, _ = response.oscillation(
        recording.t[window] - recording.t_step,
        recording.current[window],
        amplitude=RINGING_CURRENT * recording.current_limit,
    )
    return np.asarray(found.step.oscillating | ringing)


def ripple(found: Figures) -> Floats:
    """Return the RMS change of the current from sample to sample [A], over the second half of the step's window.

    Noise that the gains amplify, and ringing that hardly decays: it grows as the limit of stability comes near.
    """
    recording = found.recording
    first, load = _index(recording.t, recording.t_step), _index(recording.t, recording.t_load)
    change = np.diff(recording.current[(first + load) // 2 : load + 1], axis=0)
    return response.rms(change)


def tracking(found: Figures, weights: Mapping[str, float]) -> Floats:
    """Return the combined metric [s]: how far from its set-point the axis stays, and how rough its current is.

    tracking = step * IAE_step / |h| + disturbance * IAE_load / |h| + ripple * i_ripple / i_max

    h is the height of the velocity step, IAE_step the integral of |set-point - actual| up to the load torque step,
    IAE_load the same from there to the end, i_ripple the metric `ripple` and i_max the drive's current limit. The first
    two are seconds of full error; the weight of the third [s] is what a ripple of the whole current limit would cost:
    with 0.2 s, one percent of it is worth 2 ms.
    """
    height = abs(float(found.recording.reference_rpm[-1]))
    return (
        weights["step"] * _iae(found) / height
        + weights["disturbance"] * _disturbance_iae(found) / height
        + weights["ripple"] * ripple(found) / found.recording.current_limit
    )


def score(name: str, weights: Mapping[str, float], found: Figures) -> Floats:
    """Return the metric that ranks, plain or combined, shape (p,)."""
    return tracking(found, weights) if name == TRACKING.name else METRICS[name].function(found)


def _iae(found: Figures) -> Floats:
    return response.iae(found.recording.t[: len(found.step_error)], found.step_error)


def _itae(found: Figures) -> Floats:
    return response.itae(found.recording.t[: len(found.step_error)], found.step_error)


def _disturbance_iae(found: Figures) -> Floats:
    return response.iae(found.recording.t[: len(found.load_error)], found.load_error)


def _rms_current(found: Figures) -> Floats:
    recording = found.recording
    return response.rms(recording.current[_index(recording.t, recording.t_step) :])


def _index(t: Floats, time: float) -> int:
    """Return the sample at a time [s]; times are whole sampling periods."""
    return int(np.abs(t - time).argmin())


METRICS: dict[str, Metric] = {
    row.name: row
    for row in (
        Metric("iae", "rpm*s", "integral of |set-point - actual velocity| from the step to the load torque", _iae),
        Metric("itae", "rpm*s^2", "the same, weighted with the time since the step", _itae),
        Metric("rise", "s", "from 10 % to 90 % of the step", lambda f: f.step.rise_time),
        Metric("settling", "s", "until the velocity stays within 2 % of the step", lambda f: f.step.settling_time),
        Metric("overshoot", "%", "beyond the step's height", lambda f: 100.0 * f.step.overshoot),
        Metric("undershoot", "%", "away from the set-point", lambda f: 100.0 * f.step.undershoot),
        Metric("dip", "rpm", "largest change of velocity after the load torque step", lambda f: f.disturbance.dip),
        Metric("recovery", "s", "until it stays within 20 % of the dip", lambda f: f.disturbance.recovery_time),
        Metric("disturbance_iae", "rpm*s", "integral of |set-point - actual velocity| from the load torque on",
               _disturbance_iae),
        Metric("peak_current", "A", "largest |i_q| from the step on", lambda f: f.current.peak),
        Metric("rms_current", "A", "RMS of i_q from the step on", _rms_current),
        Metric("ripple", "A", "RMS change of i_q per sample, once the step is over", ripple),
    )
}  # fmt: skip


class Combined(NamedTuple):
    """The row of a combined metric: its weights, with their defaults."""

    name: str
    unit: str
    meaning: str
    weights: Mapping[str, float]


TRACKING = Combined(
    "tracking",
    "s",
    "IAE of step and disturbance over the step's height, plus current ripple over the current limit; weighted",
    {"step": 1.0, "disturbance": 1.0, "ripple": 0.2},
)


def unit_of(name: str) -> str:
    """Return the unit of a metric, plain or combined."""
    return TRACKING.unit if name == TRACKING.name else METRICS[name].unit


def metric_names() -> list[str]:
    """Return the names of all metrics, the combined one first."""
    return [TRACKING.name, *METRICS]
