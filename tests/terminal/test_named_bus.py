"""Who names a channel or an interface means the bus: no command of the three programs takes an emulated machine then.

The commands and their options are read from the programs, so that a new one is held to this by itself.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, NamedTuple, get_args, get_origin, get_type_hints

import pytest
import typer
from typer.testing import CliRunner

from agents.commands.cli import app as agent_app
from agents.evaluation import on_the_bus
from drive_env.commands.cli import app as env_app
from drive_env.emulator.emulated_drives import EmulatedDrives
from drive_env.whole_file import sealed
from tuning.commands.cli import app as tune_app
from tuning.snapshot import Snapshot

PROGRAMS = {"drive-env": env_app, "drive-tune": tune_app, "drive-agent": agent_app}
CHANNEL = "no-such-channel-here"  # longer than Linux lets a network interface's name be
NAMED = ("-i", "socketcan", "-c", CHANNEL)
CANNOT_OPEN = rf"cannot open (--)?interface '?socketcan'?,? (--)?channel '?{CHANNEL}"
NO_CHANNEL = "no CAN channel is given|a channel, the network interface"


class Option(NamedTuple):
    """An option or argument of a command: how it is typed, "" for an argument, and what it takes."""

    name: str
    typed: str
    kind: type
    required: bool


class Command(NamedTuple):
    """A command that may act on a bus."""

    program: str
    path: tuple[str, ...]
    options: dict[str, Option]

    def __str__(self) -> str:
        return " ".join((self.program, *self.path))


def options_of(function: Any) -> dict[str, Option]:
    """What a command takes, by the names of its parameters."""
    hints = get_type_hints(function, include_extras=True) | {
        name: one.annotation for name, one in inspect.signature(function, eval_str=True).parameters.items()
    }
    found = {}
    for name, parameter in inspect.signature(function, eval_str=True).parameters.items():
        if get_origin(hints[name]) is not Annotated:
            continue  # the context
        kind, told = get_args(hints[name])[:2]
        # In Annotated the first of an option's words stands where its default stood.
        words = [str(word).split("/")[0] for word in (told.default, *(getattr(told, "param_decls", None) or ()))]
        long = next((word for word in words if word.startswith("--")), "--" + name.replace("_", "-"))
        typed = "" if isinstance(told, typer.models.ArgumentInfo) else long
        inner = {kind, *get_args(kind), *(deep for one in get_args(kind) for deep in get_args(one))}
        plain = next(one for one in (bool, int, float, Path, str) if one in inner)
        found[name] = Option(name, typed, plain, parameter.default is inspect.Parameter.empty)
    return found


def commands_of(program: str, app: typer.Typer, path: tuple[str, ...] = ()) -> Iterator[Command]:
    """The commands of a program, also those in groups."""
    for row in app.registered_commands:
        name = row.name or row.callback.__name__.replace("_", "-")
        yield Command(program, (*path, name), options_of(row.callback))
    for group in app.registered_groups:
        yield from commands_of(program, group.typer_instance, (*path, group.name))


ALL = [command for name, app in PROGRAMS.items() for command in commands_of(name, app)]
ON_A_BUS = [one for one in ALL if one.options.keys() & {"bus", "interface", "channel"}]
# It puts emulated drives on the bus that is named: the only one that may make some.
SERVES = "drive-env serve"

# What an argument or an option is given: by command and name, by name, or by its type.
VALUES: dict[str, str] = {
    "objects": "6041", "name": "6081", "value": "1", "speed": "60 rpm", "motor": "qbl4208", "new": "5",
    "policy": "tracking_two_mass", "environment": "tracking", "device": "tmcm1636", "load": "inertia",
    "drive-env lss bit-rate new": "500000", "file": "state.toml",
    "drive-env parameters backup file": "new.toml", "drive-env frames log file": "new.log",
    "drive-env export eds file": "new.eds", "drive-env export dcf file": "new.dcf",
    "drive-env frames replay file": "frames.log",
    "drive-tune undo file": "before.toml", "other": "state.toml",
    "drive-tune auto agent": "gain_tuning", "drive-tune auto by": "design",
    "dynamics": "soft", "inertia_range": "0.8/4",
    "replay": "move.csv", "out": "new", "drive-env scope out": "new.csv", "drive-env jog out": "new.csv",
    "eds": "own.eds", "config": "config.toml", "journal": "new.journal", "store": "new",
    "position": "1 rev", "drive-env move out": "new.csv", "workspace": "machine.toml",
    "pcap": "new.pcap", "trigger": "6041>0", "by": "1", "drive-env frames replay speed": "2", "max_current": "1 A",
    "identity": "286:1:1:1", "loop": "velocity", "signal": "multisine", "rule": "simc",
    "limit": "current=1 A", "drive-tune commission step": "motor", "drive-tune commission skip": "tune",
    "sampler": "tpe", "objectives": "cost", "gains": "velocity_p", "axes": "apart", "travel": "-1:1",
    "cluster": "tcp://127.0.0.1:1", "against": "emulator", "sensor": "module:function", "listen": "127.0.0.1",
    "token": "12345678", "minari": "drives/tracking-v0", "fault": "encoder_stuck at=2",
}  # fmt: skip
BY_TYPE = {int: "1", float: "0.5"}
INSTEAD = {"by": "duration"}  # an option that stands in another's place
# Options beside which a command has nothing to do with drives: it does that, on no machine.
WITHOUT_DRIVES = {
    ("drive-agent evaluate", "--card"): "environment: ServoDrive/Tracking-v0",  # prints how an agent was trained
    ("drive-env frames replay", "--dry-run"): "1 frames shown",  # prints what is in a file
}


# About the bus or its nodes as a whole; a page has all axes, and one is chosen there.
OF_NO_AXIS = {"drive-env studio"}


def test_every_command_about_the_axes_of_drives_on_a_bus_has_axis():
    about = [one for one in ON_A_BUS if one.program == "drive-env" and {"node", "eds"} <= one.options.keys()]
    assert len(about) > 10
    assert {str(one) for one in about if "axis" not in one.options} == OF_NO_AXIS


def value(command: Command, option: Option) -> str:
    """What is typed for an option."""
    for key in (f"{command} {option.name}", option.name):
        if key in VALUES:
            return VALUES[key]
    assert option.kind in BY_TYPE, f"give {command} {option.name} a row in VALUES"
    return BY_TYPE[option.kind]


def line(command: Command, *named: str, beside: Option | None = None) -> list[str]:
    """The command line: what is required, how the bus is named, what lets a motor turn, and an option beside."""
    given = [*command.path]
    given += [value(command, one) for one in command.options.values() if not one.typed and one.required]
    given += named
    needed = {"yes": ["--yes"], "travel": ["--travel", "-1:1"], "duration": ["--for", "0.1"]}
    if beside is not None:
        needed.pop(INSTEAD.get(beside.name, beside.name), None)
    given += [
        word
        for name, words in needed.items()
        if name in command.options and command.options[name].typed == words[0]
        for word in words
    ]
    if beside is not None:
        given += [word for word in (beside.typed, "" if beside.kind is bool else value(command, beside)) if word]
    return given


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    """A folder with the files that commands read, a bus that nobody has named in the environment, no emulator."""
    monkeypatch.chdir(tmp_path)
    for name in ("INTERFACE", "CHANNEL", "TOKEN", "TIMEOUT"):
        monkeypatch.delenv(f"DRIVE_ENV_{name}", raising=False)
    Path("state.toml").write_text(sealed('[parameters]\n"6081:00" = 1000\n'))
    Path("frames.log").write_text("(1.0) can0 601#4041600000000000\n")
    rows = "".join(f"{k / 1000:.3f},{k}\n" for k in range(20))
    Path("move.csv").write_text("t [s],6064h:00 Position actual value [inc]\n" + rows)
    Path("config.toml").write_text("")
    Snapshot("tmcm1636", ({(0x6081, 0): 1000},), {"interface": "socketcan", "channel": "can0", "nodes": [1]}).save(
        "before.toml"
    )

    # It compiles on an emulated machine before it opens the bus, and takes the task's size from its environment.
    sizes = SimpleNamespace(config=SimpleNamespace(amplitude=1.0, speed=1.0), close=lambda: None)
    monkeypatch.setattr(on_the_bus, "make_environments", lambda *_: sizes)
    monkeypatch.setattr(on_the_bus, "warm_up", lambda *_: None)


class EmulatedError(BaseException):
    """An emulated machine is made; no command takes this for an error of its own."""


def emulated(*_: Any, **__: Any) -> None:
    raise EmulatedError


def run(command: Command, arguments: list[str]) -> Any:
    found = CliRunner().invoke(PROGRAMS[command.program], arguments)
    assert found.exception is None or isinstance(found.exception, SystemExit), (arguments, found.exception)
    return found


def test_these_commands_may_act_on_a_bus():
    """That the programs are read rightly: a command that is lost from this list is looked at by nobody."""
    assert {str(one) for one in ON_A_BUS} >= {
        *(f"drive-env {one}" for one in ("scan", "get", "set", "jog", "scope", "export eds", "serve", "lss node-id")),
        *(f"drive-tune {one}" for one in ("identify", "response", "rules", "auto", "undo")),
        "drive-agent evaluate",
    }
    for one in ON_A_BUS:
        assert {"interface", "channel"} <= one.options.keys(), f"{one} has no name for the whole bus"


def wrong(
    monkeypatch: pytest.MonkeyPatch, rows: Iterable[tuple[Command, list[str], tuple[int, ...], str]]
) -> list[str]:
    """Return which of the command lines make an emulated machine, or end with another exit code or another message."""
    found = []
    for command, arguments, codes, told in rows:
        with monkeypatch.context() as patch:
            if str(command) != SERVES:
                patch.setattr(EmulatedDrives, "__init__", emulated)
            try:
                done = run(command, arguments)
            except EmulatedError:
                found.append(f"{command.program} {' '.join(arguments)}: an emulated machine, though the bus was named")
                continue
        if done.exit_code not in codes or not re.search(told, done.output):
            found.append(f"{command.program} {' '.join(arguments)}: exit code {done.exit_code}, {done.output}")
    return found


@pytest.mark.slow
def test_a_named_channel_or_interface_is_opened_or_refused(monkeypatch):
    rows = []
    for command in ON_A_BUS:
        for named, told in (
            (NAMED, CANNOT_OPEN),
            (("-c", CHANNEL), rf"channel '{CHANNEL}' needs an interface|--channel {CHANNEL} needs --interface"),
            (("-c", "socket://127.0.0.1:1"), "127.0.0.1:1"),
            (("-i", "socketcan"), f"{NO_CHANNEL}|socketcan needs --channel"),
            (("-i", "ethercat-udp", "-c", CHANNEL), f"{CHANNEL}' must be a UDP port|ethercat"),
            (("-i", "ethercat"), "needs a channel|--channel|can0 cannot be opened"),  # can0: of the file of undo
        ):
            # The file of undo names the rest of a bus.
            more = f"|cannot open .*can0|{CANNOT_OPEN}" if str(command) == "drive-tune undo" else ""
            rows.append((command, line(command, *named), (1, 2), told + more))
    found = wrong(monkeypatch, rows)
    assert not found, "\n".join(found)


@pytest.mark.slow
def test_no_other_option_makes_an_emulated_machine_of_a_named_bus(monkeypatch):
    rows = []
    for command in [one for one in ON_A_BUS if str(one) != SERVES]:
        for beside in command.options.values():
            if beside.name in ("interface", "channel") or (beside.required and not beside.typed):
                continue
            alone = WITHOUT_DRIVES.get((str(command), beside.typed))
            codes, told = ((1, 2), r"\A\s*.*\n?.*\s*\Z") if alone is None else ((0,), re.escape(alone))
            rows.append((command, line(command, *NAMED, beside=beside), codes, told))
    assert len(rows) > 200
    found = wrong(monkeypatch, rows)
    assert not found, "\n".join(found)


def test_what_only_a_bus_has_is_never_an_emulated_machines(files_read_here, monkeypatch):
    rows = [
        (command, line(command, *named), (2,), f"{NO_CHANNEL}|{named[0]} is for a bus; give its --channel")
        for command in ON_A_BUS
        for named in (("--bus",), ("--node", "3"), ("--bitrate", "500000"), ("--lockstep",))
        if str(command) != SERVES and named[0] in {option.typed for option in command.options.values()}
    ]
    found = wrong(monkeypatch, rows)
    assert not found, "\n".join(found)


def test_a_bus_in_the_environment_alone_turns_no_motor(monkeypatch):
    monkeypatch.setenv("DRIVE_ENV_INTERFACE", "socketcan")
    monkeypatch.setenv("DRIVE_ENV_CHANNEL", CHANNEL)
    monkeypatch.setattr(EmulatedDrives, "__init__", emulated)
    for command in [one for one in ON_A_BUS if "load" in one.options and str(one) != SERVES]:
        with pytest.raises(EmulatedError):
            run(command, line(command))


def test_the_settings_of_a_search_on_a_bus_are_repeated_on_no_emulated_machine(monkeypatch):
    """A motor turns only if --bus is said again; without it the search is refused, not made elsewhere."""
    monkeypatch.setattr(EmulatedDrives, "__init__", emulated)
    command = next(one for one in ON_A_BUS if str(one) == "drive-tune auto")
    for where in ('channel = "can0"', 'interface = "socketcan"', "nodes = [1]"):
        Path("settings.toml").write_text(f'sampler = "tpe"\n[machine]\ndevice = "tmcm1636"\n{where}\n')
        found = run(command, line(command, "--config", "settings.toml"))
        assert found.exit_code == 2 and "add --bus" in found.output, found.output
