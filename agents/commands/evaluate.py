"""`drive-agent evaluate`: episodes of any policy, on emulated machines or on a bus, and the gap between the two."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from agents.commands.options import (
    Bitrate,
    Channel,
    Interface,
    Json,
    Load,
    Nodes,
    Seed,
    errors_as_exit_codes,
    new_folder,
    print_json,
)

EMULATOR = "emulator"
BUS_EPISODES, EPISODES = 8, 64
LATE = 1.05  # times the time that steps should take: worth a word
BUS_OPTIONS = ("interface", "channel", "node")


def evaluate(
    context: typer.Context,
    policy: Annotated[
        str,
        typer.Argument(
            help="agent.npz, checkpoint.zip, agent.onnx, module:function, or a baseline: nothing, feed_forward, "
            "state_feedback."
        ),
    ],
    environment: Annotated[
        str | None, typer.Option("--environment", "-e", help="Environment of a policy that does not say its own.")
    ] = None,
    load: Load = None,
    config: Annotated[
        Path | None, typer.Option("--config", help="The environment's options (TOML), in place of the policy's own.")
    ] = None,
    episodes: Annotated[
        int | None, typer.Option("--episodes", help="Episodes.", show_default=f"{EPISODES}, on a bus {BUS_EPISODES}")
    ] = None,
    seed: Seed = 1_000_000,
    bus: Annotated[bool, typer.Option("--bus", help="Act on drives of a bus; so does any of the next three.")] = False,
    interface: Interface = None,
    channel: Channel = None,
    node: Nodes = None,
    bitrate: Bitrate = None,
    device: Annotated[str, typer.Option("--device", help="Drive by name.")] = "tmcm1636",
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="Of an emulator served so: time passes by SYNC.")
    ] = False,
    sensor: Annotated[
        str | None, typer.Option("--sensor", help="module:function that returns the pendulum's angles [rad] on a bus.")
    ] = None,
    stall: Annotated[float, typer.Option(help="Longest time for an action on a bus [s]; 0 for any.")] = 0.1,
    saturation: Annotated[
        float, typer.Option(help="Longest time with an action at the end of its range on a bus [s]; 0 for any.")
    ] = 0.1,
    against: Annotated[
        str | None, typer.Option("--against", help="Report the gap to this report.json, or to the `emulator`.")
    ] = None,
    replay: Annotated[
        Path | None,
        typer.Option("--replay", help="Act on nothing: repeat an episodes.npz, or a CSV of `drive-env scope`."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for report, episodes and pictures, new or empty.")
    ] = None,
    json: Json = False,
) -> None:
    """Run episodes of a policy: score with a 95 % interval, violations, pictures; on both sides the same command.

    On a bus it acts inside the safety envelope; a policy that gives no number, sticks at its limit or stalls is
    stopped, and the drives are left at rest and disabled. `--out` keeps report.json, episodes.npz and pictures.
    """
    with errors_as_exit_codes():
        for name, value in (("--episodes", episodes), ("--seed", seed + 1)):
            if value is not None and value < 1:
                raise ValueError(f"{name} {value} is too small")
        if stall < 0.0 or saturation < 0.0:
            raise ValueError("--stall and --saturation are times [s], 0 for any")
        loaded, configuration = _open(policy, environment, load, config)
        if replay is not None:
            _replay(loaded, configuration, replay, json)
            return
        folder = None if out is None else new_folder(out, "evaluate")
        on_bus = bus or any(_was_typed(context, one) for one in BUS_OPTIONS)
        guard = _guard(stall, saturation)
        count = episodes or (BUS_EPISODES if on_bus else EPISODES)
        options = {"episodes": count, "seed": seed, "guard": guard, "name": policy}
        found = (
            _on_bus(loaded, configuration, options, sensor, device=device, interface=interface, channel=channel,
                    nodes=node or (1,), lockstep=lockstep, **({} if bitrate is None else {"bitrate": bitrate}))
            if on_bus
            else _on_emulator(loaded, configuration, options)
        )  # fmt: skip
        gaps: list[str] = []
        if against is not None:
            from agents import gap
            from agents.evaluation import Evaluation

            other = (
                _on_emulator(loaded, configuration, options, as_on_a_bus=True)
                if against == EMULATOR
                else Evaluation.load(against)
            )
            gaps = gap.text(gap.compare(other, found), other.side, found.side)
        _tell(found, gaps, json)
        if folder is not None:
            _save(found, folder, gaps)


def _open(text: str, environment: str | None, load: str | None, config: Path | None) -> tuple[Any, dict[str, Any]]:
    """Return the policy, its environment filled in, and the environment's options."""
    import tomllib

    from agents.baselines import BASELINES, baseline
    from agents.policies import LoadedPolicy, open_policy
    from agents.tasks import environment_name, make_lanes

    names = {name for rows in BASELINES.values() for name in rows}
    loaded = LoadedPolicy(text, None) if text in names else open_policy(text)
    if environment is not None:
        loaded.environment = environment_name(environment)
    if loaded.environment is None:
        raise ValueError(f"{text} does not say its environment; give --environment")
    configuration = dict(loaded.configuration)
    if config is not None:
        try:
            configuration = tomllib.loads(config.read_text(encoding="utf-8"))
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ValueError(f"--config {config} is no TOML: {error}") from None
    if load is not None:
        configuration["load"] = load
    if loaded.policy is None:
        lanes: Any = make_lanes(loaded.environment, 1, configuration)
        actions = lanes.single_action_space.shape[0]
        lanes.close()
        loaded.policy = baseline(text, loaded.environment, lanes.config, actions)
    return loaded, configuration


def _on_emulator(loaded: Any, configuration: dict[str, Any], options: dict[str, Any], as_on_a_bus: bool = False) -> Any:
    from agents.evaluation import AsOnABus
    from agents.evaluation import evaluate as run

    if not as_on_a_bus:
        return run(loaded.policy, loaded.environment, configuration, **{**options, "guard": None}, told=_told())
    from agents.tasks import make_lanes
    from drive_env.drives import EmulatedDrives

    lanes: Any = make_lanes(loaded.environment, 1, configuration)
    config = lanes.config
    lanes.close()
    with EmulatedDrives(config.device, config.load, config.motor, 1, friction=config.friction) as drives:
        joint = getattr(getattr(config, "task", None), "joint", None)
        sensor = None if joint is None else lambda: drives.machine.joint_positions[:, joint]
        return run(
            loaded.policy,
            loaded.environment,
            configuration,
            drives=AsOnABus(drives),
            sensor=sensor,
            side="emulator as on a bus",
            **options,
        )


def _on_bus(
    loaded: Any, configuration: dict[str, Any], options: dict[str, Any], sensor: str | None, **where: Any
) -> Any:
    from agents.evaluation import evaluate as run
    from agents.on_the_bus import drives_for

    function = None
    if sensor is not None:
        from agents.training import found

        function = found(sensor)
    with drives_for(loaded.environment, configuration, options["guard"], **where) as drives:
        return run(
            loaded.policy, loaded.environment, configuration, drives=drives, sensor=function, told=_told(), **options
        )


def _replay(loaded: Any, configuration: dict[str, Any], path: Path, json: bool) -> None:
    """Say what the policy would have done in recorded episodes, or how far the emulator lies from a recorded move."""
    if path.suffix.lower() == ".csv":
        _replay_move(configuration, path, json)
        return
    from agents import episode_log

    recording = episode_log.load(path)
    found = episode_log.repeat(loaded.policy, recording)
    if json:
        print_json(found._asdict())
        return
    print(
        f"{found.steps} recorded steps: the policy's actions lie within {found.largest:.2g} of the recorded ones "
        f"(RMS {found.rms:.2g})"
    )


def _replay_move(configuration: dict[str, Any], path: Path, json: bool) -> None:
    from drive_env.drives import EmulatedDrives
    from drive_env.replay import compare, read_log
    from drive_env.replay import replay as repeat_move

    log = read_log(path)
    options = {key: configuration[key] for key in ("device", "load", "motor", "friction") if key in configuration}
    with EmulatedDrives(**options) as drives:
        found = compare(log, repeat_move(drives, log))
    table = {f"{index:04X}h": difference for (index, _), difference in found.items()}
    if json:
        print_json({name: one._asdict() for name, one in table.items()})
        return
    for name, one in table.items():
        print(
            f"{name}: the emulator lies {float(one.nrmse[0]):.2%} of the log's range from it (RMS), "
            f"{float(one.shifted[0]):.2%} when shifted by {1e3 * float(one.shift[0]):.1f} ms"
        )


def _guard(stall: float, saturation: float) -> Any:
    from agents.guard import GuardLimits

    return GuardLimits(saturation=saturation or None, stall=stall or None)


def _told() -> Any:
    if not sys.stderr.isatty():
        return None
    return lambda done, total: print(f"\r{done} of {total} episodes", end="", file=sys.stderr, flush=True)


def _was_typed(context: typer.Context, name: str) -> bool:
    """Return whether an option stands on the command line: one in the environment must turn no motor by surprise."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def _tell(found: Any, gaps: list[str], json: bool) -> None:
    if json:
        print_json(
            {
                "policy": found.policy,
                "environment": found.environment,
                "side": found.side,
                "figures": {name: found.interval(name)._asdict() for name in found.values},
                "violations": found.violations,
                "pace": found.pace,
                "gap": gaps,
            }
        )
        return
    print(f"{found.policy} in {found.environment} on the {found.side}, {len(found.seeds)} episodes")
    for name in found.values:
        one = found.interval(name)
        print(f"{name}: {one.mean:.4g} (95 % of {one.low:.4g} to {one.high:.4g}), median {one.median:.4g}")
    count = sum(found.violations.values())
    which = "".join(f", {number} x {name}" for name, number in found.violations.items())
    print(f"violations: {count}{which}")
    if found.pace > LATE:
        print(
            f"steps took {found.pace:.2f} times the time that they should: this computer is too slow or too busy, and "
            "the figures show that; end other programs, or take a lower rate or a smaller network"
        )
    for line in gaps:
        print(line)


def _save(found: Any, folder: Path, gaps: list[str]) -> None:
    from agents import episode_log, evaluation_plots

    folder.mkdir(parents=True, exist_ok=True)
    found.save(folder / "report.json")
    episode_log.save(folder / "episodes.npz", found.environment, found.configuration, found.episodes)
    evaluation_plots.save(found, folder)
    if gaps:
        (folder / "gap.txt").write_text("\n".join(gaps) + "\n", encoding="utf-8")
    print(f"written to {folder}")
