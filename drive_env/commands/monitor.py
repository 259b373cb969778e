"""`drive-env monitor`: objects of drives as they change."""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drive_env import cia402
from drive_env.commands.options import (
    AxesOptions,
    Eds,
    Json,
    axes_of_nodes,
    axis_name,
    check_time,
    default_objects,
    errors_as_exit_codes,
    grouped,
    object_name,
    print_json,
    scales_of,
)
from drive_env.commands.tables import Column, tables
from drive_env.dictionary.roles import Role

if TYPE_CHECKING:
    from collections.abc import Sequence

    from drive_env.dictionary.entries import Entry
    from drive_env.dictionary.quantities import Scale
    from drive_env.master.bus_drives import BusDrives

SPARKS = "▁▂▃▄▅▆▇█"
MOST_SPARKS = 32  # readings in a line of --plot
DEFAULT = ("6041", "6061", "6064", "606C", "6077")


@grouped
def monitor(
    objects: Annotated[
        list[str] | None, typer.Argument(help="Objects; by default status, mode, position, velocity, current.")
    ] = None,
    *,
    bus: AxesOptions,
    eds: Eds = None,
    period: Annotated[float, typer.Option(help="Time between two readings [s].")] = 0.2,
    duration: Annotated[
        float | None, typer.Option(help="Stop after this time [s]; otherwise stop with Ctrl-C.")
    ] = None,
    plot: Annotated[bool, typer.Option("--plot", help="Draw the last 32 readings of each below the table.")] = False,
    json: Json = False,
) -> None:
    """Show objects in a table that refreshes, with emergencies as they come; it only reads, over SDO.

    An axis that stands with its current at its limit for half a second (blocked, against a stop, or its encoder is
    stuck) is named, too. With --json a line for each reading.
    """
    with errors_as_exit_codes():
        check_time("--period", period)
        check_time("--duration", duration)
        if plot and json:
            raise ValueError("--plot draws on the screen, and --json writes lines for programs; leave one of them out")
        with bus.connect(eds, safety=False) as drives:
            known = drives.description.dictionary
            entries = [known.find(object_name(name)) for name in objects or default_objects(known, DEFAULT)]
            axes = axes_of_nodes(drives, bus.axis)
            watch = _Pushing(drives, axes)
            end = time.monotonic() + (float("inf") if duration is None else duration)
            try:
                if json:
                    _lines(drives, axes, entries, watch, period, end)
                else:
                    _table(drives, axes, entries, watch, period, end, plot)
            except KeyboardInterrupt:
                pass  # the usual end


def _look(drives: BusDrives, axes: list[int], entries: list[Any]) -> dict[Any, Any]:
    return {entry: [drives.read_axis(entry, axis) for axis in axes] for entry in entries}


class _Pushing:
    """Finds axes that stand with their current at its limit, by its own readings.

    Args:
        drives: The drives.
        axes: The axes to check.
    """

    def __init__(self, drives: BusDrives, axes: list[int]) -> None:
        from drive_env.drives.limit_at_rest import LimitAtRest

        self._drives, self._axes = drives, axes
        self._watch = LimitAtRest(drives)

    def look(self) -> list[bool]:
        """Return which of the axes stand at their current limit now, in their order."""
        if not self._watch.is_known:
            return [False] * len(self._axes)
        names: tuple[int | Role, ...] = (
            cia402.STATUSWORD,
            cia402.TORQUE_ACTUAL,
            cia402.VELOCITY_ACTUAL,
            Role.CURRENT_LIMIT,
        )
        return [
            bool(x)
            for x in self._watch.look(time.monotonic(), *(self._drives.read(name) for name in names))[self._axes]
        ]


def _heard(drives: BusDrives, axes: list[int]) -> list[Any]:
    """Return the emergencies of these axes, including those of their nodes without an axis."""
    return [message for message in drives.emergencies() if message.axis in axes]


def _lines(drives: BusDrives, axes: list[int], entries: list[Any], watch: _Pushing, period: float, end: float) -> None:
    start = time.monotonic()
    while True:
        values = _look(drives, axes, entries)
        row: dict[str, Any] = {"t": round(time.monotonic() - start, 3)}
        row |= {f"{e.index:04X}:{e.sub:02X}": list(values[e]) for e in entries}
        row["emergencies"] = [message._asdict() for message in _heard(drives, axes)]
        row["current at its limit at rest"] = watch.look()
        print_json(row)
        if time.monotonic() + period > end:
            return
        time.sleep(period)


def _table(
    drives: BusDrives, axes: list[int], entries: list[Any], watch: _Pushing, period: float, end: float, plot: bool
) -> None:
    from rich.live import Live

    from drive_env.drives.limit_at_rest import SAYS

    scales = scales_of(drives)
    emergencies: list[str] = []
    plotted = [entry for entry in entries if plot and _is_number(entry)]
    traces: dict[Any, deque[int]] = {
        (entry, k): deque(maxlen=MOST_SPARKS) for entry in plotted for k in range(len(axes))
    }
    with Live(auto_refresh=False) as live:
        while True:
            for message in _heard(drives, axes):
                when = time.strftime("%H:%M:%S")
                emergencies.append(f"{when}  {axis_name(drives, message.axis)}: {message.code:04X}h {message.name}")
            pushing = [
                f"{axis_name(drives, axis)}: {SAYS}" for axis, pushes in zip(axes, watch.look(), strict=True) if pushes
            ]
            values = _look(drives, axes, entries)
            for (entry, k), trace in traces.items():
                trace.append(int(values[entry][k]))
            told = [_trace_line(drives, entry, axes[k], trace, scales) for (entry, k), trace in traces.items()]
            told += emergencies[-5:] + pushing
            live.update(_draw(drives, axes, values, scales, told, live.console.width), refresh=True)
            if time.monotonic() + period > end:
                return
            time.sleep(period)


def _is_number(entry: Entry) -> bool:
    """Return whether an object can be drawn: a number except a statusword."""
    return entry.bits is not None and cia402.of_first_axis(entry.index) != cia402.STATUSWORD


def spark_line(values: Sequence[int]) -> str:
    """Return numbers as a line of bars, scaled from the least to the greatest; flat if all are equal."""
    low, span = min(values), max(values) - min(values)
    return "".join(SPARKS[(value - low) * (len(SPARKS) - 1) // span if span else 0] for value in values)


def _trace_line(drives: BusDrives, entry: Entry, axis: int, trace: Sequence[int], scales: list[Scale]) -> str:
    from drive_env.dictionary.quantities import show

    ends = " to ".join(show(value, entry, scales[axis]) for value in (min(trace), max(trace)))
    name = f"{entry.index:04X}h" + (f" {axis_name(drives, axis)}" if drives.num_axes > 1 else "")
    return f"{name} {spark_line(trace)} {ends}"


def _draw(
    drives: BusDrives, axes: list[int], values: dict[Any, Any], scales: list[Scale], told: list[str], width: int
) -> Any:
    from rich.console import Group
    from rich.text import Text

    from drive_env.dictionary.quantities import show

    columns = [Column("object", "text"), *(Column(axis_name(drives, axis), "text") for axis in axes)]
    rows = []
    for entry, found in values.items():
        cells = []
        for axis, value in zip(axes, found, strict=True):
            if cia402.of_first_axis(entry.index) == cia402.STATUSWORD:
                state = cia402.state_of(int(value))
                name = "?" if state is None else state.name.lower().replace("_", " ")
                cells.append(f"{int(value):04X}h {name}")
            elif entry.bits is None:
                cells.append(str(value))
            else:
                cells.append(show(int(value), entry, scales[axis]))
        rows.append((entry.label, *cells))
    return Group(*tables(columns, rows, width), *map(Text, told))
