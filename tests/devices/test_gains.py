"""Raw gains from bandwidths: the integers of the table that the gain scale was derived with, and the way back."""

from __future__ import annotations

import math

import pytest
from rigs.chip_gains import Gains, bandwidths_from_gains, chip_gains

from drive_env.devices import find_device
from drive_env.motors import MOTORS

DEVICE = find_device("tmcm1636")


def table_motor(R, L, K_t, J, n_p, voltage):
    """Return a motor with a torque constant K_t per ampere of peak i_q."""
    return MOTORS["qbl4208"]._replace(R_s=R, L_d=L, L_q=L, psi_m=K_t / (1.5 * n_p), n_p=n_p, inertia=J, voltage=voltage)


# The table uses .0315 N m as torque per PEAK ampere for the EC-i 40; the catalogue's .0315 is line to line, and the
# row of drive_env/motors/ has 0.866 of it. The table's integers belong to the motor as the table has it; its
# resistance, .404 ohm in print, is .807/2.
W20 = table_motor(2.2, 0.45e-3, 0.022, 0.9e-6, 4, 24.0)
EC_I_40 = table_motor(0.4035, 0.322e-3, 0.0315, 2.42e-6, 7, 36.0)
W750 = table_motor(0.05, 0.1e-3, 0.11, 1.2e-4, 4, 48.0)


def gains_of(motor, **bandwidths):
    wanted = {"current_hz": 1000.0, "velocity_hz": 50.0, "position_hz": 10.0, **bandwidths}
    return chip_gains(DEVICE, motor, 3.0 * motor.inertia, **wanted)


@pytest.mark.parametrize(("motor", "P", "I"), [(W20, 3015, 12815), (EC_I_40, 1438, 3284), (W750, 335, 1310)])
def test_torque_gains_at_1_khz_are_those_of_the_table(motor, P, I):
    gains = gains_of(motor)
    # The table cuts fractions off and uses 2.62 for 2.62144.
    assert abs(gains.torque_p - P) <= 1
    assert abs(gains.torque_i - I) <= 1 + 0.0006 * I


@pytest.mark.parametrize(
    ("motor", "velocity_hz", "P"),
    [
        (W20, 50, 339), (W20, 100, 677), (W20, 200, 1355),
        (EC_I_40, 50, 636), (EC_I_40, 100, 1272), (EC_I_40, 200, 2544),
        (W750, 50, 9032), (W750, 100, 18064),
    ],
)  # fmt: skip
def test_velocity_p_is_that_of_the_table(motor, velocity_hz, P):
    # 8784 stands for 8784.4 in the table's formula.
    assert abs(gains_of(motor, velocity_hz=velocity_hz).velocity_p - P) <= 1 + 5e-5 * P


@pytest.mark.parametrize(("velocity_hz", "I"), [(50, 824), (100, 1647), (200, 3294)])
def test_velocity_i_is_that_of_the_table_for_every_motor(velocity_hz, I):
    for motor in (W20, EC_I_40):
        assert abs(gains_of(motor, velocity_hz=velocity_hz).velocity_i - I) <= 1


@pytest.mark.parametrize(("position_hz", "P"), [(10, 236), (20, 471), (40, 942)])
def test_position_p_is_that_of_the_table_for_every_motor(position_hz, P):
    for motor in (W20, EC_I_40, W750):
        assert abs(gains_of(motor, position_hz=position_hz).position_p - P) <= 1


def test_a_gain_outside_the_registers_range_is_an_error_that_names_it():
    with pytest.raises(ValueError, match=r"velocity P would be 361\d\d, outside 1\.\.\.32767"):
        gains_of(W750, velocity_hz=200.0)  # "out of range" in the table
    with pytest.raises(ValueError, match=r"position P would be 0, outside 1\.\.\.32767"):
        gains_of(W20, position_hz=0.01)
    with pytest.raises(ValueError, match="torque P would be"):
        gains_of(W20, current_hz=12_000.0)


def test_the_largest_and_the_smallest_gain_are_allowed():
    highest = gains_of(W20, position_hz=32767 / 3.75 / (2 * math.pi) * 0.99999)
    assert 32750 <= highest.position_p <= 32767
    assert gains_of(W20, position_hz=1.0 / 3.75 / (2 * math.pi)).position_p == 1


def test_supply_changes_torque_p_alone():
    at_24 = gains_of(W20)
    at_48 = chip_gains(DEVICE, W20, 3 * W20.inertia, current_hz=1000.0, velocity_hz=50.0, position_hz=10.0, supply=48.0)
    assert abs(at_48.torque_p - at_24.torque_p / 2) <= 1
    assert at_48[1:] == at_24[1:]


@pytest.mark.parametrize("motor", [W20, EC_I_40, W750, MOTORS["qbl4208"], MOTORS["ec_i_40"]])
def test_bandwidths_come_back_from_gains_within_rounding(motor):
    inertia = 3.0 * motor.inertia
    gains = chip_gains(DEVICE, motor, inertia, current_hz=1000.0, velocity_hz=60.0, position_hz=15.0)
    back = bandwidths_from_gains(DEVICE, motor, inertia, gains)
    assert back.current_hz == pytest.approx(1000.0, rel=0.5 / gains.torque_p)
    assert back.velocity_hz == pytest.approx(60.0, rel=0.5 / gains.velocity_p)
    assert back.position_hz == pytest.approx(15.0, rel=0.5 / gains.position_p)
    expected_integration = 5.0 / (2 * math.pi * 60.0)
    assert back.velocity_integration_s == pytest.approx(expected_integration, rel=0.6 / gains.velocity_i)


def test_what_the_makers_demonstration_gains_mean_on_the_bare_demonstration_motor():
    """Hand calculation: 300*24/(25600*2 pi*.6e-3); 100*.035714/(8784.4*4.8e-6)/2 pi; 300/3.75/2 pi; 65536*2e-4/100."""
    motor = MOTORS["qbl4208"]
    meaning = bandwidths_from_gains(DEVICE, motor, motor.inertia, Gains(300, 600, 100, 100, 300))
    assert meaning.current_hz == pytest.approx(74.6, abs=0.1)
    assert meaning.velocity_hz == pytest.approx(13.48, abs=0.02)
    assert meaning.position_hz == pytest.approx(12.73, abs=0.02)
    assert meaning.velocity_integration_s == pytest.approx(0.1311, abs=0.0001)


def test_no_integration_is_an_infinite_time():
    motor = MOTORS["qbl4208"]
    assert bandwidths_from_gains(DEVICE, motor, 1e-5, Gains(1, 1, 1, 0, 1)).velocity_integration_s == math.inf
