"""`drive-tune undo`: restore drives to their state before a change."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drive_env.commands.parameters import OtherDrive, Unchecked
from tuning.commands.options import (
    REFUSED,
    Channel,
    Interface,
    Json,
    Yes,
    ask,
    errors_as_exit_codes,
    fail,
    print_json,
)

if TYPE_CHECKING:
    from tuning.snapshot import Snapshot


def undo(
    file: Annotated[Path, typer.Argument(help="File with the state before, which a command saved (TOML).")],
    interface: Interface = None,
    channel: Channel = None,
    store: Annotated[
        bool | None,
        typer.Option(
            "--store/--no-store",
            help="Store it in the drives, so that it survives a power cycle.",
            show_default="yes if the change was stored",
        ),
    ] = None,
    other_drive: OtherDrive = False,
    unchecked: Unchecked = False,
    yes: Yes = False,
    json: Json = False,
) -> None:
    """Restore the parameters that drives had before a change.

    The file names the drives and the bus; --interface and --channel override it. The file must be unchanged and belong
    to these drives. The axes must be disabled. Each axis is written completely or not at all, and read back.
    """
    with errors_as_exit_codes():
        from drive_env.fieldbus.errors import BusError
        from tuning.snapshot import load_snapshot
        from tuning.way_back import what_is_changed

        snapshot = load_snapshot(file, unchecked=unchecked)
        if not snapshot.bus:
            fail(f"{file} is from emulated drives, which existed in their program only; there is nothing to restore")
        given = {"interface": interface, "channel": channel}
        address = {**snapshot.bus, **{name: value for name, value in given.items() if value is not None}}
        nodes = ", ".join(map(str, address.get("nodes", [])))
        which = f"axis {', '.join(map(str, address['axes']))} of node {nodes}" if "axes" in address else f"node {nodes}"
        ask(f"Restore {which} on {address.get('channel')}?", yes)
        keep = snapshot.stored if store is None else store
        try:
            changed, verified = _restore(file, snapshot, dict(address), keep, other_drive=other_drive)
        except (KeyboardInterrupt, BusError):
            if address == snapshot.bus:
                print(f"drive-tune: {what_is_changed(file)}", file=sys.stderr)
            raise
    if json:
        rows = [{"axis": k, "object": c.entry.label, "found": c.found, "restored": c.wanted} for k, c in changed]
        print_json({"changed": rows, "verified": verified, "stored": keep})
        return
    for axis, change in changed:
        print(f"axis {axis}: {change.entry.label}: {change.found} -> {change.wanted}")
    kept = "; stored in the drives" if keep else ""
    count = f"{len(changed)} parameter{'s' * (len(changed) != 1)}"
    print(f"{count} restored, {verified} verified by a second reading{kept}")


def _restore(
    file: Path, snapshot: Snapshot, address: dict[str, Any], store: bool, *, other_drive: bool
) -> tuple[list[tuple[int, Any]], int]:
    """Return what was changed as (axis, difference), and how many parameters another connection has read anew."""
    from drive_env.master.open_drives import open_drives
    from drive_env.master.parameters import list_differences, restorable
    from tuning import snapshot as snapshots
    from tuning.target import of_nodes

    # Nothing turns: the envelope would only add its own limits.
    axes = address.pop("axes", None)
    with open_drives(snapshot.device, safety=False, **address) as drives:
        snapshots.check_same_drives(file, snapshot, drives, other_drive=other_drive)
        chosen = drives if axes is None else of_nodes(drives, axes)
        numbers = [*chosen.axis_numbers, *snapshot.left_out]
        changed = snapshots.restore(chosen, snapshot)
        if store:
            snapshots.store(chosen)
    with open_drives(snapshot.device, safety=False, **address) as drives:
        left = snapshots.differences(drives, snapshot)
        hints = drives.description.hints
        verified = sum(len(restorable(one, hints)) for one in (*snapshot.axes, *snapshot.left_out.values()))
    if left:
        first = left[0][0]
        fail(
            f"axis {first} does not have the values that were written, by a second reading: "
            f"{list_differences([change for axis, change in left if axis == first])}; is another master writing to it? "
            f"End it, then restore {file} again",
            REFUSED,
        )
    return [(axis, change) for axis, changes in zip(numbers, changed, strict=True) for change in changes], verified
