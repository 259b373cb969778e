"""The gains of the TGZ by its maker's names and units: what each does to currents, speeds and positions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from drive_env import EmulatedDrives, cia402, motion
from drive_env.devices import find_device
from drive_env.devices.gains import as_chip, bandwidth_gains, gains_in_si, rule_gains, si_scales
from drive_env.firmware.record import get_lanes
from drive_env.motors import find_motor
from tuning.auto.twin import gain_bounds

DEVICE = find_device("tgz_d")
VOLTS = 560.0
OF_LINK = 32.0  # V of the current controller's output that are the whole link (device.toml, 2500h)
RPM = 2.0 * math.pi / 60.0


def new_drives(**given):
    return EmulatedDrives("tgz_d", "inertia", num_machines=1, seed=0, ideal=True, num_threads=1, **given)


def field(drives, name):
    return float(get_lanes(drives.inside.records, name, drives.num_axes, 0)[0])


def write(drives, **values):
    for name, value in values.items():
        drives.write(name.replace("_", "-"), value)


MOTORS = (
    find_motor("am3041_e"),
    find_motor("am3033_e"),
    find_motor("am3033_e")._replace(R_s=0.7, L_d=4.3e-3, L_q=4.3e-3),  # of a larger frame
)


@pytest.mark.parametrize("motor", MOTORS, ids=("am3041_e", "am3033_e", "larger"))
def test_the_current_loop_is_commissioned_by_the_makers_rules(motor):
    """C-K = L_2ph [mH] 100,000 / V_DC, C-Ti = 1000 L_2ph [mH] / R_2ph [ohm], between two terminals: twice a phase's.

    M-Inull = 1000 I_n, M-Ipeak = 1414 I_max with I_max = 2 I_n; C-Lim M-Inull / 1000 lets all of it through.
    """
    found = DEVICE.preset(motor)
    line_mh, line_ohm = 2e3 * motor.L_q, 2.0 * motor.R_s
    assert found["C-K"] == round(line_mh * 100_000.0 / min(motor.voltage, VOLTS))
    assert found["C-Ti"] == round(1000.0 * line_mh / line_ohm)
    rms = motor.rated_current / math.sqrt(2.0)
    assert found["M-Inull"] == round(1000.0 * rms)
    assert found["M-Ipeak"] == pytest.approx(1414.0 * min(2.0 * rms, DEVICE.nominal_current / math.sqrt(2.0)), abs=60)
    for name in ("C-LimN", "C-LimP"):
        assert 0 <= found[name] * found["M-Inull"] / 1000.0 - found["M-Ipeak"] < found["M-Inull"] / 1000.0


def test_c_k_is_volts_for_amperes_and_c_kdr_its_share_across_them():
    """Without integrator a held rotor's current is K / (K + R) of what is asked, K being C-K of the link's voltage."""
    with new_drives() as drives:
        write(drives, C_K=2000, C_Ti=0)
        drives.machine.brake = "closed"
        motion.enable(drives, mode="cst")
        drives.write(cia402.TARGET_TORQUE, 3000)
        drives.advance(0.05)
        asked = 3000 / 32767 * field(drives, "peak_current")
        K = 2000e-3 / OF_LINK * field(drives, "u_dc")
        resistance = field(drives, "R_s")
        assert field(drives, "i_q") == pytest.approx(asked * K / (K + resistance), rel=2e-3)
        motion.disable(drives)
        write(drives, C_KDr=50)
        for name, value in ((0x23E4, 1), (0x23E5, 3000)):  # in open loop: all of the current is along the field
            drives.write(name, value)
        motion.enable(drives, mode="cst")
        drives.advance(0.1)
        K = 0.5 * 2000e-3 / OF_LINK * field(drives, "u_dc")
        assert field(drives, "i_d") == pytest.approx(asked * K / (K + resistance), rel=2e-3)
        assert field(drives, "i_q") == pytest.approx(0.0, abs=1e-3)


def test_c_ti_is_the_time_in_which_the_integrator_adds_what_the_gain_gives():
    """A weak controller leaves the error as it is: the current rises by K / (R C-Ti) of it per second."""
    with new_drives() as drives:
        write(drives, C_K=5, C_Ti=20_000)
        drives.machine.brake = "closed"
        motion.enable(drives, mode="cst")
        drives.write(cia402.TARGET_TORQUE, 3000)
        drives.advance(0.05)
        first = field(drives, "i_q")
        drives.advance(0.05)
        asked, resistance = 3000 / 32767 * field(drives, "peak_current"), field(drives, "R_s")
        K = 5e-3 / OF_LINK * field(drives, "u_dc")
        # K / (R + K) of it at once, the rest with a lag of (R + K) T / K; the winding's own, 3 ms, shifts all of it.
        lag = (resistance + K) * 0.02 / K
        missing = [resistance / (resistance + K) * math.exp(-(t - 0.003) / lag) for t in (0.05, 0.1)]
        assert field(drives, "i_q") - first == pytest.approx(asked * (missing[0] - missing[1]), rel=0.01)


def test_c_cogcompfac_is_the_share_of_the_cogging_that_a_current_takes_away():
    """Of a held rotor the current is the cogging torque there over 3/2 n_p psi; of one that turns the ripple goes."""
    torque, phase, ripples = 0.2, 0.7, []
    for share in (0, 50, 100):
        with new_drives() as drives:
            write(drives, C_CogCompFac=share)
            for name, value in (("torque", torque), ("phase", phase)):
                drives.machine.set(f"motor.cogging_{name}", value)
            drives.machine.brake = "closed"
            motion.enable(drives, mode="cst")
            drives.advance(0.05)
            order, angle = drives.motor.cogging_order, float(drives.machine.rotor_angle[0])
            constant = 1.5 * drives.motor.n_p * drives.motor.psi_m
            expected = -share / 100.0 * torque * math.sin(order * angle + phase) / constant
            assert field(drives, "i_q") == pytest.approx(expected, abs=2e-3)
            motion.disable(drives)
            drives.machine.brake = "open"
            motion.enable(drives, mode="pv")
            drives.write(cia402.TARGET_VELOCITY, "60 rpm")
            drives.advance(0.8)
            speeds = []
            for _ in range(500):
                drives.advance(0.001)
                speeds.append(drives.machine.rotor_speed[0])
            ripples.append(np.std(speeds))
    assert ripples[1] == pytest.approx(0.5 * ripples[0], rel=0.2)
    assert ripples[2] < 0.1 * ripples[0]


def test_a_current_against_cogging_stays_within_the_limits_and_flows_in_an_axis_that_is_on_alone():
    with new_drives() as drives:
        write(drives, C_CogCompFac=100)
        drives.machine.set("motor.cogging_torque", 50.0)
        drives.machine.set("motor.cogging_phase", 0.5 * math.pi)
        drives.machine.brake = "closed"
        drives.advance(0.02)
        assert field(drives, "i_q_ref") == 0.0
        motion.enable(drives, mode="cst")
        drives.advance(0.05)
        assert field(drives, "i_q_ref") == field(drives, "i_low") < 0.0


def test_v_k_and_v_ti_are_milliamperes_for_1000_rpm_and_the_time_that_doubles_them():
    with new_drives() as drives:
        write(drives, V_K=2000, V_Ti=0)
        drives.write(cia402.FOLLOWING_WINDOW, 0)
        drives.machine.brake = "closed"
        motion.enable(drives, mode="pv")
        drives.write("Profile acceleration", "100000 rpm/s")
        drives.write(cia402.TARGET_VELOCITY, "500 rpm")
        drives.advance(0.02)
        assert field(drives, "i_q_ref") == pytest.approx(1.0, rel=1e-3)  # 2000 mA for 1000 rpm: 1 A for 500
        write(drives, V_Ti=40_000)
        drives.advance(0.02)
        assert field(drives, "i_q_ref") == pytest.approx(1.5, rel=0.03)  # half of V-Ti later, half as much again


def test_p_k_and_p_sff_leave_a_lag_of_what_is_not_fed_forward():
    """In csp at a steady speed v the axis is v (1 - P-SFF) / P-K behind."""
    speed, count = 600.0 * RPM, 400
    turn = 2**20
    steps = np.rint(np.arange(count) * 1e-3 * speed / (2.0 * math.pi) * turn).astype(int)
    for share in (0, 500, 1000):
        with new_drives() as drives:
            write(drives, P_K=40_000, P_SFF=share)
            drives.write(cia402.FOLLOWING_WINDOW, 0)
            motion.enable(drives, mode="csp")
            start = int(drives.read(cia402.POSITION_ACTUAL)[0])
            drives.record([cia402.POSITION_ACTUAL], count * 1e-3, play={cia402.TARGET_POSITION: start + steps})
            lag = speed * (1.0 - share / 1000.0) / 40.0
            assert field(drives, "position_error") == pytest.approx(lag, abs=2e-3 * speed)


def test_integration_times_are_what_the_linear_model_and_si_say():
    gains = np.array([3571, 3077, 6400, 40_000, 31_416, 0])
    si = gains_in_si(DEVICE, VOLTS, gains)
    assert si.torque_p == pytest.approx(3.571 * VOLTS / OF_LINK)
    assert si.torque_integration == pytest.approx(3.077e-3)
    assert si.velocity_p == pytest.approx(6.4 / (1000.0 * RPM))
    assert si.velocity_integration == pytest.approx(40e-3)
    assert si.position_p == pytest.approx(31.416)
    scale = si_scales(DEVICE, VOLTS)["velocity", "I"]
    assert scale.raw(25.0) == pytest.approx(40_000) and scale.value(40_000) == pytest.approx(25.0)
    assert scale.raw(0.0) == 0.0 and scale.value(0) == 0.0  # off
    assert as_chip(DEVICE, gains)[3] == pytest.approx(65536.0 / 5000.0 / 40e-3)


def test_more_of_a_gain_is_less_of_its_integration_time():
    known, motor = DEVICE.gains, find_motor("am3041_e")
    gains = bandwidth_gains(
        DEVICE, motor, 3 * motor.inertia, current_hz=1000.0, velocity_hz=20.0, position_hz=5.0
    )  # fmt: skip
    columns = known.columns_of("velocity", "position")
    livelier = known.changed(gains, np.full(3, math.log(2.0)), columns, known.highest)
    assert livelier[columns] == pytest.approx(gains[columns] * [2.0, 0.5, 2.0], abs=1)
    assert known.change(livelier, gains, columns) == pytest.approx(np.full(3, math.log(2.0)), abs=1e-4)
    assert known.scaled(gains, 2.0, columns).tolist() == livelier.tolist()
    softer = known.softened(gains[None], 2, "velocity")[0]
    assert softer[columns[:2]] == pytest.approx(gains[columns[:2]] * [0.5, 2.0], abs=1)
    assert known.strength(livelier, columns) / known.strength(gains, columns) == pytest.approx(2.0, rel=1e-3)
    slow, fast = (rule_gains(DEVICE, motor, J)[0] for J in (1e-3, 1e-4))
    assert slow[3] == fast[3] and slow[2] == pytest.approx(10 * fast[2], rel=1e-3)  # by lags, and by inertia


def test_a_change_from_speed_to_position_knows_what_is_fed_forward():
    """The position loop takes over at the speed that there is, whatever share of it is fed forward."""
    for share in (0, 1000):
        with new_drives() as drives:
            write(drives, P_SFF=share)
            drives.write(cia402.FOLLOWING_WINDOW, 0)
            motion.enable(drives, mode="pv")
            drives.write(cia402.TARGET_VELOCITY, "600 rpm")
            drives.advance(0.5)
            drives.write(0x2303, 7)
            drives.write(cia402.MODE, 1)
            drives.advance(0.001)
            assert field(drives, "omega_ref") == pytest.approx(600.0 * RPM, rel=0.1), share


def test_bounds_and_the_way_without_feed_forward():
    least, most = gain_bounds(DEVICE)
    assert least.tolist() == [1, 1, 1, 1, 1, 0]
    assert most[3] == 655_360 and most[5] == 1000  # us: the longest integration time
    gains = np.array([[3571, 3077, 6400, 40_000, 31_416, 850]])
    assert DEVICE.gains.without_feed_forward(gains).tolist() == [[3571, 3077, 6400, 40_000, 31_416, 0]]
