"""The shipped agents, by name; each contains its card (`drive-agent evaluate --card NAME`)."""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).parent
TUNER = "gain_tuning"  # default agent of `drive-tune auto --by agent`


def shipped_names() -> tuple[str, ...]:
    """Return the names of all shipped agents."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.npz")))


def shipped(name: str) -> Path:
    """Return the file of a shipped agent.

    Raises:
        ValueError: For an unknown name.
    """
    if name not in shipped_names():
        raise ValueError(f"no agent named {name!r} ships; there are {', '.join(shipped_names())}, or give a file")
    return FOLDER / f"{name}.npz"


def find_agent(name_or_path: str) -> Path:
    """Return the file of an agent, by its path or a shipped one's name; ValueError for neither."""
    path = Path(name_or_path)
    return path if path.suffix == ".npz" or path.exists() else shipped(name_or_path)
