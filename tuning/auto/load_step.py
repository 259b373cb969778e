"""The response of axes at standstill to a load step: on emulated machines only, for a certificate.

A load step cannot be applied to hardware. It identifies nothing, but gains with which an axis does not come to rest
after it are rejected.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import detrend

from drive_env import cia402, motion
from drive_env.drives.currents import ampere_per_count
from drive_env.drives.interface import CYCLE, machine_of
from drive_env.trials import response
from drive_env.trials.positioning import wrapped
from mechanics.arrays import Mask
from tuning.certificate.certificate import StepResponse

if TYPE_CHECKING:
    from tuning.target import Target

NAME = "load step of 0.3 rated torque at standstill"
SHARE = 0.3  # of the rated torque
RECOVERED = 0.05  # of the dip: recovery band
# s: wait for standstill; recording before and after the step; and its last part, in which the axis must be at rest.
REST, BEFORE, AFTER, LOOKED_AT = 0.1, 0.02, 0.3, 0.1
SWING = "current at rest afterwards, RMS [% of rated]"
NOISE = "noise of the current's measurement, RMS [% of rated]"  # added if the swing is above its limit


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
