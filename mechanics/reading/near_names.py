"""Which of the names that there are was meant by one that there is not."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

NEAR = 0.6  # share of letters in common (difflib) above which a name counts as a slip of another


def did_you_mean(name: object, names: Iterable[str]) -> str:
    """Return "; did you mean 'two_mass'?" with the names nearest to one that was not found, at most three, or ""."""
    there = {one.casefold(): one for one in names}
    near = difflib.get_close_matches(str(name).casefold(), there, 3, NEAR)
    return f"; did you mean {' or '.join(repr(there[one]) for one in near)}?" if near else ""
