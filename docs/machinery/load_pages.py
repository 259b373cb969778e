"""The loads: an index with pictures, and a page for each with its parts and parameters."""

from __future__ import annotations

import math
from pathlib import Path

from tables import table, unit

from mechanics.load import Combination, Load
from mechanics.loads import LOADS
from mechanics.shaft import one

FOLDER = "reference/loads"
PICTURES = Path(__file__).resolve().parent.parent / "assets" / "loads"
INDEX = """# Loads

`load="belt"` in Python and `--load belt` of the commands take a name of this page. Each is a MuJoCo model
(`mechanics/models/`) with a row of data (`mechanics/loads.py`); they are sized for a motor of 50 W. A load of your own
is the path of an MJCF file: `load="my_machine.xml"`.

All have friction, of the kind that is asked for: `friction="stribeck"` (the default), `"none"`, `"coulomb_viscous"` or
`"lugre"`.

<div class="grid pictures" markdown>
{cards}
</div>

{table}"""


def pages() -> dict[str, str]:
    """Return the index and a page for each load.

    Raises:
        ValueError: For a load whose picture is missing, with the command that draws it.
    """
    for load in LOADS.values():
        if not (PICTURES / f"{load.name}.webp").exists():
            raise ValueError(f"{load.name} has no picture; draw it with python docs/machinery/pictures.py loads")
    cards = "\n".join(
        f"[![{load.meaning}](../../assets/loads/{load.name}.webp){{ loading=lazy }}\n`{load.name}`]({load.name}.md)\n"
        for load in LOADS.values()
    )
    rows = [(f"[`{load.name}`]({load.name}.md)", load.meaning, load.num_axes) for load in LOADS.values()]
    index = INDEX.format(cards=cards, table=table(("name", "what it is", "drives"), rows))
    return {f"{FOLDER}/index.md": index, **{f"{FOLDER}/{load.name}.md": page(load) for load in LOADS.values()}}


def page(load: Load) -> str:
    """Return the page of a load."""
    parts = [
        f"# {load.name}\n",
        f"{load.meaning[0].upper()}{load.meaning[1:]}.\n",
        f"![{load.name}](../../assets/loads/{load.name}.webp){{ width=480 }}\n",
        f"Film it: `drive-env render --load {load.name} --out {load.name}.gif`. Environments draw it from "
        f"[these ranges](../environments/distributions.md#{load.name}).\n",
        "## Drives\n",
        drives(load),
        parameters(load),
        frictions(load),
    ]
    if load.contacts:
        parts.append(contacts(load))
    if load.switches:
        parts.append(switches(load))
    if load.rolls:
        head = ("roll", "joint", "radius at the start [m]", "core [m]", "web thickness [m]", "density [kg/m²]")
        rows = [(one.name, one.joint, one.start, one.core, one.thickness, one.density) for one in load.rolls]
        parts.append("## Rolls\n\nThe radius grows with every turn.\n\n" + table(head, rows))
    return "\n".join(parts)


def drives(load: Load) -> str:
    """Return a table of the joint, gear and travel of each drive."""
    rows = []
    for axis, (joint, gear) in enumerate(zip(load.joints, load.gears, strict=True)):
        travel = load.travel[axis] if axis < len(load.travel) else None
        way = "endless" if travel is None else f"{travel[0]:g} to {travel[1]:g}"
        rows.append((axis, f"`{joint}`", f"{gear:.5g}", way))
    text = table(("axis", "joint", "rotor angle per unit of the joint [1 or rad/m]", "travel [rad or m]"), rows)
    text += f"\nThe external load torque or force (`drives.machine.load_torque`) is in {unit(load.disturbance_unit)}.\n"
    if load.start:
        text += f"\nA run begins with {motion(load.start)} [rad or m], everything else at 0.\n"
    return text


def parameters(load: Load) -> str:
    """Return a table of the parameters that each machine may have its own of."""
    alone = one(load)
    rows = []
    for row in load.parameters:
        value = float(alone.get(row.name)[0])
        what = f"{row.name.replace('_', ' ')} {row.meaning}" if row.meaning.startswith("of ") else row.meaning
        rows.append((f"`load.{row.name}`", what, value, f"{row.low * value:g} to {row.high * value:g}", unit(row.unit)))
    return (
        "## Parameters\n\nEach can be set for each machine, at any time: "
        f"`drives.machine.set({{{rows[0][0].replace('`', chr(34))}: ...}})`. *Range* is what `randomise=True` draws "
        "from.\n\n" + table(("parameter", "meaning", "default", "range", "unit"), rows)
    )


def frictions(load: Load) -> str:
    """Return the friction of each motion."""
    rows = [
        (f.name, motion(f.motion), f.coulomb, f.breakaway, f.stribeck, f.viscous, f.drag or None,
         None if f.efficiency == 1.0 else f.efficiency)
        for f in load.frictions
    ]  # fmt: skip
    head = (
        "where", "motion", "Coulomb [N·m or N]", "breakaway [N·m or N]", "Stribeck speed [rad/s or m/s]",
        "viscous [N·m·s/rad or N·s/m]", "drag [N·m·s²/rad²]", "efficiency",
    )  # fmt: skip
    return "## Friction\n\n" + table(head, rows)


def contacts(load: Load) -> str:
    """Return end stops and backlash."""
    rows = [
        (c.name, motion(c.motion), f"{c.low:g} to {c.high:g}", c.stiffness, c.damping,
         "backlash" if c.transmits else "end stop")
        for c in load.contacts
    ]  # fmt: skip
    head = ("where", "motion", "free from, to [rad or m]", "stiffness [N·m/rad or N/m]",
            "damping [N·m·s/rad or N·s/m]", "kind")  # fmt: skip
    return "## End stops and backlash\n\n" + table(head, rows)


def switches(load: Load) -> str:
    """Return where switches are pressed."""
    rows = [(one.axis, one.kind, f"{one.low:g} to {one.high:g}") for one in load.switches]
    return "## Switches\n\n" + table(("axis", "switch", "pressed from, to [rad or m]"), rows)


def motion(combination: Combination) -> str:
    """Return a combination of joints, e.g. pulley + stretch."""
    terms = []
    for name, factor in combination.items():
        times = "" if math.isclose(abs(factor), 1.0) else f"{abs(factor):.4g} · "
        terms.append(("- " if factor < 0 else "+ ") + times + f"`{name}`")
    return " ".join(terms).removeprefix("+ ")
