"""Recorded moves with the new gains and the gains before, load steps, and whether axes are at rest afterwards.

A load step cannot be applied to hardware: only emulated machines get one. It identifies nothing, but gains with which
an axis does not come to rest after it are rejected.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import detrend

from drive_env import cia402, motion
from drive_env.drives.currents import ampere_per_count
from drive_env.drives.interface import CYCLE, machine_of
from drive_env.drives.raw_gains import write_gains
from drive_env.safety.envelope import SafetyError
from drive_env.trials import response
from drive_env.trials.positioning import wrapped
from mechanics.arrays import Mask
from tuning.auto.bench import PREVIOUS_GAINS_TIME
from tuning.auto.loop_margins import measured_axis
from tuning.auto.loop_model import loop_models
from tuning.auto.proving import RESTLESS, without_noise
from tuning.certificate.certificate import StepResponse

if TYPE_CHECKING:
    from tuning.auto.bench import AutoBench
    from tuning.auto.stages import Basis, RecordedGains
    from tuning.target import Target

NAME = "load step of 0.3 rated torque at standstill"
SHARE = 0.3  # of the rated torque
RECOVERED = 0.05  # of the dip: recovery band
# s: wait for standstill; recording before and after the step; and its last part, in which the axis must be at rest.
REST, BEFORE, AFTER, LOOKED_AT = 0.1, 0.02, 0.3, 0.1
SWING = "current at rest afterwards, RMS [% of rated]"
NOISE = "noise of the current's measurement, RMS [% of rated]"  # added if the swing is above its limit
STEP_TIME = 1.0  # s of drive time for a step of the set-point
CALMING = 0.5  # s for an oscillation after a load step to decay with calm gains
BY_COMPARISON = "by a move, which was better than with the new ones: the gains before are kept"


def record_final_move(bench: AutoBench, recorded: RecordedGains, where: Mask) -> RecordedGains:
    """Record a move of axes with their gains, and check whether they are at rest afterwards."""
    going = bench.target.together(where & bench.going)
    if not going.any():
        return recorded
    failed = recorded.failed.copy()
    try:
        with bench.spending(going):
            shown = bench.ground.show(recorded.gains, going)
    except SafetyError as error:
        bench.recover(going)
        failed[going] = f"the envelope stopped the move with the new gains: {error}"
        return replace(recorded, failed=failed)
    swing = np.where(going, without_noise(shown.swing, shown.noise), recorded.swing)
    faults = bench.faults()
    for k in map(int, np.flatnonzero(going)):
        failed[k] = f"the move with the new gains failed: {shown.reason[k]}" if shown.reason[k] else ""
        if k in faults:
            failed[k] = f"the drive went into fault in the move with the new gains: {faults[k]}"
        elif not failed[k] and shown.restless[k]:
            failed[k] = f"it does not come to rest: {_shook(shown.swing[k], shown.noise[k], 'at rest')}"
    bench.recover_faults(faults, "moving with the new gains")
    shown = shown if recorded.shown is None else recorded.shown.replaced(shown)
    return replace(recorded, shown=shown, failed=failed, swing=swing)


def step(bench: AutoBench, recorded: RecordedGains, where: Mask) -> RecordedGains:
    """Make a small step of the set-point in csp with the gains of axes, and record the overshoot."""
    going = bench.whole_machines(where & bench.going & (recorded.failed == "")) & bench.affordable(STEP_TIME)
    if not going.any():
        return recorded
    try:
        with bench.spending(going):
            overshoot = bench.ground.step(recorded.gains, going)
    except SafetyError as error:
        bench.note(going, f"the envelope stopped a step of the set-point in csp: {error}")
        bench.recover(going)
        overshoot = np.full(len(going), np.nan)
    return replace(recorded, overshoot=np.where(going, overshoot, recorded.overshoot))


def _shook(swing: float, noise: float, when: str) -> str:
    """Describe the swing of a current over the rated one."""
    told = f"its current swung by {100.0 * swing:.1f} % of the rated current (RMS) {when}"
    if noise > 0.0:
        alone = float(without_noise(swing, noise))
        told += f", {100.0 * alone:.1f} % without the noise of its measurement"
    return f"{told}; {100.0 * RESTLESS:.0f} % is allowed"


def load(bench: AutoBench, basis: Basis, recorded: RecordedGains, target: Target, where: Mask) -> RecordedGains:
    """Make a load step on emulated machines: axes that oscillate after it fail.

    Args:
        bench: The drives.
        basis: Has gains that damp an oscillation.
        recorded: The gains, and their move.
        target: The drives with time that is not counted, since a load step is not part of tuning.
        where: Axes to check, (num_axes,).
    """
    still = bench.whole_machines(where & bench.going & (recorded.failed == ""))
    if target.drives.machine is None or not still.any():
        return recorded
    write_gains(target.drives, recorded.gains, still)
    loaded = {**recorded.loaded, **load_step(target, still)}
    swing, failed, most = np.zeros(len(still)), recorded.failed.copy(), recorded.swing.copy()
    swing[still] = [0.01 * loaded[int(k)].figures[SWING] for k in np.flatnonzero(still)]
    if (large := swing > RESTLESS).any():
        noise = bench.ground.noise(recorded.gains, large)
        alone = without_noise(swing, noise)
        shook = large & (alone > RESTLESS)
        for k in map(int, np.flatnonzero(large)):
            loaded[k] = replace(loaded[k], figures={**loaded[k].figures, NOISE: 100.0 * float(noise[k])})
        for k in map(int, np.flatnonzero(shook)):
            told = _shook(swing[k], noise[k], "after a load step of 0.3 of the rated torque")
            failed[k], most[k] = f"it does not come to rest: {told}", alone[k]
        if shook.any():
            # The oscillation must have decayed before the next gains are judged.
            write_gains(target.drives, basis.calm, bench.target.together(shook))
            target.drives.advance(CALMING)
    return replace(recorded, loaded=loaded, failed=failed, swing=most)


def record_previous_gains(bench: AutoBench, basis: Basis, recorded: RecordedGains) -> RecordedGains:
    """Record a move with the gains before if these are safe by the model; keep them if they are better."""
    going = bench.going
    late = ~bench.affordable(PREVIOUS_GAINS_TIME)
    why = np.where((basis.unsafe == "") & late, "the drive time was used up", basis.unsafe)
    able = bench.whole_machines(going & (why == ""))
    for k in map(int, np.flatnonzero(going & ~able)):
        told = why[k] or "another axis of its machine cannot make it"
        bench.journals[k].note(f"no comparison move with the gains before: {told}")
    if not able.any():
        return recorded
    try:
        with bench.spending(able):
            earlier = bench.ground.show(basis.before, able)
    except SafetyError as error:
        bench.note(able, f"the envelope stopped the move with the gains before: {error}")
        return recorded
    failed = able & (np.array(earlier.reason, object) != "")
    for k, causes in bench.faults().items():
        if able[k]:
            # The gains before caused the fault, which favours the new ones.
            failed[k] = True
            bench.journals[k].note(f"the drive went into fault in the move with the gains before: {causes}")
        else:
            bench.journals[k].stop(f"the drive went into fault while holding its position: {causes}")
    for k in map(int, np.flatnonzero(failed)):
        if earlier.reason[k]:
            bench.journals[k].note(f"in the move with the gains before, {earlier.reason[k]}")
    if failed.any():
        bench.recover(failed)
    comparable = bench.whole_machines(able & ~failed) & bench.going
    return keep_what_is_better(bench, basis, replace(recorded, earlier=earlier), comparable)


def keep_what_is_better(bench: AutoBench, basis: Basis, recorded: RecordedGains, where: Mask) -> RecordedGains:
    """Keep the gains before on machines whose loops keep the dynamics at least as well with them and that moved better.

    The worst axis of a machine counts. Loops are judged as measured, and by the model in all variants; if they were not
    measured, the new gains stay. Measurement errors are the same for both gains, so they are ignored.
    """
    assert recorded.shown is not None and recorded.earlier is not None, "both moves are recorded"
    shown, earlier, axes = recorded.shown, recorded.earlier, bench.target.axes_per_machine
    slack = np.full(len(where), np.nan)
    for k in map(int, np.flatnonzero(where)):
        if (measured := measured_axis(bench, basis, recorded, k)) is not None:
            slack[k] = measured.slack(bench.dynamics, basis.before[k][None])[0]
    of_before, of_new = slack.copy(), recorded.slack.copy()
    for model, own in loop_models(bench.target, basis.identified, recorded, where, bench.dynamics):
        for known, gains in ((of_before, basis.before), (of_new, recorded.gains)):
            known[own] = np.minimum(known[own], model.slack(bench.dynamics, gains[own][None])[0])
    now, before = (np.repeat(one.cost.reshape(-1, axes).max(axis=1), axes) for one in (shown, earlier))
    # Gains with which an axis oscillates at rest are never kept.
    kept = where & (before < now) & ~np.repeat(earlier.restless.reshape(-1, axes).any(axis=1), axes)
    kept = bench.whole_machines(kept & (of_before >= np.fmin(of_new, 0.0)))
    if not kept.any():
        return recorded
    for k in map(int, np.flatnonzero(kept)):
        bench.journals[k].undo(recorded.gains[k], basis.before[k], "the gains before are kept")
        bench.journals[k].note(
            f"the gains before are kept: the measured cost J of a move was {now[k]:.2f} with the new gains and "
            f"{before[k]:.2f} with the gains before"
        )
    return replace(
        recorded,
        gains=np.where(kept[:, None], basis.before, recorded.gains),
        proof=np.where(kept, earlier.cost, recorded.proof),
        slack=np.where(kept, slack, recorded.slack),
        overshoot=np.where(kept, np.nan, recorded.overshoot),
        verified=np.where(kept, BY_COMPARISON, recorded.verified),
        shown=shown.replaced(earlier._replace(where=kept)),
        earlier=earlier._replace(where=earlier.where & ~kept),
        kept=kept,
    )


def load_step(target: Target, where: Mask) -> dict[int, StepResponse]:
    """Return the response of emulated axes to a load step with their present gains; restore the enabled state.

    Load steps of both signs are applied; the first is recorded, the swing is the greatest of all four rests.

    Args:
        target: Emulated machines.
        where: Axes, shape (num_axes,); only those of machines all of whose axes are chosen take part.
    """
    from mechanics.shaft import one, way

    drives = target.drives
    per_count = ampere_per_count(drives)
    machines = where.reshape(-1, target.axes_per_machine).all(axis=1)
    axes = np.repeat(machines, target.axes_per_machine)
    if not axes.any():
        return {}
    machine = machine_of(drives)
    packed = one(machine.load)
    # The torque acts on the load: at the axis with the longest lever it equals the share.
    lever = float(np.abs(way(packed).joints @ packed.plant.disturbance[:, 0]).max())
    off = axes & ~cia402.matches(drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED)
    motion.enable(drives, mode="pp", where=axes)
    drives.advance(REST)
    try:
        rest = drives.record([cia402.POSITION_ACTUAL, cia402.TORQUE_ACTUAL], BEFORE)
        windows = []
        # Both signs, each with and without the load: an axis with backlash may swing in one and rest in the other.
        for share in (-SHARE, 0.0, SHARE, 0.0):
            machine.load_torque = np.where(machines, share * target.motor.rated_torque / lever, 0.0)
            windows.append(drives.record([cia402.POSITION_ACTUAL, cia402.TORQUE_ACTUAL], AFTER))
    finally:
        machine.load_torque = 0.0
        drives.advance(REST)
        if off.any():
            motion.disable(drives, where=off)
    loaded = windows[0]
    raw = np.concatenate([rest[cia402.POSITION_ACTUAL], loaded[cia402.POSITION_ACTUAL]])
    angle = wrapped(raw - raw[0]) / target.increments()
    current = np.concatenate([rest[cia402.TORQUE_ACTUAL], loaded[cia402.TORQUE_ACTUAL]]) * per_count
    t = np.arange(len(angle), dtype=np.float64) * CYCLE
    # The drift of an integrator that has not settled yet is no oscillation.
    ends = [
        detrend(per_count * window[cia402.TORQUE_ACTUAL][-round(LOOKED_AT / CYCLE) :], axis=0).std(axis=0)
        for window in windows
    ]
    swing = np.max(ends, axis=0) / target.motor.rated_current
    found = response.disturbance_metrics(t, angle, np.zeros(target.num_axes), t_load=BEFORE, band=RECOVERED)
    return {
        axis: StepResponse(
            NAME, True, "rad", t, np.zeros(len(t)), angle[:, axis], current[:, axis],
            {
                "greatest dip of the rotor [turns]": float(found.dip[axis]) / (2.0 * math.pi),
                "recovery to within 5 % of the dip [ms]": 1e3 * float(found.recovery_time[axis]),
                SWING: 100.0 * float(swing[axis]),
            },
        )
        for axis in map(int, np.flatnonzero(axes))
    }  # fmt: skip
