"""Options, target, progress and exit codes shared by the commands of `drive-tune`."""

from __future__ import annotations

import inspect
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NoReturn, Self

import typer

from drive_env.commands.options import INTERRUPTED as INTERRUPTED
from drive_env.commands.options import REFUSED as REFUSED
from drive_env.commands.options import USER_ERROR as USER_ERROR
from drive_env.commands.options import Bitrate as Bitrate
from drive_env.commands.options import Channel as Channel
from drive_env.commands.options import DeviceName as DeviceName
from drive_env.commands.options import Interface as Interface
from drive_env.commands.options import Json as Json
from drive_env.commands.options import Nodes as Nodes
from drive_env.commands.options import WouldDo as WouldDo
from drive_env.commands.options import Yes as Yes
from drive_env.commands.options import ask as ask
from drive_env.commands.options import ending_by, file_names_a_bus, grouped, names_a_bus, options_of, with_options
from drive_env.commands.options import look_first as look_first
from drive_env.commands.options import print_json as print_json
from drive_env.commands.options import print_result as print_result
from drive_env.commands.progress import progress_on
from drive_env.default_device import DEFAULT_DEVICE

if TYPE_CHECKING:
    from drive_env.loops.dynamics import Dynamics
    from tuning.runs.inputs import Input
    from tuning.snapshot import Transaction
    from tuning.target import Target

# Packages that take long to import (the compiler, MuJoCo, matplotlib) are imported by the commands that need them.

APART = "apart"  # one of `tuning.target.AXES`
MotorName = Annotated[
    str | None,
    typer.Option(
        "--motor",
        help="Motor: a name of the catalogue, or the path of a TOML file; its data sheet values are used.",
        show_default="the device's usual one",
    ),
]
LoadName = Annotated[
    str, typer.Option("--load", help="Load of an emulated machine: a name, or the path of an MJCF file.")
]
ForeignEds = Annotated[Path | None, typer.Option("--eds", hidden=True)]  # of drive-env; refused here, with a remedy
DYNAMICS = (
    "What the outer loops must keep: soft (60 degrees, 12 dB, Ms 1.5), standard (45, 8, 2.0), stiff (35, 6, 2.5), or "
    "phase margin/gain margin/Ms as 50/10/1.8."
)
DynamicsOption = Annotated[str | None, typer.Option("--dynamics", help=DYNAMICS, show_default="standard")]
InertiaRangeOption = Annotated[
    str | None,
    typer.Option(
        "--inertia-range",
        help="Load inertia that the tuned axis must bear with weaker margins, over that of tuning: LOW/HIGH.",
        show_default="0.5/2",
    ),
]
Seed = Annotated[int, typer.Option("--seed", help="Seed of all random numbers, 0 or more.")]
Out = Annotated[Path | None, typer.Option("--out", help="Folder for the results, new or empty.")]
Bus = Annotated[
    bool,
    typer.Option(
        "--bus",
        help="Use the drives on a bus, inside the safety envelope; --interface, --channel, --node, --bitrate and "
        "--lockstep imply it. Environment variables do not.",
    ),
]
Lockstep = Annotated[
    bool, typer.Option("--lockstep", help="Time passes by SYNC only, for an emulator that is served with --lockstep.")
]
Supply = Annotated[
    float | None, typer.Option("--supply", help="Supply voltage at the drive [V].", show_default="the motor's")
]
TravelRange = Annotated[
    str | None,
    typer.Option(
        "--travel",
        help="How far the rotor may turn from its present position [turns]: LOW:HIGH, e.g. -0.15:0.15, or free; one "
        "for "
        "all axes, or one for each with commas between. Required on a bus; an emulated load has its own.",
    ),
]
Axes = Annotated[
    str,
    typer.Option(
        "--axes",
        help="For several nodes on a bus, how their axes are coupled: apart (separate machines), coupled (joints of "
        "one machine, moved one after the other) or linked (they drive one part, as both ends of a gantry, and "
        "are moved together). Known for an emulated load.",
    ),
]
ChosenAxis = Annotated[
    list[int] | None,
    typer.Option(
        "--axis",
        help="Axis of nodes with several that is tuned, from 0; may be repeated. The others are never enabled, and "
        "keep their parameters.",
        show_default="all",
    ),
]
Machines = Annotated[
    int | None,
    typer.Option("--machines", help="Number of emulated machines.", show_default="1; 8 for a search by trials"),
]
Randomise = Annotated[bool, typer.Option("--randomise", help="Draw random parameters for every machine.")]
Workers = Annotated[
    int | None,
    typer.Option(
        "--workers", help="Worker processes on this computer.", show_default="this process, with one thread per core"
    ),
]
Cluster = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        help="Run on the workers of this Dask scheduler: tcp://host:port, or tls://host:port followed by "
        "?ca=FILE&cert=FILE&key=FILE.",
    ),
]
Resume = Annotated[bool, typer.Option("--resume", help="Continue a stopped run with the same --out.")]


@dataclass(frozen=True, kw_only=True)
class DriveOptions:
    """The options that name a drive, emulated or on a bus; `takes` adds them to a command."""

    PANEL: ClassVar[str] = "Which drive"
    bus: Bus = False
    device: DeviceName = DEFAULT_DEVICE
    eds: ForeignEds = None
    motor: MotorName = None
    load: LoadName = "two_mass"
    seed: Seed = 0
    interface: Interface = None
    channel: Channel = None
    nodes: Nodes = None
    bitrate: Bitrate = None
    lockstep: Lockstep = False
    supply: Supply = None
    travel: TravelRange = None
    axis: ChosenAxis = None
    axes: Axes = APART
    yes: Yes = False

    @property
    def motor_name(self) -> str:
        """Name of the motor; the device's usual one by default."""
        from drive_env.devices import find_device

        return find_device(self.device).default_motor if self.motor is None else self.motor

    def with_inputs(self) -> Self:
        """Return the options with the content of the user's files instead of their paths.

        Raises:
            ValueError: If a file cannot be read, as in `inputs.taken`.
        """
        from tuning.runs.inputs import taken_options

        names = {"device": self.device, "motor": self.motor}
        return replace(self, **taken_options(names if self.bus else names | {"load": self.load}))

    def inputs(self) -> list[Input]:
        """Return the user's files that `with_inputs` has read."""
        from tuning.runs.inputs import inputs_in

        return inputs_in([self.device, self.motor, self.load])

    def check(self) -> None:
        """Raise ValueError for an impossible number, or a drive with too little data."""
        check_seed(self.seed)
        if self.eds is None and self.axis and self.bus:
            from drive_env.devices import find_device
            from drive_env.drives.chosen_axes import chosen_parts

            chosen_parts(self.axis, find_device(self.device).num_axes, self.device)
        if self.eds is not None:
            raise ValueError(
                f"--eds {self.eds}: an EDS says neither which objects are gains nor in what units a drive counts, and "
                "both are needed to tune it; make it a device, a folder with this EDS and some tables, and give "
                "--device FOLDER (the page on file formats, section Device, has the list)"
            )

    def check_identifiable(self) -> None:
        """Raise ValueError for a drive that cannot be identified; called before the user is asked."""
        from drive_env.devices import find_device
        from tuning.identify.working_state import check_identifiable

        check_identifiable(find_device(self.device))

    def machine(self) -> dict[str, Any]:
        """Return the options as arguments of `tuning.target.emulated`; raises as `open_target`."""
        self.check()
        check_no_bus(self.nodes, self.bitrate, self.lockstep, self.axes)
        named = {name: getattr(self, name) for name in ("device", "load", "seed", "supply")}
        named |= {"motor": self.motor_name, "travel": None if self.travel is None else parse_travels(self.travel)}
        return named | ({"chosen": list(self.axis)} if self.axis else {})

    def open(self) -> Target:
        """Open the drives, after the user has agreed that a motor on a bus turns; raises as `open_target`."""
        self.check()  # before the user is asked
        if self.bus and self.travel is not None:
            ask_to_turn(self.nodes, self.yes, self.interface, self.axis)
        return open_target(self)

    def open_to_read(self) -> Target:
        """Open the drives for a dry run, without asking; raises as `open_target`, and if a node does not answer."""
        self.check()
        if self.bus:
            look_first(self.interface, self.channel, self.nodes, self.bitrate, self.device)
        return open_target(self)


@dataclass(frozen=True, kw_only=True)
class TargetOptions(DriveOptions):
    """`DriveOptions`, and the number of emulated machines."""

    machines: Machines = None
    randomise: Randomise = False

    @property
    def count(self) -> int:
        """Number of emulated machines, 1 by default."""
        return 1 if self.machines is None else self.machines

    def check(self) -> None:
        """Raise ValueError for an impossible number or an insufficiently described drive."""
        super().check()
        check_machines("--machines", self.count)

    def machine(self) -> dict[str, Any]:
        """Return the options as arguments of `tuning.target.emulated`; raises as `open_target`."""
        return super().machine() | {"num_machines": self.count, "randomise": self.randomise}


def takes(command: Callable[..., None]) -> Callable[..., None]:
    """Add to a command the fields of its dataclasses as options, its own and those of its argument `drive`.

    An option of a bus selects drives on the bus.
    """
    run = grouped(command)
    shared = {p.name for p in options_of(inspect.signature(command, eval_str=True).parameters["drive"].annotation)}
    options = inspect.signature(run).parameters.values()

    @wraps(command)
    def run_on(context: typer.Context, **given: Any) -> None:
        given["bus"] |= names_a_bus(context)
        if file_names_a_bus(context) and not given["bus"]:
            fail("--config names drives on a bus; add --bus to use them, and their motors turn")
        run(**given)

    context = inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
    return with_options(run_on, [context, *sorted(options, key=lambda p: p.name in shared)])


def parse_travel(text: str) -> tuple[float, float]:
    """Convert LOW:HIGH in turns, or `free`, to angles [rad].

    Raises:
        ValueError: For any other text.
    """
    if text == "free":
        return -math.inf, math.inf
    low, colon, high = text.partition(":")
    try:
        if not colon:
            raise ValueError(text)
        ends = float(low) * 2.0 * math.pi, float(high) * 2.0 * math.pi
    except ValueError:
        raise ValueError(f"--travel {text} must be LOW:HIGH in turns, e.g. -0.15:0.15, or free") from None
    if not ends[0] <= 0.0 <= ends[1] or not ends[0] < ends[1]:
        raise ValueError(
            f"--travel {text} must contain 0, where the rotor is now, and must not be empty; give the free way to both "
            "sides"
        )
    return ends


def parse_travels(text: str) -> tuple[float, float] | list[tuple[float, float]]:
    """Convert travel to angles [rad]: one range for all rotors, or one for each, separated by commas.

    Raises:
        ValueError: For any other text.
    """
    ways = [parse_travel(part.strip()) for part in text.split(",")]
    return ways[0] if len(ways) == 1 else ways


def check_seed(seed: int) -> None:
    """Raise ValueError for a seed below 0."""
    if seed < 0:
        raise ValueError(f"--seed must be 0 or more, not {seed}")


def check_machines(option: str, machines: int) -> None:
    """Raise ValueError for an impossible number of emulated machines."""
    from drive_env.emulator.emulated_drives import MOST_MACHINES

    if not 1 <= machines <= MOST_MACHINES:
        raise ValueError(
            f"{option} must be {'1 or more' if machines < 1 else f'{MOST_MACHINES} at most'}, not {machines}"
        )


def check_no_bus(nodes: list[int] | None, bitrate: int | None, lockstep: bool, axes: str = APART) -> None:
    """Raise ValueError for options of a bus without --bus.

    Interface and channel may come from the environment: alone they do not select the bus, so that no motor turns
    unexpectedly.
    """
    if nodes or bitrate is not None or lockstep:
        raise ValueError("--node, --bitrate and --lockstep are for drives on a bus; add --bus, or leave them out")
    if axes != APART:
        raise ValueError(
            f"--axes {axes} is for drives on a bus; add --bus, or leave it out (an emulated load has its own coupling)"
        )


def ask_to_turn(
    nodes: list[int] | None, yes: bool, interface: str | None = None, axes: list[int] | None = None
) -> None:
    """Continue if the user agrees that the motors on a bus turn; raises as `ask`."""
    from drive_env.master.open_drives import default_nodes

    which = f"node {', '.join(map(str, nodes or default_nodes(interface)))}"
    if axes:
        which = f"axis {', '.join(map(str, sorted(set(axes))))} of {which}"
    ask(f"The motor of {which} will turn. Is its way clear?", yes)


def open_target(drive: DriveOptions) -> Target:
    """Open the drives of a command's options, on a bus or emulated, without asking.

    Raises:
        ValueError: For an unknown name, or a bus without a travel.
        BusError: If a node does not answer, or another master commands it.
    """
    from drive_env.commands.scope import refuse_other_masters
    from tuning.target import LOCKSTEP_PATIENCE, emulated, on_bus

    drive.check()
    inputs = tuple(drive.with_inputs().inputs())  # opened by path: the state before names the device for `undo`
    if not drive.bus:
        return replace(emulated(**drive.machine()), inputs=inputs)
    if drive.travel is None:
        raise ValueError("--travel is missing: give how far the motor may turn, LOW:HIGH in turns, or free")
    options: dict[str, Any] = {} if drive.bitrate is None else {"bitrate": drive.bitrate}
    if drive.lockstep:
        options |= {"pace": "lockstep", "timeout": LOCKSTEP_PATIENCE}
    # Two tuners would receive each other's answers, and the second would save the first one's trial as the state
    # before.
    refuse_other_masters(drive.interface, drive.channel, drive.nodes, drive.bitrate)
    target = on_bus(
        drive.device,
        drive.motor_name,
        interface=drive.interface,
        channel=drive.channel,
        nodes=drive.nodes or None,
        supply=drive.supply,
        travel=parse_travels(drive.travel),
        axes=drive.axes,
        chosen=drive.axis or None,
        **options,
    )
    return replace(target, inputs=inputs)


def asked_dynamics(dynamics: str | None, device: str, inertia_range: str | None = None) -> Dynamics:
    """Return the dynamics that options ask for, standard ones by default.

    Raises:
        ValueError: For unknown dynamics, or any dynamics for a drive without a linear model, such as a stepper's.
    """
    from drive_env.devices import find_device
    from drive_env.devices.gains import has_linear_model
    from drive_env.loops.dynamics import DEFAULT, find_dynamics

    found = find_dynamics(DEFAULT if dynamics is None else dynamics, inertia_range)
    if (dynamics or inertia_range) and not has_linear_model(find_device(device)):
        option = "--dynamics" if dynamics else "--inertia-range"
        raise ValueError(
            f"{option} asks for margins of loops, and {device} has no linear model of its loops; leave {option} out"
        )
    return found


def file_of(drive: DriveOptions, kind: str, out: Path | None = None) -> Path | None:
    """Return the file for the state before of drives on a bus, None for emulated ones; raises as `file_before`."""
    if not drive.bus:
        return None
    from tuning.snapshot import file_before

    return file_before(kind, out)


@contextmanager
def unchanged(drive: DriveOptions, file: Path | None) -> Iterator[tuple[Target, Transaction | None]]:
    """Open drives and save their state before to a file, if one is given; restore uncommitted changes at the end."""
    from tuning.snapshot import Transaction
    from tuning.way_back import way_back

    with (
        way_back(file, "drive-tune"),
        drive.open() as target,
        nullcontext() if file is None else Transaction(target, file) as transaction,
    ):
        yield target, transaction


def before_as_json(file: Path | None) -> dict[str, str]:
    """Return the JSON entry for the file with the state before; empty without one."""
    return {} if file is None else {"before": str(file)}


def tell_before(file: Path | None) -> None:
    """Print the differences of a bus' drives from their state before, and the command that restores it."""
    if file is not None:
        from tuning.way_back import what_is_changed

        print(what_is_changed(file))


@contextmanager
def errors_as_exit_codes() -> Iterator[None]:
    """End with one line: exit code 1 for errors of drive or bus, 2 for the user's mistake, 130 for Ctrl-C."""
    from drive_env.fieldbus.errors import BusError, RefusedError
    from drive_env.safety.envelope import SafetyError
    from tuning.runs.pools import PoolError

    with ending_by(fail, refused=(SafetyError, BusError, RefusedError, PoolError, TimeoutError)):
        yield


@contextmanager
def progress_bar(description: str) -> Iterator[Callable[[float], None]]:
    """Show a progress bar on stderr; the yielded function takes the share that is done, 0 to 1."""
    from rich.console import Console

    with progress_on(Console(stderr=True), transient=True) as progress:
        task = progress.add_task(description, total=1.0)
        yield lambda share: progress.update(task, completed=share)


def fail(error: object, code: int = USER_ERROR) -> NoReturn:
    """End the command with a line on stderr."""
    from tuning.runs.inputs import as_given

    print(f"drive-tune: {as_given(str(error))}", file=sys.stderr)
    raise typer.Exit(code)


def what_an_interrupt_leaves(folder: Path) -> str:
    """Return the message of an interrupted run, with the command that resumes it if one can."""
    from tuning.runs import unfinished

    if unfinished.unfinished_folder(folder).exists():
        return f"interrupted; the completed part is kept; continue with --out {folder} --resume"
    return "interrupted; nothing was written"
