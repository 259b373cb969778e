"""The NMT slave: states, commands, and the services active in each state (CiA 301, 7.3.2)."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple


class NmtState(IntEnum):
    """NMT state; the number is the one in heartbeats and guarding."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class Command(IntEnum):
    """Command specifier of an NMT frame."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


class Services(NamedTuple):
    """A row of CiA 301, table 37: the active services of a state; NMT and error control work in all three."""

    sdo: bool
    pdo: bool
    emergency: bool


SERVICES = {
    NmtState.INITIALISING: Services(sdo=False, pdo=False, emergency=False),
    NmtState.PRE_OPERATIONAL: Services(sdo=True, pdo=False, emergency=True),
    NmtState.OPERATIONAL: Services(sdo=True, pdo=True, emergency=True),
    NmtState.STOPPED: Services(sdo=False, pdo=False, emergency=False),
}

_COMMANDS = {int(command): command for command in Command}


def parse_command(data: bytes, node_id: int) -> Command | None:
    """Return the command of an NMT frame to all nodes (0) or this one; None if it has no command for it."""
    if len(data) != 2 or data[1] not in (0, node_id):
        return None
    return _COMMANDS.get(data[0])
