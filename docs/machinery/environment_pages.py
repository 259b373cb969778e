"""The environments: an index, and a page for each from its class' docstring and its configuration."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import re
from typing import Any

from tables import table

from drive_env.envs import ENVIRONMENTS

FOLDER = "reference/environments"
INDEX = """# Environments

`import drive_env` registers them with Gymnasium. All are vectorised: each environment of a vector is a machine of its
own, and 64 of them cost little more than one.

{table}
```python
import gymnasium as gym
import drive_env  # registers the environments

env = gym.make_vec("ServoDrive/Tracking-v0", num_envs=64, vectorization_mode="vector_entry_point", load="two_mass")
observations, infos = env.reset(seed=0)
for _ in range(100):
    observations, rewards, terminated, truncated, infos = env.step(env.action_space.sample())
```

The [learning tasks](../../tasks.md), `ServoDrive/...-v1`, are frozen configurations of these.

`gym.make("ServoDrive/Tracking-v0")` makes a single one; `gym.make("drive_env:ServoDrive/Tracking-v0")` needs no import
before, as in the configuration of a training script. The steps of an episode are in `env.spec.max_episode_steps`,
whatever the configuration makes them, so that wrappers like `TimeAwareObservation` work; the environment itself
truncates. With Stable-Baselines3 one line makes its `VecEnv`:
`drive_env.envs.make_vec_env("ServoDrive/Tracking-v0", num_envs=8, load="inertia")`.

Every environment takes

- `config=`, a dataclass, a table or a TOML file, and each of its fields as an option;
- `distributions=`, a set from which the machine of each episode is drawn: [a name](distributions.md), or a TOML file of
  your own;
- `drives=`, a `CanDrives`, to act on real drives in place of emulated ones;
- `render_mode=`, `"rgb_array"` for pictures of machine and scope (Gymnasium's `RecordVideo` films them), `"human"` for
  a window;
- `reward=`, a function of observations, actions and info of your own; `info["reward_terms"]` has the terms of ours,
  `info["terminated"]` and `info["truncated"]` say which episodes end with this step;
- `stage`, 0 to 1, an attribute that widens the set of machines during training.

## Resets

`env.reset(seed=..., options=...)` takes a dict of

| option | what it does |
| --- | --- |
| `machine` | true parameters for this episode by name, one value or one per environment; the rest is drawn |
| `trajectory` | Tracking alone: for this episode a function, or rows of (3, samples) or (all axes, 3, samples) |
| `state` | goes on from a saved state instead of beginning an episode; nothing else is given then |
| `reset_mask` | of vector environments: which of them begin |

## States

`state = env.unwrapped.save_state()` takes down all that an environment goes on from: drives, machine, trajectory,
messages on the bus, random generators, how far the episode is. `env.unwrapped.restore_state(state)` puts it back, and
what follows is the same to the bit, as often as you like: for planning with the emulator as the model, for resets to a
state, for a tree search. A state is dicts of arrays; it pickles, and another environment of the same configuration
takes it, in another process too. One of another configuration is refused with what differs. `copy.deepcopy(env)` and
`pickle` copy an environment with its state. Vector environments do all that likewise. Real drives cannot be put back:
on a bus all of it is refused.

The file that an environment's configuration comes from may hold any field of the tables on its page.
"""
# One line for the index: what an agent does there.
TASKS = {
    "GainTuning": "commissioning as an episode: one step is one trial of gains on an unknown machine",
    "GainScheduling": "gains follow the machine while a payload changes: new ones every 5 to 20 ms",
    "Tracking": "the agent is the outer controller in csp, csv or cst: trajectories, a crane, a standing pole",
}


def pages() -> dict[str, str]:
    """Return the index and a page for each environment."""
    rows, made = [], {}
    for name, (module, kind) in ENVIRONMENTS.items():
        rows.append((f"[`{name}`]({module}.md)", TASKS[kind]))
        made[f"{FOLDER}/{module}.md"] = page(name, module, kind)
    return {f"{FOLDER}/index.md": INDEX.format(table=table(("name", "what an agent does"), rows)), **made}


def page(name: str, module: str, kind: str) -> str:
    """Return the page of an environment."""
    home = importlib.import_module(f"drive_env.envs.{module}")
    environment = getattr(home, kind)
    text, arguments = parts_of(inspect.cleandoc(environment.__doc__))
    configuration = getattr(home, f"{kind}Config")
    return "\n".join(
        [
            f"# {kind}\n",
            f"![{kind}: machine and scope](../../assets/environments/{module}.webp){{ width=960 }}\n",
            f'`gym.make("{name}")`, or `gym.make_vec("{name}", num_envs=64, '
            'vectorization_mode="vector_entry_point")`\n',
            with_headings(text),
            "## Configuration\n",
            "Fields of its configuration, each of which is an option of `gym.make`, too.\n",
            fields(configuration),
            meanings(configuration),
            "## Arguments\n",
            described(arguments),
        ]
    )


def parts_of(text: str) -> tuple[str, str]:
    """Return the part of a docstring before `Args:`, and its arguments; its `Raises:` is on the page of the API."""
    before, _, after = text.partition("\nArgs:\n")
    return before, inspect.cleandoc(after.partition("\nRaises:")[0])


def with_headings(text: str) -> str:
    """Return a class' text with a heading before each of its parts, which the docstring begins with a known word."""
    text = re.sub(r" (?=`info`: )", "\n\n", text, count=1)  # where it follows in the same paragraph
    for word, heading in (("Action", "Action space"), ("Observation", "Observation space"),
                          ("(?:The reward|Reward)", "Reward and end"), ("`info`", "Info")):  # fmt: skip
        text = re.sub(rf"(?m)^(?={word}\b|{word}[:,])", f"## {heading}\n\n", text, count=1)
    return text + "\n"


def fields(configuration: Any) -> str:
    """Return the fields with their defaults, those that depend on the load or device as the code fills them in."""
    plain = configuration()
    rows = []
    for one in dataclasses.fields(configuration):
        value = getattr(plain, one.name)
        given = one.default is None and value is not None
        rows.append((f"`{one.name}`", f"`{one.type}`", shown(value) + (" (of the default load)" if given else "")))
    return table(("field", "type", "default"), rows)


def shown(value: Any) -> str:
    """Return a default as Python writes it."""
    return f"`{dict(value)!r}`" if hasattr(value, "items") else f"`{value!r}`"


def meanings(configuration: Any) -> str:
    """Return the fields of the configuration's docstring as a list."""
    return described(inspect.cleandoc(configuration.__doc__).partition("\n\n")[2])


def described(text: str) -> str:
    """Return `names: text` paragraphs of a docstring as a list."""
    found: list[str] = []
    for line in text.splitlines():
        if line and not line.startswith(" ") and re.match(r"[\w, \[\]/]+: ", line):
            names, _, rest = line.partition(": ")
            names = re.sub(r"[A-Za-z_]\w*(?![\w/\]]*\])", r"`\g<0>`", names)
            found.append(f"- {names}: {rest}")
        else:
            found.append(f"  {line.strip()}")
    return "\n".join(found) + "\n"
