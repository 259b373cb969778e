"""`drive-env jog`: turn an axis at a speed, for a time or by a distance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drive_env import cia402
from drive_env.commands.one_axis import (
    AFTER,
    BEFORE,
    LEAST,
    STANDSTILL,
    MaxCurrent,
    MoveOutcome,
    NoWatchdog,
    OneAxis,
    Recording,
    check_axis,
    go,
    limits_of,
    print_outcome,
)
from drive_env.commands.options import (
    REFUSED,
    AxisOptions,
    Eds,
    Json,
    WouldDo,
    cycle_for,
    errors_as_exit_codes,
    fail,
    grouped,
    print_json,
)
from drive_env.commands.scope import new_files

if TYPE_CHECKING:
    from drive_env.dictionary.entries import Entry
    from drive_env.dictionary.quantities import Scale

ENOUGH = 0.9  # of the requested distance: an axis that moved less, with an emergency, was stopped by it


@grouped
def jog(
    speed: Annotated[str, typer.Argument(help="Speed: '100 rpm', '1 rev/s', or an integer of the drive's unit.")],
    duration: Annotated[float, typer.Option("--for", help="Duration, without --by [s].")] = 1.0,
    by: Annotated[str | None, typer.Option(help="Distance: '1 rev', '-90 deg', or increments.")] = None,
    *,
    bus: AxisOptions,
    eds: Eds = None,
    max_current: MaxCurrent = None,
    no_watchdog: NoWatchdog = False,
    out: Recording = None,
    json: Json = False,
    dry_run: WouldDo = False,
) -> None:
    """Enable an axis, turn it for a while or by a distance, and switch it off again.

    The safety envelope is on: Ctrl-C, an exceeded limit and the end of this process all cause a quick stop. A negative
    speed turns the other way; with --by the sign of the distance does. A drive without pv turns in vl. Exit code 1 if
    the movement was stopped, or the axis did not move.
    """
    with errors_as_exit_codes():
        from drive_env.fieldbus.description import describe

        description = describe(bus.device, eds)
        check_axis(description, bus.one_axis)
        if dry_run:
            bus.look_first(eds)
        limits = limits_of(bus, eds, description, [bus.one_axis], max_current, no_watchdog=no_watchdog)
        if not 0.001 <= duration <= 3600.0:
            raise ValueError(f"--for {duration:g} s must be at least 0.001 s and at most an hour")
        files = None if out is None else new_files(out)
        with bus.connect(eds, safety=limits, cycle=cycle_for(description)) as drives:
            one = OneAxis(drives, bus.one_axis)
            movement = _asked_for(one, speed, by, duration)
            start = one.position()
            meant = _speed_in_words(speed, movement.velocity, description.dictionary.find(one.target), one.scale)
            if dry_run:
                what = f"turn for {duration:g} s at {meant}" if by is None else f"turn by {by} at {meant}"
                one.tell_plan(what, start, is_dry=True, json=json)
                return
            outcome = one.carry_out(lambda: movement.run(one, is_recorded=files is not None))
            if files is not None and outcome.trace is not None:
                one.write_recording(files, outcome.trace)
        moved = outcome.end - start
        share = moved / movement.way if one.has_position else one.turned / movement.velocity
        stopped = _verdict(share, outcome, meant)
        if json:
            told = {"moved": moved, "start": start} if one.has_position else {"speed": one.turned}
            print_json(told | {"emergencies": outcome.emergencies, "stopped": stopped})
        elif one.has_position:
            print_outcome(f"{one.name} moved by {one.show(moved)}", outcome, files)
        else:
            shown = description.dictionary.find(one.speed)
            print_outcome(f"{one.name} turned: {shown.label} = {one.show(one.turned, one.speed)}", outcome, files)
        if stopped:
            fail(stopped, REFUSED)


@dataclass(frozen=True)
class _Movement:
    """The movement of an axis, in the drive's units: turn at a speed for a time [s], or by a distance if given."""

    velocity: int
    duration: float
    distance: int | None

    @property
    def way(self) -> float:
        """Distance of the movement if nothing stops it."""
        return self.velocity * self.duration if self.distance is None else self.distance

    def run(self, one: OneAxis, is_recorded: bool) -> Any:
        """Enable the axis and move it; return the requested samples."""
        if self.distance is None:
            return _turn(one, self.velocity, round(self.duration, 3), is_recorded)
        return go(one, self.distance, abs(self.velocity), relative=True, is_recorded=is_recorded)


def _asked_for(one: OneAxis, speed: str, by: str | None, duration: float) -> _Movement:
    """Return the movement of the arguments, before the axis is enabled; ValueError for an impossible one."""
    velocity = one.parse(speed, one.target)
    if velocity == 0:
        raise ValueError("a speed of 0 does not move the axis; give one, e.g. '60 rpm'")
    if by is not None and not (one.has_position and one.drives.description.has(cia402.TARGET_POSITION)):
        raise ValueError(f"--by {by}: {one.drives.description.name} has no position to move to; use --for")
    distance = None if by is None else one.parse(by, cia402.TARGET_POSITION)
    if distance == 0:
        raise ValueError(f"--by {by} is less than one increment: nothing would move; give more")
    if distance is not None and velocity < 0 < distance:
        raise ValueError(f"{speed} turns the other way than --by {by}; leave out one sign, the distance's counts")
    if distance is not None:
        one.check_target(one.position() + distance)
    one.check_acceleration(one.mode if by is None else "pp")
    return _Movement(velocity, duration, distance)


def _verdict(share: float, outcome: MoveOutcome, meant: str) -> str:
    """Return why a movement failed; "" if it did not.

    Args:
        share: Achieved share of the requested distance or speed.
        outcome: The drive's values at the end.
        meant: The requested speed as text.
    """
    if stopped := outcome.stopped(share >= ENOUGH):
        return stopped
    if share < LEAST:
        return (
            f"the axis hardly moved, and the drive reports no cause. The speed was {meant}. Else check for a closed "
            "brake, a blocked load, a low current limit (--max-current) or a small acceleration (6083h, in vl 6048h)"
        )
    return ""


def _speed_in_words(speed: str, velocity: int, entry: Entry, scale: Scale) -> str:
    """Return a speed as text, with a hint about rpm if it was a bare number."""
    from drive_env.dictionary import quantities

    text = quantities.show(velocity, entry, scale)
    if not entry.unit:
        return f"{text}, in a unit that the EDS does not tell"
    if quantities.is_quantity(speed) or text.endswith(" rpm"):
        return text
    return f"{text} (if {speed} rpm are meant, write '{speed} rpm')"


def _turn(one: OneAxis, velocity: int, duration: float, is_recorded: bool) -> Any:
    """Turn at a speed, let the drive brake with its own deceleration; return the requested samples."""
    from drive_env import motion

    drives, cycle = one.drives, one.cycle
    if is_recorded:  # mapping takes a while: not while an axis is enabled
        one.record(0.0, {one.target: one.rows([], 0)})
    motion.enable(drives, mode=one.mode, where=one.where)
    trace = None
    if is_recorded:
        motion.turn(drives, 0, one.where)
        turns = [0] * one.cycles(BEFORE) + [velocity] * one.cycles(duration)
        rows = turns + [0] * one.cycles(AFTER)
        trace = one.record(len(rows) * cycle, {one.target: one.rows(rows, 0)})
        if not one.has_position:
            one.turned = int(trace[one.speed][len(turns) - 1, one.axis])
    else:
        motion.turn(drives, velocity, one.where)
        drives.advance(one.cycles(duration) * cycle)
        if not one.has_position:
            one.turned = one.read(one.speed)
    motion.turn(drives, 0, one.where)
    # Bit 10 in pv and vl shows that the ramp has ended.
    motion.wait_for(drives, cia402.TARGET_REACHED, 10.0, "standstill", one.where)
    drives.advance(one.cycles(STANDSTILL) * cycle)
    return trace
