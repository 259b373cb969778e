"""A drive as an FMU: the same integers as the emulator in another process, and a rotor that others' mechanics turn."""

from __future__ import annotations

import csv
import json
import math
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rigs import ROOT
from typer.testing import CliRunner

from drive_env import EmulatedDrives
from drive_env.commands.cli import app
from drive_env.fmu import drive as fmu_drive
from drive_env.fmu import export
from drive_env.fmu.drive import FmuDrive
from drive_env.fmu.export import export_fmu
from drive_env.fmu.slave import DriveSlave, PlainData
from mechanics.loads import LOADS
from mechanics.model import MODELS

MS = 0.001
PP, CSP = 1, 8
INTERNAL_LIMIT, ENABLED = 0x800, 0x27
AT_REST = [592, 0, 0]  # statusword, position, speed
BOTH = ("statusword", "position_demand_value", "position_actual_value", "torque_actual_value")


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


class Used(FmuDrive):
    """The drive of an FMU, used by the names of its variables."""

    def __getitem__(self, name):
        return self.get(self.named(name))

    def named(self, name):
        return next(one for one in self.variables if one.name == name)

    def let(self, size=MS, **values):
        for name, value in values.items():
            self.set(self.named(name), value)
        self.step(size)

    def enable(self, mode, axis=""):
        self.let(**{f"{axis}mode_of_operation": mode})
        for word in (6, 7, 15):
            self.let(**{f"{axis}controlword": word})
        self.let(10 * MS)
        assert self[f"{axis}statusword"] & 0x6F == ENABLED


def run(*command, cwd):
    return subprocess.run(
        [sys.executable, *map(str, command)], cwd=cwd, capture_output=True, text=True, check=True, timeout=300
    ).stdout


@pytest.fixture(scope="module")
def servo(tmp_path_factory):
    pytest.importorskip("fmpy")
    file = tmp_path_factory.mktemp("fmu") / "servo.fmu"
    made = CliRunner().invoke(app, ["export", "fmu", "tmcm1636", "--load", "two_mass", "--out", str(file)])
    assert made.exit_code == 0, made.output
    return file


# --- the file ---------------------------------------------------------------------------------------------------------
def valid(file):
    from fmpy.validation import validate_fmu

    return validate_fmu(str(file))


def test_the_file_is_valid_and_says_what_it_can(servo):
    import fmpy

    assert valid(servo) == []
    about = fmpy.read_model_description(str(servo))
    assert (about.modelName, about.fmiVersion) == ("servo", "3.0")
    assert about.coSimulation.canGetAndSetFMUstate and about.coSimulation.canSerializeFMUstate
    assert float(about.coSimulation.fixedInternalStepSize) == MS
    kinds = {one.name: (one.causality, one.type, one.unit) for one in about.modelVariables}
    assert kinds["controlword"] == ("input", "Int32", None)
    assert kinds["load_torque"] == ("input", "Float64", "N*m")
    assert kinds["rotor_angle"] == ("output", "Float64", "rad")
    assert kinds["'Profile velocity'"] == ("parameter", "Int64", None)  # UNSIGNED32
    assert kinds["'Velocity Mode Settings'.P_Parameter"] == ("parameter", "Int32", None)


@pytest.mark.slow
def test_a_pp_move_and_a_csp_move_have_the_integers_of_the_emulator(servo, tmp_path):
    run(ROOT / "examples/fmu_move.py", servo, "--out", "move", cwd=tmp_path)
    assert (tmp_path / "move.png").stat().st_size > 10_000
    rows = [{k: int(v) for k, v in row.items()} for row in csv.DictReader((tmp_path / "move.csv").open())]
    with EmulatedDrives("tmcm1636", load="two_mass", num_threads=1) as drives:
        drives.write("Profile velocity", 20 * 65_536)
        before = {"mode_of_operation": 0, "controlword": 0}
        for row in rows:
            for name, index in (("mode_of_operation", 0x6060), ("target_position", 0x607A), ("controlword", 0x6040)):
                if row[name] != before.get(name):  # a set-point of csp arrives each time
                    drives.write(index, row[name])
            before = {name: row[name] for name in before}
            drives.advance(MS)
            shown = [int(drives.read(index)[0]) for index in (0x6041, 0x6062, 0x6064, 0x6077)]
            assert shown == [row[name] for name in BOTH]
    pp, csp = (([row for row in rows if row["mode_of_operation"] == mode]) for mode in (PP, CSP))
    assert pp[-1]["position_actual_value"] == pytest.approx(2 * 65_536, abs=300)
    assert max(row["position_actual_value"] for row in csp) > 2.9 * 65_536


@pytest.mark.slow
def test_another_process_saves_states_refuses_wrong_steps_and_goes_on(servo, tmp_path):
    found = json.loads(run(ROOT / "tests/fmu_importer.py", servo, cwd=tmp_path))
    check_of_importer(found)
    assert found["reset"] == [50, 100_000, *AT_REST]
    step, value = found["said"]
    assert step == "0.0015 s is not a whole number of communication cycles of 0.001 s; use 0.002 s"
    assert value.startswith("6060h:00 Modes of operation cannot be 99; its highest is 10")
    assert "fatal" in found["wrong parameter"]
    assert "2043h:01 Position Mode Settings.P_Parameter cannot be -1; its lowest is 0" in found["said of it"][0]


def check_of_importer(found):
    assert found["start"] == [592, 0, 0]
    assert found["onwards"][1] > 20_000, "it moved"
    assert found["from the state"] == found["from its bytes"] == found["onwards"]
    assert "discard" in found["wrong step"] and "discard" in found["wrong input"]
    assert found["after refusals"] == found["onwards"], "nothing changed"
    assert found["goes on"] != found["onwards"]
    assert found["other at rest"] == AT_REST, "an instance of its own"
    assert found["other, from the bytes"] == found["onwards"]
    assert found["first, untouched"] == found["goes on"]


@pytest.mark.slow
def test_fmi_2_does_the_same(servo, tmp_path):
    import fmpy

    old = tmp_path / "servo.fmu"
    export_fmu(old, "tmcm1636", "two_mass", fmi=2)
    assert valid(old) == []
    about = fmpy.read_model_description(str(old))
    assert about.fmiVersion == "2.0" and not about.coSimulation.canBeInstantiatedOnlyOncePerProcess
    old_run, new_run = (json.loads(run(ROOT / "tests/fmu_importer.py", one, cwd=tmp_path)) for one in (old, servo))
    check_of_importer(old_run)
    assert old_run["other, alone"] == old_run["onwards"] and old_run["third at rest"] == AT_REST
    assert [old_run[name] for name in ("onwards", "goes on")] == [new_run[name] for name in ("onwards", "goes on")]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("device", "load", "fmi"),  # each firmware and each kind of load with both versions
    [
        ("tmcm1636", "inertia", 3), ("tmcm1636", "none", 2), ("tmcm3313", "portal", 2), ("tmcm3313", "inertia", 2),
        ("tmcm6212", "gantry", 3), ("tmcm6212", "portal", 3), ("tgz_d", "gantry", 2), ("tgz_d", "none", 3),
    ],
)  # fmt: skip
def test_every_device_builds_and_is_valid(device, load, fmi, tmp_path):
    pytest.importorskip("fmpy")
    export_fmu(tmp_path / "one.fmu", device, load, fmi=fmi)
    assert valid(tmp_path / "one.fmu") == []


@pytest.mark.slow
def test_files_of_ones_own_are_packed(tmp_path, monkeypatch):
    pytest.importorskip("fmpy")
    import fmpy

    own = shutil.copy(MODELS / "inertia.xml", tmp_path / "disc.xml")
    export_fmu(tmp_path / "own.fmu", "tmcm1636", str(own))
    Path(own).unlink()
    resources = Path(fmpy.extract(str(tmp_path / "own.fmu"), tmp_path / "there")) / "resources"
    settings = fmu_drive.read_settings(resources)
    assert settings == {"device": "tmcm1636", "load": str(resources / "disc.xml"), "motor": None}
    assert FmuDrive(**settings).drives.load.name == "disc"
    monkeypatch.setattr("drive_env.__version__", "9.9.9")
    with pytest.raises(ValueError, match=r"made by drive-env .* and this is drive-env 9\.9\.9; install that version"):
        fmu_drive.read_settings(resources)


@pytest.mark.parametrize(("given", "says"), [
    (["--out", "a-b.fmu"], "a-b.fmu must be letters, digits and _, a letter first, then .fmu"),
    (["--out", "a.zip"], "a.zip must be letters, digits and _"),
    (["--fmi", "1", "--out", "a.fmu"], "FMI 1 is not among the versions that can be written: 2, 3"),
    (["--load", "nothing", "--out", "a.fmu"], "no load is named 'nothing'"),
    (["--motor", "nothing", "--out", "a.fmu"], "no motor is named 'nothing'"),
])  # fmt: skip
def test_mistakes_are_refused_and_leave_no_file(given, says, tmp_path, monkeypatch):
    pytest.importorskip("pythonfmu3")
    monkeypatch.chdir(tmp_path)
    answer = CliRunner().invoke(app, ["export", "fmu", *given])
    assert (answer.exit_code, list(tmp_path.iterdir())) == (2, [])
    assert says in " ".join(answer.output.split())


def test_a_missing_library_is_told_with_the_remedy(tmp_path, monkeypatch):
    monkeypatch.setattr(export.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"needs pythonfmu3, which is not installed: pip install 'drive-env\[fmu\]'"):
        export_fmu(tmp_path / "a.fmu", "tmcm1636", "two_mass")


def test_a_state_from_outside_is_data_alone():
    assert DriveSlave._fmu_state_from_bytes(DriveSlave._fmu_state_to_bytes({"x": np.arange(3)}))["x"].tolist() == [
        0,
        1,
        2,
    ]
    with pytest.raises(pickle.UnpicklingError, match=r"the state holds .*system, which is no data"):
        DriveSlave._fmu_state_from_bytes(b"cos\nsystem\n(S'true'\ntR.")
    assert all(module.startswith("numpy") for module, _ in PlainData.KNOWN)


# --- the variables ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("device", "load", "there", "absent"), [
    ("tmcm1636", "two_mass", ["statusword", "load_torque", "load.inertia", "'Profile velocity'"], ["shaft_torque"]),
    slow("tgz_d", "gantry", ["axis1.statusword", "axis1.drive_mode", "load_torque", "supply_voltage"], ["statusword"]),
    ("tgz_d", "none", ["axis1.shaft_torque", "axis0.load.inertia", "supply_voltage"], ["load_torque"]),
    slow("tmcm3313", "portal", ["axis2.left_switch", "axis2.'Profile velocity'"], ["axis3.statusword"]),
    slow("tmcm6212", "inertia", ["axis5.position_demand_value", "axis5.load_torque"], ["axis0.torque_actual_value"]),
    ("tmcm1636", "gantry", ["axis1.statusword", "load_torque"], ["axis2.statusword"]),  # two drives of one axis
])  # fmt: skip
def test_names_tell_the_axis_where_there_are_several(device, load, there, absent):
    names = [one.name for one in FmuDrive(device, load).variables]
    assert set(there) <= set(names) and not set(absent) & set(names)


@pytest.mark.slow
def test_each_axis_has_its_own_inputs():
    drive = Used("tmcm3313", "inertia")
    drive.enable(PP, "axis1.")
    drive.let(**{"axis1.target_position": 20_000, "axis1.controlword": 31, "axis2.supply_voltage": 20.0})
    drive.let(0.3)
    assert abs(drive["axis1.position_actual_value"]) > 10_000
    assert [drive[f"axis{axis}.statusword"] & 0x6F for axis in (0, 2)] == [0x40, 0x40]
    assert drive.drives.machine.supply.tolist() == [24.0, 24.0, 20.0]


def test_a_switch_is_pressed_from_outside_and_let_go():
    drive = Used("tmcm1636", "two_mass")
    drive.enable(PP)
    drive.let(target_position=200_000, controlword=31)
    drive.let(0.05, right_switch=True)
    drive.let(0.3)
    stopped = drive["position_actual_value"]
    assert drive["digital_inputs"] & 0x7 == 2 and drive["statusword"] & INTERNAL_LIMIT
    assert stopped < 150_000
    drive.let(right_switch=False)
    assert drive["digital_inputs"] & 0x7 == 0


def test_a_load_presses_its_own_switches_still():
    drive = Used("tmcm1636", "belt")
    assert drive["digital_inputs"] & 0x7 == 0
    with pytest.raises(ValueError, match=r"axis 0 has no home switch to press: load 'inertia' has none"):
        EmulatedDrives("tmcm1636", "inertia", num_threads=1).machine.press("home", True)
    there = {(one.kind, one.low, one.high) for one in LOADS["belt"].switches}
    assert {(one.kind, one.low, one.high) for one in drive.drives.load.switches} == there


def test_emergencies_are_counted():
    drive = Used("tmcm1636", "two_mass")
    drive.enable(PP)
    assert (drive["emergency_code"], drive["emergency_count"]) == (0, 0)
    drive.let(0.01, enable_input=False)
    assert (drive["emergency_code"], drive["emergency_count"]) == (0x5441, 1)
    drive.let(0.01, enable_input=True, supply_voltage=4.0)
    assert drive["emergency_count"] >= 1


def test_parameters_are_written_as_the_simulation_begins():
    drive = Used("tmcm1636", "two_mass")
    for name, value in {"'Profile velocity'": 123_456, "load.inertia": 2e-5}.items():
        drive.set(drive.named(name), value)
    assert int(drive.drives.read("Profile velocity")[0]) != 123_456
    drive.begin()
    assert int(drive.drives.read("Profile velocity")[0]) == 123_456
    assert drive.drives.machine.parameters["load.inertia"].tolist() == [2e-5]


@pytest.mark.parametrize(("size", "says"), [
    (0.0, "a step of 0 s is shorter than a communication cycle; use 0.001 s or a multiple"),
    (5e-4, "a step of 0.0005 s is shorter than a communication cycle; use 0.001 s or a multiple"),
    (math.nan, "a step of nan s is shorter"),
    (2.5e-3, "0.0025 s is not a whole number of communication cycles of 0.001 s; use 0.002 s"),
])  # fmt: skip
def test_another_step_is_refused_with_value_limit_and_remedy(size, says):
    with pytest.raises(ValueError, match=says):
        Used("tmcm1636", "two_mass").let(size)


def test_a_refused_step_changes_nothing_and_the_next_one_goes_on():
    drive = Used("tmcm1636", "two_mass")
    drive.let(load_torque=0.01)
    before = pickle.dumps(drive.drives.save_state())
    with pytest.raises(ValueError, match="supply voltage must be finite and 0 V or more, not -5 V"):
        drive.let(mode_of_operation=8, load_torque=0.02, supply_voltage=-5.0)
    assert pickle.dumps(drive.drives.save_state()) == before
    drive.let(supply_voltage=48.0)
    assert drive["mode_display"] == 8
    assert drive.drives.machine.load_torque.tolist() == [0.02]


# --- the shaft --------------------------------------------------------------------------------------------------------
def bare():
    """A rotor alone, switched off, without bearing friction and cogging."""
    drive = Used("tmcm1636", "none")
    for name in ("motor.coulomb", "motor.viscous", "motor.cogging_torque"):
        drive.drives.machine.set(name, 0.0)
    return drive, float(drive.drives.machine.parameters["motor.inertia"][0] + drive["load.inertia"])


def test_a_torque_at_the_shaft_turns_the_rotor_by_newtons_law():
    drive, J = bare()
    for k in range(1, 21):
        drive.let(shaft_torque=1e-3)
        assert drive["rotor_speed"] == pytest.approx(1e-3 * k * MS / J, rel=2e-3)
        assert drive["rotor_angle"] == pytest.approx(0.5 * 1e-3 * (k * MS) ** 2 / J, rel=1e-2)


def swing(stiffness, damping):
    """The rotor on a spring and a damper outside, which give their torque once a step; how its swing ends [rad]."""
    drive, _ = bare()
    drive.let(shaft_torque=1e-3)
    angles = []
    for _ in range(120):
        drive.let(shaft_torque=-stiffness * drive["rotor_angle"] - damping * drive["rotor_speed"])
        angles.append(abs(drive["rotor_angle"]))
    return max(angles[-20:]) / max(angles[:20])


def test_a_coupling_is_stable_where_the_page_says():
    """Stable where k h / 2 < c < 2 J / h (docs/how-to/fmu.md)."""
    _, J = bare()
    k = 0.2 * J / MS**2
    assert swing(k, 0.65 * k * MS) < 0.5
    assert swing(k, 0.35 * k * MS) > 2.0
    assert swing(k, 1.9 * J / MS) < 0.1
    assert swing(k, 2.1 * J / MS) > 2.0


def test_mechanics_outside_do_what_those_inside_do():
    """A disc on an elastic shaft of 20 Hz: outside, in steps of 20 us between two exchanges, and as load two_mass."""
    inertia, stiffness, damping = 2e-5, 0.05, 2e-4
    inside, outside = Used("tmcm1636", "two_mass"), Used("tmcm1636", "none")
    values = {
        "inertia": inertia,
        "stiffness": stiffness,
        "damping": damping,
        "coulomb": 0.0,
        "breakaway": 0.0,
        "viscous": 0.0,
    }
    for name, value in values.items():
        inside.drives.machine.set(f"load.{name}", value)
    angle, speed, h = 0.0, 0.0, MS / 50
    for drive in (inside, outside):
        drive.enable(PP)
        drive.set(drive.named("target_position"), 60_000)
        drive.set(drive.named("controlword"), 31)
    apart, way = [], []
    for _ in range(400):
        theta, omega = outside["rotor_angle"], outside["rotor_speed"]
        # What the rotor feels in the step is the torque in its middle, by the speeds as the step begins.
        torque = stiffness * (angle - theta + 0.5 * MS * (speed - omega)) + damping * (speed - omega)
        inside.let()
        outside.let(shaft_torque=torque)
        for _ in range(50):
            speed -= torque / inertia * h
            angle += speed * h
        apart.append(inside["rotor_angle"] - outside["rotor_angle"])
        way.append(inside["rotor_angle"])
    assert max(way) > 5.0
    assert np.abs(apart).max() < 0.02 * max(way)
