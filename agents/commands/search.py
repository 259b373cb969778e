"""`drive-agent search`: hyper-parameters by Optuna."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from agents.commands.options import (
    Algorithm,
    Cluster,
    Config,
    Environment,
    Load,
    Preset,
    Seed,
    Steps,
    Workers,
    elsewhere,
    errors_as_exit_codes,
)


def search(
    environment: Environment = "gain_tuning",
    algorithm: Algorithm = "ppo",
    preset: Preset = "quick",
    load: Load = None,
    config: Config = None,
    seed: Seed = 0,
    steps: Steps = None,
    trials: Annotated[int, typer.Option("--trials", help="Trainings.")] = 20,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", help="Folder of the study; an existing study is continued.", show_default="a new one in runs/"
        ),
    ] = None,
    workers: Workers = None,
    cluster: Cluster = None,
) -> None:
    """Search hyper-parameters: each trial trains an agent and scores it on machines not used for training.

    Five trials at a time are chosen from the results before; with --workers and --cluster they run in parallel, with
    the same results. The study is a journal that several processes may share. Writes best.yaml, which `drive-agent
    train --config` takes.
    """
    with errors_as_exit_codes():
        from agents.commands.train import with_load
        from agents.hyperparameter_search import BEST, SearchTrial
        from agents.hyperparameter_search import search as run_search
        from agents.tasks import environment_name, short_name

        for name, value in (("--trials", trials), ("--steps", steps)):
            if value is not None and value < 1:
                raise ValueError(f"{name} {value} must be 1 or more")
        given = with_load(environment, algorithm, preset, load, config)
        if steps is not None:
            given["n_timesteps"] = steps
        short = short_name(environment_name(environment))
        folder = Path("runs") / f"search-{short}-{algorithm}" if out is None else out

        def tell(trial: SearchTrial, best: SearchTrial | None) -> None:
            score = "diverged" if trial.score is None else f"{trial.score:.4g}"
            so_far = "none yet" if best is None else f"{best.score:.4g} of trial {best.number}"
            print(f"trial {trial.number}: {score}; best {so_far}", flush=True)

        with elsewhere(workers, cluster, "continue with the same --out") as pool:
            run_search(environment, algorithm, given, folder, trials=trials, seed=seed, told=tell, pool=pool)
        print(f"written to {folder / BEST}")
