"""Tunes the gains of the closed loop of a stepper drive by trials that overload the motor.

Stop on stall and CoolStep are off during the trials: the first would stop the motor before the loop can catch up, the
second would change the overload. The loop is left open; a user who closes it later finds the gains set.
"""

from __future__ import annotations

import numpy as np

from drive_env.devices.gain_set import LOAD_ANGLE
from drive_env.dictionary.roles import Role
from drive_env.drives.raw_gains import write_gains
from drive_env.trials.load_reading import LOWER
from mechanics.arrays import Floats, Integers, Mask
from tuning.search.optimise import Optimised, Settings, optimise
from tuning.search.trial_bench import TrialBench
from tuning.stepper.load_detection import LoadDetection
from tuning.target import Target

TRIALS = 24
REPEATS = 4  # of the commissioned and of the found gains, by which the better ones are chosen
BEFORE, AFTER = "J of the closed loop, by commissioning", "J of the closed loop, tuned"
LOOP_FIGURES = (BEFORE, AFTER)


def tune_loop(target: Target, detection: LoadDetection, roles: dict[Role, tuple[int, int]]) -> dict[str, Floats]:
    """Write the gains of the closed loop into the result of load detection; return `LOOP_FIGURES`, shape (num_axes,).

    Axes whose found gains are not better in repeated trials keep the commissioned ones, with a reservation.

    Args:
        target: The drives, enabled, with open loop.
        detection: Result of load detection in open loop.
        roles: Objects of the speeds of load detection and CoolStep.
    """
    drives, known = target.drives, target.device.gains
    loop = known.loop_of_kind(LOAD_ANGLE)
    assert loop is not None, "a drive that closes such a loop"
    names = tuple(loop.gains)
    columns = known.columns(names)
    speeds = {role: drives.read(role) for role in roles}
    lower = known.column(*LOWER)
    try:
        if Role.STALL_SPEED in roles:
            drives.write(Role.STALL_SPEED, 0)
        if lower is not None:  # CoolStep with a start speed of 0 is always active
            drives.write(known.keys[lower], 0)
        found = optimise(target, Settings(trials=TRIALS, gains=names, safe=bool(target.bus)))
        others = _best_others(found, target.axes_per_machine)
        before, after, (stood, held) = _compared(target, names, others)
    finally:
        write_gains(drives, detection.gains)
        for role, values in speeds.items():
            drives.write(role, values)
    better = held & (~stood | (after < before))
    tuned = np.repeat(better, target.axes_per_machine)
    detection.gains[:, columns] = np.where(tuned[:, None], others[:, columns], detection.gains[:, columns])
    useless = np.repeat(~stood & ~held, target.axes_per_machine)
    for k in np.flatnonzero(detection.found.going() & useless):
        detection.found.reservations[k].append(
            "the closed loop is not certified: its trials were stopped, with the gains of commissioning and with "
            f"the best of {TRIALS} others; leave it open ({_register(target)} = 0), or find out why it does not hold"
        )
    for k in np.flatnonzero(detection.found.going() & ~tuned & ~useless):
        detection.found.reservations[k].append(
            f"the gains of the closed loop are as they were: none of {TRIALS} others that were tried was better in "
            f"{REPEATS} more trials of each"
        )
    figures = {BEFORE: np.where(stood, np.exp(before), np.nan), AFTER: np.where(better, np.exp(after), np.nan)}
    return {name: np.repeat(values, target.axes_per_machine) for name, values in figures.items()}


def _best_others(found: Optimised, axes: int) -> Integers:
    """Return each machine's best gains other than the commissioned ones, which may have won by noise."""
    gains = found.gains.copy()
    for machine in range(len(found.cost)):
        own = slice(machine * axes, (machine + 1) * axes)
        rows = [row for row in found.rows if row.search == machine and row.accepted]
        others = [row for row in rows if not np.array_equal(row.gains, found.rule[own])]
        if others:
            gains[own] = min(others, key=lambda row: row.cost).gains
    return gains


def _register(target: Target) -> str:
    index, sub = target.device.roles[Role.LOOP_MODE]
    return f"{index:04X}h:{sub:02X}"


def _compared(target: Target, names: tuple[str, ...], gains: Integers) -> tuple[Floats, Floats, tuple[Mask, Mask]]:
    """Try the commissioned gains and others again; return the mean ln J of both, and where each was never stopped.

    The best trial of a search was also favoured by its noise, so one trial proves little. Trials alternate in
    direction.
    """
    bench = TrialBench(target, gains=names)
    bench.identify()
    costs: list[list[Floats]] = [[], []]
    held = np.ones((2, bench.num_machines), bool)
    for repeat in range(REPEATS):
        for which in (0, 1) if repeat % 2 == 0 else (1, 0):
            tried = bench.run(gains if which else bench.rule)
            costs[which].append(tried.cost)
            held[which] &= ~(tried.aborted | tried.fragile if which else tried.aborted)
    bench.leave(gains)
    before, after = (np.mean(one, axis=0) for one in costs)
    return before, after, (held[0], held[1])
