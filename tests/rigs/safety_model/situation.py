"""Everything that matters at one moment of a session, and the steps from it."""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum
from typing import Literal, NamedTuple

from drive_env.canopen.nmt import SERVICES, NmtState
from drive_env.cia402 import State as Fsa
from rigs.safety_model.drive import NOBODY, Drive
from rigs.safety_model.rules import ENABLE, FIXED_ID, OWN_ID, Assumptions, Rules


class _Place(Enum):
    """An enumeration whose members, which are in millions of keys, have the hash of any object."""

    __hash__ = object.__hash__


class At(_Place):
    """Where the program's thread is."""

    PROGRAM = "between two calls"
    ARM = "about to arm"
    ARMED = "armed, and about to send what was checked before"
    SEND = "about to send what was checked"
    STALLED = "hung"
    LEAVING = "leaving"
    RESTORE = "about to put 1016h back"
    RESTORE_AGAIN = "about to put 1016h back once more"
    CLOSED = "closed"
    DEAD = "dead"


class StopStage(_Place):
    """How far a stop is."""

    NONE = "none"
    QUICK = "about to send the quick stop"
    RAMP = "looking at the ramp"
    CUT = "about to switch the voltage off"
    PROVE = "about to read 6041h"
    PROVEN = "proven off"
    UNPROVEN = "not proven off"


class Hand(_Place):
    """Who enabled or commanded the axis last."""

    NOBODY = "nobody"
    OURS = "ours"
    OTHER = "another master's"


class Held(NamedTuple):
    """A frame that was held back: its identifier's part ("request", "answer", "rpdo") and its content."""

    kind: Literal["request", "answer", "rpdo"]
    content: object


ACKNOWLEDGED = "acknowledged"  # content of an answer to a write of 6040h; that to a read of 6041h is a state


class Situation(NamedTuple):
    """Everything that matters at one moment."""

    drive: Drive = Drive()
    at: At = At.PROGRAM
    rows: tuple[int, ...] = ()  # controlwords, or SET_POINT, that the present call has still to send
    by_pdo: bool = False
    cancelled: bool = False  # a stop has begun since the present call was checked
    believed: bool = False  # the envelope takes the axis for live
    armed: bool = False  # the supervisor runs, and sends heartbeats
    lockstep: bool = False  # as the program chose; the bus is one of real time all the same
    stop: StopStage = StopStage.NONE
    ramped: bool = False  # this stop has sent its quick stop
    acknowledged: bool = False  # this stop's last controlword was answered
    interfered: bool = False  # another master acted, and what follows of it is not done yet
    twin: int = NOBODY  # node-ID of another program's heartbeats
    silent: bool = False  # the node hears and sends nothing any more, while the session's other axes are heard
    hand: Hand = Hand.NOBODY
    held: tuple[Held, ...] = ()
    troubles: int = 0  # that are still to come


class Step(NamedTuple):
    """A possible step: its kind, its text for an engineer, and the situation after it."""

    kind: str
    text: str
    after: Situation


LIBRARY, DRIVE = "library", "drive"  # kinds of steps that happen by themselves
GONE = (At.CLOSED, At.DEAD)
IN_A_STOP = (StopStage.QUICK, StopStage.RAMP, StopStage.CUT, StopStage.PROVE)
Steps = Iterator[Step]


def beginnings(rules: Rules, assumptions: Assumptions) -> Iterator[Situation]:
    """Return the situations in which a session may begin: the axis off, or enabled by another master and turning."""
    found = Drive(fsa=Fsa.OPERATION_ENABLED, turns=True, word=ENABLE, nmt=NmtState.OPERATIONAL)
    for lockstep in (False,) if rules.arms_in_lockstep else (False, True):  # then it makes no difference
        for drive, hand in ((Drive(), Hand.NOBODY), (found, Hand.OTHER)):
            yield Situation(drive, lockstep=lockstep, hand=hand, troubles=assumptions.troubles)


def master_id(rules: Rules) -> int:
    """Return the node-ID under which the master sends heartbeats."""
    return OWN_ID if rules.own_id else FIXED_ID


def beating(s: Situation, rules: Rules) -> frozenset[int]:
    """Return the node-IDs whose heartbeats are on the bus."""
    ours = s.armed and s.at not in GONE and (rules.arms_in_lockstep or not s.lockstep)
    return frozenset(({master_id(rules)} if ours else set()) | ({s.twin} if s.twin else set()))


def moved(s: Situation, drive: Drive, by: Hand) -> Situation:
    """Return the situation with another drive, which was moved by a frame of `by`."""
    hand = Hand.NOBODY if not drive.live else by if not s.drive.live else s.hand
    return s._replace(drive=drive, hand=hand)


def has_sdo(s: Situation) -> bool:
    """Return whether the node answers SDO."""
    return SERVICES[s.drive.nmt].sdo


def refused(s: Situation) -> Situation:
    """Return the situation back in the program, whose call ends here."""
    return s._replace(at=At.PROGRAM, rows=(), by_pdo=False, cancelled=False)


def left(s: Situation, rules: Rules) -> Situation:
    """Return the situation in which the program has begun to leave."""
    proven = s.stop is StopStage.PROVEN and not rules.proves_anew
    stop = s.stop if s.stop in IN_A_STOP or s.stop is StopStage.UNPROVEN or proven else StopStage.NONE
    return s._replace(at=At.LEAVING, rows=(), by_pdo=False, cancelled=False, stop=stop)


def ended(s: Situation, at: At) -> Situation:
    """Return the situation without the process: its drive, who else beats, and frames on their way to the drive."""
    held = tuple(frame for frame in s.held if frame.kind != "answer")
    return Situation(s.drive, at, hand=s.hand, twin=s.twin, silent=s.silent, held=held)


def begun(s: Situation, rules: Rules) -> Situation:
    """Return the situation with a stop begun."""
    stop = StopStage.QUICK if rules.ramps_first else StopStage.CUT
    believed = rules.live_from == "statusword"  # TODAY forgets what it stops before it has stopped
    cancelled = s.at in (At.ARM, At.ARMED, At.SEND)
    return s._replace(stop=stop, ramped=False, acknowledged=False, believed=believed, cancelled=cancelled)


def joined(what: str, more: str) -> str:
    """Join an action and its consequence; without a consequence the action alone."""
    return f"{what}; {more}" if more else what
