"""`drive-env jog`: turn an axis at a speed, for a time or by a distance."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drive_env import cia402
from drive_env.commands.options import (
    REFUSED,
    AxisOptions,
    Eds,
    Json,
    WouldDo,
    axis_name,
    cycle_for,
    errors_as_exit_codes,
    fail,
    grouped,
    print_json,
    scales_of,
)
from drive_env.commands.scope import default_names, draw, new_files, write_table

if TYPE_CHECKING:
    from drive_env.cia402 import Key
    from drive_env.dictionary.entries import Entry, ObjectDictionary, ObjectName
    from drive_env.dictionary.quantities import Scale
    from drive_env.fieldbus.description import Description
    from drive_env.master.bus_drives import BusDrives

POSITION = (cia402.POSITION_ACTUAL, 0)
# Of each mode: the object that keeps an axis from moving if it is 0, its words, and a value for it.
PROFILE = ((cia402.PROFILE_ACCELERATION, 0), "profile acceleration 6083h", "6083 '500 rev/s^2'")
ACCELERATION = {
    "pp": PROFILE,
    "pv": PROFILE,
    "vl": ((cia402.VL_ACCELERATION, 1), "acceleration 6048h:01", "6048:1 1000"),
}
BEFORE, AFTER = 0.02, 0.5  # s recorded at rest before a movement, and besides the time that it should take
RELATIVE = cia402.ENABLE_OPERATION | cia402.RELATIVE
INTERNAL_LIMIT = 0x0800  # bit 11 of the statusword
STANDSTILL = 0.05  # s, that the drives get to come to rest
LOOK, STANDS = 0.2, 0.05  # s between two looks, and the share of the speed asked for below which an axis stands
LEAST, ENOUGH = 0.01, 0.9  # of the way asked for: less is no movement, and less with an emergency was stopped by that


@grouped
def jog(
    speed: Annotated[str, typer.Argument(help="Speed: '100 rpm', '1 rev/s', or an integer of the drive's unit.")],
    duration: Annotated[float, typer.Option("--for", help="Duration, without --by [s].")] = 1.0,
    by: Annotated[str | None, typer.Option(help="Distance: '1 rev', '-90 deg', or increments.")] = None,
    *,
    bus: AxisOptions,
    eds: Eds = None,
    max_current: Annotated[
        str | None, typer.Option(help="Current limit, set in the drive for the movement; by default the drive's own.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Record the movement, as scope does: new files OUT.csv and OUT.png."),
    ] = None,
    json: Json = False,
    dry_run: WouldDo = False,
) -> None:
    """Enable an axis, turn it for a while or by a distance, and switch it off again.

    The safety envelope is on: Ctrl-C, an exceeded limit and the end of this process all cause a quick stop. A negative
        speed turns the other way. A drive without pv turns in vl. Exit code 1 if the movement was stopped, or the axis
        did not move.
    """
    with errors_as_exit_codes():
        from drive_env import motion
        from drive_env.dictionary import quantities
        from drive_env.drives.limits import Limits
        from drive_env.fieldbus.description import describe

        description = describe(bus.device, eds)
        known, axis = description.dictionary, bus.axis
        if not 0 <= axis < description.num_axes:
            raise ValueError(f"--axis {axis}: a {description.name} has {description.num_axes} axes, from 0")
        if max_current is not None:
            _check_has_current_limit(description)
        current = None if max_current is None else quantities.parse(max_current, known.find(cia402.TORQUE_ACTUAL), None)
        if current is not None and current <= 0:
            raise ValueError(f"--max-current {max_current} must be above 0 A; leave it out for the drive's own limit")
        if not 0.001 <= duration <= 3600.0:
            raise ValueError(f"--for {duration:g} s must be at least 0.001 s and at most an hour")
        files = None if out is None else new_files(out)
        if dry_run:
            bus.look_first(eds)
        with bus.connect(eds, safety=Limits(current=current), cycle=cycle_for(description)) as drives:
            one = _OneAxis(drives, axis)
            scale = scales_of(drives)[axis]
            movement = _asked_for(one, known, scale, speed, by, duration)
            start = one.position()
            if dry_run:
                _tell_plan(one, speed, by, duration, start, scale, json=json)
                return
            reasons: list[str] = []
            trace: Any = None
            with _what_stops(reasons):
                trace = movement.run(motion, one, is_recorded=files is not None)
            with _what_stops([]):
                motion.disable(drives, where=one.where)
            drives.advance(0.1)
            moved = None if start is None else one.read(cia402.POSITION_ACTUAL) - start
            emergencies = [message._asdict() for message in drives.emergencies() if message.axis == axis]
            if files is not None and trace is not None:
                _write(files, trace, known, scale, axis)
        meant = _speed_in_words(speed, movement.velocity, known.find(one.target), scale)
        share = one.reached / movement.velocity if moved is None else moved / movement.way
        stopped = _verdict(share, reasons, emergencies, meant)
        if json:
            told = {"speed": one.reached} if moved is None else {"moved": moved, "start": start}
            print_json(told | {"emergencies": emergencies, "stopped": stopped})
        else:
            if moved is None:
                shown = known.find(one.speed)
                print(f"{one.name} turned: {shown.label} = {quantities.show(one.reached, shown, scale)}")
            else:
                print(f"{one.name} moved by {quantities.show(moved, known.find(cia402.POSITION_ACTUAL), scale)}")
            for message in filter(_is_error, emergencies):
                print(f"emergency {_told(message)}")
            if files is not None:
                print("nothing was recorded" if trace is None else f"recorded in {files[0]} and {files[1]}")
        if stopped:
            fail(stopped, REFUSED)


def _check_has_current_limit(description: Description) -> None:
    """Raise ValueError for a known drive without a current limit in amperes: nothing would be limited."""
    from drive_env.dictionary.roles import Role

    device = description.device
    if device is not None and Role.CURRENT_LIMIT not in device.roles:
        name = next((row for row in device.gains.rows if row.name == "run_current"), None)
        own = "" if name is None else f" (drive-env set {name.key[0]:04X} ..., shares of the drive's full current)"
        raise ValueError(
            f"--max-current: {description.name} has no current limit in amperes that could be set for the movement; "
            f"leave it out, and set the drive's own current{own}"
        )


class _OneAxis:
    """The axis that turns, and the others of its node, which are let alone.

    Attributes:
        mode: In which it turns at a speed.
        target: The object of that speed.
        has_position: Whether its drive shows where it is.
        speed: The object that shows the speed.
        reached: The speed before it was brought to rest, of a drive without a position.
    """

    def __init__(self, drives: BusDrives, axis: int) -> None:
        import numpy as np

        from drive_env import motion
        from drive_env.safety.bounds import velocity_object

        self.mode = motion.turning_mode(drives)
        self.target = motion.FOLLOWED[self.mode][0]
        self.has_position = drives.description.has(POSITION)
        self.speed, self.reached = velocity_object(drives.description), 0
        self.drives, self.axis = drives, axis
        self.where = np.arange(drives.num_axes) == axis
        self.name = axis_name(drives, axis)
        self.cycle = drives.description.cycle

    def position(self) -> int | None:
        """Return where it is, None of a drive without a position."""
        return self.read(cia402.POSITION_ACTUAL) if self.has_position else None

    def read(self, name: ObjectName) -> int:
        """Return an object of it."""
        return int(self.drives.read(name)[self.axis])

    def write(self, name: int, raw: int) -> None:
        """Write an object of it."""
        self.drives.write(name, raw, where=self.where)

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


@dataclass(frozen=True)
class _Movement:
    """The movement of an axis, in the drive's units: turn at a speed for a time [s], or by a distance if given."""

    velocity: int
    duration: float
    distance: int | None

    @property
    def way(self) -> float:
        """How far the axis turns if nothing stops it."""
        return self.velocity * self.duration if self.distance is None else self.distance

    def run(self, motion: Any, one: _OneAxis, is_recorded: bool) -> Any:
        """Enable the axis and move it; return the samples that were wanted of it."""
        if self.distance is None:
            return _turn(motion, one, self.velocity, round(self.duration, 3), is_recorded)
        return _go(motion, one, abs(self.velocity), self.distance, is_recorded)


def _asked_for(
    one: _OneAxis, known: ObjectDictionary, scale: Scale, speed: str, by: str | None, duration: float
) -> _Movement:
    """Return the movement that the arguments ask for, before the axis is enabled; ValueError for one that cannot be."""
    from drive_env.dictionary import quantities
    from drive_env.dictionary.access import check_limits

    velocity = quantities.parse(speed, known.find(one.target), scale)
    if velocity == 0:
        raise ValueError("a speed of 0 does not move the axis; give one, e.g. '60 rpm'")
    check_limits(known.find(one.target), velocity)
    distance = None
    if by is not None:
        if not (one.has_position and known.has(cia402.TARGET_POSITION)):
            raise ValueError(f"--by {by}: {one.drives.description.name} has no position to move to; use --for")
        distance = quantities.parse(by, known.find(cia402.TARGET_POSITION), scale)
        check_limits(known.find(cia402.TARGET_POSITION), distance)
    key, name, example = ACCELERATION[one.mode if by is None else "pp"]
    if one.drives.description.has(key) and one.read(key) == 0:
        raise ValueError(
            f"the drive's {name} is 0, so nothing would move; set it (drive-env set {example}), or commission the drive"
        )
    return _Movement(velocity, duration, distance)


def _recorded(known: ObjectDictionary) -> list[Key]:
    """Return the objects that are recorded of a movement: those of scope that the drive has."""
    return [key for name in default_names(known) if known.has(key := (int(name, 16), 0))]


def _write(files: tuple[Path, Path], trace: Any, known: ObjectDictionary, scale: Scale, axis: int) -> None:
    """Write a recorded movement as table and picture, as scope does."""
    entries = [known.find(key) for key in _recorded(known)]
    rows = {entry: trace[entry.index, entry.sub][:, axis : axis + 1] for entry in entries}
    write_table(files[0], entries, [""], trace.t, rows)
    draw(files[1], entries, [""], [scale], trace.t, rows)


@contextlib.contextmanager
def _what_stops(reasons: list[str]) -> Iterator[None]:
    """Record the stops that end a movement early; errors of the bus pass through."""
    from drive_env.fieldbus.errors import BusError
    from drive_env.safety.envelope import SafetyError

    try:
        yield
    except BusError:
        raise
    except SafetyError as error:
        text = str(error).replace("Limits(current=...)", "--max-current").partition(", or set Limits(")[0]
        reasons.append(text.replace("Choose less, or raise Limits(velocity=...): ", "Choose less: "))
    except (RuntimeError, TimeoutError) as error:  # motion's, whose remedies are Python's
        reasons.append(str(error).partition(";")[0])


def _speed_in_words(speed: str, velocity: int, entry: Entry, scale: Scale) -> str:
    """Return a speed in words, and how to write rpm if it was a bare number."""
    from drive_env.dictionary import quantities

    text = quantities.show(velocity, entry, scale)
    if quantities.is_quantity(speed) or text.endswith(" rpm"):
        return text
    return f"{text}; if {speed} rpm are meant, write '{speed} rpm'"


def _verdict(share: float, reasons: list[str], emergencies: list[dict[str, Any]], meant: str) -> str:
    """Return why a movement failed; "" if it did not.

    Args:
        share: What came of the way, or of the speed, that was asked for.
        reasons: What stopped it.
        emergencies: That came.
        meant: The speed that was asked for, in words.
    """
    told = [_told(message) for message in filter(_is_error, emergencies)]
    if told and (reasons or share < ENOUGH):
        return (
            "the movement was stopped: emergency "
            f"{', '.join(dict.fromkeys(told))}{''.join(f'; {one}' for one in reasons)}"
        )
    if reasons:
        return "; ".join(reasons)
    if share < LEAST:
        return (
            f"the axis hardly moved, and the drive reports no cause. The speed was {meant}. Else check for a closed "
            "brake, a blocked load, a low current limit (--max-current) or a small acceleration (6083h, in vl 6048h)"
        )
    return ""


def _is_error(message: dict[str, Any]) -> bool:
    """Return whether an emergency reports an error; the code 0000h reports that all errors are gone (CiA 301)."""
    return bool(message["code"])


def _told(message: dict[str, Any]) -> str:
    return f"{message['code']:04X}h {message['name'].replace('_', ' ')}"


def _tell_plan(
    one: _OneAxis,
    speed: str,
    by: str | None,
    duration: float,
    start: int | None,
    scale: Scale,
    *,
    json: bool,
) -> None:
    """Say where the axis is and what would be done; raises for one in fault, which could not be enabled."""
    from drive_env.dictionary import quantities

    status = one.read(cia402.STATUSWORD)
    if cia402.matches(status, cia402.FAULT_BIT):
        raise RuntimeError(f"the drive is in fault ({status:04X}h) and would not be enabled; reset it first")
    what = f"turn at {speed} for {duration:g} s" if by is None else f"turn by {by} at {speed}"
    if json:
        print_json({"would": what, "start": start, "statusword": status, "moved": 0})
        return
    where = ""
    if start is not None:
        where = f"at {quantities.show(start, one.drives.description.dictionary.find(cia402.POSITION_ACTUAL), scale)} "
    print(
        f"{one.name} is {where}({status:04X}h) and would be enabled, {what}, and be switched off again "
        "(dry run: nothing was done)"
    )


def _turn(motion: Any, one: _OneAxis, velocity: int, duration: float, is_recorded: bool) -> Any:
    """Turn at a speed, let the drive brake with its own deceleration; return the samples that were wanted of it."""
    drives, cycle = one.drives, one.cycle
    if is_recorded:  # mapping takes a while: not with an axis enabled
        one.record(0.0, {one.target: one.rows([], 0)})
    motion.enable(drives, mode=one.mode, where=one.where)
    trace = None
    if is_recorded:
        motion.turn(drives, 0, one.where)
        turns = [0] * one.cycles(BEFORE) + [velocity] * one.cycles(duration)
        rows = turns + [0] * one.cycles(AFTER)
        trace = one.record(len(rows) * cycle, {one.target: one.rows(rows, 0)})
        if not one.has_position:
            one.reached = int(trace[one.speed][len(turns) - 1, one.axis])
    else:
        motion.turn(drives, velocity, one.where)
        drives.advance(one.cycles(duration) * cycle)
        if not one.has_position:
            one.reached = one.read(one.speed)
    motion.turn(drives, 0, one.where)
    # Bit 10 in pv and vl tells that the ramp has ended.
    motion.wait_for(drives, cia402.TARGET_REACHED, 10.0, "standstill", one.where)
    drives.advance(one.cycles(STANDSTILL) * cycle)
    return trace


def _go(motion: Any, one: _OneAxis, velocity: int, distance: int, is_recorded: bool) -> Any:
    """Move in pp, and give the drive its profile velocity back; return the samples that were wanted of it."""
    from drive_env.drives.lent_object import lent

    drives, cycle = one.drives, one.cycle
    trace = None
    with lent(drives, cia402.PROFILE_VELOCITY, velocity, one.where):
        if is_recorded:  # mapping takes a while: not with an axis enabled
            nothing = one.rows([], 0)
            one.record(0.0, {cia402.TARGET_POSITION: nothing, cia402.CONTROLWORD: nothing})
        motion.enable(drives, mode="pp", where=one.where)
        if is_recorded:
            first = one.cycles(BEFORE)
            count = first + one.cycles(abs(distance) / velocity) + one.cycles(AFTER)
            words = [RELATIVE] * first + [RELATIVE | cia402.NEW_SET_POINT] * first + [RELATIVE] * (count - 2 * first)
            play = {
                cia402.TARGET_POSITION: one.rows([distance] * count, 0),
                cia402.CONTROLWORD: one.rows(words, cia402.DISABLE_VOLTAGE),
            }
            trace = one.record(count * cycle, play)
        else:
            motion.start_move(drives, distance, relative=True, where=one.where)
        _arrive(motion, one, velocity, 10.0 + 2.0 * abs(distance) / velocity)
    return trace


def _arrive(motion: Any, one: _OneAxis, velocity: int, timeout: float) -> None:
    """Wait until the target is reached; RuntimeError for an axis that stands at a limit."""
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
            if is_still and one.read(cia402.STATUSWORD) & INTERNAL_LIMIT:
                raise RuntimeError("it is at a limit switch, or at a position limit") from None
            if waited >= timeout:
                raise TimeoutError(f"it did not reach its target within {waited:.1f} s") from None
            before = here
        else:
            return
