"""`drive-agent tune`: a trained tuner finds the gains of a drive on the CAN bus."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from agents.commands.options import (
    Bitrate,
    Channel,
    Interface,
    Json,
    Nodes,
    Out,
    errors_as_exit_codes,
    new_folder,
    print_json,
)
from drive_env.tools.options import DeviceName, Yes
from tuning.commands.options import MotorName, Supply, TravelRange

if TYPE_CHECKING:
    from agents.tuner import TrialShown
    from agents.tuning_run import Run
    from tuning.target import Target


def tune(
    agent: Annotated[str, typer.Argument(help="Agent: one that ships, by name, or a file (.npz).")] = "gain_tuning",
    interface: Interface = None,
    channel: Channel = None,
    node: Nodes = None,
    bitrate: Bitrate = None,
    lockstep: Annotated[bool, typer.Option("--lockstep", help="The bus is of emulated drives that wait for SYNC.")] = (
        False
    ),
    device: DeviceName = "tmcm1636",
    motor: MotorName = "qbl4208",
    load: Annotated[str, typer.Option(help="Load of the emulated drive, where no --interface is given.")] = "two_mass",
    seed: Annotated[
        int | None,
        typer.Option(help="Draw the emulated machine from the load's distributions.", show_default="default"),
    ] = None,
    supply: Supply = None,
    travel: TravelRange = None,
    trials: Annotated[int | None, typer.Option(help="Trials.", show_default="the agent's own, 10")] = None,
    store: Annotated[
        bool, typer.Option("--store/--no-store", help="Have a drive keep the gains over a power cycle.")
    ] = True,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be done with this drive; write nothing, move nothing.")
    ] = False,
    out: Out = None,
    yes: Yes = False,
    json: Json = False,
) -> None:
    """Let a trained agent tune a drive, trial by trial, inside the safety envelope; PyTorch is not needed.

    Without --interface an emulated drive is served as a CANopen node and reached over its bus as a real one would be.
    Writes before.toml, from which `drive-tune restore` brings back what was, certificate.json and report.html.
    """
    with errors_as_exit_codes():
        from agents.policy import load_policy
        from agents.shipped import find_agent
        from drive_env.tools.options import ask

        if interface is None and (channel is not None or node or bitrate is not None or lockstep):
            raise ValueError("--channel, --node, --bitrate and --lockstep are of a bus; give its --interface, too")
        if interface is not None and seed is not None:
            raise ValueError("--seed draws an emulated machine; leave it out with --interface")
        if trials is not None and trials < 1:
            raise ValueError(f"--trials {trials} must be 1 or more")
        policy = load_policy(find_agent(agent))
        if policy.bundle.environment != "ServoDrive/GainTuning-v0":
            raise ValueError(
                f"agent {agent} acts in {policy.bundle.environment}; a tuner acts in ServoDrive/GainTuning-v0"
            )
        if trials is not None:
            policy.bundle.configuration["trials"] = trials
        folder = new_folder(out, "agent-tune")
        with ExitStack() as stack:
            if interface is None:
                target = stack.enter_context(_emulated_node(device, motor, load, seed, supply, travel))
            else:
                target = stack.enter_context(_on_bus(interface, channel, node, bitrate, lockstep, device, motor, supply,
                                                     travel))  # fmt: skip
            if dry_run:
                _tell_plan(target, policy)
                return
            if interface is not None:
                ask(f"The motor of node {', '.join(map(str, node or [1]))} will turn. Is its way clear?", yes)
            result = _run(target, policy, folder, agent, store, json)
        _report(result, folder, json)


@contextmanager
def _emulated_node(
    device: str, motor: str, load: str, seed: int | None, supply: float | None, travel: str | None
) -> Iterator[Target]:
    """Serve an emulated drive on a hub of its own and reach it over that."""
    from drive_env import EmulatedDrives
    from drive_env.bus.hub import Hub
    from drive_env.bus.server import Server
    from drive_env.bus.world import World
    from tuning.commands.options import parse_travel
    from tuning.target import emulated, on_bus

    volts = supply
    with emulated(device, load, motor, travel=None if travel is None else parse_travel(travel)) as own:
        ways = [(float(low), float(high)) for low, high in zip(own.low, own.high, strict=True)]
        name = own.machine
        own.drives.advance(0.001)  # compiles the kernels, the first time: a node that does would not answer in time
    drives = EmulatedDrives(device, load, motor, supply=volts)
    if seed is not None:
        import numpy as np

        from drive_env.envs.randomisation import Distributions, RandomMachines

        RandomMachines(drives, Distributions.load(load)).redraw([np.random.default_rng(seed)], np.ones(1, bool), 1.0)
    if drives.num_axes > 1:
        drives.close()
        raise ValueError(f"load {load!r} has {drives.num_axes} drives; an agent tunes one: take a load with one")
    world = World()
    world.add(drives, [1])
    hub = Hub()
    try:
        with Server(world, hub), on_bus(
            device, motor, interface="slcan", channel=hub.channel, nodes=[1], supply=volts, travel=ways, pace="lockstep"
        ) as target:  # fmt: skip
            from dataclasses import replace

            yield replace(target, machine=f"{name}, emulated, node 1 of {hub.channel}")
    finally:
        world.close()


@contextmanager
def _on_bus(
    interface: str,
    channel: str | None,
    nodes: list[int] | None,
    bitrate: int | None,
    lockstep: bool,
    device: str,
    motor: str,
    supply: float | None,
    travel: str | None,
) -> Iterator[Target]:
    from tuning.commands.options import open_target

    with open_target(
        bus=True, device=device, motor=motor, interface=interface, channel=channel, nodes=nodes, bitrate=bitrate,
        lockstep=lockstep, supply=supply, travel=travel,
    ) as target:  # fmt: skip
        yield target


def _tell_plan(target: Target, policy: Any) -> None:
    """Print what a run would do; the drive is read, and nothing else."""
    from drive_env.gains import Gains
    from tuning.trial_bench import first_gains, read_gains

    has, begins = Gains(*map(int, read_gains(target)[0])), Gains(*map(int, first_gains(target)[0]))
    trials = policy.bundle.configuration["trials"]
    print(f"drive: {target.device.name}, motor {target.motor.name}, {target.machine}")
    print(f"gains that it has: {_gains_text(has)}")
    print(f"travel {target.low[0]:.3g} to {target.high[0]:.3g} rad from here, at most {target.speed:.4g} rad/s, "
          f"{target.current:.3g} A")  # fmt: skip
    print(f"it would begin with {_gains_text(begins)}, identify, and make 1 + {trials} trials of 3 moves of 250 ms;")
    print(
        "what oscillates would be stopped within 50 ms; gains lie within 1...32767; profile 6081h, 6083h, 6084h, mode"
    )
    print("6060h and controlword 6040h would be written. Nothing was written.")


def _run(target: Target, policy: Any, folder: Path, agent: str, store: bool, json: bool) -> Run:
    from agents.tuning_run import run

    def show(trial: TrialShown) -> None:
        if json:
            return
        mark = "stopped: it oscillated or tripped" if trial.aborted[0] else "better" if trial.better[0] else ""
        what = "rule" if trial.number == 0 else f"{trial.number}"
        velocity_p, velocity_i, position_p = trial.gains[0, 2:]
        print(
            f"{what:>5} {velocity_p:>11} {velocity_i:>11} {position_p:>11} {trial.measured[0]:>8.3f}  {mark}",
            flush=True,
        )

    def say(what: str) -> None:
        if not json:
            print(what, flush=True)
            if what == "trials":
                print("trial  velocity P  velocity I  position P        J")

    folder.mkdir(parents=True, exist_ok=True)
    return run(target, policy, folder / "before.toml", name=agent, keep=store, show=show, say=say)


def _report(result: Run, folder: Path, json: bool) -> None:
    certificate, report = result.certificate.save(folder)
    axis = result.certificate.axes[0]
    first, best = result.trials[0].measured[0], min(float(trial.measured[0]) for trial in result.trials)
    if json:
        print_json(
            {
                "before": axis.before, "after": axis.after, "J of the rule": float(first), "J": best,
                "drive seconds": axis.hardware_seconds, "stored": result.kept, "certificate": str(certificate),
                "report": str(report),
            }
        )  # fmt: skip
        return
    from drive_env.gains import Gains

    print(f"before: {_gains_text(Gains(*axis.before))}")
    print(f"after:  {_gains_text(Gains(*axis.after))}")
    print(f"J by measured terms {best:.3f}, {100.0 * best / first:.0f} % of the fitted rule's {first:.3f}; "
          f"{axis.hardware_seconds:.1f} s of drive time, {axis.aborts} trials stopped")  # fmt: skip
    print(f"written to {folder}: before.toml, certificate.json, report.html")


def _gains_text(gains: Any) -> str:
    return ", ".join(
        f"{name.replace('_p', ' P').replace('_i', ' I')} {value}" for name, value in gains._asdict().items()
    )
