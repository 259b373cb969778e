"""`drive-env export`: files for other programs: EDS, DCF and ESI to describe a drive, FMU to simulate it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from drive_env.commands.options import (
    AxisOfNode,
    DeviceName,
    Eds,
    NodeOptions,
    check_free,
    errors_as_exit_codes,
    grouped,
    names_a_bus,
)
from drive_env.commands.program import answer_old_name
from drive_env.commands.tables import print_text
from drive_env.default_device import DEFAULT_DEVICE

KBIT = 1000  # bit/s

File = Annotated[Path, typer.Argument(help="New file; - prints it.", show_default=False)]


class ExportGroup(TyperGroup):
    """The commands; it answers `drive-env export FILE` with the new names, for one version."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the command line."""
        has_file = any(one.lower().endswith((".eds", ".dcf")) for one in args)
        if has_file and not self.commands.keys() & set(args) and not ctx.resilient_parsing:
            answer_old_name("drive-env", "export FILE", "drive-env export eds|dcf FILE")
        return super().parse_args(ctx, args)


export_app = typer.Typer(cls=ExportGroup, no_args_is_help=True, rich_markup_mode="markdown")


@export_app.callback()
def export() -> None:
    """Files by which others know a drive, EDS and DCF of CANopen, ESI of EtherCAT; or simulate it: FMU."""


@dataclass(frozen=True, kw_only=True)
class CommissionedOptions(NodeOptions):
    """Options of a commissioned drive, on a bus or emulated."""

    axis: AxisOfNode = None
    eds: Eds = None
    motor: Annotated[str | None, typer.Option("--motor", help="Motor that an emulated drive is commissioned for.")] = (
        None
    )


@export_app.command("eds")
@grouped
def export_eds(context: typer.Context, file: File, *, drive: CommissionedOptions) -> None:
    """Write the EDS of a device; or of a commissioned drive, whose values are the defaults then.

    Values are those of the drive on the bus that --interface, --channel, --node or --bitrate names (nothing is written
    to it), or of an emulated drive with --motor or --axis. With --axis the values of one axis and of the node are
    written, and all other axes keep what the EDS says.
    """
    from drive_env.devices import find_device
    from drive_env.dictionary.entries import eds_text
    from drive_env.ethercat.sii_content import described

    with errors_as_exit_codes():
        _check_name(file, ".eds")
        if names_a_bus(context) or (drive.eds, drive.motor, drive.axis) != (None, None, None):
            _write_commissioned(context, file, drive, node_id=None)
        else:
            device = find_device(drive.device)
            own, other = ([(one.index, one.sub) for one in of.new_dictionary()] for of in (device, described(device)))
            # For the same objects there is one file, the maker's.
            _write(file, eds_text((described(device) if own == other else device).eds), f"EDS of {drive.device}")


@export_app.command("dcf")
@grouped
def export_dcf(context: typer.Context, file: File, *, drive: CommissionedOptions) -> None:
    """Write the DCF of a drive: its EDS with the commissioned values, node-ID and bit rate of this node.

    It is the drive on the bus that --interface, --channel, --node or --bitrate names (nothing is written to it), else
    an emulated one, without --motor with the device's usual motor. --axis is as of `export eds`.
    """
    with errors_as_exit_codes():
        _check_name(file, ".dcf")
        _write_commissioned(context, file, drive, node_id=(drive.nodes or [1])[0])


@export_app.command("esi")
def export_esi(file: File, device: DeviceName) -> None:
    """Write the ESI of a device, an XML file for EtherCAT configurators."""
    from drive_env.devices import find_device
    from drive_env.ethercat.esi import esi_text

    with errors_as_exit_codes():
        _check_name(file, ".xml")
        _write(file, esi_text(find_device(device)), f"ESI of {device}")


@export_app.command("fmu")
def export_drive(
    device: Annotated[str, typer.Argument(help="Device by name, or your own by its path.")] = DEFAULT_DEVICE,
    load: Annotated[
        str, typer.Option(help="Load by name, or the path of an MJCF; none: other mechanics are on the shaft.")
    ] = "two_mass",
    motor: Annotated[
        str | None, typer.Option(help="Motor, a name or a TOML file; the device's usual one by default.")
    ] = None,
    fmi: Annotated[int, typer.Option(help="Version of FMI, 2 or 3.")] = 3,
    *,
    out: Annotated[Path, typer.Option(help="New file, NAME.fmu; the model has that name.")],
) -> None:
    """Write an FMU for co-simulation: an emulated drive with its motor and its load, commissioned.

    The program that loads it needs drive-env in its Python. Inputs and outputs are in docs/how-to/fmu.md.
    """
    from drive_env.fmu.export import export_fmu

    with errors_as_exit_codes():
        check_free(out)
        export_fmu(out, device, load, motor, fmi=fmi)
        print(f"{out}: {device} with load {load}, an FMU of FMI {fmi}")


def _write_commissioned(context: typer.Context, file: Path, drive: CommissionedOptions, node_id: int | None) -> None:
    """Write the EDS of a commissioned drive, or with a node-ID its DCF.

    Raises:
        ValueError: For an EDS without a bus, and an axis that the drive does not have.
    """
    from drive_env.devices import find_device
    from drive_env.drives.chosen_axes import chosen_parts
    from drive_env.master.commissioned_eds import CAN_KBIT, commissioned_eds, commissioned_values, own_bit_rate

    axis, eds, device, kbit = drive.axis, drive.eds, drive.device, None
    if names_a_bus(context):
        with drive.connect(eds, safety=False) as drives:
            if axis is not None:
                chosen_parts([axis], drives.description.num_axes, drives.description.name)
            values = commissioned_values(drives, axis=axis)
            source, whose = drives.description.dictionary.path, drives.description.name
            kbit = own_bit_rate(drives) if drive.bitrate is None else drive.bitrate // KBIT
    else:
        if eds is not None:
            raise ValueError(
                f"--eds {eds} is of a drive on a bus, and no bus is named; give --interface and --channel, or make "
                f"a device of it (drive-env new --eds {eds}) and name that as --device"
            )
        from drive_env.emulator.emulated_drives import EmulatedDrives

        known = find_device(device)
        if axis is not None:
            chosen_parts([axis], known.num_axes, device)
        source, whose = known.eds, device
        with EmulatedDrives(device, "inertia", drive.motor, num_machines=known.num_axes, num_threads=1) as emulated:
            values = commissioned_values(emulated, axis=axis)
    name = source.name if str(file) == "-" else file.name
    text = commissioned_eds(source, values, name, node_id=node_id, bit_rate=kbit or CAN_KBIT)
    node = "" if node_id is None else f", as node {node_id} at {kbit or CAN_KBIT} kbit/s"
    part = "" if axis is None else f", axis {axis} alone"
    _write(file, text, f"{len(values)} parameters of {whose}{node}{part}")


def _check_name(file: Path, ending: str) -> None:
    """Raise ValueError for a file of another kind, or one that exists already; - is the standard output."""
    if str(file) == "-":
        return
    if file.suffix.lower() != ending:
        raise ValueError(f"{file} must end with {ending}, or be - for the standard output")
    check_free(file)


def _write(file: Path, text: str, said: str) -> None:
    from drive_env.whole_file import write_whole

    if str(file) == "-":
        print_text(text)
    else:
        write_whole(file, text)
        print(f"{file}: {said}")
