"""`drive-env motor`: describe your own motor in a file, from the numbers of its data sheet."""

from __future__ import annotations

import json as json_text
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drive_env.commands.options import check_free, errors_as_exit_codes

if TYPE_CHECKING:
    from collections.abc import Mapping

    from drive_env.motors import Motor

Printed = tuple[float, str]  # a number's value in the file, and the typed text

motor_app = typer.Typer(no_args_is_help=True, rich_markup_mode="markdown")


@motor_app.callback()
def motor() -> None:
    """Motors that the catalogue does not have; --motor takes the path of such a file wherever it takes a name."""


# Remedies for required numbers that a data sheet lacks.
ESTIMATES = {
    "inertia_kg_m2": "where the data sheet lacks it, take that of a motor of the same size: tuning measures the "
    "inertia of motor and load together"
}


@motor_app.command("new")
def new_motor(
    file: Annotated[
        Path | None, typer.Argument(help="New TOML file to write; only --list needs none.", show_default=False)
    ] = None,
    kind: Annotated[str | None, typer.Option("--kind", help="pmsm (brushless), dc (brushed) or stepper.")] = None,
    title: Annotated[str, typer.Option("--title", help="Name of the motor.")] = "",
    numbers: Annotated[
        list[str] | None,
        typer.Option("--number", "-n", help="A number as it is printed, e.g. inertia='48 gcm2'; may be repeated."),
    ] = None,
    source: Annotated[str, typer.Option("--source", help="Where the numbers come from.")] = "",
    list_numbers: Annotated[bool, typer.Option("--list", help="List the numbers that can be given, and stop.")] = False,
    unchecked: Annotated[bool, typer.Option("--unchecked", help="Accept numbers that contradict each other.")] = False,
) -> None:
    """Write a motor's file from its data sheet; in a terminal, missing numbers are asked for.

    A data sheet gives resistance and inductance of a phase or between two terminals, the torque constant per ampere
    peak or RMS, a back-EMF or KV; each has a number of its own, and is converted from the unit that is printed. Numbers
    that contradict each other are refused. Friction and cogging, which data sheets do not give, are taken from motors
    of its class; correct them in the file.
    """
    from drive_env.motors import MotorError, check_kind, load_motor, motor_of
    from drive_env.motors.plausibility import doubts

    with errors_as_exit_codes():
        if list_numbers:
            _list_numbers()
            return
        if file is None:
            raise ValueError("name the file to write: drive-env motor new my_motor.toml")
        check_free(file)
        if file.suffix != ".toml":
            raise ValueError(f"{file} must end with .toml, which distinguishes it from a motor's name")
        given = _given(numbers or [])
        if kind is None:
            kind = _asked("kind of motor, pmsm (brushless), dc (brushed) or stepper", "pmsm")
        check_kind(kind)
        while missing := _missing(kind, given):
            if not _is_answered():
                hint = f"; {ESTIMATES[missing[0][0]]}" if missing[0][0] in ESTIMATES else ""
                raise ValueError(
                    f"{' or '.join(missing[0])} is missing; give it with --number (--list describes it){hint}"
                )
            name, printed = _ask_for(missing[0])
            given |= _read(name, printed)
        where = source or _asked("source of the numbers (data sheet, revision)", "data sheet")
        data = {"title": title or file.stem, "kind": kind, "sources": {"data_sheet": where},
                "numbers": {name: [value, "data_sheet"] for name, (value, _) in given.items()}}  # fmt: skip
        try:
            row = motor_of(file.stem, data)
        except MotorError as error:
            raise ValueError(f"{error}; nothing was written") from None
        contradictions = [] if unchecked else doubts(row)
        for text in contradictions if _is_answered() else ():
            typer.echo(f"  {text}", err=True)
        if contradictions and not (_is_answered() and typer.confirm("keep these numbers", err=True)):
            raise ValueError(
                f"{'; '.join(contradictions)}; nothing was written (--unchecked keeps numbers that are right)"
            )
        _write(file, data, {name: printed for name, (_, printed) in given.items()})
        _tell(file, load_motor(file))


def _list_numbers() -> None:
    from drive_env import motors

    brushed = motors.OF_DC
    phases = (
        *motors.RESISTANCE, *motors.INDUCTANCE, *motors.INDUCTANCE_D, *motors.INDUCTANCE_Q, *motors.TORQUE_CONSTANT,
        *motors.RATED_CURRENT, "pole_pairs",
    )  # fmt: skip
    brushless = tuple(name for name in phases if name not in brushed)
    needed = motors.NEEDED
    of_stepper = tuple(name for name in (*motors.STEPPER_NEEDED, *motors.RATED_CURRENT, *motors.STEPPER_MAY))
    groups = {
        "every motor with or without brushes, all of them:": needed,
        "a brushless motor (pmsm), pole_pairs and one each of resistance, inductance, and torque constant, back-EMF or "
        "rated current:": brushless,
        "a brushed motor (dc), all of them:": brushed,
        "a two-phase stepper, all of the first six and one rated current; the others may be left out:": of_stepper,
        "what may be left out; then values of motors of its class are taken:": tuple(
            name for name in motors.NUMBERS if name not in (*needed, *brushless, *brushed, *motors.OF_STEPPER)
        ),
    }
    for title, names in groups.items():
        print(title)
        for name in names:
            row = motors.NUMBERS[name]
            print(f"  {name}: {row.meaning}" + (f" [{row.unit}]" if row.unit else ""))


def _given(texts: list[str]) -> dict[str, Printed]:
    found: dict[str, Printed] = {}
    for text in texts:
        name, _, value = (part.strip() for part in text.partition("="))
        found |= _read(name, value)
    return found


def _read(name: str, text: str) -> dict[str, Printed]:
    from drive_env.motors.data_sheet import read_number

    key, value = read_number(name, text)
    return {key: (value, text)}


def _missing(kind: str, given: Mapping[str, Printed]) -> list[tuple[str, ...]]:
    """Return the quantities that are still missing, each with the names of its forms."""
    from drive_env import motors

    if kind == "stepper":
        wanted: list[tuple[str, ...]] = [*((name,) for name in motors.STEPPER_NEEDED), motors.RATED_CURRENT]
        return [choice for choice in wanted if not any(name in given for name in choice)]
    if kind == "dc":
        wanted = [("resistance_ohm",), ("inductance_h",), motors.DC_CONSTANT]
    else:
        forms = (motors.RESISTANCE, (*motors.INDUCTANCE, *motors.INDUCTANCE_D), motors.TORQUE_CONSTANT)
        wanted = [tuple(name for name in form if name not in motors.OF_DC) for form in forms]
        if any(name in given for name in motors.RATED_CURRENT):
            wanted.pop()  # the torque constant follows from the rated point
        wanted += [(name.replace("_d_", "_q_"),) for name in motors.INDUCTANCE_D if name in given]
        wanted.append(("pole_pairs",))
    wanted += [(name,) for name in motors.NEEDED]
    return [choice for choice in wanted if not any(name in given for name in choice)]


def _ask_for(choice: tuple[str, ...]) -> tuple[str, str]:
    """Return the form of a quantity that the user chooses, and the typed value."""
    from drive_env.motors import NUMBERS

    name = choice[0]
    if len(choice) > 1:
        for number, each in enumerate(choice, 1):
            typer.echo(f"  {number}: {NUMBERS[each].meaning} [{NUMBERS[each].unit}]", err=True)
        which = _asked(f"which of these does the data sheet give (1 to {len(choice)})", "1")
        if not which.isdigit() or not 1 <= int(which) <= len(choice):
            raise ValueError(f"{which!r} is not one of 1 to {len(choice)}")
        name = choice[int(which) - 1]
    row = NUMBERS[name]
    return name, _asked(f"{row.meaning}{f' [{row.unit}, or with its unit]' if row.unit else ''}", "")


def _is_answered() -> bool:
    """Return whether a user at a terminal can answer."""
    return sys.stdin.isatty()


def _asked(what: str, default: str) -> str:
    """Ask at a terminal; without one name the option instead."""
    if not _is_answered():
        raise ValueError(f"{what} is missing; give it as an option (--kind, --source)")
    return str(typer.prompt(what, default=default or None, err=True))


def _write(file: Path, data: Mapping[str, object], printed: Mapping[str, str]) -> None:
    from drive_env.motors import NUMBERS
    from drive_env.whole_file import write_whole

    sources, numbers = data["sources"], data["numbers"]
    assert isinstance(sources, dict) and isinstance(numbers, dict)
    lines = [f"title = {json_text.dumps(data['title'])}", f"kind = {json_text.dumps(data['kind'])}", "", "[sources]"]
    lines += [f"{name} = {json_text.dumps(text)}" for name, text in sources.items()]
    lines += ["", "[numbers]  # each with its source"]
    for name, (value, source) in numbers.items():
        unit = f"{NUMBERS[name].unit}, " if NUMBERS[name].unit else ""
        typed = f": {printed[name]}" if printed[name] != repr(value) else ""
        lines.append(f'{name} = [{value!r}, "{source}"]  # {unit}{NUMBERS[name].meaning}{typed}')
    write_whole(file, "\n".join(lines) + "\n")


def _tell(file: Path, row: Motor) -> None:
    """Print figures derived from a motor's numbers, by which the user may notice a wrong number."""
    from drive_env.devices import device_names, find_device
    from drive_env.firmware import motor_kinds
    from drive_env.motors import is_extra_low
    from drive_env.motors.plausibility import no_load_speed

    no_load, rpm = no_load_speed(row), 30.0 / math.pi
    print(f"{file}: {row.title}")
    inductance = " and ".join(f"{1e3 * each:.4g}" for each in dict.fromkeys((row.L_d, row.L_q)))
    print(f"  a phase: {row.R_s:.4g} ohm, {inductance} mH; rated current {row.rated_current:.3g} A peak")
    if row.kind == "stepper":
        print(f"  holding torque {row.rated_torque:.4g} N*m, detent torque {row.cogging_torque:.3g} N*m")
        print(f"  {row.voltage:g} V carry the rated current up to {row.rated_speed * rpm:.0f} rpm")
    else:
        print(f"  torque constant {row.torque_constant:.4g} N*m/A of peak i_q; {no_load * rpm:.0f} rpm without load")
        print(f"  rated power {row.rated_torque * row.rated_speed:.3g} W")
    of_kind = [device for device in map(find_device, device_names()) if row.kind in motor_kinds(device.firmware_name)]
    # A device of another voltage class need not support it.
    of_kind = [one for one in of_kind if is_extra_low(one.highest_supply) == is_extra_low(row.voltage)] or of_kind
    refused = {}
    for device in of_kind:
        try:
            device.preset(row)
        except ValueError as error:
            refused[device.name] = error
    print(f"  drives that turn it: {', '.join(one.name for one in of_kind if one.name not in refused) or 'none'}")
    for name, why in refused.items():
        print(f"  {name} cannot turn it: {why}")
