"""Causes of stepper drives: the shared ones, and those of the driver's bridges and the encoder.

Status flags are the driver's error flags, 2102h (TMCM-3313 manual, table 155).
"""

from __future__ import annotations

from drive_env.firmware.common import brake, causes
from drive_env.firmware.common.phases import open_load_a, open_load_b
from drive_env.firmware.common.protection import CUT, FAULT_RESET, FOLLOWING_ERROR, STOP, WARN, Cause
from drive_env.firmware.stepper.stall_guard import stalled
from mechanics.kernels.compiled import stage

OPEN_LOAD_DEMAND = 0.3  # of the amplitude, that must be demanded of a phase
OPEN_LOAD_CURRENT = 0.05  # of the amplitude, below which a phase counts as without current


@stage
def watch_phases(drive, lane, dt):
    """Measure for how long a phase carries no current although the table demands it."""
    on = drive.stage_on[lane] > 0.0
    asked = OPEN_LOAD_DEMAND * drive.amplitude[lane]
    flows = OPEN_LOAD_CURRENT * drive.amplitude[lane]
    if not on or drive.peak_a[lane] >= flows:
        drive.open_load_time_a[lane] = 0.0
    elif drive.amplitude[lane] * abs(drive.cos_ref[lane]) > asked:
        drive.open_load_time_a[lane] += dt
    if not on or drive.peak_b[lane] >= flows:
        drive.open_load_time_b[lane] = 0.0
    elif drive.amplitude[lane] * abs(drive.sin_ref[lane]) > asked:
        drive.open_load_time_b[lane] += dt


@stage
def overcurrent_high_side(drive, lane, told):
    """Return whether a short circuit across the DC link draws too much."""
    drawn = drive.u_dc[lane] * drive.short_conductance[lane]
    return drive.short_protection_off[lane] == 0.0 and drawn > drive.overcurrent[lane]


@stage
def detection_time(setting):
    """Return how long a bridge must be on to see a short to ground [s] (TMC262 data sheet, TS2G)."""
    slow = 3.2e-6 if setting < 0.5 else 1.6e-6
    fast = 1.2e-6 if setting < 2.5 else 0.8e-6
    return slow if setting < 1.5 else fast


@stage
def carries_too_much(drive, lane, peak, conductance):
    """Return whether a bridge, with a short to ground of that conductance [S] or without one, has too large a current.

    A short carries current while the bridge is on; if that is shorter than the detection time, it is not detected.
    """
    sees = drive.stage_on[lane] > 0.0 and drive.on_time[lane] > detection_time(drive.short_detection[lane])
    carried = peak + (drive.u_dc[lane] * conductance if sees else 0.0)
    return drive.short_protection_off[lane] == 0.0 and carried > drive.overcurrent[lane]


@stage
def overcurrent_a(drive, lane, told):
    """Return whether bridge A had too large a current."""
    return carries_too_much(drive, lane, drive.peak_a[lane], drive.short_a[lane])


@stage
def overcurrent_b(drive, lane, told):
    """Return whether bridge B had too large a current."""
    return carries_too_much(drive, lane, drive.peak_b[lane], drive.short_b[lane])


@stage
def following_error(drive, lane, told):
    """Return whether the encoder is farther from the demand than the window of 6065h: the motor has lost steps."""
    window = drive.following_error_window[lane]
    # Not from position_actual: homing has moved demand and steps in this period, but not yet that.
    error = abs(drive.position_demand[lane] - drive.theta_meas[lane] + drive.deviation[lane])
    return drive.drive_function[lane] > 0.0 and window > 0.0 and error > window


CAUSES = (
    Cause(FAULT_RESET, WARN, 0x00, 0x0),
    Cause("overcurrent_high_side", CUT, 0x02, 0x10, overcurrent_high_side, held=True),
    Cause("overcurrent_bridge_a", CUT, 0x02, 0x01, overcurrent_a, held=True),
    Cause("overcurrent_bridge_b", CUT, 0x02, 0x02, overcurrent_b, held=True),
    Cause("undervoltage", CUT, 0x04, 0x20, causes.undervoltage),
    Cause("overvoltage", CUT, 0x04, 0x0, causes.overvoltage),
    Cause("overtemperature", CUT, 0x08, 0x80, causes.overtemperature),
    Cause("shutdown_switch", CUT, 0x80, 0x0, causes.shutdown_switch),
    Cause("open_load_a", STOP, 0x80, 0x04, open_load_a, held=True),
    Cause("open_load_b", STOP, 0x80, 0x08, open_load_b, held=True),
    Cause(FOLLOWING_ERROR, STOP, 0x20, 0x0, following_error),
    Cause("stall", STOP, 0x20, 0x0, stalled),
    Cause("overtemperature_warning", WARN, 0x08, 0x40, causes.warm),
    *causes.LIMITS_AND_NETWORK,
)

CUTS = sum(1 << row for row, cause in enumerate(CAUSES) if row and cause.reaction == CUT)


@stage
def switch_brake(drive, lane, dt):
    """Advance output and brake by dt [s]; a cut of the stage also cuts a current that only waits for the brake."""
    if drive.present[lane] & CUTS:
        drive.holding[lane] = 0
    brake.drive_output(drive, lane, dt)
    brake.follow_output(drive, lane, dt)
