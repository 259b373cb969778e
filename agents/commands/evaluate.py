"""`drive-agent evaluate`: episodes of any policy, on emulated machines or on a bus, and the gap between the two."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from agents.commands.options import (
    REFUSED,
    Bitrate,
    Channel,
    Cluster,
    Interface,
    Json,
    Load,
    Nodes,
    Seed,
    Trust,
    Workers,
    elsewhere,
    errors_as_exit_codes,
    fail,
    new_folder,
    print_json,
    progress_bar,
)
from agents.seeds import EVALUATION
from drive_env.commands.options import DeviceName, Yes, was_typed
from drive_env.commands.tables import print_lines
from drive_env.default_device import DEFAULT_DEVICE
from tuning.commands.options import ask_to_turn

if TYPE_CHECKING:
    from agents.evaluation.evaluation import Evaluation, GivenDrives
    from agents.evaluation.open_policy import LoadedPolicy
    from agents.policies.guard import GuardLimits

logger = logging.getLogger(__name__)

EMULATOR = "emulator"
BUS_EPISODES, EPISODES = 8, 64
# Factor on the steps' nominal time, and share of SYNCs (each interrupts a move), from which on a warning is printed.
SLOW, LATE = 1.05, 0.0005
BUS_OPTIONS = ("bus", "interface", "channel", "node")
OF_A_BUS_ALONE = ("bitrate", "device", "sensor")
NOT_OF_A_GAP = (*BUS_OPTIONS, *OF_A_BUS_ALONE, "episodes", "against", "replay", "minari")
ELSEWHERE = ("workers", "cluster")


def evaluate(
    context: typer.Context,
    policy: Annotated[
        str,
        typer.Argument(
            help="The policy: name of an agent that ships, agent.npz, checkpoint.zip, agent.onnx, module:function, or "
            "a baseline (nothing, feed_forward, state_feedback, surrogate; of the suite rest, cascade, expert, "
            "nominal)."
        ),
    ],
    environment: Annotated[
        str | None, typer.Option("--environment", "-e", help="Environment, for a policy whose file does not name it.")
    ] = None,
    load: Load = None,
    config: Annotated[
        Path | None, typer.Option("--config", help="The environment's options (TOML), instead of the policy's own.")
    ] = None,
    episodes: Annotated[
        int | None, typer.Option("--episodes", help="Episodes.", show_default=f"{EPISODES}, on a bus {BUS_EPISODES}")
    ] = None,
    seed: Seed = EVALUATION[0],
    bus: Annotated[
        bool, typer.Option("--bus", help="Act on drives on a bus; the next three options imply it.")
    ] = False,
    interface: Interface = None,
    channel: Channel = None,
    node: Nodes = None,
    bitrate: Bitrate = None,
    device: DeviceName = DEFAULT_DEVICE,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="For an emulator served with --lockstep: time passes by SYNC.")
    ] = False,
    sensor: Annotated[
        str | None, typer.Option("--sensor", help="module:function that returns the pendulum's angles [rad] on a bus.")
    ] = None,
    stall: Annotated[
        float | None,
        typer.Option(
            help="On a bus, the longest time without an action [s]; then the policy is stopped. 0 for no limit.",
            show_default="0.1, between trials of gains 1",
        ),
    ] = None,
    saturation: Annotated[
        float | None,
        typer.Option(
            help="On a bus, the longest time with an action at the end of its range [s]; then the policy is stopped. "
            "0 for no limit.",
            show_default="0.1; no limit for trials of gains",
        ),
    ] = None,
    against: Annotated[
        str | None,
        typer.Option("--against", help="Report the difference from this report.json, or from the `emulator`."),
    ] = None,
    gap: Annotated[
        int | None,
        typer.Option(
            "--gap",
            help="Evaluate it on this many drawn machines twice, in this process and over CAN, and report the "
            "difference. Each machine is served by its own `drive-env serve` in real time, or without real time "
            "with --lockstep.",
        ),
    ] = None,
    replay: Annotated[
        Path | None,
        typer.Option(
            "--replay", help="Without drives: compare with a recording, an episodes.npz or a CSV of `drive-env scope`."
        ),
    ] = None,
    card: Annotated[
        bool, typer.Option("--card", help="Print the agent's card (how it was trained), and stop.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for report, episodes and pictures, new or empty.")
    ] = None,
    minari: Annotated[
        str | None,
        typer.Option(
            "--minari",
            help="Keep the episodes as a Minari dataset of this name, as servo/tracking-v0 (extra `minari`).",
        ),
    ] = None,
    workers: Workers = None,
    cluster: Cluster = None,
    trust: Trust = False,
    yes: Yes = False,
    json: Json = False,
) -> None:
    """Run episodes of a policy, on emulated drives or on a bus: score with a 95 % interval, violations, pictures.

    On a bus it acts inside the safety envelope; a policy that returns NaN, stays at its limit or takes too long is
    stopped, and the drives are brought to rest and disabled. Their parameters are saved to a file for `drive-tune
    undo`, beside --out or in runs/, and restored at the end. `--out` keeps report.json, episodes.npz and pictures. On
    the emulator, 64 episodes at a time are a task of --workers or --cluster, to the same bytes. In real time other
    programs disturb: on Linux, `chrt -f 10 drive-agent evaluate ...` goes before them.
    """
    with errors_as_exit_codes():
        _check_numbers(episodes, gap, seed, {"--stall": stall, "--saturation": saturation})
        if card:
            _tell_card(policy, json)
            return
        _check_side(context, lockstep, gap, replay)
        if minari is not None:
            from agents.evaluation import minari_dataset

            minari_dataset.check_name(minari)
        recording = None if replay is None or replay.suffix.lower() == ".csv" else _recording(replay)
        recorded = None if recording is None else recording.environment
        loaded, configuration = opened_for(policy, environment, load, config, recorded, trust)
        if replay is not None:
            _replay(loaded, configuration, replay, recording, json)
            return
        folder = None if out is None else new_folder(out, "evaluate")
        guard = _guard(loaded.environment, stall, saturation)
        if gap is not None:
            _both_sides(loaded, configuration, gap, seed, lockstep, guard, folder, json)
            return
        on_bus = bool(_typed(context, BUS_OPTIONS))
        run = _Run(loaded, configuration, policy, episodes or (BUS_EPISODES if on_bus else EPISODES), seed, guard)
        before = None
        if on_bus:
            before = _way_back(out)
            if not lockstep:  # drives that wait for SYNC are emulated
                ask_to_turn(node, yes, interface)
            found = _on_bus(run, sensor, before, device=device, interface=interface, channel=channel,
                            nodes=node or None, lockstep=lockstep,
                            **({} if bitrate is None else {"bitrate": bitrate}))  # fmt: skip
        elif _typed(context, ELSEWHERE):
            found = _elsewhere(run, trust, workers, cluster)
        else:
            found = _on_emulator(run)
        gaps = [] if against is None else _against(run, against, found)
        _tell(found, gaps, json, before=before)
        if folder is not None:
            _save(found, folder, gaps, json)
        if minari is not None:
            minari_dataset.save(minari, found)


@dataclass(frozen=True)
class _Run:
    """An evaluation, on an emulator or a bus: a policy in its environment, for a number of episodes."""

    loaded: LoadedPolicy
    configuration: dict[str, Any]
    name: str  # of the policy, as it was typed
    episodes: int
    seed: int
    guard: GuardLimits  # on given drives

    @property
    def environment(self) -> str:
        """Name of the environment."""
        assert self.loaded.environment is not None, "opened_for fills it in"
        return self.loaded.environment

    def evaluate(self, told: Callable[[float], None], on: GivenDrives | None = None) -> Evaluation:
        """Run the episodes, on given drives or on emulated machines of the environment's own."""
        from agents.evaluation import evaluation

        return evaluation.evaluate(
            self.loaded.policy, self.environment, self.configuration, name=self.name, episodes=self.episodes,
            seed=self.seed, on=on, told=told,
        )  # fmt: skip


def _typed(context: typer.Context, names: Iterable[str]) -> list[str]:
    """Return those of these options that the user typed."""
    return [name for name in names if was_typed(context, name)]


def _check_numbers(episodes: int | None, gap: int | None, seed: int, limits: Mapping[str, float | None]) -> None:
    """Raise ValueError for an impossible number; `limits` maps an option's name to its time [s], None if not given."""
    for name, value in (("--episodes", episodes), ("--gap", gap), ("--seed", seed + 1)):
        if value is not None and value < 1:
            least = 0 if name == "--seed" else 1
            raise ValueError(f"{name} {value - 1 + least} is too small; give {least} or more")
    for name, limit in limits.items():
        if limit is not None and not 0.0 <= limit < math.inf:
            raise ValueError(f"{name} {limit:g} must be a time [s], 0 for no limit")


def _check_side(context: typer.Context, lockstep: bool, gap: int | None, replay: Path | None) -> None:
    """Raise ValueError for options that have no effect here: on a bus, on the emulator, with --gap or --replay."""
    on_bus = bool(_typed(context, BUS_OPTIONS))
    if not on_bus and gap is None:
        if lockstep:
            raise ValueError("--lockstep is for a bus; give its --channel, or --gap")
        if alone := _typed(context, OF_A_BUS_ALONE):
            raise ValueError(f"--{alone[0]} is for a bus; give its --channel, or leave --{alone[0]} out")
    if (on_bus or gap is not None or replay is not None) and (away := _typed(context, ELSEWHERE)):
        raise ValueError(
            f"--{away[0]} is for episodes on the emulator; leave it out on a bus, with --gap and with --replay"
        )
    if replay is not None and (extra := _typed(context, (*BUS_OPTIONS, *OF_A_BUS_ALONE, "minari"))):
        raise ValueError(f"--replay acts on no drives; leave --{extra[0]} out")
    if gap is not None and (extra := _typed(context, NOT_OF_A_GAP)):
        raise ValueError(f"--gap serves its own machines, one episode each; leave --{extra[0]} out")


def _way_back(out: Path | None) -> Path:
    from tuning.snapshot import file_before

    return file_before("evaluate", out)


def opened_for(
    text: str,
    environment: str | None,
    load: str | None = None,
    config: Path | None = None,
    otherwise: str | None = None,
    trust: bool = False,
) -> tuple[Any, dict[str, Any]]:
    """Return the policy with its environment (by default `otherwise`) and options; ValueError if they do not fit."""
    import tomllib

    from agents.evaluation.open_policy import LoadedPolicy, is_baseline, is_checkpoint, open_policy, opened
    from agents.tasks import environment_name
    from drive_env.envs.suite import TASKS
    from drive_env.randomisation.random_machines import shipped as shipped_distributions
    from mechanics.reading.untrusted import read_toml
    from tuning.runs.inputs import taken_options

    loaded = LoadedPolicy(text, None) if is_baseline(text) else open_policy(text, trust=trust)
    if environment is not None:
        wanted = environment_name(environment)
        if loaded.environment not in (None, wanted):
            raise ValueError(f"{text} acts in {loaded.environment}, not in {wanted}; leave --environment out")
        loaded.environment = wanted
    loaded.environment = loaded.environment or otherwise
    if loaded.environment is None:
        raise ValueError(f"policy {text} does not name its environment; give --environment")
    configuration = dict(loaded.configuration)
    if config is None and is_checkpoint(text) and not configuration and loaded.environment not in TASKS:
        logger.warning(
            "%s does not say with which options of the environment it was trained: the defaults are used; if it was "
            "trained with others, give them with --config FILE.toml",
            text,
        )
    if config is not None:
        try:
            configuration = read_toml(config)
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ValueError(f"--config {config} is not TOML: {error}") from None
    if load is not None:
        if configuration.get("distributions") == configuration.get("load"):  # the old load's own
            configuration["distributions"] = load if load in shipped_distributions() else None
        configuration["load"] = load
    configuration = taken_options(configuration)
    if loaded.policy is None:
        loaded.policy = opened(text, loaded.environment, configuration).policy
    return loaded, configuration


def _against(run: _Run, against: str, found: Evaluation) -> list[str]:
    """Return, as text, the gap between these results and those on the emulator or in an earlier report."""
    from agents.evaluation import gap
    from agents.evaluation.evaluation import Evaluation

    other = _as_on_a_bus(run) if against == EMULATOR else Evaluation.load(against)
    return gap.text(gap.compare(other, found), other.side, found.side)


def _both_sides(
    loaded: Any,
    configuration: dict[str, Any],
    machines: int,
    seed: int,
    lockstep: bool,
    guard: Any,
    folder: Path | None,
    json: bool,
) -> None:
    """Evaluate a policy on machines in this process and over their bus, and print the difference."""
    from agents.evaluation import evaluation_plots, gap
    from agents.evaluation.sim_versus_bus import on_both_sides

    with progress_bar(f"{machines} machines, in this process and over CAN") as show:
        both = on_both_sides(
            loaded.policy, loaded.environment, configuration, machines=machines, seed=seed, name=loaded.name,
            lockstep=lockstep, guard=guard, told=show,
        )  # fmt: skip
    gaps = gap.text(gap.compare(both.inside, both.bus), "in process", "over CAN")
    if both.again is not None:  # only of the score: how much of its gap is chance
        chance = gap.compare(both.inside, both.again)[:1]
        gaps += [f"noise alone: {line}" for line in gap.text(chance, "in process", "in process with other noise")]
    _tell(both.bus, gaps, json, missing=both.missing)
    if folder is not None:
        _save(both.bus, folder, gaps, json)
        both.inside.save(folder / "report-in-process.json")
        evaluation_plots.save_gap(both.inside, both.bus, folder)
    if both.missing:
        fail(
            f"{len(both.missing)} of {machines} machines could not be evaluated over the bus; the reason for the "
            f"first: {next(iter(both.missing.values()))}",
            REFUSED,
        )


def _on_emulator(run: _Run) -> Evaluation:
    with progress_bar(f"{run.loaded.name} on the emulator") as show:
        return run.evaluate(show)


def _as_on_a_bus(run: _Run) -> Evaluation:
    """Evaluate on an emulated machine hidden from the environment, as on a bus."""
    from agents.evaluation.evaluation import GivenDrives, as_on_a_bus
    from agents.tasks import make_environments
    from drive_env.emulator.emulated_drives import EmulatedDrives

    lanes: Any = make_environments(run.environment, 1, run.configuration)
    config = lanes.config
    lanes.close()
    with (
        EmulatedDrives(config.device, config.load, config.motor, 1, friction=config.friction) as drives,
        progress_bar(f"{run.loaded.name} on the emulator") as show,
    ):
        joint = getattr(getattr(config, "task", None), "joint", None)
        sensor = None if joint is None else lambda: drives.machine.joint_positions[:, joint]
        return run.evaluate(show, GivenDrives(as_on_a_bus(drives), sensor, run.guard, "emulator as on a bus"))


def _elsewhere(run: _Run, trust: bool, workers: int | None, cluster: str | None) -> Evaluation:
    from agents.evaluation.evaluation_shards import Written, evaluate_elsewhere

    written = Written.of(run.name, trust)
    with (
        elsewhere(workers, cluster, "give the command again") as pool,
        progress_bar(f"{run.loaded.name}, elsewhere") as show,
    ):
        assert pool is not None
        return evaluate_elsewhere(
            written, run.environment, run.configuration, pool, name=run.name, episodes=run.episodes,
            seed=run.seed, told=show,
        )  # fmt: skip


def _on_bus(run: _Run, sensor: str | None, before: Path, **where: Any) -> Evaluation:
    from agents.evaluation.evaluation import GivenDrives
    from agents.evaluation.on_the_bus import lower_profile_velocity, target_for
    from agents.evaluation.open_policy import find_object
    from tuning.snapshot import Transaction
    from tuning.way_back import way_back

    function = None if sensor is None else find_object(sensor)
    with (
        way_back(before, "drive-agent"),
        target_for(run.environment, run.configuration, run.guard, **where) as target,
        Transaction(target, before),
        progress_bar(f"{run.loaded.name} on the bus") as show,
    ):
        lower_profile_velocity(target.drives)  # the transaction restores it, once the axes are off
        return run.evaluate(show, GivenDrives(target.drives, function, run.guard))


def _recording(path: Path) -> Any:
    from agents.evaluation import episode_log

    return episode_log.load(path)


def _replay(loaded: Any, configuration: dict[str, Any], path: Path, recording: Any, json: bool) -> None:
    """Print the policy's actions in recorded episodes, or the emulator's deviation from a recorded move."""
    if recording is None:
        _replay_move(configuration, path, json)
        return
    from agents.evaluation import episode_log

    if recording.environment != loaded.environment:
        raise ValueError(f"{path} was recorded in {recording.environment}, and {loaded.name} acts in "
                         f"{loaded.environment}; give a recording of that")  # fmt: skip
    with progress_bar("repeating") as show:
        found = episode_log.repeat(loaded.policy, recording, told=show)
    if json:
        print_json(found._asdict())
        return
    print(
        f"{found.steps} recorded steps: the policy's actions lie within {found.largest:.2g} of the recorded ones "
        f"(RMS {found.rms:.2g})"
    )


def _replay_move(configuration: dict[str, Any], path: Path, json: bool) -> None:
    from drive_env.emulator.emulated_drives import EmulatedDrives
    from drive_env.trials.replay import compare, read_log
    from drive_env.trials.replay import replay as repeat_move

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
            f"{name}: deviation of the emulator {float(one.nrmse[0]):.2%} of the log's range (RMS), "
            f"{float(one.shifted[0]):.2%} when shifted by {1e3 * float(one.shift[0]):.1f} ms"
        )


def _guard(environment: str, stall: float | None, saturation: float | None) -> Any:
    """Return the limits of a policy on given drives: the environment's own, unless the user gives others."""
    from dataclasses import replace

    from agents.policies.guard import LIMITS
    from drive_env.envs import environment_of

    given = {"stall": stall, "saturation": saturation}
    own = LIMITS[environment_of(environment)]
    return replace(own, **{name: value or None for name, value in given.items() if value is not None})


def _tell(
    found: Any, gaps: list[str], json: bool, missing: Mapping[int, str] | None = None, before: Path | None = None
) -> None:
    if json:
        print_json(
            {
                "policy": found.policy,
                "environment": found.environment,
                "side": found.side,
                "figures": {name: found.interval(name)._asdict() for name in found.values},
                "violations": found.violations,
                "pace": found.pace,
                "late": found.late,
                "gap": gaps,
                "missing": dict(missing or {}),
            }
            | ({} if before is None else {"before": str(before)})
        )
        return
    lines = [f"{found.policy} in {found.environment} on the {found.side}, {len(found.seeds)} episodes"]
    for name in found.values:
        one = found.interval(name)
        lines.append(f"{name}: {one.mean:.4g} (95 % of {one.low:.4g} to {one.high:.4g}), median {one.median:.4g}")
    count = sum(found.violations.values())
    which = "".join(f", {number} x {name}" for name, number in found.violations.items())
    lines.append(f"violations: {count}{which}")
    if found.pace > SLOW or found.late > LATE:
        lines.append(
            f"steps took {found.pace:.2f} times their nominal time, {found.late:.1%} of the SYNCs in them were "
            "more than a cycle late: this computer is too slow or too busy, and the figures show that; end other "
            "programs, put `chrt -f 10` before the command (Linux), or take a lower rate or a smaller network"
        )
    lines += gaps
    if before is not None:
        from tuning.way_back import what_is_changed

        lines.append(what_is_changed(before))
    print_lines(lines)


def _save(found: Any, folder: Path, gaps: list[str], json: bool) -> None:
    from agents.evaluation import episode_log, evaluation_plots
    from drive_env.whole_file import write_whole
    from tuning.runs.inputs import inputs_in, write_inputs

    folder.mkdir(parents=True, exist_ok=True)
    write_inputs(folder, inputs_in(found.configuration))
    episode_log.save(folder / "episodes.npz", found.environment, found.configuration, found.episodes)
    evaluation_plots.save(found, folder)
    if gaps:
        write_whole(folder / "gap.txt", "\n".join(gaps) + "\n")
    found.save(folder / "report.json")  # last: a folder that has it is complete
    if not json:
        print(f"written to {folder}")


def _tell_card(text: str, json: bool) -> None:
    """Print how an agent was trained, and its scores."""
    from agents.evaluation.open_policy import described_checkpoint, is_checkpoint, open_policy

    loaded = described_checkpoint(text) if is_checkpoint(text) else open_policy(text)
    about = {"environment": loaded.environment, **loaded.card}
    if not loaded.card:
        raise ValueError(f"{text} has no card, since it was not made by drive-agent")
    if json:
        print_json(about)
        return
    for line in _lines(about):
        print(line)


def _lines(table: Mapping[str, Any], indent: str = "") -> Iterator[str]:
    for name, value in table.items():
        if isinstance(value, Mapping):
            yield _printable(f"{indent}{name}:")
            yield from _lines(value, indent + "  ")
        else:
            number = f"{value:.4g}" if isinstance(value, float) else value
            yield _printable(f"{indent}{name}: {', '.join(map(str, value)) if isinstance(value, list) else number}")


def _printable(text: str) -> str:
    """Return text of an untrusted file without terminal control characters."""
    return "".join(one if one.isprintable() else "\N{REPLACEMENT CHARACTER}" for one in text)
