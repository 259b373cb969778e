"""`drive-tune restore`: drives as they were before a change."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from tuning.commands.options import Channel, Interface, Json, Yes, ask, errors_as_exit_codes, fail, print_json


def restore(
    file: Annotated[Path, typer.Argument(help="The file that a change left (TOML).")],
    interface: Interface = None,
    channel: Channel = None,
    store: Annotated[
        bool | None,
        typer.Option(
            "--store/--no-store",
            help="Have the drives keep it over a power cycle.",
            show_default="as they were told to keep the change",
        ),
    ] = None,
    yes: Yes = False,
    json: Json = False,
) -> None:
    """Bring drives back to the parameters that they had before a change.

    The file says which drives, on which bus; --interface and --channel say otherwise. Each axis is written all or none,
    and read back; it must not be enabled.
    """
    with errors_as_exit_codes():
        from tuning.snapshot import load_snapshot

        snapshot = load_snapshot(file)
        if not snapshot.bus:
            fail(f"{file} was taken from emulated drives, which ended with their program; nothing is left to restore")
        given = {"interface": interface, "channel": channel}
        address = {**snapshot.bus, **{name: value for name, value in given.items() if value is not None}}
        nodes = ", ".join(map(str, address.get("nodes", [])))
        ask(f"Restore node {nodes} on {address.get('channel')}?", yes)
        changed, kept = _restore(snapshot, address, snapshot.stored if store is None else store)
    if json:
        rows = [{"axis": k, "object": c.entry.label, "found": c.found, "restored": c.wanted} for k, c in changed]
        print_json({"changed": rows, "stored": kept})
        return
    for axis, change in changed:
        print(f"axis {axis}: {change.entry.label}: {change.found} -> {change.wanted}")
    print(f"{len(changed)} parameter{'s' * (len(changed) != 1)} restored" + ("; the drives keep them" if kept else ""))


def _restore(snapshot: Any, address: dict[str, Any], store: bool) -> tuple[list[tuple[int, Any]], bool]:
    """Return what was changed as (axis, difference), and whether the drives keep it."""
    from drive_env import CanDrives
    from tuning import snapshot as snapshots

    # Nothing turns: the envelope would only add its own limits.
    with CanDrives(snapshot.device, safety=False, **address) as drives:
        changed = snapshots.restore(drives, snapshot)
        if store:
            snapshots.store(drives)
    return [(axis, change) for axis, changes in enumerate(changed) for change in changes], store
