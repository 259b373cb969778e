"""Protection: the causes that this drive watches, once per millisecond, and what each does.

A cause is a physical condition of the axis. Its emergency code and bytes are the device's data, by name; which cause
has which reaction is decided here: what endangers the stage cuts it, what endangers the machine stops it with the
fault reaction of 605Eh, a limit of travel stops the axis and stays enabled, a warning only tells.
"""

from __future__ import annotations

from typing import NamedTuple

from drive_env.firmware import alignment, fsa, inputs
from drive_env.firmware.record import LANES
from mechanics.compiled import cached, stage

CUT, STOP, LIMIT, WARN = 0, 1, 2, 3


class Cause(NamedTuple):
    """A row: name as in the device's emergency table, reaction, bits of 1001h and of 2101h."""

    name: str
    reaction: int
    error_register: int
    status_flag: int


# Row 0 is the answer to a fault reset, which every device sends with code 0000h.
CAUSES = (
    Cause("fault_reset", WARN, 0x00, 0x0),
    Cause("overcurrent_high_side", CUT, 0x02, 0x1),
    Cause("overcurrent_bridge_a", CUT, 0x02, 0x1),
    Cause("overcurrent_bridge_b", CUT, 0x02, 0x1),
    Cause("undervoltage", CUT, 0x04, 0x2),
    Cause("overvoltage", CUT, 0x04, 0x4),
    Cause("overtemperature", CUT, 0x08, 0x8),
    Cause("hall_error", CUT, 0x20, 0x20),
    Cause("shutdown_switch", CUT, 0x80, 0x1000),
    Cause("encoder_initialization", CUT, 0x20, 0x80),
    Cause("open_load_a", STOP, 0x80, 0x40),
    Cause("open_load_b", STOP, 0x80, 0x40),
    Cause("following_error", STOP, 0x20, 0x0),
    Cause("overload", STOP, 0x02, 0x20000),
    Cause("overtemperature_warning", WARN, 0x08, 0x0),
    Cause("positive_software_limit", LIMIT, 0x20, 0x0),
    Cause("negative_software_limit", LIMIT, 0x20, 0x0),
    Cause("positive_limit_switch", LIMIT, 0x20, 0x0),
    Cause("negative_limit_switch", LIMIT, 0x20, 0x0),
    # From outside the axis (`trip`): its network was stopped or lost.
    Cause("communication_error", STOP, 0x10, 0x0),
    # The axis has left its limits: 0000h too, as CiA 301 has it, but no command, and nothing else ends with it.
    Cause("fault_reset", WARN, 0x00, 0x0),
)
(
    _RESET,
    HIGH_SIDE,
    BRIDGE_A,
    BRIDGE_B,
    UNDERVOLTAGE,
    OVERVOLTAGE,
    OVERTEMPERATURE,
    HALL_ERROR,
    SHUTDOWN_SWITCH,
    INITIALIZATION,
    OPEN_LOAD_A,
    OPEN_LOAD_B,
    FOLLOWING_ERROR,
    OVERLOAD,
    WARM,
    POSITIVE_SOFTWARE,
    NEGATIVE_SOFTWARE,
    POSITIVE_SWITCH,
    NEGATIVE_SWITCH,
    COMMUNICATION,
    LIMITS_LEFT,
) = range(len(CAUSES))
GENERIC_ERROR = 0x01  # bit 0 of 1001h is set with every error
BLOCKS_NEGATIVE, BLOCKS_POSITIVE = 1, 2
ROUNDING = 1e-9  # rad: a target at the corrected limit itself is within it
# rad, one degree of the rotor: an axis that is held at its limit moves by less, and is not told of.
LIMIT_MARGIN = 0.017453292519943295
HOMING = 6  # limit switches are what homing looks for

_CUTS, _STOPS, _LIMITS, _WARNS = (
    sum(1 << row for row, cause in enumerate(CAUSES) if row and cause.reaction == reaction)
    for reaction in (CUT, STOP, LIMIT, WARN)
)
_POSITIVE = 1 << POSITIVE_SOFTWARE | 1 << POSITIVE_SWITCH
_NEGATIVE = 1 << NEGATIVE_SOFTWARE | 1 << NEGATIVE_SWITCH
_SOFTWARE = 1 << POSITIVE_SOFTWARE | 1 << NEGATIVE_SOFTWARE
# What is over as soon as the stage is off: the driver shows it until the reset.
_HELD = 1 << HIGH_SIDE | 1 << BRIDGE_A | 1 << BRIDGE_B | 1 << OPEN_LOAD_A | 1 << OPEN_LOAD_B | 1 << OVERLOAD
_REGISTER = tuple(cause.error_register for cause in CAUSES)
_FLAGS = tuple(cause.status_flag for cause in CAUSES)

OPEN_LOAD_TIME = 0.05  # s for which a phase must stay without the current that is asked for
OPEN_LOAD_DEMAND = 1.0  # A of phase current that must be asked for
OPEN_LOAD_CURRENT = 0.3  # A below which there is none
SQRT3 = 3.0**0.5


@stage
def watch_phases(drive, lane, dt):
    """Measure for how long a phase carries no current although the loop asks for it; then forget the peaks."""
    # What each phase should carry now; a rotor at rest may well ask nothing of one of them.
    q = drive.i_q_ref[lane] * drive.torque_share[lane] * (1.0 - 2.0 * drive.shaft_direction[lane])
    d = drive.i_d_ref[lane]
    alpha = drive.cos_meas[lane] * d - drive.sin_meas[lane] * q
    beta = drive.sin_meas[lane] * d + drive.cos_meas[lane] * q
    asked_a = abs(alpha)
    asked_b = asked_a if drive.is_dc[lane] == 1.0 else abs(0.5 * (SQRT3 * beta - alpha))
    # Near no-load speed no current flows for want of voltage: the other phase, or standstill, must show that it could.
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
def conditions(drive, lane):
    """Return the causes whose condition holds now, as bits 1 << row."""
    bits = 0
    if drive.u_dc[lane] * drive.short_conductance[lane] > drive.overcurrent[lane]:
        bits |= 1 << HIGH_SIDE
    if drive.peak_a[lane] > drive.overcurrent[lane]:
        bits |= 1 << BRIDGE_A
    if drive.peak_b[lane] > drive.overcurrent[lane]:
        bits |= 1 << BRIDGE_B
    if drive.u_dc[lane] < drive.undervoltage[lane]:
        bits |= 1 << UNDERVOLTAGE
    if drive.u_dc[lane] > drive.overvoltage[lane]:
        bits |= 1 << OVERVOLTAGE
    if drive.T_stage[lane] > drive.warning_temperature[lane]:
        bits |= 1 << WARM
        if drive.T_stage[lane] > drive.error_temperature[lane]:
            bits |= 1 << OVERTEMPERATURE
    # A brushed motor has none.
    if (drive.hall_broken[lane] > 0.0 or drive.is_dc[lane] == 1.0) and alignment.needs_halls(drive, lane):
        # All three lines alike is a pattern that no rotor position gives.
        bits |= 1 << HALL_ERROR
    if (drive.inputs[lane] & inputs.ENABLE) == 0:
        bits |= 1 << SHUTDOWN_SWITCH
    if alignment.has_failed(drive, lane):
        bits |= 1 << INITIALIZATION
    # With one phase open the other lacks current too while the rotor stands across it: that follows from the first.
    if drive.open_load_time_a[lane] > OPEN_LOAD_TIME and drive.fault[lane] != OPEN_LOAD_B + 1:
        bits |= 1 << OPEN_LOAD_A
    if drive.open_load_time_b[lane] > OPEN_LOAD_TIME and drive.fault[lane] != OPEN_LOAD_A + 1:
        bits |= 1 << OPEN_LOAD_B
    if drive.overload[lane] > 1.0:
        bits |= 1 << OVERLOAD
    if drive.drive_function[lane] > 0.0:
        window = drive.following_error_window[lane]
        error = abs(drive.position_demand[lane] - drive.theta_meas[lane])
        if window > 0.0 and drive.loop_level[lane] > 0.0 and error > window:
            bits |= 1 << FOLLOWING_ERROR
        # Limit switches are what homing looks for, and before it positions mean nothing.
        if drive.mode_display[lane] != HOMING:
            bits |= demand_beyond(drive, lane) | actual_beyond(drive, lane)
            if inputs.is_active(drive, lane, 1):
                bits |= 1 << POSITIVE_SWITCH
            if inputs.is_active(drive, lane, 0):
                bits |= 1 << NEGATIVE_SWITCH
    return bits


@stage
def demand_beyond(drive, lane):
    """Return the software limits that the position demand is past.

    Only position modes have such a demand: what the velocity modes integrate for 6062h is shifted against the axis by a
    load that pushes it.
    """
    if drive.loop_level[lane] != 2:
        return 0
    bits = 0
    if drive.position_demand[lane] > corrected_maximum(drive, lane):
        bits |= 1 << POSITIVE_SOFTWARE
    if drive.position_demand[lane] < corrected_minimum(drive, lane):
        bits |= 1 << NEGATIVE_SOFTWARE
    return bits


@stage
def actual_beyond(drive, lane):
    """Return the software limits that the axis is past (manual, section 6.1.11); one told lasts to its edge."""
    position = drive.theta_meas[lane]
    past_positive = 0.0 if drive.active[lane] & 1 << POSITIVE_SOFTWARE else LIMIT_MARGIN
    past_negative = 0.0 if drive.active[lane] & 1 << NEGATIVE_SOFTWARE else LIMIT_MARGIN
    bits = 0
    if position > corrected_maximum(drive, lane) + past_positive:
        bits |= 1 << POSITIVE_SOFTWARE
    if position < corrected_minimum(drive, lane) - past_negative:
        bits |= 1 << NEGATIVE_SOFTWARE
    return bits


@stage
def corrected_minimum(drive, lane):
    """Return 607Dh:01 corrected by the home offset (manual, section 6.1.11) [rad]."""
    return drive.position_min[lane] - drive.home_offset[lane]


@stage
def corrected_maximum(drive, lane):
    """Return 607Dh:02 corrected by the home offset [rad]."""
    return drive.position_max[lane] - drive.home_offset[lane]


@stage
def causes_gone(drive, lane):
    """Return whether no cause that takes the drive into fault holds any more.

    A failed initialisation does not count: it is tried again at the next enabling, and its cause is only seen then.
    """
    return conditions(drive, lane) & (_CUTS | _STOPS) & ~(1 << INITIALIZATION) == 0


@stage
def protect(drive, lane, dt):
    """Look at every cause; one that appears queues its emergency and has its reaction."""
    watch_phases(drive, lane, dt)
    present = conditions(drive, lane)
    drive.present[lane] = present
    if drive.fsa[lane] < fsa.SWITCHED or drive.fsa[lane] == fsa.FAULTED:
        # A drive whose supply or enable is missing is in no fault before anybody switches it on.
        present &= ~(_CUTS | _STOPS)
    drive.peak_a[lane] = 0.0
    drive.peak_b[lane] = 0.0
    appeared = present & ~drive.active[lane]
    # Until the fault reaction has ended, what began it is no new occurrence when it goes and comes again.
    told = drive.active[lane] & _STOPS if drive.fsa[lane] == fsa.REACTING else 0
    drive.active[lane] = present | told
    drive.warning[lane] = 1 if present & _WARNS else 0
    # A position demand that is within the limits leads an axis back that was pushed past them.
    blocking = present & ~_SOFTWARE | demand_beyond(drive, lane) if drive.loop_level[lane] == 2 else present
    drive.blocked[lane] = (BLOCKS_POSITIVE if blocking & _POSITIVE else 0) | (
        BLOCKS_NEGATIVE if blocking & _NEGATIVE else 0
    )
    # A limit shows in 1001h while it lasts; what made a fault stays there until the reset.
    if present & _LIMITS:
        drive.error_register[lane] |= GENERIC_ERROR | _REGISTER[POSITIVE_SOFTWARE]
    elif drive.fault[lane] == 0 and drive.error_register[lane] != 0:
        drive.error_register[lane] = 0
        fsa.push_emergency(drive, lane, LIMITS_LEFT)
    if appeared == 0:
        return
    for cause in range(1, len(_REGISTER)):
        if not appeared & (1 << cause):
            continue
        push_emergency = True
        if (_CUTS | _STOPS) & (1 << cause):
            cut = _CUTS & (1 << cause) != 0
            # The stage that is cut has answered: what else it sees in the same moment follows from it.
            push_emergency = drive.fsa[lane] != fsa.FAULTED
            if push_emergency:
                drive.fault[lane] = cause + 1
                drive.error_register[lane] |= GENERIC_ERROR | _REGISTER[cause]
                fsa.fault(drive, lane, cut)
        if push_emergency:
            fsa.push_emergency(drive, lane, cause)


@cached()
def trip(records, first_axis, num_axes, cause):
    """Take axes that are in operation enabled into fault, with the reaction of a cause that is outside of them.

    Whoever knows the cause tells it: no emergency is queued. Returns how many axes were taken.
    """
    taken = 0
    for axis in range(first_axis, first_axis + num_axes):
        drive = records[axis // LANES]
        lane = axis % LANES
        if drive.fsa[lane] != fsa.ENABLED:
            continue
        drive.fault[lane] = cause + 1
        drive.error_register[lane] |= GENERIC_ERROR | _REGISTER[cause]
        fsa.fault(drive, lane, _CUTS & (1 << cause) != 0)
        taken += 1
    return taken


@stage
def fault_flags(drive, lane):
    """Return the bits of 2101h that tell what is wrong now, in whatever state the drive is."""
    causes = drive.present[lane]
    if drive.fault[lane] > 0:
        causes |= 1 << (drive.fault[lane] - 1) & _HELD
    flags = 0
    for cause in range(1, len(_FLAGS)):
        if causes & 1 << cause:
            flags |= _FLAGS[cause]
    return flags


@stage
def limit_bit(drive, lane):
    """Return bit 11 of the statusword while the axis is past a software limit."""
    return 0x0800 if drive.active[lane] & _SOFTWARE else 0
