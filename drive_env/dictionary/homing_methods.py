"""Homing methods (6098h): what each does, in words."""

from __future__ import annotations

from pathlib import Path

from mechanics.untrusted import read_toml

WITHOUT_INDEX = 16  # from a method with an index to the one that ends at the switch's edge
HERE = (35, 37)  # which move nothing
INDEX_ALONE = (33, 34)  # which search no switch
_DATA = read_toml(Path(__file__).parent / "homing_methods.toml")
_EDGES = {int(number): text for number, text in _DATA["standard"].items()}
# CiA 402's, by number: what each does.
METHODS: dict[int, str] = {
    **{n: _EDGES[n + WITHOUT_INDEX] + _DATA["then_to_the_index"] for n in range(1, 15)},
    **_EDGES,
}
_OWN = {int(number): text for number, text in _DATA["known_devices"].items()}


def method_text(method: int, *, is_known: bool) -> str:
    """Return the description of a homing method, or that the manual has one.

    Args:
        method: As 6098h has it.
        is_known: Whether the device is known: of others a negative number, the maker's own, may mean anything.
    """
    return (METHODS | _OWN if is_known else METHODS).get(method, "the maker's own: the drive's manual describes it")
