"""Distributes objects to PDOs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from drive_env.dictionary.entries import Entry

PDO_BITS = 64


class Slots(NamedTuple):
    """The PDOs of one direction that an axis may use: their numbers (0 is PDO 1), and how many entries each takes."""

    numbers: tuple[int, ...]
    entries: int


def pack(entries: Sequence[Entry], slots: Slots, *, keep_order: bool) -> list[list[Entry]] | None:
    """Return the entries of each PDO, in the order of `slots.numbers`, or None if they do not fit.

    Args:
        entries: The entries to map; each has its size in bits.
        slots: The available PDOs.
        keep_order: Keep the order if possible, since a drive applies PDOs and their entries one after the other.
    """
    if keep_order:
        in_order = _fill_one_after_the_other(entries, slots)
        if in_order is not None:
            return in_order
    # Widest first: a solution, if there is one, is then found soon.
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
            continue  # skip a PDO as full as one that led to no solution
        tried.add(state)
        pdo.append(entries[0])
        found = _search(entries[1:], pdos, limit)
        if found is not None:
            return found
        pdo.pop()
    return None
