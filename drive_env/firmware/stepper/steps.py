"""Steps: converts the demand of the modes to microsteps, and a microstep to an entry of the sine table.

The demand moves once per supervision period; in between the steps are spread evenly. The table's waves are symmetrical,
as in the driver: entry k is in the middle of its microstep, so that at full steps both phases carry the same current.
"""

from __future__ import annotations

import numpy as np

from drive_env.cia402 import CSP
from drive_env.firmware.common.arithmetic import TWO_PI, sine_cosine
from drive_env.firmware.record import LANES
from drive_env.firmware.stepper.chopper import larger
from mechanics.kernels.compiled import inlined

HALF_PI = 1.5707963267948966
SMALLEST_WAY = 1e-6  # microsteps
HALF = 4294967296.0  # 2^32: half of a 64-bit counter


@inlined
def derive_steps(drive):
    """Compute the size of a microstep: writes counts_per_turn, steps_per_rad, table_length and rad_per_entry."""
    for lane in range(LANES):
        per_step = 2.0 ** drive.microstep_resolution[lane]
        # 2001h may be 0, with which no motor can be counted.
        steps = drive.full_steps[lane] if drive.full_steps[lane] > 0.0 else 1.0
        drive.counts_per_turn[lane] = steps * per_step
        drive.steps_per_rad[lane] = steps * per_step / TWO_PI
        drive.table_length[lane] = 4.0 * per_step
        drive.rad_per_entry[lane] = HALF_PI / per_step


@inlined
def plan_steps(drive, dt):
    """Spread the steps to the demand over the coming period of dt [s].

    Writes planned_rate, step_rate, at_high_speed and in_full_steps.
    """
    for lane in range(LANES):
        way = drive.position_demand[lane] + drive.home_shift[lane] + drive.step_shift[lane] - drive.step_position[lane]
        # A rounding error of the last period's distance is not motion.
        way = 0.0 if abs(way) * drive.steps_per_rad[lane] < SMALLEST_WAY else way
        rate = way / dt
        # Catching up with set-points of csp after DcStep's waiting begins so that 6084h ends it at their speed.
        ahead = drive.velocity_demand[lane] if drive.velocity_demand[lane] * way > 0.0 else 0.0
        left = larger(abs(rate) - abs(ahead), 0.0) * dt
        slows = drive.deceleration[lane] if drive.deceleration[lane] > 0.0 else drive.acceleration[lane]
        most = abs(ahead) + (2.0 * slows * left) ** 0.5
        catches_up = drive.dc_speed[lane] > 0.0 and drive.mode_display[lane] == CSP and slows > 0.0
        size = most if catches_up and most < abs(rate) else abs(rate)
        rate = size if rate > 0.0 else -size
        drive.planned_rate[lane] = rate
        drive.step_rate[lane] = rate
        threshold = drive.fullstep_threshold[lane]
        fast = threshold > 0.0 and abs(rate) > threshold
        # DcStep counts as that threshold; voltage PWM disables it.
        dc_step = drive.dc_speed[lane] > 0.0 and abs(rate) >= drive.dc_speed[lane] and drive.in_pwm[lane] < 0.5
        drive.at_high_speed[lane] = 1.0 if fast or dc_step else 0.0
        drive.in_full_steps[lane] = drive.high_speed_fullstep[lane] * drive.at_high_speed[lane]


@inlined
def count_steps(drive, h):
    """Count the microsteps of the coming window of h [s]: writes steps_low, steps_high and steps_done."""
    for lane in range(LANES):
        counted = drive.steps_low[lane] + abs(drive.step_rate[lane]) * h * drive.steps_per_rad[lane]
        carry = 1.0 if counted >= HALF else 0.0
        drive.steps_low[lane] = counted - carry * HALF
        drive.steps_high[lane] += carry
        drive.steps_done[lane] = drive.steps_high[lane] * HALF + drive.steps_low[lane]


@inlined
def table_values(drive, lane, position):
    """Return sine and cosine in the table's entry at a position [rad]."""
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
