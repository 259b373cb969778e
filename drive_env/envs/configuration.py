"""An environment's configuration: a dataclass, filled from a table, a TOML file and single options."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, TypeVar

Config = TypeVar("Config")


def configured(
    kind: type[Config], source: Config | Mapping[str, Any] | str | Path | None, options: Mapping[str, Any]
) -> Config:
    """Return a configuration of a dataclass.

    Args:
        kind: The dataclass; it checks its values itself.
        source: One of it, a table, the path of a TOML file, or None for the defaults.
        options: Fields that replace the source's.

    Raises:
        ValueError: For a field that there is not, naming those that there are, or a file that is no TOML.
    """
    if source is None:
        table: dict[str, Any] = {}
    elif isinstance(source, kind):
        table = asdict(source)  # type: ignore[call-overload]
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
            raise ValueError(f"there is no option {name!r}; there are {', '.join(known)}")
    return kind(**table)


def _read(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no TOML: {error}") from None
