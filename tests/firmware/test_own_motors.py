"""Motors of one's own: a TOML from a data sheet, in whatever form it has its numbers; a Motor; the command."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from typer.testing import CliRunner

from drive_env import EmulatedDrives, motion
from drive_env.commands.cli import app
from drive_env.devices import find_device
from drive_env.motors import MOTORS, NUMBERS, MotorError, find_motor, load_motor, motor_of

RPM = 2.0 * math.pi / 60.0
# A motor of 0.2 ohm and 0.5 mH a phase, 0.06 N m per A peak, in every form that data sheets have.
REST = {"pole_pairs": 4, "inertia_kg_m2": 3e-5, "rated_torque_nm": 0.6, "rated_speed_rpm": 3000, "voltage_v": 48.0,
        "encoder_counts": 8000}  # fmt: skip
PSI = 0.06 / (1.5 * 4)
FORMS = [
    {"resistance_phase_ohm": 0.2, "inductance_phase_h": 5e-4, "torque_constant_peak": 0.06},
    {"resistance_line_to_line_ohm": 0.4, "inductance_line_to_line_h": 1e-3, "torque_constant_rms": 0.06 * math.sqrt(2)},
    # k_t of block commutation: peak phase current flows through two phases, k_t = sqrt(3) n_p psi_m.
    {"resistance_phase_ohm": 0.2, "inductance_phase_h": 5e-4, "torque_constant_line_to_line": math.sqrt(3) * 4 * PSI},
    # Between two terminals sqrt(3) n_p psi_m omega.
    {"resistance_phase_ohm": 0.2, "inductance_phase_h": 5e-4,
     "back_emf_line_peak_v_per_krpm": math.sqrt(3) * 4 * PSI * 1000 * RPM},
    {"resistance_phase_ohm": 0.2, "inductance_phase_h": 5e-4,
     "back_emf_line_rms_v_per_krpm": math.sqrt(1.5) * 4 * PSI * 1000 * RPM},
    {"resistance_phase_ohm": 0.2, "inductance_phase_h": 5e-4, "rated_current_peak_a": 10.0},
    {"resistance_phase_ohm": 0.2, "inductance_phase_h": 5e-4, "rated_current_rms_a": 10.0 / math.sqrt(2)},
]  # fmt: skip


def tables(numbers, **other):
    rows = {name: [value, "sheet"] for name, value in numbers.items()}
    return {"title": "Own, 48 V", "kind": "pmsm", "sources": {"sheet": "data sheet, rev. 3"}, "numbers": rows} | other


@pytest.mark.parametrize("form", FORMS, ids=[" ".join(form) for form in FORMS])
def test_every_form_of_a_data_sheet_is_the_same_motor(form):
    motor = motor_of("own", tables(REST | form))
    assert (motor.R_s, motor.L_q) == pytest.approx((0.2, 5e-4))
    assert motor.psi_m == pytest.approx(PSI)
    assert motor.torque_constant == pytest.approx(0.06)
    assert motor.rated_current == pytest.approx(10.0)
    assert motor.rated_speed == pytest.approx(3000 * RPM)


DC = {"resistance_ohm": 1.2, "inductance_h": 3.4e-4, "torque_constant": 0.0389}


def test_a_brushed_motor_has_one_winding():
    rest = {name: value for name, value in REST.items() if name != "pole_pairs"}
    motor = motor_of("own", tables(rest | DC, kind="dc"))
    assert (motor.R_s, motor.L_q, motor.psi_m, motor.n_p) == (1.2, 3.4e-4, 0.0389, 1)
    assert motor.rated_current == pytest.approx(0.6 / 0.0389)
    assert motor.cogging_torque == 0.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"inertia_kg_m2": None}, "inertia_kg_m2 is missing"),
        ({"inertia_kg_m2": 0.0}, r"inertia_kg_m2 = 0.0 kg\*m\^2 must be above 0 \(inertia of the rotor\)"),
        ({"inertia_kg_m2": math.nan}, "inertia_kg_m2 = nan is not a number"),
        ({"inertia_kg_m2": "much"}, "inertia_kg_m2 = 'much' is not a number"),
        ({"pole_pairs": 3.5}, "pole_pairs = 3.5 must be a whole number"),
        ({"pole_pairs": 500}, "pole_pairs = 500  must be at least 1 and at most 127"),
        ({"inertia": 1e-5}, "'inertia' is not a number of a motor; did you mean 'inertia_kg_m2'"),
        (
            {"resistance_line_to_line_ohm": 0.4},
            "resistance_phase_ohm and resistance_line_.* are two forms of the same number",
        ),
        ({"torque_constant_rms": 0.1}, "torque_constant_peak and torque_constant_rms are two forms of the same number"),
        ({"torque_constant_peak": None}, "torque_constant_peak or .* is missing, or the rated current"),
        ({"resistance_ohm": 0.4, "resistance_phase_ohm": None}, "resistance_ohm: of a brushless motor say"),
    ],
)
def test_a_wrong_number_is_told_with_the_remedy(change, message):
    numbers = REST | FORMS[0] | change
    numbers = {name: value for name, value in numbers.items() if value is not None}
    with pytest.raises(MotorError, match=message):
        motor_of("own", tables(numbers))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "linear"}, r"kind is 'linear'; it is one of 'pmsm' \(brushless\)"),
        ({"sources": {}}, "there is no source 'sheet'; describe it under"),
        ({"numbers": {"voltage_v": 48.0}}, r"voltage_v = 48.0: write the number and where it comes from"),
        ({"poles": 8}, "'poles' is not a key of a motor"),
        ({"numbers": 3}, "sources and numbers are tables"),
    ],
)
def test_a_file_of_another_shape_is_told(change, message):
    with pytest.raises(MotorError, match=message):
        motor_of("own", tables(REST | FORMS[0]) | change)


def test_files_that_are_none_are_told(tmp_path):
    with pytest.raises(MotorError, match="cannot be read: No such file"):
        find_motor(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("title = ")
    with pytest.raises(MotorError, match="is not a TOML file"):
        find_motor(str(tmp_path / "bad.toml"))
    with pytest.raises(ValueError, match=r"no motor is named 'qbl'.*or give the path of a motor's .toml file"):
        find_motor("qbl")


def new(*words):
    return CliRunner().invoke(app, ["motor", "new", *words])


def options(numbers):
    return [word for name, value in numbers.items() for word in ("--number", f"{name}={value!r}")]


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "own.toml"
    done = new(str(path), "--kind", "pmsm", "--source", "data sheet, rev. 3", *options(REST | FORMS[1]))
    assert done.exit_code == 0, done.output
    assert "torque constant 0.06 N*m/A" in done.output
    return path


def test_the_command_writes_a_file_that_is_the_motor(file):
    motor = load_motor(file)
    assert motor.name == "own"
    assert dict(motor.sources)["inertia_kg_m2"] == "data sheet, rev. 3"
    assert motor.torque_constant == pytest.approx(0.06)


@pytest.mark.parametrize("how", ["path", "text", "Motor"])
def test_drives_turn_it_commissioned_by_the_devices_rule(file, how):
    motor = {"path": file, "text": str(file), "Motor": load_motor(file)}[how]
    with EmulatedDrives(motor=motor, load="inertia", parameters={"load.inertia": 6e-5}, num_threads=1) as drives:
        assert drives.read("Maximum Current").tolist() == [20_000]
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, "1000 rpm")
        drives.advance(0.5)
        assert drives.machine.rotor_speed[0] == pytest.approx(1000 * RPM, rel=0.03)


def test_a_motor_that_no_drive_of_ours_can_turn_is_told(tmp_path):
    weak = REST | FORMS[0] | {"inductance_phase_h": 10.0}
    done = new(str(tmp_path / "weak.toml"), "--kind", "pmsm", "--source", "made up", "--unchecked", *options(weak))
    assert done.exit_code == 0
    assert "tmcm1636 cannot turn it: torque P would be" in done.output


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["own.txt", "--kind", "pmsm"], "must end with .toml"),
        (["own.toml", "--kind", "pmsm", "-n", "inertia_kg_m2=much"], "is not a number; write it as 4.8e-6"),
        (["own.toml", "--kind", "pmsm", "-n", "mass=1"], "'mass' is not a number of a motor.*--list shows them"),
        (["own.toml", "--kind", "pmsm", "--source", "x"], "resistance_.* is missing; give it with --number"),
        (
            ["own.toml", "--kind", "pmsm", "--source", "x", *options({**FORMS[0], "pole_pairs": 4})],
            "inertia_kg_m2 is missing; .* take that of a motor of the same size",
        ),
        (["own.toml"], "kind of motor, pmsm .* is missing; give it as an option"),
        ([], "name the file to write: drive-env motor new my_motor.toml"),
    ],
)
def test_a_mistake_of_the_command_line_is_one_line_and_writes_nothing(tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    done = new(*words)
    assert done.exit_code == 2, done.output
    assert len(done.output.strip().splitlines()) == 1
    assert re.search(message, done.output)
    assert not list(tmp_path.iterdir())


def test_a_file_that_is_there_is_not_replaced(file):
    before = file.read_text()
    done = new(str(file), "--kind", "pmsm", "--source", "x", *options(REST | FORMS[0]))
    assert done.exit_code == 2
    assert file.read_text() == before


def test_at_a_terminal_what_is_not_given_is_asked_for(tmp_path, monkeypatch):
    monkeypatch.setattr("drive_env.commands.motor._is_answered", lambda: True)
    answers = ["pmsm", "2", "0.4", "2", "0.001", "1", "0.06", "4", "3e-5", "0.6", "3000", "48", "8000", "sheet"]
    done = CliRunner().invoke(app, ["motor", "new", str(tmp_path / "asked.toml")], input="\n".join(answers) + "\n")
    assert done.exit_code == 0, done.output
    motor = load_motor(tmp_path / "asked.toml")
    assert (motor.R_s, motor.L_q, motor.torque_constant) == pytest.approx((0.2, 5e-4, 0.06))


@pytest.mark.parametrize("words", [["--list"], ["x.toml", "--list"]])
def test_every_number_is_listed_with_its_unit(words):
    done = new(*words)
    assert done.exit_code == 0
    for name, row in NUMBERS.items():
        assert f"{name}: {row.meaning}" in done.output


def test_a_motor_of_the_catalogue_that_is_changed_takes_the_rules_preset():
    device, own = find_device("tmcm1636"), MOTORS["qbl4208"]._replace(rated_torque=0.1)
    assert device.preset(own) != device.preset(MOTORS["qbl4208"])


@pytest.mark.slow
def test_auto_and_the_agent_tune_a_motor_of_ones_own(file, tmp_path):
    """Both look for gains on machines with the motor itself, not one of the catalogue with its name."""
    from tuning.commands.cli import app as tune

    own = ["--motor", str(file), "--load", "inertia"]
    done = CliRunner().invoke(tune, ["auto", *own, "--out", str(tmp_path / "auto")])
    assert done.exit_code in (0, 1), done.output  # accepted, or rejected by a check
    assert (tmp_path / "auto" / "certificate.json").exists()
    done = CliRunner().invoke(tune, ["auto", "--by", "agent", *own, "--trials", "1", "--out", str(tmp_path / "agent")])
    assert done.exit_code in (0, 1), done.output
    assert (tmp_path / "agent" / "certificate.json").exists()


def test_an_environment_takes_a_motor_itself(file):
    from drive_env.envs.gain_tuning import GainTuning

    motor = load_motor(file)
    for given in (motor, str(file)):
        envs = GainTuning(2, load="inertia", motor=given, distributions={"parameters": {}}, num_threads=1)
        assert envs.motor._replace(name="", sources=()) == motor._replace(name="", sources=())
        assert np.isfinite(envs.reset(seed=0)[0]).all()
        envs.close()
