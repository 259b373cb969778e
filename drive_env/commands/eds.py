"""`drive-env eds`: the electronic data sheet of an emulated device, for other CANopen masters."""

from __future__ import annotations

from typing import Annotated

import typer

from drive_env.commands.options import errors_as_exit_codes
from drive_env.commands.tables import print_text


def print_eds(
    device: Annotated[str, typer.Argument(help="Drive by name (drive-env list devices), or by its path.")],
) -> None:
    """Print the EDS of a device: drive-env eds tmcm1636_fw109 > drive.eds."""
    from drive_env.devices import find_device
    from drive_env.dictionary.entries import eds_text

    with errors_as_exit_codes():
        print_text(eds_text(find_device(device).eds))
