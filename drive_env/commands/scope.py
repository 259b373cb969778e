"""`drive-env scope`: record objects at every SYNC, from a trigger on, as CSV and picture."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from drive_env import cia402
from drive_env.commands.options import (
    INTERRUPTED,
    REFUSED,
    AxesOptions,
    Eds,
    Json,
    axes_of_nodes,
    axis_name,
    check_free,
    check_writable,
    default_samples,
    errors_as_exit_codes,
    fail,
    grouped,
    object_name,
    print_json,
    scales_of,
)

if TYPE_CHECKING:
    from drive_env.dictionary.entries import ObjectDictionary
    from drive_env.dictionary.quantities import Scale
    from drive_env.master.bus_drives import BusDrives

# Response and commands of the usual modes: what `drive-env model` needs.
DEFAULT = ("6062", "6064", "606C", "60FF", "6077")
OF_VL = ("6043", "6042", "6044", "6077")  # of a drive without pv
LISTENED = 0.3  # s to listen for other masters before anything is sent
CHUNK = 0.05  # s recorded at a time while waiting for the trigger
PIECE = 0.25  # s recorded at a time afterwards: the most that is lost if the recording is interrupted
_TRIGGER = re.compile(r"^\s*(.+?)\s*(<=|>=|<|>|==|!=)\s*(.+?)\s*$")


class Trigger(NamedTuple):
    """A condition on an object: it fires when the condition becomes true."""

    entry: Any
    relation: str
    text: str


@grouped
def scope(
    objects: Annotated[
        list[str] | None, typer.Argument(help="Objects that can be mapped; by default demands and responses.")
    ] = None,
    *,
    bus: AxesOptions,
    eds: Eds = None,
    duration: Annotated[float, typer.Option(help="Duration of the recording after the trigger [s].")] = 1.0,
    trigger: Annotated[
        str | None, typer.Option(help="Start condition: '606C > 100 rpm', 'Statusword == 0x1637'.")
    ] = None,
    before: Annotated[float, typer.Option(help="Time to keep before the trigger [s].")] = 0.05,
    wait: Annotated[float, typer.Option(help="Longest wait for the trigger [s].")] = 30.0,
    period: Annotated[float, typer.Option(help="Time between samples [s], whole milliseconds.")] = 0.001,
    out: Annotated[Path, typer.Option(help="New files, without ending: OUT.csv and OUT.png.")] = Path("scope"),
    json: Json = False,
) -> None:
    """Sample objects with SYNC, one sample per millisecond, and write CSV (raw integers) and PNG (in units).

    After Ctrl-C, or if the bus is lost, the samples received so far are written, with a message.
    It sends SYNC and maps TPDOs, which it restores. Where another master commands the drive it refuses, or ends with
    what came until then: samples of two masters would be wrong.
    """
    with errors_as_exit_codes():
        _check_times(duration=duration, before=before, wait=wait, period=period)
        table, picture = new_files(out)
        refuse_other_masters(bus.interface, bus.channel, bus.nodes, bus.bitrate)
        with bus.connect(eds, safety=False) as drives:
            known = drives.description.dictionary
            entries = [
                known.find(object_name(name)) for name in objects or default_samples(known, default_names(known))
            ]
            condition = None if trigger is None else _parse(trigger, known)
            axes = axes_of_nodes(drives, bus.axis)
            every_scale = scales_of(drives)
            scales = [every_scale[k] for k in axes]
            labels = [axis_name(drives, k) for k in axes]
            rows, start, broken = _record(drives, axes, entries, condition, scales, duration, before, wait)
            _, late, worst = drives.total_timing
        if broken is not None and not len(rows[entries[0]]):
            raise broken
        every = round(period / 0.001)
        t, rows = _thin(rows, start, every)
        write_table(table, entries, labels, t, rows)
        draw(picture, entries, labels, scales, t, rows)
        summary = {"samples": len(t), "csv": str(table), "png": str(picture), "complete": broken is None}
        if json:
            print_json(summary | {"late": late, "worst lateness": worst})
        elif broken is None:
            print(f"{len(t)} samples written to {table} and {picture}")
        if late and not json:
            print(
                f"{late} SYNCs were late, the worst by {1e3 * worst:.1f} ms: the times given are the nominal times "
                f"of the SYNCs"
            )
        if broken is not None:
            why, code = (str(broken), REFUSED) if isinstance(broken, Exception) else ("interrupted", INTERRUPTED)
            fail(f"{why}; the {len(t)} samples received before are in {table} and {picture}", code)


def default_names(known: ObjectDictionary) -> tuple[str, ...]:
    """Return the default objects to record; a drive may lack some."""
    return DEFAULT if known.has(cia402.TARGET_VELOCITY) or not known.has(cia402.VL_TARGET_VELOCITY) else OF_VL


def new_files(out: Path) -> tuple[Path, Path]:
    """Return the paths of table and picture; ValueError if they cannot be written, or exist."""
    if not out.parent.is_dir():
        raise ValueError(f"there is no folder {out.parent}; choose another --out")
    table, picture = out.with_suffix(".csv"), out.with_suffix(".png")
    for file in (table, picture):
        check_free(file, "choose another --out")
    check_writable(table)
    return table, picture


def refuse_other_masters(
    interface: str | None, channel: str | None, nodes: list[int] | None, bitrate: int | None
) -> None:
    """Raise OtherMastersError if another master is active; nothing is sent."""
    from drive_env.master.can.other_masters import OtherMasters
    from drive_env.master.can.port import Port, open_bus
    from drive_env.master.open_drives import default_nodes, is_ethercat

    if is_ethercat(interface):
        return  # opening a segment takes it over in any case
    port = Port(open_bus(interface, channel, **({} if bitrate is None else {"bitrate": bitrate})))
    try:
        OtherMasters(port, nodes or default_nodes(interface)).listen(LISTENED)
    finally:
        port.close()


def _check_times(**times: float) -> None:
    for name, value in times.items():
        if not 0.0 <= value <= 3600.0 or (value == 0.0 and name in ("duration", "period")):
            raise ValueError(f"--{name} {value:g} s must be above 0 s and at most an hour")
        if name != "wait" and abs(value / 0.001 - round(value / 0.001)) > 1e-6:
            raise ValueError(f"--{name} {value:g} s is not a whole number of milliseconds; use {round(value, 3):g}")


def _parse(text: str, known: Any) -> Trigger:
    found = _TRIGGER.match(text)
    if found is None:
        raise ValueError(f"--trigger {text!r} is not a condition; write it as '606C > 100 rpm'")
    return Trigger(known.find(object_name(found[1])), found[2], found[3])


def _fires(trigger: Trigger, values: Any, scales: list[Scale]) -> Any:
    """Return the rows in which the condition is true on any of the axes."""
    import operator

    import numpy as np

    from drive_env.dictionary.quantities import parse

    relation = {
        "<": operator.lt, ">": operator.gt, "<=": operator.le, ">=": operator.ge, "==": operator.eq, "!=": operator.ne,
    }[trigger.relation]  # fmt: skip
    level = np.array([parse(trigger.text, trigger.entry, scale) for scale in scales])
    return relation(values, level).any(axis=1)


class _Samples:
    """Samples of objects at every SYNC: rows of each entry, (n, len(axes)), as long as no other master is active."""

    def __init__(self, drives: BusDrives, axes: list[int], entries: list[Any]) -> None:
        self._drives = drives
        self._axes = axes
        self._entries = list(dict.fromkeys(entries))
        self._others = drives.link.other_masters()

    def none(self) -> dict[Any, Any]:
        """Return no rows."""
        import numpy as np

        return {entry: np.empty((0, len(self._axes)), np.int64) for entry in self._entries}

    def record(self, seconds: float) -> dict[Any, Any]:
        """Return the next rows."""
        from drive_env.fieldbus.errors import BusError

        names = [(entry.index, entry.sub) for entry in self._entries]
        try:
            trace = self._drives.record(names, round(seconds, 3))
        except BusError:
            self._others.check()  # missing samples are another master's doing, if there is one
            raise
        self._drives.link.drain()
        self._others.check()
        return {entry: trace[name][:, self._axes] for entry, name in zip(self._entries, names, strict=True)}

    def complete(self, rows: dict[Any, Any], missing: int) -> tuple[dict[Any, Any], BaseException | None]:
        """Return these rows and `missing` more, or those before Ctrl-C or the loss of the bus, with that exception."""
        from drive_env.fieldbus.errors import BusError

        pieces, broken, piece = [rows], None, round(PIECE / 0.001)
        try:
            for first in range(0, missing, piece):
                pieces.append(self.record(min(piece, missing - first) * 0.001))
        except (BusError, KeyboardInterrupt) as error:
            broken = error
        return self.joined(pieces), broken

    def joined(self, pieces: list[dict[Any, Any]]) -> dict[Any, Any]:
        """Return rows one after the other."""
        import numpy as np

        return {entry: np.concatenate([part[entry] for part in pieces]) for entry in self._entries}


def _record(
    drives: BusDrives,
    axes: list[int],
    entries: list[Any],
    trigger: Trigger | None,
    scales: list[Scale],
    duration: float,
    before: float,
    wait: float,
) -> tuple[dict[Any, Any], int, BaseException | None]:
    """Return rows of each entry, the row at which the trigger fired, and the error that ended the recording."""
    count, keep = round(duration / 0.001), round(before / 0.001)
    if trigger is None:
        samples = _Samples(drives, axes, entries)
        rows, broken = samples.complete(samples.none(), count)
        return rows, 0, broken
    samples = _Samples(drives, axes, [*entries, trigger.entry])
    rows, fired = _wait_for(trigger, samples, scales, keep, wait)
    begin, end = max(0, fired - keep), fired + count
    rows, broken = samples.complete(rows, end - len(rows[trigger.entry]))
    return {entry: rows[entry][begin:end] for entry in entries}, fired - begin, broken


def _wait_for(
    trigger: Trigger, samples: _Samples, scales: list[Scale], keep: int, wait: float
) -> tuple[dict[Any, Any], int]:
    """Return the rows around the trigger, with up to `keep` before it, and the row at which it fired.

    If it does not fire within `wait` [s] the command ends.
    """
    import numpy as np

    rows = samples.none()
    _fires(trigger, np.zeros((1, len(scales)), np.int64), scales)  # an invalid level is reported before the wait
    held = True  # a condition that is true from the start must become false first
    for _ in range(max(1, round(wait / CHUNK))):
        chunk = samples.record(CHUNK)
        holds = _fires(trigger, chunk[trigger.entry], scales)
        first = np.flatnonzero(holds & ~np.concatenate([[held], holds[:-1]]))
        held = bool(holds[-1])
        old = len(rows[trigger.entry])
        rows = samples.joined([rows, chunk])
        if first.size:
            return rows, old + int(first[0])
        rows = {entry: values[max(0, len(values) - keep) :] for entry, values in rows.items()}
    fail(f"the trigger {trigger.entry.label} {trigger.relation} {trigger.text} did not fire within {wait:g} s", REFUSED)


def _thin(rows: dict[Any, Any], start: int, every: int) -> tuple[Any, dict[Any, Any]]:
    import numpy as np

    count = len(next(iter(rows.values())))
    chosen = np.arange(start % every, count, every)
    return (chosen - start) * 0.001, {entry: values[chosen] for entry, values in rows.items()}


def write_table(path: Path, entries: list[Any], labels: list[str], t: Any, rows: dict[Any, Any]) -> None:
    """Write samples as CSV: times [s], then integers of each entry and axis, rows of shape (n, axes)."""
    from drive_env import whole_file

    header = ["t [s]"]
    for entry in entries:
        unit = f" [{entry.unit}]" if entry.unit else ""
        header += [f"{entry.label}{unit}" + (f" ({label})" if len(labels) > 1 else "") for label in labels]
    samples = [[f"{time:.3f}", *(int(v) for entry in entries for v in rows[entry][k])] for k, time in enumerate(t)]
    whole_file.write_table(path, [header, *samples])


def draw(path: Path, entries: list[Any], labels: list[str], scales: list[Scale], t: Any, rows: dict[Any, Any]) -> None:
    """Draw samples as PNG, a panel for each entry, in units where their scales are known."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from drive_env.dictionary.quantities import SHOWN, UNITS, find_unit
    from drive_env.whole_file import write_picture

    figure = Figure(figsize=(9.0, 1.2 + 1.9 * len(entries)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(entries), 1, sharex=True, squeeze=False)[:, 0]
    for panel, entry in zip(panels, entries, strict=True):
        shown = entry.unit
        for axis, label in enumerate(labels):
            unit = find_unit(entry.unit, scales[axis])
            factor = 1.0
            if unit is not None:
                shown = SHOWN[unit.dimension]
                factor = unit.factor / UNITS[shown].factor
            panel.plot(t, rows[entry][:, axis] * factor, linewidth=1.2, drawstyle="steps-post", label=label)
        panel.set_ylabel(shown)
        panel.set_title(entry.label, fontsize="medium", loc="left")
        panel.grid(alpha=0.3)
        panel.margins(x=0)
        if t[0] < 0.0:
            panel.axvline(0.0, color="0.4", linewidth=0.8, linestyle="--")
    if len(labels) > 1:
        panels[0].legend(loc="upper right", fontsize="small", ncols=min(len(labels), 4))
    panels[-1].set_xlabel("time from the trigger [s]" if t[0] < 0.0 else "time [s]")
    write_picture(path, figure, 110)
