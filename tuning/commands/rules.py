"""`drive-tune rules`: what every rule proposes for an axis, and what its loops would be worth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tuning.commands.options import (
    Bitrate,
    Bus,
    Channel,
    DeviceName,
    Interface,
    Json,
    LoadName,
    Lockstep,
    Machines,
    MotorName,
    Nodes,
    Randomise,
    Seed,
    Supply,
    TravelRange,
    Yes,
    ask,
    ask_to_turn,
    errors_as_exit_codes,
    open_target,
    print_json,
    progress_bar,
)

if TYPE_CHECKING:
    from tuning.linear_model import Plant
    from tuning.proposal import Proposal
    from tuning.target import Target

MEASURED = "relay, measured"
POINTS = 1500  # frequencies at which margins are looked for


def rules(
    rule: Annotated[list[str] | None, typer.Argument(help="Rules by name; all by default.")] = None,
    bus: Bus = False,
    device: DeviceName = "tmcm1636",
    motor: MotorName = "qbl4208",
    load: LoadName = "two_mass",
    seed: Seed = 0,
    machines: Machines = 1,
    randomise: Randomise = False,
    interface: Interface = None,
    channel: Channel = None,
    node: Nodes = None,
    bitrate: Bitrate = None,
    lockstep: Lockstep = False,
    supply: Supply = None,
    travel: TravelRange = None,
    relay: Annotated[bool, typer.Option("--relay", help="Swing the axis by a relay, too, and show what that says.")] = (
        False
    ),
    apply: Annotated[str | None, typer.Option("--apply", help="Write this rule's gains to the drive.")] = None,
    store: Annotated[bool, typer.Option("--store", help="Have the drive keep them over a power cycle.")] = False,
    snapshot: Annotated[
        Path | None,
        typer.Option(
            help="File for the state before, with --apply.", show_default="runs/<timestamp>-rules/before.toml"
        ),
    ] = None,
    yes: Yes = False,
    json: Json = False,
) -> None:
    """Identify an axis and show the gains that each rule proposes, with the margins they would have.

    Margins are those of the velocity loop on the identified model. Notes say what no integer reaches.
    """
    with errors_as_exit_codes():
        from tuning.rules import RULES

        chosen = rule or list(RULES)
        for name in [*chosen, *([apply] if apply else [])]:
            if name not in RULES:
                raise ValueError(f"no rule is named {name!r}; there are {', '.join(RULES)}")
        if store and not apply:
            raise ValueError("--store keeps what --apply writes; add --apply RULE, or leave it out")
        if snapshot is not None and not apply:
            raise ValueError("--snapshot is where --apply keeps the state before; add --apply RULE, or leave it out")
        if bus and travel is not None:
            ask_to_turn(node, yes)
        with open_target(
            bus=bus, device=device, motor=motor, load=load, seed=seed, machines=machines, randomise=randomise,
            interface=interface, channel=channel, nodes=node, bitrate=bitrate, lockstep=lockstep, supply=supply,
            travel=travel,
        ) as target:  # fmt: skip
            plants = _identified(target)
            proposals = [_propose(target, plant, chosen) for plant in plants]
            swung = _swing(target, plants) if relay else [""] * len(plants)
            for rows, measured in zip(proposals, swung, strict=True):
                if not isinstance(measured, str):
                    rows[MEASURED] = measured
            unswung = [measured if isinstance(measured, str) else "" for measured in swung]
            axes = list(zip(plants, proposals, unswung, strict=True))
            if json:
                print_json([_as_json(target, *axis) for axis in axes])
            else:
                for k, (plant, rows, reason) in enumerate(axes):
                    _print(target, plant, rows, reason, k if len(plants) > 1 else None)
            if apply:
                _apply(target, plants, apply, snapshot, store=store, yes=yes)


def _identified(target: Target) -> list[Plant]:
    """Return what the axes are.

    Raises:
        ValueError: If no inertia was found: no rule works without.
    """
    from tuning.identification import identify
    from tuning.linear_model import Plant
    from tuning.proving import shaken_on_purpose

    with progress_bar("identifying") as show, shaken_on_purpose(target.drives):
        found = identify(target, progress=lambda what, share: show(share))
    return [
        Plant.from_identification(target.device, target.motor, float(target.supply[axis]), one)
        for axis, one in enumerate(found)
    ]


def _propose(target: Target, plant: Plant, names: Sequence[str]) -> dict[str, Proposal]:
    from tuning.rules import propose

    return {name: propose(name, target.device, target.motor, plant) for name in names}


def _swing(target: Target, plants: Sequence[Plant]) -> list[Proposal | str]:
    """Return what relay experiments say, with the current loops that the rule computes; or why one says nothing."""
    import numpy as np

    from drive_env.gains import write_gains
    from tuning.relay import gains_from_swing, relay_experiment, relay_rule
    from tuning.trial_bench import read_gains

    before = read_gains(target)
    gains = [relay_rule(target.device, target.motor, plant).gains for plant in plants]
    write_gains(target.drives, np.array(gains, np.int64))
    try:
        swing = relay_experiment(target)
    finally:
        write_gains(target.drives, before)
    found: list[Proposal | str] = []
    for axis, plant in enumerate(plants):
        try:
            if reason := swing.reason[axis]:
                raise ValueError(reason)
            found.append(gains_from_swing(target.device, plant, float(swing.slope[axis]), swing.ultimate(axis)))
        except ValueError as error:  # also from gains_from_swing: it was the load's resonance that swung
            found.append(str(error))
    return found


def _margins(target: Target, plant: Plant, proposal: Proposal) -> Any:
    import numpy as np

    from tuning.linear_model import velocity_open_loop
    from tuning.margins import margins

    f = np.geomspace(0.5, 0.49 * target.device.velocity_rate, POINTS)
    return margins(f, velocity_open_loop(target.device, plant, proposal.gains, f))


def _as_json(target: Target, plant: Plant, rows: Mapping[str, Proposal], unswung: str) -> dict[str, Any]:
    from dataclasses import asdict

    return {
        "plant": asdict(plant),
        "proposals": {
            name: {
                "gains": proposal.gains._asdict(),
                "wanted": dict(proposal.wanted),
                "notes": list(proposal.notes),
                "velocity_margins": _margins(target, plant, proposal)._asdict(),
            }
            for name, proposal in rows.items()
        },
    } | ({"no_relay": unswung} if unswung else {})


def _print(target: Target, plant: Plant, rows: Mapping[str, Proposal], unswung: str, axis: int | None) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    head = "" if axis is None else f"axis {axis}: "
    pair = f", resonances at {plant.anti_resonance:.0f} and {plant.resonance:.0f} Hz" if plant.is_elastic else ", rigid"
    title = f"{head}inertia {plant.inertia:.3g} kg m^2{pair}"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for title in ("rule", "2041h\nP", "I", "2042h\nP", "I", "2043h\nP", "cross\nHz", "phase\ndeg", "gain\ndB"):
        table.add_column(title, justify="left" if title == "rule" else "right", no_wrap=True)
    for name, proposal in rows.items():
        found = _margins(target, plant, proposal)
        figures = (found.crossover_hz, found.phase_deg, found.gain_db)
        table.add_row(name, *map(str, proposal.gains), *(f"{figure:.0f}" for figure in figures))
    console = Console()
    console.print(table)
    for name, proposal in rows.items():
        for note in proposal.notes:
            console.print(f"{name}: {note}", highlight=False, markup=False, soft_wrap=True)
    if unswung:
        console.print(f"{MEASURED}: nothing: {unswung}", highlight=False, markup=False, soft_wrap=True)


def _apply(
    target: Target, plants: Sequence[Plant], name: str, snapshot: Path | None, *, store: bool, yes: bool
) -> None:
    import numpy as np

    from drive_env.gains import write_gains
    from tuning.provenance import run_folder
    from tuning.rules import propose
    from tuning.snapshot import Transaction

    proposals = [propose(name, target.device, target.motor, plant) for plant in plants]
    ask(f"Write the gains of {name} to {'the axis' if target.num_axes == 1 else f'{target.num_axes} axes'}?", yes)
    file = run_folder("rules") / "before.toml" if snapshot is None else snapshot
    with Transaction(target, file) as transaction:
        write_gains(target.drives, np.array([proposal.gains for proposal in proposals], np.int64))
        kept = store and transaction.store()
        transaction.commit()
    way_back = (
        f"drive-tune restore {file} brings back what was" if target.bus else "emulated drives end with the program"
    )
    print(f"written{', and kept by the drive' if kept else ''}; {way_back}")
