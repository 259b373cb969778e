"""The parameters of drives before they are changed: a file, and the way back.

A `Transaction` writes the file before anything else happens, so that even a process that is killed leaves it behind;
`drive-tune restore FILE` brings the drives back to it. Axes that are not committed are rolled back at the end.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from drive_env import motion
from drive_env.dictionary.access import ObjectAccessError, check_in_range, check_writable
from drive_env.gains import GAIN_OBJECTS
from drive_env.master.description import Description, Key, describe
from drive_env.master.errors import BusError
from drive_env.master.parameters import Difference, read_parameters, write_all_or_none
from drive_env.safety import SafetyError
from tuning.provenance import nearest_place, run_folder
from tuning.toml_tables import toml

if TYPE_CHECKING:
    from drive_env.dictionary.entries import Entry
    from tuning.target import Target

Mask = NDArray[np.bool_]

SWITCH_OFF = 1000  # cycles that switching the voltage off may take
SAVE = 0x65766173  # CiA 301: "save", written to 1010h
STORE = (0x1010, 1)
DEVICE_OBJECTS = 0x2000  # from here on: what lies below is how drives talk, which their master has in use


class SnapshotError(ValueError):
    """A file that is no snapshot, or that does not fit these drives: one line with its remedy."""


@dataclass(frozen=True)
class Snapshot:
    """All parameters of drives as they were.

    Attributes:
        device: Name of the device.
        axes: Of every axis, (index, sub-index) -> raw integer.
        bus: What opens the drives again, for `CanDrives`; empty for emulated drives.
        stored: Whether the drives were told to keep what came afterwards: then the way back is to be kept, too.
    """

    device: str
    axes: tuple[Mapping[Key, int], ...]
    bus: Mapping[str, Any] = field(default_factory=dict)
    stored: bool = False

    def save(self, path: str | Path) -> Path:
        """Write the snapshot as TOML and return its path; the file is complete or absent, also after a power cut.

        Raises:
            OSError: If it cannot be written.
        """
        where = Path(path)
        partial = where.with_name(f".{where.name}.partial")
        try:
            where.parent.mkdir(parents=True, exist_ok=True)
            with partial.open("w", encoding="utf-8", newline="\n") as file:
                file.write(self._toml(where.name))
                file.flush()
                os.fsync(file.fileno())
            partial.replace(where)
            if os.name == "posix":  # the new name, too
                folder = os.open(where.parent, os.O_RDONLY)
                with suppress(OSError):  # some file systems know no such thing
                    os.fsync(folder)
                os.close(folder)
        except OSError as error:
            with suppress(OSError):
                partial.unlink(missing_ok=True)
            raise OSError(
                f"the state before cannot be written to {where}: {error.strerror}; choose another place"
            ) from None
        return where

    def _toml(self, name: str) -> str:
        dictionary = describe(self.device, None).dictionary
        lines = [
            f"# Parameters of {len(self.axes)} axes, read {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC before a change.",
            f"# drive-tune restore {name} brings them back.",
            "",
            f"device = {toml(self.device)}",
            f"stored = {str(self.stored).lower()}  # whether the drives were told to keep what came then",
        ]
        if self.bus:
            lines += ["", "[bus]"]
            for key, value in self.bus.items():
                lines.append(f"{key} = {value if isinstance(value, list) else toml(value)}")
        for axis, values in enumerate(self.axes):
            lines += ["", f"[[axis]]  # {axis}; index:sub-index, both hexadecimal"]
            for (index, sub), value in values.items():
                lines.append(f'"{index:04X}:{sub:02X}" = {value}  # {dictionary.find((index, sub)).name}')
        return "\n".join(lines) + "\n"


def take(target: Target) -> Snapshot:
    """Return the parameters of a target's drives as they are.

    Take it before the drives record anything: that maps PDOs on a bus, which are parameters, too.
    """
    drives = _per_axis(target.drives)
    axes = tuple(read_parameters(drives, axis) for axis in range(target.num_axes))
    return Snapshot(target.device.name, axes, target.bus)


def load_snapshot(path: str | Path) -> Snapshot:
    """Return the snapshot of a file.

    Raises:
        SnapshotError: If the file is none.
    """
    where = Path(path)
    try:
        data = tomllib.loads(where.read_text(encoding="utf-8"))
    except OSError as error:
        raise SnapshotError(f"cannot read {where}: {error.strerror}; give a file that drive-tune left") from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise SnapshotError(f"{where} is no TOML: {error}; give a file that drive-tune left") from None
    tables = data.get("axis")
    if not isinstance(tables, list) or not tables or not isinstance(data.get("device"), str):
        raise SnapshotError(f"{where} is no snapshot; give a file that drive-tune left before a change")
    dictionary = describe(data["device"], None).dictionary
    axes = []
    for table in tables:
        values = {}
        for text, value in table.items():
            index, _, sub = text.partition(":")
            try:
                key = int(index, 16), int(sub, 16)
                entry = dictionary.find(key)
                check_writable(entry)
                check_in_range(entry, np.asarray(value))
            except (ValueError, ObjectAccessError) as error:
                raise SnapshotError(f"{where}: {text} = {value!r}: {error}") from None
            values[key] = int(value)
        axes.append(values)
    return Snapshot(data["device"], tuple(axes), data.get("bus", {}), bool(data.get("stored", False)))


def restore(
    drives: Any, snapshot: Snapshot, where: Mask | None = None, *, whole: bool = True
) -> list[list[Difference]]:
    """Bring drives back to a snapshot, axis by axis, each all or none; return what was changed on each.

    The axes must not be enabled.

    Args:
        drives: The drives, `EmulatedDrives` or `CanDrives`.
        snapshot: Where to.
        where: Axes to bring back; all by default.
        whole: Objects of the communication area as well: not while the drives' PDOs are in use.

    Raises:
        SnapshotError: If the drives are others; NotRestoredError or RollbackError if a drive refuses.
    """
    if len(snapshot.axes) != drives.num_axes or snapshot.device != drives.device.name:
        raise SnapshotError(
            f"the snapshot is of {len(snapshot.axes)} axes of {snapshot.device}, and here are {drives.num_axes} of "
            f"{drives.device.name}; open the drives that it was taken from"
        )
    axes = np.ones(drives.num_axes, bool) if where is None else where
    single = _per_axis(drives)
    changed: list[list[Difference]] = [[] for _ in snapshot.axes]
    for axis in map(int, np.flatnonzero(axes)):
        wanted = snapshot.axes[axis] if whole else _settings(snapshot.axes[axis])
        changed[axis] = write_all_or_none(single, wanted, axis)
    return changed


@contextmanager
def undisturbed() -> Iterator[None]:
    """Have Ctrl-C, and what else ends a command, wait for the block's end: drives are not left half brought back."""
    if threading.current_thread() is not threading.main_thread():
        yield  # signals reach the main thread alone
        return
    pressed: list[int] = []
    ends = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {number: signal.getsignal(number) for number in ends}
    handled = {number: handler for number, handler in before.items() if callable(handler)}
    for number in handled:
        signal.signal(number, lambda number, frame: pressed.append(number))
    try:
        yield
    finally:
        for number, handler in handled.items():
            signal.signal(number, handler)
    if pressed:
        raise KeyboardInterrupt


def file_before(kind: str, out: Path | None = None) -> Path:
    """Return where the state before goes: beside the results in `out`, or in runs/; never a file that is there.

    Args:
        kind: What moves the drives, for the name.
        out: Folder for its results, if any; or their file, less its ending.

    Raises:
        OSError: If nothing can be written there.
    """
    first = Path(f"{run_folder(kind)}-before.toml") if out is None else out.with_name(f"{out.name}-before.toml")
    file, k = first, 2
    while file.exists():  # the only way back, if it is from a run that was killed
        file, k = first.with_name(f"{first.stem}-{k}.toml"), k + 1
    check_place(file)
    return file


def check_place(file: Path) -> None:
    """Raise OSError unless a new file can be written there: before a drive is asked for anything."""
    if file.exists():
        raise OSError(f"{file} is there already, and may hold the state before an earlier run; choose another file")
    place, writable = nearest_place(file)
    if not place.is_dir():
        raise OSError(f"the state before cannot be written to {file}: {place} is a file; choose another place")
    if not writable:
        raise OSError(f"the state before cannot be written to {file}: {place} is not yours to write; choose another")


@contextmanager
def put_back(target: Target, file: Path, program: str) -> Iterator[Transaction]:
    """Have the state of drives in a file while a block moves them, and bring it back at the end unless committed.

    If the block fails, a line on stderr says where the file is.

    Args:
        target: The drives.
        file: The file to leave.
        program: Who speaks on stderr.
    """
    transaction = Transaction(target, file)
    try:
        with transaction:
            yield transaction
    except BaseException as error:
        if file.exists() and str(file) not in str(error):  # no line for a file that could not be written
            way = f"drive-tune restore {file} brings back what was" if transaction.changed else what_is_left(file)
            print(f"{program}: {way}", file=sys.stderr)
        raise


def what_is_left(file: Path) -> str:
    """Return what a run says that has put everything back."""
    return f"the drives have what they had before; if ever not, drive-tune restore {file} brings it back"


class Transaction:
    """A change of drives that leaves a file and is undone unless committed.

    Entering takes the snapshot and writes the file; leaving rolls back every axis that was not committed, whatever
    ended the block.

    Args:
        target: What is changed.
        path: The file to leave.
    """

    def __init__(self, target: Target, path: str | Path) -> None:
        self.path = Path(path)
        self._target = target
        self._committed = np.zeros(target.num_axes, bool)

    def __enter__(self) -> Transaction:
        mask, enabled = motion.OPERATION_ENABLED
        self._ran: Mask = self._target.drives.read(0x6041) & mask == enabled
        self.before = take(self._target)
        self.before.save(self.path)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: object) -> None:
        left = ~self._committed
        if not left.any():
            return
        try:
            with undisturbed():
                if error is not None and getattr(self._target.drives, "safety", None):
                    # What still turns is braked as their own exit would: without voltage it would run on.
                    self._target.drives.safety.stop(str(error) or type(error).__name__)
                try:
                    self.roll_back(left & ~self._untouched())
                except SafetyError:  # after a stall the envelope refuses one call, to tell of it
                    self.roll_back(left & ~self._untouched())
        except (BusError, ObjectAccessError, RuntimeError, TimeoutError) as failure:
            raise BusError(
                f"{failure}; the drives may hold what was tried: drive-tune restore {self.path} brings back what was"
            ) from (error or failure)

    def _untouched(self) -> Mask:
        """Return the axes that somebody else runs and that were let alone, as they are in a run that refuses them."""
        if not self._ran.any():
            return self._ran
        now = take(self._target)
        same = [_settings(one) == _settings(other) for one, other in zip(now.axes, self.before.axes, strict=True)]
        untouched: Mask = self._ran & same
        return untouched

    @property
    def changed(self) -> bool:
        """Whether any axis keeps what it has now."""
        return bool(self._committed.any())

    def commit(self, where: Mask | None = None) -> None:
        """Keep what axes have now, all by default."""
        self._committed |= True if where is None else where

    def roll_back(self, where: Mask | None = None) -> None:
        """Bring axes back to what they were, all by default: the gains at once, the rest once they are disabled."""
        drives = self._target.drives
        axes = np.ones(drives.num_axes, bool) if where is None else where
        for key in GAIN_OBJECTS:
            was = np.array([values.get(key, 0) for values in self.before.axes])
            drives.write(key, was, where=axes)
        _switch_off(drives, axes)
        restore(drives, self.before, axes, whole=False)

    def store(self, where: Mask | None = None) -> bool:
        """Have the drives keep their parameters over a power cycle; the file says so first.

        Returns whether they do: emulated drives in this process have nothing that outlives it.
        """
        if not self._target.bus:
            return False
        self.before = replace(self.before, stored=True)
        self.before.save(self.path)
        store(self._target.drives, where)
        return True


def _switch_off(drives: Any, where: Mask) -> None:
    """Switch the voltage off and wait until no axis is enabled; one in fault is off already."""
    drives.write(0x6040, 0x00, where=where)
    mask, enabled = motion.OPERATION_ENABLED
    for _ in range(SWITCH_OFF):
        if not np.any(where & (drives.read(0x6041) & mask == enabled)):
            return
        drives.advance(motion.STEP)
    raise TimeoutError(f"an axis stays enabled for {SWITCH_OFF * motion.STEP:g} s after its voltage was switched off")


def store(drives: Any, where: Mask | None = None) -> None:
    """Have drives keep their parameters over a power cycle (1010h)."""
    drives.write(STORE, SAVE, where=where)


def _settings(values: Mapping[Key, int]) -> dict[Key, int]:
    return {key: value for key, value in values.items() if key[0] >= DEVICE_OBJECTS}


def _per_axis(drives: Any) -> Any:
    """Return drives whose objects are reached axis by axis, as those of a bus are."""
    return drives if hasattr(drives, "read_axis") else _EmulatedPerAxis(drives)


class _EmulatedPerAxis:
    """Emulated drives as far as `drive_env.master.parameters` needs those of a bus."""

    def __init__(self, drives: Any) -> None:
        self._drives = drives
        self.description: Description = describe(drives.device.name, None)

    def read_axis(self, entry: Entry, axis: int) -> int:
        return int(self._drives.read((entry.index, entry.sub))[axis])

    def write_axis(self, entry: Entry, axis: int, value: int) -> None:
        where = np.zeros(self._drives.num_axes, bool)
        where[axis] = True
        self._drives.write((entry.index, entry.sub), value, where=where)
