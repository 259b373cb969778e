"""`drive-env esi`: the EtherCAT slave information of an emulated device, for EtherCAT configurators."""

from __future__ import annotations

from typing import Annotated

import typer

from drive_env.commands.options import errors_as_exit_codes
from drive_env.commands.tables import print_text


def print_esi(
    device: Annotated[str, typer.Argument(help="Drive by name (drive-env list devices), or by its path.")],
) -> None:
    """Print the ESI of a device, an XML file: drive-env esi tmcm3313 > drive.xml."""
    from drive_env.devices import find_device
    from drive_env.ethercat.esi import esi_text

    with errors_as_exit_codes():
        print_text(esi_text(find_device(device)))
