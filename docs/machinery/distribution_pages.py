"""The page of the sets of random machines that environments draw from, from their files."""

from __future__ import annotations

import tomllib
from itertools import takewhile
from typing import Any

from tables import table

from drive_env.randomisation.random_machines import SHIPPED, Law, shipped

PATH = "reference/environments/distributions.md"
GENERAL = ("common", "bus")  # what every load's set includes
PAGE = """# Random machines

`distributions="belt"` of an environment draws the machine of each episode from a set of this page; a set of your own is
a TOML file like these ([its keys](../file-formats.md#distributions)), which may `include` them. `law` is the
probability distribution of a parameter; one that has none stays at its default.
`stage`, from 0 to 1, widens the ranges from the defaults to what stands here during training.

Most sets include `common`, what belongs to every machine, and `bus`, what a CAN bus does to set-points and
measurements.

"""


def pages() -> dict[str, str]:
    """Return the page: what all include first, then a set for each load."""
    names = [*GENERAL, *(name for name in shipped() if name not in GENERAL)]
    return {PATH: PAGE + "\n".join(section(name) for name in names)}


def section(name: str) -> str:
    """Return a set: what its file says of it, and its own laws."""
    text = (SHIPPED / f"{name}.toml").read_text(encoding="utf-8")
    said = " ".join(
        line.removeprefix("#").strip() for line in takewhile(lambda line: line[:1] == "#", text.splitlines())
    )
    data = tomllib.loads(text)
    parts = [f"## {name}\n", f"{said}\n"]
    if data.get("include"):
        parts.append("Includes " + ", ".join(f"[{one}](#{one})" for one in data["include"]) + ".\n")
    rows = [(f"`{parameter}`", *described(row)) for parameter, row in data.get("parameters", {}).items() if row]
    parts.append(table(("parameter", "law", "range", "of"), rows))
    return "\n".join(parts)


def described(row: dict[str, Any]) -> tuple[str, str, str]:
    """Return a law's name, its numbers in words, and what they are multiples of."""
    law = Law(**{key: tuple(value) if isinstance(value, list) else value for key, value in row.items() if key != "of"})
    of = "the default" if "of" in row else ""
    if law.law == "choice":
        weights = f", weights {', '.join(f'{one:g}' for one in law.weights)}" if law.weights else ""
        return law.law, ", ".join(f"{one:g}" for one in law.values) + weights, of
    ends = f"{law.low:g} to {law.high:g}"
    return law.law, f"{law.mean:g} ± {law.deviation:g}, cut off at {ends}" if law.law == "normal" else ends, of
