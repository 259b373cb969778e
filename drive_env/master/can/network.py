"""The nodes of a bus as their master sees them: NMT commands, boot-up, emergencies."""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Iterable, Sequence
from functools import partial

from drive_env.canopen.frames import EMCY, ERROR_CONTROL, IDENTIFIER, INVALID, NMT
from drive_env.fieldbus.errors import NoAnswerError
from drive_env.fieldbus.link import ReceivedEmergency
from drive_env.master.can.port import Port

START, PRE_OPERATIONAL, RESET_NODE = 0x01, 0x80, 0x81  # NMT commands (CiA 301, 7.2.8.3.1)
BOOT_UP = 0x00  # in an error control message
BOOT_TIMEOUT = 5.0  # from a reset to the boot-up message [s]
HEARTBEATS_MISSED = 0x8130  # emergency code (CiA 301, table 26)
MAX_NODE = 127
_EMCY_LAYOUT = struct.Struct("<HB5s")


class Network:
    """Commands the nodes' communication states and collects their boot-ups, heartbeats and emergencies.

    Args:
        port: The bus.
        nodes: Node-IDs.
    """

    def __init__(self, port: Port, nodes: Sequence[int]) -> None:
        self._port = port
        self._nodes = tuple(nodes)
        self._emergencies: list[ReceivedEmergency] = []
        self._booted: set[int] = set()
        self._resets = False
        self.on_boot: Callable[[int], None] = lambda node: None
        self.on_restart: Callable[[int], None] = lambda node: None  # of a node that booted without our reset
        self.on_heartbeats_missed: Callable[[int], None] = lambda node: None  # which may have stopped it
        self.on_error_control: Callable[[int, bytes], None] | None = None
        for node in self._nodes:
            port.subscribe(EMCY + node, partial(self._on_emergency, node))
            port.subscribe(ERROR_CONTROL + node, partial(self._on_error_control, node))

    def move_emergencies(self, node: int, cob_id: int) -> None:
        """Receive a node's emergencies by the identifier in its 1014h."""
        if not cob_id & INVALID and cob_id & IDENTIFIER != EMCY + node:
            self._port.subscribe(EMCY + node, None)
            self._port.subscribe(cob_id & IDENTIFIER, partial(self._on_emergency, node))

    def command(self, command: int, nodes: Collection[int] | None = None) -> None:
        """Send an NMT command to nodes, all of ours by default; other nodes on the bus are left alone."""
        for node in self._nodes if nodes is None else nodes:
            self._port.send(NMT, bytes((command, node)))

    def reset(self, nodes: Collection[int]) -> None:
        """Reset nodes (NMT reset node) and wait until they have booted.

        Raises:
            NoAnswerError: If a node sends no boot-up message.
        """
        self._port.drain()
        self._booted.clear()
        self._resets = True
        try:
            self._reset(nodes)
        finally:
            self._resets = False

    def _reset(self, nodes: Collection[int]) -> None:
        self.command(RESET_NODE, nodes)
        if not self._port.wait(lambda: self._booted.issuperset(nodes), BOOT_TIMEOUT):
            silent = ", ".join(str(node) for node in sorted(set(nodes) - self._booted))
            raise NoAnswerError(
                f"node {silent} sent no boot-up message ({ERROR_CONTROL:03X}h + node) within {BOOT_TIMEOUT:g} s of "
                "its reset; check its power, then look for it with `drive-env scan`"
            )

    def take_emergencies(self) -> list[ReceivedEmergency]:
        """Return and forget the received emergencies, in their order."""
        self._port.drain()
        taken, self._emergencies[:] = list(self._emergencies), []
        return taken

    def _on_emergency(self, node: int, data: bytes) -> None:
        if len(data) == 8:
            code, register, extra = _EMCY_LAYOUT.unpack(data)
            self._emergencies.append(ReceivedEmergency(node, code, register, tuple(extra)))
            if code == HEARTBEATS_MISSED:
                self.on_heartbeats_missed(node)

    def _on_error_control(self, node: int, data: bytes) -> None:
        if self.on_error_control is not None:
            self.on_error_control(node, data)
        if data == bytes((BOOT_UP,)):
            self._booted.add(node)
            self.on_boot(node)
            if not self._resets:
                self.on_restart(node)


def check_nodes(nodes: Iterable[int]) -> tuple[int, ...]:
    """Return the node-IDs; ValueError if one is impossible or given twice, or the list is empty."""
    found = tuple(nodes)
    wrong = [node for node in found if not 1 <= node <= MAX_NODE]
    if not found or wrong or len(set(found)) != len(found):
        raise ValueError(f"nodes are different numbers of 1 to {MAX_NODE}, at least one; got {list(found)}")
    return found
