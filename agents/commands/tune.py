"""`drive-agent tune`: a trained tuner finds the gains of a drive on the CAN bus."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from agents.commands.options import (
    REFUSED,
    Bitrate,
    Channel,
    Interface,
    Json,
    Nodes,
    Out,
    errors_as_exit_codes,
    fail,
    new_folder,
    print_json,
)
from drive_env.commands.options import DeviceName, Yes, look_first, names_a_bus
from drive_env.commands.tables import print_lines
from drive_env.default_device import DEFAULT_DEVICE
from tuning.commands.options import (
    DriveOptions,
    DynamicsOption,
    MotorName,
    Supply,
    TravelRange,
    ask_to_turn,
    asked_dynamics,
    open_target,
)

PATIENCE = 30.0  # s, for a node in this process: one that is slow says that the computer is busy, not that it is gone

if TYPE_CHECKING:
    from agents.tuner.tune_target import TrialShown
    from agents.tuner.tuning_run import TunerRun
    from tuning.target import Target


def tune(
    context: typer.Context,
    agent: Annotated[str, typer.Argument(help="Agent: one that ships, by name, or a file (.npz).")] = "gain_tuning",
    interface: Interface = None,
    channel: Channel = None,
    node: Nodes = None,
    bitrate: Bitrate = None,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="For emulated drives served with --lockstep: time passes by SYNC.")
    ] = (False),
    device: DeviceName = DEFAULT_DEVICE,
    motor: MotorName = None,
    load: Annotated[str, typer.Option(help="Load of the emulated drive, where no --interface is given.")] = "two_mass",
    seed: Annotated[
        int | None,
        typer.Option(
            min=0, help="Draw the emulated machine's parameters at random, with this seed.", show_default="default"
        ),
    ] = None,
    supply: Supply = None,
    travel: TravelRange = None,
    dynamics: DynamicsOption = None,
    trials: Annotated[int | None, typer.Option(help="Trials.", show_default="the agent's own, 10")] = None,
    store: Annotated[
        bool,
        typer.Option("--store/--no-store", help="Store the gains in the drive, so that they survive a power cycle."),
    ] = True,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print what would be done with this drive; write nothing, move nothing.")
    ] = False,
    out: Out = None,
    yes: Yes = False,
    json: Json = False,
) -> None:
    """A trained agent tunes a drive, trial by trial, inside the safety envelope; PyTorch is not needed.

    Without options for a bus an emulated drive is served as a CANopen node and used like a real one. Writes
    before.toml, with which `drive-tune undo` restores the state before, certificate.json and report.html.
    """
    with errors_as_exit_codes():
        bus = names_a_bus(context)
        if bus and seed is not None:
            raise ValueError("--seed draws an emulated machine; leave it out on a bus")
        from agents.tuner.known_range import outside
        from agents.tuner.open_tuner import open_tuner
        from tuning.way_back import way_back

        asked_dynamics(dynamics, device)  # a drive without a linear model has none
        policy = open_tuner(agent, device, trials, dynamics)
        folder = new_folder(out, "agent-tune")
        with ExitStack() as stack:
            stack.enter_context(way_back(folder / "before.toml" if bus else None, "drive-agent"))
            if not bus:
                target = stack.enter_context(_emulated_node(device, motor, load, seed, supply, travel))
            else:
                if dry_run:
                    look_first(interface, channel, node or [1], bitrate, device)
                drive = DriveOptions(
                    bus=True, device=device, motor=motor, interface=interface, channel=channel, nodes=node,
                    bitrate=bitrate, lockstep=lockstep, supply=supply, travel=travel,
                )  # fmt: skip
                target = stack.enter_context(open_target(drive))
            doubts = outside(policy.bundle, target, None if bus else load)
            for doubt in doubts:
                print(f"drive-agent: {doubt}", file=sys.stderr)
            if dry_run:
                if not _tell_plan(target, policy, store, json):
                    fail("a run would not start: see the lines with 'no'", REFUSED)
                return
            if bus:
                ask_to_turn(node, yes, interface)
            result = _run(target, policy, folder, agent, doubts, store, json)
        _report(result, folder, json, bus)


@contextmanager
def _emulated_node(
    device: str, motor: str | None, load: str, seed: int | None, supply: float | None, travel: str | None
) -> Iterator[Target]:
    """Serve an emulated drive on a hub of its own and reach it over that; each of its axes turns a load of its own."""
    from drive_env import EmulatedDrives
    from drive_env.bus.hub import Hub
    from drive_env.bus.server import Server
    from drive_env.bus.world import World
    from drive_env.devices import find_device
    from tuning.commands.options import parse_travel
    from tuning.target import emulated, on_bus

    volts = supply
    with emulated(device, load, motor, travel=None if travel is None else parse_travel(travel)) as own:
        ways = [(float(low), float(high)) for low, high in zip(own.low, own.high, strict=True)]
        name = own.machine
        own.drives.advance(0.001)  # compiles the kernels, the first time: a node that does would not answer in time
    if len(ways) > 1:
        raise ValueError(f"load {load!r} has {len(ways)} axes; an agent tunes axes one by one: choose a load with one")
    count = find_device(device).num_axes
    drives = EmulatedDrives(device, load, motor, supply=volts, num_machines=count)
    if seed is not None:
        import numpy as np

        from drive_env.randomisation.random_machines import RandomMachines, laws_of

        laws = laws_of(load, drives.device, drives.machine.parameters)
        draws = [np.random.default_rng(seed if axis == 0 else (seed, axis)) for axis in range(count)]
        RandomMachines(drives, laws).redraw(draws, np.ones(count, bool), 1.0)
    world = World()
    world.add(drives, [1])
    hub = Hub()
    try:
        with Server(world, hub), on_bus(
            device, motor, interface="slcan", channel=hub.channel, nodes=[1], supply=volts, travel=ways * count,
            pace="lockstep", timeout=PATIENCE,
        ) as target:  # fmt: skip
            from dataclasses import replace

            yield replace(target, machine=f"{name}, emulated, node 1 of {hub.channel}")
    finally:
        world.close()


def _tell_plan(target: Target, policy: Any, keep: bool, json: bool) -> bool:
    """Print the checks and the plan of a run; the drive is only read. Return whether a run would start."""
    from agents.tuner.rehearsal import rehearse

    found = rehearse(target, keep=keep)
    trials = policy.bundle.configuration["trials"]
    if json:
        print_json(
            {
                "would run": not found.refused,
                "checks": [check._asdict() for check in found.checks],
                "writes": [write._asdict() for write in found.writes],
            }
        )
        return not found.refused
    lines = [f"dry run on {target.device.name}, {target.motor.name}, {target.machine}: the drive is only read"]
    lines += [f"  {check.verdict:<4}  {check.what}: {check.found}" for check in found.checks]
    lines.append(
        f"a run would identify the axis (about 4 s), make 1 + {trials} trials of 3 moves of 250 ms (stopped within 50 "
        "ms if it oscillates), record a move, measure the frequency response, and move with the gains before; then "
        "the drive gets the new gains if they pass, or its gains from before. It would write:"
    )
    lines += [_what_is_written(list(group)) for _, group in groupby(found.writes, key=lambda write: write.why)]
    lines += [
        "Objects not marked 'stays' are restored at the end, and all of them if the run fails.",
        "Nothing was written.",
    ]
    print_lines(lines)
    return not found.refused


def _what_is_written(group: list[Any]) -> str:
    """Return the lines of objects that are written for the same purpose: objects, present values, new values."""
    first = group[0]
    objects = ", ".join(f"{index:04X}h:{sub:02X}" for index, sub in (write.key for write in group))
    values = [value for write in group for value in write.present or ()]
    now = ", ".join(f"{value:X}h" if first.key[0] < 0x2000 else str(value) for value in values) or "not there"
    to = f", then {first.values}" if first.values else ""
    return f"  {objects}: {first.why}; now {now}{to}{'; stays' if first.stays else ''}"


def _run(
    target: Target, policy: Any, folder: Path, agent: str, doubts: Sequence[str], store: bool, json: bool
) -> TunerRun:
    from agents.tuner.open_tuner import remark, titles_of_trials
    from agents.tuner.tuning_run import run
    from tuning.certificate.certificate_files import certificate_files

    known = target.device.gains
    outer = known.columns_of("velocity", "position")
    titles = titles_of_trials(known)
    widths = [max(len(title) + 1, 11) for title in titles]

    def show(trial: TrialShown) -> None:
        if json:
            return
        figures = "".join(f" {value:>{width}}" for value, width in zip(trial.gains[0, outer], widths, strict=True))
        print_lines([f"{trial.number or 'rule':>5}{figures} {trial.measured[0]:>8.3f}  {remark(trial)}".rstrip()])

    def say(what: str) -> None:
        if not json:
            print(what, flush=True)
            if what == "trials":
                print("The cost J (less is better) counts settling time, stiffness, noise and")
                print("overshoot of a move, its reversal and a move with 1.5 times velocity P, which")
                print("shows how near the gains are to oscillation.")
                names = (f" {title:>{width}}" for title, width in zip(titles, widths, strict=True))
                print(f"trial{''.join(names)} {'J':>8}")

    if not json:
        print_lines([f"agent {agent} tunes {target.device.name} with {target.motor.name}: {target.machine}"])
    folder.mkdir(parents=True, exist_ok=True)
    return run(
        target, policy, folder / "before.toml", name=agent, doubts=doubts, keep=store, show=show, say=say,
        files=lambda certificate: certificate_files(certificate, folder, target.inputs),
    )  # fmt: skip


def _report(done: TunerRun, folder: Path, json: bool, bus: bool) -> None:
    result, rule = done.result, float(done.trials[0].measured[0]) if done.trials else None
    axis, seconds = result.axes[0], float(result.drive_seconds[0])
    refused = [
        f"axis {k}: rejected, and its gains from before are restored: {one.reason}"
        for k, one in enumerate(result.axes)
        if not one.accepted
    ]
    if json:
        print_json(
            {
                "verdict": axis.verdict, "accepted": not refused, "reason": axis.reason,
                "reservations": axis.reservations, "notes": axis.notes, "before": list(axis.before),
                "after": list(axis.after), "J of the rule": rule, "J": axis.proof, "drive seconds": seconds,
                "stored": result.kept, "certificate": str(folder / "certificate.json"),
                "report": str(folder / "report.html"),
            }
        )  # fmt: skip
    else:
        _print(done, refused)
        undo = ", before.toml for `drive-tune undo`" if bus else ""  # an emulated drive ended with this program
        print_lines([f"written to {folder}: report.html to read, certificate.json{undo}"])
    if refused:
        raise typer.Exit(REFUSED)


def _print(done: TunerRun, refused: list[str]) -> None:
    from drive_env.devices import find_device

    result = done.result
    axis, certified = result.axes[0], done.certificate.axes[0]
    titles = find_device(done.certificate.device).gains.titles
    width = max(12, *(len(title) + 2 for title in titles))
    lines = [f"{'':<7}{''.join(f'{name:>{width}}' for name in titles)}"]
    for name, gains in (("before", axis.before), ("after", axis.after)):
        lines.append(f"{name:<7}{''.join(f'{value:>{width}}' for value in gains)}")
    if axis.accepted and (said := _answer(done)):
        lines.append(said)
    if axis.accepted and done.trials:
        lines.append(
            f"J {axis.proof:.3f}; {certified.hardware_seconds:.1f} s of drive time, trials stopped: {certified.aborts}"
        )
    for loop in certified.frequency_responses:
        if loop.tuned:
            margins = (f"{n} {v:.3g}" if math.isfinite(v) else f"{n} not measured" for n, v in loop.margins.items())
            lines.append(f"{loop.name}: {', '.join(margins)}")
    if axis.accepted:
        lines.append(axis.verdict)
    lines += [f"reservation: {reservation}" for reservation in axis.reservations]
    lines += [*axis.notes, *refused]
    if not refused:
        lines.append(
            "the new gains are stored in the drive"
            if result.kept
            else "the new gains are not stored: they are lost when the drive is switched off (--store stores them)"
        )
    print_lines(lines)


def _answer(done: TunerRun) -> str:
    """Return which trial the agent chooses, and why if another one measured better; "" if it chooses no trial."""
    from agents.tuner.tune_target import best_good

    after = tuple(done.result.axes[0].after)
    own = next((trial for trial in done.trials if tuple(trial.gains[0]) == after), None)
    if own is None:
        return ""
    which = f"trial {own.number}" if own.number else "the baseline rule's gains"
    best = best_good(done.trials, 0)
    if best is None or best.measured[0] >= own.measured[0]:
        return f"the agent chooses {which}, the best"
    return (
        f"the agent chooses {which}: by its estimate from all trials, the J of {best.measured[0]:.3f} of trial "
        f"{best.number} would not be repeated"
    )
