"""An environment's configuration: a dataclass, filled from a table, a TOML file and single options."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import fields
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TypeVar

from drive_env.motors import Motor
from mechanics.reading.near_names import did_you_mean
from mechanics.reading.untrusted import read_toml

Config = TypeVar("Config")


def _is_number(value: Any) -> bool:
    return not isinstance(value, bool) and isinstance(value, Real)


def _is_whole(value: Any) -> bool:
    return not isinstance(value, bool) and isinstance(value, Integral)


# Type of a field -> its description, and the check of a value; fields of other types check themselves.
_KINDS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "str": ("text", lambda value: isinstance(value, str)),
    "str | Motor": ("a motor's name, the path of its file, or a Motor", lambda value: isinstance(value, (str, Motor))),
    "int": ("a whole number", _is_whole),
    "float": ("a number", _is_number),
    "bool": ("true or false", lambda value: isinstance(value, bool)),
    "tuple[str, ...]": (
        "a list of names",
        # Also a single name: the dataclass knows the valid ones.
        lambda value: isinstance(value, str | list | tuple) and all(isinstance(one, str) for one in value),
    ),
    "Mapping[str, float]": (
        "a table of finite numbers",
        lambda value: isinstance(value, Mapping) and all(_is_number(v) and math.isfinite(v) for v in value.values()),
    ),
}


def configured(
    kind: type[Config], source: Config | Mapping[str, Any] | str | Path | None, options: Mapping[str, Any]
) -> Config:
    """Return a configuration of a dataclass.

    Args:
        kind: The dataclass, which checks its values itself.
        source: An instance, a table, the path of a TOML file, or None for the defaults.
        options: Fields that replace the source's.

    Raises:
        ValueError: For an unknown field, a value of another type, or a file that is not TOML.
    """
    if source is None:
        table: dict[str, Any] = {}
    elif isinstance(source, kind):
        table = {field.name: getattr(source, field.name) for field in fields(kind)}  # type: ignore[arg-type]
    elif isinstance(source, Mapping):
        table = dict(source)
    elif isinstance(source, (str, Path)):
        table = _read(Path(source))
    else:
        raise ValueError(f"a configuration is a {kind.__name__}, a table or a TOML file, not {source!r}")
    table |= options
    known = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    for name in table:
        if name not in known:
            raise ValueError(f"there is no option {name!r}; there are {', '.join(known)}{did_you_mean(name, known)}")
    for field in fields(kind):  # type: ignore[arg-type]
        if field.name in table:
            if str(field.type).startswith("float") and table[field.name] in ("inf", "-inf"):
                table[field.name] = float(table[field.name])  # JSON has no infinity: an agent's file has it as text
            _check_type(field.name, str(field.type), table[field.name])
    return kind(**table)


def _check_type(name: str, kind: str, value: Any) -> None:
    """Raise ValueError unless a value is of the field's type in the dataclass."""
    optional = kind.endswith(" | None")
    if optional and value is None:
        return
    what, fits = _KINDS.get(kind.removesuffix(" | None"), ("", lambda value: True))
    if not fits(value):
        raise ValueError(f"{name} must be {what}{' or left out' if optional else ''}, not {value!r}")


def _read(path: Path) -> dict[str, Any]:
    try:
        return read_toml(path)
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not TOML: {error}") from None
