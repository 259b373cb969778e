"""The gains of a device: their objects, loops and ranges, in any number, in the device's order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from drive_env.cia402 import Key
from mechanics.arrays import Floats, Integers, Mask
from mechanics.reading.untrusted import read_toml

if TYPE_CHECKING:
    from drive_env.dictionary.axis_objects import AxisObjects


class Gain(NamedTuple):
    """A gain: its name in code, title for people, object, greatest integer, loop, and part of the loop.

    lowest: The least sensible integer: 1 for a loop's gain, since 0 opens the loop.
    steps: Number of different values that the drive makes of all integers; 0 if every integer is different.
    is_time: Whether the integers of an I are an integration time, so that larger ones act less.
    """

    name: str
    title: str
    key: Key
    highest: int
    loop: str
    part: str
    lowest: int = 1
    steps: int = 0
    is_time: bool = False


# Kinds of loops that a stepper's drive may close: commutation by the encoder, or a PID that moves the field in addition
# to the ramp, or alone.
LOAD_ANGLE, PID_ON_RAMP, PID_ALONE = "load angle", "PID on the ramp", "PID alone"
KINDS = (LOAD_ANGLE, PID_ON_RAMP, PID_ALONE)


class ClosedLoop(NamedTuple):
    """A loop that an open-loop stepper's drive may close.

    kind: One of `KINDS`.
    mode: Its mode (`Role.LOOP_MODE`).
    gains: Names of the gains that act only in it, P first, with the gains whose objects they are: one object may be P
        of one loop and D of another.
    first: Start values of a search, by the first of these names; others start as commissioned.
    """

    kind: str
    mode: int
    gains: Mapping[str, str]
    first: Mapping[str, int]

    @property
    def is_pid(self) -> bool:
        """Whether the encoder regulates the position and does not commutate."""
        return self.kind != LOAD_ANGLE


LOAD_DETECTION = ("load detection", "CoolStep")  # loops by which a stepper's drive reacts to its load reading
FEED_FORWARD = ("feed-forward", "speed")  # loop and part: the share of the demanded speed that a position loop adds
# Steps of a setting for which 0 is an ordinary value; a search counts one as a factor of e.
PER_UNIT = {"load detection": 12.0, "CoolStep": 2.5, FEED_FORWARD[0]: 300.0}
RUN, STANDBY = ("current", "amplitude"), ("current", "standby amplitude")  # of a stepper's phases: loop and part


@dataclass(frozen=True)
class GainSet:
    """The gains of a device, in its order; raw integers have shape (..., count).

    cascade: Structure of the loops, by its name in `drive_env/devices/gains.py`; "" for one without gains by rule.
    closed_loops: The loops that a stepper's drive may close.
    """

    rows: tuple[Gain, ...]
    cascade: str = ""
    closed_loops: tuple[ClosedLoop, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names in code."""
        return tuple(row.name for row in self.rows)

    @property
    def titles(self) -> tuple[str, ...]:
        """Titles for people."""
        return tuple(row.title for row in self.rows)

    @property
    def keys(self) -> tuple[Key, ...]:
        """Objects."""
        return tuple(row.key for row in self.rows)

    @property
    def count(self) -> int:
        """Number of gains."""
        return len(self.rows)

    def column(self, loop: str, part: str) -> int | None:
        """Return the column of a part ("P", "I") of a loop ("current", "velocity", "position"); None if it has none."""
        return next((k for k, row in enumerate(self.rows) if (row.loop, row.part) == (loop, part)), None)

    def columns_of(self, *loops: str) -> list[int]:
        """Return the columns of the gains of loops."""
        return [k for k, row in enumerate(self.rows) if row.loop in loops]

    @property
    def outer(self) -> tuple[str, ...]:
        """Names of the gains that depend on the machine: of velocity and position loop; in open loop the currents."""
        if self.is_open_loop:
            return tuple(row.name for row in self.rows if (row.loop, row.part) in (RUN, STANDBY))
        return tuple(self.names[k] for k in self.columns_of("velocity", "position"))

    @property
    def is_open_loop(self) -> bool:
        """Whether no loop is closed and the motor follows the current's amplitude, as on a stepper."""
        return self.column(*RUN) is not None and not self.columns_of("velocity", "position")

    @property
    def searched(self) -> tuple[str, ...]:
        """Names by which gains can be selected: their own, and those in loops that may be closed."""
        return tuple(dict.fromkeys([*self.names, *(name for loop in self.closed_loops for name in loop.gains)]))

    def loop_of_kind(self, kind: str) -> ClosedLoop | None:
        """Return the loop of a kind, or None."""
        return next((loop for loop in self.closed_loops if loop.kind == kind), None)

    def loop_of(self, names: Sequence[str]) -> ClosedLoop | None:
        """Return the loop in which gains of these names act alone; None if they act in open loop.

        Raises:
            ValueError: For names of several loops.
        """
        loops = [loop for loop in self.closed_loops if not loop.gains.keys().isdisjoint(names)]
        if len(loops) > 1:
            raise ValueError(
                f"{', '.join(names)} are gains of different loops ({', '.join(loop.kind for loop in loops)}), of which "
                "a drive closes one; name gains of one of them"
            )
        return loops[0] if loops else None

    def columns_of_loop(self, loop: ClosedLoop) -> list[int]:
        """Return the columns of the gains that act in a loop that a drive may close."""
        return [self.names.index(name) for name in loop.gains.values()]

    @property
    def powers(self) -> Floats:
        """1 if a gain acts in proportion to its integer, -1 if in inverse proportion, shape (count,)."""
        return np.array([-1.0 if row.is_time else 1.0 for row in self.rows])

    @property
    def lowest(self) -> Integers:
        """The least integers, shape (count,)."""
        return np.array([row.lowest for row in self.rows], np.int64)

    @property
    def highest(self) -> Integers:
        """The greatest integers, shape (count,)."""
        return np.array([row.highest for row in self.rows], np.int64)

    def columns(self, names: Sequence[str]) -> Integers:
        """Return the columns of gains by name.

        Raises:
            ValueError: For an unknown name, listing the known ones, or for a name given twice.
        """
        own = {name: name for name in self.names} | {k: v for loop in self.closed_loops for k, v in loop.gains.items()}
        for name in names:
            if name not in own:
                raise ValueError(f"no gain is named {name!r}; there are {', '.join(self.searched)}")
        if not names or len({own[name] for name in names}) != len(names):
            raise ValueError(f"give different ones of gain: {', '.join(own)}, not {', '.join(names) or 'none'}")
        return np.array([self.names.index(own[name]) for name in names])

    def clipped(self, raw: ArrayLike) -> Integers:
        """Return gains as integers within the device's ranges; a loop's gains are at least 1, since 0 opens it."""
        return np.asarray(np.clip(np.rint(np.asarray(raw, float)), self.lowest, self.highest), np.int64)

    def with_velocity_p(self, raw: Integers, factor: ArrayLike) -> Integers:
        """Return gains of shape (n, count) with velocity P times a factor, within its range.

        Raises:
            ValueError: If the device has no such gain.
        """
        column = self.column("velocity", "P")
        if column is None:
            raise ValueError(
                "this drive has no velocity P gain, with which trials measure the distance from oscillation"
            )
        changed = raw.copy()
        changed[:, column] = np.clip(np.rint(raw[:, column] * np.asarray(factor, float)), 1, self.rows[column].highest)
        return changed

    def softened(self, raw: Integers, divisor: Integers | int, *loops: str) -> Integers:
        """Return gains of shape (n, count), those of loops divided by a whole number, shape (n,) or one; at least 1."""
        softer = raw.copy()
        for column in self.columns_of(*loops):
            row, now = self.rows[column], raw[:, column]
            softer[:, column] = np.minimum(now * divisor, row.highest) if row.is_time else np.maximum(now // divisor, 1)
        return softer

    def changed(self, raw: Integers, by: ArrayLike, columns: Sequence[int] | Integers, highest: Integers) -> Integers:
        """Return gains of shape (..., count) with some changed, within their ranges; see `change`.

        Args:
            raw: The gains.
            by: The change, shape (..., len(columns)): the logarithm of the factor by which a gain acts more; for a
                setting that may be 0 the number of its steps, over those of `PER_UNIT`.
            columns: The gains to change.
            highest: Greatest integers of all gains.
        """
        unit, result = self._per_unit(columns), raw.copy()
        by = np.asarray(by, float)
        some = raw[..., columns]
        factor = np.exp(np.where(unit > 0.0, 0.0, by * self.powers[columns]))
        wanted = np.where(unit > 0.0, np.rint(some + by * unit), np.rint(some * factor))
        lowest = np.where(unit > 0.0, self.lowest[columns], 1)
        result[..., columns] = np.clip(wanted, lowest, np.asarray(highest)[columns])
        return result

    def change(self, raw: Integers, since: Integers, columns: Sequence[int] | Integers) -> Floats:
        """Return the change of some gains since others, (..., len(columns)), in the units of `changed`."""
        unit = self._per_unit(columns)
        now, before = raw[..., columns], since[..., columns]
        if not unit.any():
            return np.asarray(self.powers[columns] * (np.log(now) - np.log(before)))
        ratio = np.log(np.where(unit > 0.0, 1, now)) - np.log(np.where(unit > 0.0, 1, before))
        return np.asarray(np.where(unit > 0.0, (now - before) / np.where(unit > 0.0, unit, 1.0), ratio))

    def _per_unit(self, columns: Sequence[int] | Integers) -> Floats:
        return np.array([PER_UNIT.get(self.rows[k].loop, 0.0) for k in columns])

    def scaled(self, raw: Integers, factor: ArrayLike, columns: Sequence[int]) -> Integers:
        """Return gains of shape (..., count), some of them with a factor more effect, within their ranges; at least 1.

        Args:
            raw: The gains.
            factor: One, or an array that fits (..., len(columns)).
            columns: The gains to change.
        """
        shape = np.broadcast_shapes((*raw.shape[:-1], len(columns)), np.shape(factor))
        result = np.broadcast_to(raw, (*shape[:-1], self.count)).copy()
        wanted = np.rint(raw[..., columns] * np.asarray(factor, float) ** self.powers[columns])
        result[..., columns] = np.clip(wanted, 1, self.highest[columns])
        return result

    def strength(self, raw: Integers, columns: Sequence[int]) -> Floats:
        """Return the effect of some gains, up to a constant factor of each, (..., len(columns))."""
        return np.asarray(raw[..., columns].astype(float) ** self.powers[columns])

    def without_feed_forward(self, raw: Integers) -> Integers:
        """Return gains of shape (..., count) with 0 as feed-forward, if there is one."""
        columns = self.columns_of(FEED_FORWARD[0])
        result = raw.copy()
        result[..., columns] = 0
        return result

    def opens(self, raw: Sequence[int] | Integers, *loops: str) -> bool:
        """Return whether gains of shape (count,) open one of the loops: its P is 0."""
        return any(raw[k] == 0 for k in self.columns_of(*loops) if self.rows[k].part == "P")

    def read(self, drives: AxisObjects) -> Integers:
        """Return the gains that drives have, shape (num_axes, len(set))."""
        return np.stack([drives.read(key) for key in self.keys], axis=-1)

    def write(self, drives: AxisObjects, gains: Integers, where: Mask | None = None) -> None:
        """Write gains of shape (num_axes, len(set))."""
        for key, column in zip(self.keys, gains.T, strict=True):
            drives.write(key, column, where=where)


def load_gain_set(path: Path) -> GainSet:
    """Return the gain set of a device's `gains.toml`."""
    data: dict[str, Any] = read_toml(path)
    rows = []
    for row in data["gain"]:
        index, sub = row["object"].split(":")
        rows.append(
            Gain(
                row["name"],
                row["title"],
                (int(index, 16), int(sub)),
                row["highest"],
                row["loop"],
                row["part"],
                row.get("lowest", 1),
                row.get("steps", 0),
                row.get("is_time", False),
            )
        )
    loops = tuple(_closed_loop(table, [row.name for row in rows]) for table in data.get("closed_loop", ()))
    return GainSet(tuple(rows), data.get("cascade", ""), loops)


def _closed_loop(table: Mapping[str, Any], known: Sequence[str]) -> ClosedLoop:
    loop = ClosedLoop(table["kind"], table["mode"], table["gains"], table.get("first", {}))
    if loop.kind not in KINDS:
        raise ValueError(f"closed_loop: kind = {loop.kind!r} is unknown; there are {', '.join(KINDS)}")
    for what, given, there in (("gains", loop.gains.values(), known), ("first", loop.first, tuple(loop.gains))):
        if wrong := [name for name in given if name not in there]:
            raise ValueError(f"closed_loop: {what}: {', '.join(wrong)}: no such gain; there are {', '.join(there)}")
    return loop
