"""Which objects go into which PDO."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from drive_env.dictionary.entries import Entry

PDO_BITS = 64


class Slots(NamedTuple):
    """The PDOs of one direction that an axis has: their numbers (0 is PDO 1), and entries that each takes."""

    numbers: tuple[int, ...]
    entries: int


def pack(entries: Sequence[Entry], slots: Slots, *, keep_order: bool) -> list[list[Entry]] | None:
    """Return the entries of each PDO, in the order of `slots.numbers`, or None if they do not fit.

    Args:
        entries: What to map; each has its size in bits.
        slots: The PDOs there are.
        keep_order: Keep the order if it fits so, since a drive takes PDOs and their entries one after the other.
    """
    if keep_order:
        in_order = _fill_one_after_the_other(entries, slots)
        if in_order is not None:
            return in_order
    # Widest first: then what fits at all is found soon.
    by_width = sorted(entries, key=lambda entry: -(entry.bits or 0))
    return _search(by_width, [[] for _ in slots.numbers], slots.entries)


def _fits(entry: Entry, pdo: list[Entry], limit: int) -> bool:
    return len(pdo) < limit and sum(other.bits or 0 for other in pdo) + (entry.bits or 0) <= PDO_BITS


def _fill_one_after_the_other(entries: Sequence[Entry], slots: Slots) -> list[list[Entry]] | None:
    pdos: list[list[Entry]] = [[]]
    for entry in entries:
        if not _fits(entry, pdos[-1], slots.entries):
            pdos.append([])
        pdos[-1].append(entry)
    return pdos if len(pdos) <= len(slots.numbers) else None


def _search(entries: list[Entry], pdos: list[list[Entry]], limit: int) -> list[list[Entry]] | None:
    if not entries:
        return [pdo for pdo in pdos if pdo]
    tried = set()
    for pdo in pdos:
        state = (len(pdo), sum(other.bits or 0 for other in pdo))
        if state in tried or not _fits(entries[0], pdo, limit):
            continue  # a PDO as full as one that led nowhere leads nowhere
        tried.add(state)
        pdo.append(entries[0])
        found = _search(entries[1:], pdos, limit)
        if found is not None:
            return found
        pdo.pop()
    return None
