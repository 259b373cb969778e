"""Rows of hybrid steppers: numbers of their data sheets against each other, the pull-out curve, files that are wrong,
and motors that are given to a drive of the other kind."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from rigs import stepper_rig
from typer.testing import CliRunner

from drive_env import EmulatedDrives
from drive_env.commands.cli import app
from drive_env.devices import find_device
from drive_env.motors import MOTORS, RPM, MotorError, find_motor, load_motor, motor_of, motors_of

STEPPERS = motors_of(["stepper"])


@pytest.fixture(params=sorted(STEPPERS))
def motor(request):
    return STEPPERS[request.param]


# --- the rows -----------------------------------------------------------------------------------------------------
def test_there_are_steppers_of_all_sizes():
    sizes = {int(re.search(r"NEMA ([0-9]+)", motor.title)[1]) for motor in STEPPERS.values()}
    assert {11, 17, 23, 34} <= sizes
    assert len(STEPPERS) >= 6


def test_the_title_is_the_makers_name_which_has_length_current_and_torque(motor):
    size, _, current, torque = re.search(r"QSH([0-9]{2})18-([0-9]+)-([0-9]+)-([0-9]+),", motor.title).groups()
    assert motor.name.startswith(f"qsh{size}18_")
    assert motor.rated_current / math.sqrt(2.0) == pytest.approx(int(current) / 10.0, rel=0.05)  # A RMS of a phase
    assert motor.rated_torque == pytest.approx(int(torque) / 100.0)  # N m
    assert motor.kind == "stepper"
    assert find_motor(motor.name) is motor
    assert {"resistance_phase_ohm", "inertia_kg_m2", "holding_torque_nm"} <= set(dict(motor.sources))


def test_four_full_steps_are_a_period_of_the_current(motor):
    assert motor.n_p == 50
    assert motor.cogging_order == 200


def test_the_holding_torque_is_that_of_both_phases_at_their_rated_current(motor):
    """Both at their RMS value are a vector of sqrt(2) times it; what saturation takes is told by the data sheets.

    QSH4218 manual, table 6.1: 125 % of the current is 125 % of the torque, 150 % at most 150 %.
    """
    amplitude = motor.rated_current
    assert stepper_rig.holding_torque(motor, amplitude) == pytest.approx(motor.rated_torque)
    assert stepper_rig.holding_torque(motor, 1.25 * amplitude) == pytest.approx(1.25 * motor.rated_torque, rel=0.03)
    assert 1.35 < stepper_rig.holding_torque(motor, 1.5 * amplitude) / motor.rated_torque <= 1.5
    small = 1e-3 * amplitude
    assert stepper_rig.holding_torque(motor, small) == pytest.approx(motor.torque_constant * small, rel=1e-5)


def test_the_rated_current_warms_the_winding_by_80_k(motor):
    """ "100 % = 2 I^2 R" of the RMS current, hot; data sheets have a rise of at most 80 K."""
    hot = motor.R_s * (1.0 + 0.00393 * 80.0)
    assert hot * motor.rated_current**2 * motor.thermal_resistance == pytest.approx(80.0)
    assert 600.0 <= motor.thermal_time <= 3600.0


def test_up_to_the_rated_speed_the_supply_carries_the_rated_current(motor):
    w, current = motor.n_p * motor.rated_speed, motor.rated_current
    psi = motor.rated_torque / (motor.n_p * current)
    assert math.hypot(motor.R_s * current + w * psi, w * motor.L_q * current) == pytest.approx(motor.voltage)
    assert 4.0 * motor.R_s * current / math.sqrt(2.0) < motor.voltage  # "optimum driver supply voltage", table 6.2


def test_friction_is_small_and_damps_a_swinging_rotor_lightly(motor):
    damping = motor.viscous / (2.0 * math.sqrt(motor.n_p * motor.rated_torque * motor.inertia))
    assert damping == pytest.approx(0.045)
    assert 0.02 <= motor.cogging_torque / motor.rated_torque <= 0.09
    assert motor.coulomb < motor.cogging_torque


@pytest.mark.slow
def test_the_pull_out_curve_is_that_of_ideal_comparators(motor):
    curve = motor.pull_out
    assert curve.supply == motor.voltage
    assert curve.speed[0] < 0.5 * motor.rated_speed and curve.speed[-1] > 1.4 * motor.rated_speed
    for k in (0, 3, 5):
        speed, torque = curve.speed[k], curve.torque[k]
        assert stepper_rig.pull_out(motor, speed, curve.supply, motor.rated_current) == pytest.approx(torque, rel=0.01)
    assert np.all(np.diff(curve.torque) < 0.0)


def test_the_qsh4218_47_gives_at_1200_rpm_what_its_data_sheet_says():
    """ "0.25 Nm torque at 1200 RPM with a 24 V supply": the drag of all rows was chosen by it."""
    curve = MOTORS["qsh4218_47"].pull_out
    assert np.interp(1200 * RPM, curve.speed, curve.torque) == pytest.approx(0.25, rel=0.05)


# --- files --------------------------------------------------------------------------------------------------------
OWN = {"resistance_phase_ohm": 1.0, "inductance_phase_h": 2e-3, "full_steps": 200, "holding_torque_nm": 1.0,
       "inertia_kg_m2": 2.5e-5, "voltage_v": 24.0, "rated_current_rms_a": 2.0}  # fmt: skip
CURVE = {"source": "sheet", "supply_v": 24.0, "speed_rpm": [100, 300], "torque_nm": [0.9, 0.5]}


def tables(numbers, **other):
    rows = {name: [value, "sheet"] for name, value in numbers.items()}
    return {"title": "Own", "kind": "stepper", "sources": {"sheet": "data sheet, rev. 3"}, "numbers": rows} | other


def test_a_stepper_of_ones_own_needs_seven_numbers():
    motor = motor_of("own", tables(OWN))
    assert (motor.R_s, motor.L_d, motor.L_q, motor.n_p, motor.encoder_counts) == (1.0, 2e-3, 2e-3, 50, 0)
    assert motor.rated_current == pytest.approx(2.0 * math.sqrt(2.0))
    assert motor.pull_out is None
    curve = motor_of("own", tables(OWN, pull_out=CURVE)).pull_out
    assert curve.speed == pytest.approx((100 * RPM, 300 * RPM))
    fine = motor_of("own", tables(OWN | {"full_steps": 400}))
    assert fine.n_p == 100
    assert fine.psi_m == pytest.approx(0.5 * motor.psi_m)


@pytest.mark.parametrize(
    ("change", "other", "message"),
    [
        ({"full_steps": None}, {}, "full_steps is missing"),
        ({"rated_current_rms_a": None}, {}, "rated_current_peak_a or rated_current_rms_a is missing"),
        ({"full_steps": 198}, {}, "full_steps = 198 must be a multiple of 4"),
        ({"pole_pairs": 50}, {}, "pole_pairs: not of a stepper, which has resistance_phase_ohm"),
        ({"torque_saturation": 0.8}, {}, r"torque_saturation = 0.8 1 must be at least 0 and at most 0.5"),
        ({"voltage_v": 2.0}, {}, "voltage_v = 2 V does not even drive 2.82843 A through 1 ohm"),
        ({}, {"pull_out": CURVE | {"supply_v": None}}, "pull_out: None is not a number of 0 or more"),
        ({}, {"pull_out": {"source": "sheet"}}, "pull_out has source, speed_rpm, supply_v, torque_nm, all of them"),
        ({}, {"pull_out": CURVE | {"source": "x"}}, "pull_out: there is no source 'x'"),
        ({}, {"pull_out": CURVE | {"speed_rpm": [300, 100]}}, "pull_out: speed_rpm must increase"),
        ({}, {"pull_out": CURVE | {"torque_nm": [1.0]}}, "lists of the same length"),
        ({}, {"kind": "pmsm"}, "pole_pairs is missing"),
    ],
)
def test_a_wrong_file_is_told_with_the_remedy(change, other, message):
    numbers = {name: value for name, value in (OWN | change).items() if value is not None}
    with pytest.raises(MotorError, match=message):
        motor_of("own", tables(numbers, **other))


def test_numbers_of_a_stepper_are_none_of_another_motor():
    given = {"resistance_phase_ohm": 0.2, "inductance_phase_h": 5e-4, "torque_constant_peak": 0.06, "pole_pairs": 4,
             "inertia_kg_m2": 3e-5, "rated_torque_nm": 0.6, "rated_speed_rpm": 3000, "voltage_v": 48.0,
             "encoder_counts": 8000}  # fmt: skip
    with pytest.raises(MotorError, match="detent_torque_nm: only a stepper has it"):
        motor_of("own", tables(given | {"detent_torque_nm": 0.1}, kind="pmsm"))
    with pytest.raises(MotorError, match="pull_out: only a stepper falls out of step"):
        motor_of("own", tables(given, kind="pmsm", pull_out=CURVE))


def test_the_command_writes_a_stepper(tmp_path):
    path = tmp_path / "own.toml"
    given = [word for name, value in OWN.items() for word in ("--number", f"{name}={value!r}")]
    done = CliRunner().invoke(app, ["motor", "new", str(path), "--kind", "stepper", "--source", "sheet 3", *given])
    assert done.exit_code == 0, done.output
    assert "holding torque 1 N*m, detent torque 0.05 N*m" in done.output
    assert "24 V carry the rated current up to " in done.output
    assert "drives that turn it: tmcm3313, tmcm6212\n" in done.output
    assert load_motor(path).rated_torque == 1.0


def test_the_command_asks_for_what_a_stepper_needs(tmp_path):
    line = ["motor", "new", str(tmp_path / "own.toml"), "--kind", "stepper", "--source", "x", "-n", "full_steps=200"]
    done = CliRunner().invoke(app, line)
    assert done.exit_code == 2
    assert "resistance_phase_ohm is missing; give it with --number" in done.output


# --- each kind to its own drives ----------------------------------------------------------------------------------
def test_a_servo_drive_offers_no_stepper_and_a_stepper_drive_nothing_else():
    servo, stepper = find_device("tmcm1636").motors, find_device(stepper_rig.BARE).motors
    mains = find_device("tgz_d").motors
    assert set(servo) | set(stepper) | set(mains) == set(MOTORS)
    assert set(mains) == {"am3033_e", "am3041_e"} and not set(mains) & set(servo)
    assert set(stepper) == set(STEPPERS)
    offered = CliRunner().invoke(app, ["parameters", "commission", "?"]).output.split()
    assert offered == list(servo)
    listed = CliRunner().invoke(app, ["list", "motors"]).output
    assert "two-phase stepper, NEMA 17" in listed


@pytest.mark.parametrize(
    ("device", "motor", "message"),
    [
        ("tmcm1636", "qsh4218_51", "turns brushless and brushed motors; qsh4218_51 is a two-phase hybrid stepper"),
        (stepper_rig.BARE, "qbl4208", "turns two-phase hybrid stepper motors; qbl4208 is a brushless motor: take qsh2"),
    ],
)
def test_a_motor_of_the_other_kind_is_refused_with_the_remedy(device, motor, message):
    with pytest.raises(ValueError, match=message):
        EmulatedDrives(device, "inertia", motor)
    with pytest.raises(ValueError, match=message):
        find_device(device).preset(MOTORS[motor])


def test_drives_have_a_motor_of_their_kind_unless_one_is_named():
    for device, kind in ((stepper_rig.BARE, "stepper"), ("tmcm1636", "pmsm")):
        with EmulatedDrives(device, "inertia") as drives:
            assert drives.motor.kind == kind
