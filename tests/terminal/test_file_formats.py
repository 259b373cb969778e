"""docs/reference/file-formats.md has the fields of files that are really written, no more and no fewer."""

from __future__ import annotations

import csv
import dataclasses
import json
import re
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
from rigs import ROOT
from rigs.scripted_drive import ScriptedBus, ScriptedDrive
from typer.testing import CliRunner

from agents.benchmark.results import Row
from agents.evaluation import episode_log
from agents.evaluation.evaluation import Evaluation
from agents.evaluation.scores import Episode
from agents.policies.agent_file import AgentFile
from agents.shipped import find_agent
from drive_env.bus.config import Bus, Machine
from drive_env.bus.faults import Faults
from drive_env.commands.cli import app as drive_env_app
from drive_env.commands.frames import FORMATS
from drive_env.devices import device_names, find_device
from drive_env.fieldbus.description import describe
from drive_env.master.identity import Identity
from drive_env.motors import MOTORS, NUMBERS, find_motor
from drive_env.randomisation import random_machines as randomisation
from drive_env.studio.workspace import Workspace
from tuning.certificate.certificate import (
    AxisCertificate,
    Certificate,
    Correction,
    FrequencyResponse,
    Requirement,
    StatedParameter,
    StepResponse,
)
from tuning.certificate.certificate_files import certificate_files
from tuning.commands.cli import app
from tuning.runs import inputs
from tuning.snapshot import take
from tuning.target import emulated

PAGE = (ROOT / "docs" / "reference" / "file-formats.md").read_text(encoding="utf-8")
DEVICE = ROOT / "drive_env" / "devices" / "tmcm1636"


def fields(name, kind="keys"):
    """Return the names in backticks in the first column of the table that is marked with a name."""
    after = PAGE.split(f"<!-- {kind}: {name} -->\n", 1)[1].split("\n\n", 1)[0]
    return [found for row in after.splitlines()[2:] for found in re.findall(r"`([^`]+)`", row.split(" | ")[0])]


def run(*arguments):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output


def header(path):
    with path.open(encoding="utf-8", newline="") as file:
        return next(csv.reader(file))


def test_every_table_is_compared_here():
    marked = set(re.findall(r"<!-- (?:keys|files): ([a-z ]+) -->", PAGE))
    compared = set(re.findall(r'(?:fields\(|\(")"?([a-z ]+)"', Path(__file__).read_text(encoding="utf-8")))
    assert marked - {"distributions"} <= compared and "distributions" in marked


# --- tuning -----------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    row = np.linspace(1.0, 2.0, 9)
    axis = AxisCertificate(
        0, True, "", (), {"inertia": StatedParameter(1.0, 0.9, 1.1, "kg*m^2")}, (1,) * 5, (1,) * 5, {}, {},
        (StepResponse("move", True, "rad", row, row, row, row),),
        (FrequencyResponse("velocity loop", True, row, row, row, row),),
        "standard", (Requirement("velocity loop, Ms", 2.0, 1.5, False, "kept"),), {},
        (Correction((1,) * 5, (1,) * 5, "", ""),),
    )  # fmt: skip
    made = Certificate("auto", "tmcm1636", "qbl4208", "belt", 24.0, 0, {}, (axis,), {})
    folder = tmp_path_factory.mktemp("certificate")
    with certificate_files(made, folder):
        pass
    return json.loads((folder / "certificate.json").read_text(encoding="utf-8"))


def test_certificate(certificate):
    assert fields("certificate") == list(certificate)
    (axis,) = certificate["axes"]
    assert fields("certificate axis") == list(axis)
    assert fields("certificate identified") == list(axis["identified"]["inertia"])
    assert fields("certificate step") == list(axis["steps"][0])
    assert fields("certificate requirement") == list(axis["requirements"][0])
    assert fields("certificate correction") == list(axis["corrections"][0])
    assert fields("certificate response") == list(axis["frequency_responses"][0])


@pytest.mark.slow
def test_identification(tmp_path):
    run("identify", "--load", "inertia", "--out", tmp_path / "found.json")
    (axis,) = json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))
    assert fields("identification") == list(axis)
    assert {name for one in axis["estimates"].values() for name in one} == set(fields("certificate identified"))


def test_state_before_a_change(tmp_path):
    with emulated(load="inertia", num_machines=1) as target:
        take(target).save(tmp_path / "before.toml")
    written = tomllib.loads((tmp_path / "before.toml").read_text(encoding="utf-8"))
    of_a_bus = {"bus", "node", "left_out"}
    assert [name for name in fields("snapshot") if name not in of_a_bus] == list(written)
    assert of_a_bus < set(fields("snapshot"))


def test_sweep(tmp_path):
    text = re.sub(r"count = \d+", "count = 2", (ROOT / "tuning" / "runs" / "sweep.toml").read_text(encoding="utf-8"))
    (tmp_path / "small.toml").write_text(text, encoding="utf-8")
    mine = shutil.copy(ROOT / "drive_env" / "motors" / "qbl4208.toml", tmp_path / "mine.toml")
    run("sweep", "--config", tmp_path / "small.toml", "--motor", mine, "--out", tmp_path / "out")
    settings = tomllib.loads((tmp_path / "out" / "settings.toml").read_text(encoding="utf-8"))
    assert fields("sweep settings") == list(settings)
    assert fields("sweep") == list(settings["sweep"][0])
    assert sorted(fields("excitation")) == sorted(settings["excitation"])
    columns = header(tmp_path / "out" / "results.csv")
    assert fields("sweep results") == [name for name in columns if not re.match("[0-9A-F]{4}h:", name)]


@pytest.mark.slow
def test_search(tmp_path):
    mine = shutil.copy(ROOT / "drive_env" / "motors" / "qbl4208.toml", tmp_path / "mine.toml")
    given = ("--motor", mine, "--load", "inertia", "--inertia-range", "0.5/3")
    run("auto", "--by", "tpe", "--trials", 1, *given, "--out", tmp_path / "out")
    settings = tomllib.loads((tmp_path / "out" / "settings.toml").read_text(encoding="utf-8"))
    assert fields("search settings") == list(settings)
    assert fields("trials") == header(tmp_path / "out" / "trials.csv")


def test_inputs():
    assert set(fields("inputs", "files")) == set(inputs._FILES)


def test_comparison(tmp_path):
    run("rank", "-t", "baseline", "--count", 1, "--out", tmp_path / "out")
    assert fields("tuners") == header(tmp_path / "out" / "tuners.csv")


@pytest.mark.slow
def test_response(tmp_path):
    run("response", "--load", "inertia", "--out", tmp_path / "out")
    assert fields("response") == header(tmp_path / "out" / "velocity_axis0.csv")


def test_machines_for_comparisons():
    suite = tomllib.loads((ROOT / "tuning" / "compare" / "suites" / "public.toml").read_text(encoding="utf-8"))
    assert fields("suite") == list(suite)
    found = dict.fromkeys(name for group in suite["group"] for name in group)
    assert sorted(fields("suite group")) == sorted(found)


# --- drives -----------------------------------------------------------------------------------------------------------
def test_backup(tmp_path, monkeypatch):
    drive = ScriptedDrive(values={(0x1018, 4): (4711, 4), (0x6081, 0): (1000, 4)})
    monkeypatch.setattr("drive_env.master.can_drives.open_bus", lambda *_, **__: ScriptedBus(drive))
    monkeypatch.setattr("drive_env.master.can.port.open_bus", lambda *_, **__: ScriptedBus(drive))
    file = tmp_path / "drive.toml"
    result = CliRunner().invoke(drive_env_app, ["parameters", "backup", str(file), "-c", "any", "-i", "virtual"])
    assert result.exit_code == 0, result.output
    written = tomllib.loads(file.read_text(encoding="utf-8"))
    assert fields("backup") == list(written)
    assert set(written["identity"]) < set(fields("identity"))
    assert fields("identity") == [*Identity._fields, "axis"]


def test_bus():
    plain = {field.name for field in dataclasses.fields(Bus)}
    assert set(fields("bus")) == plain
    assert set(fields("bus machine")) == {field.name for field in dataclasses.fields(Machine)}
    assert set(fields("bus faults")) == {field.name for field in dataclasses.fields(Faults)}


def test_motor():
    for name in MOTORS:
        file = ROOT / "drive_env" / "motors" / f"{name}.toml"
        assert set(tomllib.loads(file.read_text(encoding="utf-8"))) <= set(fields("motor"))
    assert fields("motor numbers") == list(NUMBERS)
    for name, row in NUMBERS.items():
        assert f"| `{name}` |" in PAGE and f"| {row.unit or '1'} | {row.meaning} |" in PAGE, name


def block(begin, name, folder):
    """Write the TOML block of the page that begins with a text into a file; return its path."""
    (found,) = (text for text in re.findall(r"```toml\n(.*?)```", PAGE, re.S) if text.startswith(begin))
    (folder / name).write_text(found, encoding="utf-8")
    return folder / name


def test_the_examples_of_the_page_are_taken(tmp_path):
    assert find_motor(block("title = ", "acme.toml", tmp_path)).rated_torque == 0.125
    variant = find_device(str(block("variant_of = ", "small.toml", tmp_path)))
    assert variant.overcurrent == 40.0
    mine = block("include = ", "mine.toml", tmp_path)
    randomisation.Distributions.load(mine)
    mine.write_text(mine.read_text(encoding="utf-8").replace("loguniform", "logarithmic"), encoding="utf-8")
    with pytest.raises(ValueError, match="logarithmic"):
        randomisation.Distributions.load(mine)


def test_device():
    read = [tomllib.loads((DEVICE.parent / name / "device.toml").read_text(encoding="utf-8"))
            for name in device_names() if not find_device(name).variant_of]  # fmt: skip
    read.append(tomllib.loads((DEVICE.parent / "template.toml").read_text(encoding="utf-8")))  # of drives by their EDS
    assert set(fields("device")) == {key for data in read for key in data}
    own = {path.name for path in (ROOT / "tests" / "invented_drive").iterdir() if not path.name.startswith("_")}
    # A device of one's own has its presets, or the rule of any CiA 402 drive; those that ship have a rule of their own.
    assert {name.replace("*", "invented") for name in fields("device", "files")} == own | {"commissioning.toml"}


def test_film():
    shown = CliRunner().invoke(drive_env_app, ["render", "--show-config"]).stdout
    keys = re.findall(r"^(?:# )?(\w+) = ", shown.split("[objects]")[0], re.M)
    assert [name for name in fields("film") if name not in ("objects", "picture")] == keys
    assert {"objects", "picture"} == set(re.findall(r"^\[(\w+)\]", shown, re.M))


def test_recorded_frames():
    rows = re.findall(r"^\| ((?:`\.[a-z]+`(?:, )?)+) \|.*\| reads[^|]* \|$", PAGE, re.M)
    assert sorted(ending for names in rows for ending in re.findall(r"`(\.[a-z]+)`", names)) == sorted(FORMATS)


# --- environments and agents ------------------------------------------------------------------------------------------
def test_distributions():
    rows = {}
    for line in PAGE.split("<!-- keys: distributions -->\n", 1)[1].split("\n\n", 1)[0].splitlines()[2:]:
        laws, needs, may = (re.findall(r"`([^`]+)`", cell) for cell in line.strip("|").split("|"))
        rows |= {law: (tuple(needs), tuple(may)) for law in laws}
    assert rows == {law: (randomisation._KEYS[law], randomisation._OPTIONAL[law]) for law in randomisation.LAWS}


def test_agent():
    with np.load(find_agent("tracking_two_mass")) as stored:
        about = json.loads(bytes(stored["about"]))
        assert set(fields("agent")) == set(about)
        for name in ("weight_0", "bias_0", "observation_mean", "observation_scale", "action_low", "action_high"):
            assert name in stored and f"`{name}`" in PAGE
    assert AgentFile.load(find_agent("tracking_two_mass")).kind in PAGE


def test_report_row_and_episodes(tmp_path):
    episode = Episode(0, np.zeros((3, 2)), np.zeros((2, 1)), np.zeros(2), {}, False, "", {}, {})
    report = Evaluation("p", "e", {}, "emulator", [0], {"return": [1.0]}, {"return": False}, {})
    report.save(tmp_path / "report.json")
    assert set(fields("evaluation report")) == set(json.loads((tmp_path / "report.json").read_text(encoding="utf-8")))
    row = Row("ServoDrive/Crane-v1", "ppo", "trained", 0, "agent.npz", "", [2**33, 2**33], [0.5], 0)
    assert set(fields("benchmark row")) == set(json.loads(row.text()))
    episode_log.save(tmp_path / "episodes.npz", "e", {}, [episode])
    with np.load(tmp_path / "episodes.npz") as stored:
        assert fields("episodes") == list(stored)


def test_workspace_of_the_studio(tmp_path):
    Workspace(describe("tmcm1636", None), tmp_path / "machine.toml").change(0, jog_speed="90 rpm")
    data = tomllib.loads((tmp_path / "machine.toml").read_text(encoding="utf-8"))
    assert list(data) == ["format", "device", "favourites", "units", "axis"]
    assert set(data["axis"]["0"]) == set(fields("workspace"))
