"""`drive-tune rules`: shows the gains that tuning rules propose for an axis, with the margins they would have."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drive_env.commands.tables import Column, print_lines, print_table
from tuning.commands.options import (
    REFUSED,
    DynamicsOption,
    InertiaRangeOption,
    Json,
    TargetOptions,
    asked_dynamics,
    before_as_json,
    errors_as_exit_codes,
    fail,
    file_of,
    print_json,
    progress_bar,
    takes,
    tell_before,
    unchanged,
)

if TYPE_CHECKING:
    from drive_env.devices.gain_set import GainSet
    from drive_env.loops.dynamics import Dynamics
    from tuning.compare.side_by_side import AxisRules
    from tuning.target import Target

MEASURED = "relay, measured"


@takes
def rules(
    drive: TargetOptions,
    rule: Annotated[list[str] | None, typer.Argument(help="Rules by name; all by default.")] = None,
    relay: Annotated[
        bool, typer.Option("--relay", help="Also make the axis swing by relay feedback, and show the gains from that.")
    ] = (False),
    dynamics: DynamicsOption = None,
    inertia_range: InertiaRangeOption = None,
    json: Json = False,
) -> None:
    """Identify an axis and show the gains that each rule proposes, with the margins they would have.

    Margins of the velocity and the position loop are computed by the identified model. Gains keep the --dynamics if
    this axis keeps them, with the overshoot of a csp step, and its variants (load inertia at both ends of
    --inertia-range, x 0.5 and x 2 by default, stiffness x 0.8, velocity P x 0.67 and x 1.5) keep weaker margins. Notes
    name limits of the integer gains. Afterwards the drive has its own parameters; on a bus they are also saved to a
    file for `drive-tune undo`, in runs/. A rule's gains are written by `drive-tune auto --by rule`.
    """
    with errors_as_exit_codes():
        from tuning.compare.side_by_side import AxisRules, identified_plants, proposals, swung_proposals
        from tuning.rules.rules_by_name import RULES, check_rule

        chosen = rule or list(RULES)
        for name in chosen:
            check_rule(name)
        drive.check()
        drive.check_identifiable()
        asked = asked_dynamics(dynamics, drive.device, inertia_range)
        before = file_of(drive, "rules")
        with unchanged(drive, before) as (target, _):
            with progress_bar("identifying") as show:
                _, plants = identified_plants(target, lambda what, share: show(share))
            known = [plant for plant in plants if not isinstance(plant, str)]
            swung = swung_proposals(target, known) if relay and len(known) == len(plants) else [""] * len(plants)
            axes = [AxisRules(plant) for plant in plants]
            for axis, measured in zip(axes, swung, strict=True):
                if not isinstance(axis.plant, str):
                    axis.rows |= proposals(target, axis.plant, chosen)
                if isinstance(measured, str):
                    axis.unswung = measured
                else:
                    axis.rows[MEASURED] = measured
            if json:
                named = zip(target.axis_numbers, axes, strict=True)
                print_json([{"axis": k} | _as_json(target, axis, asked) | before_as_json(before) for k, axis in named])
            else:
                for k, axis in zip(target.axis_numbers, axes, strict=True):
                    _print(target, axis, asked, k if drive.axis or len(plants) > 1 else None)
            if not known:
                fail("no axis has an identified inertia, which every rule needs", REFUSED)
        if not json:
            tell_before(before)


def _as_json(target: Target, axis: AxisRules, dynamics: Dynamics) -> dict[str, Any]:
    from dataclasses import asdict

    from tuning.compare.side_by_side import outer_margins, slacks

    plant, rows = axis.plant, axis.rows
    if isinstance(plant, str):
        return {"no_plant": plant}
    slack = slacks(target, plant, rows, dynamics)
    return {
        "plant": asdict(plant),
        "dynamics": dynamics.name,
        "inertia_range": list(dynamics.inertia_range),
        "proposals": {
            name: {
                "gains": dict(zip(target.device.gains.names, proposal.gains, strict=True)),
                "wanted": dict(proposal.wanted),
                "notes": list(proposal.notes),
                "margins": {
                    loop: found._asdict() for loop, found in outer_margins(target.device, plant, proposal.gains).items()
                },
                "slack": slack[name],
                "keeps": slack[name] >= 0.0,
            }
            for name, proposal in rows.items()
        },
    } | ({"no_relay": axis.unswung} if axis.unswung else {})


def _print(target: Target, shown: AxisRules, dynamics: Dynamics, axis: int | None) -> None:
    from tuning.compare.side_by_side import outer_margins, slacks

    head, plant, rows = "" if axis is None else f"axis {axis}: ", shown.plant, shown.rows
    if isinstance(plant, str):
        print_lines([f"{head}{plant}"])
        return
    pair = f", resonances at {plant.anti_resonance:.0f} and {plant.resonance:.0f} Hz" if plant.is_elastic else ", rigid"
    low, high = dynamics.inertia_range
    title = (
        f"{head}inertia {plant.inertia:.3g} kg m^2{pair}; kept: by {dynamics.name} dynamics, load inertia x {low:g} to "
        f"x {high:g}"
    )
    titles = (*_gain_titles(target.device.gains), "velocity\n°/dB/Ms", "position\n°/dB/Ms", "kept")
    cells, slack = [], slacks(target, plant, rows, dynamics)
    for name, proposal in rows.items():
        found = outer_margins(target.device, plant, proposal.gains)
        cells.append(
            (name, *map(str, proposal.gains),
             *(f"{_figure(one.phase_deg)}/{_figure(one.gain_db)}/{one.ms:.1f}" for one in found.values()),
             "yes" if slack[name] >= 0.0 else "no")
        )  # fmt: skip
    print_table([Column("rule", "name"), *map(Column, titles)], cells, title)
    lines = []
    if plant.is_elastic and plant.damping == type(plant).damping:
        lines.append(
            "The damping of the resonance is not identified: margins are computed with a damping ratio of "
            f"{plant.damping:g}; `drive-tune response` measures them."
        )
    lines += [f"{name}: {note}" for name, proposal in rows.items() for note in proposal.notes]
    if shown.unswung:
        lines.append(f"{MEASURED}: no gains: {shown.unswung}")
    print_lines(lines)


def _figure(value: float) -> str:
    return f"{value:.0f}" if math.isfinite(value) else "-"


def _gain_titles(known: GainSet) -> list[str]:
    """Return a column's title for each gain: its part, and its object if that differs from the gain before."""
    told, titles = None, []
    for gain in known.rows:
        place = gain.loop, gain.key[0]
        titles.append(f"{'' if place == told else f'{gain.key[0]:04X}h'}\n{gain.part}")
        told = place
    return titles
