"""Suggestions for an unknown name among the known ones."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

NEAR = 0.6  # share of common letters (difflib) above which a name counts as a typing error of another


def did_you_mean(name: object, names: Iterable[str]) -> str:
    """Return "; did you mean 'two_mass'?" with the nearest known names, at most three, or ""."""
    there = {one.casefold(): one for one in names}
    near = difflib.get_close_matches(str(name).casefold(), there, 3, NEAR)
    return f"; did you mean {' or '.join(repr(there[one]) for one in near)}?" if near else ""
