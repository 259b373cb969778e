"""`drive-env new`: a device of one's own from the EDS of a drive."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from drive_env.commands.options import Json, errors_as_exit_codes, print_json


def new_from_eds(
    eds: Annotated[Path, typer.Option("--eds", help="The vendor's EDS of a CiA 402 drive.", show_default=False)],
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder to make.", show_default="the file's name, here")
    ] = None,
    motor: Annotated[
        str,
        typer.Option("--motor", help="Motor whose rated current is the base of thousandths (drive-env list motors)."),
    ] = "qbl4208",
    velocity_unit: Annotated[
        str, typer.Option("--velocity-unit", help='Unit of speeds where the EDS tells none: rpm, pps, "0.1 rpm" ...')
    ] = "",
    acceleration_unit: Annotated[
        str, typer.Option("--acceleration-unit", help='The same of accelerations: rpm/s, pps^2, "10 pps^2" ...')
    ] = "",
    json: Json = False,
) -> None:
    """Make a device's folder from a drive's EDS: drive-env new --eds vendor.eds, then drive-env serve ./vendor.

    Dictionary, modes, units and roles are the EDS's; what no EDS tells are class values. The folder has a list of what
    a person must fill in, of objects that have no effect in the emulator, and of what had to be put right in the file.
    """
    from drive_env.devices import find_device
    from drive_env.devices.new_device import LIST_NAME, new_device
    from drive_env.motors import find_motor

    with errors_as_exit_codes():
        folder = Path(eds.stem) if out is None else out
        chosen = find_motor(motor)
        made = new_device(eds, folder, chosen, velocity_unit=velocity_unit, acceleration_unit=acceleration_unit)
        device = find_device(str(folder if len(folder.parts) > 1 else Path(folder)))
        device.preset(chosen)
        if json:
            print_json({
                "folder": str(folder),
                "axes": device.num_axes,
                "fill in": [note._asdict() for note in made.fill_in],
                "modes": [note._asdict() for note in made.modes],
                "without effect": [note._asdict() for note in made.without_effect],
                "put right": [note._asdict() for note in made.repairs],
            })  # fmt: skip
            return
        print(made.text(), end="")
        print(f"\n{folder} is written, this list as {folder / LIST_NAME}; serve it: drive-env serve {folder}")
