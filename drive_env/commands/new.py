"""`drive-env new`: a device of one's own from the EDS or the ESI of a drive."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated

import typer

from drive_env.commands.options import Json, errors_as_exit_codes, print_json

FIELDBUSES = ("can", "ethercat")


def new_from_eds(
    eds: Annotated[
        Path | None, typer.Option("--eds", help="The vendor's EDS of a CiA 402 drive.", show_default=False)
    ] = None,
    esi: Annotated[
        Path | None,
        typer.Option("--esi", help="Its ESI (.xml), for EtherCAT; --eds beside it, if it has no dictionary."),
    ] = None,
    product: Annotated[
        str, typer.Option("--product", help="Which device of an ESI with several: its type, or code:revision.")
    ] = "",
    fieldbus: Annotated[
        str | None, typer.Option("--fieldbus", help="can or ethercat.", show_default="can; ethercat with --esi")
    ] = None,
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

    With --fieldbus ethercat, or from an ESI (--esi vendor.xml), it is on EtherCAT: drive-env serve ./vendor --interface
    ethercat --channel veth1. Dictionary, modes, units and roles are the file's; what no file tells are class values.
    The folder has a list of what a person must fill in, of objects that have no effect in the emulator, and of what had
    to be put right in the file.
    """
    from drive_env.devices import find_device
    from drive_env.devices.new_device import LIST_NAME, new_device
    from drive_env.ethercat.sii_content import sii_content
    from drive_env.motors import find_motor

    with errors_as_exit_codes():
        if fieldbus not in (None, *FIELDBUSES):
            raise ValueError(f"--fieldbus {fieldbus} must be {' or '.join(FIELDBUSES)}")
        if esi is not None and fieldbus == "can":
            raise ValueError("--esi is a file of EtherCAT; leave --fieldbus can out, or make a device of the EDS alone")
        if product and esi is None:
            raise ValueError(f"--product {product} is one device of an ESI; name the file with --esi")
        if (source := esi or eds) is None:
            raise ValueError(
                "no file is given; name the drive's EDS, its ESI, or both: --eds drive.eds --esi drive.xml"
            )
        folder = Path(source.stem) if out is None else out
        chosen = find_motor(motor)
        is_ethercat = esi is not None or fieldbus == "ethercat"
        made = new_device(
            eds, folder, chosen, velocity_unit=velocity_unit, acceleration_unit=acceleration_unit, esi=esi,
            product=product, on_ethercat=is_ethercat,
        )  # fmt: skip
        try:
            device = find_device(str(folder))
            device.preset(chosen)
            if is_ethercat:
                sii_content(device)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)  # an existing folder would be refused the next time
            raise
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
        serve = f"drive-env serve {folder}" + (" --interface ethercat --channel veth1" if is_ethercat else "")
        print(f"\n{folder} is written, this list as {folder / LIST_NAME}; serve it: {serve}")
