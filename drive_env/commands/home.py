"""`drive-env home`: find the reference position of axes, by a homing method of the drive."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Annotated, Any, NamedTuple

import typer

from drive_env import cia402
from drive_env.commands.one_axis import (
    STANDSTILL,
    MaxCurrent,
    MoveOutcome,
    NoWatchdog,
    OneAxis,
    check_axis,
    limits_of,
    print_outcome,
)
from drive_env.commands.options import (
    REFUSED,
    AxesInOrderOptions,
    Eds,
    Json,
    WouldDo,
    Yes,
    ask,
    axis_place,
    check_time,
    cycle_for,
    errors_as_exit_codes,
    fail,
    grouped,
    print_json,
    print_result,
)

SETTLING = 40  # checks, a STANDSTILL apart, within which an axis must come to rest at home
REACHED = cia402.TARGET_REACHED.mask  # at rest, which the command determines by the position
# Bit 12, without bit 13, which reports an error.
ATTAINED = cia402.Pattern(cia402.HOMING_BITS ^ REACHED, cia402.HOMED ^ REACHED)


class _Homing(NamedTuple):
    """The homing of an axis.

    Attributes:
        one: The axis.
        method: Number of the homing method.
        is_own: Whether the drive has that number in 6098h already.
    """

    one: OneAxis
    method: int
    is_own: bool

    @property
    def words(self) -> str:
        """Description of the axis' plan."""
        is_known = self.one.drives.description.device is not None
        return f"homed by method {self.method} ({_text(self.method, is_known)})"

    def run(self, within: float) -> MoveOutcome:
        """Home the axis, switch it off, and restore the drive's own method."""
        from drive_env.drives.lent_object import lent

        one = self.one
        own = nullcontext() if self.is_own else lent(one.drives, cia402.HOMING_METHOD, self.method, one.where)
        with own:
            return one.carry_out(lambda: _find_home(one, within))


@grouped
def home(
    method: Annotated[
        int | None,
        typer.Option(help="Homing method for this time; 6098h keeps its value.", show_default="the drive's, 6098h"),
    ] = None,
    *,
    bus: AxesInOrderOptions,
    eds: Eds = None,
    within: Annotated[float, typer.Option(help="Longest time that homing an axis may take [s].")] = 60.0,
    max_current: MaxCurrent = None,
    no_watchdog: NoWatchdog = False,
    yes: Yes = False,
    json: Json = False,
    dry_run: WouldDo = False,
) -> None:
    """Home axes, one after the other: enable each, run its homing method, and switch it off again.

    It says what will be done, and asks. A drive without a method (6098h is 0) gets a list of those that it has.

    The safety envelope is on: Ctrl-C, an exceeded limit and the end of this process all cause a quick stop. Exit code 1
    if an axis did not attain home, which ends the command.
    """
    with errors_as_exit_codes():
        from drive_env.fieldbus.description import describe

        description = describe(bus.device, eds)
        for axis in bus.axes:
            check_axis(description, axis)
        check_time("--within", within)
        if not description.has(cia402.HOMING_METHOD):
            raise ValueError(f"{description.name} has no homing: its EDS lacks 6098h")
        if dry_run:
            bus.look_first(eds)
        limits = limits_of(bus, eds, description, bus.axes, max_current, no_watchdog=no_watchdog)
        with bus.connect(eds, safety=limits, cycle=cycle_for(description)) as drives:
            plan = [_planned(OneAxis(drives, axis), method, json) for axis in bus.axes]
            for homing in plan:
                one = homing.one
                one.tell_plan(homing.words, one.read(cia402.POSITION_ACTUAL), is_dry=dry_run, json=json)
            if dry_run:
                return
            ask("Home now?", yes)
            for homing in plan:
                outcome = homing.run(within)
                _report(homing, outcome, json)


def _text(method: int, is_known: bool) -> str:
    from drive_env.dictionary.homing_methods import method_text

    return method_text(method, is_known=is_known)


def _planned(one: OneAxis, method: int | None, json: bool) -> _Homing:
    """Return the homing of an axis.

    Raises:
        ValueError: For a method that the axis does not have.
        RuntimeError: If no method is given, and the drive has none; those that it has are printed first.
    """
    from drive_env.drives.homing import methods_of

    own = one.read(cia402.HOMING_METHOD)
    there = methods_of(one.drives, one.drives.description, one.axis)
    if method is not None and (method == 0 or (there and method not in there)):
        known = ", ".join(map(str, there)) or "those of its manual"
        raise ValueError(f"--method {method}: {one.name} has {known}; without --method its list shows what each does")
    chosen = own if method is None else method
    if chosen == 0:
        _print_methods(one, there, json)
        raise RuntimeError(
            f"{one.name} has no homing method: 6098h is 0. Choose one of the list that fits the machine's switches: "
            "drive-env home --method NUMBER, or for good drive-env set 6098 NUMBER"
        )
    _check_speeds(one, chosen)
    return _Homing(one, chosen, is_own=chosen == own)


def _check_speeds(one: OneAxis, method: int) -> None:
    """Raise ValueError if a speed or the acceleration that a method needs is 0: the axis would not move."""
    from drive_env.drives.homing import missing_speeds

    for (index, sub), example in missing_speeds(one.drives, one.axis, method).items():
        raise ValueError(
            f"{index:04X}h:{sub:02X} of {one.name} is 0, so method {method} would not move the axis; set it, for "
            f"example drive-env set {index:04X}:{sub} '{example}' --{one.name.replace(' axis', ' --axis')}"
        )


def _print_methods(one: OneAxis, there: list[int], json: bool) -> None:
    """Print the methods that an axis has, with descriptions; those of CiA 402 if it does not list any."""
    from drive_env.dictionary.homing_methods import METHODS

    is_known = one.drives.description.device is not None
    texts = {number: _text(number, is_known) for number in there or METHODS}
    title = f"homing methods of {one.name}:"
    if not there:
        title = f"homing methods of CiA 402; {one.name} does not list its own:"
    lines = [title, *(f"  {number:>3}  {text}" for number, text in texts.items())]
    print_result(axis_place(one.drives, one.axis) | {"method": 0, "methods": texts}, lines, json)


def _find_home(one: OneAxis, within: float) -> None:
    """Home an axis and wait until it stands; RuntimeError if it moves on, regardless of its drive's report."""
    from drive_env import motion

    motion.home(one.drives, where=one.where, timeout=within)
    for _ in range(SETTLING):
        before = one.read(cia402.POSITION_ACTUAL)
        one.drives.advance(one.cycles(STANDSTILL) * one.cycle)
        if abs(one.read(cia402.POSITION_ACTUAL) - before) <= one.tolerance():
            return
    raise RuntimeError("the drive reports home, and the axis is not at rest")


def _report(homing: _Homing, outcome: MoveOutcome, json: bool) -> None:
    """Print the result of a homing; exit code 1 unless the drive shows that it attained home."""
    one = homing.one
    is_home = bool(cia402.matches(outcome.status, ATTAINED))
    stopped = outcome.stopped(is_home)
    if not stopped and not is_home:
        stopped = f"the drive does not show that home is attained ({outcome.status:04X}h)"
    if json:
        row: dict[str, Any] = {"method": homing.method, "position": outcome.end, "statusword": outcome.status}
        print_json(axis_place(one.drives, one.axis) | row | {"emergencies": outcome.emergencies, "stopped": stopped})
    else:
        state = "not homed" if stopped else f"homed by method {homing.method}"
        print_outcome(f"{one.name} {state}, at {one.show(outcome.end)}", outcome, None)
    if stopped and not cia402.matches(outcome.status, cia402.OPERATION_ENABLED):  # the envelope's stop, or a fault
        fail(f"{one.name}: homing was stopped: {stopped}", REFUSED)
    if stopped:
        fail(
            f"{one.name}: {stopped}. Check that the switches of method {homing.method} are there, and the speeds 6099h "
            "and the acceleration 609Ah",
            REFUSED,
        )
