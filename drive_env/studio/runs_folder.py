"""The folder `runs/` for web pages: lists its runs and their files, and gives no access outside of it."""

from __future__ import annotations

import itertools
import mimetypes
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from mechanics.reading.untrusted import read_json, read_start, read_toml

RUNS = Path("runs")
ROUTE = "/studio/runs/"
MOST_RUNS = 500  # that are listed, the newest
MOST_FILES = 400  # per run
MOST_ENTRIES = 20_000  # of a run's folder that are examined
MOST_TEXT = 200_000  # bytes of a text that are shown
MOST_READ = 8  # files of one name that are read for a page
PICTURES, FILMS = (".png", ".jpg", ".jpeg", ".svg", ".webp", ".gif"), (".mp4", ".webm")
TEXTS = (".toml", ".json", ".csv", ".txt", ".md", ".yaml", ".yml", ".log")
REPORTS = (".html",)
EVENTS = "events.out.tfevents."  # first part of the names of TensorBoard's files
# Permissions of a page of a run: its own text, styles and pictures; no script, no form, nothing from other servers.
POLICY = (
    "sandbox; default-src 'none'; img-src data: 'self'; media-src 'self'; style-src 'unsafe-inline'; font-src data:; "
    "frame-ancestors 'self'"
)


@dataclass(frozen=True)
class RunFile:
    """A file of a run: path in the run, kind ("report", "picture", "film", "text", "other"), size [bytes]."""

    path: str
    kind: str
    size: int


@dataclass(frozen=True)
class Run:
    """A run: its name, the time of its last change [s since 1970], and its files."""

    name: str
    changed: float
    files: tuple[RunFile, ...]

    @property
    def when(self) -> str:
        """Date and time of the run's last change."""
        return time.strftime("%Y-%m-%d %H:%M", time.localtime(self.changed))

    def of(self, kind: str) -> list[RunFile]:
        """Return the run's files of a kind."""
        return [file for file in self.files if file.kind == kind]

    @property
    def has_events(self) -> bool:
        """Whether it has TensorBoard files of a training."""
        return any(Path(file.path).name.startswith(EVENTS) for file in self.files)


def kind_of(path: Path) -> str:
    """Return a file's kind by its suffix: report, picture, film, text or other."""
    ending = path.suffix.lower()
    for kind, endings in (("report", REPORTS), ("picture", PICTURES), ("film", FILMS), ("text", TEXTS)):
        if ending in endings:
            return kind
    return "other"


def list_runs(root: Path = RUNS) -> list[Run]:
    """Return the runs, the newest first: folders in `root`, and each single file in it as a run."""
    if not root.is_dir():
        return []
    found = []
    for one in root.iterdir():
        if one.name.startswith(".") or one.is_symlink():
            continue
        found.append((_changed(one), one))
    found.sort(key=lambda pair: (-pair[0], pair[1].name))
    return [_run(one, changed) for changed, one in found[:MOST_RUNS]]


def find_run(name: str, root: Path = RUNS) -> Run | None:
    """Return the run with a name; None if it does not exist."""
    try:
        path = confined(name, root)
    except ValueError:
        return None
    if path.parent != root.resolve() or not path.exists():
        return None
    return _run(path, _changed(path))


def confined(name: str, root: Path = RUNS) -> Path:
    """Resolve a path inside the folder of runs.

    Raises:
        ValueError: For a path outside of it, by dots or by a link, or an invalid file name.
    """
    base = root.resolve()
    try:
        path = (base / name).resolve()
        if path == base or not path.is_relative_to(base):
            raise ValueError(f"{name} is not in {root}")
        path.exists()
    except (OSError, RuntimeError, UnicodeError) as error:  # a name that is too long, or circular links
        raise ValueError(f"{name[:100]} is no name of a file in {root}: {error}") from None
    return path


def url_of(run: str, path: str = "") -> str:
    """Return the address of a file of a run."""
    return ROUTE + quote(f"{run}/{path}" if path else run)


def media_type(path: Path) -> str:
    """Return the media type with which a file is sent; never one that a browser would execute."""
    if kind_of(path) == "text":
        return "text/plain; charset=utf-8"
    found, _ = mimetypes.guess_type(path.name)
    kinds = ("picture", "film", "report")
    return found if found and kind_of(path) in kinds else "application/octet-stream"


def text_of(path: Path) -> str:
    """Return the text of a file, only its beginning if it is long."""
    content = read_start(path, MOST_TEXT + 1)
    text = content[:MOST_TEXT].decode("utf-8", "replace")
    return text if len(content) <= MOST_TEXT else text + "\n… (the file goes on)"


def settings_of(run: Run, root: Path = RUNS) -> dict[str, str]:
    """Return the settings of a run as flat names and texts; empty without settings."""
    found: dict[str, str] = {}
    for file in _named(run, "settings.toml", "config.toml", "args.toml"):
        try:
            found |= _flat(read_toml(confined(f"{run.name}/{file.path}", root)))
        except (OSError, ValueError):
            continue
    return found


def certificate_of(run: Run, root: Path = RUNS) -> dict[str, Any]:
    """Return the certificate of a run as parsed JSON; empty without a readable one."""
    for file in _named(run, "certificate.json", "stepper-certificate.json"):
        try:
            data = read_json(confined(f"{run.name}/{file.path}", root))
        except (OSError, ValueError):
            continue
        if isinstance(data, dict):
            return data
    return {}


def _named(run: Run, *names: str) -> list[RunFile]:
    """Return the first files of a run with one of these names that are short enough for a page."""
    found = [file for file in run.files if Path(file.path).name in names and file.size < MOST_TEXT]
    return found[:MOST_READ]


def _run(path: Path, changed: float) -> Run:
    if path.is_file():
        return Run(path.name, changed, (RunFile("", kind_of(path), path.stat().st_size),))
    files: list[RunFile] = []
    for one in sorted(itertools.islice(path.rglob("*"), MOST_ENTRIES)):
        if len(files) >= MOST_FILES:
            break
        if one.is_file() and not one.is_symlink() and not any(p.startswith(".") for p in one.relative_to(path).parts):
            files.append(RunFile(one.relative_to(path).as_posix(), kind_of(one), one.stat().st_size))
    return Run(path.name, changed, tuple(files))


def _changed(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def _flat(table: dict[str, Any], prefix: str = "") -> dict[str, str]:
    found: dict[str, str] = {}
    for name, value in table.items():
        if isinstance(value, dict):
            found |= _flat(value, f"{prefix}{name}.")
        else:
            found[prefix + name] = str(value)
    return found
