"""`drive-tune response`: the frequency response of an axis's velocity or position loop, with its margins."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drive_env.commands.tables import Column, print_lines, print_table
from tuning.commands.options import (
    REFUSED,
    Json,
    Out,
    TargetOptions,
    before_as_json,
    errors_as_exit_codes,
    fail,
    file_of,
    print_json,
    progress_bar,
    takes,
    tell_before,
    unchanged,
)
from tuning.identify.identified_axis import TITLES

if TYPE_CHECKING:
    from tuning.response.measured_loop import MeasuredLoop

FEWEST = 0.1  # of an axis' frequencies that must be coherent; else the command fails
COLUMNS = (
    "frequency [Hz]", "gain [dB]", "phase [deg]", "coherence", "trusted", "source",
)  # fmt: skip


@takes
def response(
    drive: TargetOptions,
    loop: Annotated[str, typer.Argument(help="velocity or position.")] = "velocity",
    signal: Annotated[str, typer.Option("--signal", help="Excitation: multisine or chirp.")] = "multisine",
    low: Annotated[float | None, typer.Option("--low", help="Lowest frequency [Hz].", show_default="5")] = None,
    high: Annotated[
        float | None,
        typer.Option("--high", help="Highest frequency [Hz], up to 400.", show_default="400; 50 for the position loop"),
    ] = None,
    resolution: Annotated[float, typer.Option("--resolution", help="Spacing of the frequencies [Hz].")] = 5.0,
    trace: Annotated[
        bool, typer.Option("--trace", help="Measure above 400 Hz, with the emulator's trace; not on a bus.")
    ] = False,
    out: Out = None,
    json: Json = False,
) -> None:
    """Measure the axes' frequency response with their present gains: open loop, coherence and margins.

    The axes run there and back at a steady speed, with an excitation on the set-point, for about two seconds, and end
    where they began. With --out, a picture and a CSV of each axis are written. Frequencies with low coherence are grey,
    and no margin is read from them. The parameters of drives on a bus are saved to a file for `drive-tune undo`, beside
    --out or in runs/.
    """
    with errors_as_exit_codes():
        from drive_env.devices import find_device
        from tuning.response.excitation_run import MODE
        from tuning.response.frequency_response import Signal, measure
        from tuning.runs import provenance
        from tuning.target import check_measurable

        if out is not None:
            provenance.check_folder(out)
        if trace and (drive.bus or high is not None):
            raise ValueError(
                "--trace is for emulated drives, up to 1000 Hz; leave out --high and --bus, or leave out --trace"
            )
        drive.check()
        check_measurable(find_device(drive.device), (MODE.get(loop, "csv"),))
        file = file_of(drive, "response", out)
        with unchanged(drive, file) as (target, _), progress_bar("shaking") as show:
            measured = measure(target, loop, signal=Signal(signal, low, high, resolution), traced=trace, progress=show)
            numbers = target.axis_numbers
        if out is not None:
            _write(out, measured, numbers)
        if json:
            print_json([one | before_as_json(file) for one in _as_json(measured, numbers)])
        else:
            _print(measured, numbers, out)
            tell_before(file)
        if measured.trusted.mean(axis=0).min() < FEWEST:
            worst = int(measured.trusted.mean(axis=0).argmin())
            # Print the measured margins before the notes.
            why = "; ".join(measured.notes[worst]) or "the excitation was too weak"
            fail(f"less than a tenth of an axis's frequencies are coherent: {why}", REFUSED)


def _axes(measured: MeasuredLoop) -> range:
    return range(measured.open_loop.shape[1])


def _write(folder: Path, measured: MeasuredLoop, numbers: Sequence[int]) -> None:
    import numpy as np

    from drive_env.whole_file import write_table
    from tuning.response.bode import write_bode
    from tuning.runs.provenance import new_folder

    with new_folder(folder) as partial:
        for axis in _axes(measured):
            name = f"{measured.loop}_axis{numbers[axis]}"
            write_bode(partial / f"{name}.png", measured, axis)
            rows: list[Sequence[object]] = [COLUMNS]
            for k, f in enumerate(measured.f):
                L = measured.open_loop[k, axis]
                known = bool(np.isfinite(L)) and L != 0.0
                gain = 20.0 * math.log10(abs(L)) if known else math.nan
                phase = math.degrees(np.angle(L)) if known else math.nan
                source = "emulator's trace" if measured.traced[k] else "bus"
                trusted = int(measured.trusted[k, axis])
                row = (f"{gain:.4f}", f"{phase:.3f}", f"{measured.coherence[k, axis]:.4f}", trusted, source)
                rows.append((f"{f:g}", *row))
            write_table(partial / f"{name}.csv", rows)


def _as_json(measured: MeasuredLoop, numbers: Sequence[int]) -> list[dict[str, Any]]:
    rows = []
    for axis in _axes(measured):
        on_bus = ~measured.traced
        rows.append(
            {
                "axis": numbers[axis],
                "loop": measured.loop,
                "gains": [int(gain) for gain in measured.gains[axis]],
                "margins": {name: _or_none(value) for name, value in measured.margins(axis)._asdict().items()},
                "coherent": float(measured.trusted[on_bus, axis].mean()),
                "plant": _plant(measured, axis),
                "peak_current_a": _or_none(measured.peak_current[axis]),
                "drive_time_s": measured.drive_time,
                "notes": list(measured.notes[axis]),
            }
        )
    return rows


def _plant(measured: MeasuredLoop, axis: int) -> dict[str, Any] | None:
    if measured.fits[axis] is None:
        return None
    return {
        name: {"value": _or_none(e.value), "low": _or_none(e.low), "high": _or_none(e.high), "unit": e.unit}
        | ({"reason": e.reason} if e.reason else {})
        for name, e in measured.estimates(axis).items()
    }


def _print(measured: MeasuredLoop, numbers: Sequence[int], out: Path | None) -> None:
    titles = (
        "phase\nmargin\n[deg]", "at\n[Hz]", "gain\nmargin\n[dB]", "at\n[Hz]", "crossover\n[Hz]", "bandwidth\n[Hz]",
        "\nMs", "coherent\n[%]",
    )  # fmt: skip
    rows = []
    for axis in _axes(measured):
        found = measured.margins(axis)
        coherent = 100.0 * float(measured.trusted[~measured.traced, axis].mean())
        figures = (
            found.phase_deg, found.phase_hz, found.gain_db, found.gain_hz, found.crossover_hz, found.bandwidth_hz,
            found.ms, coherent,
        )  # fmt: skip
        rows.append((str(numbers[axis]), *(_text(x, "{:.2f}" if x is found.ms else "{:.1f}") for x in figures)))
    print_table([Column("axis"), *map(Column, titles)], rows, f"{measured.loop} loop")
    lines = []
    for axis in _axes(measured):
        if measured.fits[axis] is not None:
            for name, e in measured.estimates(axis).items():
                unit = "" if e.unit == "1" else f" {e.unit}"
                said = f"{e.value:.4g}{unit} ({e.low:.4g} to {e.high:.4g})"
                if e.reason:
                    said = f"not identified: {e.reason}"
                lines.append(f"axis {numbers[axis]}: {TITLES[name]} {said}")
        lines += [f"axis {numbers[axis]}: {note}" for note in measured.notes[axis]]
    written = "" if out is None else f"; written to {out}"
    print_lines([*lines, f"{measured.drive_time:.2f} s of drive time{written}"])


def _text(value: float, form: str) -> str:
    return form.format(value) if math.isfinite(value) else "infinite" if value == math.inf else "not measured"


def _or_none(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
