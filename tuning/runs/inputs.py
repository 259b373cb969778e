"""The user's files of a run: stored in its folder by content, identified by a hash, and sent along with its work.

A user's own motor, load, device, set of distributions or suite is given as a path. The file may be edited while a run
is stopped, and a worker may have another file of the same name. So a run reads it once: from then on its `Input` is
opened, wherever the work is done. Shipped names are no inputs: the hash of the sources covers them.
"""

from __future__ import annotations

import atexit
import hashlib
import json
import os
import re
import shutil
import tempfile
import threading
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from mechanics.reading.untrusted import TooLargeError, read_bytes

FOLDER = "inputs"  # in a run's folder
MOST_BYTES = 64_000_000  # of an input with all its files: it is sent with each task
_KEPT = re.compile(rf"{FOLDER}/[a-z]+(?:/[^/\\\0]+)+")


class InputError(ValueError):
    """A file that a run cannot store, or that has changed since the run began; one line with its remedy."""


class Input(str):
    """The path of this process' own copy of a user's file.

    Pickling stores the content: unpickling writes a new copy, without access to the original file.

    Attributes:
        given: The path as the user gave it, for messages.
        kept: Its place in a run's folder, e.g. `inputs/motor/mine.toml`.
        hash: SHA-256 over the names and contents of its files.
        files: Path -> content, relative to `inputs/<what>`; empty if only the hash is known, as for an agent file that
            was moved without its inputs.
    """

    __slots__ = ("files", "given", "hash", "kept")
    given: str
    kept: str
    hash: str
    files: Mapping[str, bytes]

    def __new__(cls, what: str, given: str, main: str, files: Mapping[str, bytes], recorded: str = "") -> Input:
        """Create the path of the copy, and write it if this process has none; `main` is the file, or the folder."""
        own = recorded if not files else _hash(main, files)
        path = Path(given) if not files else _copy(f"{own[:16]}/{what}", files) / main
        made = super().__new__(cls, path)
        made.given, made.kept, made.hash, made.files = given, f"{FOLDER}/{what}/{main}", own, files
        _GIVEN[str(path)] = given
        return made

    @property
    def what(self) -> str:
        """Kind of the input: "motor", "load" ..."""
        return self.kept.split("/")[1]

    @property
    def main(self) -> str:
        """Path of the file, or the folder, within `inputs/<what>`."""
        return self.kept.split("/", 2)[2]

    def __reduce__(self) -> Any:
        """Pickle the content."""
        return Input, (self.what, self.given, self.main, dict(self.files), self.hash)

    def __copy__(self) -> Input:
        """Return itself: it is constant."""
        return self

    def __deepcopy__(self, memo: object) -> Input:
        """Return itself."""
        return self

    def __repr__(self) -> str:
        """Show its place and hash, independently of the place of its copy."""
        return f"Input({self.kept!r}, {self.hash!r})"


def taken(what: str, name: Any, also: Iterable[Path] = ()) -> Any:
    """Return an `Input` for the path of a file or folder, and any other name unchanged.

    Args:
        what: A key of `_FILES`.
        name: As in `find_motor`, `find_load`, `find_device` and `Distributions.load`.
        also: Further files that belong to it, such as those that a suite names.

    Raises:
        InputError: If one of its files cannot be read, or lies where the copy cannot have it.
        ValueError: If it is not of this kind.
    """
    if isinstance(name, Input) or not isinstance(name, str | Path) or not is_path(what, str(name)):
        return name
    _check(what, name)  # so that messages have the user's path
    return _read(what, Path(name), str(name), also)


def files_of(what: str, path: Path) -> list[Path]:
    """Return the files that belong to the one at a path; raises as `taken`."""
    return _FILES[what](path)


def taken_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options with inputs instead of paths, by their keys."""
    return {key: taken(key, value) if key in _FILES else value for key, value in options.items()}


def inputs_in(value: Any) -> list[Input]:
    """Return the inputs among values, also in nested tables and lists."""
    return list({one.kept: one for one in _walk(value)}.values())


def hashes(inputs: Iterable[Input]) -> dict[str, str]:
    """Return the table of inputs for settings: place in the folder -> hash."""
    return {one.kept: one.hash for one in inputs}


def table_of(inputs: Iterable[Input]) -> list[str]:
    """Return the lines of the table of inputs in settings; empty without inputs."""
    lines = [f'{json.dumps(place)} = "{own}"' for place, own in hashes(inputs).items()]
    return ["", "[inputs]", *lines] if lines else []


def as_kept(value: Any) -> Any:
    """Replace inputs by their places in a run's folder, also in nested tables and lists."""
    if isinstance(value, Input):
        return value.kept
    if isinstance(value, Mapping):
        return {key: as_kept(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [as_kept(one) for one in value]
    return value


def found_in(value: Any, folder: Path) -> Any:
    """Replace inputs by the absolute paths of their copies in a run's folder, for a file outside that folder."""
    if isinstance(value, Input):
        return str(folder.absolute() / value.kept)
    if isinstance(value, Mapping):
        return {key: found_in(one, folder) for key, one in value.items()}
    return value


def write_inputs(folder: Path, inputs: Iterable[Input]) -> None:
    """Write inputs into a run's folder; raises OSError with the file and the reason."""
    from drive_env.whole_file import write_whole  # here, since acting with an agent's file needs NumPy only

    for one in inputs:
        for name, content in one.files.items():
            write_whole(folder / FOLDER / one.what / name, content)


def found_again(value: Any, recorded: Any, folder: Path, *, alone: bool = False) -> Any:
    """Replace places in a run's folder by the inputs stored there.

    Args:
        value: A name, or a table of names.
        recorded: The table of inputs in the settings, as written by `hashes`.
        folder: The run's folder.
        alone: Whether the settings may have been moved without the inputs: a missing input then has no content.

    Raises:
        InputError: If an input is missing, or differs from the recorded one.
    """
    if isinstance(value, Mapping):
        return {key: found_again(one, recorded, folder, alone=alone) for key, one in value.items()}
    if not isinstance(value, str) or not isinstance(recorded, Mapping) or value not in recorded:
        return value
    wanted = recorded[value]
    if not _KEPT.fullmatch(value) or ".." in PurePosixPath(value).parts or not isinstance(wanted, str):
        raise InputError(f"{value!r} is no place of an input; it is {FOLDER}/motor/mine.toml or the like")
    what, main, path = value.split("/")[1], value.split("/", 2)[2], folder.absolute() / value
    if not path.exists():
        if alone:
            return Input(what, str(path), main, {}, wanted)
        raise InputError(f"{path} is missing, which the run was made with; copy the run's folder as a whole")
    _check(what, path)
    found = _read(what, path, str(path))
    if found.kept != value or found.hash != wanted:
        raise InputError(f"{path} was changed since the run was made with it; take another copy of the run's folder")
    return found


def check_unchanged(recorded: Any, inputs: Iterable[Input], place: Path) -> None:
    """Raise InputError, with the file and the remedies, if an input of a stopped run has changed.

    Args:
        recorded: The table of inputs in its settings.
        inputs: The present ones.
        place: The folder of the stopped run.
    """
    if not isinstance(recorded, Mapping):
        return
    for one in inputs:
        if recorded.get(one.kept, one.hash) != one.hash:
            raise InputError(
                f"{_changed(one, place)} was changed since the run in {place} was begun, and the results of two are "
                f"not mixed: go on with the {one.what} as it was, of which {place / one.kept} is a copy, or remove "
                f"{place} to begin anew"
            )


def _changed(one: Input, place: Path) -> str:
    """Return which file of an input differs from the copy in a run's folder, for a message."""
    folder = place / FOLDER / one.what
    for name, content in one.files.items():
        try:
            same = read_bytes(folder / name) == content
        except (OSError, ValueError):
            same = False
        if not same and name != one.main:
            return f"{name} of {one.given} ({one.what})"
        if not same:
            break
    return f"{one.given} ({one.what})"


def forget_copies() -> None:
    """Remove this process' copies; needed before an exit without cleanup (os._exit)."""
    with _LOCK:
        if _COPIES and _COPIES[0][0] == os.getpid():
            shutil.rmtree(_COPIES.pop()[1], ignore_errors=True)


# --- the files of an input --------------------------------------------------------------------------------------------
def is_path(what: str, name: str) -> bool:
    """Return whether a name is the path of a file, or of a device's folder, as `find_motor` and similar take it."""
    if is_shipped(what, name):
        return False
    if what == "device":
        from drive_env.devices.own_folder import is_own_folder

        return name.endswith(".toml") or is_own_folder(name)
    if what == "load":
        from mechanics.loads import MODEL_ENDINGS

        return name.endswith(MODEL_ENDINGS)
    return name.endswith(".toml")


def is_shipped(what: str, name: str) -> bool:
    """Return whether a name is a shipped one, even if the present folder has a file of this name."""
    if what == "device":
        from drive_env.devices import device_names

        return name in device_names()
    return False  # other shipped names end differently from paths


def _check(what: str, name: str | Path) -> None:
    """Raise ValueError, with the path as given, for a file that is not of this kind."""
    if what == "motor":
        from drive_env.motors import find_motor

        find_motor(name)
    elif what == "load":
        from mechanics.loads import find_load

        find_load(name)
    elif what == "device":
        from drive_env.devices import find_device

        find_device(str(name))
    elif what == "distributions":
        from drive_env.randomisation.random_machines import Distributions

        Distributions.load(name)


def _read(what: str, path: Path, given: str, also: Iterable[Path] = ()) -> Input:
    """Read the input at a path, all its files once."""
    try:
        paths = [_whole(one) for one in (*_FILES[what](path), *also)]
        top = _whole(path)
        folder = Path(os.path.commonpath([one.parent for one in (*paths, top)]))
        files: dict[str, bytes] = {}
        for one in sorted(set(paths)):
            left = MOST_BYTES - sum(map(len, files.values()))
            files[one.relative_to(folder).as_posix()] = read_bytes(one, left)
    except OSError as error:
        raise InputError(f"{error.filename or given} cannot be read: {error.strerror}") from None
    except TooLargeError as error:
        raise InputError(
            f"{given}: {error} A {what} has {MOST_BYTES // 1_000_000} MB at most, since each task has it"
        ) from None
    found = Input(what, given, top.relative_to(folder).as_posix(), files)
    outside = [one for one in _FILES[what](Path(found)) if not _whole(one).is_relative_to(_top(found))]
    if outside:
        raise InputError(
            f"{given} names {outside[0]} by its whole path, so that a run's copy would not hold it; name it relative "
            f"to {given}"
        )
    return found


def _whole(path: Path) -> Path:
    """Make a path absolute and remove `..`; links are not resolved, since a copy keeps their names."""
    return Path(os.path.abspath(path))  # noqa: PTH100


def _top(one: Input) -> Path:
    """Return the folder of a copy to which its files' paths are relative."""
    return Path(one).parents[len(PurePosixPath(one.main).parts) - 1]


def _alone(path: Path) -> list[Path]:
    return [path]


def _of_load(path: Path) -> list[Path]:
    """Return the files of an MJCF: includes, meshes, textures and height fields."""
    import mujoco

    try:
        return [Path(one) for one in mujoco.mju_getXMLDependencies(str(path))]
    except mujoco.FatalError as error:
        raise ValueError(" ".join(str(error).split())) from None


def _of_device(path: Path) -> list[Path]:
    """Return the files of a variant, or the used files of a device's folder."""
    if not path.is_dir():
        return [path]
    from drive_env.devices.own_folder import own_data

    named = ("device.toml", str(own_data(path)["eds"]), "bindings.toml", "roles.toml", "gains.toml")
    return [*(path / name for name in named), *path.glob("commissioning.toml"), *(path / "presets").glob("*.toml")]


_FILES = {"motor": _alone, "distributions": _alone, "load": _of_load, "device": _of_device, "suite": _alone}

# --- copies -----------------------------------------------------------------------------------------------------------
_LOCK = threading.RLock()  # reentrant: Ctrl-C may arrive while it is held, and removes the copies
_COPIES: list[tuple[int, Path]] = []  # process and its folder
_GIVEN: dict[str, str] = {}  # path of a copy -> path as the user gave it


def as_given(text: str) -> str:
    """Replace paths of this process' copies in a message by those that the user gave."""
    for copy, given in _GIVEN.items():
        text = text.replace(copy, given)
    return text


def _copy(place: str, files: Mapping[str, bytes]) -> Path:
    """Write files to this process' folder unless they are there, and return their folder."""
    with _LOCK:
        if not _COPIES or _COPIES[0][0] != os.getpid():  # the copies of a parent process, if this one is a fork
            if not _COPIES:
                atexit.register(forget_copies)
            _COPIES[:] = [(os.getpid(), Path(tempfile.mkdtemp(prefix="drive-env-inputs-")))]
        folder = _COPIES[0][1] / place
        if not folder.exists():
            partial = folder.with_name(f".{folder.name}.partial")
            for name, content in files.items():
                if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
                    raise InputError(f"{name!r} is no path within an input")
                path = partial / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content)
            partial.rename(folder)
        return folder


def _hash(main: str, files: Mapping[str, bytes]) -> str:
    digest = hashlib.sha256(f"{main}\n".encode())
    for name, content in sorted(files.items()):
        digest.update(f"{name} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def _walk(value: Any) -> Iterator[Input]:
    if isinstance(value, Input):
        yield value
    elif isinstance(value, Mapping):
        for one in value.values():
            yield from _walk(one)
    elif isinstance(value, list | tuple):
        for one in value:
            yield from _walk(one)
