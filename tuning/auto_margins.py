"""The frequency response of the velocity loop with the new gains: what comes too near to instability is calmed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env.gains import Gains, scaled, write_gains
from drive_env.master.errors import BusError
from drive_env.safety.envelope import SafetyError
from tuning.auto_moves import show
from tuning.auto_run import MOVE_TIME, TRIAL_TIME
from tuning.auto_trials import BY_TRIAL, FOLLOWING_WINDOW, watch_following
from tuning.margins import hidden_crossing, margins
from tuning.measured_loop import COHERENT

if TYPE_CHECKING:
    from tuning.auto_run import Run
    from tuning.measured_loop import MeasuredLoop

Mask = NDArray[np.bool_]

LEAST_LINES = 10  # of a frequency response, that are worth a judgement
SENSITIVITY = 4.0  # greatest |1/(1+L)| that a measured velocity loop may have: 14 degrees, 2.5 dB from instability
SOFTER = (1.0, 0.85, 0.7, 0.6, 0.5)  # factors of velocity P and position P by which a lively loop is calmed
CALMED = [Gains._fields.index(name) for name in ("velocity_p", "position_p")]
LEAST_WAY = 1e-3  # rad; an axis without any way is shaken as little as can be, and its response says so
ALONE = (
    "its response is that of an axis that moves alone what all axes of its machine share, with the others let go: with "
    "all of them moving it the loop's gain is higher, and the gain margin less, by as much as their share"
)
FREE_WINDOW = 100  # turns of following error that trip a frequency response: it means nothing there


def measure(run: Run) -> None:
    """Measure the velocity loop's response with the new gains; what comes too near to instability is calmed."""
    going = run.going
    # A move with the gains before matters more: without it nobody knows whether the new ones are better.
    late = going & ~run.affordable(run.response_time + run.look_back_time)
    _without_response(run, late, "the drive time was used up")
    going &= ~late
    if not going.any():
        return
    from tuning import frequency_response

    drives = run.target.drives
    # Trials have left the axes somewhere in their travel: what is left of it is counted from there.
    low, high = run.room()
    here = replace(run.target, low=low, high=np.maximum(high, LEAST_WAY))
    write_gains(drives, run.gains, going)
    drives.write(FOLLOWING_WINDOW, FREE_WINDOW * drives.read((0x2058, 0)), where=going)
    try:
        with run.spending(going):
            run.response = response = frequency_response.measure(here, "velocity", where=going)
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


def _calm(run: Run, k: int, response: MeasuredLoop) -> bool:
    """Lower the gains of an axis whose measured loop comes too near to instability; return whether it was so.

    The loop scales with P.
    """
    axis, f, L = run.axes[k], response.f, response.open_loop[:, k]
    trusted = response.trusted[:, k]
    if trusted.sum() < LEAST_LINES:
        why = f"{int(trusted.sum())} of its lines are coherent, and {LEAST_LINES} are needed"
        _without_response(run, np.arange(run.target.num_axes) == k, "; ".join([why, *response.notes[k]]))
        return False
    for factor in SOFTER:
        found = margins(f, factor * L, trusted)
        if found.ms <= SENSITIVITY:
            break
    else:
        axis.reason = f"the measured loop is {found.ms:.1f} times as sensitive as an open one: {SENSITIVITY:g} is most"
        return False
    axis.margins = found
    if (hidden := hidden_crossing(f, factor * L, trusted)) is not None:
        axis.notes.append(
            f"no phase margin is told: the gain passes 1 between {hidden[0]:.0f} and {hidden[1]:.0f} Hz, where the "
            f"coherence is below {COHERENT:g}"
        )
    if run.target.linked:
        axis.notes.append(ALONE)
    axis.verified = f"{BY_TRIAL}; and by the measured frequency response of the velocity loop, Ms {found.ms:.1f}"
    if factor == 1.0:
        return False
    softer = run.gains[k].copy()
    softer[CALMED] = scaled(softer[CALMED], factor)
    run.gains[k], run.spare[k] = softer, 0  # the second best would be as near
    axis.notes.append(
        f"calmed to {100.0 * factor:.0f} %: the measured loop came too near to instability; margins are computed "
        "from that response"
    )
    return True


def _try_again(run: Run, calmed: Mask) -> None:
    """Try gains that were calmed, and record a move with them; without time for a trial, that move must do."""
    where = calmed & run.affordable(TRIAL_TIME + MOVE_TIME + run.look_back_time)
    run.note(calmed & ~where, "a move was the only trial of the calmed gains: the drive time was used up")
    assert run.ground is not None, "proving makes it"
    if where.any():
        with run.spending(run.target.together(where)):
            proof = run.ground.run(run.gains, where)
        for k in map(int, np.flatnonzero(where)):
            axis = run.axes[k]
            axis.proof = float(proof.cost[k])
            if not proof.passed[k]:
                axis.reason = f"the calmed gains failed their trial: {proof.reason[k]}"
    show(run, calmed & run.going)


def _go_on_after_faults(run: Run, faults: Mapping[int, str]) -> None:
    """Have axes move once more that were shaken into a fault: what the gains do by themselves was seen before."""
    where = np.isin(np.arange(run.target.num_axes), list(faults))
    if not where.any():
        return
    for axis, causes in faults.items():
        only = np.arange(run.target.num_axes) == axis
        _without_response(run, only, f"the drive went into fault while it was shaken for it ({causes})")
    assert run.ground is not None, "proving makes it"
    with run.spending(run.target.together(where)):
        run.ground.recover(where)
    run.drop_faults("its frequency response was measured, and stays in it")
    show(run, where & run.going)


def _without_response(run: Run, where: Mask, why: str) -> None:
    """Say why there is no frequency response, and what was verified instead."""
    run.note(where, f"no margins were measured: {why}; verified {BY_TRIAL} instead")
