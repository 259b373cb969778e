"""`drive-env move`: move an axis to a position, or by a distance."""

from __future__ import annotations

from typing import Annotated

import typer

from drive_env import cia402
from drive_env.commands.one_axis import (
    LEAST,
    MaxCurrent,
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
    Yes,
    ask,
    cycle_for,
    errors_as_exit_codes,
    fail,
    grouped,
    print_json,
)
from drive_env.commands.scope import new_files


@grouped
def move(
    position: Annotated[str, typer.Argument(help="Where to: '2 rev', '-90 deg', or increments.")],
    relative: Annotated[bool, typer.Option("--relative", help="Move by it, from where the axis is.")] = False,
    speed: Annotated[
        str | None, typer.Option(help="Profile velocity of this move: '300 rpm'.", show_default="the drive's, 6081h")
    ] = None,
    *,
    bus: AxisOptions,
    eds: Eds = None,
    max_current: MaxCurrent = None,
    no_watchdog: NoWatchdog = False,
    out: Recording = None,
    yes: Yes = False,
    json: Json = False,
    dry_run: WouldDo = False,
) -> None:
    """Enable an axis, move it to a position in profile position mode, and switch it off again.

    It says what will be done, and asks. The safety envelope is on: Ctrl-C, an exceeded limit and the end of this
    process all cause a quick stop. Exit code 1 if the axis did not get there.
    """
    with errors_as_exit_codes():
        from drive_env.fieldbus.description import describe

        description = describe(bus.device, eds)
        check_axis(description, bus.one_axis)
        if dry_run:
            bus.look_first(eds)
        limits = limits_of(bus, eds, description, [bus.one_axis], max_current, no_watchdog=no_watchdog)
        files = None if out is None else new_files(out)
        with bus.connect(eds, safety=limits, cycle=cycle_for(description)) as drives:
            one = OneAxis(drives, bus.one_axis)
            goal, velocity = one.parse(position, cia402.TARGET_POSITION), _velocity(one, speed)
            one.check_acceleration("pp")
            start = one.read(cia402.POSITION_ACTUAL)
            target = start + goal if relative else goal
            one.check_target(target)
            way = target - start
            what = f"moved by {one.show(way)} to {one.show(target)}"
            what += f" at {one.show(velocity, cia402.PROFILE_VELOCITY)}"
            one.tell_plan(what, start, is_dry=dry_run, json=json)
            if dry_run:
                return
            ask("Move now?", yes)
            outcome = one.carry_out(lambda: go(one, goal, velocity, relative=relative, is_recorded=files is not None))
            near = max(one.tolerance(), LEAST * abs(way))
            if files is not None and outcome.trace is not None:
                one.write_recording(files, outcome.trace)
        short = target - outcome.reached
        stopped = outcome.stopped(abs(short) <= near)
        if not stopped and abs(short) > near:
            stopped = f"it stands {one.show(short)} from where it should be, and the drive reports no cause"
        if json:
            moved = outcome.reached - start
            row = {"moved": moved, "start": start, "target": target, "position": outcome.reached}
            print_json(row | {"emergencies": outcome.emergencies, "stopped": stopped})
        else:
            print_outcome(f"{one.name} is at {one.show(outcome.reached)}", outcome, files)
        if stopped:
            fail(stopped, REFUSED)


def _velocity(one: OneAxis, speed: str | None) -> int:
    """Return the profile velocity of the move; ValueError for one that is not above 0."""
    if speed is None:
        velocity = one.read(cia402.PROFILE_VELOCITY)
        if velocity <= 0:
            raise ValueError("the drive's profile velocity 6081h is 0; give --speed '60 rpm'")
        return velocity
    velocity = one.parse(speed, cia402.PROFILE_VELOCITY)
    if velocity <= 0:
        raise ValueError(f"--speed {speed} must be above 0; the sign of the position gives the direction")
    return velocity
