"""Cause and remedy of each emergency, from the source file of the page of messages."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import NamedTuple

from mechanics.reading.untrusted import read_toml

_PACKAGE = Path(__file__).parents[1]
# In a wheel it is in the package; in a working copy in the documentation's sources.
_PLACES = (_PACKAGE / "messages.toml", _PACKAGE.parent / "docs" / "messages.toml")


class FaultText(NamedTuple):
    """An emergency's name, cause and remedy."""

    name: str
    cause: str
    remedy: str


@cache
def _rows() -> dict[str, dict[str, str]]:
    for place in _PLACES:
        if place.is_file():
            topics = read_toml(place)["topic"]
            return {row["emcy"]: row for topic in topics for row in topic["message"] if "emcy" in row}
    return {}


def fault_text(name: str) -> FaultText:
    """Return the text of an emergency by its name in its device's table."""
    row = _rows().get(name, {})
    row = _rows().get(row.get("same", ""), row)
    unknown = "The drive's manual lists its code."
    return FaultText(name.replace("_", " "), _plain(row.get("cause", unknown)), _plain(row.get("remedy", unknown)))


def _plain(text: str) -> str:
    """Return a text without Markdown marks."""
    return re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text).replace("`", "")
