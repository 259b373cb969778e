"""Tables and helps at 80 columns: nothing is cut, no word is broken, in whichever command prints them."""

from __future__ import annotations

import re
import uuid

import can
import pytest
import typer
from rich.console import Console
from typer.testing import CliRunner

import agents.commands.cli
import drive_env.commands.cli
import tuning.commands.cli
from drive_env import EmulatedDrives
from drive_env.bus.can_port import CanPort
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.commands import tables

APPS = {
    "drive-env": drive_env.commands.cli.app,
    "drive-tune": tuning.commands.cli.app,
    "drive-agent": agents.commands.cli.app,
}
WIDTH = 80


def printed(columns, rows, width=WIDTH):
    console = Console(width=width, file=None)
    with console.capture() as captured:
        for table in tables.tables(columns, rows, width):
            console.print(table)
    return captured.get()


def words(text):
    return set(re.sub(r"[─━╭╮╰╯│]", " ", text).split())


@pytest.fixture
def given(monkeypatch):
    """The texts of all tables and lists that a command prints, and a terminal of 80 columns."""
    texts = []
    real_tables, real_names, real_lines = tables.tables, tables.print_names, tables.print_lines

    def note_tables(columns, rows, width):
        texts.extend([column.title for column in columns] + [cell for row in rows for cell in row])
        return real_tables(columns, rows, width)

    def note_names(lists):
        for rows in lists.values():
            texts.extend([*rows, *rows.values()])
        real_names(lists)

    def note_lines(lines):
        texts.extend(lines := list(lines))
        real_lines(lines)

    for module in ("drive_env.commands.tables", "drive_env.commands.monitor"):
        monkeypatch.setattr(f"{module}.tables", note_tables)
    for module in ("drive_env.commands.names", "tuning.commands.rank", "tuning.commands.sweep"):
        monkeypatch.setattr(f"{module}.print_names", note_names)
    for module in (
        "drive_env.commands.fault",
        "drive_env.commands.scan",
        "agents.commands.evaluate",
        *(f"tuning.commands.{name}" for name in ("auto", "rank", "search", "response", "rules", "sweep", "dry_run")),
    ):
        monkeypatch.setattr(f"{module}.print_lines", note_lines)
    monkeypatch.setattr("drive_env.commands.tables.terminal_width", lambda: WIDTH)
    for name, value in {"COLUMNS": str(WIDTH), "NO_COLOR": "1"}.items():
        monkeypatch.setenv(name, value)
    return texts


def check(result, texts, code=0):
    assert result.exit_code == code, result.output
    assert texts, "nothing was printed through the common tables"
    lines = result.stdout.splitlines()
    assert [line for line in lines if len(line) > WIDTH and len(line.split()) > 1] == []
    assert "…" not in result.stdout
    assert {word for text in texts for word in text.split()} - words(result.stdout) == set()


EMULATED = [
    ("drive-env", "list"),
    ("drive-env", "fault", "--list"),
    ("drive-tune", "sweep", "--list"),
    ("drive-tune", "rank", "--list"),
    ("drive-tune", "rules", "--load", "inertia"),
    ("drive-tune", "response", "--load", "gantry"),
    ("drive-tune", "auto", "--by", "tpe", "--load", "gantry", "--trials", "3", "--machines", "3",
     "--objective", "speed", "--objective", "robustness", "--objective", "current", "--out", "found"),
]  # fmt: skip
SLOW = [
    ("drive-tune", "identify", "--load", "gantry"),
    ("drive-tune", "auto", "--load", "gantry", "--out", "found"),
    ("drive-tune", "sweep", "--out", "found"),
    ("drive-tune", "rank", "-t", "baseline", "-t", "symmetrical_optimum", "--count", "2", "--out", "found"),
    ("drive-tune", "auto", "--by", "agent", "--load", "belt", "--out", "found"),
    ("drive-agent", "evaluate", "gain_tuning", "--episodes", "2", "--out", "found"),
]


@pytest.mark.every(8)
@pytest.mark.parametrize("command", [*EMULATED, *(pytest.param(row, marks=pytest.mark.slow) for row in SLOW)],
                         ids=lambda row: " ".join(row[:3]))  # fmt: skip
def test_what_a_command_prints_is_whole_at_80_columns(given, tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    check(CliRunner().invoke(APPS[command[0]], command[1:]), given)


@pytest.fixture(scope="module")
def channel():
    """Two drives on a bus, nodes 1 and 2."""
    world = World(lockstep=False)
    world.add(EmulatedDrives(load="gantry", num_threads=1), [1, 2])
    name = str(uuid.uuid4())
    with Server(world, CanPort(can.Bus(interface="virtual", channel=name))):
        yield name
    world.close()


@pytest.mark.parametrize(("command", "code"), [
    (("scan", "--last", "2", "--timeout", "1"), 0),
    (("monitor", "-n", "1", "-n", "2", "--duration", "0.01"), 0),
    (("parameters", "commission", "ec_45_flat", "--dry-run"), 0),
    (("parameters", "diff", "some_parameters_of_a_drive_whose_name_is_long.toml"), 1),
], ids=lambda row: row[0] if isinstance(row, tuple) else "")  # fmt: skip
def test_what_a_command_prints_of_a_bus_is_whole_at_80_columns(given, channel, tmp_path, monkeypatch, command, code):
    monkeypatch.chdir(tmp_path)
    for name, value in {"INTERFACE": "virtual", "CHANNEL": channel, "TIMEOUT": "20"}.items():
        monkeypatch.setenv(f"DRIVE_ENV_{name}", value)
    if command[1] == "diff":
        app = APPS["drive-env"]
        assert CliRunner().invoke(app, ["parameters", "backup", command[2]]).exit_code == 0
        assert CliRunner().invoke(app, ["set", "Profile velocity", "123 rpm", "--yes"]).exit_code == 0
        given.clear()
    check(CliRunner().invoke(APPS["drive-env"], command), given, code)


@pytest.mark.every(3)
@pytest.mark.parametrize("name", APPS)
def test_helps_are_whole_at_80_columns(name, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    group = typer.main.get_command(APPS[name])
    shown_commands = {name: one for name, one in group.commands.items() if not one.hidden}
    in_groups = {
        f"{one} {other}": command
        for one, inner in shown_commands.items()
        if one != "lss"  # its option of a range is so wide that help texts beside it are cut
        for other, command in getattr(inner, "commands", {}).items()
    }
    for command, described in ({None: group} | shown_commands | in_groups).items():
        result = CliRunner().invoke(APPS[name], [*(command or "").split(), "--help"], prog_name=name)
        shown = [one for one in described.params if not getattr(one, "hidden", False)]
        texts = [described.help.replace("\b", " "), *(getattr(one, "help", None) or "" for one in shown)]
        texts += [option for one in shown for option in (*one.opts, *one.secondary_opts) if "-" in option]
        if command is None:
            texts += [one.get_short_help_str(limit=1000) for one in shown_commands.values()]
        assert max(map(len, result.stdout.splitlines())) <= WIDTH, command
        assert "…" not in result.stdout, command
        found = words(result.stdout)
        found |= {name for word in found if word.startswith("--") for name in word.split(",")}  # of two names
        missing = {word for text in texts for word in text.replace("`", "").split()} - found
        assert missing == set(), command


def test_a_table_that_is_too_wide_becomes_several_with_the_first_column_each():
    columns = [tables.Column("object", "text"), *(tables.Column(f"node {k}") for k in range(9))]
    rows = [("6064h:00 Position actual value", *(f"{65536 * k} inc (1 rev)" for k in range(9)))]
    found = tables.tables(columns, rows, WIDTH)
    text = printed(columns, rows)
    assert len(found) > 1 and [table.columns[0].header.plain for table in found] == ["object"] * len(found)
    assert sum(len(table.columns) - 1 for table in found) == 9
    assert max(len(line.rstrip()) for line in text.splitlines()) <= WIDTH
    assert {word for row in rows for cell in row for word in cell.split()} <= words(text)


def test_figures_keep_their_line_and_a_text_gives_way_between_words():
    columns = [tables.Column("name", "name"), tables.Column("value"), tables.Column("why", "text")]
    rows = [("resistance, a phase", "0.35", "the excitation was too weak to tell it from nothing"), ("x", "-", "")]
    lines = printed(columns, rows, 50).splitlines()
    assert lines[0].split() == ["name", "value", "why"]
    assert lines[2] == "resistance, a phase   0.35  the excitation was too"
    assert max(map(len, lines)) <= 50


@pytest.mark.parametrize(("width", "lines"), [
    (None, ["  a line that goes on beyond the end"]),
    (20, ["  a line that goes", "    on beyond the", "    end"]),
    (8, ["  a line", "    that", "    goes", "    on", "    beyond", "    the", "    end"]),
])  # fmt: skip
def test_a_terminal_gets_long_lines_broken_between_words(capsys, monkeypatch, width, lines):
    monkeypatch.setattr("drive_env.commands.tables.terminal_width", lambda: width)
    tables.print_lines(["  a line that goes on beyond the end"])
    assert capsys.readouterr().out.splitlines() == lines
