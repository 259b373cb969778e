"""Process data of several nodes: objects of all axes to PDOs, and rows of integers to frames and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drive_env.dictionary.entries import Entry
from drive_env.master.can.pdo import INTO_DRIVE, OUT_OF_DRIVE, Direction, PdoConfiguration, RemotePdo, plan, too_many
from drive_env.master.description import Description, Key
from drive_env.master.sampling import Bytes, Samples

Integers = NDArray[np.int64]
Groups = list[list[Entry]]


class ProcessData:
    """What is mapped at present, and the way between its integers and its frames.

    Args:
        description: What device the nodes are.
        configurations: The PDOs of each node.

    Attributes:
        mapping: Its number: it grows with every change.
    """

    def __init__(self, description: Description, configurations: Sequence[PdoConfiguration]) -> None:
        self._description = description
        self._configurations = configurations
        self._num_axes = len(configurations) * description.num_axes
        self._mapped: dict[str, tuple[tuple[Entry, ...], list[list[RemotePdo]]]] = {}
        self._plans: dict[tuple[str, tuple[Entry, ...]], Groups | None] = {}
        self.mapping = 0

    def forget(self) -> None:
        """Forget what is mapped: a node was reset."""
        self.mapping += 1
        self._mapped.clear()

    def choose(self, wanted: Sequence[Entry], welcome: Sequence[Entry]) -> tuple[Entry, ...]:
        """Return what to sample: what is wanted, and of what is welcome besides, in its order, as much as fits.

        Raises:
            ObjectAccessError: 06040042h if not even what is wanted fits.
        """
        besides = [entry for entry in welcome if entry not in wanted]
        while True:
            entries = (*wanted, *besides)
            if self._plan(OUT_OF_DRIVE, entries) is not None:
                return entries
            if not besides:
                raise too_many(self._description, wanted, OUT_OF_DRIVE)
            besides.pop()

    def is_mapped(self, direction: Direction, entries: Sequence[Entry]) -> bool:
        """Return whether the PDOs are such already: into the drive just these, out of it these and maybe others."""
        mapped, _ = self._mapped.get(direction.name, ((), []))
        return tuple(entries) == mapped if direction is INTO_DRIVE else set(entries) <= set(mapped)

    def map(self, direction: Direction, entries: tuple[Entry, ...]) -> None:
        """Map entries of every axis to PDOs that go with SYNC.

        Raises:
            ObjectAccessError: If they do not fit or a drive refuses them.
        """
        groups = self._plan(direction, entries)
        if groups is None:
            raise too_many(self._description, entries, direction)
        self.mapping += 1
        self._mapped.pop(direction.name, None)
        pdos = [configuration.configure(groups, direction) for configuration in self._configurations]
        self._mapped[direction.name] = (entries, pdos)

    def sampled(self) -> list[RemotePdo]:
        """Return the TPDOs that are mapped, node by node."""
        return [pdo for of_node in self._mapped.get(OUT_OF_DRIVE.name, ((), []))[1] for pdo in of_node]

    def sampled_entries(self) -> tuple[Entry, ...]:
        """Return what the mapped TPDOs carry."""
        return self._mapped.get(OUT_OF_DRIVE.name, ((), []))[0]

    def encode(self, played: Mapping[Entry, Integers]) -> list[tuple[int, Bytes]]:
        """Return identifier and rows of bytes of each mapped RPDO, of integers of shape (cycles, num_axes)."""
        rows = []
        for k, pdos in enumerate(self._mapped[INTO_DRIVE.name][1]):
            for pdo in pdos:
                parts = []
                for member in pdo.members:
                    axis = k * self._description.num_axes + member.axis
                    column = np.ascontiguousarray(played[member.entry][:, axis], "<i8")
                    parts.append(column.view(np.uint8).reshape(-1, 8)[:, : member.size])
                rows.append((pdo.can_id, np.hstack(parts)))
        return rows

    def decode(self, samples: Samples, first: int, last: int) -> dict[Key, Integers]:
        """Return the integers of rows `first` to `last` (excluded), each object of shape (rows, num_axes)."""
        values: dict[Key, Integers] = {}
        count = last - first
        number = 0
        for k, pdos in enumerate(self._mapped[OUT_OF_DRIVE.name][1]):
            for pdo in pdos:
                data = samples.bytes_of(number, first, last)
                number += 1
                for member in pdo.members:
                    entry = member.entry
                    rows = values.setdefault((entry.index, entry.sub), np.empty((count, self._num_axes), np.int64))
                    column = integers(data[:, member.start : member.start + member.size], entry.signed)
                    rows[:, k * self._description.num_axes + member.axis] = column
        return values

    def _plan(self, direction: Direction, entries: tuple[Entry, ...]) -> Groups | None:
        key = (direction.name, entries)
        if key not in self._plans:
            self._plans[key] = plan(self._description, entries, direction)
        return self._plans[key]


def integers(data: Bytes, signed: bool) -> Any:
    """Return the integers of little-endian bytes, shape (rows, size), as int64 or narrower."""
    size = data.shape[1]
    if size in (1, 2, 4, 8):
        return np.ascontiguousarray(data).view(_TYPES[size, signed])[:, 0]
    wide = np.zeros((data.shape[0], 8), np.uint8)  # 24, 40, 48, 56 bits
    wide[:, :size] = data
    column = wide.view("<i8")[:, 0]
    return column - ((column >> (8 * size - 1)) << (8 * size)) if signed else column


_TYPES = {(size, signed): np.dtype(f"<{'i' if signed else 'u'}{size}") for size in (1, 2, 4, 8) for signed in (0, 1)}
