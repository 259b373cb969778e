"""The gains of a device: which objects they are, in which loop and range; any number of them, in the device's order."""

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
    """A gain: its name in code, its title for people, its object, the greatest integer, its loop and its part in it.

    lowest: The least integer that makes sense: of a loop's gain 1, since 0 opens it.
    steps: How many different values the drive makes of all its integers; 0 for as many as there are.
    is_time: Whether the integers of an I count the integration time, so that more of them act less.
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


# Kinds of loops that a stepper's drive may close: the encoder commutates; or a PID moves the field besides the ramp, or
# alone.
LOAD_ANGLE, PID_ON_RAMP, PID_ALONE = "load angle", "PID on the ramp", "PID alone"
KINDS = (LOAD_ANGLE, PID_ON_RAMP, PID_ALONE)


class ClosedLoop(NamedTuple):
    """A loop that an open-loop stepper's drive may close.

    kind: One of `KINDS`. mode: Its mode (`Role.LOOP_MODE`). gains: Names of what acts in it alone, P first, and of the
    gains that these stand for: one object may be P of one loop and D of another. first: Values where a search begins,
    by the first of these names; what is left out begins as commissioned.
    """

    kind: str
    mode: int
    gains: Mapping[str, str]
    first: Mapping[str, int]

    @property
    def is_pid(self) -> bool:
        """Whether the encoder regulates the position and does not commutate."""
        return self.kind != LOAD_ANGLE


LOAD_DETECTION = ("load detection", "CoolStep")  # loops of settings by which a stepper's drive acts on its load reading
FEED_FORWARD = ("feed-forward", "speed")  # loop and part of the share of the demanded speed that a position loop adds
# Steps of a setting, of which 0 is a value as others are, that a search takes for a factor of e.
PER_UNIT = {"load detection": 12.0, "CoolStep": 2.5, FEED_FORWARD[0]: 300.0}
RUN, STANDBY = ("current", "amplitude"), ("current", "standby amplitude")  # of a stepper's phases: loop and part


@dataclass(frozen=True)
class GainSet:
    """The gains of a device, in its order; raw integers have shape (..., count).

    cascade: Structure of the loops that they are gains of, one of those of `drive_env/devices/gains.py`, from which
    their rule comes; "" for loops that nothing is known of.
    closed_loops: What a stepper's drive may close.
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
        """How many there are."""
        return len(self.rows)

    def column(self, loop: str, part: str) -> int | None:
        """Return which gain is the part ("P", "I") of a loop ("current", "velocity", "position"); None for none."""
        return next((k for k, row in enumerate(self.rows) if (row.loop, row.part) == (loop, part)), None)

    def columns_of(self, *loops: str) -> list[int]:
        """Return which gains belong to loops."""
        return [k for k, row in enumerate(self.rows) if row.loop in loops]

    @property
    def outer(self) -> tuple[str, ...]:
        """Names of those that machines differ in: of the velocity and the position loop; in open loop the currents."""
        if self.is_open_loop:
            return tuple(row.name for row in self.rows if (row.loop, row.part) in (RUN, STANDBY))
        return tuple(self.names[k] for k in self.columns_of("velocity", "position"))

    @property
    def is_open_loop(self) -> bool:
        """Whether the motor follows the current's amplitude and no loop is closed around it: a stepper's."""
        return self.column(*RUN) is not None and not self.columns_of("velocity", "position")

    @property
    def searched(self) -> tuple[str, ...]:
        """Names by which gains can be asked for: their own, and those that they have in loops that may be closed."""
        return tuple(dict.fromkeys([*self.names, *(name for loop in self.closed_loops for name in loop.gains)]))

    def loop_of_kind(self, kind: str) -> ClosedLoop | None:
        """Return the loop of a kind; None for none."""
        return next((loop for loop in self.closed_loops if loop.kind == kind), None)

    def loop_of(self, names: Sequence[str]) -> ClosedLoop | None:
        """Return the loop in which gains of these names act alone; None where they act in open loop.

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
        """Return which gains act in a loop that a drive may close."""
        return [self.names.index(name) for name in loop.gains.values()]

    @property
    def powers(self) -> Floats:
        """1 where a gain acts in proportion to its integer, -1 where by its inverse, shape (count,)."""
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
        """Return which gains have names.

        Raises:
            ValueError: For a name that none has, naming those there are, and unless they are different ones.
        """
        own = {name: name for name in self.names} | {k: v for loop in self.closed_loops for k, v in loop.gains.items()}
        for name in names:
            if name not in own:
                raise ValueError(f"no gain is named {name!r}; there are {', '.join(self.searched)}")
        if not names or len({own[name] for name in names}) != len(names):
            raise ValueError(f"give different ones of gain: {', '.join(own)}, not {', '.join(names) or 'none'}")
        return np.array([self.names.index(own[name]) for name in names])

    def clipped(self, raw: ArrayLike) -> Integers:
        """Return gains as integers within the device's ranges; those of a loop are 1 at least: 0 opens it."""
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
        """Return gains of shape (n, count) with those of loops over a whole number, shape (n,) or one; 1 at least."""
        softer = raw.copy()
        for column in self.columns_of(*loops):
            row, now = self.rows[column], raw[:, column]
            softer[:, column] = np.minimum(now * divisor, row.highest) if row.is_time else np.maximum(now // divisor, 1)
        return softer

    def changed(self, raw: Integers, by: ArrayLike, columns: Sequence[int] | Integers, highest: Integers) -> Integers:
        """Return gains of shape (..., count) with some changed, within their ranges; see `change`.

        Args:
            raw: What is changed.
            by: How much, of shape (..., len(columns)): the logarithm of a factor by which a gain acts more; of settings
                of which 0 is a value as others are, in units of `PER_UNIT`.
            columns: Which gains.
            highest: Of all gains.
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
        """Return how far some gains are from others, (..., len(columns)), as `changed` takes it."""
        unit = self._per_unit(columns)
        now, before = raw[..., columns], since[..., columns]
        if not unit.any():
            return np.asarray(self.powers[columns] * (np.log(now) - np.log(before)))
        ratio = np.log(np.where(unit > 0.0, 1, now)) - np.log(np.where(unit > 0.0, 1, before))
        return np.asarray(np.where(unit > 0.0, (now - before) / np.where(unit > 0.0, unit, 1.0), ratio))

    def _per_unit(self, columns: Sequence[int] | Integers) -> Floats:
        return np.array([PER_UNIT.get(self.rows[k].loop, 0.0) for k in columns])

    def scaled(self, raw: Integers, factor: ArrayLike, columns: Sequence[int]) -> Integers:
        """Return gains of shape (..., count), some of which act by a factor more, within their ranges; 1 at least.

        Args:
            raw: What is changed.
            factor: One, or an array that fits (..., len(columns)).
            columns: Which gains.
        """
        shape = np.broadcast_shapes((*raw.shape[:-1], len(columns)), np.shape(factor))
        result = np.broadcast_to(raw, (*shape[:-1], self.count)).copy()
        wanted = np.rint(raw[..., columns] * np.asarray(factor, float) ** self.powers[columns])
        result[..., columns] = np.clip(wanted, 1, self.highest[columns])
        return result

    def strength(self, raw: Integers, columns: Sequence[int]) -> Floats:
        """Return by how much some gains act, up to a constant of each, (..., len(columns))."""
        return np.asarray(raw[..., columns].astype(float) ** self.powers[columns])

    def without_feed_forward(self, raw: Integers) -> Integers:
        """Return gains of shape (..., count) whose feed-forward, if there is one, is 0."""
        columns = self.columns_of(FEED_FORWARD[0])
        result = raw.copy()
        result[..., columns] = 0
        return result

    def opens(self, raw: Sequence[int] | Integers, *loops: str) -> bool:
        """Return whether gains of shape (count,) leave one of the loops open: its P is 0."""
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
