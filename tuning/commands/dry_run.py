"""`drive-tune auto --dry-run`: shows what a run would read, move and write; drives on a bus are only read."""

from __future__ import annotations

import math
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drive_env.commands.tables import print_lines
from tuning.commands.options import REFUSED, fail, print_json

if TYPE_CHECKING:
    from tuning.commands.methods import OpenedMethod
    from tuning.rehearsal import Rehearsal
    from tuning.target import Target


def check_can_be_told(name: str) -> None:
    """Raise ValueError for a device whose writes cannot be listed beforehand."""
    from drive_env.devices import find_device
    from tuning.identify.working_state import check_identifiable

    if (device := find_device(name)).gains.is_open_loop:
        raise ValueError(
            f"--dry-run: what a run writes to a {device.name} follows from what it measures, and cannot be listed "
            "before; leave --dry-run out: drive-tune undo restores a drive on a bus from before.toml of the run"
        )
    check_identifiable(device)


def tell_plan(target: Target, method: OpenedMethod, folder: Path, *, keep: bool, json: bool) -> None:
    """Print the checks and the plan of a run; exit with REFUSED if it would not start.

    Args:
        target: The drives; those of a bus are read by SDO, and neither written nor enabled.
        method: The method that would find the gains.
        folder: Folder to which the run would write its files.
        keep: Whether the run would have the drives store the gains over a power cycle.
        json: Print JSON instead of lines.
    """
    from tuning.rehearsal import Rehearsal, rehearse

    found = rehearse(target, keep=keep) if target.bus else Rehearsal((), ())
    files = [str(folder / name) for name in ("before.toml", "certificate.json", "report.html", *method.files)]
    if json:
        print_json(
            {
                "would run": not found.refused,
                "checks": [check._asdict() for check in found.checks],
                "moves": {
                    "low [rad]": [_finite(value) for value in target.low.tolist()],
                    "high [rad]": [_finite(value) for value in target.high.tolist()],
                    "speed [rad/s]": target.speed,
                    "current [A]": target.current,
                    "drive seconds at most": _finite(method.budget),
                },
                "writes": [write._asdict() for write in found.writes],
                "files": files,
            }
        )
    else:
        print_lines(_lines(target, method, found, files))
    if found.refused:
        fail("a run would not start: see the lines with 'no'", REFUSED)


def _lines(target: Target, method: OpenedMethod, found: Rehearsal, files: list[str]) -> list[str]:
    where = "the drive is only read" if target.bus else "the drive is emulated, and nothing moves"
    lines = [f"dry run on {target.device.name}, {target.motor.name}, {target.machine}: {where}"]
    lines += [f"  {check.verdict:<4}  {check.what}: {check.found}" for check in found.checks]
    lines.append(
        f"A run would identify the axis (about 4 s), make {method.plan} (3 moves of 250 ms each, stopped within 50 ms "
        "if it oscillates), record a move, measure the frequency response, and move with the gains before; then the "
        "drive gets the new gains if they pass, or its gains from before."
    )
    limits = f"at up to {target.speed:.4g} rad/s and {target.current:.3g} A{_at_most(method.budget)}"
    lines += [
        f"It would move axis {k} {_between(low, high)}, {limits}."
        for k, low, high in zip(target.axis_numbers, target.low.tolist(), target.high.tolist(), strict=True)
    ]
    if found.writes:
        lines.append("It would read all parameters of the drive into before.toml, and then write these objects:")
    lines += [_what_is_written(list(group)) for _, group in groupby(found.writes, key=lambda write: write.why)]
    if found.writes:
        lines.append("Objects not marked 'stays' are restored at the end, and all of them if the run fails.")
    return [*lines, f"It would write {', '.join(files)}.", "Nothing was written."]


def _between(low: float, high: float) -> str:
    if math.isfinite(low) and math.isfinite(high):
        return f"between {low:.3g} and {high:.3g} rad from where it is"
    return "freely to both sides"


def _at_most(budget: float) -> str:
    return f", for {budget:g} s of drive time at most" if math.isfinite(budget) else ""


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _what_is_written(group: list[Any]) -> str:
    """Format the line of objects that are written for the same purpose: objects, present values, new values."""
    first = group[0]
    objects = ", ".join(f"{index:04X}h:{sub:02X}" for index, sub in (write.key for write in group))
    values = [value for write in group for value in write.present or ()]
    now = ", ".join(f"{value:X}h" if first.key[0] < 0x2000 else str(value) for value in values) or "not there"
    to = f", then {first.values}" if first.values else ""
    return f"  {objects}: {first.why}; now {now}{to}{'; stays' if first.stays else ''}"
