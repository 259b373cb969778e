"""The result of `record`, from an emulator or a bus."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from drive_env.dictionary.entries import Entry, ObjectDictionary, ObjectName
from drive_env.dictionary.quantities import SHOWN, Scale, find_unit, follows_scale, in_unit
from drive_env.whole_file import write_table
from mechanics.arrays import Floats, Integers

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Scales = Callable[[], Sequence[Scale]]


class Trace:
    """A recorded move: sample times `t` [s], shape (n,), and each object's integers, shape (n, num_axes).

    `trace["Velocity actual value"]` are integers on the bus, `trace["Velocity actual value", "rad/s"]` floats in a
    unit. Printing it lists its contents.

    Args:
        t: Sample times [s].
        values: Integers by index and sub-index.
        dictionary: Names and units of the objects.
        scale: Returns the scale of each axis' units, as far as the drive reports it; called when a unit needs it. None:
            the scale is unknown.
    """

    def __init__(
        self,
        t: Floats,
        values: dict[tuple[int, int], Integers],
        dictionary: ObjectDictionary,
        scale: Scales | None = None,
    ) -> None:
        self.t = t
        self._values = values
        self._dictionary = dictionary
        self._scale = scale

    @overload
    def __getitem__(self, name: tuple[ObjectName, str]) -> Floats: ...
    @overload
    def __getitem__(self, name: ObjectName) -> Integers: ...
    def __getitem__(self, name: ObjectName | tuple[ObjectName, str]) -> Integers | Floats:
        if isinstance(name, tuple) and isinstance(name[1], str):
            entry = self._dictionary.find(name[0])
            return in_unit(self[name[0]], entry, name[1], self._scales(entry))
        entry = self._dictionary.find(name)
        if (entry.index, entry.sub) not in self._values:
            recorded = ", ".join(self._dictionary.find(key).label for key in self._values)
            raise KeyError(f"{entry.label} was not recorded; there are {recorded}")
        return self._values[entry.index, entry.sub]

    def of_axes(self, axes: Sequence[int]) -> Trace:
        """Return the trace of some axes, in their order."""
        values = {key: rows[:, axes] for key, rows in self._values.items()}
        scale = self._scale
        scales = None if scale is None else lambda: _of(scale(), axes)
        return Trace(self.t, values, self._dictionary, scales)

    @classmethod
    def joined(cls, traces: Sequence[Trace], period: float) -> Trace:
        """Join traces, at least one, of the same objects at the same period [s], recorded one after the other."""
        first = traces[0]
        values = {key: np.concatenate([trace._values[key] for trace in traces]) for key in first._values}
        rows = sum(map(len, traces))
        return cls(np.arange(rows, dtype=np.float64) * period, values, first._dictionary, first._scale)

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        axes = self._axes
        lines = [
            f"{len(self)} samples"
            + (f" from {self.t[0]:g} to {self.t[-1]:g} s" if len(self) else "")
            + f", {axes} {'axis' if axes == 1 else 'axes'}"
        ]
        for key, values in self._values.items():
            entry = self._dictionary.find(key)
            spread = f": {values.min()} to {values.max()} {entry.unit}".rstrip() if values.size else ""
            lines.append(f"  {entry.label}{spread}")
        return "\n".join(lines)

    def to_csv(self, path: str | Path) -> Path:
        """Write time and integers as a table with a line of names and units, a column for each axis; return its path.

        Raises:
            OSError: If it cannot be written.
        """
        head = ["t [s]", *(name for name, _ in self._columns())]
        columns = [values.tolist() for _, values in self._columns()]
        write_table(Path(path), [head, *zip((f"{time:.6g}" for time in self.t), *columns, strict=True)])
        return Path(path)

    def to_frame(self) -> Any:
        """Return a pandas DataFrame over the time, with the columns of `to_csv`.

        Raises:
            ImportError: If pandas is not installed.
        """
        try:
            from pandas import DataFrame, Index  # type: ignore[import-not-found,import-untyped,unused-ignore]
        except ImportError:
            raise ImportError("to_frame needs pandas, which is not installed: pip install pandas") from None
        return DataFrame(dict(self._columns()), index=Index(self.t, name="t [s]"))

    def plot(self) -> Figure:
        """Return a matplotlib figure: a panel for each object, a line for each axis, in readable units."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(9.0, 1.2 + 1.9 * len(self._values)), layout="constrained")
        panels = figure.subplots(len(self._values), 1, sharex=True, squeeze=False)[:, 0]
        for panel, (key, values) in zip(panels, self._values.items(), strict=True):
            entry = self._dictionary.find(key)
            scale = self._scales(entry)
            units = {
                None if unit is None else SHOWN[unit.dimension]
                for unit in (find_unit(entry.unit, one) for one in scale)
            }
            unit = units.pop() if len(units) == 1 else None
            panel.plot(self.t, values if unit is None else in_unit(values, entry, unit, scale))
            panel.set_title(entry.name, loc="left", fontsize="medium")
            panel.set_ylabel(entry.unit if unit is None else unit)
            panel.grid(alpha=0.3)
        if self._axes > 1:
            panels[0].legend([f"axis {axis}" for axis in range(self._axes)], loc="upper right", fontsize="small")
        panels[-1].set_xlabel("t [s]")
        return figure

    @property
    def _axes(self) -> int:
        return next((values.shape[-1] for values in self._values.values()), 0)

    def _columns(self) -> Iterator[tuple[str, Integers]]:
        """Yield name and values of each column, shape (n,)."""
        for key, values in self._values.items():
            entry = self._dictionary.find(key)
            name = f"{entry.label} [{entry.unit}]" if entry.unit else entry.label
            for axis in range(values.shape[-1]):
                yield (name if self._axes == 1 else f"{name} (axis {axis})"), values[:, axis]

    def _scales(self, entry: Entry) -> Sequence[Scale]:
        # The drive is not asked unless a unit needs it.
        if self._scale is None or not follows_scale(entry.unit):
            return [None] * self._axes
        return self._scale()


def _of(scales: Sequence[Scale], axes: Sequence[int]) -> Sequence[Scale]:
    return [scales[axis] for axis in axes]
