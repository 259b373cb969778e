"""Protection: the causes that a drive monitors, once per supervision period, and their reactions.

A cause is a physical condition of the axis, and a row of the table that a device's firmware names. Its emergency code
and bytes are the device's data, by name; each row has the reaction: a danger to the stage cuts it, a danger to the
machine stops it with the fault reaction of 605Eh, a limit of travel stops the axis, which stays enabled, and a warning
is only reported.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, NamedTuple

from drive_env import cia402
from drive_env.firmware.common import fsa, limits
from mechanics.kernels.compiled import inlined, stage

CUT, STOP, LIMIT, WARN = 0, 1, 2, 3
BLOCKS_NEGATIVE, BLOCKS_POSITIVE = 1, 2
GENERIC_ERROR = 0x01  # bit 0 of 1001h is set with every error
LIMIT_REGISTER = 0x20  # of 1001h, for an axis at a limit
# Names that the core itself uses.
FAULT_RESET, COMMUNICATION, FOLLOWING_ERROR = "fault_reset", "communication_error", "following_error"


class Cause(NamedTuple):
    """A row.

    Attributes:
        name: As in the device's emergency table.
        reaction: CUT, STOP, LIMIT or WARN.
        error_register: Bits of 1001h.
        status_flag: Bits of the device's status flags, if it has them.
        condition: Stage (drive, lane, whether it was present at the last check) -> whether it is present; None for a
            cause outside the axis, or reported by the automaton.
        blocks: BLOCKS_NEGATIVE or BLOCKS_POSITIVE, for a limit.
        software: Whether it is a software limit, from which a demand within the limits leads back.
        held: Whether it is over as soon as the stage is off, so that its flag stays until the reset.
        tried_again: Whether a reset is allowed although it holds: the next enabling tries again.
        unless: Name of a cause whose fault hides this one, which then follows from it.
        known_as: Name in the core, if the device uses another one.
        silent: Whether it acts without an emergency and without a bit of 1001h, as a limit that is not an error.
    """

    name: str
    reaction: int
    error_register: int
    status_flag: int
    condition: Callable[..., Any] | None = None
    blocks: int = 0
    software: bool = False
    held: bool = False
    tried_again: bool = False
    unless: str = ""
    known_as: str = ""
    silent: bool = False


class Protection(NamedTuple):
    """Stages of a table of causes.

    Attributes:
        protect: (drive, lane): checks every cause, once per supervision period.
        causes_gone: (drive, lane) -> whether no cause of a fault is present any more.
        statusword_bits: (drive, lane) -> bits 11 and 13 of the statusword that causes set.
        trip: (drive, lane, row): takes an axis that is in operation into fault.
    """

    protect: Any
    causes_gone: Any
    statusword_bits: Any
    trip: Any


def _mask(causes: Sequence[Cause], chosen: Callable[[Cause], bool]) -> int:
    return sum(1 << row for row, cause in enumerate(causes) if row and chosen(cause))


def row_of(causes: Sequence[Cause], name: str) -> int:
    """Return the first row of a cause, by its name or `known_as`; -1 if the table has none."""
    return next((row for row, cause in enumerate(causes) if name in (cause.name, cause.known_as)), -1)


TOGETHER = 4  # conditions per function: each function costs compile time, and each nested one more


def _conditions(causes: Sequence[Cause]) -> Any:
    """Return the stage (drive, lane) -> the causes that are present now, as bits 1 << row."""
    rows: list[tuple[Any, int]] = []
    for row, cause in enumerate(causes):
        if cause.condition is not None:
            hiding = row_of(causes, cause.unless) + 1 if cause.unless else None
            rows.append((cause.condition if hiding is None else _unless_hidden(cause.condition, hiding), 1 << row))
    rows += [(_never, 0)] * (-len(rows) % TOGETHER)
    groups = [_any_of_four(*zip(*rows[k : k + TOGETHER], strict=True)) for k in range(0, len(rows), TOGETHER)]
    return reduce(_either, groups)


@inlined
def _never(drive, lane, told):
    return False


def _unless_hidden(condition: Any, fault: int) -> Any:
    @inlined
    def unless_hidden(drive, lane, told):
        return drive.fault[lane] != fault and condition(drive, lane, told)

    return unless_hidden


def _any_of_four(conditions: tuple[Any, ...], bits: tuple[int, ...]) -> Any:
    first, second, third, fourth = conditions
    bit_1, bit_2, bit_3, bit_4 = bits

    @stage
    def any_of_four(drive, lane):
        active, found = drive.active[lane], 0
        if first(drive, lane, active & bit_1 != 0):
            found |= bit_1
        if second(drive, lane, active & bit_2 != 0):
            found |= bit_2
        if third(drive, lane, active & bit_3 != 0):
            found |= bit_3
        if fourth(drive, lane, active & bit_4 != 0):
            found |= bit_4
        return found

    return any_of_four


def _either(first: Any, second: Any) -> Any:
    @inlined
    def either(drive, lane):
        return first(drive, lane) | second(drive, lane)

    return either


class _Masks(NamedTuple):
    """Rows of a table as bits 1 << row, by their effect."""

    cuts: int
    stops: int
    at_limits: int
    silent: int
    warns: int
    positive: int
    negative: int
    software: int
    held: int
    tried_again: int

    @property
    def faults(self) -> int:
        """The causes that take the drive into fault."""
        return self.cuts | self.stops


def _masks(causes: Sequence[Cause]) -> _Masks:
    return _Masks(
        cuts=_mask(causes, lambda cause: cause.reaction == CUT),
        stops=_mask(causes, lambda cause: cause.reaction == STOP),
        at_limits=_mask(causes, lambda cause: cause.reaction == LIMIT and not cause.silent),
        silent=_mask(causes, lambda cause: cause.silent),
        warns=_mask(causes, lambda cause: cause.reaction == WARN),
        positive=_mask(causes, lambda cause: cause.blocks == BLOCKS_POSITIVE),
        negative=_mask(causes, lambda cause: cause.blocks == BLOCKS_NEGATIVE),
        software=_mask(causes, lambda cause: cause.software),
        held=_mask(causes, lambda cause: cause.held),
        tried_again=_mask(causes, lambda cause: cause.tried_again),
    )


def _look(masks: _Masks, conditions: Any, told_when_left: int, tells_all: bool, faults_when_off: bool) -> Any:
    """Return the stage (drive, lane) -> the causes that have appeared."""
    faults, stops, at_limits, warns = masks.faults, masks.stops, masks.at_limits, masks.warns
    positive, negative, software = masks.positive, masks.negative, masks.software
    software_positive, software_negative = positive & software, negative & software

    @stage
    def demand_beyond(drive, lane):
        """Return the software limits that the position demand exceeds."""
        return (software_positive if limits.demand_above(drive, lane) else 0) | (
            software_negative if limits.demand_below(drive, lane) else 0
        )

    @inlined
    def look(drive, lane):
        present = conditions(drive, lane)
        drive.present[lane] = present
        faulted = drive.fsa[lane] == fsa.FAULTED
        is_off = drive.fsa[lane] < fsa.SWITCHED and not faults_when_off
        if is_off or (faulted and not tells_all):
            # A drive whose supply or enable is missing is not in fault before it is switched on, unless its maker lets
            # every error act at once.
            present &= ~faults
        reacting = drive.fsa[lane] == fsa.REACTING
        # Outside a fault no cause counts as known: one that is back at its reset is new.
        known = drive.active[lane] if faulted or reacting else drive.active[lane] & ~faults
        appeared = present & ~known
        # Until the fault reaction has ended, its cause is not new if it goes and returns; if every error is reported,
        # not before the reset.
        told = drive.active[lane] & stops if reacting else 0
        if tells_all and (faulted or reacting):
            told = drive.active[lane] & faults
        drive.active[lane] = present | told
        drive.warning[lane] = 1 if present & warns else 0
        # A position demand within the limits leads an axis back that was pushed past them.
        blocking = present & ~software | demand_beyond(drive, lane) if drive.loop_level[lane] == 2 else present
        drive.blocked[lane] = (BLOCKS_POSITIVE if blocking & positive else 0) | (
            BLOCKS_NEGATIVE if blocking & negative else 0
        )
        # A limit is shown in 1001h while it is present; the cause of a fault stays there until the reset.
        if present & at_limits:
            drive.error_register[lane] |= GENERIC_ERROR | LIMIT_REGISTER
        elif drive.fault[lane] == 0 and drive.error_register[lane] != 0:
            drive.error_register[lane] = 0
            fsa.push_emergency(drive, lane, told_when_left)
        return appeared

    return look


def _react(masks: _Masks, register: tuple[int, ...], tells_all: bool) -> Any:
    """Return the stage (drive, lane, causes that have appeared): emergencies and reactions."""
    faults, cuts, silent, rows = masks.faults, masks.cuts, masks.silent, len(register)

    @stage
    def react(drive, lane, appeared):
        for cause in range(1, rows):
            if not appeared & (1 << cause):
                continue
            push_emergency = silent & (1 << cause) == 0
            if faults & (1 << cause):
                cut = cuts & (1 << cause) != 0
                # The cut stage is the answer: other causes at the same time follow from it.
                is_first = drive.fsa[lane] != fsa.FAULTED
                push_emergency = is_first or tells_all
                if push_emergency:
                    drive.error_register[lane] |= GENERIC_ERROR | register[cause]
                if is_first:
                    drive.fault[lane] = cause + 1
                    fsa.fault(drive, lane, cut)
            if push_emergency:
                fsa.push_emergency(drive, lane, cause)

    return react


def _cause_flags(held: int, flags: tuple[int, ...], tells_all: bool) -> Any:
    """Return the stage (drive, lane) -> status flags."""
    rows = len(flags)

    @inlined
    def cause_flags(drive, lane):
        """Return the status flags of present causes, in any state of the drive."""
        shown = drive.present[lane]
        if drive.fault[lane] > 0:
            shown |= 1 << (drive.fault[lane] - 1) & held
            if tells_all:
                shown |= drive.active[lane] & held
        found = 0
        for cause in range(1, rows):
            if shown & 1 << cause:
                found |= flags[cause]
        return found

    return cause_flags


def protection_of(causes: Sequence[Cause], *, tells_all: bool = False, faults_when_off: bool = False) -> Protection:
    """Return the stages of a table of causes.

    Args:
        causes: Row 0 is the answer to a fault reset; the last one reports that the axis has left its limits. Causes
            that appear together are reported, and act, in the order of the rows.
        tells_all: Whether a drive in fault reports further errors, each once until the reset; otherwise errors after
            the cut of the stage count as its consequences, and are not reported.
        faults_when_off: Whether a cause takes the drive into fault in every state, or from switched on only.
    """
    masks = _masks(causes)
    register = tuple(cause.error_register for cause in causes)
    conditions = _conditions(causes)
    look = _look(masks, conditions, len(causes) - 1, tells_all, faults_when_off)
    react = _react(masks, register, tells_all)
    cause_flags = _cause_flags(masks.held, tuple(cause.status_flag for cause in causes), tells_all)
    faults, cuts, software, tried_again = masks.faults, masks.cuts, masks.software, masks.tried_again
    following_fault, csp, ip = row_of(causes, FOLLOWING_ERROR) + 1, cia402.CSP, cia402.IP

    @stage
    def causes_gone(drive, lane):
        return conditions(drive, lane) & faults & ~tried_again == 0

    @inlined
    def protect(drive, lane):
        appeared = look(drive, lane)
        if appeared != 0:
            react(drive, lane, appeared)
        drive.cause_flags[lane] = cause_flags(drive, lane)

    @inlined
    def statusword_bits(drive, lane):
        bits = 0x0800 if drive.active[lane] & software else 0
        mode = drive.mode_display[lane]
        if mode in (csp, ip) and drive.fault[lane] == following_fault:
            bits |= 0x2000
        return bits

    @stage
    def trip(drive, lane, cause):
        drive.fault[lane] = cause + 1
        drive.error_register[lane] |= GENERIC_ERROR | register[cause]
        fsa.fault(drive, lane, cuts & (1 << cause) != 0)

    return Protection(protect, causes_gone, statusword_bits, trip)
