"""A run that is under way: a folder beside the one that its results will have, from which it goes on if it is killed.

The folder of the results is complete or absent. Beside it, named `<folder>.unfinished`, lie the settings of the run,
its inputs, the results of the shards that are done, and of shards that can go on from where they were what they have so
far; it vanishes with the last step of the run.
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
    """Return where a run keeps finished shards while its folder is absent."""
    path = Path(folder)
    return path.with_name(path.name + SUFFIX)


def settings_of(folder: str | Path) -> Path | None:
    """Return the settings of an unfinished run, None without an unfinished run."""
    path = unfinished_folder(folder) / SETTINGS
    return path if path.is_file() else None


@contextmanager
def shard_log(folder: str | Path, settings: str, *, resume: bool, inputs: Iterable[Input] = ()) -> Iterator[ShardLog]:
    """Give the shards of a run that are done, and keep those to come; leave no folder behind without any shard.

    Args:
        folder: Where the results will be.
        settings: What the run repeats from: with other settings it is another run.
        resume: Go on with an unfinished run if there is one.
        inputs: What the run has taken from its user's files; the settings have their hashes in a table `inputs`.

    Raises:
        ShardLogError: If an unfinished run is there and is not to be resumed, or is another one.
        InputError: If one of its inputs was changed since.
        OSError: If it cannot be written.
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
    """Have the error of a file that cannot be written, as on a full disk, say how a run in this folder goes on."""
    try:
        yield
    except OSError as error:
        if error.filename is None or not unfinished_folder(folder).exists():
            raise
        why = f"{error.strerror}; the completed part is kept: make room, then continue with --out {folder} --resume"
        raise OSError(error.errno, why, error.filename) from None


def _recorded(settings: Path) -> object:
    """Return the inputs in the settings of an unfinished run, None if the file cannot be read."""
    try:
        return read_toml(settings).get("inputs")
    except (OSError, ValueError, tomllib.TOMLDecodeError):
        return None


def has_parts(log: ShardLog) -> bool:
    """Return whether shards of a run have begun, and kept partial results."""
    return any(log.path.parent.glob(f"{PART}*"))


def part_path(log: ShardLog, shard: int) -> Path:
    """Return the file in which a shard of a run keeps partial results."""
    return log.path.with_name(f"{PART}{shard}")


@contextmanager
def part_log(path: Path, key: str) -> Iterator[ShardLog]:
    """Give the partial results of a shard, and keep those to come; leave no file behind without results."""
    with ShardLog(path, key) as log:
        try:
            yield log
        finally:
            if not log.holds_results:
                path.unlink(missing_ok=True)


def discard(folder: str | Path) -> None:
    """Remove the files of an unfinished run."""
    shutil.rmtree(unfinished_folder(folder), ignore_errors=True)
