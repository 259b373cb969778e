"""Training with Stable-Baselines3: one seed gives the same agent on the same machine, and a run can be resumed.

A run is cut into segments, at whose ends a checkpoint is written and every environment begins a new episode with seeds
of the segment. So a resumed run equals an uninterrupted one to the last digit: the emulated machines in the middle of
their episodes, which cannot be saved, are reset in both. Times differ, and so does a run with another number of torch
threads, which may sum in another order.
"""

from __future__ import annotations

import importlib
import inspect
import logging
import shutil
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from agents.plain import plain
from agents.policies.agent_file import AgentFile
from agents.tasks import configuration_of, make_environments
from agents.training import checkpoint
from agents.training.algorithms import algorithm_class, need
from agents.training.counted_environments import CountedEnvironments
from agents.training.hyperparameters import RUN_KEYS, HyperparameterError, schedule
from agents.training.networks import bundle_of
from agents.training.training_run import AGENT, CHECKPOINT, TABLE, Progress, Report, TrainingRun, segment_seed
from tuning.runs.inputs import FOLDER as INPUTS
from tuning.runs.inputs import as_kept, found_again, hashes, inputs_in, taken_options, write_inputs
from tuning.runs.provenance import check_begun

logger = logging.getLogger(__name__)

# Torch's and NumPy's random generators are global: two trainings at once in a process would disturb each other.
_ALONE = threading.Lock()
IMITATION = 1_000_000  # number for the seeds of an imitation, beyond all segments
# Options that may be schedules.
_SCHEDULED = ("learning_rate", "clip_range", "clip_range_vf")
# Keys whose value SB3 wants as a whole number, though YAML may say 1e5.
_WHOLE = ("n_steps", "batch_size", "n_epochs", "buffer_size", "learning_starts", "train_freq", "gradient_steps")


class DivergedError(ValueError):
    """The networks have non-finite weights: the training is lost; the message says what to change."""


def train(
    run: TrainingRun, folder: str | Path, *, report: Report | None = None, resume: bool = False, trust: bool = False
) -> AgentFile:
    """Train an agent and return it.

    The folder gets agent.npz, checkpoint.zip, training.csv, its picture learning_curve.png, TensorBoard's files, and
    in inputs/ the files of its user that it needs.

    Args:
        run: The run; not used with `resume`, which takes that of the folder.
        folder: Folder of the results.
        report: Called with the progress, some 200 times.
        resume: Whether to continue from the folder's checkpoint.
        trust: Whether its writer is trusted; needed to resume, see `agents.training.checkpoint`.

    Raises:
        CheckpointError: If there is nothing to resume, or it is not trusted, ValueError if it was begun with other
            sources; MissingPackageError without the extra `agents`.
        HyperparameterError: For hyper-parameters that the algorithm does not take.
        DivergedError: If the model is no longer sound (`is_sound`); the last checkpoint is from before.
    """
    folder = Path(folder)
    path = folder / CHECKPOINT
    if resume:
        run = run_to_resume(folder)
        checkpoint.check_trust(path, trust)
        check_begun(path, checkpoint.read_run(path).get("sources"), "begin a new run")
    else:
        run = with_inputs(run)
    with _ALONE:
        return _train(run, folder, report, resume, trust)


def _train(run: TrainingRun, folder: Path, report: Report | None, resume: bool, trust: bool) -> AgentFile:
    import torch
    from stable_baselines3.common.logger import configure

    from agents.training.segments import Segments

    path = folder / CHECKPOINT
    threads = torch.get_num_threads()
    torch.set_num_threads(run.torch_threads)
    lanes, env = make_env(run)
    try:
        if resume:
            model, normaliser = checkpoint.load(path, env, trust=trust)
        else:
            model, normaliser = make_model(run, env)
            agent_of(model, normaliser, run, configuration_of(lanes))  # raises if no bundle can hold the model
            if run.hyperparameters.get("imitate"):
                _imitate(run, model, lanes, report)
        folder.mkdir(parents=True, exist_ok=True)
        if not resume:
            write_inputs(folder, inputs_in(run.hyperparameters))
        model.set_logger(configure(str(folder), ["tensorboard"]))
        segments = Segments(run, folder, lanes, normaliser, report, resume)
        if resume:
            # SB3 would reset the environments before the segment does, and count that in the normaliser.
            model._last_obs = np.zeros(0)
            model._last_episode_starts = np.ones(lanes.num_envs, bool)
        else:
            model.get_env().seed(segment_seed(run.seed, 0))
        _count_from(env, model.num_timesteps if resume else 0)
        left = run.total - (model.num_timesteps if resume else 0)
        if left > 0:
            try:
                with _without_tracebacks_of_threads():
                    model.learn(left, callback=segments, log_interval=1, reset_num_timesteps=not resume)
            except ValueError:  # torch's, of a distribution without a mean
                if is_sound(model):
                    raise
            if not is_sound(model):
                raise DivergedError(
                    f"the training diverged: after {model.num_timesteps} steps its networks return NaN. "
                    "Use a smaller learning_rate or max_grad_norm; the checkpoint, if there is one, is from before"
                )
            segments.finish()
        bundle = agent_of(model, normaliser, run, configuration_of(lanes))
        bundle.save(folder / AGENT)
        return bundle
    finally:
        torch.set_num_threads(threads)
        env.close()


@contextmanager
def _without_tracebacks_of_threads() -> Iterator[None]:
    """Let TensorBoard's thread that finds a full disk end without a traceback: the training ends with that error."""
    before = threading.excepthook
    threading.excepthook = lambda args: None if isinstance(args.exc_value, OSError) else before(args)
    try:
        yield
    finally:
        threading.excepthook = before


def with_inputs(run: TrainingRun) -> TrainingRun:
    """Return a run with the paths in its environment's options replaced by the content of the user's files."""
    given = run.hyperparameters
    options = taken_options(given.get("env_kwargs") or {})
    return replace(run, hyperparameters={**given, "env_kwargs": options}) if inputs_in(options) else run


def clear(folder: str | Path) -> None:
    """Delete the files of a run that was ended before its first checkpoint: it cannot be resumed."""
    folder = Path(folder)
    for path in (folder / TABLE, *folder.glob("events.out.tfevents.*")):
        path.unlink(missing_ok=True)
    shutil.rmtree(folder / INPUTS, ignore_errors=True)
    with suppress(OSError):  # not there, or something of the user's in it
        folder.rmdir()


def run_to_resume(folder: str | Path) -> TrainingRun:
    """Return the run whose checkpoint a folder holds.

    Raises:
        CheckpointError: If it holds none.
        InputError: If a file of its user is missing there, or was changed.
    """
    path = Path(folder) / CHECKPOINT
    if not path.is_file():
        raise checkpoint.CheckpointError(
            f"there is no file {path} to continue from: a run writes its first one after a tenth of its steps"
        )
    table = checkpoint.read_run(path)
    found_again(table["run"], table.get("inputs"), path.parent)  # all of them are needed
    return _run_of(table, path)


def agent_of(model: Any, normaliser: Any, run: TrainingRun, configuration: Mapping[str, Any]) -> AgentFile:
    """Return a trained model as a bundle with the facts of the run on its card."""
    card = {
        "trained": f"{run.algorithm} of Stable-Baselines3, preset {run.preset}, {model.num_timesteps} steps",
        "distribution": plain(as_kept(configuration.get("distributions"))) or "the environment's own",
        "seeds": {"training": run.seed},
        "hyperparameters": plain(as_kept(run.hyperparameters)),
        "figures": {},
        "limits": [f"trained on the load {as_kept(configuration.get('load'))!r} alone"],
    }
    if inputs := inputs_in(configuration):
        card["inputs"] = hashes(inputs)
    return bundle_of(model, normaliser, environment=run.environment, configuration=configuration, card=card)


def bundle_of_checkpoint(path: str | Path, *, trust: bool = False) -> AgentFile:
    """Return the agent of a checkpoint.

    Raises:
        CheckpointError: If the file is not a checkpoint, or its writer is not trusted.
    """
    table = checkpoint.read_run(Path(path))
    model, normaliser = checkpoint.load(Path(path), trust=trust)
    configuration = found_again(table["configuration"], table.get("inputs"), Path(path).parent, alone=True)
    return agent_of(model, normaliser, _run_of(table, Path(path)), configuration)


def _run_of(table: Mapping[str, Any], path: Path) -> TrainingRun:
    """Return the run that a checkpoint describes, with the user's files that are stored in its folder."""
    try:
        return TrainingRun(**found_again(table["run"], table.get("inputs"), path.parent, alone=True))
    except TypeError as error:
        raise checkpoint.CheckpointError(f"{path} is not a checkpoint of this drive-agent: {error}") from None


def with_figures(bundle: AgentFile, figures: Mapping[str, Any], seeds: Mapping[str, Any]) -> AgentFile:
    """Return a bundle whose card has figures, and the seeds of the episodes that they come from."""
    card = {**bundle.card, "figures": plain(figures), "seeds": {**bundle.card.get("seeds", {}), **seeds}}
    return replace(bundle, card=card)


def make_env(run: TrainingRun) -> tuple[CountedEnvironments, Any]:
    """Return counted environments, and the VecEnv of Stable-Baselines3 over them."""
    need("stable_baselines3")
    from drive_env.envs.stable_baselines import DriveVecEnv

    options = run.hyperparameters.get("env_kwargs") or {}
    lanes = make_environments(run.environment, run.hyperparameters["n_envs"], options, autoreset_mode="SameStep")
    counted = CountedEnvironments(lanes)
    env: Any = DriveVecEnv(counted)  # type: ignore[arg-type]
    wrapper = run.hyperparameters.get("vec_env_wrapper")
    if wrapper:
        name, settings = _named(wrapper)
        with _settings_of(name):
            env = found(name)(env, **settings)
    return counted, env


def make_model(run: TrainingRun, env: Any) -> tuple[Any, Any]:
    """Return a new model on the environment, and its normaliser, if the hyper-parameters want one."""
    from stable_baselines3.common.vec_env import VecNormalize

    given = run.hyperparameters
    options = {key: value for key, value in given.items() if key not in RUN_KEYS}
    normalize = given.get("normalize")
    normaliser = None
    if normalize:
        wanted = dict(normalize) if isinstance(normalize, Mapping) else {}
        with _settings_of("normalize"):
            normaliser = env = VecNormalize(env, gamma=float(options.get("gamma", 0.99)), **wanted)
    for key in _SCHEDULED:
        if key in options:
            options[key] = schedule(options[key])
    for key in _WHOLE:
        if isinstance(options.get(key), float):
            options[key] = int(options[key])
    if options.get("policy_kwargs"):
        options["policy_kwargs"] = _with_classes(options["policy_kwargs"])
    with _settings_of(run.algorithm):
        model = algorithm_class(run.algorithm)(_policy(given["policy"]), env, seed=run.seed, device="cpu", **options)
    return model, normaliser


def is_sound(model: Any) -> bool:
    """Return whether a model's weights are finite, and its actions' standard deviation, if any, is above 0."""
    weights = list(model.policy.parameters())
    if getattr(model.policy, "log_std", None) is not None:
        deviation = model.policy.log_std.exp()
        weights += [deviation, 1.0 / deviation]
    return all(bool(weight.isfinite().all()) for weight in weights)


def _count_from(env: Any, steps: int) -> None:
    """Set the curriculum's step count to the run's: without an imitation's steps, with those before a resumption."""
    while hasattr(env, "venv"):
        env = env.venv
    env._steps = steps


def _imitate(run: TrainingRun, model: Any, lanes: CountedEnvironments, report: Report | None) -> None:
    """Teach the model, before PPO begins, the actions of the baseline that the hyper-parameters name."""
    from agents.policies.baselines import baseline
    from agents.training.imitation import imitate

    name, settings = _named(run.hyperparameters["imitate"])
    teacher = baseline(name, run.environment, lanes.config, int(model.action_space.shape[0]))

    def told(share: float) -> None:
        if report is not None:
            report(Progress(0, run.total, 0, {}, {}, 0.0, 0.0, share))

    seed = segment_seed(run.seed, IMITATION)
    with _settings_of(f"imitate {name}"):
        wanted = inspect.signature(imitate).bind(model, teacher, seed=seed, told=told, **settings)
    left = imitate(*wanted.args, **wanted.kwargs)
    lanes.forget()  # the teacher's episodes do not count as the training's
    logger.info("the policy begins as %s, its actions within %.3g", name, left)


@contextmanager
def _settings_of(name: str) -> Iterator[None]:
    """Raise HyperparameterError if a constructor in the block rejects its arguments: SB3 checks some by assertions."""
    try:
        yield
    except (TypeError, AssertionError) as error:
        raise HyperparameterError(f"{name} does not take these hyper-parameters: {error}") from None


def _named(value: Any) -> tuple[str, dict[str, Any]]:
    """Return name and settings of an entry in RL-Zoo's form: a name, or a table of a name and its settings."""
    if not isinstance(value, Mapping):
        return str(value), {}
    if len(value) != 1:
        raise HyperparameterError(f"one name with its settings is wanted, not {', '.join(map(str, value))}")
    [(name, settings)] = value.items()
    return str(name), dict(settings or {})


def found(name: str) -> Any:
    """Import the object of "module:name".

    Raises:
        HyperparameterError: If there is no such object.
    """
    module, _, kind = str(name).partition(":")
    try:
        return getattr(importlib.import_module(module), kind)
    except (ImportError, AttributeError) as error:
        raise HyperparameterError(f"{name!r} is not a module:name that can be imported: {error}") from None


def _policy(name: str) -> Any:
    """Return the policy class of a name "module:class", or SB3's own name."""
    return found(name) if ":" in str(name) else name


def _with_classes(value: Any) -> Any:
    """Return policy_kwargs with "nn.Tanh" and the like as torch's classes."""
    import torch

    if isinstance(value, Mapping):
        return {key: _with_classes(one) for key, one in value.items()}
    if isinstance(value, str) and value.startswith("nn."):
        try:
            return getattr(torch.nn, value[3:])
        except AttributeError:
            raise HyperparameterError(f"torch.nn has no {value[3:]!r}; activations are nn.Tanh, nn.ReLU, ...") from None
    return value
