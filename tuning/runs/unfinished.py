"""An unfinished run: a folder beside that of the results, from which the run continues if it is interrupted.

The folder of the results is complete or absent. The folder beside it, `<folder>.unfinished`, has the run's settings,
its inputs, the results of finished shards, and partial results of shards that can continue from these; it is removed at
the end of the run.
"""

from __future__ import annotations

import shutil
import tomllib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from drive_env.whole_file import write_whole
from mechanics.reading.untrusted import read_toml
from tuning.runs.inputs import Input, check_unchanged, write_inputs
from tuning.runs.shard_log import ShardLog, ShardLogError

SUFFIX, SETTINGS, SHARDS, PART = ".unfinished", "settings.toml", "shards", "part-"


def unfinished_folder(folder: str | Path) -> Path:
    """Return the folder of an unfinished run, by the folder of its results."""
    path = Path(folder)
    return path.with_name(path.name + SUFFIX)


def settings_of(folder: str | Path) -> Path | None:
    """Return the settings of an unfinished run; None without one."""
    path = unfinished_folder(folder) / SETTINGS
    return path if path.is_file() else None


@contextmanager
def shard_log(folder: str | Path, settings: str, *, resume: bool, inputs: Iterable[Input] = ()) -> Iterator[ShardLog]:
    """Yield the log of a run's shards; if it has no results at the end, remove the folder of the unfinished run.

    Args:
        folder: Folder of the results.
        settings: Settings from which the run repeats: other settings mean another run.
        resume: Continue an unfinished run if there is one.
        inputs: The user's files of the run; a table `inputs` in the settings has their hashes.

    Raises:
        ShardLogError: If an unfinished run exists and must not be resumed, or is another one.
        InputError: If one of its inputs has changed.
        OSError: If the folder cannot be written.
    """
    place = unfinished_folder(folder)
    if place.exists() and not resume:
        raise ShardLogError(f"{place} holds an unfinished run; continue it with --resume, or remove it")
    inputs = list(inputs)
    check_unchanged(_recorded(place / SETTINGS), inputs, place)
    is_new = not place.exists()
    place.mkdir(parents=True, exist_ok=True)
    try:
        begun = ShardLog(place / SHARDS, settings)
    except OSError:
        if is_new:
            discard(folder)
        raise
    with begun as log:
        try:
            if not (place / SETTINGS).exists():
                write_inputs(place, inputs)
                write_whole(place / SETTINGS, settings)
            yield log
        finally:
            if not log.holds_results and not has_parts(log):
                discard(folder)


@contextmanager
def telling_what_is_kept(folder: str | Path) -> Iterator[None]:
    """Add to the error of a failed write, as on a full disk, how the run in this folder can continue."""
    try:
        yield
    except OSError as error:
        if error.filename is None or not unfinished_folder(folder).exists():
            raise
        why = f"{error.strerror}; the completed part is kept: make room, then continue with --out {folder} --resume"
        raise OSError(error.errno, why, error.filename) from None


def _recorded(settings: Path) -> object:
    """Return the inputs in the settings of an unfinished run; None if the file cannot be read."""
    try:
        return read_toml(settings).get("inputs")
    except (OSError, ValueError, tomllib.TOMLDecodeError):
        return None


def has_parts(log: ShardLog) -> bool:
    """Return whether some shards of a run have stored partial results."""
    return any(log.path.parent.glob(f"{PART}*"))


def part_path(log: ShardLog, shard: int) -> Path:
    """Return the file for partial results of a shard."""
    return log.path.with_name(f"{PART}{shard}")


@contextmanager
def part_log(path: Path, key: str) -> Iterator[ShardLog]:
    """Yield the log of a shard's partial results; remove the file if it has no results at the end."""
    with ShardLog(path, key) as log:
        try:
            yield log
        finally:
            if not log.holds_results:
                path.unlink(missing_ok=True)


def discard(folder: str | Path) -> None:
    """Remove the files of an unfinished run."""
    shutil.rmtree(unfinished_folder(folder), ignore_errors=True)
