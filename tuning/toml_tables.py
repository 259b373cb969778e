"""Strict conversion between TOML tables and dataclasses: every mistake is reported in one line with its remedy."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping
from dataclasses import fields
from typing import Any


class ExperimentError(ValueError):
    """The experiment is invalid; the message has key, value, limit and remedy."""


_KINDS: dict[str, tuple[type, str]] = {"str": (str, "a text"), "int": (int, "a whole number"),
                                       "float": (float, "a number")}  # fmt: skip


def read_table(where: str, table: Any, kind: type, optional: Collection[str] = ()) -> dict[str, Any]:
    """Check a table against the fields of a dataclass and return its values."""
    table = as_table(where, table)
    types = {f.name: str(f.type).removesuffix(" | None") for f in fields(kind)}
    check_keys(where, table, list(types), optional)
    return {key: as_value(f"{where}: {key}", value, types[key]) for key, value in table.items()}


def check_keys(where: str, table: Mapping[str, Any], known: list[str], optional: Collection[str] = ()) -> None:
    """Raise ExperimentError for a key that is unknown, or one that is missing and not optional."""
    for key in table:
        if key not in known:
            raise ExperimentError(f"{where}: key {key!r} is unknown; there are {', '.join(known)}")
    missing = [key for key in known if key not in table and key not in optional]
    if missing:
        raise ExperimentError(f"{where}: key {missing[0]!r} is missing; add it (there are {', '.join(known)})")


def as_table(where: str, value: Any) -> dict[str, Any]:
    """Return a table; ExperimentError for another value."""
    if not isinstance(value, dict):
        raise ExperimentError(f"{where} is {kind_of(value)}; it must be a table")
    return value


def as_value(where: str, value: Any, kind: str) -> Any:
    """Return a value of a kind, else ExperimentError; "float" accepts whole numbers, no kind accepts booleans."""
    wanted, meaning = _KINDS[kind]
    if wanted is float and type(value) is int:
        value = float(value)
    if type(value) is not wanted:
        raise ExperimentError(f"{where} = {value!r} is {kind_of(value)}; it must be {meaning}")
    if isinstance(value, float) and not math.isfinite(value):
        raise ExperimentError(f"{where} = {value} is not finite; give a number")
    return value


def kind_of(value: Any) -> str:
    """Return the kind of a TOML value for messages."""
    names = {bool: "a truth value", int: "a whole number", float: "a number with a fraction", str: "a text",
             list: "an array", dict: "a table"}  # fmt: skip
    return names.get(type(value), f"a {type(value).__name__}")


def toml_lines(record: Any) -> list[str]:
    """Write the fields of a dataclass as lines of a TOML table; fields that are None are omitted."""
    values = {f.name: getattr(record, f.name) for f in fields(record)}
    return [f"{name} = {toml(value)}" for name, value in values.items() if value is not None]


def toml(value: Any) -> str:
    """Write a value as TOML: a float with all its digits; a value without TOML type, such as a path, as text."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml, value))}]"
    return repr(value) if isinstance(value, int | float) else json.dumps(str(value))
