"""The parameters of drives before a change: saved to a file, and restored.

A `Transaction` writes the file before anything else, so that the file exists even if the process is killed; `drive-tune
undo FILE` restores the drives from it. Axes that are not committed are rolled back at the end.
"""

from __future__ import annotations

import errno
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.dictionary.access import check_in_range, check_writable
from drive_env.drives.interface import CYCLE, Drives, device_of
from drive_env.fieldbus.description import Description, describe
from drive_env.fieldbus.errors import BusError
from drive_env.held_signals import held_signals
from drive_env.master.identity import Identity, check_same_drive, load_identity, read_identity
from drive_env.master.parameters import (
    SAVE,
    Difference,
    check_at_rest,
    check_no_commands,
    compare,
    read_parameters,
    restorable,
    write_all_or_none,
)
from drive_env.master.single_axes import SingleAxes
from drive_env.safety.envelope import SafetyError
from drive_env.whole_file import FORMAT, check_seal, sealed, write_whole
from mechanics.arrays import Mask
from mechanics.reading.untrusted import read_toml
from tuning.runs.provenance import nearest_place, run_folder
from tuning.toml_tables import toml

if TYPE_CHECKING:
    from drive_env.dictionary.entries import Entry
    from drive_env.drives.interface import BusSide, DescribedAxes
    from tuning.target import Target


SWITCH_OFF = 1000  # cycles until the voltage must be off
STORE = (0x1010, 1)
DEVICE_OBJECTS = 0x2000  # first object of the device; objects below are communication, in use by the master
# Set-points that turn an axis as soon as it is enabled. A program that dies leaves them in the drive, and no parameter
# file has them, since they are commands.
SET_POINTS = (cia402.TARGET_TORQUE, cia402.TARGET_VELOCITY, cia402.TORQUE_OFFSET, cia402.VELOCITY_OFFSET)


class SnapshotError(ValueError):
    """The file is not a snapshot, or does not fit these drives; the message has the remedy."""


@dataclass(frozen=True)
class Snapshot:
    """All parameters of drives at one time.

    Attributes:
        device: Name of the device.
        axes: For each axis, (index, sub-index) -> raw integer.
        bus: Options of `open_drives` that open the drives again; empty for emulated drives.
        stored: Whether the drives stored the change; then undoing it is stored, too.
        identities: Identity objects of each node; empty for emulated drives, and if the file lacks them.
        left_out: For each axis that `bus` does not choose, by its number among all axes of the nodes: the values of
            objects that a master changes all the same, since PDO mapping and watchdog belong to whole nodes.
    """

    device: str
    axes: tuple[Mapping[Key, int], ...]
    bus: Mapping[str, Any] = field(default_factory=dict)
    stored: bool = False
    identities: tuple[Identity, ...] = ()
    left_out: Mapping[int, Mapping[Key, int]] = field(default_factory=dict)

    def save(self, path: str | Path) -> Path:
        """Write the snapshot as TOML and return its path; the file is complete or absent, also after a power cut.

        Raises:
            OSError: If it cannot be written.
        """
        where = Path(path)
        try:
            write_whole(where, sealed(self._toml(where.name)))
        except OSError as error:
            reason = f"the state before cannot be written: {error.strerror}; choose another place"
            raise OSError(error.errno, reason, str(where)) from None
        return where

    def _toml(self, name: str) -> str:
        dictionary = describe(self.device, None).dictionary
        lines = [
            f"# Parameters of {len(self.axes)} axes before a change: drive-tune undo {name} restores them.",
            "# The check sum at the end shows whether this file was changed.",
            "",
            f"format = {FORMAT}",
            f'written = "{datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC"',
            f"device = {toml(self.device)}",
            f"stored = {str(self.stored).lower()}  # whether the drives stored the change",
        ]
        if self.bus:
            lines += ["", "[bus]"]
            for key, value in self.bus.items():
                lines.append(f"{key} = {value if isinstance(value, list) else toml(value)}")
        for identity in self.identities:
            lines += ["", "[[node]]", *identity.to_toml()]
        of_axes = [(f"[[axis]]  # {k}; index:sub-index, both hexadecimal", one) for k, one in enumerate(self.axes)]
        of_axes += [
            (f"[left_out.{k}]  # borrowed of an axis that is not tuned", one) for k, one in self.left_out.items()
        ]
        for title, values in of_axes:
            lines += ["", title]
            for (index, sub), value in values.items():
                lines.append(f'"{index:04X}:{sub:02X}" = {value}  # {dictionary.find((index, sub)).name}')
        return "\n".join(lines) + "\n"


def take(target: Target) -> Snapshot:
    """Read the parameters of a target's drives.

    Call it before the drives record anything: recording maps PDOs on a bus, which are parameters, too.
    """
    return take_of(target.drives, target.bus)


def take_of(drives: Drives, address: Mapping[str, Any]) -> Snapshot:
    """Read the parameters of drives; `address` has the options that open them again, empty for emulated ones."""
    bus = drives.bus
    identities = [] if bus is None else [read_identity(bus, node) for node in range(len(bus.nodes))]
    return Snapshot(
        device_of(drives).name, _read_axes(drives), address, identities=tuple(identities), left_out=_borrowed(drives)
    )


def _read_axes(of: Drives) -> tuple[Mapping[Key, int], ...]:
    drives = _per_axis(of)
    # The dictionary of a module lists the objects of all its axes: each axis keeps its own, under the first axis' keys.
    others = drives.description.of_further_axes()
    return tuple(
        {key: value for key, value in read_parameters(drives, axis).items() if key not in others}
        for axis in _places(of)
    )


def _borrowed(drives: Drives) -> dict[int, dict[Key, int]]:
    """Read the objects that a master changes on axes that were not chosen, by the axis' number."""
    bus = drives.bus
    if bus is None:
        return {}
    known, others = bus.description, bus.description.of_further_axes()

    def is_borrowed(entry: Entry) -> bool:
        key = entry.index, entry.sub
        is_masters = entry.index < DEVICE_OBJECTS or entry.index == cia402.ABORT_CONNECTION_OPTION
        return is_masters and key not in others and known.key(entry, 1) != key

    left_out = [axis for axis in range(bus.num_axes) if axis not in set(drives.axis_numbers)]
    return {axis: read_parameters(bus, axis, is_borrowed) for axis in left_out}


def load_snapshot(path: str | Path, *, unchecked: bool = False) -> Snapshot:
    """Read a snapshot from a file.

    Args:
        path: The file.
        unchecked: Accept also a file that was changed since it was written, or that has no check sum.

    Raises:
        SnapshotError: If the file is not a snapshot; FileChangedError if it was changed since it was written.
        CommandObjectError: If it contains objects that are commands or services.
    """
    where = Path(path)
    try:
        data = read_toml(where)
    except OSError as error:
        raise SnapshotError(f"cannot read {where}: {error.strerror}; give a file that drive-tune left") from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise SnapshotError(f"{where} is not TOML, or incomplete: {error}; give a file that drive-tune left") from None
    tables = data.get("axis")
    if not isinstance(tables, list) or not tables or not isinstance(data.get("device"), str):
        raise SnapshotError(f"{where} is not a file with the state before a change; give one that drive-tune saved")
    try:
        known = describe(data["device"], None, on_ethercat=True)  # the file's drives may be on either bus
    except ValueError as error:
        raise SnapshotError(
            f"{where}: {error}; a device of your own is looked for from the present folder: call drive-tune undo in "
            "the one where the run was started"
        ) from None
    axes = [_checked_axis(where, table, known) for table in tables]
    left_out = data.get("left_out", {})
    if not isinstance(left_out, dict) or not all(name.isdecimal() for name in left_out):
        raise SnapshotError(f"{where}: left_out must be a table of numbered axes; give a file as drive-tune left it")
    others = {int(name): _checked_axis(where, table, known) for name, table in left_out.items()}
    check_seal(where, data, unchecked=unchecked)
    nodes = [load_identity(table) for table in data.get("node", []) if isinstance(table, dict)]
    identities = tuple(identity for identity in nodes if identity is not None)
    bus = _checked_bus(where, data.get("bus", {}))
    return Snapshot(data["device"], tuple(axes), bus, bool(data.get("stored", False)), identities, others)


def _checked_axis(file: Path, table: Any, known: Description) -> dict[Key, int]:
    """Check the table of an axis and convert its keys; SnapshotError or CommandObjectError if it is invalid."""
    if not isinstance(table, dict):
        raise SnapshotError(f"{file}: {table!r} is not an axis; give a file that drive-tune saved before a change")
    values = {}
    for text, value in table.items():
        index, _, sub = text.partition(":")
        try:
            key = int(index, 16), int(sub, 16)
            entry = known.dictionary.find(key)
            check_writable(entry)
            check_in_range(entry, np.asarray(value))
        except (ValueError, ObjectAccessError) as error:
            raise SnapshotError(f"{file}: {text} = {value!r}: {error}") from None
        values[key] = int(value)
    check_no_commands(values, file, known.hints)
    return values


def _checked_bus(file: Path, bus: Any) -> dict[str, Any]:
    """Check the options that open the drives again; SnapshotError for unknown keys or wrong types."""
    if not isinstance(bus, dict):
        raise SnapshotError(f"{file}: bus = {bus!r} must be a table; give a file as drive-tune left it")
    for key, value in bus.items():
        if key not in _BUS:
            raise SnapshotError(f"{file}: [bus] has a key {key!r}, which is not one of {', '.join(_BUS)}; remove it")
        numbers = value if isinstance(value, list) else [value]
        if (isinstance(value, list) != (key in ("nodes", "axes"))) or any(
            type(one) is not _BUS[key] for one in numbers
        ):
            raise SnapshotError(
                f"{file}: [bus] {key} = {value!r} is not of type {_BUS[key].__name__}; restore the file"
            )
    return bus


_BUS = {"interface": str, "channel": str, "nodes": int, "axes": int, "bitrate": int, "pace": str}


def check_same_drives(file: object, snapshot: Snapshot, drives: BusSide, *, other_drive: bool = False) -> None:
    """Raise OtherDriveError unless the nodes of a bus are those from which a snapshot was taken.

    Args:
        file: The snapshot's file, for the message.
        snapshot: The snapshot to be written.
        drives: The opened drives.
        other_drive: Accept other drives.
    """
    # A file without identities, which `load_snapshot` accepts only with `unchecked`, fits any drive.
    for node, written in zip(range(len(drives.nodes)), snapshot.identities, strict=False):
        check_same_drive(file, written, read_identity(drives, node), other_drive=other_drive)


def restore(
    drives: Drives, snapshot: Snapshot, where: Mask | None = None, *, whole: bool = True
) -> list[list[Difference]]:
    """Restore drives from a snapshot, axis by axis, each completely or not at all; return the changes of each.

    The axes must not be enabled. Set-points of speed and torque are 0 afterwards: no file has them, and an axis would
    turn with those of an earlier program once it is enabled.

    Args:
        drives: The drives, emulated or on a bus.
        snapshot: The state to restore.
        where: Axes to restore; all by default.
        whole: Also restore objects of the communication area, and those that were changed on axes not chosen, whose
            changes come last in the result. Not while the drives' PDOs are in use.

    Raises:
        SnapshotError: If the drives are others; NotRestoredError or RollbackError if a drive rejects a value.
    """
    if len(snapshot.axes) != drives.num_axes or snapshot.device != device_of(drives).name:
        raise SnapshotError(
            f"the snapshot is of {len(snapshot.axes)} axes of {snapshot.device}, and here are {drives.num_axes} of "
            f"{device_of(drives).name}; open the drives that it was taken from"
        )
    axes = np.ones(drives.num_axes, bool) if where is None else where
    single = _per_axis(drives)
    changed: list[list[Difference]] = [[] for _ in snapshot.axes]
    wanted = [values if whole else _settings(values) for values in snapshot.axes]
    places = _places(drives)
    for axis in map(int, np.flatnonzero(axes)):
        check_at_rest(single, wanted[axis], places[axis])  # checked for all axes before the first is written
    for key in _set_points(describe(snapshot.device, None)):
        drives.write(key, 0, where=axes)
    for axis in map(int, np.flatnonzero(axes)):
        changed[axis] = write_all_or_none(single, wanted[axis], places[axis])
    if whole:
        changed += [write_all_or_none(single, values, place) for place, values in snapshot.left_out.items()]
    return changed


def write_parameters(drives: Drives, wanted: Mapping[Key, int]) -> list[list[Difference]]:
    """Write parameters to each axis, completely or not at all; return the changes of each. No axis may be enabled.

    Raises:
        NotRestoredError, RollbackError: If a drive rejects a value.
    """
    single = _per_axis(drives)
    return [write_all_or_none(single, wanted, place) for place in _places(drives)]


def _set_points(known: Description) -> list[Key]:
    return [(index, 0) for index in SET_POINTS if known.has(index) and known.dictionary.find(index).access != "wo"]


def differences(drives: BusSide, snapshot: Snapshot) -> list[tuple[int, Difference]]:
    """Read drives of a bus; return the parameters that differ from a snapshot, as (number of the axis, difference).

    Includes set-points of speed and torque that would turn an axis once it is enabled.

    Args:
        drives: All axes of the nodes.
        snapshot: The wanted values.
    """
    known = drives.description
    parts = snapshot.bus.get("axes", range(known.num_axes))
    numbers = [node * known.num_axes + part for node in range(len(drives.nodes)) for part in parts]
    still = dict.fromkeys(_set_points(known), 0)
    wanted = {axis: restorable(one, known.hints) | still for axis, one in zip(numbers, snapshot.axes, strict=True)}
    wanted |= {axis: restorable(one, known.hints) for axis, one in snapshot.left_out.items()}
    return [(axis, change) for axis, values in wanted.items() for change in compare(drives, values, axis)]


@contextmanager
def undisturbed() -> Iterator[None]:
    """Delay Ctrl-C and other signals that end a command until the block's end: no drive is left half restored."""
    with held_signals() as noted:
        yield
    if noted:
        raise KeyboardInterrupt


def file_before(kind: str, out: Path | None = None) -> Path:
    """Choose a new file for the state before: beside the results in `out`, or in runs/; existing files are kept.

    Args:
        kind: What moves the drives, for the name.
        out: Folder of the results, or their file without suffix; None selects runs/.

    Raises:
        OSError: If the file cannot be written there.
    """
    first = Path(f"{run_folder(kind)}-before.toml") if out is None else out.with_name(f"{out.name}-before.toml")
    file, k = first, 2
    while file.exists():  # an existing file may be the only way back from a run that was killed
        file, k = first.with_name(f"{first.stem}-{k}.toml"), k + 1
    check_place(file)
    return file


def check_place(file: Path) -> None:
    """Raise OSError unless a new file can be written there; called before any access to the drives."""
    if file.exists():
        raise OSError(f"{file} exists already, and may be the state before an earlier run; choose another file")
    place, writable = nearest_place(file)
    if not place.is_dir():
        raise OSError(f"the state before cannot be written to {file}: {place} is a file; choose another place")
    if not writable:
        raise OSError(f"the state before cannot be written to {file}: {place} is not writable; choose another")


def what_is_left(file: Path) -> str:
    """Return the message of a run that has restored everything."""
    return f"the drives have their state from before; if not, drive-tune undo {file} restores it"


class Transaction:
    """A change of drives that saves the state before to a file, and is undone unless committed.

    Entering takes the snapshot and writes the file; leaving rolls back every axis that was not committed, also after an
    exception.

    Args:
        target: The target to change.
        path: The file to write.
    """

    def __init__(self, target: Target, path: str | Path) -> None:
        self.path = Path(path)
        self._target = target
        self._committed = np.zeros(target.num_axes, bool)
        self._stored = np.zeros(target.num_axes, bool)

    def __enter__(self) -> Transaction:
        self._ran: Mask = cia402.matches(self._target.drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED)
        self.before = take(self._target)
        self.before.save(self.path)
        if load_snapshot(self.path) != self.before:  # the file is the only way back
            raise OSError(errno.EIO, "the state before does not read back as it was written", str(self.path))
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: object) -> None:
        left = ~self._committed
        if not left.any():
            return
        try:
            with undisturbed():
                if error is not None and self._target.drives.safety:
                    # Turning axes are braked first: without voltage they would coast.
                    self._target.drives.safety.stop(str(error) or type(error).__name__)
                try:
                    self.roll_back(left & ~self._untouched())
                except SafetyError:  # after a stall the envelope raises once, to report it
                    self.roll_back(left & ~self._untouched())
                if np.any(left & self._stored):
                    store(self._target.drives, left & self._stored)
        except (BusError, ObjectAccessError, RuntimeError, TimeoutError) as failure:
            raise BusError(
                f"{failure}; the drives may have the gains that were tried: drive-tune undo {self.path} restores the "
                "state before"
            ) from (error or failure)
        if isinstance(error, OSError) and error.filename and not self.changed:  # disk full, or folder deleted
            raise OSError(error.errno, f"{error.strerror}; {what_is_left(self.path)}", error.filename) from error

    def _untouched(self) -> Mask:
        """Return enabled axes of another program whose settings are unchanged, as after a run that refuses them."""
        if not self._ran.any():
            return self._ran
        now = _read_axes(self._target.drives)
        same = [_settings(one) == _settings(other) for one, other in zip(now, self.before.axes, strict=True)]
        untouched: Mask = self._ran & same
        return untouched

    @property
    def changed(self) -> bool:
        """Whether any axis keeps its present settings."""
        return bool(self._committed.any())

    def commit(self, where: Mask | None = None) -> None:
        """Keep the present settings of axes, all by default."""
        self._committed |= True if where is None else where

    def roll_back(self, where: Mask | None = None, to: Snapshot | None = None) -> None:
        """Restore the settings of axes, all by default: the gains immediately, the rest after switching them off.

        Args:
            where: The axes.
            to: A later state; None restores the state before.
        """
        drives, wanted = self._target.drives, self.before if to is None else to
        axes = np.ones(drives.num_axes, bool) if where is None else where
        for key in device_of(drives).gains.keys:
            was = np.array([values.get(key, 0) for values in wanted.axes])
            drives.write(key, was, where=axes)
        switch_off(drives, axes)
        restore(drives, wanted, axes, whole=False)

    def store(self, where: Mask | None = None) -> bool:
        """Have the drives store their parameters over a power cycle; the file records it first.

        False, without storing, if they cannot: see `can_store`.
        """
        if not can_store(self._target):
            return False
        self.before = replace(self.before, stored=True)
        self.before.save(self.path)
        self._stored |= True if where is None else where
        store(self._target.drives, where)
        return True


def switch_off(drives: Drives, where: Mask) -> None:
    """Switch the voltage off and wait until no axis is live, a fault reaction among it; TimeoutError if one is."""
    drives.write(cia402.CONTROLWORD, 0x00, where=where)
    for _ in range(SWITCH_OFF):
        if not np.any(where & [cia402.is_live(int(word)) for word in drives.read(cia402.STATUSWORD)]):
            return
        drives.advance(CYCLE)
    raise TimeoutError(f"an axis stays enabled for {SWITCH_OFF * CYCLE:g} s after its voltage was switched off")


def can_store(target: Target) -> bool:
    """Return whether drives can store their parameters over a power cycle.

    False for emulated drives in this process, which end with it, and for drives without 1010h (TMCM-3313).
    """
    bus = target.drives.bus
    return bool(target.bus) and (bus is None or bus.description.has(STORE))


def store(drives: Drives, where: Mask | None = None) -> None:
    """Have drives store their parameters over a power cycle (1010h)."""
    drives.write(STORE, SAVE, where=where)


def _settings(values: Mapping[Key, int]) -> dict[Key, int]:
    return {key: value for key, value in values.items() if key[0] >= DEVICE_OBJECTS}


def _per_axis(drives: Drives) -> DescribedAxes:
    """Return drives whose objects are accessed axis by axis, like those of a bus."""
    return drives.bus or SingleAxes(drives, describe(device_of(drives).name, None))


def _places(drives: Drives) -> Sequence[int]:
    """Return the numbers of the axes for access through `_per_axis`: on a bus those among all axes of the nodes."""
    return drives.axis_numbers if drives.bus is not None else range(drives.num_axes)
