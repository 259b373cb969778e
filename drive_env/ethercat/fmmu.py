"""FMMUs: map bits of a master's logical address space to a slave's memory (ETG.1000.4, 6.6)."""

from __future__ import annotations

import struct
from typing import NamedTuple


class Fmmu(NamedTuple):
    """An active FMMU: `num_bits` from `logical_bit` on are mapped to the slave's memory from `physical_bit` on.

    Both count bits from the beginning of their memory. `first` and `end` [bytes] are the logical addresses that it
    covers; `offset` [bytes] is added to a logical address if all is aligned to bytes, otherwise it is None.
    """

    first: int
    end: int
    logical_bit: int
    physical_bit: int
    num_bits: int
    reads: bool
    writes: bool
    offset: int | None


def parse(registers: bytes | bytearray) -> Fmmu | None:
    """Parse the 16 bytes of an FMMU's registers; None if it is off, or maps nothing."""
    start, length, first_bit, last_bit, physical, physical_bit, kind, active = struct.unpack_from(
        "<IHBBHBBB", registers
    )
    num_bits = 8 * (length - 1) + last_bit - first_bit + 1
    if not active & 1 or length == 0 or num_bits <= 0:
        return None
    is_aligned = first_bit == 0 and last_bit == 7 and physical_bit == 0
    return Fmmu(
        start, start + length, 8 * start + first_bit, 8 * physical + physical_bit, num_bits,
        bool(kind & 1), bool(kind & 2), physical - start if is_aligned else None,
    )  # fmt: skip


def copy_bits(source: bytes | bytearray, from_bit: int, target: bytearray, to_bit: int, count: int) -> None:
    """Copy `count` bits; bit 0 is the lowest of byte 0. Other bits of the target are unchanged."""
    value = int.from_bytes(source, "little") >> from_bit & ((1 << count) - 1)
    mask = ((1 << count) - 1) << to_bit
    whole = int.from_bytes(target, "little") & ~mask | value << to_bit
    target[:] = whole.to_bytes(len(target), "little")
