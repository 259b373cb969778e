"""The chopper: how the bridges make the phase currents follow the sine table, once per current tick.

A chopper cycle takes some 20 to 60 us, as long as a tick, so only its mean effect is modelled, from the TMC5160 data
sheet's description of the cycle:

- Spread cycle: on until the current is a hysteresis above the set-point, slow decay for the off time, fast decay until
  it is as much below, slow decay again. The mean current is nearly the set-point's; the ripple is twice the hysteresis
  and what a slow decay loses, at least what blank times make. Fast decay can lower a current at the full voltage.
- Constant off time: on until the current reaches the set-point, fast decay for a time, slow decay for another. The
  mean lies some half a ripple below the set-point. A current cannot be made to fall faster than this cycle with the
  shortest possible on-time, the blank time, allows; and that on-time is the least that a small set-point gets.
- The ripple warms the winding. Neither its noise nor the beat of two phases is modelled.

Voltage PWM applies a share of the supply that follows the table: the current results from winding and back-EMF.
"""

from __future__ import annotations

from drive_env.firmware.record import LANES
from mechanics.kernels.compiled import inlined

HYSTERESIS_UNITS = 512.0  # of the largest current (TMC5160 data sheet, HEND)
PWM_STEPS = 255.0
PWM_CLOCKS = 1024.0  # of a period of the voltage PWM (TMC5130 data sheet, pwm_freq 0)
FINEST = 256.0  # microsteps of the table per full step, in which the driver measures time
SMALLEST_SLOPE = 1.0  # A/s; if the back-EMF uses up the supply, no current can rise
TWO_PI = 6.283185307179586


@inlined
def blank_clocks(setting):
    """Return the blank time [clocks] of a setting 0...3 (TMC5160 data sheet, TBL)."""
    low = 16.0 if setting < 0.5 else 24.0
    high = 36.0 if setting < 2.5 else 54.0
    return low if setting < 1.5 else high


@inlined
def larger(x, y):
    """Return the larger of two numbers."""
    return x if x > y else y


@inlined
def slow_decay_clocks(off_time):
    """Return the duration of a slow decay [clocks] (2097h)."""
    return larger(12.0 + 32.0 * off_time, 64.0)


@inlined
def choose_drive(drive):
    """Choose chopper or voltage PWM for this window, by the speed of the steps: writes in_pwm and pwm_scale.

    The amplitude grows with the speed as A + G 256 / T, T the clocks between two microsteps of 1/256, up to 255; the
    current's scale lowers it as it lowers the chopper's set-point.
    """
    for lane in range(LANES):
        speed = abs(drive.step_rate[lane])
        gradient = drive.pwm_gradient[lane]
        slow = 1.0 if speed < drive.pwm_threshold[lane] else 0.0
        per_clock = speed * drive.full_steps[lane] * (FINEST / TWO_PI) / drive.chopper_clock[lane]
        scale = drive.pwm_amplitude[lane] + gradient * 256.0 * per_clock
        scale = scale if scale < PWM_STEPS else PWM_STEPS
        # The amplitude is that of the present current step; vsense applies only to the chopper.
        share = drive.amplitude[lane] * (1.0 + drive.vsense[lane]) / drive.full_scale_current[lane]
        drive.in_pwm[lane] = slow if gradient > 0.0 else 0.0
        drive.pwm_scale[lane] = scale * share


@inlined
def spread_cycle(rise, fast, lost, off, blank, start, end, falls):
    """Return ripple [A], duration [s], and excess of the mean current over the set-point [A] of such a cycle.

    The hysteresis falls from the cycle's beginning on, while on and in fast decay. Their durations, up and down, are
    the solution of rise up = h(up) + h(up + down) + lost and fast down = h(up) + h(up + down) - lost.

    Args:
        rise: Slope of the current while on [A/s].
        fast: Slope in fast decay [A/s].
        lost: Decrease in a slow decay [A].
        off: Duration of a slow decay [s].
        blank: Blank time [s].
        start: Hysteresis at the cycle's beginning [A].
        end: Lowest hysteresis [A].
        falls: Slope of the hysteresis [A/s].
    """
    determinant = (rise + 2.0 * falls) * (fast + falls) - 2.0 * falls * falls
    up = ((2.0 * start + lost) * (fast + falls) - falls * (2.0 * start - lost)) / determinant
    down = larger(((rise + 2.0 * falls) * (2.0 * start - lost) - 2.0 * falls * (2.0 * start + lost)) / determinant, 0.0)
    above = larger(start - falls * up, end)
    below = larger(start - falls * (up + down), end)
    ripple = larger(above + below + lost, larger(2.0 * lost + blank * fast, blank * rise))
    top = larger(start - falls * ripple / rise, end)
    return ripple, ripple / rise + 2.0 * off + (ripple - 2.0 * lost) / fast, top - 0.5 * ripple


@inlined
def constant_off_cycle(rise, lost, off, blank, dropped, fast_decay):
    """Return ripple [A], duration [s], and distance of the mean current below its maximum [A] of such a cycle.

    Args:
        rise: Slope of the current while on [A/s].
        lost: Decrease in the slow decay [A].
        off: Duration of the slow decay [s].
        blank: Blank time [s].
        dropped: Decrease in the fast decay [A].
        fast_decay: Its duration [s].
    """
    ripple = larger(dropped + lost, blank * rise)
    duration = ripple / rise + fast_decay + off
    area = 0.5 * ripple * ripple / rise + 0.5 * dropped * fast_decay + (dropped + 0.5 * lost) * off
    return ripple, duration, area / duration


@inlined
def find_ripple(drive):
    """Compute the effect of the chopper's cycle on the mean current in this window.

    Writes ripple, chopper_frequency, on_time, in_spread_cycle, current_shift, current_gain and lowest_share.
    """
    for lane in range(LANES):
        clock = 1.0 / drive.chopper_clock[lane]
        fast_chopper = drive.high_speed_chopper[lane] * drive.at_high_speed[lane]
        is_constant = drive.chopper_mode[lane] > 0.5 or fast_chopper > 0.5
        # The high speed chopper has no fast decay, and doubles the off time (TMC5160 data sheet, vhighchm).
        off = slow_decay_clocks(drive.off_time[lane]) * clock * (1.0 + fast_chopper)
        blank = blank_clocks(drive.chopper_blank[lane]) * clock
        fast_decay = 32.0 * drive.hysteresis_start[lane] * clock * (1.0 - fast_chopper)
        # Slopes of a current of the set-point's size at the full opposing back-EMF [A/s].
        per_volt = 1.0 / drive.L_s[lane]
        resisted = (drive.R_s[lane] + drive.on_resistance[lane]) * drive.amplitude[lane]
        u = drive.u_dc[lane] * drive.duty_limit[lane]
        against = resisted + drive.psi[lane] * drive.n_p[lane] * abs(drive.omega_m[lane])
        rise = larger((u - against) * per_volt, SMALLEST_SLOPE)
        fast = (u + resisted) * per_volt
        lost = against * per_volt * off
        unit = drive.full_scale_current[lane] / (1.0 + drive.vsense[lane]) / HYSTERESIS_UNITS
        end = drive.hysteresis_end[lane] * unit
        start = end + drive.hysteresis_start[lane] * unit
        falls = unit / (16.0 * (1.0 + drive.hysteresis_decrement[lane]) * clock)
        spread, spread_time, above = spread_cycle(rise, fast, lost, off, blank, start, end, falls)
        steady, steady_time, below = constant_off_cycle(rise, lost, off, blank, fast_decay * fast, fast_decay)
        chops = drive.stage_on[lane] * (1.0 - drive.in_pwm[lane])
        drive.ripple[lane] = (steady if is_constant else spread) * chops
        drive.in_spread_cycle[lane] = 0.0 if is_constant else 1.0
        drive.chopper_frequency[lane] = chops / (steady_time if is_constant else spread_time)
        held = drive.pwm_scale[lane] * (PWM_CLOCKS / PWM_STEPS) * clock
        drive.on_time[lane] = held if drive.in_pwm[lane] > 0.5 else (steady if is_constant else spread) / rise
        # A spread cycle's losses are small for small currents; those of the other distort the zero crossing.
        drive.current_shift[lane] = end - below if is_constant else 0.0
        drive.current_gain[lane] = 1.0 if is_constant else 1.0 + above / drive.amplitude[lane]
        drive.lowest_share[lane] = (blank - fast_decay) / (blank + fast_decay + off) if is_constant else -1.0


@inlined
def drain_shorts(drive):
    """Compute the current from the DC link in this window besides the winding's power: writes drain.

    A short to ground carries current while the bridge's upper transistor is on, for a share of time equal to the
    phase's voltage over the supply.
    """
    for lane in range(LANES):
        shorts = drive.short_a[lane] * abs(drive.u_a[lane]) + drive.short_b[lane] * abs(drive.u_b[lane])
        drive.drain[lane] = drive.idle_current[lane] + drive.stage_on[lane] * shorts


@inlined
def phase_voltage(reference, shift, offset, slope, lowest, largest):
    """Return the mean voltage of a phase in a tick [V] that brings its current to the set-point, as far as possible.

    Args:
        reference: Set-point [A].
        shift: Excess of the mean current over it [A].
        offset: Voltage that brings the current to 0 [V].
        slope: Voltage per additional ampere [V/A].
        lowest: Lowest voltage along the set-point's direction [V].
        largest: Highest voltage along it [V].
    """
    sign = 1.0 if reference >= 0.0 else -1.0
    size = sign * reference + shift
    size = size if size > 0.0 else 0.0
    along = sign * offset + slope * size
    along = lowest if along < lowest else along
    along = largest if along > largest else along
    return sign * along
