"""`drive-agent train`: an agent from an environment and hyper-parameters."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from agents.commands.options import (
    INTERRUPTED,
    Algorithm,
    Config,
    Environment,
    Load,
    Out,
    Preset,
    Seed,
    Steps,
    Trust,
    errors_as_exit_codes,
    fail,
    new_folder,
)

if TYPE_CHECKING:
    from agents.evaluation.evaluation import Evaluation
    from agents.policies.agent_file import AgentFile
    from agents.training.training_run import Progress, Report

EPISODES = 64  # for the card
LINES = 10  # of progress, if the output is not a terminal


def train(
    context: typer.Context,
    environment: Environment = "gain_tuning",
    algorithm: Algorithm = "ppo",
    preset: Preset = "quick",
    load: Load = None,
    config: Config = None,
    seed: Seed = 0,
    steps: Steps = None,
    out: Out = None,
    resume: Annotated[
        Path | None, typer.Option("--resume", help="Continue the run in this folder; needs --trust.")
    ] = None,
    trust: Trust = False,
) -> None:
    """Train an agent with Stable-Baselines3 (pip install 'drive-env[agents]').

    Writes agent.npz (the agent, its normaliser and its card), checkpoint.zip, training.csv, learning_curve.png and
    TensorBoard's files. The same seed gives the same agent on the same machine, also when the run was interrupted and
    resumed.
    """
    with errors_as_exit_codes():
        from agents.tasks import short_name
        from agents.training.train import clear, run_to_resume
        from agents.training.train import train as run_training
        from agents.training.training_run import AGENT, CHECKPOINT, CURVE, TrainingRun

        if resume is None:
            if trust:
                raise ValueError("--trust is for --resume only, since a new run loads nothing; leave it out")
            given = with_load(environment, algorithm, preset, load, config)
            if steps is not None:
                if steps < 1:
                    raise ValueError(f"--steps {steps} must be 1 or more")
                given["n_timesteps"] = steps
            run = TrainingRun(environment, algorithm, given, seed=seed, preset=preset)
            folder = new_folder(out, f"{short_name(run.environment)}-{algorithm}")
        else:
            given_too = [name for name in given_options(context) if name not in ("--resume", "--trust")]
            if given_too:
                raise ValueError(f"--resume continues the run with its own options; leave {', '.join(given_too)} out")
            folder = resume
            run = run_to_resume(folder)
        try:
            with progress(f"{run.environment} {run.algorithm}") as report:
                bundle = run_training(run, folder, report=report, resume=resume is not None, trust=trust)
        except KeyboardInterrupt:
            if not (folder / CHECKPOINT).is_file():
                clear(folder)
                fail("interrupted before the first checkpoint: the run cannot be continued, and its files were removed",
                     INTERRUPTED)  # fmt: skip
            fail(f"interrupted; to continue: drive-agent train --resume {folder} --trust", INTERRUPTED)
        except OSError as error:
            if error.errno is None or not folder.is_dir():
                raise
            if (folder / CHECKPOINT).is_file():
                left = f"make room, then continue: drive-agent train --resume {folder} --trust"
            else:
                clear(folder)
                left = "this was before the first checkpoint, and the run's files were removed"
            raise OSError(error.errno, f"{error.strerror}; {left}", error.filename or str(folder)) from None
        print(f"evaluating it in {EPISODES} episodes with seeds not used for training", file=sys.stderr)
        agent, evaluation = judged(bundle)
        agent.save(folder / AGENT)
        for name in evaluation.values:
            found = evaluation.interval(name)
            print(f"{name}: {found.mean:.4g} (95 % of {found.low:.4g} to {found.high:.4g}), median {found.median:.4g}")
        print(f"written to {folder}: {AGENT}, {CHECKPOINT}, {CURVE}")


def given_options(context: typer.Context) -> list[str]:
    """Return the user's options and arguments as written."""
    sources = ((one, context.get_parameter_source(str(one.name))) for one in context.command.params)
    return [one.opts[0] for one, source in sources if source is not None and source.name == "COMMANDLINE"]


def judged(bundle: AgentFile) -> tuple[AgentFile, Evaluation]:
    """Return an agent with its scores on its card, and its evaluation on emulated machines."""
    from agents.evaluation.evaluation import evaluate
    from agents.policies.policy import policy_of
    from agents.training.train import with_figures

    found = evaluate(policy_of(bundle), bundle.environment, bundle.configuration, episodes=EPISODES)
    figures = {name: found.interval(name)._asdict() for name in found.values} | {"violations": found.violations}
    return with_figures(bundle, figures, {"evaluation": f"{found.seeds[0]}...{found.seeds[-1]}"}), found


def with_load(
    environment: str, algorithm: str, preset: str, load: str | None, config: Path | None = None
) -> dict[str, Any]:
    """Return hyper-parameters for a load: with the section named after it, if there is one."""
    from agents.training import hyperparameters

    section = load if load in hyperparameters.sections(environment, algorithm, config) else None
    given = hyperparameters.load(environment, algorithm, preset, path=config, section=section)
    if load is not None:
        hyperparameters.merge(given, {"env_kwargs": {"load": load}})
    return given


@contextmanager
def progress(title: str) -> Iterator[Report]:
    """Show progress, speed and reward terms of a training: as a bar on a terminal, otherwise as a few printed lines."""
    from rich.console import Console, Group
    from rich.live import Live
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    console = Console(stderr=True)
    if not console.is_terminal:
        shown = -1

        def print_line(state: Any) -> None:
            nonlocal shown
            part = LINES * state.timesteps // max(state.total, 1)
            if part > shown:
                shown = part
                print(f"{title}: {state.timesteps} of {state.total} steps, {text(state)}", file=sys.stderr, flush=True)

        yield print_line
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=20),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    bar = Progress(*columns, console=console)
    task = bar.add_task(title, total=1.0)
    with Live(bar, console=console) as live:

        def show(state: Any) -> None:
            bar.update(task, completed=state.timesteps / max(state.total, 1))
            # On a separate line: beside the bar a terminal of 80 columns would truncate the terms.
            live.update(Group(bar, Text(text(state))))

        yield show


def text(state: Progress) -> str:
    """Return speed, share of the environment, mean return and reward terms in words."""
    if state.imitated < 1.0:
        return f"imitating its teacher: {state.imitated:.0%}"
    if not state.means:
        return "imitation of its teacher done"
    terms = ", ".join(f"{name} {value:.3g}" for name, value in state.terms.items())
    return (
        f"{state.speed:,.0f} steps/s ({state.environment_share:.0%} environment), return {state.means['return']:.4g}, "
        f"{terms}"
    )
