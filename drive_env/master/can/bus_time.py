"""Whether the frames of a cycle fit into it: SYNC, and the PDOs of all axes that go with it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from drive_env.dictionary.entries import Entry

BIT_RATE = 1_000_000  # bit/s, the highest of classical CAN
FRAME_BITS = 47  # of a frame without data, the gap after it included (ISO 11898-1)
SHARE = 0.8  # share of a cycle for PDOs beyond the requested ones: SDO requests and emergencies need the rest


class BusTime(NamedTuple):
    """Capacity of the bus in a cycle: `bit_rate` [bit/s], `cycle` [s]; inf if frames take no time."""

    bit_rate: float = BIT_RATE
    cycle: float = math.inf

    def has_room_besides(self, groups: Iterable[Sequence[Entry]], axes: int) -> bool:
        """Return whether PDOs of these groups, for this number of axes, leave room even with the most stuff bits."""
        bits = FRAME_BITS + axes * sum(_most(group) for group in groups)
        return bits <= SHARE * self.bit_rate * self.cycle

    def excess(self, groups: Sequence[Sequence[Entry]], axes: int) -> str | None:
        """Return a message about PDOs that cannot all go with a SYNC, even without stuff bits; None if they can.

        Args:
            groups: The entries of each PDO of an axis.
            axes: Axes of all nodes.
        """
        needed = (FRAME_BITS + axes * sum(map(_least, groups))) / self.bit_rate
        if needed <= self.cycle:
            return None
        return (
            f"{axes * len(groups)} PDOs of {axes} axes take at least {1e3 * needed:.2g} ms of a bus of "
            f"{self.bit_rate / 1e3:g} kbit/s, and SYNC comes every {1e3 * self.cycle:g} ms; record and play fewer "
            f"objects at a time, or give a longer cycle (in Python CanDrives(cycle={math.ceil(1250 * needed) / 1e3:g}))"
        )


def _least(group: Sequence[Entry]) -> int:
    return FRAME_BITS + sum(entry.bits or 0 for entry in group)


def _most(group: Sequence[Entry]) -> int:
    stuffed = 34 + sum(entry.bits or 0 for entry in group)
    return _least(group) + (stuffed - 1) // 4
