"""Automatic commissioning of an open-loop stepper: currents, StallGuard threshold, CoolStep; certified or rolled back.

All axes at the same time go through the steps of manual commissioning: identify the load by the load angle, set the run
current for it, move at the working speed, raise the threshold until the load reading is above 0 and falls to 0 before
the pull-out, let CoolStep reduce the current, and prove that no step is lost. The state before is saved to a file
before anything changes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np

from drive_env import cia402, motion
from drive_env.devices.gain_set import LOAD_ANGLE
from drive_env.dictionary.roles import Role
from drive_env.drives.raw_gains import read_gains, write_gains
from drive_env.drives.speeds import per_increment
from drive_env.phase_current import amplitude, holding_torque, run_and_standby
from drive_env.trials.load_reading import LOWER, STALL_ANGLE, has_coolstep, lacks_load_detection
from drive_env.trials.open_loop import encoder_age
from drive_env.trials.working_moves import WorkingMoves
from mechanics.arrays import Floats, Integers, Mask
from tuning.lateness import told_lateness
from tuning.search.optimise import Settings
from tuning.search.samplers import load
from tuning.search.trial_bench import TrialBench
from tuning.snapshot import Transaction, can_store, restore
from tuning.stepper.closed_loop import LOOP_FIGURES, tune_loop
from tuning.stepper.load_detection import LoadDetection
from tuning.stepper.obstacle import OBSTACLE_RISE, REACTION, RISE, can_load, prove_with_load, why_not_loaded
from tuning.stepper.result import StepperAxis, StepperResult, figure
from tuning.target import Target, timed

Progress = Callable[[str, float], None]
Files = Callable[[StepperResult], AbstractContextManager[object]]

WORKING_SHARE = 0.7  # of the motor's corner speed: still with full current, and with a clear back-EMF
ACCELERATION_SHARE = 0.3  # of the holding torque at the run current
# Pairs of both, tried in this order for axes that fail: with much friction or little current a motor loses steps.
WORK = ((WORKING_SHARE, ACCELERATION_SHARE), (0.5, 0.15), (0.35, 0.2))
MOST_ACCELERATION = 2000.0  # rad/s^2
PROFILE_SHARE = 0.95  # of the greatest acceleration that the drive accepts
REACH_SHARE, LONGEST = 0.9, 100.0  # of the travel, and at most [rad]
MOST_LOST = 3.0  # teeth until a stall must have stopped the motor


def check_stepper(target: Target) -> None:
    """Import the search's packages; ValueError, before anything moves, for drives without adjustable load detection."""
    if lacks := lacks_load_detection(target.device):
        raise ValueError(
            f"{target.device.name}: the load detection of this drive cannot be set: {lacks}; drive-tune sweep and "
            "auto --by tpe find its phase currents by trials"
        )
    load(Settings().sampler)


def commission(
    target: Target, file: str | Path, *, keep: bool = True, progress: Progress | None = None, files: Files = nullcontext
) -> StepperResult:
    """Commission the axes of a target; an axis that fails a check is rolled back, with the reason in the result.

    Args:
        target: The drives; they are off afterwards.
        file: File for the state before.
        keep: Whether drives on a bus store the settings.
        progress: Called with the present step, and the share that is done.
        files: As in `tuning.auto.one_button.auto`.

    Raises:
        ValueError: For a drive without load detection, before anything is written.
        BusError: If the drives can no longer be reached; OSError if a file cannot be written.
    """
    check_stepper(target)
    say = progress or (lambda what, share: None)
    with Transaction(target, file) as transaction, timed(target) as (watched, clock):
        say("identifying", 0.0)
        on = cia402.matches(target.drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED)
        if on.any():
            motion.disable(target.drives, where=on)
        before, roles = read_gains(target.drives), _roles(target)
        bench = TrialBench(watched)
        bench.identify()
        say("trying the currents", 0.15)
        gains, weakness = _currents(bench)
        detection, proof_figures = _commissioned(bench, watched, gains, weakness, say)
        found = detection.found
        if target.device.gains.loop_of_kind(LOAD_ANGLE) is not None and found.going().any():
            say("tuning the closed loop", 0.9)
            proof_figures |= tune_loop(watched, detection, roles)
        say("writing", 0.95)
        accepted = found.going()
        _leave(bench, transaction, detection, accepted, roles)
        kept = keep and bool(accepted.any()) and can_store(target)
        settings = [_settings(k, transaction, target, roles) for k in range(target.num_axes)]
        result = StepperResult(
            tuple(
                _axis(k, target, bench, before, detection, proof_figures, settings[k]) for k in range(target.num_axes)
            ),
            target.device.name, target.motor.name, target.machine, float(found.speed.max()), clock.seconds,
            transaction.path, kept, can_load(target), target.axis_numbers, target.inputs,
        )  # fmt: skip
        with files(result):
            if kept:
                transaction.store(accepted)
        transaction.commit(accepted)
    say("done", 1.0)
    return result


def _commissioned(
    bench: TrialBench, target: Target, gains: Integers, weakness: Sequence[str], say: Progress
) -> tuple[LoadDetection, dict[str, Floats]]:
    """Commission axes at the working speed, those that fail there at a lower one, with a note; return all results."""
    weak = np.array([bool(reason) for reason in weakness])
    detection, figures = _found_at(bench, target, gains, ~weak, WORK[0], say)
    for k in map(int, np.flatnonzero(weak)):
        detection.found.reasons[k] = weakness[k]
    for work in WORK[1:]:
        left = ~detection.found.going() & ~weak
        if not left.any():
            break
        drives = target.drives
        drives.advance(REACTION)  # an axis that failed may be in fault and braking
        bench.trials.recover(left)
        write_gains(drives, gains, left)
        other, measured = _found_at(bench, target, gains, left, work, say)
        better = left & other.found.going()
        for k in map(int, np.flatnonzero(better)):
            other.found.reservations[k].append(
                f"the working speed is {other.found.speed[k]:.3g} rad/s, with ramps of {work[1]:g} of the holding "
                f"torque: at {detection.found.speed[k]:.3g} rad/s {detection.found.reasons[k]}"
            )
        detection.take(other, better)
        figures = {name: np.where(better, measured[name], values) for name, values in figures.items()}
    return detection, figures


def _found_at(
    bench: TrialBench, target: Target, gains: Integers, where: Mask, work: tuple[float, float], say: Progress
) -> tuple[LoadDetection, dict[str, Floats]]:
    """Find and prove the settings of some axes at a share of the speed, with ramps of a share of the torque."""
    speed = work[0] * min(target.speed, target.motor.rated_speed)
    moves = _moves(bench, gains, work[1])
    detection = LoadDetection(target.drives, target.motor, moves, gains, speed)
    found = detection.found
    found.reject(~where, "it takes no part in these moves")
    short = np.abs(moves.reach) < moves.least_reach(speed)
    for k in np.flatnonzero(short):
        found.reject(
            np.arange(target.num_axes) == k,
            f"the travel is too short: {abs(moves.reach[k]):.2g} rad to go, and {moves.least_reach(speed)[k]:.2g} "
            f"rad are needed for the load reading at {speed:.3g} rad/s; allow more with --travel",
        )
    if found.going().any():
        say("finding the StallGuard threshold", 0.3)
        detection.find_threshold()
    if found.going().any() and has_coolstep(target.device):
        say("finding the CoolStep setting", 0.6)
        detection.find_coolstep()
    if found.going().any():
        say("proving", 0.8)
        detection.prove()
    return detection, _prove(target, detection, moves, speed)


def _currents(bench: TrialBench) -> tuple[Integers, list[str]]:
    """Return the rule's currents, or the rated ones if those lose steps in a trial, and why axes fail with both."""
    axes = bench.target.axes_per_machine
    tried = bench.run(bench.rule)
    gains = np.where(np.repeat(tried.aborted, axes)[:, None], bench.safe, bench.rule)
    if tried.aborted.any():
        tried = bench.run(gains)
    write_gains(bench.target.drives, gains)
    reasons = [""] * bench.target.num_axes
    for k in map(int, np.flatnonzero(np.repeat(tried.aborted, axes))):
        told = f"; the drive reported {tried.causes[k // axes]}" if tried.causes[k // axes] else ""
        reasons[k] = f"it loses steps or goes into fault in trials with the motor's rated current{told}"
    return gains, reasons


def _moves(bench: TrialBench, gains: Integers, share: float) -> WorkingMoves:
    target = bench.target
    torque = share * holding_torque(target.motor, run_and_standby(target.device, gains)[0])
    reach = np.clip(REACH_SHARE * np.nan_to_num(bench.reach, posinf=LONGEST, neginf=-LONGEST), -LONGEST, LONGEST)
    # The drive's profiles have a greatest acceleration, too.
    entry = target.device.new_dictionary().find(cia402.PROFILE_ACCELERATION)
    assert entry.high is not None, "an acceleration is a number"
    counts = target.increments() * per_increment(target.drives, cia402.PROFILE_ACCELERATION)
    most = np.minimum(MOST_ACCELERATION, PROFILE_SHARE * entry.high / counts)
    acceleration = np.minimum(torque / bench.identified.inertia, most)
    # A trial may have ended away from the first positions; the reach counts from those.
    return WorkingMoves(
        target.drives, target.motor, bench.trials, bench.began, reach, acceleration, target.increments(),
        encoder_age(target.device),
    )  # fmt: skip


def _prove(target: Target, detection: LoadDetection, moves: WorkingMoves, speed: float) -> dict[str, Floats]:
    """Prove the settings with a load and an obstacle, or add a reservation that this was not done."""
    found = detection.found
    lost = np.full(target.num_axes, np.nan)
    if not can_load(target):
        for k in np.flatnonzero(found.going()):
            found.reservations[k].append(
                f"stop on stall was not proved with a load and an obstacle: {why_not_loaded(target)}; hold the shaft "
                f"in a slow move and see whether it stops (above {found.stop_speed[k]:.3g} rad/s)"
            )
        return {"lost": lost}
    going = found.going()
    if going.any():
        run, _ = run_and_standby(target.device, detection.gains)
        proof = prove_with_load(target, moves, speed, run, going)
        lower = target.device.gains.column(*LOWER)
        if lower is not None and (cooled := going & ~proof.withstood & (detection.gains[:, lower] > 0)).any():
            detection.leave_coolstep_off(
                cooled, f"with it a load of 30 % of the holding torque, which comes within {RISE:g} s, stops the axis"
            )
            proof = prove_with_load(target, moves, speed, run, going)
        for k in np.flatnonzero(going & ~proof.withstood):
            told = f"; the drive reported {proof.causes[k]}" if proof.causes[k] else ""
            found.reasons[k] = f"it stops or loses steps with a load of 30 % of the holding torque{told}"
        found.reject(going & ~proof.stopped, "an obstacle does not stop it: no stall was seen before steps were lost")
        lost = np.where(proof.stopped, proof.lost, np.nan)
        for k in np.flatnonzero(found.going() & (proof.lost > MOST_LOST)):
            found.reservations[k].append(
                f"at an obstacle the rotor slipped by {proof.lost[k]:.0f} teeth before the stall stopped it: home it "
                "after a stall"
            )
    return {"lost": lost}


def _roles(target: Target) -> dict[Role, tuple[int, int]]:
    """Return the objects that are set in addition to the gains."""
    return {
        role: target.device.roles[role]
        for role in (Role.STALL_SPEED, Role.COOLSTEP_SPEED)
        if role in target.device.roles
    }


def _leave(
    bench: TrialBench,
    transaction: Transaction,
    detection: LoadDetection,
    accepted: Mask,
    roles: dict[Role, tuple[int, int]],
) -> None:
    """Leave the accepted axes with their settings and everything else restored, disabled.

    A stall above their 20A4h speed then stops them; the speed of a CoolStep that is off is restored.
    """
    drives, gains = bench.target.drives, detection.gains
    lower = bench.target.device.gains.column(*LOWER)
    everywhere = np.ones(bench.target.num_axes, bool)
    if bench.trials.down().any():  # a failed axis is in fault
        drives.advance(REACTION)
        bench.trials.recover(everywhere)
    motion.disable(drives, where=~bench.trials.down())
    speeds = {role: drives.read(role) for role in roles}
    bench.trials.leave()
    if not accepted.any():
        return
    axes = []
    for k, values in enumerate(transaction.before.axes):
        wanted = dict(values)
        wanted |= {key: int(gains[k, column]) for column, key in enumerate(bench.target.device.gains.keys)}
        is_cooled = lower is not None and gains[k, lower] > 0
        wanted |= {
            key: int(speeds[role][k]) for role, key in roles.items() if role is not Role.COOLSTEP_SPEED or is_cooled
        }
        axes.append(wanted)
    restore(drives, replace(transaction.before, axes=tuple(axes)), accepted, whole=False)


def _axis(
    k: int,
    target: Target,
    bench: TrialBench,
    before: Integers,
    detection: LoadDetection,
    proof: dict[str, Floats],
    settings: dict[str, dict[str, int]],
) -> StepperAxis:
    found, names, constant = detection.found, target.device.gains.names, target.motor.torque_constant
    reason = found.reasons[k]
    after = before[k] if reason else detection.gains[k]
    known = target.device.gains
    run = known.column("current", "amplitude")
    assert run is not None, "an open loop has a run current"
    identified, is_loaded = bench.identified, math.isfinite(proof["lost"][k])
    figures = {
        "inertia [kg m^2]": figure(identified.inertia[k]),
        "dry friction [N m]": figure(identified.coulomb[k] * constant),
        "constant load [N m]": figure(identified.offset[k] * constant),
        "working speed [rad/s]": figure(found.speed[k]),
        "run current [A]": figure(float(amplitude(target.device, after[run]))),
        "load angle at the working speed [deg electrical]": figure(float(np.degrees(found.angle[k]))),
        "load reading of the axis' own load": figure(found.margin[k]),
        "load angle at which the reading is to be 0 [deg electrical]": figure(float(np.degrees(STALL_ANGLE))),
        "stop on stall above [rad/s]": figure(found.stop_speed[k]),
        "current saved by CoolStep, by the load angle [%]": figure(100.0 * found.saved[k]),
        "load of 30 % that does not stop it came within [s]": figure(RISE if is_loaded else math.nan),
        "obstacle that stops it came within [s]": figure(OBSTACLE_RISE if is_loaded else math.nan),
        "teeth lost at an obstacle": figure(proof["lost"][k]),
    }
    figures |= {name: figure(values[k]) for name, values in proof.items() if name in LOOP_FIGURES}
    return StepperAxis(
        dict(zip(names, map(int, before[k]), strict=True)), dict(zip(names, map(int, after), strict=True)), reason,
        (*found.reservations[k], *filter(None, [told_lateness(target.drives)])), figures, settings,
    )  # fmt: skip


def _settings(
    k: int, transaction: Transaction, target: Target, roles: dict[Role, tuple[int, int]]
) -> dict[str, dict[str, int]]:
    """Return the values before and now of an axis' objects other than gains; equal ones for a rejected axis."""
    return {
        f"{index:04X}:{sub:02X}": {
            "before": transaction.before.axes[k][index, sub], "after": int(target.drives.read(role)[k]),
        }
        for role, (index, sub) in roles.items()
    }  # fmt: skip
