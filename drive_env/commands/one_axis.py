"""One axis that a command moves and switches off again: plan, confirmation, stop, verdict, recording."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from drive_env import cia402
from drive_env.commands.options import NodeOptions, axis_name, default_samples, print_json, scales_of
from drive_env.commands.scope import default_names, draw, write_table
from drive_env.commands.tables import print_lines

if TYPE_CHECKING:
    from drive_env.dictionary.entries import ObjectDictionary, ObjectName
    from drive_env.dictionary.quantities import Scale
    from drive_env.drives.limits import Limits
    from drive_env.fieldbus.description import Description
    from drive_env.master.bus_drives import BusDrives

MaxCurrent = Annotated[
    str | None, typer.Option(help="Current limit, set in the drive for the movement; by default the drive's own.")
]
NoWatchdog = Annotated[
    bool,
    typer.Option(
        "--no-watchdog",
        help="Move a drive that has no watchdog over its master (neither 1016h nor 100Ch): it runs on if this process "
        "or the cable dies. Keep the emergency stop at hand.",
    ),
]
Recording = Annotated[
    Path | None, typer.Option(help="Record the movement, as scope does: new files OUT.csv and OUT.png.")
]
WATCHDOGS = (0x1016, 0x100C)  # heartbeat consumer, life guarding
POSITION = (cia402.POSITION_ACTUAL, 0)
# For each mode: the object that prevents motion if it is 0, its name, and an example value.
PROFILE = ((cia402.PROFILE_ACCELERATION, 0), "profile acceleration 6083h", "6083 '500 rev/s^2'")
ACCELERATION = {
    "pp": PROFILE,
    "pv": PROFILE,
    "vl": ((cia402.VL_ACCELERATION, 1), "acceleration 6048h:01", "6048:1 1000"),
}
BEFORE, AFTER = 0.02, 0.5  # s recorded at rest before a movement, and after its expected time
LOOK, STANDS = 0.2, 0.05  # s between two checks, and the share of the requested speed below which an axis stands
STANDSTILL = 0.05  # s for the drives to come to rest
LEAST = 0.01  # of the requested distance: an axis that moved less has not moved, one that is nearer has arrived


class MoveOutcome(NamedTuple):
    """The end of a movement: the drive's values, and the reasons of an early stop.

    Attributes:
        status: Statusword at the end of the movement, before the axis was switched off.
        reached: Position then [inc]; 0 if the drive has no position.
        end: Position after the axis was switched off [inc]; 0 if the drive has no position.
        reasons: Why the movement was stopped; [] if it was not.
        emergencies: Those of the axis, as their fields.
        trace: The requested samples; None if nothing was recorded.
    """

    status: int
    reached: int
    end: int
    reasons: list[str]
    emergencies: list[dict[str, Any]]
    trace: Any

    @property
    def errors(self) -> list[str]:
        """The emergencies that report an error, in words."""
        return [told(message) for message in self.emergencies if is_error(message)]

    def stopped(self, is_there: bool) -> str:
        """Return the reason of an early stop; "" without one. `is_there`: the axis arrived in spite of an emergency."""
        if self.errors and (self.reasons or not is_there):
            why = [", ".join(dict.fromkeys(self.errors)), *self.reasons]
            return f"the movement was stopped: emergency {'; '.join(why)}"
        return "; ".join(self.reasons)


class OneAxis:
    """The axis to move; the others of its node are left alone.

    Args:
        drives: Drives of one node, with the envelope.
        axis: Number of the axis to move.

    Attributes:
        mode: The mode in which the axis turns at a speed.
        target: The object of that mode's target speed.
        has_position: Whether the drive shows a position.
        speed: The object that shows the speed.
        turned: Of a drive without a position, the speed just before the axis was brought to rest; of others 0.
    """

    def __init__(self, drives: BusDrives, axis: int) -> None:
        import numpy as np

        from drive_env import motion
        from drive_env.safety.bounds import velocity_object

        self.mode = motion.turning_mode(drives)
        self.target = motion.FOLLOWED[self.mode][0]
        self.has_position = drives.description.has(POSITION)
        self.speed, self.turned = velocity_object(drives.description), 0
        self.drives, self.axis = drives, axis
        self.where = np.arange(drives.num_axes) == axis
        self.name = axis_name(drives, axis)
        self.cycle = drives.description.cycle
        self.scale: Scale = scales_of(drives)[axis]

    def position(self) -> int:
        """Return the axis' position [inc]; 0 if the drive shows none."""
        return self.read(cia402.POSITION_ACTUAL) if self.has_position else 0

    def read(self, name: ObjectName) -> int:
        """Return an object's value on the axis."""
        return int(self.drives.read(name)[self.axis])

    def write(self, name: int, raw: int) -> None:
        """Write an object on the axis."""
        self.drives.write(name, raw, where=self.where)

    def parse(self, text: str, name: ObjectName) -> int:
        """Convert a text to an object's integer; ValueError for an invalid text or a value out of range."""
        from drive_env.dictionary import quantities
        from drive_env.dictionary.access import check_limits

        entry = self.drives.description.dictionary.find(name)
        raw = quantities.parse(text, entry, self.scale)
        check_limits(entry, raw)
        return raw

    def show(self, raw: int, name: ObjectName = cia402.POSITION_ACTUAL) -> str:
        """Return an object's integer in words; by default a position."""
        from drive_env.dictionary import quantities

        return quantities.show(raw, self.drives.description.dictionary.find(name), self.scale)

    def tolerance(self) -> int:
        """Return how far from its target the axis may stand [inc]: the drive's position window, where it uses one."""
        from drive_env.drives.motion import NEAR, WIDEST

        has_window = self.drives.description.has(cia402.POSITION_WINDOW)
        window = self.read(cia402.POSITION_WINDOW) if has_window else 0
        return max(NEAR, window if window < WIDEST else 0)

    def rows(self, raw: list[int], others: int) -> Any:
        """Return rows to play: those of the axis, and for the others values without effect."""
        import numpy as np

        return np.where(self.where, np.array(raw, int)[:, None], others)

    def cycles(self, duration: float) -> int:
        """Return how many cycles a time [s] takes, one at least."""
        return max(round(duration / self.cycle), 1)

    def record(self, duration: float, play: dict[int, Any]) -> Any:
        """Return the samples of those default objects that the drive has, while something is played."""
        keys = _recorded(self.drives.description.dictionary)
        keys += [] if self.has_position or self.speed in keys else [self.speed]
        return self.drives.record(keys, duration, play=play, period=self.cycle)

    def write_recording(self, files: tuple[Path, Path], trace: Any) -> None:
        """Write a recorded movement as table and picture, as scope does."""
        known = self.drives.description.dictionary
        entries = [known.find(key) for key in _recorded(known)]
        rows = {entry: trace[entry.index, entry.sub][:, self.axis : self.axis + 1] for entry in entries}
        write_table(files[0], entries, [""], trace.t, rows)
        draw(files[1], entries, [""], [self.scale], trace.t, rows)

    def carry_out(self, act: Callable[[], Any]) -> MoveOutcome:
        """Run a movement, which enables the axis and may return a recording; then switch the axis off."""
        from drive_env import motion

        reasons: list[str] = []
        trace: Any = None
        with what_stops(reasons):
            trace = act()
        status, reached = self.read(cia402.STATUSWORD), self.position()
        with what_stops([]):
            motion.disable(self.drives, where=self.where)
        self.drives.advance(0.1)
        end = self.position()
        emergencies = [one._asdict() for one in self.drives.emergencies() if one.axis == self.axis]
        return MoveOutcome(status, reached, end, reasons, emergencies, trace)

    def tell_plan(self, what: str, start: int, *, is_dry: bool, json: bool) -> None:
        """Print where the axis is and what is to be done; RuntimeError for one in fault, which could not be enabled."""
        status = self.read(cia402.STATUSWORD)
        if cia402.matches(status, cia402.FAULT_BIT):
            raise RuntimeError(
                f"the drive is in fault ({status:04X}h) and would not be enabled; reset it first "
                "(drive-env faults has the cause)"
            )
        if json:
            if is_dry:
                there = start if self.has_position else None
                print_json({"would": what, "start": there, "statusword": status, "moved": 0})
            return
        end = " (dry run: nothing was done)" if is_dry else ""
        here = f"at {self.show(start)} " if self.has_position else ""
        print_lines(
            [f"{self.name} is {here}({status:04X}h) and would be enabled, {what}, and be switched off again{end}"]
        )

    def check_target(self, target: int) -> None:
        """Raise ObjectAccessError for a position, say of a relative move, that 607Ah does not hold."""
        from drive_env.dictionary.access import check_limits

        check_limits(self.drives.description.dictionary.find(cia402.TARGET_POSITION), target)

    def check_acceleration(self, mode: str) -> None:
        """Raise ValueError where the acceleration of a mode is 0: nothing would move."""
        key, name, example = ACCELERATION[mode]
        if self.drives.description.has(key) and self.read(key) == 0:
            raise ValueError(
                f"the drive's {name} is 0, so nothing would move; set it (drive-env set {example}), or commission the "
                "drive"
            )


def _recorded(known: ObjectDictionary) -> list[cia402.Key]:
    """Return the objects that are recorded of a movement: those of scope that the drive can send with every cycle."""
    return [(int(name, 16), 0) for name in default_samples(known, default_names(known))]


def check_axis(description: Description, axis: int) -> None:
    """Raise ValueError for an axis that a node lacks."""
    if not 0 <= axis < description.num_axes:
        raise ValueError(f"--axis {axis}: a {description.name} has {description.num_axes} axes, from 0")


def limits_of(
    bus: NodeOptions, eds: Path | None, description: Description, axes: list[int], max_current: str | None,
    *, no_watchdog: bool,
) -> Limits:  # fmt: skip
    """Return the envelope's limits for --max-current of axes and --no-watchdog; ValueError for an impossible value.

    Where currents are counted in those of the motor, these are read from the drive.
    """
    from drive_env.dictionary import quantities
    from drive_env.dictionary.roles import Role
    from drive_env.drives.limits import Limits
    from drive_env.master.open_drives import is_ethercat

    limits = Limits()
    if no_watchdog:
        has = [index for index in WATCHDOGS if description.has((index, 0)) or description.has((index, 1))]
        if has or is_ethercat(bus.interface):
            what = f"{has[0]:04X}h" if has else "that of its process data"
            raise ValueError(
                f"--no-watchdog: a {description.name} has a watchdog over its master ({what}), and is not moved "
                "without it; leave the option out"
            )
        limits = Limits(silence=None)
    if max_current is None:
        return limits
    device = description.device
    if device is not None and Role.CURRENT_LIMIT not in device.roles:
        name = next((row for row in device.gains.rows if row.name == "run_current"), None)
        own = "" if name is None else f" (drive-env set {name.key[0]:04X} ..., shares of the drive's full current)"
        raise ValueError(
            f"--max-current: {description.name} has no current limit in amperes that could be set for the movement; "
            f"leave it out, and set the drive's own current{own}"
        )
    entry = description.dictionary.find(cia402.TORQUE_ACTUAL)
    scales: list[Scale] = [None] * description.num_axes
    if quantities.follows_scale(entry.unit):
        with bus.connect(eds, safety=False) as drives:
            scales = scales_of(drives)
    current = [
        quantities.parse(max_current, entry, scale) if axis in axes else None for axis, scale in enumerate(scales)
    ]
    if any(one is not None and one <= 0 for one in current):
        raise ValueError(f"--max-current {max_current} must be above 0 A; leave it out for the drive's own limit")
    return replace(limits, current=current)


@contextlib.contextmanager
def what_stops(reasons: list[str]) -> Iterator[None]:
    """Record the stops that end a movement early; errors of the bus pass through."""
    from drive_env.fieldbus.errors import BusError
    from drive_env.safety.envelope import SafetyError

    try:
        yield
    except BusError:
        raise
    except SafetyError as error:
        text = str(error).replace("Limits(current=...)", "--max-current").partition(", or set Limits(")[0]
        reasons.append(text.replace(", or raise Limits(velocity=...): ", ": "))
    except (RuntimeError, TimeoutError) as error:  # motion.py's errors, whose remedies are for Python
        reasons.append(str(error).partition(";")[0])


def print_outcome(line: str, outcome: MoveOutcome, files: tuple[Path, Path] | None) -> None:
    """Print a movement's result: a line, its emergencies, and its recording, if files were asked for."""
    print(line)
    for error in outcome.errors:
        print(f"emergency {error}")
    if files is not None:
        print("nothing was recorded" if outcome.trace is None else f"recorded in {files[0]} and {files[1]}")


def is_error(message: dict[str, Any]) -> bool:
    """Return whether an emergency reports an error; the code 0000h reports that all errors are gone (CiA 301)."""
    return bool(message["code"])


def told(message: dict[str, Any]) -> str:
    """Return an emergency in words."""
    return f"{message['code']:04X}h {message['name'].replace('_', ' ')}"


def go(one: OneAxis, goal: int, velocity: int, *, relative: bool, is_recorded: bool) -> Any:
    """Move in pp, restore the drive's profile velocity, and return the requested samples.

    Args:
        one: The axis.
        goal: Position, or distance [inc].
        velocity: Profile velocity, above 0, in the drive's unit.
        relative: Whether the goal is a distance.
        is_recorded: Whether to record samples.
    """
    from drive_env import motion
    from drive_env.drives.lent_object import lent

    drives = one.drives
    duration = abs(goal if relative else goal - one.read(cia402.POSITION_ACTUAL)) / velocity
    trace = None
    with lent(drives, cia402.PROFILE_VELOCITY, velocity, one.where):
        if is_recorded:  # mapping takes a while: not while an axis is enabled
            nothing = one.rows([], 0)
            one.record(0.0, {cia402.TARGET_POSITION: nothing, cia402.CONTROLWORD: nothing})
        motion.enable(drives, mode="pp", where=one.where)
        if is_recorded:
            word = cia402.ENABLE_OPERATION | (cia402.RELATIVE if relative else 0)
            first = one.cycles(BEFORE)
            count = first + one.cycles(duration) + one.cycles(AFTER)
            words = [word] * first + [word | cia402.NEW_SET_POINT] * first + [word] * (count - 2 * first)
            play = {
                cia402.TARGET_POSITION: one.rows([goal] * count, 0),
                cia402.CONTROLWORD: one.rows(words, cia402.DISABLE_VOLTAGE),
            }
            trace = one.record(count * one.cycle, play)
        else:
            motion.start_move(drives, goal, relative=relative, where=one.where)
        _arrive(one, velocity, 10.0 + 2.0 * duration)
        drives.advance(one.cycles(STANDSTILL) * one.cycle)
    return trace


def _arrive(one: OneAxis, velocity: int, timeout: float) -> None:
    """Wait until the target is reached; RuntimeError at a limit, TimeoutError after `timeout` [s]."""
    from drive_env import motion
    from drive_env.fieldbus.errors import BusError

    waited, before = 0.0, one.read(cia402.POSITION_ACTUAL)
    while True:
        try:
            motion.wait_for(one.drives, cia402.TARGET_REACHED, LOOK, "its target", one.where)
        except BusError:
            raise
        except TimeoutError:
            waited += LOOK
            here = one.read(cia402.POSITION_ACTUAL)
            is_still = abs(here - before) < STANDS * velocity * LOOK
            if is_still and cia402.matches(one.read(cia402.STATUSWORD), cia402.INTERNAL_LIMIT):
                raise RuntimeError("it is at a limit switch, or at a position limit") from None
            if waited >= timeout:
                raise TimeoutError(f"it did not reach its target within {waited:.1f} s") from None
            before = here
        else:
            return
