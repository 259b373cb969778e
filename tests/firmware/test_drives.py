"""The Drives interface, on emulated drives."""

import subprocess
import sys

import numpy as np
import pytest
from rigs import ROOT

from drive_env import EmulatedDrives, ObjectAccessError, motion
from drive_env.dictionary.roles import Role
from tuning.snapshot import load_snapshot


def test_drives_come_up_commissioned_in_switch_on_disabled(axis):
    assert axis.read("Statusword")[0] & 0x4F == 0x40
    assert axis.read("Motor Type")[0] == 3
    assert axis.read("Limit switches")[0] == 3  # the load has none
    assert axis.read((0x2042, 1))[0] == 445
    assert axis.emergencies() == []


def test_time_passes_in_whole_communication_cycles(axis):
    axis.advance(0.0)
    with pytest.raises(ValueError, match=r"0\.0015 s is not a whole number of communication cycles of 0\.001 s"):
        axis.advance(0.0015)
    with pytest.raises(ValueError, match=r"12345\.6785 s is not .*; use 12345\.678 s"):
        axis.advance(12345.6785)
    with pytest.raises(ValueError, match="not a whole number"):
        axis.advance(-0.001)
    with pytest.raises(ValueError, match="period must be at least"):
        axis.record([0x6064], 0.01, period=0.0)


def test_record_samples_at_the_start_of_each_cycle(running):
    now = running.read("Position actual value")
    trace = running.record(["Position actual value", 0x606C, (0x2042, 1)], 0.05)
    assert trace.t.shape == (50,)
    assert trace.t[1] == 0.001
    assert trace["position actual VALUE"].shape == (50, 1)
    assert trace[0x6064][0] == now
    assert np.all(np.diff(trace[0x6064][:, 0]) > 0)
    assert np.all(trace[0x2042, 1] == 445)
    with pytest.raises(KeyError, match="6077h:00 Torque actual value was not recorded; there are 6064h"):
        trace[0x6077]


def test_record_can_sample_slower(running):
    trace = running.record([0x6064], 0.022, period=0.005)
    assert list(trace.t) == pytest.approx([0.0, 0.005, 0.010, 0.015, 0.020])


def test_load_torque_disturbs_and_the_loop_recovers(running):
    rpm = 60.0 / 65536.0
    running.machine.load_torque = -0.05
    trace = running.record([0x606C, 0x6077], 0.4)
    speed = trace[0x606C][:, 0] * rpm
    assert speed.min() < 970.0
    assert speed[-50:].mean() == pytest.approx(1000.0, abs=3.0)
    torque_constant = 0.125 / 3.5
    friction = 1.5e-3 + 2e-3  # bearings of motor and load
    assert trace[0x6077][-50:].mean() * 1e-3 == pytest.approx((0.05 + friction) / torque_constant, rel=0.05)


def test_unknown_names_list_what_there_is():
    for options, message in (
        ({"device": "acme"}, "no device is named 'acme'; there are tgz_d, tgz_d_2026"),
        ({"load": "acme"}, "no load is named 'acme'; there are arm, ball_screw, belt, cart_pendulum"),
        ({"motor": "acme"}, "no motor is named 'acme'; there are am3033_e, am3041_e"),
        ({"num_machines": 0}, "num_machines must be 1 or more, not 0"),
        ({"randomise": ["mass"]}, "nothing to randomise is named 'mass'; there are load, motor, stage"),
        ({"parameters": {"load.mass": 1.0}}, "machines have no parameter 'load.mass'"),
        ({"device": "tmcm1637"}, "did you mean 'tmcm1636'"),
        ({"load": "two_mas"}, "did you mean 'two_mass'"),
        ({"motor": "qbl4207"}, "did you mean 'qbl4208'"),
        ({"randomise": ["loads"]}, "did you mean 'load'"),
        ({"parameters": {"load.stifness": 1.0}}, "did you mean 'load.stiffness'"),
    ):
        with pytest.raises(ValueError, match=message):
            EmulatedDrives(**options)


@pytest.mark.parametrize("volts", [-1.0, float("nan"), float("inf")])
def test_a_supply_that_cannot_be_is_refused_when_it_is_given_and_when_it_is_set(axis, volts):
    message = f"supply voltage must be finite and 0 V or more, not {volts:g} V"
    with pytest.raises(ValueError, match=message):
        EmulatedDrives(supply=volts)
    with pytest.raises(ValueError, match=message):
        axis.machine.supply = volts
    assert axis.machine.supply == 24.0


@pytest.mark.parametrize("one", ["Statusword", 0x6041, (0x6041, 0)])
def test_one_object_may_be_recorded_by_its_name_alone(axis, one):
    trace = axis.record([one] if isinstance(one, tuple) else one, 0.003)
    assert trace["Statusword"].shape == (3, 1)
    assert (trace[0x6041] == axis.read(0x6041)).all()


def test_importing_the_package_loads_neither_compiler_nor_physics_nor_a_bus():
    heavy = ("numba", "mujoco", "matplotlib", "can", "canopen")
    code = f"import sys, drive_env; print([m for m in {heavy} if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


@pytest.mark.slow
def test_the_example_of_one_drive_runs():
    script = ROOT / "examples" / "one_drive.py"
    done = subprocess.run([sys.executable, script, "--machines", "2"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "positions reached [inc]: [" in done.stdout


@pytest.mark.slow
def test_the_example_that_tunes_a_drive_runs_and_leaves_the_way_back(tmp_path):
    script = ROOT / "examples" / "tune_a_drive.py"
    assert len(script.read_text(encoding="utf-8").splitlines()) < 40
    run = [sys.executable, script, "--load", "inertia"]
    done = subprocess.run(run, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert load_snapshot(tmp_path / "before.toml").axes[0][0x2042, 1] == 445  # the commissioning preset's
    assert "velocity_p=" in done.stdout and "velocity_p=445" not in done.stdout
    moved = int(done.stdout.split("moved by [inc]: [")[1].split("]")[0])
    assert moved == pytest.approx(32_768, rel=0.03)  # the first millisecond is not in it


def test_outputs_are_those_that_the_mask_lets_through(axis):
    """2703h (table 98): bits 16 to 19 are GPO0 to GPO3."""
    axis.write((0x2703, 1), 0x000F0000)
    assert axis.machine.outputs[0] == 0
    axis.write((0x2703, 2), 0x00050000)
    assert axis.machine.outputs[0] == 0b0101
    axis.write((0x2703, 1), 0x00040000)
    assert axis.machine.outputs[0] == 0b0100


def test_analog_inputs_read_what_is_applied(axis):
    axis.machine.analog_inputs = [[1234], [4095]]
    assert axis.read((0x270E, 1))[0] == 1234
    assert axis.read((0x270E, 2))[0] == 4095
    with pytest.raises(ObjectAccessError, match="cannot be 4096; its highest is 4095"):
        axis.machine.analog_inputs = 4096


def test_a_turning_axis_is_taken_over_at_its_speed(running):
    motion.disable(running)
    running.advance(0.01)
    speed = int(running.read(0x606C)[0])
    motion.enable(running, mode="pv")
    running.write(0x60FF, speed)
    trace = running.record([0x606C], 0.05)
    assert speed > 500_000
    assert trace[0x606C].min() > 0.8 * speed


def test_positions_wrap_like_a_counter_and_the_axis_turns_on(running):
    near_the_end = 2**31 - 100_000
    shift = (near_the_end - int(running.read(0x6064)[0])) * 2 * np.pi / 65536
    running.inside.records["home_shift"] -= shift
    for field in ("position_demand", "theta_meas"):
        running.inside.records[field] += shift
    trace = running.record([0x6064], 0.5)
    assert trace[0x6064][0, 0] > 2**31 - 120_000
    assert trace[0x6064][-1, 0] < -(2**31) + 600_000
    assert running.emergencies() == []
    motion.select_mode(running, "pp")
    running.advance(0.5)
    here = int(running.read(0x6064)[0])
    motion.move_to(running, here + 100_000)
    assert abs(int(running.read(0x6064)[0]) - here - 100_000) < 300


def test_enable_resumes_from_a_quick_stop_that_stays(running):
    running.write(0x605A, 6)
    motion.quick_stop(running)
    running.advance(0.5)
    assert running.read(0x6041)[0] & 0x6F == 0x07
    motion.enable(running)
    assert running.read(0x6041)[0] & 0x6F == 0x27


@pytest.mark.parametrize("name", ["tmcm1636", "tmcm6212", "tmcm3313"])
def test_enable_right_after_a_quick_stop_waits_for_what_follows_its_ramp(name):
    """605Ah: 2 goes on to switch on disabled by itself, 6 stays in quick stop active; both are enabled then."""
    with EmulatedDrives(name, "inertia", num_machines=2, num_threads=1) as drives:
        turn = drives.read(Role.POSITION_SCALE)
        drives.write(0x605A, [2, 6])
        drives.write(0x6085, 10 * turn)
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, 2 * turn)
        drives.advance(1.0)
        motion.quick_stop(drives)
        assert np.all(drives.read(0x6041) & 0x6F == 0x07)
        motion.enable(drives)
        assert np.all(drives.read(0x6041) & 0x6F == 0x27)
