"""Process data of a node: objects that are sent together, packed one after the other, on any fieldbus.

Each field acts by itself: an object that does not accept its value keeps the old one, and the other fields act all the
same. So a stop never fails because of another field.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

from drive_env import cia402
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.node import mapping
from drive_env.node.axis import ObjectPort

_MASK, _ENABLES = cia402.COMMANDS["enable operation"]
_RANK = {"mode": 1, "controlword": 2}  # all others have 0


class ReceivedFields:
    """Fields of the data that a node receives, and the objects behind them.

    Args:
        ports: The port of each field's object.
    """

    def __init__(self, ports: Sequence[ObjectPort]) -> None:
        order = sorted(range(len(ports)), key=lambda k: _RANK.get(ports[k].event, 0))
        # Masters repeat the mode in every frame: the present mode again is not written, since some drives would refuse
        # it.
        rows = [(k, ports[k], ports[k].read if ports[k].event == "mode" else None) for k in order]
        self._plan = [(k, port.fit, repeats, port.check, port.write) for k, port, repeats in rows]
        self._controlwords = [k for k in order if ports[k].event == "controlword"]

    def write(self, values: Sequence[int]) -> bool:
        """Write each value that its object accepts; return whether all were accepted.

        Regardless of the order of the fields, controlwords that stop act first. Then come set-points, modes, and
        controlwords that enable operation, so that a controlword which starts a move acts on the target of the same
        frame.
        """
        plan = self._plan
        stops = [k for k in self._controlwords if values[k] & _MASK != _ENABLES]
        if stops:
            plan = sorted(plan, key=lambda row: row[0] not in stops)
        all_taken = True
        for k, fit, repeats, check, write in plan:
            value = values[k] if fit is None else fit(values[k])
            if repeats is not None and value == repeats():
                continue
            try:
                check(value)
                write(value)
            except ObjectAccessError:
                all_taken = False
        return all_taken


class MappedObjects:
    """Objects in the order in which they are sent.

    Args:
        fields: Their ports; for a gap, its length [bits]. Objects begin on a byte.

    Attributes:
        size: Length of their data [bytes].
    """

    def __init__(self, fields: Sequence[ObjectPort | int]) -> None:
        letters, gap, ports = "<", 0, []
        for field in fields:
            if isinstance(field, int):
                gap += field
                continue
            letters += f"{gap // 8}x{mapping.LAYOUT[field.entry.bits or 0][field.entry.signed]}"
            gap = 0
            ports.append(field)
        self._layout = struct.Struct(f"{letters}{gap // 8}x")
        self.size = self._layout.size
        self._readers = [port.read for port in ports]
        self._fields = ReceivedFields(ports)

    def __len__(self) -> int:
        return len(self._readers)

    def pack(self) -> bytes:
        """Return the present values."""
        return self._layout.pack(*[read() for read in self._readers])

    def write(self, data: bytes) -> bool:
        """Write each object that accepts its value; return whether all did."""
        return self._fields.write(self._layout.unpack(data))
