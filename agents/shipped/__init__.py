"""The agents that ship in the package, by name; each has its card inside (`drive-agent evaluate --card NAME`)."""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).parent
TUNER = "gain_tuning"  # what `drive-tune auto --by agent` takes unless told otherwise


def shipped_names() -> tuple[str, ...]:
    """Return the names of all agents that ship."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.npz")))


def shipped(name: str) -> Path:
    """Return the file of an agent that ships.

    Raises:
        ValueError: For an unknown name.
    """
    if name not in shipped_names():
        raise ValueError(f"no agent named {name!r} ships; there are {', '.join(shipped_names())}, or give a file")
    return FOLDER / f"{name}.npz"


def find_agent(name_or_path: str) -> Path:
    """Return the file of an agent: one that ships, by its name, or any other."""
    path = Path(name_or_path)
    return path if path.suffix == ".npz" or path.exists() else shipped(name_or_path)
