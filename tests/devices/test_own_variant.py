"""A power stage of one's own: a variant of a device by a TOML file, and a machine of 540 V and 2.2 kW on it."""

from __future__ import annotations

import math

import pytest

from drive_env import EmulatedDrives, motion
from drive_env.devices import find_device
from drive_env.firmware.record import get_lanes
from drive_env.motors import MOTORS

RPM = 2.0 * math.pi / 60.0
STAGE = """
title = "Servo amplifier, 560 V DC link"
variant_of = "tmcm1636"
[supply]
undervoltage = 200.0
overvoltage = 820.0
[current]
full_scale = 50.0
overcurrent = 45.0
nominal = 12.0
"""
# A servo motor of 2.2 kW at 3000 rpm; class values.
MOTOR = """
title = "Servo motor, 540 V, 2200 W"
kind = "pmsm"
[sources]
class = "values of its class"
[numbers]
resistance_line_to_line_ohm = [2.4, "class"]
inductance_line_to_line_h = [0.018, "class"]
torque_constant_rms = [1.4, "class"]
pole_pairs = [4, "class"]
inertia_kg_m2 = [1.1e-3, "class"]
rated_torque_nm = [7.0, "class"]
rated_speed_rpm = [3000, "class"]
voltage_v = [540.0, "class"]
encoder_counts = [16384, "class"]
"""


@pytest.fixture
def files(tmp_path):
    stage, motor = tmp_path / "stage.toml", tmp_path / "motor.toml"
    stage.write_text(STAGE)
    motor.write_text(MOTOR)
    return str(stage), str(motor)


def test_a_machine_of_540_v_and_2_kw_runs(files):
    stage, motor = files
    with EmulatedDrives(stage, "inertia", motor, parameters={"load.inertia": 2.2e-3}, num_threads=1) as drives:
        assert drives.device.overvoltage == 820.0
        assert drives.machine.supply.tolist() == [540.0]
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, "2500 rpm")
        drives.advance(1.5)
        assert drives.machine.rotor_speed[0] == pytest.approx(2500 * RPM, rel=0.02)
        assert drives.emergencies() == []


@pytest.mark.parametrize(("volts", "present"), [(540.0, True), (150.0, False), (250.0, True)])
def test_its_supply_is_watched_by_its_own_limits(files, volts, present):
    stage, motor = files
    with EmulatedDrives(stage, "inertia", motor, supply=volts, num_threads=1) as drives:
        drives.advance(0.05)
        assert bool(drives.read(0x6041)[0] & 0x10) is present  # bit 4: the supply is there


def test_currents_are_counted_as_its_measuring_range_has_them(tmp_path):
    stage = tmp_path / "stage.toml"
    stage.write_text(
        'title = "Servo stage, 50 A"\nvariant_of = "tmcm1636"\n[current]\nfull_scale = 50.0\novercurrent = 45.0\n'
    )
    device, base = find_device(str(stage)), find_device("tmcm1636")
    assert (device.current_full_scale, base.current_full_scale) == (50.0, 100.0)
    assert device.velocity_rate == base.velocity_rate
    # The same gain is twice the integer in velocity P, and half of it in current P.
    own, known = (one.preset(MOTORS["re_40"]) for one in (device, base))
    assert own["Velocity Mode Settings.P_Parameter"] == pytest.approx(
        2 * known["Velocity Mode Settings.P_Parameter"], abs=1
    )
    assert own["Torque Mode Settings.Torque_P"] == pytest.approx(known["Torque Mode Settings.Torque_P"] / 2, abs=1)


@pytest.mark.every(2)
@pytest.mark.parametrize("base", ["tmcm6212", "tmcm3313"])
def test_a_stepper_stage_of_ones_own_makes_the_current_that_it_has(tmp_path, base):
    """One of 5.5 A, whose bridges detect a short at 12 A: a motor of 2.8 A rms gets its rated amplitude of 4 A."""
    path = tmp_path / "stage.toml"
    path.write_text(
        f'title = "Stepper stage, 5.5 A"\nvariant_of = "{base}"\n'
        "[current]\nfull_scale = 5.5\novercurrent = 12.0\nnominal = 5.5\n"
    )
    device, motor = find_device(str(path)), MOTORS["qsh5718_76"]
    with EmulatedDrives(str(path), "inertia", motor, num_machines=device.num_axes, num_threads=1) as drives:
        motion.enable(drives, mode="pp")
        motion.move_to(drives, 51_200)
        drives.advance(0.01)
        assert (drives.read(0x6041) & 0x6F == 0x27).all()
        run = get_lanes(drives.inside.records, "full_scale_current", device.num_axes)
        steps = (drives.read(0x2003) + 1) // 8
    assert run.tolist() == [5.5] * device.num_axes
    amplitude = 5.5 * steps / 32
    assert (amplitude <= motor.rated_current).all() and (amplitude > motor.rated_current - 5.5 / 32).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("title = ", "is not a TOML file"),
        ('variant_of = "tgz"', "variant_of is 'tgz'; it names the device that differs a little: tgz_d, tmcm1636"),
        ("[supply]\novervoltage = 100.0", "variant_of is 'None'"),
        ('variant_of = "tmcm1636"\n[suply]\novervoltage = 100.0', "suply is nothing that a device has; did you mean"),
        ('variant_of = "tmcm1636"\n[supply]\npeak = 1.0', r"supply.peak is nothing that a device has"),
        ('variant_of = "tmcm1636"\n[supply]\novervoltage = "high"', "overvoltage = 'high' must be a number above 0"),
        ('variant_of = "tmcm1636"\n[supply]\novervoltage = -5.0', "must be a number above 0"),
        ('variant_of = "tmcm1636"\n[supply]\novervoltage = 5.0', "undervoltage = 8 V must lie below"),
        ('variant_of = "tmcm1636"\n[current]\nnominal = 95.0', "must come in this order"),
        (
            'variant_of = "tmcm6212"\n[current]\nfull_scale = 6.0',
            "current.nominal = 1.5 A, full_scale = 6 A and overcurrent = 3.6 A must come in this order: continuous "
            "current, largest current, short detection",
        ),
        ('variant_of = "tmcm1636"\n[rates]\nvelocity = 4000', "each must be a whole multiple of the next"),
        ('variant_of = "tmcm1636"\nsupply = 3', "supply is a table of undervoltage"),
    ],
)
def test_a_file_that_is_no_variant_is_told_with_the_remedy(tmp_path, text, message):
    path = tmp_path / "own.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        find_device(str(path))


def test_a_file_that_is_not_there_is_told(tmp_path):
    with pytest.raises(ValueError, match="cannot be read: No such file"):
        find_device(str(tmp_path / "none.toml"))
