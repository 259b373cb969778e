"""`drive-tune` as a user meets it: its help, its results, and what it says to mistakes."""

import csv
import io
import os
import signal
import subprocess
import sys
import time
import tomllib

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from rigs import ROOT
from typer.testing import CliRunner

from tuning.commands.cli import app
from tuning.compare.comparison import Comparison, MachineRow, TunerRow
from tuning.compare.comparison_picture import BROKEN, draw
from tuning.runs.experiment import DEFAULT

SMALL = (
    DEFAULT.read_text(encoding="utf-8")
    .replace("count = 32", "count = 4")
    .replace("load_time = 0.2 ", "load_time = 0.1 ")
    .replace("duration = 0.4", "duration = 0.2")
)


def drive_tune(*arguments, cwd, **environment):
    return subprocess.run(
        [sys.executable, "-m", "tuning.commands.cli", *map(str, arguments)],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "100", "NO_COLOR": "1"} | environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.fixture
def said(tmp_path, monkeypatch):
    """What drive-tune says in this process, in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: CliRunner(env={"COLUMNS": "100", "NO_COLOR": "1"}).invoke(app, arguments)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A small sweep: where it ran and what it printed."""
    folder = tmp_path_factory.mktemp("tune")
    (folder / "small.toml").write_text(SMALL, encoding="utf-8")
    done = drive_tune("sweep", "--config", "small.toml", "--out", "out/run", cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder, done


def rows(path):
    return list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"))))


@pytest.mark.slow
def test_a_sweep_prints_the_best_ten_and_how_fast_it_was(run):
    folder, done = run
    best = sorted(rows(folder / "out/run/results.csv"), key=lambda row: int(row["rank"]))[:10]
    table = [line.split() for line in done.stdout.splitlines() if line.split() and line.split()[0].isdigit()]
    usable = [row for row in best if row["score [s]"] != "inf"]
    assert [line[:3] for line in table[: len(usable)]] == [
        [row["rank"], row["2042h:01"], row["2042h:02"]] for row in usable
    ]
    assert len(usable) == 10
    assert "x real time" in done.stdout
    assert "of 16 points are usable" in done.stdout
    assert "written to out/run: results.csv, heatmap.png, best_response.png, settings.toml" in done.stdout
    assert done.stderr == ""


@pytest.mark.slow
def test_a_sweep_leaves_four_files_and_nothing_else(run):
    folder, _ = run
    assert sorted(path.name for path in (folder / "out/run").iterdir()) == [
        "best_response.png", "heatmap.png", "results.csv", "settings.toml",
    ]  # fmt: skip
    assert [path.name for path in (folder / "out").iterdir()] == ["run"]


@pytest.mark.slow
def test_other_versions_are_told(run):
    folder, _ = run
    settings = (folder / "out/run/settings.toml").read_text(encoding="utf-8")
    numpy = f'"numpy" = "{np.__version__}"'
    assert numpy in settings
    (folder / "old.toml").write_text(settings.replace(numpy, '"numpy" = "0.9"').replace("count = 4", "count = 1"))
    done = drive_tune("sweep", "--config", "old.toml", "--out", "old", cwd=folder)
    assert f"note: the run was made with numpy 0.9, this is {np.__version__}" in done.stdout.replace("\n", " ")


@pytest.mark.slow
def test_without_out_results_go_to_a_folder_named_after_the_time(run):
    folder, _ = run
    (folder / "one.toml").write_text(SMALL.replace("count = 4", "count = 1"), encoding="utf-8")
    done = drive_tune("sweep", "--config", "one.toml", "--seed", "5", "--load", "inertia", cwd=folder)
    assert done.returncode == 0, done.stderr
    (made,) = (folder / "runs").iterdir()
    assert made.name.endswith("-sweep")
    settings = tomllib.loads((made / "settings.toml").read_text(encoding="utf-8"))
    assert (settings["seed"], settings["load"], settings["motor"]) == (5, "inertia", "qbl4208")


def test_help_names_the_options(said):
    done = said("--help")
    assert done.exit_code == 0
    for command in ("identify", "response", "rules", "auto", "sweep", "rank", "verify", "undo"):
        assert f"│ {command} " in done.stdout
    options = said("sweep", "--help").stdout
    for option in ("--config", "--device", "--motor", "--load", "--seed", "--out", "--show-config", "--list",
                   "--workers", "--cluster", "--resume"):  # fmt: skip
        assert option in options


def test_help_imports_nothing_heavy(tmp_path):
    heavy = {"numba", "mujoco", "matplotlib", "canopen", "scipy", "optuna", "torch", "distributed"}
    code = f"import sys, tuning.commands.cli; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.slow
def test_list_names_what_there_is(said):
    done = said("sweep", "--list")
    assert done.exit_code == 0
    for name in ("tmcm1636", "qbl4208", "ec_i_40", "two_mass", "inertia", "2042h:01", "2043h:01", "tracking [s]",
                 "iae [rpm*s]", "settling [s]", "ripple [A]"):  # fmt: skip
        assert name in done.stdout, name
    assert "2042h:03" not in done.stdout


@pytest.mark.slow
def test_show_config_prints_the_experiment_with_its_comments_and_reads_back(tmp_path):
    done = drive_tune("sweep", "--show-config", cwd=tmp_path)
    assert done.stdout == DEFAULT.read_text(encoding="utf-8")
    assert "# N*m on the load" in done.stdout
    (tmp_path / "mine.toml").write_text(done.stdout, encoding="utf-8")
    again = drive_tune("sweep", "--config", "mine.toml", "--show-config", cwd=tmp_path)
    assert again.stdout == done.stdout
    changed = drive_tune("sweep", "--config", "mine.toml", "--motor", "ec_i_40", "--show-config", cwd=tmp_path)
    expected = tomllib.loads(done.stdout) | {"motor": "ec_i_40"}
    assert tomllib.loads(changed.stdout) == expected


@pytest.mark.every(2)
@pytest.mark.parametrize(("arguments", "message"), [
    (["swep"], "No such command"),
    (["sweep", "--grid", "3"], "No such option"),
    (["identify", "--eds", "vendor.eds"], "an EDS says neither which objects are gains nor in what units"),
    (["auto", "--eds", "vendor.eds", "--node", "1", "--travel", "free"], "give --device FOLDER"),
    (["response", "--eds", "vendor.eds"], "give --device FOLDER"),
    (["auto", "--by", "tpe", "--eds", "vendor.eds"], "give --device FOLDER"),
    (["rules", "--eds", "vendor.eds"], "give --device FOLDER"),
    (["sweep", "--seed", "x"], "--seed"),
    (["sweep", "extra"], "unexpected extra argument"),
    (["sweep", "--config", "none.toml"], "drive-tune: cannot read the experiment none.toml: No such file"),
    (["sweep", "--motor", "abc"], "drive-tune: no motor is named 'abc'; there are am3033_e, am3041_e"),
    (["sweep", "--seed", "-1"], "drive-tune: seed = -1 lies outside"),
    (["sweep", "--out", "full"], "drive-tune: the folder full is not empty; choose another --out or remove it"),
])  # fmt: skip
def test_a_mistake_ends_with_code_2_and_a_line_that_helps(said, tmp_path, arguments, message):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    done = said(*arguments)
    assert done.exit_code == 2 and isinstance(done.exception, SystemExit)
    assert message in done.stderr
    assert "Traceback" not in done.stderr + done.stdout
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "full"]


@pytest.mark.slow
def test_a_grid_without_a_usable_pair_says_so(tmp_path):
    text = SMALL.replace("low = 60\n", "low = 4000\n").replace("count = 4", "count = 1")
    (tmp_path / "wild.toml").write_text(text, encoding="utf-8")
    done = drive_tune("sweep", "--config", "wild.toml", "--out", "run", cwd=tmp_path)
    assert done.returncode == 0
    assert "0 of 1 points are usable; 1 oscillate" in done.stdout
    assert "choose other ranges" in done.stdout
    assert rows(tmp_path / "run/results.csv")[0]["score [s]"] == "inf"


@pytest.mark.slow
def test_a_sweep_that_leaves_the_loads_travel_names_the_excitation(tmp_path):
    text = DEFAULT.read_text(encoding="utf-8").replace("count = 32", "count = 1").replace("low = 60\n", "low = 1000\n")
    (tmp_path / "long.toml").write_text(text, encoding="utf-8")
    done = drive_tune("sweep", "--config", "long.toml", "--load", "belt", "--out", "run", cwd=tmp_path)
    assert done.returncode == 0
    assert "1 end in fault" in done.stdout
    assert "lower velocity_rpm or duration" in " ".join(done.stdout.split())


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_an_interrupt_ends_with_code_130_and_writes_nothing(tmp_path):
    # Minutes; and not one of its shards is done after seconds, which would be kept (test_scale.py).
    text = DEFAULT.read_text(encoding="utf-8").replace("duration = 0.4", "duration = 40.0")
    (tmp_path / "long.toml").write_text(text, encoding="utf-8")
    process = subprocess.Popen(
        [sys.executable, "-m", "tuning.commands.cli", "sweep", "--config", "long.toml", "--out", "run"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    while not (tmp_path / "run.unfinished").exists():  # the run has begun
        assert process.poll() is None
        time.sleep(0.01)
    time.sleep(1.0)  # while it simulates, or while it compiles
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert errors.strip() == "drive-tune: interrupted; nothing was written"
    assert [path.name for path in tmp_path.iterdir()] == ["long.toml"]


@pytest.mark.slow
def test_a_travel_that_is_too_short_is_told_in_turns_with_its_remedy(tmp_path):
    done = drive_tune("auto", "--load", "inertia", "--travel=-0.01:0.01", "--out", "run", cwd=tmp_path)
    assert done.returncode == 1
    assert (
        "axis 0 was not tuned: the travel is too short: 0.13 rad (0.02 turns), and 0.2 rad (0.032 turns) are needed; "
        "allow more with --travel"
    ) in done.stdout
    assert "rejected" not in done.stdout


def test_the_picture_of_a_comparison_names_its_colour_and_has_what_keeps_the_constraints_at_its_tuner(
    tmp_path, monkeypatch
):
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, **options: figures.append(figure))
    rows = [
        MachineRow(tuner, f"machine {k}", J, J, 1.0, J, slack, 46.0, 9.0, 1.9, True, True, False, 2.0, 3, 0, 0, "",
                   False, {"torque_p": 1}, "")
        for tuner, relative, slack in (("auto", (1.1, 1.2, 1.3), 0.1), ("modulus", (0.9, 1.0, 1.4), -0.1))
        for k, J in enumerate(relative)
    ]  # fmt: skip
    tuners = [
        TunerRow(name, 3, 1.2, 1.3, kept, 1.0, 46.0, 46.0, 9.0, 1.9, 1.9, 1.0, 0.0, 2.0, 3, 0, 0, 0)
        for name, kept in (("auto", 1.0), ("modulus", 0.0))
    ]
    draw(Comparison(tuple(rows), tuple(tuners)), tmp_path / "comparison.png")
    score, phase, *_ = figures[0].axes
    assert [label.get_text() for label in score.get_yticklabels()] == [
        "modulus, 0 % keep them",
        "auto, 100 % keep them",
    ]
    assert not score.texts  # which would stand beside the next panel
    assert "orange: breaks a constraint" in score.get_title()
    assert "phase margin" in phase.get_xlabel()
    broken = [
        points.get_offsets() for points in score.collections if tuple(points.get_facecolor()[0][:3]) == to_rgb(BROKEN)
    ]
    assert [len(points) for points in broken if len(points)] == [3]  # those of the tuner that breaks them
    red, green, blue = to_rgb(BROKEN)
    assert red > green > blue  # orange


def test_a_foreign_package_in_the_way_is_named(tmp_path):
    (tmp_path / "other" / "mechanics").mkdir(parents=True)
    (tmp_path / "other" / "mechanics" / "__init__.py").touch()
    code = "import sys; sys.path.insert(0, 'other'); from drive_env import programs; programs.drive_tune()"
    done = subprocess.run(
        [sys.executable, "-c", code, "sweep"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert f"foreign package 'mechanics' at {tmp_path / 'other' / 'mechanics'}" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_the_example_runs(tmp_path):
    done = subprocess.run(
        [sys.executable, str(ROOT / "examples" / "gain_sweep.py"), "--points", "4", "--out", "run"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "2042h:01 = " in done.stdout
    assert (tmp_path / "run" / "results.csv").exists()
