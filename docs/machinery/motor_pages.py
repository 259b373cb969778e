"""The page of the motors: every number with its source."""

from __future__ import annotations

import math
import tomllib

from tables import table, unit

from drive_env.motors import FOLDER, MOTORS, NUMBERS, RANGES, Motor

PAGE = """# Motors

`motor="qbl4208"` in Python and `--motor qbl4208` of the commands take a name of this page; `drive-env list motors`
prints them. A motor of your own is a file of the same form (`drive-env motor new` asks for the data sheet's numbers and
writes it): `--motor my_motor.toml`.

All numbers are SI; resistance, inductance and currents are those of one phase, currents are peak i_q. The torque
constant is the torque per ampere of peak i_q. What a data sheet gives otherwise (between two terminals, RMS, per rpm)
is converted when the file is read; the tables below show the numbers as the files have them, each with its source.

{table}
Of a stepper the rated torque is the holding torque, the rated current the peak of a phase, and the rated speed the one
up to which its supply carries that current. Servo drives do not turn steppers, nor stepper drives other motors.

With `randomise=True` each machine's motor differs from its row, by these factors:

{ranges}
"""


def pages() -> dict[str, str]:
    """Return the page."""
    head = (
        "name", "kind", "voltage [V]", "rated torque [N·m]", "rated current [A]", "rated speed [rpm]",
        "torque constant [N·m/A]", "R [Ω]", "L [mH]", "inertia [kg·m²]", "pole pairs", "encoder [counts]",
    )  # fmt: skip
    rows = [summary(one) for one in MOTORS.values()]
    factors = [(f"`motor.{name}`", f"{low:g} to {high:g}") for name, (low, high) in RANGES.items()]
    text = PAGE.format(table=table(head, rows), ranges=table(("parameter", "factor"), factors))
    return {"reference/motors.md": "\n".join([text, *(section(one) for one in MOTORS.values())])}


def summary(motor: Motor) -> tuple[object, ...]:
    """Return the row of a motor."""
    return (
        f"[`{motor.name}`](#{motor.name})",
        {"pmsm": "brushless", "dc": "brushed DC", "stepper": "stepper"}[motor.kind],
        motor.voltage,
        motor.rated_torque,
        f"{motor.rated_current:.3g}",
        f"{motor.rated_speed * 30.0 / math.pi:.0f}",
        f"{motor.torque_constant:.3g}",
        f"{motor.R_s:.3g}",
        f"{1e3 * motor.L_q:.3g}",
        f"{motor.inertia:.3g}",
        None if motor.kind == "dc" else motor.n_p,
        motor.encoder_counts,
    )


def section(motor: Motor) -> str:
    """Return a motor's numbers, with their sources, as its file has them."""
    data = tomllib.loads((FOLDER / f"{motor.name}.toml").read_text(encoding="utf-8"))
    rows = []
    for name, (value, source) in data["numbers"].items():
        known = NUMBERS[name]
        rows.append((f"`{name}`", known.meaning, value, unit(known.unit), data["sources"].get(source, source)))
    head = ("number", "meaning", "value", "unit", "source")
    return f"## {motor.name} {{#{motor.name}}}\n\n{motor.title}.\n\n{table(head, rows)}"
