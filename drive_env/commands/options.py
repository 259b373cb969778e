"""Options, connection and exit codes that the commands of `drive-env` share."""

from __future__ import annotations

import inspect
import json
import re
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NoReturn, get_type_hints

import typer

from drive_env.commands.tables import print_lines
from drive_env.default_device import DEFAULT_DEVICE
from drive_env.programs import CLOSED, output_is_closed

if TYPE_CHECKING:
    from drive_env.dictionary.entries import Entry, ObjectDictionary, ObjectName
    from drive_env.dictionary.quantities import Scale
    from drive_env.fieldbus.description import Description
    from drive_env.master.bus_drives import BusDrives

REFUSED, USER_ERROR, INTERRUPTED = 1, 2, 130
AXIS_CYCLE = 0.001  # s on a bus of 1 Mbit/s for each axis of a node: seven frames

Interface = Annotated[
    str | None,
    typer.Option(
        "--interface",
        "-i",
        envvar="DRIVE_ENV_INTERFACE",
        help="python-can interface: socketcan, pcan, slcan, ...; or ethercat, ethercat-udp.",
    ),
]
Channel = Annotated[
    str | None,
    typer.Option(
        "--channel",
        "-c",
        envvar="DRIVE_ENV_CHANNEL",
        help="Channel: can0, or socket://127.0.0.1:PORT of `drive-env serve` (its token, if any, in DRIVE_ENV_TOKEN); "
        "eth1 or a UDP port on EtherCAT.",
    ),
]
Bitrate = Annotated[int | None, typer.Option(help="Bit rate [bit/s], if the interface sets it.")]
FIRST_NODE = "1; position 0"
Nodes = Annotated[
    list[int] | None,
    typer.Option(
        "--node", "-n", help="Node-ID, on EtherCAT the position; may be repeated.",
        show_default=FIRST_NODE,
    ),
]  # fmt: skip
OneNode = Annotated[
    list[int] | None,  # a list, so that a second one is refused instead of replacing the first
    typer.Option(
        "--node", "-n", metavar="<int>", help="Node-ID, on EtherCAT the position.", show_default=FIRST_NODE,
    ),
]  # fmt: skip
AxisOfNode = Annotated[
    int | None,
    typer.Option("--axis", help="Axis of nodes with several, from 0.", show_default="all that have the object"),
]
OneAxis = Annotated[
    list[int] | None,  # as of OneNode
    typer.Option("--axis", metavar="<int>", help="Axis of a node with several, from 0.", show_default="0"),
]
AxesInOrder = Annotated[
    list[int] | None,
    typer.Option(
        "--axis", help="Axis of a node with several, from 0; may be repeated, in the order wanted.", show_default="0"
    ),
]
DeviceName = Annotated[
    str, typer.Option("--device", help="Device by name, or your own by its path: a folder, or a variant's .toml.")
]
Eds = Annotated[Path | None, typer.Option("--eds", help="EDS of any other CiA 402 drive, instead of --device.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Print the frames instead of sending them.")]
WouldDo = Annotated[
    bool, typer.Option("--dry-run", help="Read the drive and print what would be done; change nothing.")
]
Timeout = Annotated[
    float | None,
    typer.Option(envvar="DRIVE_ENV_TIMEOUT", help="Longest wait for an answer [s].", show_default="the device's, 0.5"),
]
Yes = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask for confirmation.")]

_INDEX = re.compile(r"^(?:0x)?([0-9a-f]{4})h?(?:[:.]([0-9a-f]{1,2})h?)?$", re.IGNORECASE)


# Each of these options selects drives on a bus.
OF_A_BUS = ("interface", "channel", "node", "nodes", "bitrate", "lockstep")


def was_typed(context: typer.Context, name: str) -> bool:
    """Return whether an option is on the command line: one from the environment must not start a motor."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def names_a_bus(context: typer.Context) -> bool:
    """Return whether the command line names a bus or a node of it."""
    return any(was_typed(context, name) for name in OF_A_BUS)


def file_names_a_bus(context: typer.Context) -> bool:
    """Return whether a file of options names a bus or a node of it, and the command line does not override it."""
    sources = (context.get_parameter_source(name) for name in OF_A_BUS)
    return any(source is not None and source.name == "DEFAULT_MAP" for source in sources)


def object_name(text: str) -> ObjectName:
    """Return the dictionary's form of an object name: 6041, 607D:1 (hexadecimal) or a name."""
    found = _INDEX.match(text.strip())
    if found is None:
        return text
    return int(found[1], 16), int(found[2] or "0", 16)


@dataclass(frozen=True, kw_only=True)
class BusOptions:
    """Options that name drives on a bus; `grouped` replaces a command's argument of this class by its options."""

    PANEL: ClassVar[str] = "Which drive"
    interface: Interface = None
    channel: Channel = None
    device: DeviceName = DEFAULT_DEVICE
    bitrate: Bitrate = None
    timeout: Timeout = None

    @property
    def nodes(self) -> list[int] | None:
        """The named nodes; None for the first."""
        return None

    def connect(self, eds: Path | None = None, **others: Any) -> BusDrives:
        """Open the drives, of a device or an EDS; `others` as for `open_drives`."""
        from drive_env.master.open_drives import open_drives

        if self.bitrate is not None:
            others["bitrate"] = self.bitrate
        return open_drives(
            self.device, eds=eds, interface=self.interface, channel=self.channel, nodes=self.nodes,
            timeout=self.timeout, **others,
        )  # fmt: skip

    def look_first(self, eds: Path | None = None) -> None:
        """Raise NoAnswerError for a node on CAN that is silent, as the function `look_first` does."""
        look_first(self.interface, self.channel, self.nodes, self.bitrate, self.device, eds, self.timeout)


@dataclass(frozen=True, kw_only=True)
class NodesOptions(BusOptions):
    """Options that name several nodes on a bus."""

    node: Nodes = None

    @property
    def nodes(self) -> list[int] | None:
        """The named nodes; None for the first."""
        return self.node or None


@dataclass(frozen=True, kw_only=True)
class AxesOptions(NodesOptions):
    """Options that name axes of several nodes on a bus."""

    axis: AxisOfNode = None


@dataclass(frozen=True, kw_only=True)
class NodeOptions(BusOptions):
    """Options that name one node on a bus."""

    node: OneNode = None

    @property
    def nodes(self) -> list[int] | None:
        """The named node; None for the first. ValueError for several."""
        if len(self.node or ()) > 1:
            raise ValueError(
                f"--node {' --node '.join(map(str, self.node or ()))}: this command is of one node; run it once for "
                "each, or move the axes of one machine together from Python"
            )
        return self.node or None

    @property
    def number(self) -> int:
        """The named node, or the first."""
        from drive_env.master.open_drives import default_nodes

        return (self.nodes or default_nodes(self.interface))[0]


@dataclass(frozen=True, kw_only=True)
class AxisOptions(NodeOptions):
    """Options that name one axis of one node on a bus."""

    axis: OneAxis = None

    @property
    def one_axis(self) -> int:
        """The named axis, or the first. ValueError for several."""
        if len(self.axis or ()) > 1:
            raise ValueError(
                f"--axis {' --axis '.join(map(str, self.axis or ()))}: this command is of one axis; run it once for "
                "each, or move the axes of one machine together from Python"
            )
        return (self.axis or [0])[0]


@dataclass(frozen=True, kw_only=True)
class AxesInOrderOptions(NodeOptions):
    """Options that name axes of one node, in an order."""

    axis: AxesInOrder = None

    @property
    def axes(self) -> list[int]:
        """The named axes, in their order, or the first."""
        return self.axis or [0]


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Replace each argument of a command that is a dataclass by options for its fields."""
    own = inspect.signature(command, eval_str=True).parameters
    kinds = {name: p.annotation for name, p in own.items()}
    groups = {name: kind for name, kind in kinds.items() if isinstance(kind, type) and is_dataclass(kind)}
    taken = []
    for name, parameter in own.items():
        if name in groups:
            taken += options_of(groups[name])
        else:
            taken.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))

    @wraps(command)
    def run(**given: Any) -> None:
        for name, group in groups.items():
            given[name] = group(**{f.name: given.pop(f.name) for f in fields(group)})
        command(**given)

    return with_options(run, taken)


def options_of(group: type[Any]) -> list[inspect.Parameter]:
    """Return the options for the fields of a dataclass; `--help` shows them under its `PANEL`."""
    hints = get_type_hints(group, include_extras=True)
    for field in fields(group):
        for option in getattr(hints[field.name], "__metadata__", ()):
            option.rich_help_panel = group.PANEL
    return [
        inspect.Parameter(f.name, inspect.Parameter.KEYWORD_ONLY, default=f.default, annotation=hints[f.name])
        for f in fields(group)
    ]


def with_options(run: Callable[..., None], taken: list[inspect.Parameter]) -> Callable[..., None]:
    """Return a function with these options for typer."""
    run.__signature__ = inspect.Signature(taken)  # type: ignore[attr-defined]  # what typer reads
    run.__annotations__ = {p.name: p.annotation for p in taken}
    return run


def look_first(
    interface: str | None,
    channel: str | None,
    nodes: Iterable[int] | None,
    bitrate: int | None,
    device: str,
    eds: Path | None = None,
    timeout: float | None = None,
) -> None:
    """Raise NoAnswerError for a silent node on CAN, without the NMT command that opening drives would send."""
    from drive_env.fieldbus.errors import NoAnswerError
    from drive_env.master.open_drives import check_answers

    named = {"interface": interface, "channel": channel, "nodes": nodes, "bitrate": bitrate}
    try:
        check_answers(device, eds=eds, timeout=timeout, **named)
    except NoAnswerError as error:
        raise NoAnswerError(
            f"{error}; if it is in the NMT state stopped, a run without --dry-run takes it to pre-operational"
        ) from None


@contextmanager
def errors_as_exit_codes() -> Iterator[None]:
    """End with one red line: code 1 for an error of a drive or the bus, 2 for the user's mistake, 130 for Ctrl-C."""
    from drive_env.fieldbus.errors import BusError, RefusedError
    from drive_env.safety.envelope import SafetyError

    with ending_by(fail, refused=(RefusedError, SafetyError, BusError, TimeoutError)):
        yield


@contextmanager
def ending_by(
    fail: Callable[[object, int], NoReturn],
    *,
    refused: tuple[type[Exception], ...],
    mistakes: tuple[type[Exception], ...] = (),
) -> Iterator[None]:
    """End a program by its own `fail`, called with the message and the exit code.

    Args:
        fail: Ends the program.
        refused: Errors with exit code 1, in addition to a plain RuntimeError; a bus that cannot be opened is a mistake.
        mistakes: Errors with exit code 2, in addition to ValueError, errors of objects and of files.
    """
    from drive_env.dictionary.aborts import ObjectAccessError
    from drive_env.fieldbus.errors import OpenError

    mistaken: tuple[type[Exception], ...] = (ObjectAccessError, ValueError, *mistakes)
    try:
        yield
    except OpenError as error:
        fail(error, USER_ERROR)
    except refused as error:
        fail(error, REFUSED)
    except mistaken as error:
        fail(error, USER_ERROR)
    except RuntimeError as error:  # motion.py: an axis is in fault; `ask`: the user says no
        if type(error) is not RuntimeError:
            raise
        fail(error, REFUSED)
    except OSError as error:
        if isinstance(error, BrokenPipeError) and output_is_closed():
            raise typer.Exit(CLOSED) from None  # `| head -1` has read enough: neither an error nor a message
        fail(f"{error.filename}: {error.strerror}" if error.filename else error, USER_ERROR)
    except MemoryError as error:
        fail(f"there is not enough memory{f' ({error})' if str(error) else ''}; ask for less at a time", USER_ERROR)
    except KeyboardInterrupt:
        fail("interrupted", INTERRUPTED)


@contextmanager
def told_if_interrupted(what: str) -> Iterator[None]:
    """Print the written files if Ctrl-C ends a block before the command has printed them."""
    try:
        yield
    except KeyboardInterrupt:
        print(f"drive-env: {what}", file=sys.stderr)
        raise


def fail(error: object, code: int) -> NoReturn:
    """End the command with a red line."""
    typer.secho(f"drive-env: {error}", fg=typer.colors.RED, err=True)
    raise typer.Exit(code)


def print_result(value: Any, lines: Iterable[str], json: bool) -> None:
    """Print the result of a command: its value as JSON, or its lines for a reader."""
    if json:
        print_json(value)
    else:
        print_lines(lines)


def print_json(value: Any) -> None:
    """Print a value as JSON on one line."""
    print(json.dumps(value, ensure_ascii=False, default=_plain))
    sys.stdout.flush()


def check_time(option: str, value: float | None) -> None:
    """Raise ValueError for a time [s] that is not above 0, infinite, or not a number; None is accepted."""
    from drive_env.drives.arguments import LONGEST

    if value is not None and not 0.0 < value <= LONGEST:
        raise ValueError(f"{option} {value:g} s must be above 0 s, and {LONGEST:g} s at most")


def check_free(file: Path, remedy: str = "choose another file") -> None:
    """Raise ValueError for a file that exists already: no command replaces one. /dev/null and the like may exist.

    Call it before anything that takes long or uses a drive.
    """
    if file.is_file():
        raise ValueError(f"{file} exists already, and files are not overwritten; {remedy}")


def check_writable(file: Path) -> None:
    """Raise ValueError for a file that could not be written; call it before a motor turns."""
    if file.exists() and not file.is_file():
        return  # a device
    try:
        with tempfile.NamedTemporaryFile(dir=file.parent, prefix=f".{file.name}."):
            pass
    except OSError as error:
        why = (error.strerror or str(error)).lower()
        raise ValueError(f"{file} cannot be written: {why}; give another --out") from None


def ask(question: str, yes: bool) -> None:
    """Return if the user agrees; otherwise raise, and `errors_as_exit_codes` ends the program.

    Raises:
        ValueError: If there is no terminal to ask.
        RuntimeError: If the user says no.
    """
    if yes:
        return
    if not sys.stdin.isatty():
        raise ValueError(f"{question} There is no terminal to ask; confirm with --yes")
    if not typer.confirm(question):
        raise RuntimeError("nothing was changed")


def scales_of(drives: BusDrives) -> list[Scale]:
    """Return the scale of every axis' units, as far as the drive reports it."""
    from drive_env.dictionary import quantities

    return quantities.scales_of(drives, drives.description.dictionary)


def default_objects(known: ObjectDictionary, names: Iterable[str]) -> list[str]:
    """Return those of a command's default objects that a drive has: a stepper's has no current."""
    return [name for name in names if known.has(object_name(name))]


def default_samples(known: ObjectDictionary, names: Iterable[str]) -> list[str]:
    """Return those of a command's default objects that a drive can send with every cycle."""
    from drive_env.dictionary.access import fits_pdo

    return [name for name in default_objects(known, names) if fits_pdo(known.find(object_name(name)), transmit=True)]


def cycle_for(known: Description) -> float | None:
    """Return a time between SYNCs [s] in which the bus has room for all axes of a node; None for a node with one."""
    return None if known.num_axes == 1 else AXIS_CYCLE * known.num_axes


def axes_of(drives: BusDrives, entry: Entry, axis: int | None) -> list[int]:
    """Return the axes of an entry: all, or the requested one, of every node.

    An object of a further axis belongs only to that axis, and an object of the node to the first axis.

    Raises:
        ValueError: For an axis that the nodes lack, or that the object does not belong to.
    """
    known, key = drives.description, (entry.index, entry.sub)
    count = known.num_axes
    chosen = axes_of_nodes(drives, axis)
    if (found := known.of_further_axes().get(key)) is not None:
        if axis not in (None, found[1]):
            raise ValueError(f"{entry.label} is an object of axis {found[1]}, not of --axis {axis}; leave --axis out")
        return [node * count + found[1] for node in range(len(drives.nodes))]
    if known.key(entry, 1) == key:
        return [node * count for node in range(len(drives.nodes))]
    return chosen


def axes_of_nodes(drives: BusDrives, axis: int | None) -> list[int]:
    """Return all axes, or the requested one, of every node; ValueError for one that the nodes lack."""
    count = drives.description.num_axes
    if axis is not None and not 0 <= axis < count:
        raise ValueError(f"--axis {axis}: a {drives.description.name} has {count} axes, from 0")
    parts = range(count) if axis is None else [axis]
    return [node * count + part for node in range(len(drives.nodes)) for part in parts]


def axis_name(drives: BusDrives, axis: int) -> str:
    """Return an axis' name for a line: its node and, of a node with several, its number in the node."""
    node, part = divmod(axis, drives.description.num_axes)
    return f"node {drives.nodes[node]}" + (f" axis {part}" if drives.description.num_axes > 1 else "")


def axis_place(drives: BusDrives, axis: int) -> dict[str, Any]:
    """Return an axis' place for JSON, as `axis_name` does for a line."""
    node, part = divmod(axis, drives.description.num_axes)
    return {"node": drives.nodes[node]} | ({"axis": part} if drives.description.num_axes > 1 else {})


def _plain(value: Any) -> Any:
    if hasattr(value, "item"):
        return value.item()
    if hasattr(value, "tolist"):
        return value.tolist()
    return str(value)
