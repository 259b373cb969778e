"""Names of states, messages about refused states, and the way to Op (ETG.1000.6, table 11; ETG.1020)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from drive_env.ethercat.application import AlState, AlStatusCode
from drive_env.fieldbus.errors import BusError
from drive_env.master.ethercat.ethercat_master import EtherCatMaster, SlaveStatus

LOOK = 0.001  # s between two looks at a state
NAMES = {
    AlState.INIT: "Init", AlState.PRE_OP: "Pre-Op", AlState.BOOTSTRAP: "Bootstrap", AlState.SAFE_OP: "Safe-Op",
    AlState.OP: "Op",
}  # fmt: skip
MEANINGS = {
    AlStatusCode.MAILBOX: "its mailbox is not set as its EEPROM says",
    AlStatusCode.SM_WATCHDOG: "no process data came within its watchdog",
    AlStatusCode.OUTPUT_CONFIGURATION: "its outputs are not mapped as long as the master says",
    AlStatusCode.INPUT_CONFIGURATION: "its inputs are not mapped as long as the master says",
    AlStatusCode.NO_FREE_RUN: "it wants distributed clocks: open it with sync0=True",
    AlStatusCode.NO_SYNC: "it has no SYNC0: open it with sync0=True",
    AlStatusCode.DC_CYCLE_TIME: "SYNC0 comes too often for it",
}


def state_name(state: int) -> str:
    """Return the name of a state; for an undefined state its number."""
    return NAMES[AlState(state)] if state in AlState.__members__.values() else f"state {state}"


def refusal(position: int, wanted: AlState, status: SlaveStatus) -> str:
    """Return a message about a slave that does not reach a state."""
    if not status.state:
        return f"position {position} does not answer; check cable and power"
    code = status.code
    why = MEANINGS[AlStatusCode(code)] if code in {int(one) for one in MEANINGS} else "see the drive's manual"
    said = f"AL status code {code:04X}h: {why}" if code else "it gives no reason"
    return f"position {position} stays in {state_name(status.state)} and does not come to {state_name(wanted)}; {said}"


def take_to_op(
    master: EtherCatMaster,
    positions: Sequence[int],
    ask: Callable[[int], None],
    exchange: Callable[[], None] | None,
    timeout: float,
) -> None:
    """Request Op of slaves until all are there; `exchange` sends images meanwhile. BusError if one refuses."""
    for position in positions:
        ask(position)
    deadline = time.monotonic() + timeout
    while waiting := [(k, now) for k, now in ((k, master.status(k)) for k in positions) if not now.is_op]:
        refused = [(k, now) for k, now in waiting if now.has_error and not now.is_late]
        if refused or time.monotonic() > deadline:
            position, status = (refused or waiting)[0]
            raise BusError(refusal(position, AlState.OP, status))
        for position, status in waiting:
            if status.is_late:
                ask(position)
        if exchange is not None:
            exchange()
        master.alive()
        time.sleep(LOOK)
