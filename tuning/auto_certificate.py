"""What auto did, as a certificate."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from drive_env.gains import GAIN_OBJECTS
from tuning.certificate import (
    AxisCertificate,
    Certificate,
    FrequencyResponse,
    StepResponse,
    envelope,
    frequency_response,
    identified,
    si_gains,
)
from tuning.linear_model import velocity_open_loop
from tuning.load_step import load_step
from tuning.margins import Margins, margins
from tuning.provenance import versions

if TYPE_CHECKING:
    from tuning.auto_result import AxisRun, Result
    from tuning.proving import Shown
    from tuning.target import Target

SETTLED = 0.01  # of the move: what counts as there


def certificate(target: Target, result: Result, seed: int, tuner: str = "auto") -> Certificate:
    """Return the certificate of a run of auto; emulated axes feel a load step for it.

    Args:
        target: What was tuned.
        result: What came of it.
        seed: That of the run.
        tuner: What found the gains.
    """
    loaded = {}
    if target.drives.machine is not None:
        # Not of drives that were given other gains since.
        now = np.stack([target.drives.read(name) for name in GAIN_OBJECTS], axis=1)
        loaded = load_step(target, result.accepted & np.all(now == [run.after for run in result.axes], axis=1))
    axes = tuple(_axis(target, result, axis, run, loaded.get(axis)) for axis, run in enumerate(result.axes))
    return Certificate(
        tuner=tuner,
        device=target.device.name,
        motor=target.motor.name,
        machine=target.machine or "unnamed",
        supply=float(target.supply[0]),
        seed=seed,
        envelope=envelope(target),
        axes=axes,
        versions=versions(),
    )


def _axis(target: Target, result: Result, axis: int, run: AxisRun, loaded: StepResponse | None) -> AxisCertificate:
    supply = float(target.supply[axis])
    return AxisCertificate(
        axis=axis,
        accepted=run.accepted,
        reason=run.reason or f"every check was passed: the gains were verified {run.verified}",
        identified={} if run.identified is None else identified(run.identified),
        before=tuple(run.before),
        after=tuple(run.after),
        before_si=si_gains(target.device, supply, run.before),
        after_si=si_gains(target.device, supply, run.after),
        steps=(*_steps(result, axis), *([loaded] if loaded else [])) if run.accepted else (),
        frequency_responses=_responses(target, result, axis, run) if run.accepted else (),
        notes=tuple(run.notes),
        hardware_seconds=float(result.drive_seconds[axis]),
        aborts=int(result.aborts[axis]),
    )


def _steps(result: Result, axis: int) -> tuple[StepResponse, ...]:
    """Return the move with the gains before, if it was made, and that with the new ones."""
    moves = ((False, result.earlier), (True, result.shown))
    return tuple(_step(shown, axis, tuned) for tuned, shown in moves if shown is not None and shown.where[axis])


def _step(shown: Shown, axis: int, tuned: bool) -> StepResponse:
    # From where the axis began, and in the direction in which it went: moves go there and back.
    way = 1.0 if shown.demand[-1, axis] >= shown.demand[0, axis] else -1.0
    demand, actual = (way * values[:, axis] for values in (shown.demand, shown.actual))
    size = max(float(np.abs(demand - demand[0]).max()), 1e-9)
    beyond = actual - demand[-1]
    late = np.flatnonzero(np.abs(actual - demand[-1]) > SETTLED * size)
    there = np.flatnonzero(demand != demand[-1])
    settled = len(actual) - 1 not in late
    figures = {
        # After the profile's end; less than nothing is nothing.
        "settling [s]": max(float(shown.t[late[-1]] - shown.t[there[-1]]), 0.0) if settled and late.size else np.nan,
        "overshoot [%]": 100.0 * max(float(beyond.max()), 0.0) / size,
        "largest following error [rad]": float(np.abs(demand - actual).max()),
        "error at the end [rad]": float(demand[-1] - actual[-1]),
    }
    return StepResponse("move", tuned, "rad", shown.t, demand, actual, way * shown.current[:, axis], figures)


def _responses(target: Target, result: Result, axis: int, run: AxisRun) -> tuple[FrequencyResponse, ...]:
    """Return the velocity loop as measured with the new gains, and as computed with those before."""
    response = result.response
    if response is None or run.is_kept or not np.isfinite(response.open_loop[:, axis]).any():
        return ()
    # Too few lines are coherent for margins: then they are shown as what they are.
    found = Margins(*(np.nan,) * len(Margins._fields)) if run.margins is None else run.margins
    measured = frequency_response(
        "velocity loop",
        response.f,
        response.open_loop[:, axis],
        found,
        tuned=True,
        coherence=response.coherence[:, axis],
        source="multisine, 1 kHz samples",
    )
    if run.plant is None or 0 in (run.before.torque_p, run.before.velocity_p):
        return (measured,)  # an open loop has no response
    L = velocity_open_loop(target.device, run.plant, run.before, response.f)
    before = frequency_response(
        "velocity loop",
        response.f,
        L,
        margins(response.f, L),
        tuned=False,
        source="the linear model of what was identified, for the gains before",
    )
    return before, measured
