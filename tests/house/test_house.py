"""The house of docs/architecture.md, as far as a program can look: imports one way, no circles, one name per class."""

from __future__ import annotations

import ast
import importlib
import re
from collections import defaultdict
from functools import cache
from pathlib import Path

import pytest
from sources import ROOT, nodes_of

PACKAGES = ("mechanics", "drive_env", "tuning", "agents", "research")
# The rooms from below to above: a file imports from its own room and those before it, for types alone, too. A room is a
# folder of `drive_env`, `tuning` or `agents`, or a file beside these. The rest of `mechanics` is one, and `research`.
ROOMS = (
    "mechanics.kernels", "mechanics.reading", "mechanics",
    "drive_env.cia402", "drive_env.cores", "drive_env.default_device", "drive_env.held_signals",
    "drive_env.realtime_section",
    "drive_env.saved_state", "drive_env.whole_file", "drive_env.own_packages", "drive_env.programs",
    "drive_env.dictionary", "drive_env.motors", "drive_env.firmware", "drive_env.devices", "drive_env.phase_current",
    "drive_env.fieldbus", "drive_env.drives", "drive_env.faults", "drive_env.emulator", "drive_env.node",
    "drive_env.canopen", "drive_env.bus", "drive_env.ethercat", "drive_env.safety", "drive_env.master",
    "drive_env.loops", "drive_env.randomisation", "drive_env.trials", "drive_env.pictures", "drive_env.envs",
    "drive_env", "drive_env.fmu", "drive_env.studio", "drive_env.commands",
    "tuning", "tuning.bootstrap", "tuning.estimate", "tuning.fallback_gains", "tuning.lateness",
    "tuning.linked_axes", "tuning.move_counter", "tuning.oscillation_watch", "tuning.stop_causes", "tuning.toml_tables",
    "tuning.runs", "tuning.target", "tuning.drive_audit", "tuning.link_energy", "tuning.outcome", "tuning.rules",
    "tuning.response", "tuning.identify", "tuning.certificate", "tuning.snapshot", "tuning.auto", "tuning.search",
    "tuning.compare", "tuning.stepper", "tuning.rehearsal",
    "tuning.auto_to_files", "tuning.commissioning", "tuning.way_back", "tuning.commands", "tuning.studio",
    "agents", "agents.plain", "agents.seeds", "agents.shipped", "agents.tasks", "agents.policies", "agents.training",
    "agents.tuner", "agents.evaluation", "agents.benchmark", "agents.hyperparameter_search", "agents.commands",
    "agents.studio",
    "research",
)  # fmt: skip
MOST_LINES, MOST_ARGUMENTS = 60, 10
# What was longer when the rule came; a row goes when its function is split, none is added. A command is measured by its
# body alone: its arguments are its options, which are its manual.
LONG = {
    "drive_env/firmware/servo/power_stage.py power_stage",
    "drive_env/firmware/servo/power_stage.py refresh_winding", "mechanics/packed.py _new_plant",
    "mechanics/stepping.py drive", "mechanics/stepping.py report",
}  # fmt: skip
MANY = {
    "drive_env/emulator/emulated_drives.py __init__", "drive_env/master/can_drives.py __init__",
    "mechanics/friction.py bristle_torque", "mechanics/packed.py __init__",
}  # fmt: skip


@cache
def modules() -> dict[str, list[ast.AST]]:
    """The nodes of every module of ours by its dotted name."""
    found = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
            found[name] = nodes_of(path.read_text(encoding="utf-8"))
    return found


@cache
def imported_by(module: str) -> set[str]:
    """What a module imports: in its functions, and where types alone are checked, too."""
    names: set[str] = set()
    for node in modules()[module]:
        if isinstance(node, ast.ImportFrom):
            assert node.module and not node.level, "imports here name their package"
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                names.add(whole if whole in modules() else node.module)
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return names & modules().keys()


def room_of(name: str) -> str:
    """The room of a module."""
    room = ".".join(name.split(".")[:2])
    return room if room in ROOMS else name.partition(".")[0]


def test_no_module_imports_itself_through_others():
    imports = {name: imported_by(name) - {name} for name in modules()}
    circles, below = [], {}

    def depth(name: str, above: tuple[str, ...]) -> int:
        if name in above:
            circles.append(" -> ".join((*above[above.index(name) :], name)))
            return 0
        if name not in below:
            below[name] = 1 + max((depth(one, (*above, name)) for one in sorted(imports[name])), default=0)
        return below[name]

    for name in imports:
        depth(name, ())
    assert not circles
    assert max(below.values()) > 5  # there was something to see


def test_rooms_import_from_those_below():
    assert {room_of(name) for name in modules()} == set(ROOMS), "every room has its place in ROOMS, and nothing else"
    floors = {room: floor for floor, room in enumerate(ROOMS)}
    arrows = [(name, other) for name in modules() for other in imported_by(name)]
    assert len(arrows) > 1000  # there was something to see
    up = [f"{a} -> {b}" for a, b in arrows if floors[room_of(b)] > floors[room_of(a)]]
    assert not up, "move what both need to the lower room, or let that own a protocol"


def test_a_class_has_its_name_alone():
    homes = defaultdict(list)
    for name, nodes in modules().items():
        for node in nodes:
            if isinstance(node, ast.ClassDef):
                homes[node.name].append(name)
    assert {name: where for name, where in homes.items() if len(where) > 1} == {}


# Calls that read a file, or make something of what was read, without a limit. All go through
# mechanics/reading/; what else may read, and why it meets nothing that somebody else wrote.
READERS = {
    "tomllib.load", "tomllib.loads", "json.load", "json.loads", "yaml.load", "yaml.safe_load", "pickle.load",
    "pickle.loads", "np.load", "np.fromfile", "np.loadtxt", "np.genfromtxt", "zipfile.ZipFile", "zipfile.is_zipfile",
    "csv.reader", "csv.DictReader", "can.LogReader", "canopen.import_od", "ET.parse", "ET.fromstring",
    "read_text", "read_bytes", "open", "from_file", "from_string", "from_xml_path", "from_xml_string",
    "from_binary_path", "InferenceSession", "torch.load",
}  # fmt: skip
MAY_READ = {
    "mechanics.reading.untrusted": "the readers themselves",
    "mechanics.model": "MuJoCo: ours here, those of others in mechanics/reading/limited_child.py",
    "mechanics.reading.limited_child": "what its parent asks, /proc",
    "drive_env.pictures.scene": "MuJoCo: what mechanics/model.py has let pass",
    "mechanics.kernels.compiled": "sources of ours",
    "tuning.runs.provenance": "sources of ours",
    "mechanics.kernels.kernel_files": "the cache of kernels, in a folder of the user's own; pickles, as Numba's are",
    "drive_env.cores": "/proc and /sys",
    "drive_env.whole_file": "the text that is about to be written",
    "drive_env.devices.new_device": "the template of ours",
    "drive_env.dictionary.entries": "the text of a file that was read within limits; EdsText.read_text",
    "agents.training.checkpoint": "pickles of a writer who is trusted (--trust)",
    "agents.training.hyperparameters": "YAML of a text that was read within limits",
    "agents.hyperparameter_search": "files that were written a moment ago, in a folder of its own",
    "agents.training.training_table": "CSV of a text that was read within limits",
    "agents.training.learning_curve": "CSV of a text that was read within limits",
    "agents.policies.onnx_policy": "a file that has been read, and acted within limits in limited_child.py",
    "drive_env.commands.recorded_frames": "in mechanics/reading/limited_child.py",
    "tuning.runs.shard_log": "frame by frame, each with its length",
    "tuning.runs.pools": "pickles of the user's own workers, as SECURITY.md says",
}


def readers_in(nodes: list[ast.AST]) -> set[str]:
    """The calls of a module that are in READERS; a file that is opened to be written is none."""
    found = set()
    for node in nodes:
        if not isinstance(node, ast.Call):
            continue
        names = ast.unparse(node.func).split(".")
        whole = ".".join(names[-2:])
        plain = names[-1] if len(names) > 1 else whole  # of a method, which object it is of does not matter
        modes = [one.value for one in node.args if isinstance(one, ast.Constant) and isinstance(one.value, str)]
        if plain == "open" and (any(set(mode) & set("wax") for mode in modes) or not (modes or node.keywords)):
            continue  # written; or a method of that name that opens something else
        if plain == "open" and any(one.arg == "is_bootstrap" for one in node.keywords):
            continue  # a mailbox
        if plain in ("read_text", "read_bytes") and len(names) == 1:
            continue  # ours
        found |= {whole, plain} & READERS
    return found


def test_what_is_read_goes_through_the_readers_with_limits():
    found = {name: calls for name, nodes in modules().items() if (calls := readers_in(nodes))}
    ours = {name: calls for name, calls in found.items() if not name.startswith("research.")}
    assert {name: calls for name, calls in ours.items() if name not in MAY_READ} == {}, (
        "read it by mechanics/reading/untrusted.py, or say in MAY_READ why nobody else's file can be there"
    )
    assert set(MAY_READ) <= set(ours), "reads nothing now: take it from the list"


@cache
def commands() -> set[str]:
    """The functions that are commands of our programs, by file and name."""
    found = set()
    for name in modules():
        if name.endswith(".commands.cli"):
            waiting = [importlib.import_module(name).app]
            while waiting:
                app = waiting.pop()
                waiting += [group.typer_instance for group in app.registered_groups]
                own = [row.callback for row in app.registered_commands]
                found |= {f"{function.__module__.replace('.', '/')}.py {function.__name__}" for function in own}
    return found


@pytest.mark.parametrize(("measure", "most", "known"), [
    ("lines", MOST_LINES, LONG), ("arguments", MOST_ARGUMENTS, MANY),
])  # fmt: skip
def test_functions_are_short(measure, most, known):
    found, seen = set(), set()
    for name, nodes in modules().items():
        folder = ROOT / Path(*name.split("."))
        path = (folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")).relative_to(ROOT)
        for node in nodes:
            if isinstance(node, ast.FunctionDef):
                function = f"{path.as_posix()} {node.name}"
                seen.add(function)
                if size(node, is_command=function in commands())[measure] > most:
                    found.add(function)
    assert commands() <= seen and len(commands()) > 20
    assert found <= known, f"of more than {most} {measure}: split them"
    assert known <= found, "short now: take them from the list"


def size(node: ast.FunctionDef, is_command: bool) -> dict[str, int]:
    """A function's lines without its docstring, and its arguments without self; a command's without its options."""
    first, given = node.body[0], node.args
    docstring = first.end_lineno - first.lineno + 1 if ast.get_docstring(node, clean=False) else 0
    if is_command:
        return {"lines": node.end_lineno - first.lineno + 1 - docstring, "arguments": 0}
    names = [one.arg for one in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    return {
        "lines": node.end_lineno - node.lineno + 1 - docstring,
        "arguments": len(names) - (names[:1] in (["self"], ["cls"])),
    }


def test_no_test_imports_a_test():
    """What tests share is in `tests/rigs/`; programs as text count, too."""
    found = {}
    for path in sorted((ROOT / "tests").rglob("*.py")):
        names = re.findall(r"^\s*(?:from|import) (test_\w+|conftest)\b", path.read_text(encoding="utf-8"), re.MULTILINE)
        found |= {path.name: names} if names else {}
    assert found == {}
