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
    WouldDo,
    Yes,
    ask,
    errors_as_exit_codes,
    fail,
    look_first,
    print_result,
)

if TYPE_CHECKING:
    from drive_env.master.parameters import Difference
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
    dry_run: WouldDo = False,
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
        keep = snapshot.stored if store is None else store
        if dry_run:
            _print_plan(_planned(file, snapshot, dict(address), other_drive=other_drive), store=keep, json=json)
            return
        ask(f"Restore {which} on {address.get('channel')}?", yes)
        try:
            changed, verified = _restore(file, snapshot, dict(address), keep, other_drive=other_drive)
        except (KeyboardInterrupt, BusError):
            if address == snapshot.bus:
                print(f"drive-tune: {what_is_changed(file)}", file=sys.stderr)
            raise
    rows = [{"axis": k, "object": c.entry.label, "found": c.found, "restored": c.wanted} for k, c in changed]
    lines = [f"axis {axis}: {change.entry.label}: {change.found} -> {change.wanted}" for axis, change in changed]
    kept = "; stored in the drives" if keep else ""
    lines.append(f"{_counted(changed)} restored, {verified} verified by a second reading{kept}")
    print_result({"changed": rows, "verified": verified, "stored": keep}, lines, json)


def _counted(changes: list[tuple[int, Any]]) -> str:
    return f"{len(changes)} parameter{'s' * (len(changes) != 1)}"


def _planned(
    file: Path, snapshot: Snapshot, address: dict[str, Any], *, other_drive: bool
) -> list[tuple[int, Difference]]:
    """Return the changes that a restoration would make, as (axis, difference); raises as the restoration would."""
    from drive_env.master.open_drives import open_drives
    from drive_env.master.parameters import check_at_rest
    from tuning import snapshot as snapshots

    address.pop("axes", None)
    named = {name: address.get(name) for name in ("interface", "channel", "nodes", "bitrate")}
    look_first(device=snapshot.device, timeout=address.get("timeout"), **named)
    with open_drives(snapshot.device, safety=False, **address) as drives:
        snapshots.check_same_drives(file, snapshot, drives, other_drive=other_drive)
        planned = snapshots.differences(drives, snapshot)
        for axis, change in planned:
            check_at_rest(drives, [(change.entry.index, change.entry.sub)], axis)
    return planned


def _print_plan(planned: list[tuple[int, Difference]], *, store: bool, json: bool) -> None:
    """Print the changes that a restoration would make."""
    rows = [{"axis": k, "object": c.entry.label, "found": c.found, "wanted": c.wanted} for k, c in planned]
    lines = [f"axis {axis}: {change.entry.label}: {change.found}, would be {change.wanted}" for axis, change in planned]
    kept = ", and stored" if store else ""
    lines.append(f"{_counted(planned)} would be restored{kept} (dry run: nothing was written)")
    print_result({"would change": rows, "would store": store, "written": 0}, lines, json)


def _restore(
    file: Path, snapshot: Snapshot, address: dict[str, Any], store: bool, *, other_drive: bool
) -> tuple[list[tuple[int, Difference]], int]:
    """Restore a snapshot; return the changes as (axis, difference), and the number of parameters read again."""
    from drive_env.master.open_drives import open_drives
    from drive_env.master.parameters import list_differences, restorable
    from tuning import snapshot as snapshots
    from tuning.target import of_nodes

    # Nothing turns here; an envelope would only add its own limits.
    axes = address.pop("axes", None)
    with open_drives(snapshot.device, safety=False, **address) as drives:
        snapshots.check_same_drives(file, snapshot, drives, other_drive=other_drive)
        chosen = drives if axes is None else of_nodes(drives, axes)
        changed = snapshots.differences(drives, snapshot)  # with set-points, which a restoration clears
        snapshots.restore(chosen, snapshot)
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
    return changed, verified
