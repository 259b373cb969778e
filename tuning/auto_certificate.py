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
from tuning.load_step import load_step
from tuning.provenance import versions

if TYPE_CHECKING:
    from tuning.auto import AxisRun, Result
    from tuning.target import Target

SETTLED = 0.01  # of the move: what counts as there


def certificate(target: Target, result: Result, seed: int) -> Certificate:
    """Return the certificate of a run of auto; emulated axes feel a load step for it.

    Args:
        target: What was tuned.
        result: What came of it.
        seed: That of the run.
    """
    loaded = {}
    if target.drives.machine is not None:
        # Not of drives that were given other gains since.
        now = np.stack([target.drives.read(name) for name in GAIN_OBJECTS], axis=1)
        loaded = load_step(target, result.accepted & np.all(now == [run.after for run in result.axes], axis=1))
    axes = tuple(_axis(target, result, axis, run, loaded.get(axis)) for axis, run in enumerate(result.axes))
    return Certificate(
        tuner="auto",
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
        reason=run.reason or "every check was passed",
        identified={} if run.identified is None else identified(run.identified),
        before=tuple(run.before),
        after=tuple(run.after),
        before_si=si_gains(target.device, supply, run.before),
        after_si=si_gains(target.device, supply, run.after),
        steps=(*_steps(result, axis), *([loaded] if loaded else [])) if run.accepted else (),
        frequency_responses=_responses(result, axis, run) if run.accepted else (),
        notes=tuple(run.notes),
        hardware_seconds=float(result.drive_seconds[axis]),
        aborts=int(result.aborts[axis]),
    )


def _steps(result: Result, axis: int) -> tuple[StepResponse, ...]:
    shown = result.shown
    if shown is None:
        return ()
    demand, actual = shown.demand[:, axis], shown.actual[:, axis]
    size = max(float(np.abs(demand - demand[0]).max()), 1e-9)
    beyond = (actual - demand[-1]) * np.sign(demand[-1] - demand[0])
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
    return (StepResponse("move", True, "rad", shown.t, demand, actual, shown.current[:, axis], figures),)


def _responses(result: Result, axis: int, run: AxisRun) -> tuple[FrequencyResponse, ...]:
    response, margins = result.response, run.margins
    if response is None or margins is None:
        return ()
    return (
        frequency_response(
            "velocity loop",
            response.f,
            response.open_loop[:, axis],
            margins,
            tuned=True,
            coherence=response.coherence[:, axis],
            source="multisine, 1 kHz samples",
        ),
    )
