"""`drive-env backup`, `diff`, `restore` and `commission`: the parameters of a drive as a file."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from drive_env.tools.options import (
    REFUSED,
    Bitrate,
    Channel,
    DeviceName,
    DryRun,
    Eds,
    Interface,
    Json,
    Timeout,
    Yes,
    ask,
    check_free,
    connect,
    errors_as_exit_codes,
    increments_per_revolution,
    print_json,
)

Node = Annotated[int, typer.Option("--node", "-n", help="Node-ID.")]
Axis = Annotated[int, typer.Option(help="Axis of a node with several, from 0.")]
File = Annotated[Path, typer.Argument(help="Parameters (TOML), as `backup` writes them.")]
Store = Annotated[bool, typer.Option("--store", help="Have the drive keep them over a power cycle (1010h:01, 'save').")]
SAVE = 0x65766173  # CiA 301: "save", written to 1010h


def backup(
    file: Annotated[Path, typer.Argument(help="New file (TOML); - prints it.")],
    interface: Interface = None,
    channel: Channel = None,
    node: Node = 1,
    axis: Axis = 0,
    device: DeviceName = "tmcm1636",
    eds: Eds = None,
    bitrate: Bitrate = None,
    timeout: Timeout = None,
    json: Json = False,
) -> None:
    """Read all parameters of a drive into a file; commands and services are none."""
    from drive_env.master.parameters import read_parameters

    with errors_as_exit_codes():
        if str(file) != "-":
            check_free(file)
        with _connected(interface, channel, node, device, eds, bitrate, timeout) as drives:
            _check_axis(drives, axis)
            values = read_parameters(drives, axis)
            text = _toml(drives, values)
        if str(file) == "-":
            print(text, end="")
            return
        file.write_text(text, encoding="utf-8")
        if json:
            print_json({"file": str(file), "parameters": len(values)})
        else:
            print(f"{len(values)} parameters of node {node} written to {file}")


def diff(
    file: File,
    other: Annotated[Path | None, typer.Argument(help="Another file, to compare with in place of the drive.")] = None,
    interface: Interface = None,
    channel: Channel = None,
    node: Node = 1,
    axis: Axis = 0,
    device: DeviceName = "tmcm1636",
    eds: Eds = None,
    bitrate: Bitrate = None,
    timeout: Timeout = None,
    json: Json = False,
) -> None:
    """Show where a drive, or another file, differs from a file; exit code 1 if it does."""
    from drive_env.master.description import describe
    from drive_env.master.parameters import Difference, compare

    with errors_as_exit_codes():
        if other is not None:
            dictionary = describe(device, eds).dictionary
            wanted, found = load_parameters(file, dictionary), load_parameters(other, dictionary)
            differences = [
                Difference(dictionary.find(key), wanted.get(key, 0), found.get(key))
                for key in {**wanted, **found}
                if wanted.get(key) != found.get(key)
            ]
            scale = None
        else:
            with _connected(interface, channel, node, device, eds, bitrate, timeout) as drives:
                _check_axis(drives, axis)
                differences = compare(drives, load_parameters(file, drives.description.dictionary), axis)
                scale = increments_per_revolution(drives)[axis]
        _print(differences, "drive" if other is None else other.name, file.name, scale, json)
        if differences:
            raise typer.Exit(REFUSED)


def restore(
    file: File,
    interface: Interface = None,
    channel: Channel = None,
    node: Node = 1,
    axis: Axis = 0,
    device: DeviceName = "tmcm1636",
    eds: Eds = None,
    bitrate: Bitrate = None,
    timeout: Timeout = None,
    store: Store = False,
    yes: Yes = False,
    json: Json = False,
    dry_run: DryRun = False,
) -> None:
    """Write a file's parameters to a drive, all or none: what was written is read back, or else taken back.

    Bit rate and node-ID are left alone. The axis must not be enabled.
    """
    with errors_as_exit_codes(), _connected(interface, channel, node, device, eds, bitrate, timeout, dry_run) as drives:
        _check_axis(drives, axis)
        wanted = load_parameters(file, drives.description.dictionary)
        _exchange(drives, wanted, axis, file.name, store=store, yes=yes or dry_run, json=json)


def commission(
    motor: Annotated[str, typer.Argument(help="Motor whose preset is written; ? lists them.")],
    interface: Interface = None,
    channel: Channel = None,
    node: Node = 1,
    axis: Axis = 0,
    device: DeviceName = "tmcm1636",
    bitrate: Bitrate = None,
    timeout: Timeout = None,
    store: Store = False,
    yes: Yes = False,
    json: Json = False,
    dry_run: DryRun = False,
) -> None:
    """Write a motor's preset to a drive: motor, encoder, current limit, gains and profile; shows the difference first.

    All or none, as `restore`.
    """
    with errors_as_exit_codes():
        from drive_env.devices import find_device

        known = find_device(device)
        if motor == "?":
            print("\n".join(sorted(path.stem for path in known.presets.glob("*.toml"))))
            return
        preset = known.preset(motor)
        with _connected(interface, channel, node, device, None, bitrate, timeout, dry_run) as drives:
            _check_axis(drives, axis)
            dictionary = drives.description.dictionary
            wanted = {(e.index, e.sub): value for e, value in ((dictionary.find(n), v) for n, v in preset.items())}
            _exchange(drives, wanted, axis, f"preset {motor}", store=store, yes=yes or dry_run, json=json)


def _exchange(
    drives: Any, wanted: dict[tuple[int, int], int], axis: int, name: str, *, store: bool, yes: bool, json: bool
) -> None:
    from drive_env.master.parameters import IDENTITY_OF_THE_NODE, compare, write_all_or_none

    wanted = {key: value for key, value in wanted.items() if key[0] not in IDENTITY_OF_THE_NODE}
    differences = compare(drives, wanted, axis)
    scale = increments_per_revolution(drives)[axis]
    if not json:
        _print(differences, "drive", name, scale, json)
    if differences:
        ask(f"Write {len(differences)} parameters to node {drives.nodes[axis // drives.description.num_axes]}?", yes)
    changes = write_all_or_none(drives, wanted, axis)
    if store:
        drives.write((0x1010, 1), SAVE)
    if json:
        rows = [_row(change, scale) for change in changes]
        print_json({"changed": rows, "verified": len(wanted), "stored": store})
    else:
        kept = "; the drive keeps them" if store else "" if not changes else "; they last until a reset (--store)"
        print(f"{len(changes)} written, {len(wanted)} verified{kept}")


def _connected(
    interface: str | None,
    channel: str | None,
    node: int,
    device: str,
    eds: Path | None,
    bitrate: int | None,
    timeout: float | None,
    dry_run: bool = False,
) -> Any:
    options: dict[str, Any] = {"bitrate": bitrate, "timeout": timeout, "dry_run": dry_run, "safety": False}
    return connect(interface, channel, [node], device, eds, **options)


def _check_axis(drives: Any, axis: int) -> None:
    if not 0 <= axis < drives.num_axes:
        raise ValueError(f"--axis {axis}: the node has {drives.num_axes} axes, from 0")


def _toml(drives: Any, values: dict[tuple[int, int], int]) -> str:
    """Return parameters as TOML; the objects' names are comments, their index is what counts."""
    known = drives.description
    lines = [
        f"# Parameters of node {drives.nodes[0]}, read {datetime.now(UTC):%Y-%m-%d %H:%M} UTC.",
        "",
        "[identity]",
        f'device = "{known.name}"',
    ]
    for index, name in ((0x1008, "name"), (0x1009, "hardware"), (0x100A, "software")):
        if known.has(index):
            lines.append(f'{name} = "{drives.read(index)[0]}"')
    lines += ["", "[parameters]  # index:sub-index, both hexadecimal"]
    for (index, sub), value in values.items():
        entry = known.dictionary.find((index, sub))
        unit = f" [{entry.unit}]" if entry.unit else ""
        lines.append(f'"{index:04X}:{sub:02X}" = {value}  # {entry.name}{unit}')
    return "\n".join(lines) + "\n"


def load_parameters(path: Path, dictionary: Any) -> dict[tuple[int, int], int]:
    """Return the parameters of a file; ValueError for what is none."""
    from drive_env.dictionary.access import check_in_range, check_writable

    if not path.is_file():
        raise ValueError(f"there is no file {path}; write one with `drive-env backup {path}`")
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no TOML: {error}") from error
    rows = table.get("parameters")
    if not isinstance(rows, dict) or not rows:
        raise ValueError(f"{path} has no table [parameters]; `drive-env backup` writes one")
    import numpy as np

    values = {}
    for text, value in rows.items():
        index, _, sub = text.partition(":")
        try:
            key = int(index, 16), int(sub or "0", 16)
        except ValueError:
            raise ValueError(f"{path}: {text!r} is no index:sub-index; write it as 607D:01") from None
        entry = dictionary.find(key)
        check_writable(entry)
        check_in_range(entry, np.asarray(value))
        values[key] = int(value)
    return values


def _print(differences: Iterable[Any], found: str, wanted: str, scale: float | None, json: bool) -> None:
    rows = [_row(difference, scale) for difference in differences]
    if json:
        print_json(rows)
        return
    if not rows:
        print(f"no difference between {found} and {wanted}")
        return
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD)
    for column in ("object", found, wanted):
        table.add_column(column)
    for row in rows:
        table.add_row(row["object"], row["found text"], row["wanted text"])
    Console().print(table)


def _row(difference: Any, scale: float | None) -> dict[str, Any]:
    from drive_env.master.quantities import show

    entry, wanted, found = difference
    return {
        "object": entry.label,
        "found": found,
        "wanted": wanted,
        "found text": "absent" if found is None else show(found, entry, scale),
        "wanted text": show(wanted, entry, scale),
    }
