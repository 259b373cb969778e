"""`drive-env fault`: inject a fault on a bus that `drive-env serve` serves."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drive_env.commands.options import Json, ending_by, fail, print_json
from drive_env.commands.tables import print_lines

if TYPE_CHECKING:
    from drive_env.faults.table import FaultRow

CONTROL_PORT = 29637  # copy of the one in bus/fault_control.py, whose import takes long


def fault(
    name: Annotated[str | None, typer.Argument(help="Fault by name; --list lists them.")] = None,
    numbers: Annotated[
        list[str] | None,
        typer.Argument(metavar="[PARAMETER=VALUE]...", help="Parameters of the fault, e.g. share=0.2."),
    ] = None,
    at: Annotated[float, typer.Option(help="Time from now, or from when the condition holds [s].")] = 0.0,
    when: Annotated[
        str, typer.Option(help="Condition: enabled, 'speed > 100' [rad/s] or 'position < -3' [rad] of the rotor.")
    ] = "",
    duration: Annotated[
        float | None, typer.Option(help="How long it lasts [s].", show_default="until it is cleared")
    ] = None,
    node: Annotated[
        int | None, typer.Option("--node", "-n", help="Node that has the fault.", show_default="the only one")
    ] = None,
    axis: Annotated[
        int | None,
        typer.Option("--axis", help="Axis of a node with several that has the fault, from 0.", show_default="all"),
    ] = None,
    control: Annotated[int, typer.Option(help="Port of serve's --control.")] = CONTROL_PORT,
    table: Annotated[bool, typer.Option("--list", help="Print the table of faults, and stop.")] = False,
    status: Annotated[bool, typer.Option("--status", help="Print the faults that are active or scheduled.")] = False,
    clear: Annotated[str | None, typer.Option(help="End the fault of this number, or all.")] = None,
    as_json: Json = False,
) -> None:
    """Inject a fault on emulated drives: sensor, motor, supply, load, bus or node.

    They are served with --control; `drive-env fault encoder_stuck --at 2 --duration 0.1` prints the fault's number.
    docs/faults.md has the effect of each fault, the reaction of drive and master, and how to recover.
    """
    from drive_env.bus.fault_control import ControlError, ask
    from drive_env.faults.schedule import parse_order
    from drive_env.faults.table import checked_parameters, find_fault

    with ending_by(fail, refused=(ControlError,)):
        if sum((name is not None, table, status, clear is not None)) != 1:
            raise ValueError("give one of a fault's name, --list, --status and --clear NUMBER")
        if table:
            _print_table(as_json)
        elif status:
            _print_status(ask(control, "faults")["faults"], as_json)
        elif clear is not None:
            ask(control, f"clear {clear}")
        else:
            given = {"at": at, "duration": duration, "node": node, "axis": axis}
            words = [
                str(name),
                *(numbers or []),
                *(f"{key}={value}" for key, value in given.items() if value is not None),
            ]
            words += [f"when={when}"] if when else []
            line = shlex.join(words)
            order = parse_order(line)  # mistakes in it are reported here, with or without a server
            checked_parameters(find_fault(order.name), order.parameters)
            number = ask(control, f"fault {line}")["number"]
            print_json({"number": number}) if as_json else print(number)


def _print_table(as_json: bool) -> None:
    from drive_env.faults.table import FAULTS

    if as_json:
        print_json({row.name: _row(row) for row in FAULTS.values()})
        return
    group = ""
    for row in FAULTS.values():
        if row.group != group:
            group = row.group
            print(f"{group}:")
        print(f"  {row.name:<20} {row.title}")
        for key, parameter in row.parameters.items():
            print_lines([f"    {key}: {parameter.meaning} ({parameter.range}, default {parameter.default:g})"])


def _row(row: FaultRow) -> dict[str, Any]:
    return vars(row) | {"parameters": {key: vars(parameter) for key, parameter in row.parameters.items()}}


def _print_status(faults: list[dict[str, Any]], as_json: bool) -> None:
    if as_json:
        print_json(faults)
        return
    for one in faults:
        where = "" if one["node"] is None else f" node {one['node']}"
        where += "" if one["axis"] is None else f" axis {one['axis']}"
        given = "".join(f" {key}={value:g}" for key, value in one["parameters"].items())
        lasts = "permanent" if one["duration"] is None else f"for {one['duration']:g} s"
        state = "active" if one["active"] else "scheduled"
        print_lines([f"{one['number']}: {one['name']}{where}{given}, {lasts}, {state}"])
