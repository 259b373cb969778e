"""Search of a dictionary by words, and its areas."""

from __future__ import annotations

from collections.abc import Iterable

from drive_env import cia402
from drive_env.dictionary.entries import Entry

AREAS = {
    "communication": ("Communication (1000h to 1FFFh)", range(0x1000, 0x2000)),
    "manufacturer": ("Manufacturer (2000h to 5FFFh)", range(0x2000, cia402.PROFILE_AREAS.start)),
    "profile": ("Drive profile (6000h to 9FFFh)", cia402.PROFILE_AREAS),
}


def area_of(index: int) -> str:
    """Return the area of the dictionary that an index belongs to."""
    return next((name for name, (_, area) in AREAS.items() if index in area), "communication")


def searched(entries: Iterable[Entry], text: str) -> list[Entry]:
    """Return the entries whose index, name or unit contain all words of a text; all entries for an empty text."""
    words = [word.removeprefix("0x") for word in text.lower().replace("h:", ":").split()]
    found = []
    for entry in entries:
        place = f"{entry.index:04x}:{entry.sub:02x} {entry.index:04x}h {entry.name.lower()} {entry.unit.lower()}"
        if all(word in place for word in words):
            found.append(entry)
    return found
