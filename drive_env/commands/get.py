"""`drive-env get` and `drive-env set`: single objects, by index, index:sub-index or name."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drive_env import cia402
from drive_env.commands.options import (
    REFUSED,
    AxesOptions,
    Eds,
    Json,
    WouldDo,
    Yes,
    ask,
    axes_of,
    axis_name,
    axis_place,
    errors_as_exit_codes,
    fail,
    grouped,
    object_name,
    print_result,
    scales_of,
    told_if_interrupted,
)

if TYPE_CHECKING:
    from drive_env.dictionary.entries import Entry
    from drive_env.dictionary.quantities import Scale
    from drive_env.master.bus_drives import BusDrives

Raw = Annotated[bool, typer.Option("--raw", help="Integers as the wire carries them, without units.")]


@grouped
def get(
    objects: Annotated[list[str], typer.Argument(help="6041, 607D:1 (hexadecimal) or 'Velocity actual value'.")],
    *,
    bus: AxesOptions,
    eds: Eds = None,
    raw: Raw = False,
    json: Json = False,
) -> None:
    """Read objects over SDO and show them with their units.

    Nothing is written. A node on CAN that is in the NMT state stopped, where it answers no SDO, is taken to
    pre-operational first, by an NMT command, and stays there.
    """
    with errors_as_exit_codes(), bus.connect(eds, safety=False) as drives:
        entries = [drives.description.dictionary.find(object_name(name)) for name in objects]
        scales = [None] * drives.num_axes if raw else scales_of(drives)
        rows = []
        for entry in entries:
            values = drives.read((entry.index, entry.sub))
            rows += [(k, entry, values[k], scales[k]) for k in axes_of(drives, entry, bus.axis)]
        lines = [f"{axis_name(drives, k)}  {e.label} = {_text(value, e, scale, raw)}" for k, e, value, scale in rows]
        print_result([axis_place(drives, k) | _row(*row) for k, *row in rows], lines, json)


@grouped
def set_object(
    name: Annotated[str, typer.Argument(metavar="OBJECT", help="2042:1 (hexadecimal) or 'Profile velocity'.")],
    value: Annotated[str, typer.Argument(help="An integer, or a quantity: '1000 rpm', '7 A', '0.5 rev', '20 ms'.")],
    *,
    bus: AxesOptions,
    eds: Eds = None,
    raw: Raw = False,
    yes: Yes = False,
    json: Json = False,
    dry_run: WouldDo = False,
) -> None:
    """Write an object over SDO, read it back and show its value.

    If an axis is enabled it asks first. A controlword that enables is refused, since nothing would monitor the motor;
    one that stops (0, 2, 6, 7) is always sent, after a quick stop to rest where it takes the voltage away (0, 6). What
    an enabled axis stops by when its master dies (1016h, 100Ch, 100Dh, 1029h, 6007h) is not changed; if another program
    enables an axis meanwhile, the value of before is written back.
    """
    from drive_env.dictionary import quantities
    from drive_env.master.can.error_control import is_of_a_watchdog
    from drive_env.master.parameters import command

    with errors_as_exit_codes(), ExitStack() as stack:
        if dry_run:
            bus.look_first(eds)
        drives = stack.enter_context(bus.connect(eds, safety=False))
        entry = drives.description.dictionary.find(object_name(name))
        chosen = axes_of(drives, entry, bus.axis)
        is_controlword = cia402.of_first_axis(entry.index) == cia402.CONTROLWORD
        # A controlword has no unit, and one that stops must not wait for the scales.
        scales = [None] * drives.num_axes if raw or is_controlword else scales_of(drives)
        wanted: list[Any] = [value] * drives.num_axes
        if drives.description.is_number(entry):
            wanted = [
                quantities.parse_raw(value, entry) if raw else quantities.parse(value, entry, scale) for scale in scales
            ]
        if is_controlword:
            _refuse_to_enable(entry, wanted[0])
        if is_of_a_watchdog(entry.index):
            _keep_watchdog(drives, entry)
        if dry_run:
            _tell_plan(drives, entry, chosen, wanted, scales, value, raw=raw, json=json)
            return
        if not is_controlword:
            _ask_where_live(drives, f"{entry.label} = {value}", yes)
        elif cia402.cuts_voltage(wanted[0]):
            _bring_to_rest(drives, chosen)
        readable = entry.access != "wo"
        with told_if_interrupted(f"{entry.label} may be {value} by now; drive-env get {name!r} shows it"):
            _write(drives, entry, chosen, wanted if drives.description.is_number(entry) else value)
            found = drives.read((entry.index, entry.sub)) if readable else wanted
        lines = [f"{axis_name(drives, k)}  {entry.label} = {_text(found[k], entry, scales[k], raw)}" for k in chosen]
        print_result([axis_place(drives, k) | _row(entry, found[k], scales[k]) for k in chosen], lines, json)
        asked = _without_remote_frames(entry, [wanted[k] for k in chosen], [found[k] for k in chosen])
        differs = readable and any(found[k] != one for k, one in zip(chosen, asked, strict=True))
        # Objects such as 1010h take a signature and read another value.
        if differs and not command(entry.index, drives.description.hints).endswith("a service"):
            fail(f"{entry.label} was written, but reads back another value than {asked[0]}", REFUSED)


def _tell_plan(
    drives: BusDrives,
    entry: Entry,
    axes: list[int],
    wanted: list[Any],
    scales: list[Any],
    text: str,
    *,
    raw: bool,
    json: bool,
) -> None:
    """Print the present values and those to write; raises for an impossible value."""
    from drive_env.dictionary.access import check_limits, check_writable

    check_writable(entry)
    is_number = drives.description.is_number(entry)
    for one in wanted if is_number else []:
        check_limits(entry, one)
    found = drives.read((entry.index, entry.sub)) if entry.access != "wo" else [None] * drives.num_axes
    rows, lines = [], []
    for axis in axes:
        of_object = {"object": f"{entry.index:04X}h:{entry.sub:02X}", "is": found[axis], "would be": wanted[axis]}
        rows.append(axis_place(drives, axis) | of_object)
        now = "" if found[axis] is None else f" is {_text(found[axis], entry, scales[axis], raw)};"
        then = _text(wanted[axis], entry, scales[axis], raw) if is_number else text
        written = f"{then} would be written (dry run: nothing was written)"
        lines.append(f"{axis_name(drives, axis)}  {entry.label}{now} {written}")
    print_result(rows, lines, json)


def _refuse_to_enable(entry: Any, controlword: int) -> None:
    """Raise ValueError for a controlword that would enable: after this command nothing monitors the motor."""
    if cia402.may_enable(controlword):
        raise ValueError(
            f"{entry.label} = {controlword} would enable the axis, and nothing would monitor the motor after this "
            "command ends. Turn it with `drive-env jog`, or from Python with CanDrives; to stop it, set 2 or 0"
        )


def _bring_to_rest(drives: BusDrives, chosen: list[int]) -> None:
    """Stop the axes that a controlword takes the voltage from: a motor that turns would coast."""
    from drive_env.commands.replayed_motors import Stopped, name, stop_axes
    from drive_env.master.can_drives import CanDrives

    if not isinstance(drives, CanDrives):
        return  # on EtherCAT motors run only in Op, and opening the drives has taken them to Pre-Op
    axes = [(drives.nodes[node], part) for node, part in (divmod(k, drives.description.num_axes) for k in chosen)]
    clients = {node: drives.sdo(k) for k, node in enumerate(drives.nodes)}
    for outcome in stop_axes(drives.port, clients, axes, drives.description.answer_timeout):
        if not isinstance(outcome, Stopped):
            print(f"drive-env: {outcome}", file=sys.stderr)
        elif outcome.cut:
            axis = name((outcome.node, outcome.axis))
            print(f"drive-env: {axis}: its voltage was switched off while it turned: {outcome.cut}", file=sys.stderr)


def _without_remote_frames(entry: Entry, wanted: list[Any], found: list[Any]) -> list[Any]:
    """Return the wanted values with bit 30 set if the drive keeps it, with a note on stderr.

    CiA 301 has it in the COB-ID of a PDO: no remote frames for it. A drive that answers none may keep it set.
    """
    from drive_env.canopen.communication import is_pdo_id
    from drive_env.canopen.frames import NO_REMOTE

    if not is_pdo_id(entry) or found == wanted or found != [one | NO_REMOTE for one in wanted]:
        return wanted
    print(
        f"drive-env: note: {entry.label}: the drive keeps bit 30 set, which is its to decide: no remote frames for "
        "this PDO (CiA 301)",
        file=sys.stderr,
    )
    return found


def _live(drives: BusDrives) -> str:
    """Return the axes that are enabled by their present statuswords, as text; "" if all are off."""
    status = [int(word) for word in drives.read(cia402.STATUSWORD)]
    return ", ".join(
        f"{axis_name(drives, axis)} ({word:04X}h)" for axis, word in enumerate(status) if cia402.is_live(word)
    )


def _keep_watchdog(drives: BusDrives, entry: Entry) -> None:
    """Raise RuntimeError if an axis is enabled that needs this object to stop when its master dies."""
    if who := _live(drives):
        raise RuntimeError(
            f"{who} is enabled by its statusword, and {entry.label} is part of what stops it when its master dies, "
            "whichever program set it: it was not changed, and --yes does not change that. Switch the axis off first, "
            "in the program that enabled it or with drive-env set 6040 2"
        )


def _write(drives: BusDrives, entry: Entry, axes: list[int], value: Any) -> None:
    """Write an object of some axes (a text has none); a watchdog's is restored if an axis was enabled meanwhile.

    Between our check of the statusword and our write another master may enable an axis. So the statusword is checked
    again, and an axis that does not answer counts as enabled.

    Raises:
        RuntimeError: If an axis was enabled meanwhile.
    """
    import numpy as np

    from drive_env.dictionary.aborts import ObjectAccessError
    from drive_env.fieldbus.errors import BusError
    from drive_env.master.can.error_control import is_of_a_watchdog

    key = entry.index, entry.sub
    where = None if isinstance(value, str) else np.isin(np.arange(drives.num_axes), axes)
    if not is_of_a_watchdog(entry.index):
        drives.write(key, value, where=where)
        return
    before = [int(one) for one in drives.read(key)]  # read last: another program may have changed it
    drives.write(key, value, where=where)
    try:
        who = _live(drives)
    except (BusError, ObjectAccessError) as error:
        who = f"an axis whose statusword could not be read ({error})"
    if not who:
        return
    drives.write(key, before, where=where)
    raise RuntimeError(
        f"{who} was enabled by another program while {entry.label} was written, which is part of what stops it when "
        f"its master dies: {', '.join(map(str, before))} was written back, as it was before. Stop the axis with "
        "drive-env set 6040 2 where nothing monitors its master"
    )


def _ask_where_live(drives: BusDrives, what: str, yes: bool) -> None:
    """Ask the user to confirm a write if a drive may turn its motor; `ask` raises otherwise."""
    if who := _live(drives):
        ask(f"{who} is enabled by its statusword, and reacts at once (to stop it, set 6040 to 2). Write {what}?", yes)


def _row(entry: Any, value: Any, scale: Scale) -> dict[str, Any]:
    from drive_env.dictionary import quantities

    row = {"index": f"{entry.index:04X}", "sub": entry.sub, "name": entry.name, "raw": value}
    if not isinstance(value, str):
        row["unit"] = entry.unit
        row["text"] = quantities.show(int(value), entry, scale)
    return row


def _text(value: Any, entry: Any, scale: Scale, raw: bool) -> str:
    from drive_env.dictionary import quantities

    if isinstance(value, str):
        return str(value)
    if raw or entry.bits is None:
        return str(value)
    text = quantities.show(int(value), entry, scale)
    return text if entry.unit else f"{text} ({int(value) & (1 << entry.bits) - 1:X}h)"
