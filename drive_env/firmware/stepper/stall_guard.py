"""StallGuard2: the motor's load, read from the bridges' voltages, and the stop when it stalls.

The driver derives the load from its choppers: how long they are on and in fast decay, in the quarters of the period in
which a phase's current falls. An unloaded rotor gives energy back then, and the mean voltage is against the current;
the nearer the load angle comes to 90 degrees, the more power is needed. With sinusoidal currents i, field at speed w
and load angle d, the mean voltage of a falling phase, against its current and as a share of the supply, is

    given back = (2 / pi) (L i w + psi w (cos d - sin d) - R i) / u_dc

which falls all the way to 90 degrees, all but linearly with the torque. At low speed only the resistance acts; when the
back-EMF uses up the supply, the bridges' voltages saturate and show little of the load. Both follow from the formula.

The mean is computed for both phases at once, in the frame of the field, in which it is constant. The reading is 1023
times it, and 209Eh shifts it by up to the whole range; the chip's own scale is not published.
"""

from __future__ import annotations

import numpy as np

from drive_env.firmware.common.arithmetic import TWO_PI
from drive_env.firmware.record import LANES
from mechanics.kernels.compiled import inlined, stage

LARGEST_READING = 1023.0
THRESHOLD_UNIT = 16.0  # 64 steps of the threshold are the whole range
FULL_STEPS_OF_FILTER = 4.0
TWO_THROUGH_PI = 0.6366197723675814


@inlined
def collect_voltage(drive):
    """Add the phases' voltages of one tick, in the frame of the field: writes u_along and u_across."""
    for lane in range(LANES):
        s = drive.sin_ref[lane]
        c = drive.cos_ref[lane]
        drive.u_along[lane] += drive.u_a[lane] * c + drive.u_b[lane] * s
        drive.u_across[lane] += drive.u_b[lane] * c - drive.u_a[lane] * s


@inlined
def read_load(drive, tick, ticks):
    """Take a reading after each full step, or after four of them with the filter.

    Writes load_value, load_is_fresh, and stalled if the reading is 0 above the speed of 20A4h. Only a spread cycle has
    the measured quarters of fast decay: otherwise the reading is 0, without a stop.

    Args:
        drive: The record.
        tick: Current-loop period [s].
        ticks: Number of ticks in a window, whose voltages are summed.
    """
    for lane in range(LANES):
        rate = drive.step_rate[lane]
        direction = 1.0 if rate > 0.0 else -1.0
        measures = drive.stage_on[lane] * (1.0 - drive.in_pwm[lane]) * drive.in_spread_cycle[lane]
        # A measurement continues while the motor turns in one direction.
        goes_on = measures > 0.5 and rate * drive.load_direction[lane] > 0.0
        windows = drive.load_windows[lane] + 1.0
        way = abs(drive.step_position[lane] - drive.load_start[lane]) * drive.full_steps[lane] * (1.0 / TWO_PI)
        asked = FULL_STEPS_OF_FILTER if drive.load_filter[lane] > 0.5 else 1.0
        fresh = goes_on and way >= asked
        # The voltages were applied half a tick before the field's collected angle.
        a = 0.5 * tick * rate * drive.full_steps[lane] * 0.25
        sa = a * (1.0 - a * a * (1.0 / 6.0))
        ca = 1.0 - 0.5 * a * a
        across = ca * drive.u_across[lane] + sa * drive.u_along[lane]
        along = ca * drive.u_along[lane] - sa * drive.u_across[lane]
        against = (direction * across - along) * TWO_THROUGH_PI
        share = against / (drive.u_dc[lane] * windows * ticks)
        value = np.floor(LARGEST_READING * share + THRESHOLD_UNIT * drive.stall_threshold[lane])
        value = value if value > 0.0 else 0.0
        value = value if value < LARGEST_READING else LARGEST_READING
        kept = drive.load_value[lane] if measures > 0.5 else 0.0
        above = drive.stall_speed[lane] > 0.0 and abs(rate) > drive.stall_speed[lane]
        begins = fresh or not goes_on
        drive.load_value[lane] = value if fresh else kept
        drive.load_is_fresh[lane] = 1.0 if fresh else 0.0
        drive.stalled[lane] = 1.0 if fresh and above and value == 0.0 else drive.stalled[lane]
        drive.load_direction[lane] = 0.0 if rate == 0.0 else direction
        drive.load_start[lane] = drive.step_position[lane] if begins else drive.load_start[lane]
        drive.load_windows[lane] = 0.0 if begins else windows
        drive.u_along[lane] = 0.0 if begins else drive.u_along[lane]
        drive.u_across[lane] = 0.0 if begins else drive.u_across[lane]


@inlined
def stop_stalled(drive):
    """Stop the steps of a stalled motor, from this window on."""
    for lane in range(LANES):
        drive.step_rate[lane] = 0.0 if drive.stalled[lane] > 0.5 else drive.step_rate[lane]
        drive.planned_rate[lane] = 0.0 if drive.stalled[lane] > 0.5 else drive.planned_rate[lane]


@stage
def hold_stalled(drive, lane, dt):
    """Hold the demand where the steps were stopped, until the stage is off: a ramp would continue through a stall."""
    if drive.drive_function[lane] == 0.0:
        drive.stalled[lane] = 0.0
    if drive.stalled[lane] > 0.5:
        drive.position_demand[lane] = drive.step_position[lane] - drive.step_shift[lane] - drive.home_shift[lane]
        drive.velocity_demand[lane] = 0.0
        drive.braking[lane] = 1


@stage
def stalled(drive, lane, told):
    """Return whether the motor was stopped because it stalled."""
    return drive.drive_function[lane] > 0.0 and drive.stalled[lane] > 0.5


@stage
def forget_load(drive, lane):
    """Reset: no reading."""
    drive.load_value[lane] = 0.0
    drive.load_is_fresh[lane] = 0.0
    drive.load_direction[lane] = 0.0
    drive.load_windows[lane] = 0.0
    drive.u_along[lane] = 0.0
    drive.u_across[lane] = 0.0
    drive.stalled[lane] = 0.0
