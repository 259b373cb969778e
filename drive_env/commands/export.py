"""`drive-env export`: EDS and DCF of a drive as it is commissioned."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from drive_env.commands.options import (
    AxisOfNode,
    Eds,
    NodeOptions,
    check_free,
    errors_as_exit_codes,
    grouped,
    names_a_bus,
)

KBIT = 1000  # bit/s


@grouped
def export(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(help="New file, .eds or .dcf.", show_default=False)],
    dcf: Annotated[bool, typer.Option("--dcf", help="Write the DCF beside the EDS, too.")] = False,
    *,
    bus: NodeOptions,
    axis: AxisOfNode = None,
    eds: Eds = None,
    motor: Annotated[
        str | None,
        typer.Option("--motor", help="Of an emulated drive: what it is commissioned for.", show_default="the device's"),
    ] = None,
) -> None:
    """Write the EDS or DCF of a drive with its commissioned values: of one on a bus, else of an emulated one.

    An EDS has them as defaults, a DCF as the values of this node; other masters (python-canopen, CANopen tools) read
    them. With --axis the values of one axis and of the node are written, and all other axes keep what the EDS says.
    With --interface, --channel, --node or --bitrate they are read from that drive; nothing is written to it.
    """
    from drive_env.devices import find_device
    from drive_env.drives.chosen_axes import chosen_parts
    from drive_env.master.commissioned_eds import CAN_KBIT, commissioned_eds, commissioned_values
    from drive_env.whole_file import write_whole

    with errors_as_exit_codes():
        if file.suffix.lower() not in (".eds", ".dcf"):
            raise ValueError(f"{file} must end with .eds or .dcf, which says what is written")
        files = [file, file.with_suffix(".dcf")] if dcf and file.suffix.lower() == ".eds" else [file]
        for one in files:
            check_free(one)
        if names_a_bus(context):
            with bus.connect(eds, safety=False) as drives:
                if axis is not None:
                    chosen_parts([axis], drives.description.num_axes, drives.description.name)
                values = commissioned_values(drives, axis=axis)
                source, whose = drives.description.dictionary.path, drives.description.name
        else:
            if eds is not None:
                raise ValueError(
                    f"--eds {eds} is of a drive on a bus, and no bus is named; give --interface and --channel, or make "
                    f"a device of it (drive-env new --eds {eds}) and name that as --device"
                )
            from drive_env.emulator.emulated_drives import EmulatedDrives

            device, known = bus.device, find_device(bus.device)
            if axis is not None:
                chosen_parts([axis], known.num_axes, device)
            source, whose = known.eds, device
            with EmulatedDrives(device, "inertia", motor, num_machines=known.num_axes, num_threads=1) as emulated:
                values = commissioned_values(emulated, axis=axis)
        part = "" if axis is None else f", axis {axis} alone"
        number = bus.node or 1
        for one in files:
            is_dcf = one.suffix.lower() == ".dcf"
            kbit = CAN_KBIT if bus.bitrate is None else bus.bitrate // KBIT
            text = commissioned_eds(source, values, one.name, node_id=number if is_dcf else None, bit_rate=kbit)
            write_whole(one, text)
            print(f"{one}: {len(values)} parameters of {whose if not is_dcf else f'{whose}, as node {number}'}{part}")
