"""Tables in Markdown, and how numbers stand in them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table in Markdown; cells may hold Markdown themselves."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell(one) for one in line) + " |" for line in lines) + "\n"


def cell(value: object) -> str:
    """Return a value as it stands in a cell: numbers short, nothing for None."""
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:g}"
    parts = str(value).replace("\n", " ").split("`")
    parts[::2] = [one.replace("|", "\\|") for one in parts[::2]]  # within `code` it divides no cells
    return "`".join(parts)


def unit(text: str) -> str:
    """Return a unit as people write it: N*m is N·m, kg*m^2 is kg·m²; "" for 1."""
    if text in ("1", "raw"):
        return ""
    return text.replace("^2", "²").replace("*", "·").replace("ohm", "Ω")
