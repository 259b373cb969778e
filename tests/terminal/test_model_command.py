"""The command `drive-env model` with a log: what it says of it, what it fits, and how it ends."""

from __future__ import annotations

import json

import numpy as np
import pytest
from rigs.recorded_moves import CURRENT, POSITION, TARGET, TORQUE, TRUTH, VELOCITY, a_move, machines, recorded, written
from typer.testing import CliRunner

from drive_env import motion
from drive_env.commands.cli import app
from drive_env.commands.model import _print
from drive_env.randomisation.random_machines import Distributions
from drive_env.trials.replay import Log, LogDifference

DONE, USER_ERROR = 0, 2


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A log of a machine that is not the nominal one, as `drive-env scope` writes it."""
    path = tmp_path_factory.mktemp("logs") / "scope.csv"
    written(path, recorded([TARGET, POSITION, VELOCITY, CURRENT], "csp", {TARGET: a_move()}))
    return path


def run(log, *arguments, load="two_mass"):
    result = CliRunner().invoke(app, ["model", load, "--log", *(str(argument) for argument in (log, *arguments))])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.stdout, result.stderr


def test_it_tells_how_far_every_response_lies_from_the_log(log):
    code, out, err = run(log)
    assert (code, err) == (DONE, "")
    lines = out.splitlines()
    assert [line.split(":")[0] for line in lines] == ["6064h", "606Ch", "6077h"]
    assert all("% of its range (RMS)" in line for line in lines)
    code, out, _ = run(log, "--json")
    told = json.loads(out)["differences"]
    shares = {name[:5]: row["nrmse"] for name, row in told.items()}
    assert shares["6077h"] > 0.1 > shares["6064h"]  # what moves another inertia is another current


def test_a_fit_finds_the_machine_and_writes_laws_that_environments_take(log, tmp_path):
    out = tmp_path / "fitted.toml"
    fitted = [part for name in TRUTH for part in ("--fit", name)]
    code, text, _ = run(log, *fitted, "--machines", 32, "--out", out)
    assert code == DONE and f"distributions written to {out}" in text
    best = {line.split(":")[0]: float(line.split("best ")[1].split(",")[0]) for line in text.splitlines()[4:6]}
    for name, value in TRUTH.items():
        assert best[name] == pytest.approx(value, rel=0.2)
    laws = Distributions.load(out).laws
    prior = Distributions.load("two_mass").laws
    assert laws["motor.R_s"] == prior["motor.R_s"]
    assert all(laws[name] != prior[name] for name in TRUTH)


def test_what_can_be_fitted_is_listed(log):
    code, text, _ = run(log, "--fit", "?")
    assert code == 0 and text.startswith("two_mass has ") and "load.inertia" in text and "load.stiffness" in text
    code, text, _ = run(log, "--fit", "?", "--json")
    names = json.loads(text)["parameters"]
    assert code == 0 and "load.stiffness" in names and "load" not in names
    code, _, error = run(log, "--fit", "load.inertai")
    assert code == 2 and "did you mean 'load.inertia'" in error


def test_a_fit_as_json(log):
    code, text, _ = run(log, "--fit", "load.inertia", "--machines", 16, "--rounds", 1, "--json")
    told = json.loads(text)["fit"]
    assert code == DONE
    row = told["parameters"]["load.inertia"]
    assert row["low"] <= row["best"] <= row["high"] and told["best"] < told["nominal"] and told["file"] is None
    assert row["seen"]


def test_the_settings_of_the_real_drive_count(tmp_path):
    """As `drive-env parameters backup` writes them: gains of its own."""
    real = machines(seed=77)
    real.write((0x2043, 1), 250)
    real.write((0x2042, 1), 900)
    motion.enable(real, "csp")
    trace = real.record([TARGET, POSITION], 0.4, play={TARGET: a_move()})
    written(tmp_path / "log.csv", Log(trace.t, {name: trace[name] for name in (TARGET, POSITION)}))
    settings = tmp_path / "drive.toml"
    settings.write_text('[parameters]\n"2043:01" = 250\n"2042:01" = 900\n')

    def off(*options):
        return json.loads(run(tmp_path / "log.csv", "--json", *options)[1])["differences"]

    without, given = (next(iter(found.values()))["nrmse"] for found in (off(), off("--settings", settings)))
    assert given < 1e-3 and without > 0.02


@pytest.mark.parametrize(("shift", "says"), [(0.0042, "4.2 ms late"), (-0.0011, "1.1 ms early"), (0.00001, "in time")])
def test_late_and_early_are_told(capsys, shift, says):
    with machines() as drives:
        dictionary = drives.device.new_dictionary()
    row = LogDifference(*(np.array([value]) for value in (0.123, shift, 0.0456)))
    _print({POSITION: row}, dictionary, None, None)
    assert capsys.readouterr().out == (
        "6064h:00 Position actual value: deviation 12.30 % of its range (RMS); " + says + ", 4.56 % with the shift "
        "removed\n"
    )


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--joint", "motor"], "--joint motor is for a proposal; leave it out, or --log"),
        (["--motor", "big"], "qbl4208"),
        (["--fit", "load.weight"], "'load.weight' cannot be fitted"),
        (["--fit", "load.inertia", "--machines", "4"], "--machines 4 is too few for a fit; give 16 or more"),
        (["--fit", "load.inertia", "--distributions", "sand"], "no set of distributions is named 'sand'"),
        (["--out", "laws.toml"], "name the parameters to fit with --fit"),
        (["--fit", "load.inertia", "--out", "nowhere/laws.toml"], "the folder nowhere does not exist"),
        (["--fit", "load.inertia", "--rounds", "0"], "--rounds 0 must be 1 or more"),
        (["--settings", "none.toml"], "there is no file none.toml"),
    ],
)
def test_a_mistake_is_one_line(log, options, says):
    code, out, err = run(log, *options)
    assert (code, out) == (USER_ERROR, "")
    assert says in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("load", "says"),
    [
        ("crane", "no load is named 'crane'; there are arm"),
        ("gantry", "the log is of 1 axes, a machine of load 'gantry' has 2"),
    ],
)
def test_a_load_that_does_not_fit_the_log_is_one_line(log, load, says):
    code, out, err = run(log, load=load)
    assert (code, out) == (USER_ERROR, "")
    assert says in err and err.count("\n") == 1


def test_a_log_that_is_none(tmp_path):
    assert "there is no log" in run(tmp_path / "nothing.csv")[2]
    written(tmp_path / "still.csv", Log(np.arange(20) * 1e-3, {POSITION: np.zeros((20, 1), int)}))
    code, _, err = run(tmp_path / "still.csv")
    assert code == USER_ERROR and "has no command" in err
    assert f"{TORQUE[0]:04X}h" in err
