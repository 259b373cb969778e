"""Steps: the demand of the modes becomes microsteps, and a microstep an entry of the sine table.

The demand moves once per supervision period; between two of them the steps come evenly. The table's waves are
symmetrical, as the driver makes them: entry k stands in the middle of its microstep, so that full steps lie where both
phases carry the same current.
"""

from __future__ import annotations

import numpy as np

from drive_env.firmware.common.arithmetic import TWO_PI, sine_cosine
from drive_env.firmware.record import LANES
from mechanics.compiled import inlined

HALF_PI = 1.5707963267948966
SMALLEST_WAY = 1e-6  # microsteps
HALF = 4294967296.0  # 2^32: of a counter of 64 bits


@inlined
def derive_steps(drive):
    """Compute what a microstep is: writes counts_per_turn, steps_per_rad, table_length and rad_per_entry."""
    for lane in range(LANES):
        per_step = 2.0 ** drive.microstep_resolution[lane]
        # 2001h may be 0, which is no motor that could be counted with.
        steps = drive.full_steps[lane] if drive.full_steps[lane] > 0.0 else 1.0
        drive.counts_per_turn[lane] = steps * per_step
        drive.steps_per_rad[lane] = steps * per_step / TWO_PI
        drive.table_length[lane] = 4.0 * per_step
        drive.rad_per_entry[lane] = HALF_PI / per_step


@inlined
def plan_steps(drive, dt):
    """Spread the steps to the demand over the coming period of dt [s]: writes step_rate, in_full_steps, steps_done."""
    for lane in range(LANES):
        way = drive.position_demand[lane] + drive.home_shift[lane] + drive.step_shift[lane] - drive.step_position[lane]
        # What rounding has left of the last period's way is no motion.
        way = 0.0 if abs(way) * drive.steps_per_rad[lane] < SMALLEST_WAY else way
        rate = way / dt
        drive.step_rate[lane] = rate
        counted = drive.steps_low[lane] + abs(way) * drive.steps_per_rad[lane]
        carry = 1.0 if counted >= HALF else 0.0
        drive.steps_low[lane] = counted - carry * HALF
        drive.steps_high[lane] += carry
        drive.steps_done[lane] = drive.steps_high[lane] * HALF + drive.steps_low[lane]
        threshold = drive.fullstep_threshold[lane]
        fast = threshold > 0.0 and abs(rate) > threshold
        drive.in_full_steps[lane] = drive.high_speed_fullstep[lane] if fast else 0.0


@inlined
def table_values(drive, lane, position):
    """Return sine and cosine of the table's entry at a position [rad]."""
    entry = np.floor(position * drive.steps_per_rad[lane] + 0.5)
    entry -= drive.table_length[lane] * np.floor(entry / drive.table_length[lane])
    angle = (entry + 0.5) * drive.rad_per_entry[lane]
    full = (np.floor(angle * (1.0 / HALF_PI)) + 0.5) * HALF_PI
    return sine_cosine(full if drive.in_full_steps[lane] > 0.5 else angle)


@inlined
def make_steps(drive, dt):
    """Step for one tick of dt [s]: writes step_position, and the table's values sin_ref and cos_ref."""
    for lane in range(LANES):
        position = drive.step_position[lane] + drive.step_rate[lane] * dt
        drive.step_position[lane] = position
        s, c = table_values(drive, lane, position)
        drive.sin_ref[lane] = s
        drive.cos_ref[lane] = c
