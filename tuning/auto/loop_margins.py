"""The frequency response of the velocity loop with the new gains; gains too near to instability are lowered."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env import cia402
from drive_env.dictionary.roles import Role
from drive_env.gains import write_gains
from drive_env.master.errors import BusError
from drive_env.safety.envelope import SafetyError
from tuning.auto.measured_margins import CALMED, SENSITIVITY, judged_loops, margins_with, sensitivity
from tuning.auto.moves import show
from tuning.auto.run import MOVE_TIME, TRIAL_TIME
from tuning.auto.trials import BY_TRIAL, faster, watch_following
from tuning.response.measured_loop import merged
from tuning.response.model_bounds import at_least_by_model, why_unbounded

if TYPE_CHECKING:
    from tuning.auto.result import AxisRun
    from tuning.auto.run import AutoRun
    from tuning.response.margins import Margins
    from tuning.response.measured_loop import AtLeast, MeasuredLoop

Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

LEAST_LINES = 10  # of a frequency response, that are worth a judgement
CLOSE = {"phase": 14.0, "gain": 2.5}  # margins that this leaves at least [degrees, dB]
SOFTER = (1.0, 0.85, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2)  # factors of gains by which a lively loop is calmed
OVERTIME = 0.5  # s beyond the budget for a response: so near to the end margins are worth more than the time
LONGER = 2  # times as long it is shaken where too little was seen
LEAST_WAY = 1e-3  # rad; an axis without any way is shaken as little as can be, and its response says so
ALONE = (
    "the response was measured with this axis alone moving what all axes of its machine share, and the others "
    "switched off: with all of them active the loop's gain is higher, and the gain margin lower, by the others' "
    "share; the position loop was not measured"
)
FREE_WINDOW = 100  # turns of following error that trip a frequency response: it means nothing there


def measure(run: AutoRun) -> None:
    """Measure the velocity loop's response with the new gains; lower gains that are too near to instability."""
    going = run.going
    # A move with the gains before matters more: without it nobody knows whether the new ones are better.
    late = going & ~run.affordable(run.response_time + run.look_back_time - OVERTIME)
    _without_response(run, late, "the drive time of the run was used up")
    going &= ~late
    if not going.any():
        return
    from tuning.response import frequency_response

    drives = run.target.drives
    # Trials have left the axes somewhere in their travel: what is left of it is counted from there.
    low, high = run.room()
    here = replace(run.target, low=low, high=np.maximum(high, LEAST_WAY))
    write_gains(drives, run.gains, going)
    drives.write(cia402.FOLLOWING_WINDOW, FREE_WINDOW * drives.read(Role.POSITION_SCALE), where=going)
    try:
        with run.spending(going):
            response = frequency_response.measure(here, "velocity", where=going)
            if (longer := _unclear(run, response, going)).any():
                again = frequency_response.measure(
                    here, "velocity", where=longer, periods=LONGER * frequency_response.PERIODS
                )
                response = merged([response, again])
        run.response = response
    except SafetyError as error:
        run.stop(going, f"the envelope stopped the frequency response: {error}")
        return
    except (ValueError, RuntimeError, TimeoutError) as error:
        if isinstance(error, BusError):
            raise
        _without_response(run, going, str(error))
        return
    finally:
        watch_following(run, going)
    assert run.ground is not None, "proving makes it"
    faults = run.faults()
    run.ground.begin_here(going)
    calmed = np.zeros(run.target.num_axes, bool)
    for axis in map(int, np.flatnonzero(going & run.going)):
        if axis not in faults:
            calmed[axis] = _calm(run, axis, response)
    _try_again(run, calmed & run.going)
    _go_on_after_faults(run, faults)


def _unclear(run: AutoRun, response: MeasuredLoop, going: Mask) -> Mask:
    """Return the axes with too few coherent lines and enough time to measure longer, (num_axes,)."""
    left = run.affordable(LONGER * run.response_time + run.response_time + run.look_back_time)
    unclear = np.zeros(run.target.num_axes, bool)
    for k in map(int, np.flatnonzero(going & left)):
        found = margins_with(run, response, run.gains[k], k)["velocity"] if _seen(response, k) >= LEAST_LINES else None
        unclear[k] = found is None or not math.isfinite(found.phase_deg)
    return unclear


def _seen(response: MeasuredLoop, k: int) -> int:
    """Return how many lines of an axis are coherent, together with their neighbours where a model fits."""
    return round(float(response.refined(k)[2].mean()) * len(response.f))


def _rule_instead(run: AutoRun, k: int, response: MeasuredLoop, why: str) -> bool:
    """Take the baseline rule's gains, slowed as far as needed, for an axis whose own cannot be calmed; or reject it."""
    axis = run.axes[k]
    for factor in SOFTER:
        gains = faster(run.target.device.gains, run.reference[k], factor)
        if sensitivity(run, response, gains, k) <= SENSITIVITY:
            slowed = "" if factor == 1.0 else f", slowed to {100.0 * factor:.0f} %,"
            axis.notes.append(f"the gains of the baseline rule{slowed} are kept: with those found by search {why}")
            run.gains[k], run.spare[k] = gains, 0
            return True
    axis.reason = f"{why}; {SENSITIVITY:g} is allowed"
    return False


def _calm(run: AutoRun, k: int, response: MeasuredLoop) -> bool:
    """Lower the gains of an axis one of whose loops comes too near to instability; return whether it was so."""
    axis = run.axes[k]
    seen = _seen(response, k)
    if seen < LEAST_LINES:
        why = f"only {seen} frequencies are coherent, and {LEAST_LINES} are needed"
        _without_response(run, np.arange(run.target.num_axes) == k, "; ".join([why, *response.notes[k]]))
        return False
    gains, known = run.gains[k], run.target.device.gains
    for loop, lowered in CALMED.items():
        calmed = [column for column in known.columns_of(*lowered) if known.rows[column].part == "P"]
        if loop not in judged_loops(run):
            continue
        for factor in SOFTER:
            softer = known.scaled(gains, factor, calmed)
            found = margins_with(run, response, softer, k)[loop]
            if found.ms <= SENSITIVITY:
                break
        else:
            return _rule_instead(
                run, k, response, f"the measured {loop} loop has a sensitivity peak Ms of {found.ms:.1f}"
            )
        if factor != 1.0:
            names = " and ".join(known.titles[column] for column in calmed)
            axis.notes.append(
                f"{names} lowered to {100.0 * factor:.0f} %: the measured {loop} loop was too near to instability; "
                "the margins with the lower gains are computed from that measurement"
            )
        gains = softer
    if np.array_equal(gains, run.gains[k]):
        return False
    run.gains[k], run.spare[k] = gains, 0  # the second best would be as near
    return True


def judge(run: AutoRun) -> None:
    """Write down the margins of the final gains: as measured, or their lower bound."""
    response, loops = run.response, judged_loops(run)
    for k in map(int, np.flatnonzero(run.going)):
        axis, gains = run.axes[k], run.gains[k]
        if response is None or run.unseen[k]:
            axis.at_least, bounds = _by_model(run, k, loops)
            axis.reservations.append(bounds)
            continue
        found = margins_with(run, response, gains, k)
        axis.margins = {loop: found[loop] for loop in loops}
        axis.at_least = {loop: response.at_least(loop, gains, k) for loop in loops}
        blank = [loop for loop in loops if _is_blank(axis.margins[loop], axis.at_least[loop])]
        for loop in loops:
            if loop not in blank:
                _tell(axis, loop, axis.margins[loop], axis.at_least[loop])
        if blank:
            least, bounds = _by_model(run, k, blank)
            axis.at_least |= least
            axis.reservations.append(
                f"not all margins of the {' and the '.join(blank)} loop were measured: too few frequencies are "
                f"coherent, and the response fits no model; {bounds}"
            )
        axis.notes += [note for note in response.notes[k] if note not in axis.notes]
        if run.target.linked:
            axis.reservations.append(ALONE)
        how = "by"
        if not np.array_equal(gains, response.gains[k]):
            how = "by margins computed for these gains from"
        axis.verified = (
            f"{axis.verified or BY_TRIAL}; and {how} the measured frequency response of the velocity loop: "
            + ", ".join(f"{loop} loop Ms {one.ms:.1f}" for loop, one in axis.margins.items())
        )


def _is_blank(found: Margins, least: AtLeast) -> bool:
    """Return whether a margin was not measured, and the response has no bound for it."""
    pairs = ((found.phase_deg, least.phase_deg), (found.gain_db, least.gain_db))
    return any(math.isnan(bound) and not math.isfinite(value) for value, bound in pairs)


def _by_model(run: AutoRun, k: int, loops: Sequence[str]) -> tuple[dict[str, AtLeast], str]:
    """Return what margins of loops are at least by the model of the identified axis, and that in words."""
    plant, identified = run.axes[k].plant, run.axes[k].identified
    why = "the axis was not identified" if identified is None else why_unbounded(identified)
    if run.target.linked:
        why = "the model is of this axis alone, and all axes of its machine share what it moves"
    if why or plant is None or identified is None:
        return {}, f"the identified model gives no bound of the margins: {why}"
    every = at_least_by_model(run.target.device, plant, identified, run.gains[k])
    return {loop: every[loop] for loop in loops}, (
        "margins by the identified model, anywhere within its 95 % intervals: "
        + ", ".join(f"{loop} loop {_in_words(every[loop])}" for loop in loops)
        + "; this is a bound from the model, not a measurement"
    )


def _in_words(least: AtLeast) -> str:
    if math.isnan(least.phase_deg):
        return "no bound, since it may be unstable there"
    gain = f" and {least.gain_db:.1f} dB" if math.isfinite(least.gain_db) else ""
    return f"at least {least.phase_deg:.0f} degrees{gain}"


def _tell(axis: AxisRun, loop: str, found: Margins, least: AtLeast) -> None:
    """Add notes, or reservations if they are small, of the lower bounds of margins that were not measured."""
    for name, value, bound, unit in (
        ("phase", found.phase_deg, least.phase_deg, "degrees"),
        ("gain", found.gain_db, least.gain_db, "dB"),
    ):
        if not math.isfinite(value) and math.isfinite(bound):
            (axis.reservations if bound < CLOSE[name] else axis.notes).append(
                f"the {loop} loop's {name} margin was not measured; it is at least {bound:.0f} {unit} by the model "
                "fitted to the response, with its 95 % intervals"
            )


def _try_again(run: AutoRun, calmed: Mask) -> None:
    """Try gains that were lowered, and record a move with them; without time for a trial, only the move."""
    where = calmed & run.affordable(TRIAL_TIME + MOVE_TIME + run.look_back_time)
    run.reserve(calmed & ~where, "the lowered gains were tried by one move only: the drive time of the run was used up")
    assert run.ground is not None, "proving makes it"
    if where.any():
        with run.spending(run.target.together(where)):
            proof = run.ground.run(run.gains, where)
        for k in map(int, np.flatnonzero(where)):
            axis = run.axes[k]
            axis.proof = float(proof.cost[k])
            if not proof.passed[k]:
                axis.reason = f"the lowered gains failed their trial: {proof.reason[k]}"
    show(run, calmed & run.going)


def _go_on_after_faults(run: AutoRun, faults: Mapping[int, str]) -> None:
    """Repeat the move with axes that went into fault during the measurement."""
    where = np.isin(np.arange(run.target.num_axes), list(faults))
    if not where.any():
        return
    for axis, causes in faults.items():
        only = np.arange(run.target.num_axes) == axis
        _without_response(run, only, f"the drive went into fault during the measurement ({causes})")
    assert run.ground is not None, "proving makes it"
    with run.spending(run.target.together(where)):
        run.ground.recover(where)
    run.drop_faults("its frequency response was measured, and the fault cannot be reset")
    show(run, where & run.going)


def _without_response(run: AutoRun, where: Mask, why: str) -> None:
    """Add the reason why there is no frequency response, and how the gains were verified instead."""
    run.unseen |= where
    run.reserve(where, f"margins not measured: {why}; the gains were verified {BY_TRIAL} instead")
