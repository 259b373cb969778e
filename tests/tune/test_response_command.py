"""`drive-tune response` as a user meets it."""

import csv
import json

import pytest
from typer.testing import CliRunner

from tuning.commands.cli import app


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("response")
    return folder, in_process("--load", "inertia", "--high", "200", "--out", str(folder / "out"))


@pytest.mark.slow
def test_it_prints_margins_plant_and_drive_time(run):
    folder, done = run
    assert done.exit_code == 0, done.stderr
    assert all(word in done.stdout for word in ("margin", "[deg]", "crossover"))
    assert "axis 0: total inertia " in done.stdout
    assert "no resonance between 5 and" in done.stdout
    assert f"s of drive time; written to {folder / 'out'}" in done.stdout


@pytest.mark.slow
def test_it_writes_a_picture_and_a_table(run):
    folder, _ = run
    assert (folder / "out/velocity_axis0.png").stat().st_size > 20_000
    rows = list(csv.DictReader((folder / "out/velocity_axis0.csv").open(encoding="utf-8")))
    assert [float(row["frequency [Hz]"]) for row in rows] == [5.0 * k for k in range(1, 41)]
    assert {row["source"] for row in rows} == {"bus"}
    for row in rows:
        assert (float(row["coherence"]) >= 0.95) == (row["trusted"] == "1")


def in_process(*arguments):
    return CliRunner().invoke(app, ["response", *arguments])


def test_json_is_for_programs():
    done = in_process("position", "--load", "inertia", "--json")
    assert done.exit_code == 0, done.stderr
    (axis,) = json.loads(done.stdout)
    assert axis["loop"] == "position"
    assert 50.0 < axis["margins"]["phase_deg"] < 95.0
    assert axis["drive_time_s"] < 2.5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("current",), "no loop is named 'current'; there are velocity, position"),
        (("--high", "450"), "highest frequency 450 Hz must be at most 400 Hz"),
        (("--signal", "steps"), "no excitation is named 'steps'; there are multisine, chirp"),
        (("--load", "nothing"), "no load is named 'nothing'"),
    ],
)
def test_a_mistake_is_one_line_and_code_2(arguments, message):
    done = in_process(*arguments)
    assert done.exit_code == 2
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


@pytest.mark.slow
def test_a_folder_with_results_is_not_written_over(run):
    folder, _ = run
    done = in_process("--out", str(folder / "out"))
    assert done.exit_code == 2
    assert "not empty" in done.stderr
