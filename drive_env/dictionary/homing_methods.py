"""Homing methods (6098h): their descriptions."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from mechanics.reading.untrusted import read_toml

WITHOUT_INDEX = 16  # offset from a method with an index to the one that ends at the switch's edge
HERE = (35, 37)  # methods without movement
INDEX_ALONE = (33, 34)  # methods that search no switch
_DATA = read_toml(Path(__file__).parent / "homing_methods.toml")
_EDGES = {int(number): text for number, text in _DATA["standard"].items()}
# CiA 402's methods by number, with their descriptions.
METHODS: dict[int, str] = {
    **{n: _EDGES[n + WITHOUT_INDEX] + _DATA["then_to_the_index"] for n in range(1, 15)},
    **_EDGES,
}
TO_INDEX = 10.0  # of a sketch's 100, from an edge to the next index


class HomingSketch(NamedTuple):
    """The way of a method along an axis from 0 (left) to 100.

    Attributes:
        switch: The switch that it searches: "left" and "right" limit switch, "home" switch, "" for none.
        way: Start, turning points and home.
        has_index: Whether home is an index of the encoder.
    """

    switch: str
    way: tuple[float, ...]
    has_index: bool


def _sketch(row: dict[str, Any], *, has_index: bool) -> HomingSketch:
    way = tuple(map(float, row["way"]))
    direction = row.get("index", 0)
    if has_index and not direction:
        direction = 1 if way[-1] > way[-2] else -1
    return HomingSketch(row["switch"], (*way, way[-1] + direction * TO_INDEX) if direction else way, bool(direction))


PLACES = {name: (float(low), float(high)) for name, (low, high) in _DATA["places"].items()}  # where a switch is active
_ROWS = {int(number): row for number, row in _DATA["sketches"].items()}
SKETCHES: dict[int, HomingSketch] = {
    **{n: _sketch(_ROWS[n + WITHOUT_INDEX], has_index=True) for n in range(1, 15)},
    **{number: _sketch(row, has_index=False) for number, row in _ROWS.items()},
}
_OWN = {int(number): text for number, text in _DATA["known_devices"].items()}


def method_text(method: int, *, is_known: bool) -> str:
    """Return the description of a homing method, or a reference to the manual.

    Args:
        method: Number in 6098h.
        is_known: Whether the device is known: negative numbers, which are the maker's own, have no known meaning
            otherwise.
    """
    return (METHODS | _OWN if is_known else METHODS).get(method, "the maker's own: the drive's manual describes it")
