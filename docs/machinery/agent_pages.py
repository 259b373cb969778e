"""The page of the agents that ship, from the card in each one's file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tables import table

from agents.policies.agent_file import AgentFile
from agents.shipped import shipped, shipped_names
from drive_env.envs import ENVIRONMENTS
from drive_env.envs.suite import TASKS

PAGE = """# Agents that ship

An agent is one small file (`.npz`) with its weights, the normaliser of its observations, and a card of how it was
trained and what it reaches. It acts with NumPy alone. `drive-tune auto --by agent` uses `gain_tuning`; the others are
controllers that `drive-agent evaluate NAME` runs, on emulated drives or on a bus. `drive-agent evaluate NAME --card`
prints a card.

This page is made from the cards.

"""


def pages() -> dict[str, str]:
    """Return the page."""
    return {"reference/agents.md": PAGE + "\n".join(section(name) for name in shipped_names())}


def section(name: str) -> str:
    """Return an agent's section: task, training, figures."""
    agent = AgentFile.load(shipped(name))
    card = agent.card
    if agent.environment in TASKS:
        page = f"../tasks.md#{agent.environment.partition('/')[2].lower()}"
    else:
        page = f"environments/{ENVIRONMENTS[agent.environment][0]}.md"
    rows = [
        ("environment", f"[`{agent.environment}`]({page})"),
        ("options that it was trained with", options(agent)),
        ("machines", named(card["distribution"])),
        ("training", card["trained"]),
        ("limits", named(card["limits"])),
    ]
    if margins := card.get("margins"):
        rows.append(
            (
                f"loops on {margins['machines']} machines",
                f"have an Ms within `{margins['dynamics']}`: {margins['Ms median']:.2f} in the median, "
                f"{margins['Ms greatest']:.2f} at most",
            )
        )
    return "\n".join([f"## {name}\n", table(("", ""), rows), figures(card["figures"])])


def options(agent: AgentFile) -> str:
    """Return the load and the options that differ from the environment's defaults, briefly."""
    known = agent.configuration
    chosen = {key: known[key] for key in ("load", "mode", "action", "gains", "trials") if key in known}
    return ", ".join(f"`{key}={value!r}`" for key, value in chosen.items())


def named(value: Any) -> str:
    """Return a text, or a list of texts, as one."""
    return value if isinstance(value, str) else "; ".join(value)


def figures(known: Mapping[str, Any]) -> str:
    """Return the figures: means over episodes with their 95 % interval."""
    plain = [(key, number(value)) for key, value in known.items() if is_figure(value)]
    text = table(("figure", "mean [95 % interval]"), plain) if any("[" in row[1] for row in plain) else table(
        ("figure", "value"), plain)  # fmt: skip
    for key, value in known.items():
        if isinstance(value, Mapping) and not is_figure(value):
            text += f"\n{key}:\n\n" + table(("", "value"), [(f"{k}", number(v)) for k, v in value.items()])
    return text


def is_figure(value: Any) -> bool:
    """Return whether a value is one figure and not a table of several."""
    return not isinstance(value, Mapping) or "mean" in value


def number(value: Any) -> str:
    """Return a figure as it stands in a cell."""
    if isinstance(value, Mapping) and "mean" not in value:
        return ", ".join(f"{name} {number(figure)}" for name, figure in value.items())
    if isinstance(value, Mapping):
        return f"{value['mean']:.3g} [{value['low']:.3g}, {value['high']:.3g}]"
    if isinstance(value, list):
        return f"{value[0]:g} to {value[1]:g}"
    return f"{value:g}" if isinstance(value, float) else str(value if value is not None else "")
