"""The gains of the loop that a stepper's drive may close, found by trials that overload the motor.

Stop on stall and CoolStep are off meanwhile: the first would end what the loop is to catch up with, the second would
change the overload. The loop is left open; who closes it finds the gains.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drive_env.dictionary.roles import Role
from drive_env.gains import write_gains
from tuning.search.optimise import Settings, optimise
from tuning.stepper.load_detection import LoadDetection
from tuning.target import Target

Floats = NDArray[np.float64]

TRIALS = 16
BEFORE, AFTER = "J of the closed loop, by commissioning", "J of the closed loop, tuned"
LOOP_FIGURES = (BEFORE, AFTER)


def tune_loop(target: Target, detection: LoadDetection, roles: dict[Role, tuple[int, int]]) -> dict[str, Floats]:
    """Put the gains of the closed loop into what load detection has found; return `LOOP_FIGURES`, (num_axes,) each.

    Axes on which every trial was stopped keep what they have, with a reservation.

    Args:
        target: The drives, enabled, the loop open.
        detection: What was found in open loop.
        roles: The speeds of load detection and CoolStep.
    """
    drives, known = target.drives, target.device.gains
    names = tuple(row.name for row in known.closed_rows)
    columns = known.columns(names)
    speeds = {role: drives.read(role) for role in roles}
    try:
        for role in roles:
            drives.write(role, 0)
        found = optimise(target, Settings(trials=TRIALS, gains=names, safe=bool(target.bus)))
    finally:
        write_gains(drives, detection.gains)
        for role, values in speeds.items():
            drives.write(role, values)
    axes = target.axes_per_machine
    began = np.array([next(row.cost for row in found.rows if row.search == k) for k in range(len(found.cost))])
    kept = np.array([any(row.accepted for row in found.rows if row.search == k) for k in range(len(found.cost))])
    tuned = np.repeat(kept, axes)
    detection.gains[:, columns] = np.where(tuned[:, None], found.gains[:, columns], detection.gains[:, columns])
    for k in np.flatnonzero(detection.found.going() & ~tuned):
        detection.found.reservations[k].append(
            "the gains of the closed loop are as they were: in every trial the axis oscillated, went into fault, or "
            "its loop did not close"
        )
    cost = np.where(kept, found.cost, np.nan)
    return {BEFORE: np.repeat(np.exp(began), axes), AFTER: np.repeat(np.exp(cost), axes)}
