"""`drive-env parameters`: the parameters of a drive as a file."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drive_env.commands.options import (
    REFUSED,
    AxisOptions,
    Eds,
    Json,
    WouldDo,
    Yes,
    ask,
    check_free,
    errors_as_exit_codes,
    fail,
    grouped,
    names_a_bus,
    print_json,
    print_result,
    scales_of,
    told_if_interrupted,
)
from drive_env.commands.tables import Column, print_table, print_text

if TYPE_CHECKING:
    from drive_env.dictionary.quantities import Scale
    from drive_env.master.bus_drives import BusDrives

File = Annotated[Path, typer.Argument(help="Parameters (TOML), as `parameters backup` writes them.")]
Store = Annotated[
    bool,
    typer.Option("--store", help="Store them in the drive (1010h:01, 'save'), so that they survive a power cycle."),
]
OtherDrive = Annotated[
    bool, typer.Option("--other-drive", help="Allow writing to another drive than the one it was read from.")
]
Unchecked = Annotated[
    bool, typer.Option("--unchecked", help="Accept a file that was changed, or that has no check sum; read it first.")
]

parameters_app = typer.Typer(no_args_is_help=True, rich_markup_mode="markdown")


@parameters_app.callback()
def parameters() -> None:
    """The parameters of a drive in a file: read, compare, write back; a motor's preset for a drive from the factory."""


@parameters_app.command()
@grouped
def backup(
    file: Annotated[Path, typer.Argument(help="New file (TOML); - prints it.")],
    *,
    bus: AxisOptions,
    eds: Eds = None,
    json: Json = False,
) -> None:
    """Read all parameters of a drive into a file, without commands and services."""
    from drive_env.master.parameter_files import parameters_text
    from drive_env.master.parameters import read_parameters
    from drive_env.whole_file import sealed, write_whole

    with errors_as_exit_codes():
        if str(file) != "-":
            check_free(file)
        with bus.connect(eds, safety=False) as drives:
            _check_axis(drives, bus.one_axis)
            values = read_parameters(drives, bus.one_axis)
            text = sealed(parameters_text(drives, bus.one_axis, values))
        if str(file) == "-":
            print_text(text)
            return
        write_whole(file, text)
        told = [f"{len(values)} parameters of node {bus.number} written to {file}"]
        print_result({"file": str(file), "parameters": len(values)}, told, json)


@parameters_app.command()
@grouped
def diff(
    context: typer.Context,
    file: File,
    other: Annotated[Path | None, typer.Argument(help="Another file to compare with, instead of the drive.")] = None,
    *,
    bus: AxisOptions,
    eds: Eds = None,
    json: Json = False,
) -> None:
    """Show where a drive, or another file, differs from a file; exit code 1 if it does."""
    from drive_env.fieldbus.description import describe
    from drive_env.master.parameter_files import load_parameters
    from drive_env.master.parameters import compare

    with errors_as_exit_codes():
        if other is not None:
            if names_a_bus(context):
                raise ValueError(f"{file} is compared with {other}, and with no drive; leave the bus out, or {other}")
            dictionary = describe(bus.device, eds, on_ethercat=True).dictionary  # each file may be from EtherCAT
            wanted, found = load_parameters(file, dictionary), load_parameters(other, dictionary)
            _tell_of_changes(file)
            _tell_of_changes(other)
            differences: list[Any] = [
                (dictionary.find(key), wanted.get(key), found.get(key))
                for key in {**wanted, **found}
                if wanted.get(key) != found.get(key)
            ]
            scale = None
        else:
            with bus.connect(eds, safety=False) as drives:
                _check_axis(drives, bus.one_axis)
                differences = compare(drives, load_parameters(file, drives.description.dictionary), bus.one_axis)
                _tell_of_changes(file)
                scale = scales_of(drives)[bus.one_axis]
        _print(differences, "drive" if other is None else other.name, file.name, scale, json)
        if differences:
            raise typer.Exit(REFUSED)


@parameters_app.command()
@grouped
def restore(
    file: File,
    *,
    bus: AxisOptions,
    eds: Eds = None,
    store: Store = False,
    other_drive: OtherDrive = False,
    unchecked: Unchecked = False,
    yes: Yes = False,
    json: Json = False,
    dry_run: WouldDo = False,
) -> None:
    """Write a file's parameters to a drive, all or none: they are read back, and undone if one fails.

    The file must be unchanged since `backup` wrote it, and belong to this drive. Bit rate and node-ID are not changed;
    commands and services are refused. The axis must be disabled.
    """
    from drive_env.fieldbus.description import describe
    from drive_env.master.identity import check_same_drive, read_identity
    from drive_env.master.open_drives import is_ethercat
    from drive_env.master.parameter_files import checked_origin, load_parameters
    from drive_env.master.parameters import check_no_commands

    with errors_as_exit_codes():
        known = describe(bus.device, eds, is_ethercat(bus.interface))
        wanted = load_parameters(file, known.dictionary)
        written, axis_then = checked_origin(file, unchecked=unchecked)
        check_no_commands(wanted, file, known.hints)

        def check(drives: BusDrives) -> None:
            check_same_drive(file, written, read_identity(drives), other_drive=other_drive)
            if axis_then not in (None, bus.one_axis) and not other_drive:
                raise ValueError(
                    f"{file} was read from axis {axis_then}, and --axis is {bus.one_axis}; nothing was written. To "
                    "write it to this axis all the same, add --other-drive"
                )

        _exchange(bus, eds, wanted, file.name, check, store=store, yes=yes, json=json, dry_run=dry_run)


@parameters_app.command()
@grouped
def commission(
    motor: Annotated[str, typer.Argument(help="Motor whose preset is written; ? lists them.")],
    *,
    bus: AxisOptions,
    store: Store = False,
    yes: Yes = False,
    json: Json = False,
    dry_run: WouldDo = False,
) -> None:
    """Write a motor's preset to a drive: motor, encoder, current limit, gains and profile; shows the difference first.

    All or none, as `restore`.
    """
    with errors_as_exit_codes():
        from drive_env.devices import find_device
        from drive_env.motors import find_motor

        known = find_device(bus.device)
        if motor == "?":
            print("\n".join(known.motors))
            return
        preset = known.preset(find_motor(motor))
        dictionary = known.new_dictionary()
        wanted = {(e.index, e.sub): value for e, value in ((dictionary.find(n), v) for n, v in preset.items())}
        name = f"preset {motor}"
        _exchange(bus, None, wanted, name, lambda drives: None, store=store, yes=yes, json=json, dry_run=dry_run)


def _exchange(
    bus: AxisOptions,
    eds: Path | None,
    wanted: dict[tuple[int, int], int],
    name: str,
    check: Callable[[Any], None],
    *,
    store: bool,
    yes: bool,
    json: bool,
    dry_run: bool,
) -> None:
    """Write parameters, and print the drive's values read by another connection.

    Args:
        bus: The axis.
        eds: EDS of the drive instead of its device.
        wanted: The parameters.
        name: Their source.
        check: Raises for a drive that they are not meant for.
        store: Whether the drive stores them.
        yes: Whether to skip the question.
        json: Whether to print JSON.
        dry_run: Whether to print only what would be written.
    """
    from drive_env.fieldbus.description import describe
    from drive_env.master import parameters

    axis, node, source = bus.one_axis, bus.number, wanted
    wanted = parameters.restorable(source, describe(bus.device, eds).hints)
    if dry_run:  # opening a stopped node would send it an NMT command
        bus.look_first(eds)
    with ExitStack() as written:
        with bus.connect(eds, safety=False) as drives:
            _check_axis(drives, axis)
            check(drives)
            differences = parameters.compare(drives, wanted, axis)
            addresses = {key: value for key, value in source.items() if key not in wanted}
            staying = [one for one in parameters.compare(drives, addresses, axis) if one.found is not None]
            scale = scales_of(drives)[axis]
            if not json:
                _print([*differences, *staying], "drive", name, scale, json)
            if staying:
                told = parameters.list_differences(staying)
                print(f"drive-env: note: {told}: addresses are not restored", file=sys.stderr)
            if dry_run:
                parameters.check_at_rest(drives, wanted, axis)
                _tell_plan(differences, scale, node, store=store, json=json)
                return
            if differences:
                ask(f"Write {len(differences)} parameters to node {node}?", yes)
            changes = parameters.write_all_or_none(drives, wanted, axis)
            told = "".join(f"; {one.entry.label}: {one.found} -> {one.wanted}" for one in changes)
            written.enter_context(told_if_interrupted(f"{len(changes)} written to node {node}{told}"))
            if store:
                drives.write((0x1010, 1), parameters.SAVE)
        # The written values are verified by another connection, which reads them anew.
        with bus.connect(eds, safety=False) as drives:
            left = parameters.compare(drives, wanted, axis)
    if left:
        fail(
            f"node {node} does not have the values that were written, by a second reading: "
            f"{parameters.list_differences(left)}; is another master writing to it? Look with "
            "`drive-env parameters diff`, then restore again",
            REFUSED,
        )
    lost = "; not stored: lost at the next reset (--store stores them)" if changes else ""
    kept = "; stored in the drive" if store else lost
    rows = [_row(change, scale) for change in changes]
    lines = [f"{len(changes)} written, {len(wanted)} verified by a second reading{kept}"]
    print_result({"changed": rows, "verified": len(wanted), "stored": store}, lines, json)


def _tell_plan(differences: list[Any], scale: Scale, node: int, *, store: bool, json: bool) -> None:
    rows = [_row(difference, scale) for difference in differences]
    kept = ", and stored" if store else ""
    told = [f"{len(rows)} parameters would be written to node {node}{kept} (dry run: nothing was written)"]
    print_result({"would change": rows, "would store": store, "written": 0}, told, json)


def _tell_of_changes(file: Path) -> None:
    """Print on stderr that a file was changed after it was written, which a comparison allows."""
    from drive_env.master.parameter_files import checked_origin
    from drive_env.whole_file import FileChangedError

    try:
        checked_origin(file, unchecked=False)
    except FileChangedError as error:
        print(f"drive-env: note: {error}", file=sys.stderr)


def _check_axis(drives: BusDrives, axis: int) -> None:
    if not 0 <= axis < drives.num_axes:
        raise ValueError(f"--axis {axis}: the node has {drives.num_axes} axes, from 0")


def _print(differences: Iterable[Any], found: str, wanted: str, scale: Scale, json: bool) -> None:
    rows = [_row(difference, scale) for difference in differences]
    if json:
        print_json(rows)
        return
    if not rows:
        print(f"no difference between {found} and {wanted}")
        return
    columns = [Column(title, "text") for title in ("object", found, wanted)]
    print_table(columns, [(row["object"], row["found text"], row["wanted text"]) for row in rows])


def _row(difference: Any, scale: Scale) -> dict[str, Any]:
    from drive_env.dictionary.quantities import show

    entry, wanted, found = difference
    return {
        "object": entry.label,
        "found": found,
        "wanted": wanted,
        "found text": "absent" if found is None else show(found, entry, scale),
        "wanted text": "absent" if wanted is None else show(wanted, entry, scale),
    }
