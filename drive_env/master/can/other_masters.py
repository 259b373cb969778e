"""Detects another master of the nodes by frames that only a master sends and that are not ours.

A program receives every frame of the bus but its own, so a frame with such an identifier is from another master.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from drive_env.canopen.frames import NMT, RPDO, SDO_REQUEST, SYNC
from drive_env.fieldbus.errors import BusError
from drive_env.master.can.port import Port


class OtherMastersError(BusError):
    """Another master commands the nodes, so that our commands and its own would disturb each other."""


class OtherMasters:
    """Listens for other masters whenever frames are received from the port.

    Args:
        port: The bus.
        nodes: Node-IDs that matter; RPDOs are those of the predefined connection set.

    Attributes:
        heard: Description of the first such frame; "" if there was none.
    """

    def __init__(self, port: Port, nodes: Sequence[int]) -> None:
        self.heard = ""
        self._port = port
        kinds = {NMT: "an NMT command (000h)", SYNC: "a SYNC (080h)"}
        for node in nodes:
            kinds[SDO_REQUEST + node] = f"an SDO request to node {node} ({SDO_REQUEST + node:03X}h)"
            kinds |= {base + node: f"an RPDO of node {node} ({base + node:03X}h)" for base in RPDO}
        for can_id, what in kinds.items():
            port.subscribe(can_id, partial(self._hear, what))

    def listen(self, seconds: float) -> None:
        """Listen for some seconds, without sending.

        Raises:
            OtherMastersError: If another master is heard.
        """
        self._port.wait(lambda: bool(self.heard), seconds)
        self.check()

    def check(self) -> None:
        """Raise OtherMastersError if another master was heard so far."""
        if self.heard:
            raise OtherMastersError(
                f"another master commands the bus: {self.heard} came that is not ours; PDOs and SYNCs of two masters "
                "disturb each other, and samples would be wrong: end the other one, or use "
                "`drive-env frames log`, which only listens"
            )

    def _hear(self, what: str, data: bytes) -> None:
        self.heard = self.heard or what
