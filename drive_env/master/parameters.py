"""The parameters of a drive as a set: read, compared, and written all or none.

Parameters are settings, not commands or services. PDOs are remapped in the order that CiA 301 demands.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, NamedTuple

from drive_env import cia402
from drive_env.canopen.frames import INVALID
from drive_env.cia402 import Key
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.dictionary.entries import Entry
from drive_env.dictionary.standard_types import COMMANDS
from drive_env.fieldbus.errors import BusError
from drive_env.held_signals import held_signals

if TYPE_CHECKING:
    from drive_env.devices import MasterHints
    from drive_env.drives.interface import DescribedAxes


SAVE = 0x65766173  # CiA 301: "save", written to 1010h

_DEVICE_OBJECTS = 0x2000  # from here on; objects below are those of communication
_COMMUNICATION = (range(0x1400, 0x1600), range(0x1800, 0x1A00))
_MAPPING_ABOVE = 0x200  # offset of a PDO's mapping from its communication parameter
# Assignments of EtherCAT's sync managers 2 and 3 and their mappings: none is changed while it is assigned.
_ASSIGNMENTS = {0x1C12: range(0x1600, 0x1800), 0x1C13: range(0x1A00, 0x1C00)}


class Difference(NamedTuple):
    """A parameter with another value than wanted; `found` is None if the drive lacks it."""

    entry: Entry
    wanted: int
    found: int | None


class CommandObjectError(ValueError):
    """A command or service is among the parameters."""


class RollbackError(BusError):
    """A write failed and earlier writes could not be undone: the drive holds a mixture."""


class NotRestoredError(BusError):
    """A write failed; earlier writes were undone."""


def command(index: int, hints: MasterHints) -> str:
    """Return the name of the command or service that an object is, also for further axes; "" for a parameter."""
    return COMMANDS.get(cia402.of_first_axis(index)) or hints.commands.get(index, "")


def check_no_commands(keys: Iterable[Key], where: object, hints: MasterHints) -> None:
    """Raise CommandObjectError, naming them, if any of these objects of a device are commands or services."""
    found = dict.fromkeys(f"{index:04X}h ({command(index, hints)})" for index, _ in keys if command(index, hints))
    if found:
        raise CommandObjectError(
            f"{where} holds objects that are not parameters: {', '.join(found)}. Nothing was written; take them out"
        )


def restorable(values: Mapping[Key, int], hints: MasterHints) -> dict[Key, int]:
    """Return the values that may be written back to a device: without node-ID, bit rate and similar."""
    return {key: value for key, value in values.items() if key[0] not in hints.addresses}


def parameters(drives: DescribedAxes) -> list[Entry]:
    """Return the entries that are parameters of a drive."""
    known = drives.description
    further = known.of_further_axes()  # if listed, their commands are those of the first axis

    def commands(entry: Entry) -> bool:
        first, _ = further.get((entry.index, entry.sub), (entry, 0))
        return bool(command(first.index, known.hints))

    return [
        entry
        for entry in known.dictionary
        if entry.access in ("rw", "rwr", "rww") and not commands(entry) and known.is_number(entry)
    ]


def read_parameters(
    drives: DescribedAxes, axis: int = 0, chosen: Callable[[Entry], bool] = lambda entry: True
) -> dict[Key, int]:
    """Return the chosen parameters of an axis, without those that the drive refuses to show."""
    found = {}
    for entry in filter(chosen, parameters(drives)):
        with contextlib.suppress(ObjectAccessError):
            found[entry.index, entry.sub] = int(drives.read_axis(entry, axis))
    return found


def compare(drives: DescribedAxes, wanted: Mapping[Key, int], axis: int = 0) -> list[Difference]:
    """Return the parameters in which an axis differs from wanted values."""
    differences = []
    for key, value in wanted.items():
        entry = drives.description.dictionary.find(key)
        try:
            found: int | None = int(drives.read_axis(entry, axis))
        except ObjectAccessError:
            found = None
        if found != value:
            differences.append(Difference(entry, value, found))
    return differences


def write_all_or_none(drives: DescribedAxes, wanted: Mapping[Key, int], axis: int = 0) -> list[Difference]:
    """Write the differing parameters and read them back; undo all if one fails. Return the changes.

    Raises:
        CommandObjectError: If there is a command or a service among them; nothing was written.
        NotRestoredError: If the drive refused a value or holds another one; all changes were undone.
        RollbackError: If the previous values could not be written back; the message lists them.
    """
    hints = drives.description.hints
    check_no_commands(wanted, "what is to be written", hints)
    check_at_rest(drives, wanted, axis)
    chosen = restorable(wanted, hints)
    changes = compare(drives, chosen, axis)
    absent = [change.entry.label for change in changes if change.found is None]
    if absent:
        raise NotRestoredError(f"the drive has no {', '.join(absent)}; nothing was written. Take them out of the file")
    before = read_these(drives, [*chosen, *_pdos_of(drives, changes)], axis)
    try:
        _write(drives, {(c.entry.index, c.entry.sub): c.wanted for c in changes}, before, axis)
        left = compare(drives, {**before, **chosen}, axis)
        if left:
            raise BusError("the drive does not hold what was written: " + list_differences(left))
    except (ObjectAccessError, BusError, KeyboardInterrupt) as error:
        _roll_back(drives, before, axis, error)
    return changes


def check_at_rest(drives: DescribedAxes, wanted: Iterable[Key], axis: int = 0) -> None:
    """Raise NotRestoredError, naming it among several, if an axis that these parameters affect may turn."""
    live = next((other for other in _affected(drives, wanted, axis) if _is_live(drives, other)), None)
    if live is not None:
        which = f"axis {live}" if len(drives.nodes) * drives.description.num_axes > 1 else "the axis"
        raise NotRestoredError(f"{which} is enabled, and parameters are not exchanged under way; disable it first")


def _affected(drives: DescribedAxes, wanted: Iterable[Key], axis: int) -> Iterable[int]:
    """Return the axes that a change affects: all of them for objects of communication."""
    count = drives.description.num_axes
    if all(index >= _DEVICE_OBJECTS and cia402.of_first_axis(index) == index for index, _ in wanted):
        return (axis,)
    return range(axis - axis % count, axis - axis % count + count)


def _is_live(drives: DescribedAxes, axis: int) -> bool:
    return bool(cia402.is_live(int(drives.read_axis(drives.description.dictionary.find(cia402.STATUSWORD), axis))))


def _roll_back(drives: DescribedAxes, before: Mapping[Key, int], axis: int, cause: BaseException) -> None:
    why = "interrupted" if isinstance(cause, KeyboardInterrupt) else str(cause)
    try:
        with held_signals():  # a second Ctrl-C would leave a mixture
            now = read_these(drives, before, axis)
            changed = {key: value for key, value in reversed(list(before.items())) if now[key] != value}
            _write(drives, changed, now, axis)
            left = compare(drives, before, axis)
    except (ObjectAccessError, BusError) as error:
        raise RollbackError(
            f"{why}; and taking it back failed: {error}. The drive holds a mixture: restore the backup once it "
            "answers, or reset the node, which brings back what it has stored"
        ) from cause
    if left:
        raise RollbackError(
            f"{why}; and these could not be taken back: {list_differences(left)}. Reset the node, which brings "
            "back what it has stored"
        ) from cause
    raise NotRestoredError(f"{why}; everything was taken back, the drive is as it was") from cause


def _pdos_of(drives: DescribedAxes, changes: list[Difference]) -> list[Key]:
    """Return all objects of the PDOs that change: these are switched off and emptied for the change."""
    bases = {_pdo_of(change.entry.index) for change in changes} - {None}
    images = {_assignment_of(change.entry.index) for change in changes} - {None}
    return [
        (entry.index, entry.sub)
        for entry in parameters(drives)
        if _pdo_of(entry.index) in bases or entry.index in images
    ]


def read_these(drives: DescribedAxes, keys: Iterable[Key], axis: int) -> dict[Key, int]:
    """Return the present values of objects of an axis."""
    return {key: int(drives.read_axis(drives.description.dictionary.find(key), axis)) for key in keys}


def _write(drives: DescribedAxes, changes: Mapping[Key, int], before: Mapping[Key, int], axis: int) -> None:
    for key, value in _in_order(changes, before):
        drives.write_axis(drives.description.dictionary.find(key), axis, value)


def _in_order(changes: Mapping[Key, int], before: Mapping[Key, int]) -> Iterator[tuple[Key, int]]:
    """Return the writes: as given, but a PDO is switched off and emptied, then filled, then switched on."""
    pdos: dict[int, None] = {}
    images: dict[int, dict[int, None]] = {}
    for (index, sub), value in changes.items():
        base, assignment = _pdo_of(index), _assignment_of(index)
        if base is not None and (base, 1) in before:
            pdos[base] = None
        elif assignment is not None and (assignment, 0) in before:
            images.setdefault(assignment, {})
            if index != assignment:
                images[assignment][index] = None
        else:
            yield (index, sub), value
    for assignment, mappings in images.items():
        yield (assignment, 0), 0
        for index in (*mappings, assignment):
            yield from _as_list(index, changes, before)
    for base in pdos:
        wanted = {key: changes.get(key, value) for key, value in before.items() if _pdo_of(key[0]) == base}
        mapping = base + _MAPPING_ABOVE
        cob_id, count = wanted[base, 1], wanted.get((mapping, 0), 0)
        yield (base, 1), before[base, 1] | INVALID
        for key, value in wanted.items():
            if key[0] == base and key[1] != 1 and key in changes:
                yield key, value
        if (mapping, 0) in wanted:
            yield (mapping, 0), 0
            for sub in range(1, max((key[1] for key in wanted if key[0] == mapping), default=0) + 1):
                if (mapping, sub) in wanted and (sub <= count or (mapping, sub) in changes):
                    yield (mapping, sub), wanted[mapping, sub]
            yield (mapping, 0), count
        yield (base, 1), cob_id


def _as_list(index: int, changes: Mapping[Key, int], before: Mapping[Key, int]) -> Iterator[tuple[Key, int]]:
    """Return the writes of a list, whose entries are changed while its count is 0."""
    wanted = {key: changes.get(key, value) for key, value in before.items() if key[0] == index}
    count = wanted[index, 0]
    yield (index, 0), 0
    for key, value in wanted.items():
        if key[1] and (key[1] <= count or key in changes):
            yield key, value
    yield (index, 0), count


def _assignment_of(index: int) -> int | None:
    """Return the EtherCAT assignment that an object is, or that may contain this mapping; None for other objects."""
    return next((one for one, mappings in _ASSIGNMENTS.items() if index == one or index in mappings), None)


def _pdo_of(index: int) -> int | None:
    """Return the index of the communication parameter of an object's PDO; None if it belongs to no PDO."""
    for area in _COMMUNICATION:
        if index in area:
            return index
        if index - _MAPPING_ABOVE in area:
            return index - _MAPPING_ABOVE
    return None


def list_differences(differences: list[Difference]) -> str:
    """Return the first differences as text, and the number of further ones."""
    shown = [f"{d.entry.label} is {d.found}, not {d.wanted}" for d in differences[:5]]
    return ", ".join(shown) + (f" and {len(differences) - 5} more" if len(differences) > 5 else "")
