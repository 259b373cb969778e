"""Identifiers for PDOs of further axes, for which a module of several axes has no default identifiers.

CiA 301 gives four PDOs of each direction to a node. Axis k of node n borrows those of node n + k, as if every axis were
a separate node: 281h is TPDO 2 of node 1, 282h the second TPDO of its axis 1. No other node may have that node-ID.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from drive_env.canopen.frames import SDO_REQUEST, SDO_RESPONSE
from drive_env.fieldbus.errors import BusError
from drive_env.master.can.port import Port

LOOK = 0.1  # s to wait for the answer of a node
_DEVICE_TYPE = bytes((0x40, 0x00, 0x10, 0, 0, 0, 0, 0))  # SDO request of 1000h, which every node has
HIGHEST = 127


class BorrowedIdentifiers:
    """Node-IDs whose identifiers our nodes' further axes use.

    Args:
        port: The bus.
        nodes: Our node-IDs.
        num_axes: Axes of each.
    """

    def __init__(self, port: Port, nodes: Sequence[int], num_axes: int) -> None:
        self._port = port
        self._nodes = tuple(nodes)
        self._num_axes = num_axes
        self._free: set[int] = set()  # node-IDs at which no node answers

    def node_of(self, node: int, axis: int) -> int:
        """Return the node-ID whose identifiers an axis of a node uses.

        Raises:
            BusError: If that node-ID is too high or in use, by one of our nodes or another.
        """
        if node not in self._free:
            self._look(node)
            self._free.add(node)
        return node + axis

    def _look(self, node: int) -> None:
        wanted = range(node + 1, node + self._num_axes)
        remedy = "give the nodes other IDs, or those PDOs (14xxh:01, 18xxh:01) identifiers of their own, and store both"
        if wanted[-1] > HIGHEST:
            raise BusError(
                f"node {node} has {self._num_axes} axes, whose PDOs would borrow the identifiers of nodes "
                f"{wanted[0]} to {wanted[-1]}: the highest node-ID is {HIGHEST}; {remedy}"
            )
        taken = {one for one in wanted if one in self._nodes}
        others = [one for one in wanted if one not in taken]
        heard: set[int] = set()
        for one in others:
            self._port.subscribe(SDO_RESPONSE + one, partial(_note, heard, one))
            self._port.send(SDO_REQUEST + one, _DEVICE_TYPE)
        self._port.wait(lambda: len(heard) == len(others), LOOK)
        for one in others:
            self._port.subscribe(SDO_RESPONSE + one, None)
        if taken | heard:
            there = ", ".join(map(str, sorted(taken | heard)))
            raise BusError(
                f"node {node} has {self._num_axes} axes, whose PDOs would borrow the identifiers of nodes "
                f"{wanted[0]} to {wanted[-1]}, and node {there} is there: {remedy}"
            )


def _note(heard: set[int], node: int, data: bytes) -> None:
    heard.add(node)
