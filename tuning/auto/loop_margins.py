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
from tuning.auto.bench import MOVE_TIME, TRIAL_TIME
from tuning.auto.calmer_gains import far_enough, twins_tell
from tuning.auto.measured_margins import (
    CALMED,
    SENSITIVITY,
    SOUGHT,
    first_far_enough,
    judged_loops,
    margins_with,
    sensitivity,
)
from tuning.auto.moves import show
from tuning.auto.stages import Verdict
from tuning.auto.trials import BY_TRIAL, faster, watch_following
from tuning.response.measured_loop import merged
from tuning.response.model_bounds import at_least_by_model, why_unbounded

if TYPE_CHECKING:
    from drive_env.devices.gain_set import GainSet
    from drive_env.loops.margins import Margins
    from tuning.auto.bench import AutoBench, Journal
    from tuning.auto.stages import Basis, RecordedGains
    from tuning.response.measured_loop import AtLeast, MeasuredLoop

Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

LEAST_LINES = 10  # of a frequency response, that are worth a judgement
CLOSE = {"phase": 19.0, "gain": 3.5}  # margins that Ms as it is sought leaves at least [degrees, dB]
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


def measure(bench: AutoBench, basis: Basis, recorded: RecordedGains) -> RecordedGains:
    """Measure the velocity loop's response with the gains; lower those that are too near to instability."""
    going = bench.going
    # A move with the gains before matters more: without it nobody knows whether the new ones are better.
    late = going & ~bench.affordable(bench.response_time + basis.look_back_time(bench) - OVERTIME)
    recorded = _without_response(bench, recorded, late, "the drive time of the run was used up")
    going &= ~late
    if not going.any():
        return recorded
    from tuning.response import frequency_response

    drives = bench.target.drives
    # Trials have left the axes somewhere in their travel: what is left of it is counted from there.
    low, high = bench.room()
    here = replace(bench.target, low=low, high=np.maximum(high, LEAST_WAY))
    write_gains(drives, recorded.gains, going)
    drives.write(cia402.FOLLOWING_WINDOW, FREE_WINDOW * drives.read(Role.POSITION_SCALE), where=going)
    try:
        with bench.spending(going):
            response = frequency_response.measure(here, "velocity", where=going)
            if (longer := _unclear(bench, basis, recorded.gains, response, going)).any():
                again = frequency_response.measure(
                    here, "velocity", where=longer, periods=LONGER * frequency_response.PERIODS
                )
                response = merged([response, again])
    except SafetyError as error:
        bench.stop(going, f"the envelope stopped the frequency response: {error}")
        return recorded
    except (ValueError, RuntimeError, TimeoutError) as error:
        if isinstance(error, BusError):
            raise
        return _without_response(bench, recorded, going, str(error))
    finally:
        watch_following(bench, going)
    assert bench.ground is not None, "proving makes it"
    recorded, faults = replace(recorded, response=response), bench.faults()
    bench.ground.begin_here(going)
    calmed = np.zeros(bench.target.num_axes, bool)
    for axis in map(int, np.flatnonzero(going & bench.going)):
        if axis not in faults:
            before, recorded = recorded.gains[axis], calm(bench, basis, recorded, axis, response)
            calmed[axis] = not np.array_equal(before, recorded.gains[axis])
    recorded = _try_again(bench, basis, recorded, calmed & bench.going)
    return _go_on_after_faults(bench, basis, recorded, faults)


def _unclear(bench: AutoBench, basis: Basis, gains: Integers, response: MeasuredLoop, going: Mask) -> Mask:
    """Return the axes with too few coherent lines and enough time to measure longer, (num_axes,)."""
    left = bench.affordable(LONGER * bench.response_time + bench.response_time + basis.look_back_time(bench))
    unclear = np.zeros(bench.target.num_axes, bool)
    for k in map(int, np.flatnonzero(going & left)):
        found = margins_with(basis, response, gains[k], k)["velocity"] if _seen(response, k) >= LEAST_LINES else None
        unclear[k] = found is None or not math.isfinite(found.phase_deg)
    return unclear


def _seen(response: MeasuredLoop, k: int) -> int:
    """Return how many lines of an axis are coherent, together with their neighbours where a model fits."""
    return round(float(response.refined(k)[2].mean()) * len(response.f))


def _rule_instead(
    bench: AutoBench, basis: Basis, recorded: RecordedGains, k: int, response: MeasuredLoop, why: str
) -> RecordedGains:
    """Take the baseline rule's gains, slowed as far as needed, for an axis whose own cannot be calmed; or reject it."""
    slower = [faster(bench.target.device.gains, basis.reference[k], factor) for factor in SOFTER]
    chosen = first_far_enough(sensitivity(bench.target, basis, response, gains, k) for gains in slower)
    if chosen is None:
        bench.journals[k].stop(f"{why}; {SENSITIVITY:g} is allowed")
        return recorded
    slowed = "" if SOFTER[chosen] == 1.0 else f", slowed to {100.0 * SOFTER[chosen]:.0f} %,"
    bench.journals[k].note(f"the gains of the baseline rule{slowed} are kept: with those found by search {why}")
    return recorded.with_gains(k, slower[chosen])


def _others_instead(bench: AutoBench, basis: Basis, recorded: RecordedGains, k: int, why: str) -> RecordedGains:
    """Take other gains for an axis whose own cannot be calmed by less P: the best by its twins, or the rule's."""
    assert recorded.response is not None, "it was measured"
    gains = far_enough(bench, basis, recorded, k) if twins_tell(bench, basis, k) else None
    if gains is None:
        return _rule_instead(bench, basis, recorded, k, recorded.response, why)
    bench.journals[k].note(
        f"other gains were searched on the digital twins: with the first ones {why}; the margins with the new gains "
        "are computed from that measurement"
    )
    return recorded.with_gains(k, gains)


def not_beyond(
    bench: AutoBench, basis: Basis, recorded: RecordedGains, gains: Integers, k: int, limit: float
) -> Integers:
    """Return gains of an axis with the P of its outer loops lowered until Ms, as measured, is at most this.

    Where nothing was measured, or nothing is low enough, they are as they were.
    """
    response, known = recorded.response, bench.target.device.gains
    if response is None or recorded.unseen[k]:
        return gains
    lowered = gains
    for loop in judged_loops(bench.target):
        softer = (known.scaled(lowered, factor, _p_columns(known, loop)) for factor in SOFTER)
        near = (one for one in softer if margins_with(basis, response, one, k)[loop].ms <= limit)
        if (found := next(near, None)) is None:
            return gains
        lowered = found
    return lowered


def _p_columns(known: GainSet, loop: str) -> list[int]:
    """Return the P gains that are lowered where a loop is too near to instability."""
    return [column for column in known.columns_of(*CALMED[loop]) if known.rows[column].part == "P"]


def calm(bench: AutoBench, basis: Basis, recorded: RecordedGains, k: int, response: MeasuredLoop) -> RecordedGains:
    """Lower the gains of an axis one of whose loops comes too near to instability."""
    seen = _seen(response, k)
    if seen < LEAST_LINES:
        why = f"only {seen} frequencies are coherent, and {LEAST_LINES} are needed"
        here = np.arange(bench.target.num_axes) == k
        return _without_response(bench, recorded, here, "; ".join([why, *response.notes[k]]))
    gains, known = recorded.gains[k], bench.target.device.gains
    for loop in judged_loops(bench.target):
        calmed = _p_columns(known, loop)
        softer = [known.scaled(gains, factor, calmed) for factor in SOFTER]
        peaks = [margins_with(basis, response, one, k)[loop].ms for one in softer]
        if (chosen := first_far_enough(peaks)) is None:
            why = f"the measured {loop} loop has a sensitivity peak Ms of {peaks[-1]:.1f}"
            return _others_instead(bench, basis, replace(recorded, response=response), k, why)
        if chosen > 0:
            names = " and ".join(known.titles[column] for column in calmed)
            bench.journals[k].note(
                f"{names} lowered to {100.0 * SOFTER[chosen]:.0f} %: the measured {loop} loop was too near to "
                f"instability (Ms {peaks[0]:.1f}); the margins with the lower gains are computed from that measurement"
            )
        gains = softer[chosen]
    # The second best would be as near.
    return recorded if np.array_equal(gains, recorded.gains[k]) else recorded.with_gains(k, gains)


def _try_again(
    bench: AutoBench, basis: Basis, recorded: RecordedGains, calmed: Mask, use_rule: bool = True
) -> RecordedGains:
    """Try gains that were changed, and record a move with them; without time for a trial, only the move.

    What fails gives way to the baseline rule's, slowed as far as needed, which are tried in turn.
    """
    where = calmed & bench.affordable(TRIAL_TIME + MOVE_TIME + basis.look_back_time(bench))
    bench.reserve(
        calmed & ~where, "the lowered gains were tried by one move only: the drive time of the run was used up"
    )
    assert bench.ground is not None, "proving makes it"
    if where.any():
        with bench.spending(bench.target.together(where)):
            proof = bench.ground.run(recorded.gains, where)
        proven = np.where(where[:, None], recorded.gains, recorded.proven)
        recorded = replace(recorded, proof=np.where(where, proof.cost, recorded.proof), proven=proven)
        failed = where & ~proof.passed
        again = failed & bench.affordable(TRIAL_TIME + MOVE_TIME) if use_rule else np.zeros_like(failed)
        for k in map(int, np.flatnonzero(failed)):
            why = f"the lowered gains failed their trial: {proof.reason[k]}"
            if again[k]:
                assert recorded.response is not None, "it was measured"
                recorded = _rule_instead(bench, basis, recorded, k, recorded.response, why)
            else:
                bench.journals[k].stop(why)
        if again.any():
            recorded = _try_again(bench, basis, recorded, again & bench.going, use_rule=False)
            calmed &= ~again
    return show(bench, basis, recorded, calmed & bench.going)


def _go_on_after_faults(
    bench: AutoBench, basis: Basis, recorded: RecordedGains, faults: Mapping[int, str]
) -> RecordedGains:
    """Repeat the move with axes that went into fault during the measurement."""
    where = np.isin(np.arange(bench.target.num_axes), list(faults))
    if not where.any():
        return recorded
    for axis, causes in faults.items():
        only = np.arange(bench.target.num_axes) == axis
        why = f"the drive went into fault during the measurement ({causes})"
        recorded = _without_response(bench, recorded, only, why)
    assert bench.ground is not None, "proving makes it"
    with bench.spending(bench.target.together(where)):
        bench.ground.recover(where)
    bench.drop_faults("its frequency response was measured, and the fault cannot be reset")
    return show(bench, basis, recorded, where & bench.going)


def _without_response(bench: AutoBench, recorded: RecordedGains, where: Mask, why: str) -> RecordedGains:
    """Tell why there is no frequency response, and how the gains were verified instead."""
    bench.reserve(where, f"margins not measured: {why}; the gains were verified {BY_TRIAL} instead")
    return replace(recorded, unseen=recorded.unseen | where)


def judge(bench: AutoBench, basis: Basis, recorded: RecordedGains) -> Verdict:
    """Return what the final gains are worth: their margins as measured, or a lower bound."""
    response, loops, n = recorded.response, judged_loops(bench.target), bench.target.num_axes
    margins: list[dict[str, Margins]] = [{} for _ in range(n)]
    at_least: list[dict[str, AtLeast]] = [{} for _ in range(n)]
    verified = list(recorded.verified)
    for k in map(int, np.flatnonzero(bench.going)):
        journal, gains = bench.journals[k], recorded.gains[k]
        if response is None or recorded.unseen[k]:
            at_least[k], bounds = _by_model(bench, basis, k, gains, loops)
            journal.reserve(bounds)
            continue
        found = margins_with(basis, response, gains, k)
        margins[k] = {loop: found[loop] for loop in loops}
        at_least[k] = {loop: response.at_least(loop, gains, k) for loop in loops}
        blank = [loop for loop in loops if _is_blank(margins[k][loop], at_least[k][loop])]
        for loop in loops:
            if loop not in blank:
                tell_bounds(journal, loop, margins[k][loop], at_least[k][loop])
        if blank:
            least, bounds = _by_model(bench, basis, k, gains, blank)
            at_least[k] |= least
            journal.reserve(
                f"not all margins of the {' and the '.join(blank)} loop were measured: too few frequencies are "
                f"coherent, and the response fits no model; {bounds}"
            )
        for note in [note for note in response.notes[k] if note not in journal.notes]:
            journal.note(note)
        for loop in loops:
            if margins[k][loop].ms > SOUGHT:
                journal.reserve(
                    f"the {loop} loop is near to instability: Ms {margins[k][loop].ms:.1f}, where {SOUGHT:g} or less "
                    "was sought; lower its P, or move slower, if the load may change"
                )
        if bench.target.linked:
            journal.reserve(ALONE)
        how = "by"
        if not np.array_equal(gains, response.gains[k]):
            how = "by margins computed for these gains from"
        verified[k] = (
            f"{verified[k] or BY_TRIAL}; and {how} the measured frequency response of the velocity loop: "
            + ", ".join(f"{loop} loop Ms {one.ms:.1f}" for loop, one in margins[k].items())
        )
    return Verdict(tuple(margins), tuple(at_least), tuple(verified))


def _is_blank(found: Margins, least: AtLeast) -> bool:
    """Return whether a margin was not measured, and the response has no bound for it."""
    pairs = ((found.phase_deg, least.phase_deg), (found.gain_db, least.gain_db))
    return any(math.isnan(bound) and not math.isfinite(value) for value, bound in pairs)


def _by_model(
    bench: AutoBench, basis: Basis, k: int, gains: Integers, loops: Sequence[str]
) -> tuple[dict[str, AtLeast], str]:
    """Return what margins of loops are at least by the model of the identified axis, and that in words."""
    plant, identified = basis.identified.plants[k], basis.identified.found[k]
    why = "the axis was not identified" if identified is None else why_unbounded(identified)
    if bench.target.linked:
        why = "the model is of this axis alone, and all axes of its machine share what it moves"
    if why or plant is None or identified is None:
        return {}, f"the identified model gives no bound of the margins: {why}"
    every = at_least_by_model(bench.target.device, plant, identified, gains)
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


def tell_bounds(journal: Journal, loop: str, found: Margins, least: AtLeast) -> None:
    """Add notes, or reservations if they are small, of the lower bounds of margins that were not measured."""
    for name, value, bound, unit in (
        ("phase", found.phase_deg, least.phase_deg, "degrees"),
        ("gain", found.gain_db, least.gain_db, "dB"),
    ):
        if not math.isfinite(value) and math.isfinite(bound):
            tell = journal.reserve if bound < CLOSE[name] else journal.note
            tell(
                f"the {loop} loop's {name} margin was not measured; it is at least {bound:.0f} {unit} by the model "
                "fitted to the response, with its 95 % intervals"
            )
