"""Corrections of the velocity by the deviation: catching up in load angle control, and the position PID.

Register numbers as in the TMC4361 (data sheet, "PID and closed-loop registers"): microsteps a second, f the clock.

    v_P = e P / 256 v_I = sum I / 65536, the sum of e at f / 128, limited to 65536 times 202Dh v_D = (e - e_before) D, e
    sampled at f / 128 / 202Eh; 0 means 256

Their sum is limited to 202Fh. A PID adds them to the ramp's velocity (mode 2) or moves the field only by them (mode 3),
and does not correct deviations within 2022h, if that is not 0, for any sum. In load angle control P and I limit the
field's velocity on the way back to the ramp's; following an overload is not limited. Without P and I only 202Fh limits
it.
"""

from __future__ import annotations

from drive_env.firmware.common.arithmetic import clip
from drive_env.firmware.record import LANES
from mechanics.kernels.compiled import inlined

PRESCALER = 128.0  # clocks
P_FRACTION = 256.0
I_FRACTION = 65536.0
DEFAULT_DIVIDER = 256.0  # meaning of 0
UNBOUNDED = 1e300  # rad/s


@inlined
def correct(drive, h):
    """Compute the velocities of the corrections for this window of h [s].

    Writes field_rate, rate_low and rate_high; correction_sum and the D part's state.
    """
    for lane in range(LANES):
        e = drive.loop_deviation[lane]
        outside = abs(e) > drive.correction_tolerance[lane] or drive.correction_tolerance[lane] == 0.0
        closed = drive.loop_closed[lane]
        is_pid = closed > 1.5
        per_second = drive.motion_clock[lane] / PRESCALER
        # Catching up leaves no sum when it ends; a PID's sum holds the axis in its position.
        total = drive.correction_sum[lane] + e * h
        limit = drive.correction_sum_limit[lane] * I_FRACTION / (per_second * drive.steps_per_rad[lane])
        total = clip(total, limit) if outside else (drive.correction_sum[lane] if is_pid else 0.0)
        total = total if closed > 0.5 else 0.0
        drive.correction_sum[lane] = total
        divider = drive.derivative_divider[lane] if drive.derivative_divider[lane] > 0.0 else DEFAULT_DIVIDER
        period = divider / per_second
        passed = drive.derivative_time[lane] + h
        looks = passed >= period * (1.0 - 1e-9)
        # Several samples within a window act by their mean.
        change = drive.position_correction_p[lane] * (e - drive.deviation_before[lane]) * period / passed
        drive.derivative_part[lane] = change if looks else drive.derivative_part[lane]
        drive.deviation_before[lane] = e if looks else drive.deviation_before[lane]
        drive.derivative_time[lane] = 0.0 if looks else passed
        most = drive.correction_velocity_limit[lane]
        p = drive.correction_velocity_p[lane] / P_FRACTION
        i = drive.correction_velocity_i[lane] * per_second / I_FRACTION
        v = p * e + i * total
        pid = clip(v + drive.derivative_part[lane], most) * drive.corrects[lane] if outside and is_pid else 0.0
        ramp = drive.step_rate[lane]
        base = 0.0 if closed > 2.5 and drive.corrects[lane] > 0.5 else ramp
        drive.field_rate[lane] = base + pid
        back = v if e > 0.0 else -v
        back = back if back > 0.0 else 0.0
        back = back if p + i > 0.0 else most
        back = back if back < most else most
        # Within the tolerance, or a microstep, no deviation is left to catch up with.
        near = drive.correction_tolerance[lane] * drive.steps_per_rad[lane]
        near = (near if near > 1.0 else 1.0) / drive.steps_per_rad[lane]
        free = drive.asks_torque[lane] > 0.5 or abs(e) <= near
        drive.rate_high[lane] = UNBOUNDED if free or e <= 0.0 else ramp + back
        drive.rate_low[lane] = -UNBOUNDED if free or e >= 0.0 else ramp - back
