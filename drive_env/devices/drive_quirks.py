"""Quirks: deviations of a drive's profile from CiA 402: the table `quirks` of a device's data.

`defaults.toml` explains every quirk and has its value when off; the fields of `DriveQuirks` are those in the record.
Speeds in rpm are a unit of `bindings`; inhibit time in ms, bit 30 of an RPDO, latencies and block transfer are rows of
`canopen` (drive_env/devices/services.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from mechanics.reading.near_names import did_you_mean

MAY_BE_ABSENT = (4, 7, 9, 10, 11, 13, 14, 15)  # the others are the state, or part of a handshake
OF_OBJECTS = ("refuses_same_mode", "strict_transmission_types")  # not part of the record
LONGEST_DELAY = 1.0  # s


class DriveQuirks(NamedTuple):
    """Deviations of a drive's profile from the standard, as fields of the record.

    Attributes:
        mode_display_delay: From a write of 6060h until the mode changes [s].
        mode_change_needs_halt: Whether an enabled axis changes its mode only at rest, with halt set.
        absent_status_bits: Mask of the bits of 6041h that are never set.
        set_point_buffer: Set-points that pp keeps in addition to the one under way, 0 or 1.
        pv_slows_down_by_6084h: Whether pv slows down with 6084h, not with 6083h.
        pv_starts_and_stops: Whether pv jumps to the start velocity, and from the end velocity.
        homing_here_sets_zero: Whether homing methods 35 and 37 set the position to 0 for any 607Ch.
    """

    mode_display_delay: float = 0.0
    mode_change_needs_halt: bool = False
    absent_status_bits: int = 0
    set_point_buffer: int = 0
    pv_slows_down_by_6084h: bool = False
    pv_starts_and_stops: bool = False
    homing_here_sets_zero: bool = False


def drive_quirks_of(data: Mapping[str, Any]) -> DriveQuirks:
    """Return the quirks of a device's data; ValueError for an invalid key or value."""
    row = {name: value for name, value in data["quirks"].items() if name not in OF_OBJECTS}
    known = DriveQuirks._field_defaults
    for name, value in row.items():
        if name not in known:
            raise ValueError(f"quirks has no {name!r}{did_you_mean(name, (*known, *OF_OBJECTS))}")
        if isinstance(known[name], bool) and not isinstance(value, bool):
            raise ValueError(f"quirks.{name} = {value!r} must be true or false")
    delay, bits, buffer = row["mode_display_delay"], row["absent_status_bits"], row["set_point_buffer"]
    if isinstance(delay, bool) or not isinstance(delay, int | float) or not 0.0 <= delay <= LONGEST_DELAY:
        raise ValueError(f"quirks.mode_display_delay = {delay!r} must be 0 to {LONGEST_DELAY:g} s")
    if not isinstance(bits, list) or any(bit not in MAY_BE_ABSENT for bit in bits):
        raise ValueError(
            f"quirks.absent_status_bits = {bits!r} must be some of {', '.join(map(str, MAY_BE_ABSENT))}: the others "
            "are the state, or what a master waits for"
        )
    if buffer not in (0, 1) or isinstance(buffer, bool):
        raise ValueError(f"quirks.set_point_buffer = {buffer!r} must be 0, or 1 for one more set-point")
    row |= {"mode_display_delay": float(delay), "absent_status_bits": sum(1 << bit for bit in set(bits))}
    return DriveQuirks(**row)
