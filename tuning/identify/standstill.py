"""Winding resistance at rest, from readings without fixed timing: for drives in real time.

With commutation in open loop (2055h) the current of 2004h points along a field at rest, and the rotor aligns with it:
no torque acts and nothing turns. The flux regulator's integrator (`Role.FLUX_ERROR_SUM`) then holds the whole duty,

    V duty = R i + V t_dead f(i)

and between two currents that are large enough for dead time to lose equal voltages, only R remains.
"""

from __future__ import annotations

import numpy as np

from drive_env import cia402
from drive_env.dictionary.roles import Role
from drive_env.drives.currents import ampere_per_count, to_counts
from drive_env.drives.interface import CYCLE
from mechanics.arrays import Floats
from tuning.estimate import Estimate, refused
from tuning.identify.confidence import gain_error, interval, t_quantile
from tuning.identify.encoder_check import able, stay_inside
from tuning.identify.winding import SUPPLY_IDLE, WIDEST
from tuning.identify.working_state import BY_FIELD, Working, enable, still_enabled, switch_off
from tuning.response.dead_time import dead_time
from tuning.stop_causes import stop_causes

LEVELS = (0.9, 0.7, 0.5)  # of the allowed current
ROUNDS = 3  # series of levels, in alternating direction
SETTLE, APART, READINGS = 60, 3, 8  # cycles: until a current is settled; between readings; number of readings
MOST_ERROR = 0.05  # of the current: with a larger mean error it has not settled, or the voltage is too low
MOST_TURN = 0.2  # electrical rad between readings: a rotor that turns further is not held
MODEL = 0.013  # of R, 95 %: effects not modelled, such as sag of the supply and resistance of the switches
GRID = 5  # number of values of dead time tried


def standstill_resistances(working: Working) -> list[Estimate]:
    """Measure every winding's resistance, per phase, or say why that is impossible; axes are off before and after."""
    target, drives = working.target, working.target.drives
    if target.motor.kind == "dc":
        return [refused("ohm", (
            "a brushed motor turns with its current, and while it turns the current regulator's integrator can only "
            "be read in step with the drive: take the data sheet's, or identify an emulator in lockstep (--lockstep)"
        ))] * target.num_axes  # fmt: skip
    where, reasons = able(working)
    if not where.any():
        return [refused("ohm", reason) for reason in reasons]
    commutation, per_count = drives.read(Role.COMMUTATION), ampere_per_count(drives)
    levels = [share for k in range(ROUNDS) for share in LEVELS[:: 1 if k % 2 == 0 else -1]]
    currents, duties, errors, angles = (np.zeros((len(levels), target.num_axes)) for _ in range(4))
    try:
        drives.write(Role.COMMUTATION, BY_FIELD, where=where)
        drives.write(Role.OPEN_LOOP_CURRENT, 0, where=where)
        enable(working, "csv", where)
        for row, share in enumerate(levels):
            raw = to_counts(drives, share * working.current)
            drives.write(Role.OPEN_LOOP_CURRENT, raw, where=where)
            drives.advance(SETTLE * CYCLE)
            stay_inside(working, where)
            for _ in range(READINGS):
                drives.advance(APART * CYCLE)
                duties[row] += drives.read(Role.FLUX_ERROR_SUM) / (READINGS * 32768.0 * 256.0)
                errors[row] += drives.read(Role.FLUX_ERROR) * (per_count / READINGS)
            currents[row] = raw * per_count
            angles[row] = working.angle(drives.read(cia402.POSITION_ACTUAL))
        field = drives.read(Role.FIELD_ANGLE) * (2.0 * np.pi / 65536.0)
        alive = still_enabled(drives.read(cia402.STATUSWORD))
    finally:
        switch_off(drives, where)
        drives.write(Role.OPEN_LOOP_CURRENT, 0, where=where)
        drives.write(Role.COMMUTATION, commutation, where=where)
    found = []
    causes = [] if alive.all() else stop_causes(drives)
    for k in range(target.num_axes):
        reason = reasons[k]
        if where[k] and not alive[k]:
            reason = f"the drive switched off during the measurement with a constant current: {causes[k]}"
        elif where[k] and np.ptp(angles[:, k]) * target.motor.n_p > MOST_TURN:
            reason = "the rotor did not stay at the angle of its current: it slipped from the field"
        elif where[k] and np.any(np.abs(errors[:, k]) > MOST_ERROR * currents[:, k]):
            reason = "the current did not settle: check whether the supply voltage is high enough"
        found.append(refused("ohm", reason) if reason else _resistance(
            working, k, currents[:, k], duties[:, k], float(field[k])
        ))  # fmt: skip
    return found


def _resistance(working: Working, k: int, current: Floats, duty: Floats, field: float) -> Estimate:
    """Estimate the resistance from duties at currents [A], shape (n,) each, with the field at an angle [rad]."""
    target, stage = working.target, working.target.device.stage
    supply = float(target.supply[k])
    link = supply - stage["supply_resistance"].default * (1.5 * np.maximum(duty * current, 0.0) + SUPPLY_IDLE)
    X = np.stack([current, np.ones_like(current)], axis=1)
    slopes = np.linalg.pinv(X)[0]
    R = float(slopes @ (link * duty))
    rest = link * duty - X @ np.linalg.lstsq(X, link * duty, rcond=None)[0]
    freedom = len(current) - 2
    scatter = t_quantile(freedom) * float(np.sqrt(rest @ rest / freedom)) * float(np.linalg.norm(slopes))
    # Extra voltage that dead time takes from greater currents, over its range; d acts like q a quarter turn before.
    share = np.linspace(stage["dead_time"].low, stage["dead_time"].high, GRID) * target.device.current_rate
    fades = np.geomspace(stage["dead_time_current"].low, stage["dead_time_current"].high, GRID)
    lost = [float(slopes @ dead_time(np.full(len(current), field - 0.5 * np.pi), current, s, False)) for s in fades]
    apparent = supply * np.outer(share, lost)
    R -= float(apparent.mean())
    systematic = float(np.hypot(gain_error(target.device, target.motor, turns=False), MODEL))
    found = interval(R, scatter, systematic, "ohm", 1.96 * float(apparent.std()))
    if not R > 0.0 or found.high - R > WIDEST * R:
        return refused("ohm", (
            f"excitation too weak: currents of {current.min():.2g} to {current.max():.2g} A leave an interval of "
            f"{found.high - R:.2g} ohm around {R:.2g} ohm; allow a greater current"
        ))  # fmt: skip
    return found
