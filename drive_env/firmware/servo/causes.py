"""Causes of servo drives: the shared ones, and those of bridge, phases, halls and the encoder's start-up."""

from __future__ import annotations

from drive_env.firmware.common import causes, fsa, start_up
from drive_env.firmware.common.phases import open_load_a, open_load_b
from drive_env.firmware.common.protection import CUT, FAULT_RESET, FOLLOWING_ERROR, STOP, WARN, Cause
from drive_env.firmware.servo import alignment
from mechanics.kernels.compiled import stage

OPEN_LOAD_DEMAND = 1.0  # A of phase current that must be demanded
OPEN_LOAD_CURRENT = 0.3  # A below which a phase counts as without current
SQRT3 = 3.0**0.5


@stage
def watch_phases(drive, lane, dt):
    """Measure for how long a phase carries no current although the loop asks for it."""
    # The present demand of each phase; for a rotor at rest that of one phase may be 0.
    q = drive.i_q_ref[lane] * drive.torque_share[lane] * (1.0 - 2.0 * drive.shaft_direction[lane])
    d = drive.i_d_ref[lane]
    alpha = drive.cos_meas[lane] * d - drive.sin_meas[lane] * q
    beta = drive.sin_meas[lane] * d + drive.cos_meas[lane] * q
    asked_a = abs(alpha)
    asked_b = asked_a if drive.is_dc[lane] == 1.0 else abs(0.5 * (SQRT3 * beta - alpha))
    # Near no-load speed no current flows for lack of voltage: the other phase, or standstill, must show that it could.
    stands = abs(drive.omega_slow[lane]) <= drive.standstill[lane]
    on = drive.stage_on[lane] > 0.0
    could_a = on and asked_a > OPEN_LOAD_DEMAND and (stands or drive.peak_b[lane] >= OPEN_LOAD_CURRENT)
    could_b = on and asked_b > OPEN_LOAD_DEMAND and (stands or drive.peak_a[lane] >= OPEN_LOAD_CURRENT)
    if could_a and drive.peak_a[lane] < OPEN_LOAD_CURRENT:
        drive.open_load_time_a[lane] += dt
    elif not on or drive.peak_a[lane] >= OPEN_LOAD_CURRENT:
        drive.open_load_time_a[lane] = 0.0
    if could_b and drive.peak_b[lane] < OPEN_LOAD_CURRENT:
        drive.open_load_time_b[lane] += dt
    elif not on or drive.peak_b[lane] >= OPEN_LOAD_CURRENT:
        drive.open_load_time_b[lane] = 0.0


@stage
def overcurrent_high_side(drive, lane, told):
    """Return whether a short circuit across the DC link draws too much."""
    return drive.u_dc[lane] * drive.short_conductance[lane] > drive.overcurrent[lane]


@stage
def overcurrent_a(drive, lane, told):
    """Return whether phase A had too large a current."""
    return drive.peak_a[lane] > drive.overcurrent[lane]


@stage
def overcurrent_b(drive, lane, told):
    """Return whether phase B had too large a current."""
    return drive.peak_b[lane] > drive.overcurrent[lane]


@stage
def hall_error(drive, lane, told):
    """Return whether needed halls are invalid: all three lines are equal, which no rotor causes."""
    # A brushed motor has no halls.
    return (drive.hall_broken[lane] > 0.0 or drive.is_dc[lane] == 1.0) and alignment.needs_halls(drive, lane)


@stage
def initialization_failed(drive, lane, told):
    """Return whether the encoder's initialisation failed."""
    return drive.init_state[lane] == start_up.FAILED and drive.fsa[lane] >= fsa.SWITCHED


@stage
def overload(drive, lane, told):
    """Return whether the stage's I2t budget is used up."""
    return drive.overload[lane] > 1.0


# Status flags are those of 2101h (TMCM-1636 manual, table 85).
CAUSES = (
    Cause(FAULT_RESET, WARN, 0x00, 0x0),
    Cause("overcurrent_high_side", CUT, 0x02, 0x1, overcurrent_high_side, held=True),
    Cause("overcurrent_bridge_a", CUT, 0x02, 0x1, overcurrent_a, held=True),
    Cause("overcurrent_bridge_b", CUT, 0x02, 0x1, overcurrent_b, held=True),
    Cause("undervoltage", CUT, 0x04, 0x2, causes.undervoltage),
    Cause("overvoltage", CUT, 0x04, 0x4, causes.overvoltage),
    Cause("overtemperature", CUT, 0x08, 0x8, causes.overtemperature),
    Cause("hall_error", CUT, 0x20, 0x20, hall_error),
    Cause("shutdown_switch", CUT, 0x80, 0x1000, causes.shutdown_switch),
    Cause("encoder_initialization", CUT, 0x20, 0x80, initialization_failed, tried_again=True),
    # With one phase open the other also lacks current while the rotor stands across it: a consequence of the first.
    Cause("open_load_a", STOP, 0x80, 0x40, open_load_a, held=True, unless="open_load_b"),
    Cause("open_load_b", STOP, 0x80, 0x40, open_load_b, held=True, unless="open_load_a"),
    Cause(FOLLOWING_ERROR, STOP, 0x20, 0x0, causes.following_error),
    Cause("overload", STOP, 0x02, 0x20000, overload, held=True),
    Cause("overtemperature_warning", WARN, 0x08, 0x0, causes.warm),
    *causes.LIMITS_AND_NETWORK,
)
