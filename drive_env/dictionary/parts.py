"""Objects that show a part of another object, of the same axis or of a certain axis of the node.

Their rows in a device's table `parts`: `of` is the whole object, or one for each axis of the node, `axis` the axis; the
part is `bits` from `shift` on, as a signed number with `signed`; or a `share` of the number (first over second); or a
number looked up in `table`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from drive_env.cia402 import Key


class Part(NamedTuple):
    """A row.

    Attributes:
        of: The object, or one for each axis of the node.
        axis: Number in the node of the whole object's axis; None: the same axis.
        shift: Lowest of its bits.
        bits: Number of bits.
        signed: Whether the highest bit is a sign.
        table: Pairs of a whole number and the number shown for it, instead of bits.
        share: Numerator and divisor of the share shown of the whole number instead; (0, 1) shows bits.
    """

    of: tuple[Key, ...]
    axis: int | None = None
    shift: int = 0
    bits: int = 32
    signed: bool = False
    share: tuple[int, int] = (0, 1)
    table: tuple[tuple[int, int], ...] = ()

    def source(self, axis: int) -> Key:
        """Return the whole object of a part that an axis of the node shows."""
        return self.of[axis % len(self.of)]

    def shown(self, raw: Any) -> Any:
        """Return the part of the whole object's integers."""
        if self.table:
            return sum((raw == whole) * shown for whole, shown in self.table)
        numerator, divisor = self.share
        if numerator:
            return raw * numerator // divisor
        found = (raw >> self.shift) & ((1 << self.bits) - 1)
        return found - ((found >> (self.bits - 1)) << self.bits) if self.signed else found

    def put(self, raw: Any, part: Any) -> Any:
        """Return the whole object's integers with another part."""
        if self.table:
            return sum((part == shown) * whole for whole, shown in self.table)
        mask = ((1 << self.bits) - 1) << self.shift
        mask -= (mask >> 63) << 64  # as a signed number of 64 bits
        return (raw & ~mask) | ((part << self.shift) & mask)


def parts_of(rows: Mapping[Key, Mapping[str, Any]], parse: Any) -> dict[Key, Part]:
    """Return a device's table; `parse` makes a key of a text."""
    return {
        key: Part(tuple(parse(text) for text in row["of"]), **{k: v for k, v in row.items() if k != "of"})
        for key, row in rows.items()
    }
