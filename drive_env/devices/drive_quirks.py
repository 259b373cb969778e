"""Quirks of a drive's profile, where real ones differ from CiA 402: the table `quirks` of a device's data.

Each is a switch that is off where a device does not name it:

    refuses_same_mode           6060h cannot be written with the mode that it has (08000022h): some firmwares begin a
                                mode anew with each write, and so forbid it
    mode_display_delay          s from the write of 6060h until mode and 6061h change: a firmware that changes modes in
                                a slow task; a master that goes on at once is still in the mode before
    mode_change_needs_halt      an enabled axis changes its mode only at rest with halt (controlword bit 8) set: the
                                firmware does not hand a motion over from one generator to another
    absent_status_bits          bits of 6041h that never come: CiA 402 leaves 4, 7, 9, 10 ... 15 to the maker in part
    set_point_buffer            1: pp keeps a second set-point while it moves to the first, bit 12 stays while the
                                buffer is full, and bit 5 of the controlword changes the set-point at once (CiA 402-2);
                                0: each set-point replaces the one before, whatever bit 5 is
    pv_slows_down_by_6084h      pv speeds up with 6083h and slows down with 6084h (CiA 402-2); else with 6083h both ways
    pv_starts_and_stops         pv begins with a jump to 2010h and ends with one from 6082h, as pp does
    strict_transmission_types   a PDO takes the types of the table `strict_transmission_types` alone

Speeds in rpm are a unit of `bindings`; inhibit time in ms, bit 30 of an RPDO, latencies and block transfer are rows of
`canopen` (drive_env/devices/services.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from mechanics.near_names import did_you_mean

MAY_BE_ABSENT = (4, 7, 9, 10, 11, 13, 14, 15)  # the others are the state, or what a handshake waits for
NO_SWITCH: dict[str, Any] = {
    "mode_display_delay": 0.0, "mode_change_needs_halt": False, "absent_status_bits": [], "set_point_buffer": 0,
    "pv_slows_down_by_6084h": False, "pv_starts_and_stops": False,
}  # fmt: skip
SWITCHES = ("mode_change_needs_halt", "pv_slows_down_by_6084h", "pv_starts_and_stops")
ALWAYS = ("refuses_same_mode", "strict_transmission_types")
LONGEST_DELAY = 1.0  # s


class DriveQuirks(NamedTuple):
    """Where a drive's profile differs from the standard, as the record has it.

    Attributes:
        mode_display_delay: From a write of 6060h until the mode changes [s].
        mode_change_needs_halt: An enabled axis changes its mode only at rest, with halt set.
        absent_status_bits: Mask of the bits of 6041h that never come.
        set_point_buffer: Set-points that pp keeps besides the one under way, 0 or 1.
        pv_slows_down_by_6084h: pv slows down with 6084h, not with 6083h.
        pv_starts_and_stops: pv jumps to the start velocity, and from the end velocity.
    """

    mode_display_delay: float = 0.0
    mode_change_needs_halt: bool = False
    absent_status_bits: int = 0
    set_point_buffer: int = 0
    pv_slows_down_by_6084h: bool = False
    pv_starts_and_stops: bool = False


def drive_quirks_of(data: Mapping[str, Any]) -> DriveQuirks:
    """Return the quirks of a device's data; ValueError for a key or a value that cannot be."""
    row = data["quirks"]
    for key in row:
        if key not in NO_SWITCH and key not in ALWAYS:
            raise ValueError(f"quirks has no {key!r}{did_you_mean(key, (*NO_SWITCH, *ALWAYS))}")
    row = {**NO_SWITCH, **row}
    delay, bits, buffer = row["mode_display_delay"], row["absent_status_bits"], row["set_point_buffer"]
    if isinstance(delay, bool) or not isinstance(delay, int | float) or not 0.0 <= delay <= LONGEST_DELAY:
        raise ValueError(f"quirks.mode_display_delay = {delay!r} must be 0 to {LONGEST_DELAY:g} s")
    for name in SWITCHES:
        if not isinstance(row[name], bool):
            raise ValueError(f"quirks.{name} = {row[name]!r} must be true or false")
    if not isinstance(bits, list) or any(bit not in MAY_BE_ABSENT for bit in bits):
        raise ValueError(
            f"quirks.absent_status_bits = {bits!r} must be some of {', '.join(map(str, MAY_BE_ABSENT))}: the others "
            "are the state, or what a master waits for"
        )
    if buffer not in (0, 1) or isinstance(buffer, bool):
        raise ValueError(f"quirks.set_point_buffer = {buffer!r} must be 0, or 1 for one more set-point")
    needs_halt, *of_pv = (row[name] for name in SWITCHES)
    return DriveQuirks(float(delay), needs_halt, sum(1 << bit for bit in set(bits)), buffer, *of_pv)
