"""TPDOs that come with the SYNCs of a run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drive_env.canopen.frames import SYNC
from drive_env.cia402 import Key
from drive_env.fieldbus.errors import BusError, NoAnswerError
from drive_env.master.can.pdo import RemotePdo
from drive_env.master.can.port import Port
from drive_env.master.packing import Bytes, unpack_rows
from mechanics.arrays import Integers


class PdoSamples:
    """The TPDOs that come with the SYNCs of a run; the k-th frame of each belongs to the k-th SYNC.

    Args:
        port: The bus.
        of_nodes: The PDOs to collect, node by node.
        axes_per_node: Axes of a node.
    """

    def __init__(self, port: Port, of_nodes: Sequence[Sequence[RemotePdo]], axes_per_node: int) -> None:
        self._port = port
        self._of_nodes = of_nodes
        self._axes_per_node = axes_per_node
        self._pdos = pdos = [pdo for of_node in of_nodes for pdo in of_node]
        port.drain()  # frames of an earlier run belong to its SYNCs
        self.frames: list[list[bytes]] = [[] for _ in pdos]
        for pdo, frames in zip(pdos, self.frames, strict=True):
            port.subscribe(pdo.can_id, frames.append)

    def complete(self) -> int:
        """Return how many rows are complete."""
        return min((len(frames) for frames in self.frames), default=0)

    def decode(self, first: int, last: int) -> dict[Key, Integers]:
        """Return the integers of rows `first` to `last` (excluded), each object of shape (rows, num_axes).

        Raises:
            BusError: If a frame has another length than its mapping.
        """
        values: dict[Key, Integers] = {}
        number, num_axes = 0, len(self._of_nodes) * self._axes_per_node
        for k, pdos in enumerate(self._of_nodes):
            for pdo in pdos:
                data = self.bytes_of(number, first, last)
                unpack_rows(values, data, pdo.members, k * self._axes_per_node, num_axes)
                number += 1
        return values

    def close(self) -> None:
        """Stop collecting."""
        for pdo in self._pdos:
            self._port.subscribe(pdo.can_id, None)

    def missing(self, rows: int, timeout: float) -> NoAnswerError:
        """Return the error for a TPDO that did not come."""
        pdo, frames = min(zip(self._pdos, self.frames, strict=True), key=lambda pair: len(pair[1]))
        late = {pdo for pdo, frames in zip(self._pdos, self.frames, strict=True) if len(frames) < rows}
        return NoAnswerError(
            f"{pdo.label} ({pdo.can_id:03X}h) came {len(frames)} times for {rows} SYNCs, and no more within "
            f"{timeout:g} s; check that the node is operational and takes SYNC as {SYNC:03X}h (1005h), and the bus "
            "load",
            [k for k, of_node in enumerate(self._of_nodes) if not late.isdisjoint(of_node)],
        )

    def bytes_of(self, number: int, first: int, last: int) -> Bytes:
        """Return rows `first` to `last` (excluded) of TPDO `number` of this run, shape (rows, length).

        Raises:
            BusError: If a frame has another length than its mapping.
        """
        pdo = self._pdos[number]
        rows = self.frames[number][first:last]
        wrong = [row for row in rows if len(row) != pdo.length]
        if wrong:
            raise BusError(
                f"{pdo.label} ({pdo.can_id:03X}h) has {pdo.length} bytes by its mapping, and {len(wrong[0])} came: "
                f"{wrong[0].hex(' ')}; is another node or master using this identifier?"
            )
        return np.frombuffer(b"".join(rows), np.uint8).reshape(len(rows), pdo.length)
