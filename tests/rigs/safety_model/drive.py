"""One axis and its node as the safety model sees them: explicit states, moved by the tables that the emulator runs by.

The automaton is TRANSITIONS of `firmware/common/fsa.py`, what lives in which NMT state is SERVICES of `canopen/nmt.py`,
and the heartbeat consumer's rule is that of `canopen/error_control.py`: watching begins with the first heartbeat, and a
loss is reported once. Time is counted in ticks. A tick is longer than the silence that the consumer allows and longer
than any ramp, so that what a drive does by itself is done within one.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

from drive_env import cia402
from drive_env.canopen.nmt import SERVICES, Command, NmtState
from drive_env.cia402 import State
from drive_env.firmware.common.fsa import TRANSITIONS

NOBODY = 0  # node-ID in 1016h: no node is watched
LIVE = frozenset({State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE})
# 605Ah = 2, as the envelope asks for: after the ramp transition 12, and transition 16 does not exist.
_COMMANDED = {
    (row.start, row.command): row for row in TRANSITIONS if row.number not in (15, 16)
}  # 15 takes an edge, see write_controlword
# Transitions that no command makes: 1, 12 and 14; 13 leads into the reaction to a fault.
_BY_ITSELF = {
    State.NOT_READY_TO_SWITCH_ON: State.SWITCH_ON_DISABLED,
    State.QUICK_STOP_ACTIVE: State.SWITCH_ON_DISABLED,
    State.FAULT_REACTION_ACTIVE: State.FAULT,
}
_FAULT_REACTION = State.FAULT_REACTION_ACTIVE
_DISABLE_OPERATION = 5


class Drive(NamedTuple):
    """A node with one axis.

    Attributes:
        fsa: State of CiA 402's automaton.
        turns: Whether the rotor turns, driven or coasting.
        ramps: Whether transition 5 waits for its ramp.
        word: The last controlword, as far as it matters: bit 7, and all of it while a ramp of transition 5 runs.
        nmt: NMT state.
        consumer: Node-ID in 1016h.
        heard: Whether watching has begun: that node's heartbeat came since 1016h was written, or since the last loss.
        latched: The controlword in an RPDO that waits for SYNC, or None.
    """

    fsa: State = State.SWITCH_ON_DISABLED
    turns: bool = False
    ramps: bool = False
    word: int = 0
    nmt: NmtState = NmtState.PRE_OPERATIONAL
    consumer: int = NOBODY
    heard: bool = False
    latched: int | None = None

    @property
    def live(self) -> bool:
        """Whether the motor has current, as 6041h tells."""
        return self.fsa in LIVE


@cache  # a drive has some hundred states, and each is asked for again and again
def write_controlword(drive: Drive, word: int) -> Drive:
    """Return the drive after a write of 6040h, which is processed completely at once."""
    rises = word & cia402.FAULT_RESET and not drive.word & cia402.FAULT_RESET
    drive = drive._replace(word=word)
    if rises and drive.fsa is State.FAULT:
        drive = drive._replace(fsa=State.SWITCH_ON_DISABLED)
    return _remembering_less(_command(drive))


def _remembering_less(drive: Drive) -> Drive:
    """Return the drive without controlword bits that no longer matter, so that equal futures are equal states."""
    return drive if drive.ramps else drive._replace(word=drive.word & cia402.FAULT_RESET)


def _command(drive: Drive) -> Drive:
    """Take every transition that the controlword commands: of "switch on & enable operation" two."""
    for _ in range(2):
        row = next(
            (
                row
                for (start, command), row in _COMMANDED.items()
                if start is drive.fsa and drive.word & command.mask == command.value
            ),
            None,
        )
        # While a disable-operation ramp runs, only disable voltage is obeyed.
        if row is None or (drive.ramps and row.number != 9):
            return drive
        if row.number == _DISABLE_OPERATION:
            return drive._replace(ramps=True)
        drive = drive._replace(fsa=row.end, ramps=False)
    return drive


def trip(drive: Drive) -> Drive:
    """Return the drive after a fault that ramps: transition 13, from operation enabled alone."""
    if drive.fsa is not State.OPERATION_ENABLED:
        return drive
    return _remembering_less(drive._replace(fsa=_FAULT_REACTION, ramps=False))


@cache
def take_nmt(drive: Drive, command: Command) -> Drive:
    """Return the drive after an NMT command."""
    if command in (Command.RESET_NODE, Command.RESET_COMMUNICATION):
        drive = drive._replace(nmt=NmtState.PRE_OPERATIONAL, consumer=NOBODY, heard=False, latched=None)
        if command is Command.RESET_NODE:
            # Not ready to switch on is passed before the boot-up message, after which frames can come.
            drive = drive._replace(fsa=State.SWITCH_ON_DISABLED, ramps=False, word=0)
        return drive
    target = {
        Command.START: NmtState.OPERATIONAL,
        Command.STOP: NmtState.STOPPED,
        Command.ENTER_PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
    }[command]
    return _enter(drive, target)


def _enter(drive: Drive, nmt: NmtState) -> Drive:
    """Enter an NMT state; entering Stopped is the one link to the axis' automaton."""
    if nmt is drive.nmt:
        return drive
    drive = drive._replace(nmt=nmt, latched=None)
    return trip(drive) if nmt is NmtState.STOPPED else drive


def write_consumer(drive: Drive, node: int) -> Drive:
    """Return the drive after a write of 1016h: the node that it watches must be heard anew."""
    return drive._replace(consumer=node, heard=False)


def hear(drive: Drive, node: int) -> Drive:
    """Return the drive after a heartbeat of a node."""
    return drive._replace(heard=True) if node == drive.consumer != NOBODY else drive


def latch(drive: Drive, word: int) -> Drive:
    """Return the drive after an RPDO with a controlword."""
    return drive._replace(latched=word) if SERVICES[drive.nmt].pdo else drive


@cache
def sync(drive: Drive) -> Drive:
    """Return the drive after a SYNC."""
    if drive.latched is None or not SERVICES[drive.nmt].pdo:
        return drive
    return write_controlword(drive._replace(latched=None), drive.latched)


@cache
def tick(drive: Drive, beating: frozenset[int]) -> Drive:
    """Return the drive after a tick in which these nodes sent heartbeats: ramps end, an expiry, and its ramp ends.

    An axis in operation enabled turns, since its last set-point stays; one without current comes to rest.
    """
    drive = _by_itself(drive)
    if drive.consumer in beating:
        return hear(drive, drive.consumer)
    if not drive.heard:
        return drive
    drive = drive._replace(heard=False)
    # 1029h is looked at in operational alone: a loss in pre-operational is told and changes nothing.
    return _by_itself(_enter(drive, NmtState.STOPPED)) if drive.nmt is NmtState.OPERATIONAL else drive


def _by_itself(drive: Drive) -> Drive:
    """Return the drive once nothing that it does by itself is under way."""
    if drive.fsa is State.OPERATION_ENABLED and not drive.ramps:
        return drive._replace(turns=True)
    if drive.fsa is State.OPERATION_ENABLED:  # the ramp of transition 5 has ended; what was commanded meanwhile acts
        return _remembering_less(_command(drive._replace(fsa=State.SWITCHED_ON, ramps=False, turns=False)))
    return drive._replace(fsa=_BY_ITSELF.get(drive.fsa, drive.fsa), turns=False)
