"""Checks that Python finds our packages: others name theirs `mechanics`, `tuning` and `agents`, too."""

from __future__ import annotations

import importlib.util
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent  # where our packages lie side by side


class ForeignPackageError(ImportError):
    """A foreign package has the name of ours; the message names it and its remedy."""


def check_own(*names: str, root: Path = ROOT) -> None:
    """Raise ForeignPackageError unless Python finds each package in our folder; nothing is imported for that.

    Args:
        names: Names of packages, e.g. "mechanics".
        root: The folder in which our packages lie.

    Raises:
        ForeignPackageError: For a package that is missing or a foreign one, with its place and the remedy.
    """
    for name in names:
        spec = importlib.util.find_spec(name)
        places = [Path(place).resolve() for place in (spec.submodule_search_locations or ())] if spec else []
        if spec is not None and not places and spec.origin:
            places = [Path(spec.origin).resolve()]  # a lone module of that name
        if not places:
            raise ForeignPackageError(
                f"package {name!r} of drive-env is not installed beside {root / 'tuning'}; install drive-env again"
            )
        if places[0] != root / name:
            raise ForeignPackageError(
                f"Python finds a foreign package {name!r} at {places[0]} before drive-env's own at {root / name}; "
                "uninstall it, or take its folder off PYTHONPATH and the working directory"
            )
