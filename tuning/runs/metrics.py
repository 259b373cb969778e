"""The metrics of a sweep's points: their tables, and the combined metrics that rank by default.

Speeds are in rpm, as drive engineers use them. For every metric smaller is better; one that does not exist (never
settles) is nan.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from drive_env.trials import response
from mechanics.arrays import Floats, Mask

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.devices.gain_set import ClosedLoop


# A current that swings by this share of its limit without decaying is a limit cycle; noise at usable gains stays below
# 0.03.
RINGING_CURRENT = 0.2
# Encoder noise at good gains reaches 10 % of the dip; with a smaller band an axis would never recover.
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
    # Steppers only: demand less encoder [full steps], shape (n, p). In open loop the mean square of the set run current
    # over the motor's rated one, shape (p,); in closed loop the full steps per revolution, shape (p,). In open loop and
    # with a PID no torque current is measured: current and its limit are nan.
    lag: Floats | None = None
    effort: Floats | None = None
    full_steps: Floats | None = None

    @property
    def is_open_loop(self) -> bool:
        """Whether the motor runs in open loop."""
        return self.effort is not None

    @property
    def measures_current(self) -> bool:
        """Whether the torque current is measured."""
        return bool(np.isfinite(self.current_limit).all())

    def point(self, k: int) -> MoveRecording:
        """Return the recording of point k alone."""
        return self._replace(
            speed_rpm=self.speed_rpm[:, [k]].copy(),
            current=self.current[:, [k]].copy(),
            current_limit=self.current_limit[[k]],
            lag=None if self.lag is None else self.lag[:, [k]].copy(),
            effort=None if self.effort is None else self.effort[[k]],
            full_steps=None if self.full_steps is None else self.full_steps[[k]],
        )


class Figures(NamedTuple):
    """The results of response.py for a recording; errors [rpm] are set-point less actual."""

    recording: MoveRecording
    step: response.StepMetrics
    disturbance: response.DisturbanceMetrics
    current: response.CurrentMetrics | None  # None if no torque current is measured
    step_error: Floats  # shape (samples, p), from the step to the load step
    load_error: Floats  # shape (samples, p), from the load step to the end


class Metric(NamedTuple):
    """A metric: name, unit, meaning, and its function from figures to one number per point, shape (p,)."""

    name: str
    unit: str
    meaning: str
    function: Callable[[Figures], Floats]


def figures(recording: MoveRecording) -> Figures:
    """Evaluate a recording: the step until the load torque, then the disturbance until the end."""
    t, speed = recording.t, recording.speed_rpm
    reference = np.broadcast_to(recording.reference_rpm[:, None], speed.shape)
    error = reference - speed
    first, load = _index(t, recording.t_step), _index(t, recording.t_load)
    return Figures(
        recording=recording,
        step=response.step_metrics(t, speed, reference, t_step=recording.t_step, t_end=recording.t_load, initial=0.0),
        disturbance=response.disturbance_metrics(t, speed, reference, t_load=recording.t_load, band=RECOVERY_BAND),
        current=None
        if not recording.measures_current
        else response.current_metrics(recording.current[first:], i_max=recording.current_limit),
        step_error=error[first : load + 1],
        load_error=error[load:],
    )


def oscillates(found: Figures) -> Mask:
    """Return which points ring without decaying, in velocity or current, shape (p,)."""
    recording = found.recording
    if not recording.measures_current:  # no measured current that could ring
        return np.asarray(found.step.oscillating)
    window = slice(_index(recording.t, recording.t_step), _index(recording.t, recording.t_load) + 1)
    ringing, _ = response.oscillation(
        recording.t[window] - recording.t_step,
        recording.current[window],
        amplitude=RINGING_CURRENT * recording.current_limit,
    )
    return np.asarray(found.step.oscillating | ringing)


def ripple(found: Figures) -> Floats:
    """Return the RMS change of the current from sample to sample [A], over the second half of the step's window.

    It contains amplified noise and ringing that hardly decays: it grows near the stability limit.
    """
    recording = found.recording
    first, load = _index(recording.t, recording.t_step), _index(recording.t, recording.t_load)
    change = np.diff(recording.current[(first + load) // 2 : load + 1], axis=0)
    return response.rms(change)


def tracking(found: Figures, weights: Mapping[str, float]) -> Floats:
    """Return the combined metric [s] of the axis' distance from its set-point and the roughness of its current.

    tracking = step * IAE_step / |h| + disturbance * IAE_load / |h| + ripple * i_ripple / i_max

    h is the height of the velocity step, IAE_step the integral of |set-point - actual| until the load torque step,
    IAE_load the same from there to the end, i_ripple the metric `ripple` and i_max the drive's current limit. The first
    two are seconds of full error; the weight of the third [s] is the cost of a ripple of the whole current limit: with
    0.2 s, one percent of it costs 2 ms. In open loop the third term is effort * (i/i_rated)^2 of the run current. In
    closed loop the first two are the means of |demand - encoder| in the same times over the height: the seconds by
    which the axis is behind. With the PID of a stepper no torque current is measured: the third term is vibration * the
    RMS change of demand - encoder per sample [full steps].
    """
    recording, load = found.recording, len(found.step_error) - 1
    height = abs(float(recording.reference_rpm[-1]))
    if recording.full_steps is not None:
        step, disturbance = _behind(found, slice(load + 1)), _behind(found, slice(load, None))
    else:
        step, disturbance = _iae(found) / height, _disturbance_iae(found) / height
    if recording.effort is not None:
        third = weights["effort"] * recording.effort
    elif recording.measures_current:
        third = weights["ripple"] * ripple(found) / recording.current_limit
    else:
        third = weights["vibration"] * _vibration(found)
    return weights["step"] * step + weights["disturbance"] * disturbance + third


def score(name: str, weights: Mapping[str, float], found: Figures) -> Floats:
    """Return the metric of the ranking, plain or combined, shape (p,)."""
    if name == TRACKING.name:
        return tracking(found, weights)
    return (METRICS | OPEN_LOOP_METRICS | CLOSED_LOOP_METRICS)[name].function(found)


def _iae(found: Figures) -> Floats:
    return response.iae(found.recording.t[: len(found.step_error)], found.step_error)


def _itae(found: Figures) -> Floats:
    return response.itae(found.recording.t[: len(found.step_error)], found.step_error)


def _disturbance_iae(found: Figures) -> Floats:
    return response.iae(found.recording.t[: len(found.load_error)], found.load_error)


def _behind(found: Figures, window: slice) -> Floats:
    """Return the mean of |demand - encoder| over the height of the step [s]; the window begins at the step."""
    recording = found.recording
    assert recording.full_steps is not None, "a closed loop has a scale of full steps"
    height = abs(float(recording.reference_rpm[-1])) / 60.0 * recording.full_steps
    return np.asarray(np.abs(_lag(found)[window]).mean(axis=0) / height)


def _peak_current(found: Figures) -> Floats:
    assert found.current is not None, "a loop of the current measures it"
    return found.current.peak


def _rms_current(found: Figures) -> Floats:
    recording = found.recording
    return response.rms(recording.current[_index(recording.t, recording.t_step) :])


def _index(t: Floats, time: float) -> int:
    """Return the index of the sample at a time [s], a whole number of sampling periods."""
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
        Metric("peak_current", "A", "largest |i_q| from the step on", _peak_current),
        Metric("rms_current", "A", "RMS of i_q from the step on", _rms_current),
        Metric("ripple", "A", "RMS change of i_q per sample, once the step is over", ripple),
    )
}  # fmt: skip


# Open loop: no metrics of a measured current, but those of encoder, step counter and settings.
OPEN_LOOP_METRICS: dict[str, Metric] = {
    name: row for name, row in METRICS.items() if name not in ("peak_current", "rms_current", "ripple")
} | {
    row.name: row
    for row in (
        Metric("load_angle", "full steps", "largest |demand - encoder| from the step on; 1 is the pull-out",
               lambda f: np.abs(_lag(f)).max(axis=0)),
        Metric("vibration", "full steps", "RMS change of it per sample, once the step is over",
               lambda f: _vibration(f)),
        Metric("effort", "%", "mean square of the run current that is set, of the rated one",
               lambda f: 100.0 * np.asarray(f.recording.effort)),
    )
}  # fmt: skip


# Stepper with closed loop: 6077h is its torque current, and the load angle is a following error.
CLOSED_LOOP_METRICS: dict[str, Metric] = METRICS | {
    row.name: row
    for row in (
        Metric("following", "full steps", "largest |demand - encoder| from the step on",
               lambda f: np.abs(_lag(f)).max(axis=0)),
        Metric("behind", "s", "mean |demand - encoder| from the step on over the step's speed",
               lambda f: _behind(f, slice(None))),
    )
}  # fmt: skip


# Stepper whose position a PID controls: no torque current is measured.
PID_METRICS: dict[str, Metric] = {
    name: row for name, row in CLOSED_LOOP_METRICS.items() if name not in ("peak_current", "rms_current", "ripple")
} | {"vibration": OPEN_LOOP_METRICS["vibration"]._replace(
    meaning="RMS change of |demand - encoder| per sample, once the step is over")}  # fmt: skip


def _vibration(found: Figures) -> Floats:
    recording = found.recording
    return response.rms(np.diff(_lag(found)[_index(recording.t, recording.t_load) // 2 :], axis=0))


def _lag(found: Figures) -> Floats:
    recording = found.recording
    assert recording.lag is not None, "a stepper's demand and encoder are recorded"
    return recording.lag[_index(recording.t, recording.t_step) :]


class Combined(NamedTuple):
    """A combined metric with the default weights."""

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


OPEN_LOOP_TRACKING = TRACKING._replace(
    meaning="the same in open loop: with the square of the run current over the rated one in place of the ripple",
    weights={"step": 1.0, "disturbance": 1.0, "effort": 0.01},
)


CLOSED_LOOP_TRACKING = TRACKING._replace(
    meaning="of a stepper in closed loop: mean |demand - encoder| over the step's speed, in step and disturbance, plus "
    "the ripple of the torque current over the run current; weighted",
    weights={"step": 1.0, "disturbance": 1.0, "ripple": 0.005},
)


PID_TRACKING = TRACKING._replace(
    meaning="of a stepper's position PID: the same two, plus the vibration in full steps in place of the ripple of a "
    "torque current, which is not measured; weighted",
    weights={"step": 1.0, "disturbance": 1.0, "vibration": 0.01},
)


def metrics_of(device: Device, loop: ClosedLoop | None = None) -> dict[str, Metric]:
    """Return the metrics of a device in a sweep; `loop` is the stepper loop that is closed, None without one."""
    if loop is not None:
        return PID_METRICS if loop.is_pid else CLOSED_LOOP_METRICS
    return OPEN_LOOP_METRICS if device.gains.is_open_loop else METRICS


def combined_of(device: Device, loop: ClosedLoop | None = None) -> Combined:
    """Return the combined metric of a device in a sweep; `loop` as in `metrics_of`."""
    if loop is not None:
        return PID_TRACKING if loop.is_pid else CLOSED_LOOP_TRACKING
    return OPEN_LOOP_TRACKING if device.gains.is_open_loop else TRACKING


def unit_of(name: str) -> str:
    """Return the unit of a metric, plain or combined."""
    return TRACKING.unit if name == TRACKING.name else (METRICS | OPEN_LOOP_METRICS | CLOSED_LOOP_METRICS)[name].unit


def metric_names(device: Device, loop: ClosedLoop | None = None) -> list[str]:
    """Return the names of all metrics of a device in a sweep, the combined one first."""
    return [TRACKING.name, *metrics_of(device, loop)]
