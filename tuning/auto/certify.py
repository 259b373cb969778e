"""Converts the result of auto to a certificate."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from drive_env.devices.gain_set import FEED_FORWARD
from drive_env.loops.linear_model import OPEN_LOOPS
from drive_env.loops.margins import Margins, margins
from mechanics.arrays import Floats
from tuning.auto.loop_margins import OVERSHOOT_ERROR, AskedMargin, asked_margins
from tuning.auto.measured_margins import LOOPS
from tuning.auto.moves import NOISE, SWING
from tuning.certificate.certificate import (
    CROSSOVERS,
    KEPT,
    MARGIN_NAMES,
    NEARLY_KEPT,
    NOT_KEPT,
    NOT_MEASURED,
    SEEN_KEPT,
    AxisCertificate,
    Certificate,
    FrequencyResponse,
    Requirement,
    StepResponse,
    envelope,
    frequency_response,
    identified,
    si_gains,
)
from tuning.runs.inputs import hashes
from tuning.runs.provenance import versions

if TYPE_CHECKING:
    from drive_env.devices.gain_set import GainSet
    from drive_env.loops.dynamics import Dynamics
    from tuning.auto.proving import Shown
    from tuning.auto.stages import AxisResult, Result
    from tuning.target import Target

# Margins of a loop that was not measured.
UNKNOWN = Margins(*(np.nan,) * len(Margins._fields))
MODEL_LOW, MODEL_HIGH, MODEL_POINTS = 2.0, 1000.0, 200  # [Hz], frequencies for a loop known only by its model
SETTLED = 0.01  # of the move: settling band
# Measured from the end of the profile.
SETTLING = "settling time after the set-point's arrival, to within 1 % of the move [s]"


def certificate(target: Target, result: Result, seed: int, tuner: str = "auto") -> Certificate:
    """Return the certificate of a run of auto.

    Args:
        target: The tuned drives.
        result: Result of the run.
        seed: Seed of the run.
        tuner: Name of the tuner that found the gains.
    """
    axes = tuple(_axis(target, result, axis, outcome) for axis, outcome in enumerate(result.axes))
    return Certificate(
        tuner=tuner,
        device=target.device.name,
        motor=target.motor.name,
        machine=target.machine or "unnamed",
        supply=float(target.supply[0]),
        seed=seed,
        envelope=envelope(target),
        axes=axes,
        versions=versions() | hashes(target.inputs),
    )


def _axis(target: Target, result: Result, axis: int, outcome: AxisResult) -> AxisCertificate:
    supply = float(target.supply[axis])
    loaded = [result.loaded[axis]] if axis in result.loaded else []
    passed = "all checks that could be made passed" if outcome.reservations else "all checks passed"
    return AxisCertificate(
        axis=target.axis_numbers[axis],
        accepted=outcome.accepted,
        reservations=outcome.reservations,
        reason=outcome.reason or f"{passed}; the gains were verified {outcome.verified}",
        identified={} if outcome.identified is None else identified(outcome.identified, target.motor),
        before=outcome.before,
        after=outcome.after,
        before_si=si_gains(target.device, supply, outcome.before),
        after_si=si_gains(target.device, supply, outcome.after),
        steps=(*recorded_moves(result, axis), *loaded) if outcome.accepted else (),
        frequency_responses=_responses(target, result, axis, outcome) if outcome.accepted else (),
        dynamics=result.dynamics.name,
        requirements=requirements(result.dynamics, outcome, target.device.gains) if outcome.accepted else (),
        figures=_crossovers(target, outcome) if outcome.accepted else {},
        corrections=outcome.corrections,
        notes=outcome.notes,
        hardware_seconds=float(result.drive_seconds[axis]),
        aborts=int(result.aborts[axis]),
    )


def requirements(dynamics: Dynamics, outcome: AxisResult, gains: GainSet) -> tuple[Requirement, ...]:
    """Return the requirements of dynamics on an axis, and whether the measurement proves that its gains keep each."""
    rows = []
    for loop in LOOPS:
        found, least = outcome.margins.get(loop, UNKNOWN), outcome.at_least.get(loop)
        whole = np.isfinite([found.phase_deg, found.gain_db]).all()
        for asked in asked_margins(dynamics):
            value, bound = getattr(found, asked.field), getattr(least, asked.field, np.nan)
            is_bound = not np.isfinite(value) and not np.isnan(bound)
            kept = _kept(asked, value)
            if is_bound and not asked.missed(bound):  # a bound below the limit proves nothing: the margin may be larger
                kept = KEPT
            elif kept != NOT_MEASURED and asked.field == "ms" and not whole:
                kept = SEEN_KEPT if kept != NOT_KEPT else kept
            name = f"{loop} loop, {MARGIN_NAMES[asked.field]}"
            rows.append(Requirement(name, asked.limit, bound if is_bound else value, is_bound, kept))
    allowed = AskedMargin("", "", 100.0 * dynamics.overshoot, 100.0 * OVERSHOOT_ERROR, "%", 0, -1.0)
    overshoot = float(np.maximum(100.0 * outcome.overshoot, 0.0))
    alone = " without feed-forward" if gains.columns_of(FEED_FORWARD[0]) else ""
    name = f"overshoot of a small step in csp{alone} [%]"
    return (*rows, Requirement(name, allowed.limit, overshoot, False, _kept(allowed, overshoot)))


def _kept(asked: AskedMargin, value: float) -> str:
    if np.isnan(value):
        return NOT_MEASURED
    return NOT_KEPT if asked.missed(value, asked.error) else NEARLY_KEPT if asked.missed(value) else KEPT


def _crossovers(target: Target, outcome: AxisResult) -> dict[str, float]:
    """Return the crossovers of the loops: of the current loop by its design, of the outer loops as measured."""
    known, plant, current = target.device.gains, outcome.plant, np.nan
    if plant is not None and not known.opens(outcome.after, "current"):
        f = np.geomspace(MODEL_LOW, 0.49 * target.device.current_rate, MODEL_POINTS)
        current = margins(f, OPEN_LOOPS["current"](target.device, plant, outcome.after, f)).crossover_hz
    velocity, position = (outcome.margins.get(loop, UNKNOWN).crossover_hz for loop in LOOPS)
    return dict(zip(CROSSOVERS, (current, velocity, position, position / velocity), strict=True))


def recorded_moves(result: Result, axis: int) -> tuple[StepResponse, ...]:
    """Return the move with the gains before, if it was recorded, and that with the new ones."""
    moves = ((False, result.earlier), (True, result.shown))
    return tuple(_step(shown, axis, tuned) for tuned, shown in moves if shown is not None and shown.where[axis])


def _step(shown: Shown, axis: int, tuned: bool) -> StepResponse:
    # Relative to the beginning and in the direction of the move: moves go there and back.
    way = 1.0 if shown.demand[-1, axis] >= shown.demand[0, axis] else -1.0
    demand, actual = (way * values[:, axis] for values in (shown.demand, shown.actual))
    size = max(float(np.abs(demand - demand[0]).max()), 1e-9)
    beyond = actual - demand[-1]
    late = np.flatnonzero(np.abs(actual - demand[-1]) > SETTLED * size)
    there = np.flatnonzero(demand != demand[-1])
    settled = len(actual) - 1 not in late
    figures = {
        # 0 for an actual position that is in the band before the profile's end.
        SETTLING: max(float(shown.t[late[-1]] - shown.t[there[-1]]), 0.0) if settled and late.size else np.nan,
        "overshoot [%]": 100.0 * max(float(beyond.max()), 0.0) / size,
        "largest following error [rad]": float(np.abs(demand - actual).max()),
        "error at the end [rad]": float(demand[-1] - actual[-1]),
        SWING: 100.0 * float(shown.swing[axis]),
    }
    if shown.noise[axis] > 0.0:
        figures[NOISE] = 100.0 * float(shown.noise[axis])
    return StepResponse("move", tuned, "rad", shown.t, demand, actual, way * shown.current[:, axis], figures)


def _responses(target: Target, result: Result, axis: int, outcome: AxisResult) -> tuple[FrequencyResponse, ...]:
    """Return both outer loops: with the new gains as measured, else by the model; with those before as computed."""
    response, coherence, plant = result.response, None, outcome.plant
    names = [name for name in LOOPS if name in outcome.margins or name in outcome.at_least]
    if response is not None and np.isfinite(response.open_loop[:, axis]).any():
        # The position loop may have too few coherent lines; that of linked axes is a different one.
        names = ["velocity", *(name for name in names if name != "velocity")]
        f, coherence = response.f, response.coherence[:, axis]
        measured = response.loops(outcome.after, axis, plant=plant, refined=False)
        loops = {name: getattr(measured, name) for name in names}
        changed = not np.array_equal(response.gains[axis], outcome.after)
        sources = {
            "velocity": "multisine, 1 kHz samples"
            + (", with other gains, converted to the new gains by the linear model" if changed else ""),
            "position": "computed from the measured velocity loop and position P",
        }
    else:  # without a response: their margins are bounds
        names = [name for name in names if name in outcome.at_least and plant is not None]
        f = np.geomspace(MODEL_LOW, MODEL_HIGH, MODEL_POINTS)
        loops = {name: OPEN_LOOPS[name](target.device, plant, outcome.after, f) for name in names if plant is not None}
        source = "linear model of the identified axis, not measured; margins are bounds within its 95 % intervals"
        sources = dict.fromkeys(names, source)
    shown: list[FrequencyResponse] = []
    for name in names:
        found, least = outcome.margins.get(name, UNKNOWN), outcome.at_least.get(name)
        shown += _before(target, outcome, name, f)
        shown.append(
            frequency_response(
                f"{name} loop", f, loops[name], found, at_least=least, tuned=True, coherence=coherence,
                source=sources[name],
            )
        )  # fmt: skip
    return tuple(shown)


def _before(target: Target, outcome: AxisResult, name: str, f: Floats) -> list[FrequencyResponse]:
    """Return a loop with the gains before by the model; empty if these gains were kept or leave a loop open."""
    known, plant = target.device.gains, outcome.plant
    if plant is None or outcome.is_kept or known.opens(outcome.before, "current", "velocity", name):
        return []
    L = OPEN_LOOPS[name](target.device, plant, outcome.before, f)
    source = "linear model of the identified axis, with the gains before"
    return [frequency_response(f"{name} loop", f, L, margins(f, L), tuned=False, source=source)]
