"""`drive-env list`: list devices, motors and loads."""

from __future__ import annotations

from typing import Annotated

import typer

from drive_env.commands.options import Json, errors_as_exit_codes, print_json
from drive_env.commands.tables import print_names

KINDS = ("devices", "motors", "loads")


def list_names(
    kind: Annotated[str | None, typer.Argument(help="devices, motors or loads; all by default.")] = None,
    json: Json = False,
) -> None:
    """List the devices, motors and loads by the names that the other commands and `EmulatedDrives` take."""
    from drive_env.devices import device_names, find_device
    from drive_env.motors import MOTORS
    from mechanics.loads import LOADS
    from mechanics.reading.near_names import did_you_mean

    with errors_as_exit_codes():
        if kind is not None and kind not in KINDS:
            raise ValueError(f"there are {', '.join(KINDS)}, not {kind!r}{did_you_mean(kind, KINDS)}")
        tables = {
            "devices": {name: find_device(name).title for name in device_names()},
            "motors": {motor.name: motor.title for motor in MOTORS.values()},
            "loads": {load.name: load.meaning for load in LOADS.values()},
        }
        chosen = {name: rows for name, rows in tables.items() if kind in (None, name)}
        if json:
            print_json(chosen)
        else:
            print_names(chosen)
