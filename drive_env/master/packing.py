"""Integers of axes to the bytes of process data and back, for every fieldbus."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drive_env.cia402 import Key
from drive_env.dictionary.entries import Entry
from mechanics.arrays import Integers

Bytes = NDArray[np.uint8]


class Member(NamedTuple):
    """An object in packed data: its axis of the node, first byte and length."""

    entry: Entry
    axis: int
    start: int
    size: int


def pack_rows(members: Iterable[Member], played: Mapping[Entry, Integers], first_axis: int) -> Bytes:
    """Return the bytes of consecutive members, shape (rows, length).

    Args:
        members: The members.
        played: Integers of each entry, shape (rows, num_axes).
        first_axis: Number of the node's first axis among num_axes.
    """
    parts = []
    for member in members:
        column = np.ascontiguousarray(played[member.entry][:, first_axis + member.axis], "<i8")
        parts.append(column.view(np.uint8).reshape(-1, 8)[:, : member.size])
    return np.hstack(parts)


def unpack_rows(
    values: dict[Key, Integers], data: Bytes, members: Sequence[Member], first_axis: int, num_axes: int
) -> None:
    """Put the integers of members into `values`, each object of shape (rows, num_axes).

    Args:
        values: The result; missing objects are added.
        data: Shape (rows, length).
        members: The members in the data.
        first_axis: Number of the node's first axis.
        num_axes: Axes of all nodes.
    """
    for member in members:
        entry = member.entry
        rows = values.setdefault((entry.index, entry.sub), np.empty((len(data), num_axes), np.int64))
        rows[:, first_axis + member.axis] = integers(data[:, member.start : member.start + member.size], entry.signed)


def integers(data: Bytes, signed: bool) -> Any:
    """Return the integers of little-endian bytes, shape (rows, size), as int64 or narrower."""
    size = data.shape[1]
    if size in (1, 2, 4, 8):
        return np.ascontiguousarray(data).view(_TYPES[size, signed]).ravel()
    wide = np.zeros((data.shape[0], 8), np.uint8)  # 24, 40, 48, 56 bits
    wide[:, :size] = data
    column = wide.view("<i8").ravel()
    return column - ((column >> (8 * size - 1)) << (8 * size)) if signed else column


_TYPES = {(size, signed): np.dtype(f"<{'i' if signed else 'u'}{size}") for size in (1, 2, 4, 8) for signed in (0, 1)}
