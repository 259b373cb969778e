"""Run folders that are complete or absent; versions and a hash of the sources that made the results."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import zip_longest
from pathlib import Path
from typing import Any

from drive_env import __version__
from drive_env.own_packages import ROOT
from drive_env.whole_file import keep_names

HEADER = "# All settings of this run. To repeat it: drive-tune sweep --config settings.toml\n"
_PACKAGES = ("numpy", "numba", "llvmlite", "mujoco")
_OURS = tuple(ROOT / name for name in ("drive_env", "mechanics", "tuning", "agents"))


def hash_of_sources(folders: Iterable[Path] = _OURS) -> str:
    """Return a hash of the names and contents of all files of our packages, with data files."""
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted(folder.rglob("*")):
            parts = path.relative_to(folder.parent).parts
            # Files of Python or an editor do not matter.
            if path.suffix == ".pyc" or any(part.startswith(".") for part in parts) or not path.is_file():
                continue
            content = path.read_bytes()
            digest.update(f"{'/'.join(parts)} {len(content)}\n".encode() + content)
    return digest.hexdigest()[:16]


# As loaded by this process: later edits of files do not change what it runs.
SOURCES = hash_of_sources()


def check_begun(what: object, recorded: object, remedy: str) -> None:
    """Raise ValueError, with both hashes, if a run to be continued was begun with other sources.

    Args:
        what: The file or folder of the run.
        recorded: The hash in it, if any.
        remedy: An alternative for the user.
    """
    if recorded != SOURCES:
        raise ValueError(
            f"{what} holds results of sources {recorded or 'unknown'}, these are {SOURCES}, and they are not mixed; "
            f"continue with the sources that it was begun with, or {remedy}"
        )


def check_study(study: Any, file: Path, remedy: str, subject: str = "") -> None:
    """Store the hash of the sources and the subject in a new Optuna study; check those of one with trials.

    Args:
        study: The study.
        file: Its journal.
        remedy: An alternative for the user.
        subject: What its trials are of, as lines of text: trials of another subject are not comparable.

    Raises:
        ValueError: If it was begun with other sources or another subject, with the first line that differs.
    """
    if not study.trials:
        study.set_user_attr("sources", SOURCES)
        study.set_user_attr("subject", subject)
    check_begun(file, study.user_attrs.get("sources"), remedy)
    begun, now = (str(text).splitlines() for text in (study.user_attrs.get("subject", ""), subject))
    for was, own in zip_longest(begun, now, fillvalue="nothing"):
        if was != own:
            raise ValueError(
                f"{file} holds trials of something else, and they are not mixed: {was} there, {own} here; go on with "
                f"what it was begun with, or {remedy}"
            )


def check_sources(expected: str) -> None:
    """Raise ValueError, with both hashes, if this process was loaded from other sources, or its files have changed.

    Args:
        expected: The hash of the process that gives the work.
    """
    for found in (SOURCES, hash_of_sources()):
        if found != expected:
            raise ValueError(
                f"a worker has sources {found}, the run was begun with {expected}, and their results are not mixed: "
                "install the same files there, start the worker again, and continue with --resume"
            )


def versions() -> dict[str, str]:
    """Return the versions on which results depend: packages, our sources, Python, the processor of compiled kernels."""
    import llvmlite.binding

    found = {"drive-env": __version__} | {name: importlib.metadata.version(name) for name in _PACKAGES}
    found["sources"] = SOURCES
    return found | {"python": platform.python_version(), "processor": str(llvmlite.binding.get_host_cpu_name())}


def differences(recorded: Mapping[str, str]) -> list[str]:
    """Return a line for each version that differs from the recorded one: last digits may then differ."""
    if not recorded:
        return []
    here = versions()
    return [
        f"the run was made with {name} {version}, this is {here.get(name, 'none')}: last digits may differ"
        for name, version in recorded.items()
        if here.get(name) != version
    ]


def run_folder(kind: str, parent: str | Path = "runs") -> Path:
    """Return the name of a new folder: runs/<date>-<time>-<kind>."""
    stem = f"{time.strftime('%Y%m%d-%H%M%S')}-{kind}"
    name, k = Path(parent) / stem, 2
    while name.exists():
        name, k = Path(parent) / f"{stem}-{k}", k + 1
    return name


def nearest_place(path: Path) -> tuple[Path, bool]:
    """Return the nearest existing parent of a new file or folder, and whether it is writable."""
    place = path.absolute().parent
    while not place.exists():
        place = place.parent
    return place, os.access(place, os.W_OK | os.X_OK)


def check_folder(folder: str | Path) -> None:
    """Raise OSError unless the folder is new or empty, and its parent writable.

    Raises:
        FileExistsError: If the folder is not empty, or a file has its name.
        PermissionError: If the parent is not writable.
        NotADirectoryError: If the parent is a file.
    """
    path = Path(folder)
    if path.is_dir():
        if any(path.iterdir()):
            raise FileExistsError(f"the folder {path} is not empty; choose another --out or remove it")
    elif path.exists():
        raise FileExistsError(f"{path} is a file; choose another --out")
    place, writable = nearest_place(path)
    if not place.is_dir():
        raise NotADirectoryError(f"{place} is a file, so that {path} cannot be a folder; choose another --out")
    if not writable:
        raise PermissionError(f"the folder {place} cannot be written; choose another --out or change its permissions")


@contextmanager
def new_folder(folder: str | Path) -> Iterator[Path]:
    """Yield a partial folder to write into; it gets its name when all is written, and is removed if anything fails."""
    path = Path(folder)
    check_folder(path)
    partial = path.absolute().with_name(f".{path.absolute().name}.{os.getpid()}.partial")
    try:
        partial.mkdir(parents=True)
    except OSError as error:
        raise OSError(f"the folder {path} cannot be made: {error.strerror}; choose another --out") from None
    try:
        yield partial
        if path.is_dir():
            path.rmdir()  # it is empty; renaming onto a folder fails on Windows
        partial.rename(path)
        keep_names(path.absolute().parent)
    except BaseException as error:
        shutil.rmtree(partial, ignore_errors=True)
        if isinstance(error, OSError) and error.errno is not None:  # its file name is the partial folder's, or missing
            named = None if error.filename is None else Path(error.filename)
            name = path if named is None else path / named.name if named.is_relative_to(partial) else named
            raise OSError(error.errno, error.strerror, str(name)) from None
        raise
