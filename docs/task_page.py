"""docs/tasks.md from the suite's table and docs/task_scores.json: `python docs/task_page.py` writes it anew.

`python docs/task_page.py FOLDER ...` takes the scores from folders of `drive-agent benchmark` first, and plays the
policies that have learnt nothing.
"""

from __future__ import annotations

import inspect
import json
import sys
from pathlib import Path
from typing import Any

from PIL import Image

from agents.policies.agent_file import AgentFile
from agents.policies.baselines import SUITE_TASKS
from agents.shipped import shipped, shipped_names
from agents.tasks import short_name
from drive_env.envs.gain_scheduling import GainScheduling
from drive_env.envs.gain_tuning import GainTuning
from drive_env.envs.suite import TASKS, SuiteTask
from drive_env.envs.tracking import Tracking

HERE = Path(__file__).parent
SCORES = HERE / "task_scores.json"
CURVES = "assets/tasks/{}_curves.webp"
MACHINES = 24
INTRODUCTION = """# Learning tasks

Tasks to train on and to compare agents by. Each is an id that never changes: device, load, mode, action,
distributions, horizon and reward belong to it, and it takes no options. `gymnasium.make("ServoDrive/Crane-v1")` makes
one, `drive_env.envs.make_vec_env("ServoDrive/Crane-v1", num_envs=64)` many for Stable-Baselines3, `drive-agent train
--environment Crane-v1` trains, and `drive-agent benchmark --task Crane-v1` trains with several seeds and judges in
held-out episodes. For other loads, modes and rewards take `ServoDrive/Tracking-v0`, `ServoDrive/GainScheduling-v0`
and `ServoDrive/GainTuning-v0`, whose configurations these are.

The reward of a step lies in 0...1, nothing is earned after a fall or a trip, and the score of an episode is the sum of
rewards over the horizon. Every episode has a machine of its own, drawn from the load's distributions: inertia,
friction, stiffness, motor, power stage, and the delays of the bus.

What is in the table: the best of some twenty policies that have learnt nothing (zero, random, bang-bang on the
following error or by turns, nine constants; of Tracking eight pairs of gains on the errors of position and speed, of
StepperRun eight speeds that are kept, of GainScheduling five constant sets of gains, the best of a search over 141
among them, of GainTuning 26 constant sets); the *cascade* that a drive or a master has anyway, in a tuning with the
gains that it is commissioned with; the *expert*, which is what a motion engineer would program who knows the
parameters of each machine; *nominal*, the same program with the nominal parameters on every machine, since agents do
not know the machine either; and agents, trained as `drive-agent benchmark` trains them, with as many seeds as the table
says. Baselines and agents have the same 64 held-out episodes; the figure is the interquartile mean, of agents with its
95 % interval and with the mean, which sees rare failures. Agents see only what the drives tell. An agent ships where it
is better than the expert with 95 % confidence, and the Ms of its loops is at most 2 on 32 drawn machines: it then
answers following errors by less than it had learnt (`drive-agent margins agent.npz --dynamics standard --out
calm.npz`), which costs some of its score. Where none ships, take the expert. Of StepperRun none can ship: under a push
of 1 % of the rated torque the rotor swings in its field with an Ms of 6 in the median of 24 machines, and every sixth
loses its steps with the expert, every fourth with an agent, since near the highest speed no torque is left. Of
KnownPayload none ships: agents win by leaving a fifth of the margins for less lag while an axis moves fast, and over a
bus nothing tells the payload.

"""
# Task -> what the expert has and the agents lack, told while none of them is better.
LACKS = {
    "TorqueTracking-v1": "the expert knows each machine's inertia and friction, of which an agent sees what the first "
    "moves of its second show; with nominal parameters the expert has far less than an agent. One with memory is "
    "better in 64 % of the episodes (95 % interval 52 to 75 %), but machines differ so much that 64 of them do not "
    "tell their interquartile means apart.",
    "Crane-v1": "the expert knows the rope, of which an agent sees angle and rate of the moment alone. What it is "
    "taught is one answer for all ropes, better than the nominal rope's; exploration adds little, since an action "
    "changes a speed by little and the reward is flat until the load is within some centimetres of its path.",
    "PoleBalance-v1": "as Crane-v1, of the pole's length.",
    "PoleSwingUp-v1": "as PoleBalance-v1.",
    "PayloadScheduling-v1": "the expert knows the payload, which an agent sees in currents and errors alone.",
    "ServoTuning-v1": "the expert computes the margins of each machine's true model; an agent has ten trials of it, "
    "the first ones of which count, too.",
    "AmplifierTuning-v1": "as ServoTuning-v1; a trial takes some ten milliseconds, so that few are made in the time of "
    "other tasks.",
}


def page() -> str:
    """Return the page."""
    scores = json.loads(SCORES.read_text(encoding="utf-8"))
    rows = [_row(name, task, scores.get(name, {})) for name, task in TASKS.items()]
    table = "\n".join(
        [
            "| task | what has learnt nothing | cascade | expert | nominal | trained agents | agent that ships |",
            "| --- | --- | --- | --- | --- | --- | --- |",
            *rows,
        ]
    )
    sections = "\n".join(_section(name, task, scores.get(name, {})) for name, task in TASKS.items())
    return f"{INTRODUCTION}{table}\n\n{_verdict(scores)}\n\n{sections}{_spaces()}"


def _verdict(scores: dict[str, Any]) -> str:
    """Return on which tasks learning wins and where it loses to the expert, by the agents' 95 % intervals, and why."""
    found: dict[str, list[str]] = {}
    for rival, known_as in (("expert", "the expert"), ("nominal", "the nominal expert")):
        for name in TASKS:
            known = scores.get(name, {}).get("baselines", {}).get(rival)
            if known is None:
                continue
            for policy, one in scores[name]["trained"].items():
                is_better, is_worse = one["low"] > known, one["high"] < known
                verdict = "is better than" if is_better else "loses to" if is_worse else "cannot be told from"
                tasks = found.setdefault(f"{verdict} {known_as}", [])
                tasks.append(f"{name.partition('/')[2]} ({policy})")
    won = {task.partition(" ")[0] for task in found.get("is better than the expert", ())}
    lines = [f"- Learning {verdict} on {', '.join(tasks)}." for verdict, tasks in found.items()]
    lines += ["", "Where no agent is better than the expert:", ""]
    lines += [f"- {task}: {reason}" for task, reason in LACKS.items() if task not in won]
    return "\n".join(lines)


def _row(name: str, task: SuiteTask, scores: dict[str, Any]) -> str:
    unlearnt = scores.get("unlearnt", {})
    best = max(unlearnt, key=lambda policy: unlearnt[policy], default="")
    agents = "; ".join(
        f"{policy} {one['value']:.3f} ({one['low']:.3f} to {one['high']:.3f}), mean {one['mean']:.3f}, "
        f"{one['ended_early']:.0%} ended early, {one['steps']:,} steps in {one['cpu_minutes']:.1f} CPU minutes, "
        f"{one['seeds']} seeds"
        for policy, one in scores.get("trained", {}).items()
    )
    baselines = scores.get("baselines", {})
    shown = [f"{baselines[row]:.3f}" if row in baselines else "-" for row in ("cascade", "expert", "nominal")]
    plain = f"{unlearnt[best]:.3f} ({best})" if best else "-"
    cells = [f"[{name.partition('/')[2]}](#{_anchor(name)})", plain, *shown, agents or "-", _ships(scores)]
    return f"| {' | '.join(cells)} |"


def _ships(scores: dict[str, Any]) -> str:
    """Return the agent of a task that ships, with its score and the greatest Ms of its loops."""
    return "; ".join(
        f"`{name}` {one['value']:.3f} ({one['low']:.3f} to {one['high']:.3f}), Ms at most "
        f"{AgentFile.load(shipped(name)).card['margins']['Ms greatest']:.2f}"
        for name, one in scores.get("shipped", {}).items()
    ) or "-"  # fmt: skip


def _section(name: str, task: SuiteTask, scores: dict[str, Any]) -> str:
    options = "\n".join(f"{key} = {_toml(value)}" for key, value in task.options.items() if not isinstance(value, dict))
    tables = "\n".join(
        f"{key} = {_toml({one: part for one, part in value.items() if part})}"
        for key, value in task.options.items()
        if isinstance(value, dict)
    )
    first = str(inspect.getdoc(SUITE_TASKS[name]["expert"])).partition("\n")[0].rstrip(".")
    expert, curves = first.removeprefix("Return the "), CURVES.format(short_name(name))
    picture = f"assets/tasks/{short_name(name)}.webp"
    if "oracle" in SUITE_TASKS[name]:
        oracle = str(inspect.getdoc(SUITE_TASKS[name]["oracle"])).partition("\n")[0].rstrip(".")
        known = scores["baselines"]["oracle"]
        expert += f". An oracle, {oracle[0].lower()}{oracle[1:]}, has {known:.3f}"
    return "\n".join(
        [
            f"## {name.partition('/')[2]}\n",
            f"{task.about[0].upper()}{task.about[1:]}. An episode has {task.steps} steps. The expert:",
            f"{expert[0].lower()}{expert[1:]}.\n",
            *([f"![The machine and its expert at work]({picture})\n"] if (HERE / picture).is_file() else []),
            f"```toml\n{options}\n{tables}\n```\n",
            *([f"![Learning curves]({curves})\n"] if (HERE / curves).is_file() else []),
        ]
    )


def _spaces() -> str:
    """Return the actions, observations and rewards of the environments, from their docstrings."""
    parts = []
    for kind in (Tracking, GainScheduling, GainTuning):
        tasks = [name.partition("/")[2] for name, task in TASKS.items() if kind.__name__ in task.environment]
        text = inspect.cleandoc(kind.__doc__ or "").partition("\nArgs:\n")[0].partition("\n\n")[2].rstrip()
        parts.append(f"\n## Actions, observations, terms of {kind.__name__}\n\nOf {', '.join(tasks)}:\n\n{text}\n")
    return "".join(parts)


def _anchor(name: str) -> str:
    return name.partition("/")[2].lower()


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        rows = (
            f"{name if name.isidentifier() else json.dumps(name)} = "
            + (f"{one:g}" if isinstance(one, float) else _toml(one))
            for name, one in value.items()
        )
        return f"{{ {', '.join(rows)} }}"
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value).replace("Infinity", "inf")


def measure(folder: Path, scores: dict[str, dict[str, Any]]) -> None:
    """Take a benchmark's results into the scores, with those of untrained policies."""
    from agents.benchmark.unlearnt import unlearnt_scores

    rows = [row for row in json.loads((folder / "results.json").read_text(encoding="utf-8")) if row["task"] in TASKS]
    for name in dict.fromkeys(row["task"] for row in rows):
        unlearnt = {policy: round(score, 4) for policy, score in unlearnt_scores(name, MACHINES).items()}
        scores[name] = {"trained": {}, "baselines": {}, **scores.get(name, {}), "unlearnt": unlearnt}
        curves = folder / name.partition("/")[2] / "learning_curves.png"
        if curves.is_file():
            with Image.open(curves) as picture:
                picture.save(HERE / CURVES.format(short_name(name)), quality=82, method=6)
    for row in rows:
        own = scores[row["task"]]
        if row["kind"] == "baseline":
            own["baselines"][row["policy"]] = round(row["score"]["value"], 4)
            continue
        figures = {key: round(row["score"][key], 4) for key in ("value", "low", "high")}
        if row["kind"] == "trained":
            kept = ("mean", "ended_early", "steps", "cpu_minutes", "seeds")
            own["trained"][row["policy"]] = figures | {key: round(row[key], 4) for key in kept}
        elif row["policy"] in shipped_names():  # submitted
            own.setdefault("shipped", {})[row["policy"]] = figures


if __name__ == "__main__":
    if len(sys.argv) > 1:
        kept = json.loads(SCORES.read_text(encoding="utf-8"))
        for argument in sys.argv[1:]:
            measure(Path(argument), kept)
        kept = {name: kept[name] for name in TASKS if name in kept}
        SCORES.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    (HERE / "tasks.md").write_text(page(), encoding="utf-8")
