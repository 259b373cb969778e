"""`drive-tune identify`: parameters of motor and machine, with intervals, from the drive's own signals."""

from __future__ import annotations

import json as json_
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drive_env.commands.options import check_free, check_writable
from drive_env.commands.tables import Column, print_table
from tuning.commands.options import (
    REFUSED,
    Json,
    TargetOptions,
    before_as_json,
    errors_as_exit_codes,
    file_of,
    print_json,
    progress_bar,
    takes,
    tell_before,
    unchanged,
)
from tuning.estimate import interval
from tuning.identify.identified_axis import TITLES

if TYPE_CHECKING:
    from drive_env.devices import Device
    from tuning.identify.identified_axis import Identification
K_T_NOTE = (
    "Inertia, friction and load are measured as current: an inertia is the measured\nJ/K_t times the data sheet's K_t."
)


@takes
def identify(
    drive: TargetOptions,
    out: Annotated[Path | None, typer.Option("--out", help="File for the results (JSON).")] = None,
    json: Json = False,
) -> None:
    """Identify axes: winding, encoder, inertia, friction, gravity, resonance, delay and filter.

    The motor turns: there and back within --travel, up to its rated current and 0.7 of its rated speed. Every value has
    a 95 % interval; a value that cannot be identified has the reason instead. Afterwards the drive is off and has
    its own parameters; on a bus they are also saved to a file for `drive-tune undo`, beside --out or in runs/.
    """
    with errors_as_exit_codes():
        if out is not None and not out.parent.is_dir():
            raise ValueError(f"there is no folder {out.parent} for --out; make it first")
        if out is not None and out.is_dir():
            raise ValueError(f"{out} is a folder; give a file for --out, e.g. {out / 'identified.json'}")
        if out is not None:
            check_free(out, "choose another --out")
            check_writable(out)
        drive.check()
        drive.check_identifiable()
        file = file_of(drive, "identify", None if out is None else out.with_suffix(""))
        from drive_env.whole_file import write_whole
        from tuning.identify.identification import identify as run

        with unchanged(drive, file) as (target, _), progress_bar("identifying") as show:
            found = run(target, progress=lambda what, share: show(share))
            numbers = target.axis_numbers
        rows = [{"axis": axis} | row(one) for axis, one in zip(numbers, found, strict=True)]
        if out is not None:
            write_whole(out, json_.dumps(rows, indent=1) + "\n")
        if json:
            print_json([one | before_as_json(file) for one in rows])
        else:
            _print(found, target.device, numbers if drive.axis or len(found) > 1 else ())
            if out is not None:
                print(f"written to {out}")
            tell_before(file)
        if not any(estimate.is_known for one in found for estimate in one.estimates.values()):
            raise typer.Exit(REFUSED)


def row(found: Identification) -> dict[str, Any]:
    """Convert an identification to JSON types, with null for nan."""
    from tuning.identify.wiring import named

    estimates = {
        name: {key: None if isinstance(value, float) and not math.isfinite(value) else value
               for key, value in estimate._asdict().items()}
        for name, estimate in found.estimates.items()
    }  # fmt: skip
    wiring = {named(key): setting._asdict() for key, setting in found.wiring.items()}
    return {"drive_time": found.drive_time, "estimates": estimates, "wiring": wiring}


def _print(found: list[Identification], device: Device, numbers: Sequence[int]) -> None:
    from tuning.identify.wiring import finding

    columns = (Column("", "text"), Column("value"), Column("95 % interval", "text"), Column("unit", "name"))
    for k, one in enumerate(found):
        head = f"axis {numbers[k]}: " if numbers else ""
        rows = []
        said = ""
        for name, estimate in one.estimates.items():
            if estimate.is_known:
                unit = "" if estimate.unit == "1" else estimate.unit
                rows.append((TITLES[name], f"{estimate.value:.4g}", interval(estimate.low, estimate.high), unit))
            else:
                rows.append((TITLES[name], "-", "as above" if estimate.reason == said else estimate.reason, ""))
                said = estimate.reason
        print_table(columns, rows, f"{head}{one.drive_time:.1f} s of drive time")
        for line in finding(device, one.wiring):
            print(f"{head}{line}")
    print(K_T_NOTE)
