"""`drive-env objects`: search the dictionary of a device, without a bus."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from drive_env.commands.options import DeviceName, Eds, Json, errors_as_exit_codes, grouped, print_json
from drive_env.commands.tables import Column, print_table
from drive_env.default_device import DEFAULT_DEVICE

if TYPE_CHECKING:
    from drive_env.dictionary.entries import Entry


@grouped
def objects(
    words: Annotated[
        list[str] | None, typer.Argument(metavar="[WORD]...", help="Parts of index, name or unit; all must occur.")
    ] = None,
    *,
    device: DeviceName = DEFAULT_DEVICE,
    eds: Eds = None,
    area: Annotated[str | None, typer.Option(help="Only these: communication, manufacturer or profile.")] = None,
    json: Json = False,
) -> None:
    """Search the objects of a device, with type, unit, access and limits; no bus is needed.

    Objects of a drive's further axes are those of axis 0 for `get --axis` and `set --axis`. Exit code 1 if none is
    found.
    """
    from drive_env.dictionary.search import AREAS, area_of, searched
    from drive_env.fieldbus.description import describe
    from mechanics.reading.near_names import did_you_mean

    with errors_as_exit_codes():
        if area is not None and area not in AREAS:
            raise ValueError(f"there are {', '.join(AREAS)}, not {area!r}{did_you_mean(area, list(AREAS))}")
        known = describe(device, eds)
        found = searched(known.dictionary, " ".join(words or ()))
        found = sorted(
            (one for one in found if area in (None, area_of(one.index))), key=lambda one: (one.index, one.sub)
        )
        if not found:
            where = "" if area is None else f" in the area {area}"
            raise RuntimeError(
                f"{known.name} has no object with {' '.join(words or ['anything'])!r}{where}; "
                "try another word, or fewer"
            )
        if json:
            print_json([
                {"index": f"{one.index:04X}", "sub": one.sub, "name": one.name, "type": _type(one), "unit": one.unit,
                 "access": one.access, "low": one.low, "high": one.high, "default": one.default}
                for one in found
            ])  # fmt: skip
            return
        columns = [Column("object", "name"), Column("name", "text"), Column("type", "name"), Column("unit", "name"),
                   Column("access", "name"), Column("limits", "text")]  # fmt: skip
        rows = [(f"{one.index:04X}:{one.sub:02X}", one.name, _type(one), one.unit, one.access, _limits(one))
                for one in found]  # fmt: skip
        print_table(columns, rows)


def _type(entry: Entry) -> str:
    """Return an object's data type by the names of CiA 301; "text" if it is not an integer."""
    if entry.bits is None:
        return "text"
    return "BOOLEAN" if entry.bits == 1 else f"{'INTEGER' if entry.signed else 'UNSIGNED'}{entry.bits}"


def _limits(entry: Entry) -> str:
    return "" if entry.low is None or entry.high is None else f"{entry.low} to {entry.high}"
