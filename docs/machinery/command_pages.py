"""A page for each of the three programs: its commands, with every argument and option."""

from __future__ import annotations

import importlib
from typing import Any

import typer.main
from tables import table

FOLDER = "reference/commands"
PROGRAMS = {
    "drive-env": "drive_env.commands.cli",
    "drive-tune": "tuning.commands.cli",
    "drive-agent": "agents.commands.cli",
}


def pages() -> dict[str, str]:
    """Return a page for each program."""
    return {f"{FOLDER}/{name}.md": page(name, importlib.import_module(home).app) for name, home in PROGRAMS.items()}


def page(name: str, app: Any) -> str:
    """Return the page of a program."""
    program = typer.main.get_command(app)
    parts = [f"# {name}\n", text_of(program), f"`{name} COMMAND --help` prints what stands here.\n"]
    parts += ["## Before the command\n", options_of(program)]
    for path, command in commands(program):
        parts += [f"## {' '.join((name, *path))}\n", text_of(command), options_of(command)]
    return "\n".join(parts)


def commands(group: Any, above: tuple[str, ...] = ()) -> list[tuple[tuple[str, ...], Any]]:
    """Return the commands of a program, with the words that name them."""
    found: list[tuple[tuple[str, ...], Any]] = []
    for name, command in group.commands.items():
        if command.hidden:  # an old name
            continue
        path = (*above, name)
        found += commands(command, path) if hasattr(command, "commands") else [(path, command)]
    return found


def text_of(command: Any) -> str:
    """Return a command's help."""
    return (command.help or "").strip() + "\n"


def options_of(command: Any) -> str:
    """Return a table of a command's arguments and options."""
    rows = [
        (names(one), (one.help or "").replace("\n", " "), default(one), f"`{one.envvar}`" if one.envvar else "")
        for one in command.params
        if not one.hidden and one.name != "help"
    ]
    with_variables = any(row[3] for row in rows)
    head = ("argument or option", "meaning", "default", "environment variable")
    width = len(head) if with_variables else 3
    return table(head[:width], [row[:width] for row in rows]) if rows else "No options.\n"


def names(parameter: Any) -> str:
    """Return how an argument or option is written."""
    if parameter.param_type_name == "argument":
        word = parameter.metavar or parameter.name.upper()
        return f"`{word}`" + ("" if parameter.required else " (optional)")
    spelled = ", ".join(f"`{one}`" for one in (*parameter.opts, *parameter.secondary_opts))
    return spelled + (" (may be repeated)" if parameter.multiple else "")


def default(parameter: Any) -> str:
    """Return the default as the help shows it."""
    if isinstance(parameter.show_default, str):
        return parameter.show_default
    value = parameter.default
    if parameter.required:
        return "must be given"
    if value is None or value in ((), []) or callable(value) or isinstance(value, bool):
        return ""
    return f"`{getattr(value, 'value', value)}`"
