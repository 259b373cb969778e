"""How the library acts where it could act otherwise, as data: as it did before, and as it shall."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from drive_env.cia402 import State

FIXED_ID, OWN_ID = 127, 126  # under which a master beats: the one of every process, or one that is its own

SHUTDOWN, SWITCH_ON, ENABLE, QUICK_STOP, DISABLE_VOLTAGE, ENABLE_AND_RESET = 0x06, 0x07, 0x0F, 0x02, 0x00, 0x8F
SET_POINT = -1  # among controlwords: a set-point for an axis that is live already

NO_POWER = frozenset(
    {State.NOT_READY_TO_SWITCH_ON, State.SWITCH_ON_DISABLED, State.READY_TO_SWITCH_ON, State.SWITCHED_ON, State.FAULT}
)
# States that no single controlword takes to operation enabled: a frame that comes late changes nothing.
DISABLED = NO_POWER - {State.READY_TO_SWITCH_ON, State.SWITCHED_ON}


@dataclass(frozen=True)
class Rules:
    """How the library acts where it could act otherwise.

    Attributes:
        name: For messages.
        live_from: An axis counts as live by what was written and answered, or from before an enabling frame is sent
            until 6041h, read back, says that it is off.
        arms_for: Before what the library arms: the controlword that enables; or also those that lead towards it, since
            an enabling frame of before may come late, and set-points for an axis that is found enabled.
        arms_in_lockstep: Whether `pace="lockstep"` arms, too.
        arms: Once in a session, or before each enabling frame: another master may have reset the node meanwhile.
        beats: Heartbeats before the first enabling frame; the drive watches from the first that arrives.
        beats_last: Heartbeats follow the NMT start by which a node that cannot be proved off is asked once more: it
            was stopped by its watchdog, which begins anew with them.
        operational: NMT start is sent, or seen to have worked.
        watches: A thread reads the drive's 6041h, NMT state and boot-up messages whatever the program does.
        misses: A silence is seen where all axes of a session are silent, or that of each by itself.
        own_id: The master's node-ID is the same for every process, or its own; a foreign heartbeat with it is seen.
        stops_in: The thread that stops; what interrupts the program interrupts the stop if it is the program's.
        handles: Signals that stop before they end the process.
        ramps_first: A stop begins with a quick stop.
        gives_up: 1016h is put back in any case, after proof that one axis of the node is off, or that each is.
        proof: 6041h read, or read after an answered "disable voltage": the answers of a node keep their order.
        off: States of the automaton that count as off in a proof.
        proves_anew: The proof of an earlier stop does not do when the drives are closed.
        checks: A call is let pass once, or each of its frames as it is sent, under a lock that the supervisor takes
            when it begins a stop or sees the watchdog gone.
    """

    name: str
    live_from: Literal["writes", "statusword"]
    arms_for: frozenset[int]
    arms_in_lockstep: bool
    arms: Literal["once", "each time"]
    beats: int
    beats_last: bool
    operational: Literal["sent", "seen"]
    watches: bool
    misses: Literal["all", "each"]
    own_id: bool
    stops_in: Literal["program", "supervisor"]
    handles: frozenset[str]
    ramps_first: bool
    gives_up: Literal["always", "one proven off", "proven off"]
    proof: Literal["read", "answered, then read"]
    off: frozenset[State]
    proves_anew: bool
    checks: Literal["calls", "frames"]


TODAY = Rules(
    name="TODAY",
    live_from="writes",
    arms_for=frozenset({ENABLE}),
    arms_in_lockstep=False,
    arms="once",
    beats=1,
    beats_last=False,
    operational="sent",
    watches=False,
    misses="all",
    own_id=False,
    stops_in="program",
    handles=frozenset({"INT"}),
    ramps_first=True,
    gives_up="always",
    proof="read",
    off=NO_POWER,
    proves_anew=False,
    checks="calls",
)
OURS = Rules(
    name="OURS",
    live_from="statusword",
    arms_for=frozenset({SHUTDOWN, SWITCH_ON, ENABLE, ENABLE_AND_RESET, SET_POINT}),
    arms_in_lockstep=True,
    arms="each time",
    beats=3,
    beats_last=True,
    operational="seen",
    watches=True,
    misses="each",
    own_id=True,
    stops_in="supervisor",
    handles=frozenset({"INT", "TERM"}),
    ramps_first=True,
    gives_up="proven off",
    proof="answered, then read",
    off=DISABLED,
    proves_anew=True,
    checks="frames",
)


@dataclass(frozen=True)
class Assumptions:
    """Assumptions about the world.

    Attributes:
        troubles: How many troubles a run has: a frame lost, held back or doubled, a node that falls silent, an act of
            another master, a second program with our node-ID, a fault of the drive, a pause of the process. Signals, a
            hung program and a kill do not count: they are always possible, but see `coincidences`.
        keeps_order: Frames of one identifier arrive in their order, as CAN controllers and the hub send them.
        coincidences: The process may be killed between an act of another master and the stop that it sets off: until
            the drive is in quick stop active or off, some 20 ms.
    """

    troubles: int = 2
    keeps_order: bool = True
    coincidences: bool = False
