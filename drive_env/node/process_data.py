"""Process data of a node: objects that travel together, packed one behind the other, on whatever fieldbus."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.node import mapping
from drive_env.node.axis import ObjectPort

# What is received takes effect as a whole: set-points first, then the mode, then the controlword, whatever their order
# in it. A controlword that starts a move so finds the target of the same frame.
_RANK = {"": 0, "set_point": 0, "mode": 1, "controlword": 2}


def order_of_writing(events: Sequence[str]) -> list[int]:
    """Return the order in which objects take effect whose writes set off these events."""
    return sorted(range(len(events)), key=lambda k: _RANK[events[k]])


class MappedObjects:
    """Objects in the order in which they travel.

    Args:
        ports: The ways to them.

    Attributes:
        size: Length of their data [bytes].
    """

    def __init__(self, ports: Sequence[ObjectPort]) -> None:
        letters = [mapping.LAYOUT[port.entry.bits or 0][port.entry.signed] for port in ports]
        self._layout = struct.Struct("<" + "".join(letters))
        self.size = self._layout.size
        self._readers = [port.read for port in ports]
        self._plan = [(k, ports[k]) for k in order_of_writing([port.event for port in ports])]
        self._modes = [(k, port) for k, port in self._plan if port.event == "mode"]

    def __len__(self) -> int:
        return len(self._readers)

    def pack(self) -> bytes:
        """Return their values as they are now."""
        return self._layout.pack(*[read() for read in self._readers])

    def write(self, data: bytes) -> bool:
        """Write all of them, or none where one does not take its value; return whether they were written."""
        values = self._layout.unpack(data)
        plan = self._plan
        # Masters repeat the mode in every frame: what it is already is no write, which some drives would refuse.
        if self._modes:
            repeated = [k for k, port in self._modes if values[k] == port.read()]
            if repeated:
                plan = [(k, port) for k, port in plan if k not in repeated]
        try:
            for k, port in plan:
                port.check(values[k])
        except ObjectAccessError:
            return False
        for k, port in plan:
            port.write(values[k])
        return True
