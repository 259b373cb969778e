"""Hyper-parameters as YAML in RL-Zoo's form: a file per environment and algorithm, `<environment>_<algorithm>.yaml`.

A section named after the environment holds RL-Zoo's hyper-parameters; sections `quick` and `full` replace entries of it
for the presets. Strings like "dict(net_arch=[64, 64], activation_fn=nn.Tanh)" are read as in RL-Zoo, but without
evaluating code.
"""

from __future__ import annotations

import ast
import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from agents.tasks import environment_name, row_of
from agents.training.algorithms import ALGORITHMS, NOT_TAKEN, SAME_HYPERPARAMETERS
from drive_env.envs import environment_of
from drive_env.envs.suite import TASKS
from mechanics.reading.untrusted import check_table, read_text

FOLDER = Path(__file__).parent
PRESETS = ("quick", "full")

# Keys of the run, as in RL-Zoo; all others go to the algorithm's constructor. Our addition is `imitate`, the name of a
# baseline that the policy first imitates, with settings of `agents.training.imitation.imitate`.
RUN_KEYS = ("n_envs", "n_timesteps", "policy", "normalize", "env_kwargs", "vec_env_wrapper", "imitate")


MOST_YAML = 1_000_000  # bytes; PyYAML reads about 100 kB/s


class HyperparameterError(ValueError):
    """A file of hyper-parameters is wrong; the message says where."""


class _DifferentNames(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML has no types
    """PyYAML's safe reader, but a duplicate name is an error instead of replacing the first."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        names = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        for name, count in Counter(names).items():
            if count > 1:
                raise yaml.YAMLError(f"the name {name[:100]!r} stands twice in one table; leave one of them")
        table: dict[Any, Any] = super().construct_mapping(node, deep)
        return table


def load(
    environment: str, algorithm: str, preset: str = "full", path: str | Path | None = None, section: str | None = None
) -> dict[str, Any]:
    """Return the hyper-parameters of a run.

    Args:
        environment: The environment's name, or its last part in any spelling (gain_tuning, Tracking-v0).
        algorithm: One of ALGORITHMS.
        preset: One of PRESETS.
        path: File to use instead of the shipped one; None for the shipped one.
        section: A section of the file whose entries replace those of the preset, e.g. of a load.

    Raises:
        HyperparameterError: For an unknown preset, file or section, a file that cannot be read, or a wrong value.
    """
    task = environment_name(environment)
    name = environment_of(task)
    if preset not in PRESETS:
        raise HyperparameterError(f"there is no preset {preset!r}; there are {', '.join(PRESETS)}")
    file = _file(name, algorithm, path)
    table = _read(file)
    if name not in table:
        raise HyperparameterError(f"{file} has no section {name}; it has {', '.join(map(str, table))}")
    found: dict[str, Any] = {}
    chosen = [name, preset] if section is None else [name, preset, section, f"{section}/{preset}"]
    if task != name and task in table:
        chosen.append(task)
    if section is not None and section not in table:
        raise HyperparameterError(f"{file} has no section {section}; it has {', '.join(map(str, table))}")
    for key in chosen:
        merge(found, {name: read_value(value) for name, value in (table.get(key) or {}).items()})
    if task in TASKS:
        found.pop("env_kwargs", None)  # the task has its own
    if path is None:  # in a user's file it is a mistake
        for key in NOT_TAKEN.get(algorithm, ()):
            found.pop(key, None)
    for key in ("n_envs", "n_timesteps", "policy"):
        if found.get(key) is None:
            raise HyperparameterError(f"{file}: {key} is missing in section {name}")
    for key in ("n_envs", "n_timesteps"):
        found[key] = _whole(file, key, found[key])
    normalize = found.get("normalize")
    if not isinstance(normalize, (bool, Mapping, type(None))):
        raise HyperparameterError(f"{file}: normalize is true, false or VecNormalize's settings, not {normalize!r}")
    return found


def sections(environment: str, algorithm: str, path: str | Path | None = None) -> tuple[str, ...]:
    """Return the sections of loads in a file (by default the shipped one), without environment and presets."""
    name = environment_of(environment_name(environment))
    table = _read(_file(name, algorithm, path))
    return tuple(key for key in table if key not in (name, *PRESETS) and "/" not in key)


def merge(found: dict[str, Any], others: Mapping[str, Any]) -> None:
    """Merge other entries into those found, tables within tables, too."""
    for key, value in others.items():
        if isinstance(value, Mapping) and isinstance(found.get(key), dict):
            merge(found[key], value)
        else:
            found[key] = dict(value) if isinstance(value, Mapping) else value


def read_value(value: Any) -> Any:
    """Return the value of an entry: RL-Zoo writes tables as "dict(...)" and classes as "nn.Tanh", numbers as 1e-4 too.

    Raises:
        HyperparameterError: For anything else that would have to be evaluated.
    """
    if not isinstance(value, str):
        return value
    text = value.strip()
    try:
        return float(text)  # YAML 1.1 reads 1e-4 as text
    except ValueError:
        pass
    if not text.startswith(("dict(", "{", "[", "(")):
        return text
    try:
        return _literal(ast.parse(text, mode="eval").body)
    except SyntaxError as error:
        raise HyperparameterError(f"{value!r} cannot be read: {error.msg}") from None
    except TypeError as error:  # a list as a key
        raise HyperparameterError(f"{value!r} cannot be read: {error}") from None
    except (RecursionError, MemoryError):  # Python's parser raises either
        raise HyperparameterError(f"a value that begins with {text[:40]!r} nests too deep") from None


def schedule(value: Any) -> Any:
    """Return a value, or for RL-Zoo's "lin_3e-4" its schedule; HyperparameterError for "lin_" without a number."""
    if isinstance(value, str) and value.startswith("lin_"):
        try:
            first = float(value[4:])
        except ValueError:
            raise HyperparameterError(f"a schedule is lin_ and a number, e.g. lin_3e-4, not {value!r}") from None
        return Linear(first)
    return value


class Linear:
    """A schedule that falls linearly from `first` to 0."""

    def __init__(self, first: float) -> None:
        self.first = first

    def __call__(self, remaining: float) -> float:
        """Return the value at the remaining share of the run, 1...0."""
        return self.first * remaining


def _whole(file: Path, key: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 1 <= value < math.inf or value % 1:
        raise HyperparameterError(f"{file}: {key} must be a whole number of 1 or more, not {value!r}")
    return int(value)


def _file(environment: str, algorithm: str, path: str | Path | None) -> Path:
    if algorithm not in ALGORITHMS:
        raise HyperparameterError(f"there is no algorithm {algorithm!r}; there are {', '.join(ALGORITHMS)}")
    if path is not None:
        return Path(path)
    return FOLDER / f"{row_of(environment).short}_{SAME_HYPERPARAMETERS.get(algorithm, algorithm)}.yaml"


def _read(file: Path) -> dict[str, Any]:
    try:
        table = yaml.load(read_text(file, MOST_YAML), _DifferentNames)
        check_table(table)
    except FileNotFoundError:
        raise HyperparameterError(f"there is no file {file}") from None
    except OSError as error:
        raise HyperparameterError(f"{file} cannot be read: {error.strerror}") from None
    except RecursionError:
        raise HyperparameterError(f"{file} cannot be read as YAML: it nests too deep") from None
    except (yaml.YAMLError, ValueError) as error:
        raise HyperparameterError(f"{file} cannot be read as YAML: {' '.join(str(error).split())}") from None
    if not isinstance(table, dict):
        raise HyperparameterError(f"{file} holds no sections; the first is the environment's name")
    for name, section in table.items():
        if (
            not isinstance(name, str)
            or not isinstance(section, dict | type(None))
            or any(not isinstance(key, str) for key in section or ())
        ):
            raise HyperparameterError(f"{file}: section {name!r} must be a table of hyper-parameters by name")
    return table


def _literal(node: ast.expr) -> Any:
    match node:
        case ast.Call(func=ast.Name(id="dict"), args=[], keywords=keywords):
            return {str(one.arg): _literal(one.value) for one in keywords}
        case ast.Attribute(value=ast.Name(id="nn"), attr=name):
            return f"nn.{name}"
        case ast.Dict(keys=keys, values=values):
            return {_literal(k): _literal(v) for k, v in zip(keys, values, strict=True) if k is not None}
        case ast.List(elts=elements) | ast.Tuple(elts=elements):
            return [_literal(one) for one in elements]
    try:
        return ast.literal_eval(node)
    except ValueError:
        raise HyperparameterError(
            f"{ast.unparse(node)!r} is neither a number, text, list, dict(...) nor a class of nn; write it as YAML"
        ) from None
