"""The cascade: its form against an independent implementation, its limits, its delay, and what its gains mean.

Bandwidth. Two measures, both taken on the simulated axis with sines in steady state, one frequency per machine:
- the crossover of a WHOLE open loop, output over error, with everything in it: inner loops, filter, delay, sampling;
- the crossover of a loop's OWN regulator and plant: set-point of the inner loop over error, times output over the inner
  loop's output. Inner loops count as perfect there, as in the formulas of the gain scale.
A loop with an inner loop that is much faster has one and the same for both.
"""

from __future__ import annotations

import math
import platform
import re

import numpy as np
import pytest
from numba import njit, typeof
from rigs.chip_gains import chip_gains

from drive_env import EmulatedDrives, motion
from drive_env.devices import find_device
from drive_env.emulator.group import rates_of
from drive_env.firmware.cycle import mechanics_window
from drive_env.firmware.record import LANES, get_lanes, set_lanes
from drive_env.firmware.servo.derived import derive
from drive_env.firmware.servo.loops import current_loop, motion_loops
from drive_env.firmware.servo.power_stage import convert_energy, power_stage, refresh_winding
from drive_env.firmware.servo.sensors import measure_angle, measure_currents, measure_motion
from drive_env.firmware.servo.stages import FIRMWARE
from drive_env.motors import MOTORS
from mechanics.kernels.compiled import OPTIONS, cached

window = FIRMWARE.window

TWO_PI = 2.0 * math.pi
RPM = TWO_PI / 60.0
DT, WINDOW = 40e-6, 200e-6  # s
CURRENT_LSB = 100.0 / 32768.0  # A
DUTY_LIMIT = 1.0 / math.sqrt(3.0)
FREE = {"load.coulomb": 0.0, "load.breakaway": 0.0, "load.viscous": 0.0}
TORQUE_P, TORQUE_I = "Torque Mode Settings.Torque_P", "Torque Mode Settings.Torque_I"
VELOCITY_P, VELOCITY_I = "Velocity Mode Settings.P_Parameter", "Velocity Mode Settings.I_Parameter"
POSITION_P = "Position Mode Settings.P_Parameter"


# --- kernels ------------------------------------------------------------------------------------------------------
@cached()
def run_motion_loops(drive, demand, measured, out):
    """Feed velocity (or torque, by the lane's level) demands and measured velocities; out: i_q_ref, sum, error."""
    for k in range(demand.shape[0]):
        for lane in range(LANES):
            drive.velocity_demand[lane] = demand[k, lane]
            drive.torque_demand[lane] = demand[k, lane]
            drive.omega_meas[lane] = measured[k, lane]
        motion_loops(drive)
        for lane in range(LANES):
            out[k, 0, lane] = drive.i_q_ref[lane]
            out[k, 1, lane] = drive.velocity_sum[lane]
            out[k, 2, lane] = drive.velocity_error[lane]


@cached()
def run_current_loop(drive, i_q_ref, i_d, i_q, angle, out):
    """Feed set-points, measured currents and angles; out: duty d and q in that angle, sums d and q."""
    for k in range(i_q_ref.shape[0]):
        for lane in range(LANES):
            s, c = math.sin(angle[k, lane]), math.cos(angle[k, lane])
            drive.sin_meas[lane] = s
            drive.cos_meas[lane] = c
            drive.i_alpha_meas[lane] = c * i_d[k, lane] - s * i_q[k, lane]
            drive.i_beta_meas[lane] = s * i_d[k, lane] + c * i_q[k, lane]
            drive.i_q_ref[lane] = i_q_ref[k, lane]
        current_loop(drive)
        for lane in range(LANES):
            s, c = math.sin(angle[k, lane]), math.cos(angle[k, lane])
            out[k, 0, lane] = c * drive.duty_next_alpha[lane] + s * drive.duty_next_beta[lane]
            out[k, 1, lane] = c * drive.duty_next_beta[lane] - s * drive.duty_next_alpha[lane]
            out[k, 2, lane] = drive.current_sum_d[lane]
            out[k, 3, lane] = drive.current_sum_q[lane]


@cached()
def run_current_ticks(records, dt, h, i_q_ref, out):
    """Run current loop and power stage, rotors locked; out, before each tick: i_q_ref, i_q, duty alpha, beta."""
    for block in range(records.shape[0]):
        drive = records[block]
        derive(drive, dt)
        refresh_winding(drive, dt, h)
        for k in range(i_q_ref.shape[0]):
            for lane in range(LANES):
                drive.i_q_ref[lane] = i_q_ref[k, block, lane]
                out[k, 0, block, lane] = i_q_ref[k, block, lane]
                out[k, 1, block, lane] = drive.i_q[lane]
                out[k, 2, block, lane] = drive.duty_alpha[lane]
                out[k, 3, block, lane] = drive.duty_beta[lane]
            measure_angle(drive, dt)
            measure_currents(drive)
            current_loop(drive)
            power_stage(drive)
            convert_energy(drive, dt, 0.5)


ERROR_P, THETA, ERROR_V, OMEGA, I_REF, I_Q, OMEGA_TRUE, OMEGA_REF = range(8)


@cached()
def excite(records, plant, rates, scratch, num_axes, level, demand, out):
    """Run the whole axis with a demand of its own per window, shape (n, axes); out (n, 8, axes)."""
    for k in range(demand.shape[0]):
        for axis in range(num_axes):
            drive, lane = records[axis // LANES], axis % LANES
            drive.loop_level[lane] = level
            if level == 2:
                drive.position_demand[lane] = demand[k, axis]
            else:
                drive.velocity_demand[lane] = demand[k, axis]
        for block in range(records.shape[0]):
            window(records[block], rates)
        for axis in range(num_axes):
            drive, lane = records[axis // LANES], axis % LANES
            out[k, 0, axis] = drive.position_error[lane]
            out[k, 1, axis] = drive.theta_meas[lane]
            out[k, 2, axis] = drive.velocity_error[lane]
            out[k, 3, axis] = drive.omega_meas[lane]
            out[k, 4, axis] = drive.i_q_ref[lane]
            out[k, 5, axis] = drive.i_q[lane]
            out[k, 6, axis] = drive.omega_m[lane]
            out[k, 7, axis] = drive.omega_ref[lane]
        mechanics_window(records, plant, rates, scratch)


# --- the form, against an independent implementation in the chip's own numbers ------------------------------------
class AdvancedPI:
    """x = clip(x + P I e), out = clip(P e + x), in LSB: P is Q8.8, I is Q8.8/256 per sample."""

    def __init__(self, P, I, limit):
        self.P, self.I, self.limit, self.x = P / 256.0, I / 65536.0, limit, 0.0

    def __call__(self, error):
        self.x = min(max(self.x + self.P * self.I * error, -self.limit), self.limit)
        return min(max(self.P * error + self.x, -self.limit), self.limit)


LANE_P = np.array([1, 100, 445, 1272, 2544, 9032, 18064, 32767])
LANE_I = np.array([0, 100, 329, 824, 1647, 3294, 32767, 1])


@pytest.fixture
def eight():
    """Eight commissioned drives in one record, powered, at angle 0."""
    drives = EmulatedDrives(load="inertia", num_machines=8, ideal=True, num_threads=1)
    set_lanes(drives.inside.records, "drive_function", np.ones(8))
    set_lanes(drives.inside.records, "stage_on", np.ones(8))
    yield drives
    drives.close()


def test_velocity_regulator_is_the_chips_advanced_form(eight):
    """Random errors in rpm to current in LSB, limit 7 A: large ones and small ones, so that both clips act."""
    eight.write(VELOCITY_P, LANE_P)
    eight.write(VELOCITY_I, LANE_I)
    set_lanes(eight.inside.records, "loop_level", np.ones(8))
    generator = np.random.default_rng(0)
    size = 10.0 ** generator.uniform(-1, 4, (400, 8))
    demand, measured = (generator.normal(size=(400, 8)) * size * RPM for _ in range(2))
    out = np.empty((400, 3, 8))
    run_motion_loops(eight.inside.records[0], demand, measured, out)
    expected = np.empty((400, 2, 8))
    for lane in range(8):
        regulator = AdvancedPI(LANE_P[lane], LANE_I[lane], 7.0 / CURRENT_LSB)
        for k in range(400):
            i_ref = regulator((demand[k, lane] - measured[k, lane]) / RPM)
            expected[k, :, lane] = np.array([i_ref, regulator.x]) * CURRENT_LSB
    np.testing.assert_allclose(out[:, :2], expected, rtol=1e-9, atol=1e-9)
    assert 200 < np.count_nonzero(np.abs(expected[:, 0]) > 7.0 - 1e-9) < 3000


def test_position_regulator_is_a_gain_of_q4_12(eight):
    """Velocity error = P/4096 rpm per 1/65536 revolution - measured velocity."""
    eight.write(POSITION_P, LANE_P)
    records = eight.inside.records
    set_lanes(records, "loop_level", np.full(8, 2.0))
    set_lanes(records, "position_demand", np.full(8, 1000 * TWO_PI / 65536))
    set_lanes(records, "theta_meas", np.full(8, -500 * TWO_PI / 65536))
    out = np.empty((1, 3, 8))
    run_motion_loops(records[0], np.full((1, 8), 99.0), np.full((1, 8), 10 * RPM), out)
    assert out[0, 2] / RPM == pytest.approx(LANE_P / 4096 * 1500 - 10, rel=1e-9)


def test_current_regulators_are_the_chips_advanced_form_and_end_in_the_voltage_circle(eight):
    eight.write(TORQUE_P, LANE_P)
    eight.advance(0.001)  # the gain of d follows in a period
    eight.write(TORQUE_I, LANE_I)
    generator = np.random.default_rng(1)
    size = 10.0 ** generator.uniform(-2, 1.5, (400, 8))
    ref, i_d, i_q = (generator.normal(size=(400, 8)) * size for _ in range(3))
    angle = generator.uniform(-10, 10, (400, 8))
    out = np.empty((400, 4, 8))
    run_current_loop(eight.inside.records[0], ref, i_d, i_q, angle, out)
    expected, cut = np.empty_like(out), 0
    for lane in range(8):
        flux, torque = (AdvancedPI(LANE_P[lane], LANE_I[lane], DUTY_LIMIT * 32768) for _ in range(2))
        for k in range(400):
            d = flux(-i_d[k, lane] / CURRENT_LSB) / 32768
            q = torque((ref[k, lane] - i_q[k, lane]) / CURRENT_LSB) / 32768
            length = math.hypot(d, q)
            if length > DUTY_LIMIT:  # shortened, its direction kept
                cut += 1
                d, q = d * DUTY_LIMIT / length, q * DUTY_LIMIT / length
            expected[k, :, lane] = d, q, flux.x / 32768, torque.x / 32768
    np.testing.assert_allclose(out, expected, rtol=1e-9, atol=1e-12)
    assert 200 < cut < 3000
    assert np.max(np.hypot(out[:, 0], out[:, 1])) <= 0.5773502691896258 * (1 + 1e-12)


def test_direction_of_the_shaft_turns_the_torque_set_point_round(eight):
    eight.write("Motor Shaft Direction", [0, 1] * 4)
    out = np.empty((1, 4, 8))
    zero = np.zeros((1, 8))
    run_current_loop(eight.inside.records[0], np.ones((1, 8)), zero, zero, zero, out)
    assert np.all(out[0, 1, ::2] > 0)
    assert np.array_equal(out[0, 1, 1::2], -out[0, 1, ::2])


def test_torque_command_passes_by_the_velocity_regulator_whose_integrator_follows(eight):
    """After a change to a velocity mode, out = P e + x must start from the torque that was commanded."""
    set_lanes(eight.inside.records, "loop_level", np.zeros(8))
    out = np.empty((3, 3, 8))
    run_motion_loops(eight.inside.records[0], np.full((3, 8), 2.5), np.full((3, 8), 1.0), out)
    assert np.all(out[:, 0] == 2.5)
    P = get_lanes(eight.inside.records, "velocity_p", 8)
    set_lanes(eight.inside.records, "loop_level", np.ones(8))
    after = np.empty((1, 3, 8))
    run_motion_loops(eight.inside.records[0], np.full((1, 8), 2.5), np.full((1, 8), 1.0), after)
    jump = P * get_lanes(eight.inside.records, "velocity_i", 8) * 1.5  # one sample's integration
    assert after[0, 0] - 2.5 == pytest.approx(jump, abs=1e-12)


def test_nothing_comes_out_and_nothing_is_summed_while_the_power_stage_is_off(eight):
    records = eight.inside.records
    set_lanes(records, "drive_function", np.zeros(8))
    set_lanes(records, "stage_on", np.zeros(8))
    set_lanes(records, "loop_level", np.ones(8))
    out, duty = np.empty((5, 3, 8)), np.empty((5, 4, 8))
    run_motion_loops(records[0], np.full((5, 8), 30.0), np.zeros((5, 8)), out)
    one, zero = np.ones((5, 8)), np.zeros((5, 8))
    run_current_loop(records[0], one, one, zero, zero, duty)
    assert np.all(out[:, :2] == 0.0)
    assert np.all(duty == 0.0)


# --- the same, from outside: each regulator's output from the read-outs of 2041h to 2043h ------------------------
READ_OUTS = [
    (0x2041, 3), (0x2041, 4), (0x2041, 5), (0x2041, 6), (0x2042, 3), (0x2042, 4), (0x2043, 2), 0x606C, 0x6077,
]  # fmt: skip


@pytest.mark.parametrize("ideal", [True, False])
def test_each_regulators_output_follows_from_the_read_outs(ideal):
    """Rounding bounds: an error is read to half its unit, a sum to half of 1/256 LSB.

    position -> velocity error:  P/4096 * .5 (1/65536 rev) + .5 pps of velocity + .5 rpm of the result
    velocity -> current:         P/256 * .5 rpm + .5/256 LSB
    current -> duty:             P/256 * .5 mA in LSB + .5/256 LSB, in d and in q
    """
    drives = EmulatedDrives(load="two_mass", ideal=ideal, num_threads=1)
    P_T, P_V, P_P = (int(drives.read(name)[0]) for name in (TORQUE_P, VELOCITY_P, POSITION_P))
    i_max = drives.read("Maximum Current")[0] * 1e-3 / CURRENT_LSB
    motion.enable(drives, mode="pp")
    drives.write("Target position", 150_000)
    drives.write("Controlword", 0x1F)
    saturated = 0
    for _ in range(300):
        drives.advance(0.001)
        e_q, x_q, e_d, x_d, e_v, x_v, e_p, pps, milliamperes = (float(drives.read(key)[0]) for key in READ_OUTS)
        v_error = P_P / 4096 * e_p - pps * 60 / 65536
        assert abs(v_error - e_v) <= P_P / 4096 * 0.5 + 0.5 * 60 / 65536 + 0.5 + 1e-6

        i_ref = min(max(P_V / 256 * e_v + x_v / 256, -i_max), i_max)
        saturated += abs(i_ref) == i_max
        bound = P_V / 256 * 0.5 + 0.5 / 256 + 1e-6
        assert abs(i_ref - get_lanes(drives.inside.records, "i_q_ref", 1)[0] / CURRENT_LSB) <= bound
        # The same set-point from the next loop's read-outs, error + measured current, each to .5 mA.
        assert abs(i_ref - (e_q + milliamperes) * 1e-3 / CURRENT_LSB) <= bound + 1e-3 / CURRENT_LSB

        limit = DUTY_LIMIT * 32768
        d, q = (
            min(max(P_T / 256 * e * 1e-3 / CURRENT_LSB + x / 256, -limit), limit) for e, x in ((e_d, x_d), (e_q, x_q))
        )
        shorten = min(1.0, limit / max(math.hypot(d, q), 1e-9))
        s, c = (get_lanes(drives.inside.records, name, 1)[0] for name in ("sin_meas", "cos_meas"))
        alpha, beta = (
            get_lanes(drives.inside.records, name, 1)[0] * 32768 for name in ("duty_next_alpha", "duty_next_beta")
        )
        bound = 2 * (P_T / 256 * 0.5e-3 / CURRENT_LSB + 0.5 / 256) + 1e-6
        assert abs(d * shorten - (c * alpha + s * beta)) <= bound
        assert abs(q * shorten - (c * beta - s * alpha)) <= bound
    assert drives.read("Position actual value")[0] == pytest.approx(150_000, abs=2000)
    assert saturated < 300


# --- limits -------------------------------------------------------------------------------------------------------
def test_a_blocked_axis_does_not_wind_up(eight):
    """Error 1000 rpm for 10 s, 50,000 samples: the integrator stays at the limit, and lets go as soon as it may."""
    records = eight.inside.records
    P, I = 445, 329
    eight.write(VELOCITY_P, P)
    eight.write(VELOCITY_I, I)
    set_lanes(records, "loop_level", np.ones(8))
    out = np.empty((50_000, 3, 8))
    run_motion_loops(records[0], np.full((50_000, 8), 1000 * RPM), np.zeros((50_000, 8)), out)
    assert np.max(out[:, 1]) == 7.0
    assert np.all(out[100:, 0] == 7.0)
    # Released with an error of -20 rpm: P e takes effect in the first sample, and the sum falls from the limit, not
    # from 50,000 samples of error, which would have been 1e5 A.
    back = np.empty((20_000, 3, 8))
    run_motion_loops(records[0], np.full((20_000, 8), -20 * RPM), np.zeros((20_000, 8)), back)
    per_sample = P / 256 * I / 65536 * 20 * CURRENT_LSB
    assert back[0, 1, 0] == pytest.approx(7.0 - per_sample, rel=1e-9)
    assert back[0, 0, 0] == pytest.approx(7.0 - per_sample - P / 256 * 20 * CURRENT_LSB, rel=1e-9)
    zero_crossing = np.argmax(back[:, 1, 0] <= 0.0)
    assert zero_crossing == pytest.approx(7.0 / per_sample, abs=2)


def test_a_blocked_axis_read_from_outside_stays_within_its_limits_and_turns_round_at_once():
    drives = EmulatedDrives(load="inertia", ideal=True, num_threads=1, parameters={**FREE, "load.inertia": 1e3})
    drives.write("Following error window", 0)
    motion.enable(drives, mode="pv")
    drives.write("Target velocity", 3_000_000)
    trace = drives.record([(0x2042, 4), (0x2041, 4), 0x6077], duration=3.0)
    assert np.max(trace[0x2042, 4]) == round(7.0 / CURRENT_LSB * 256)
    assert np.max(np.abs(trace[0x2041, 4])) <= DUTY_LIMIT * 32768 * 256 + 1
    assert trace[0x6077][-1, 0] == pytest.approx(7000, abs=2)
    drives.write("Profile acceleration", 2_000_000_000)
    drives.write("Target velocity", -3_000_000)
    drives.advance(0.01)
    assert drives.read("Torque actual value")[0] == pytest.approx(-7000, abs=20)


def test_the_torque_integrator_stops_at_the_voltages_limit():
    """8 A through 5 ohm would need 40 V: the duty stays at 1/sqrt(3) and comes back within milliseconds."""
    drives = EmulatedDrives(
        load="inertia", ideal=True, num_threads=1, parameters={**FREE, "load.inertia": 1e3, "motor.R_s": 5.0}
    )
    motion.enable(drives, mode="cst")
    drives.write("Target torque", 7000)
    drives.advance(1.0)
    assert drives.read("Torque actual value")[0] == pytest.approx(24 / math.sqrt(3) / 5 * 1000, abs=2)
    assert drives.read((0x2041, 4))[0] == pytest.approx(DUTY_LIMIT * 32768 * 256, abs=1)
    drives.write("Target torque", 1000)
    drives.advance(0.020)
    assert drives.read("Torque actual value")[0] == pytest.approx(1000, rel=0.05)


@pytest.mark.slow
def test_a_duty_is_applied_one_pwm_period_after_the_samples_it_comes_from():
    """Tick 0 samples, tick 1 holds: the current is still 0 at the end of tick 0, on the closed form after tick 1."""
    drives = EmulatedDrives(load="inertia", ideal=True, num_threads=1)
    records = drives.inside.records
    set_lanes(records, "stage_on", np.ones(1))
    set_lanes(records, "angle_source", np.full(1, 3.0))
    set_lanes(records, "J_rotor", np.full(1, 1e30))
    out = np.empty((4, 4, 1, LANES))
    run_current_ticks(records, DT, WINDOW, np.ones((4, 1, LANES)), out)
    i_q, duty = out[:, 1, 0, 0], out[:, 3, 0, 0]
    # The encoder's half count leaves the q axis 0.8 mrad from beta at the interpolation of the ideal encoder.
    P, I = 4021 / 256, 1573 / 65536
    first = P * (1 + I) * (1.0 / CURRENT_LSB) / 32768
    assert duty[0] == 0.0
    assert duty[1] == pytest.approx(first, rel=1e-4)
    assert i_q[0] == i_q[1] == 0.0
    assert i_q[2] == pytest.approx(first * 24.0 / 0.36 * -math.expm1(-DT * 0.36 / 0.6e-3), rel=1e-4)


# --- bandwidths ---------------------------------------------------------------------------------------------------
def phasors(x, frequency, period, samples):
    """Return the complex amplitude of the last samples at each column's frequency; whole periods must fit."""
    t = period * np.arange(len(x) - samples, len(x))
    turning = np.exp(-1j * TWO_PI * np.multiply.outer(t, frequency))
    return 2.0 * np.mean(x[-samples:].reshape(samples, -1) * turning, axis=0)


def crossover(frequency, gain):
    """Return where a falling gain, one row per loop, passes 1 [Hz]; log-log interpolation; nan if it does not."""
    result = []
    for f, g in zip(frequency, np.abs(gain), strict=True):
        inside = g[0] > 1.0 > g[-1]
        result.append(math.exp(np.interp(0.0, -np.log(g), np.log(f))) if inside else math.nan)
    return np.array(result)


def sweep_axis(drives, level, frequency, amplitude, duration, samples):
    """Excite position (2) or velocity (1) demand with a sine per machine; return phasors, shape (8, machines)."""
    group = drives.inside.groups[0]
    drives.advance(0.001)  # the stage is switched on at the next millisecond
    t = WINDOW * np.arange(round(duration / WINDOW))
    demand = amplitude * np.sin(TWO_PI * np.multiply.outer(t, frequency))
    out = np.empty((len(t), 8, drives.num_axes))
    excite(group.records, group.load.plant, group.rates, group.motion, drives.num_axes, level, demand, out)
    return np.array([phasors(out[:, k], frequency, WINDOW, samples) for k in range(8)])


def sweep_current(drives, frequency, amplitude, ticks, samples):
    """Excite the current set-point with a sine per machine, rotors locked; return i_q and error, shape (machines,)."""
    records = drives.inside.records
    n = len(records) * LANES
    set_lanes(records, "stage_on", np.ones(drives.num_axes))
    set_lanes(records, "angle_source", np.full(drives.num_axes, 3.0))
    set_lanes(records, "J_rotor", np.full(n, 1e30))
    f = np.zeros(n)
    f[: len(frequency)] = frequency
    ref = amplitude * np.sin(TWO_PI * np.multiply.outer(DT * np.arange(ticks), f)).reshape(ticks, -1, LANES)
    out = np.empty((ticks, 4, len(records), LANES))
    run_current_ticks(records, DT, WINDOW, ref, out)
    i_q = phasors(out[:, 1].reshape(ticks, n), f, DT, samples)[: len(frequency)]
    error = phasors((out[:, 0] - out[:, 1]).reshape(ticks, n), f, DT, samples)[: len(frequency)]
    return i_q, error


# The gain scale's table: R ohm, L mH, K_t N m per ampere of peak i_q, J_m, V; torque P and I at 1 kHz; velocity P by
# bandwidth [Hz]. J = 3 J_m, T_i = 5/w_v. For the EC-i 40 the table takes the catalogue's .0315, line to line, as
# torque per PEAK ampere; the row "ec_i_40" of drive_env/motors/ has .866 of it. Here the motor is the table's.
TABLE = {
    "20 W": (2.2, 0.45, 0.022, 0.9e-6, 24.0, (3015, 12815), {50: 339, 100: 677, 200: 1355}),
    "EC-i 40": (0.404, 0.322, 0.0315, 2.42e-6, 36.0, (1438, 3284), {50: 636, 100: 1272, 200: 2544}),
    "750 W": (0.05, 0.1, 0.11, 1.2e-4, 48.0, (335, 1310), {50: 9032, 100: 18064}),
}
TABLE_VELOCITY_I = {50: 824, 100: 1647, 200: 3294}
TABLE_POSITION_P = {10: 236, 20: 471, 40: 942}


def table_drives(rows, velocity=None):
    """Return ideal machines with the motors of the rows and the torque gains of the table; velocity gains if given."""
    R, L, K_t, J, volts, gains, _ = zip(*(TABLE[row] for row in rows), strict=True)
    drives = EmulatedDrives(
        load="inertia", num_machines=len(rows), ideal=True, num_threads=1,
        parameters={
            **FREE,
            "motor.R_s": R, "motor.L_d": np.array(L) * 1e-3, "motor.L_q": np.array(L) * 1e-3,
            "motor.psi_m": np.array(K_t) / (1.5 * 4), "motor.inertia": J, "load.inertia": 2.0 * np.array(J),
        },
    )  # fmt: skip
    drives.machine.supply = volts
    drives.write("Maximum Current", 45_000)
    drives.write("Following error window", 0)
    drives.write(TORQUE_P, [pair[0] for pair in gains])
    drives.write(TORQUE_I, [pair[1] for pair in gains])
    if velocity is not None:
        drives.write(VELOCITY_P, [TABLE[row][6][hz] for row, hz in zip(rows, velocity, strict=True)])
        drives.write(VELOCITY_I, [TABLE_VELOCITY_I[hz] for hz in velocity])
        motion.enable(drives, mode="pv")
    return drives


def test_tables_torque_gains_give_1_khz():
    """Whole loop, one period of delay included: it costs phase, 68 degrees are left, but no gain."""
    frequency = np.array([700.0, 800.0, 900.0, 1000.0, 1100.0, 1200.0, 1300.0])
    rows = [row for row in TABLE for _ in frequency]
    i_q, error = sweep_current(table_drives(rows), np.tile(frequency, 3), 0.5, 2500, 1250)
    loop = (i_q / error).reshape(3, -1)
    assert crossover(np.tile(frequency, (3, 1)), loop) == pytest.approx(np.full(3, 1000.0), rel=0.1)
    margin = 180.0 + np.degrees(np.angle(loop[:, 3]))
    assert margin == pytest.approx(np.full(3, 90.0 - 360.0 * 1000.0 * 1.5 * DT), abs=3.0)


DESIGNS = [(row, hz) for row in TABLE for hz in TABLE[row][6]]


@pytest.mark.slow
def test_tables_velocity_gains_give_50_100_and_200_hz():
    """Whole loop and own loop: all eight designs of the table at once, each with seven frequencies about its own."""
    multiples = np.array([0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3])
    rows = [row for row, _ in DESIGNS for _ in multiples]
    designs = np.array([hz for _, hz in DESIGNS])
    frequency = np.multiply.outer(designs, multiples)
    drives = table_drives(rows, np.repeat(designs, len(multiples)).tolist())
    p = sweep_axis(drives, 1, frequency.ravel(), 1.0, 0.5, 1000)
    whole = crossover(frequency, (p[OMEGA] / p[ERROR_V]).reshape(frequency.shape))
    assert whole == pytest.approx(designs, rel=0.1)
    own = crossover(frequency, (p[I_REF] / p[ERROR_V] * p[OMEGA_TRUE] / p[I_Q]).reshape(frequency.shape))
    assert own == pytest.approx(designs, rel=0.1)


def gain_from_lag(trace):
    """Return k_v [1/s] of each axis in motion at constant speed, from 606Ch and 2043h:02.

    The demand moves once per millisecond, the loop runs five times in it, the error is read after the fifth: the mean
    of the five is larger by the way of two windows.
    """
    v = np.mean(trace[0x606C], 0)
    return v / (np.mean(trace[0x2043, 2], 0) + 2.0 * WINDOW * v)


def test_tables_position_gains_give_10_20_and_40_hz():
    """Own loop, by the lag in motion at constant speed as seen on the bus: error = v / k_v."""
    cases = [
        (row, velocity, hz)
        for row in TABLE
        for velocity in TABLE[row][6]
        for hz in TABLE_POSITION_P
        if 4 * hz <= velocity
    ]
    drives = table_drives([row for row, _, _ in cases], [velocity for _, velocity, _ in cases])
    drives.write(POSITION_P, [TABLE_POSITION_P[hz] for _, _, hz in cases])
    motion.select_mode(drives, "pp")
    drives.write("Profile velocity", 1_000_000)
    drives.write("Profile acceleration", 5_000_000)
    motion.start_move(drives, 2_000_000)
    drives.advance(0.6)
    trace = drives.record([0x606C, (0x2043, 2)], duration=0.2)
    k_v = gain_from_lag(trace)
    assert k_v / TWO_PI == pytest.approx(np.array([hz for _, _, hz in cases], float), rel=0.01)


@pytest.mark.slow
def test_whole_position_loop_crosses_over_at_its_gain_where_the_velocity_loop_is_ten_times_faster():
    cases = [(row, velocity, velocity // 10) for row, velocity in DESIGNS if velocity // 10 in TABLE_POSITION_P]
    multiples = np.array([0.8, 0.9, 1.0, 1.1, 1.25, 1.4])
    frequency = np.multiply.outer([hz for _, _, hz in cases], multiples)
    drives = table_drives(
        [row for row, _, _ in cases for _ in multiples], [velocity for _, velocity, _ in cases for _ in multiples]
    )
    drives.write(POSITION_P, [TABLE_POSITION_P[hz] for _, _, hz in cases for _ in multiples])
    p = sweep_axis(drives, 2, frequency.ravel(), 0.02, 1.5, 5000)
    whole = crossover(frequency, (p[THETA] / p[ERROR_P]).reshape(frequency.shape))
    assert whole == pytest.approx(np.array([hz for _, _, hz in cases], float), rel=0.1)


# --- the maker's demonstration gains ------------------------------------------------------------------------------
MAKER = {TORQUE_P: 300, TORQUE_I: 600, VELOCITY_P: 100, VELOCITY_I: 100, POSITION_P: 300}


def demonstration(num_machines=1, ideal=True):
    """Return the demonstration motor alone, with the maker's gains."""
    free = {**FREE, "load.inertia": 1e-10}
    drives = EmulatedDrives(load="inertia", num_machines=num_machines, ideal=ideal, num_threads=1, parameters=free)
    for name, value in MAKER.items():
        drives.write(name, value)
    return drives


def test_makers_torque_gains_give_75_hz():
    """P u_dc / (2 pi L): the crossover that the inductance alone makes, f |L(f)| far above R/L and the integrator.

    The whole loop of this motor crosses lower, since its R/L (95 Hz) lies above: 39 Hz.
    """
    frequency = np.array([300.0, 400.0, 500.0, 30.0, 35.0, 40.0, 45.0, 50.0])
    i_q, error = sweep_current(demonstration(8), frequency, 0.5, 25_000, 12_500)
    gain = np.abs(i_q / error)
    assert frequency[:3] * gain[:3] == pytest.approx(np.full(3, 75.0), rel=0.1)
    assert crossover(frequency[None, 3:], gain[None, 3:])[0] == pytest.approx(39.0, abs=1.5)


def test_makers_velocity_gains_give_14_hz():
    """Own loop. The whole loop crosses lower, since the current loop at 75 Hz yields to the back-EMF: 3.7 Hz."""
    frequency = np.array([3.0, 3.5, 4.0, 4.5, 12.0, 13.0, 14.0, 15.0])
    drives = demonstration(8)
    motion.enable(drives, mode="pv")
    p = sweep_axis(drives, 1, frequency, 1.0, 4.0, 10_000)
    own = p[I_REF] / p[ERROR_V] * p[OMEGA_TRUE] / p[I_Q]
    assert crossover(frequency[None, 4:], own[None, 4:])[0] == pytest.approx(14.0, rel=0.1)
    whole = p[OMEGA] / p[ERROR_V]
    assert crossover(frequency[None, :4], whole[None, :4])[0] == pytest.approx(3.7, abs=0.2)


def test_makers_position_gain_gives_12_7_hz():
    """Own loop, by the lag at constant speed: k_v = v / error."""
    drives = demonstration()
    motion.enable(drives, mode="pp")
    drives.write("Profile velocity", 500_000)
    drives.write("Profile acceleration", 500_000)
    motion.start_move(drives, 3_000_000)
    drives.advance(4.0)
    trace = drives.record([0x606C, (0x2043, 2)], duration=0.5)
    assert gain_from_lag(trace)[0] / TWO_PI == pytest.approx(12.7, rel=0.02)


@pytest.mark.parametrize("ideal", [True, False])
def test_makers_gains_give_a_stable_axis(ideal):
    """A step of velocity and a move settle and stay: no oscillation is left after two seconds."""
    drives = demonstration(ideal=ideal)
    motion.enable(drives, mode="pv")
    drives.write("Target velocity", 1_000_000)
    drives.advance(2.0)
    trace = drives.record([0x606C], duration=0.5)
    assert np.mean(trace[0x606C]) == pytest.approx(1_000_000, rel=0.005)
    assert np.ptp(trace[0x606C]) < 0.1 * 1_000_000  # the encoder's noise and cogging, no more
    drives.write("Target velocity", 0)
    drives.advance(1.0)
    motion.select_mode(drives, "pp")
    start = int(drives.read("Position actual value")[0])
    motion.start_move(drives, start + 200_000)
    drives.advance(3.0)
    trace = drives.record([0x6064], duration=0.5)
    assert np.mean(trace[0x6064]) == pytest.approx(start + 200_000, abs=1500)
    assert np.ptp(trace[0x6064]) < 1500


def test_gains_by_bandwidths_give_the_velocity_bandwidth_asked_for_on_the_default_motor():
    motor = MOTORS["qbl4208"]
    gains = chip_gains(
        find_device("tmcm1636"), motor, 3.0 * motor.inertia, current_hz=1000.0, velocity_hz=60.0, position_hz=6.0
    )
    frequency = 60.0 * np.array([0.75, 0.85, 1.0, 1.1, 1.25, 1.5])
    drives = EmulatedDrives(
        load="inertia", num_machines=6, ideal=True, num_threads=1,
        parameters={**FREE, "load.inertia": 2.0 * motor.inertia},
    )  # fmt: skip
    for name, value in zip((TORQUE_P, TORQUE_I, VELOCITY_P, VELOCITY_I, POSITION_P), gains, strict=True):
        drives.write(name, value)
    motion.enable(drives, mode="pv")
    p = sweep_axis(drives, 1, frequency, 1.0, 0.8, 2000)
    assert crossover(frequency[None], (p[OMEGA] / p[ERROR_V])[None])[0] == pytest.approx(60.0, rel=0.1)


# --- compiled code ------------------------------------------------------------------------------------------------
# Eight lanes are one vector register or a few: a stage that lost its vector instructions costs four times as much.
def angle_stage(drive, rates):
    measure_angle(drive, rates.tick)


def current_stage(drive, rates):
    measure_currents(drive)


def current_loop_stage(drive, rates):
    current_loop(drive)


def winding_stage(drive, rates):
    power_stage(drive)
    convert_energy(drive, rates.tick, 0.6)


def motion_stage(drive, rates):
    measure_motion(drive, rates.window)


def motion_loops_stage(drive, rates):
    motion_loops(drive)


def refresh_stage(drive, rates):
    refresh_winding(drive, rates.tick, rates.window)


# Packed and scalar double multiplications, additions, subtractions and their fused forms.
INSTRUCTIONS = {
    "x86": (r"\bv?(?:mul|add|sub)pd\b|\bvfn?m(?:add|sub)\d+pd\b", r"\bv?(?:mul|add|sub)sd\b|\bvfn?m(?:add|sub)\d+sd\b"),
    "arm": (r"\bf(?:mul|add|sub|mla|mls)(?:\.2d\b|\s+v\d+\.2d)", r"\bf(?:n?mul|add|sub|n?madd|n?msub)\s+d\d+"),
}


def count_arithmetic(kernel, records, rates):
    """Return packed and scalar instructions of a kernel compiled for a block of records and the rates."""
    architecture = {"x86_64": "x86", "AMD64": "x86", "aarch64": "arm", "arm64": "arm"}.get(platform.machine())
    if architecture is None:
        pytest.skip(f"no table of vector instructions for {platform.machine()}")
    signature = (typeof(records[0]), typeof(rates))
    kernel.compile(signature)
    code = kernel.inspect_asm(kernel.signatures[-1] if signature not in kernel.signatures else signature)
    return tuple(len(re.findall(pattern, code)) for pattern in INSTRUCTIONS[architecture])


@pytest.mark.every(7)
@pytest.mark.parametrize(
    ("stage", "least"),
    [
        (angle_stage, 20), (current_stage, 30), (current_loop_stage, 15), (winding_stage, 40), (motion_stage, 20),
        (motion_loops_stage, 5), (refresh_stage, 100),
    ],
)  # fmt: skip
def test_compiled_stages_hold_packed_arithmetic(stage, least):
    kernel = njit(**OPTIONS)(stage)
    packed, scalar = count_arithmetic(kernel, FIRMWARE.layout.new_records(LANES), rates_of(find_device("tmcm1636"), 1))
    assert packed >= least
    assert packed > 10 * scalar


@pytest.mark.slow
def test_compiled_window_of_all_stages_together_holds_packed_arithmetic():
    kernel = njit(**OPTIONS)(lambda drive, rates: window(drive, rates))  # a stage alone is intermediate code
    packed, scalar = count_arithmetic(kernel, FIRMWARE.layout.new_records(LANES), rates_of(find_device("tmcm1636"), 1))
    assert packed >= 200
    assert packed > 10 * scalar


def test_code_that_cannot_be_packed_is_counted_as_scalar():
    @njit(**OPTIONS)
    def chain(drive, rates):
        for lane in range(1, LANES):
            drive.i_d[lane] = drive.i_d[lane - 1] * drive.i_q[lane] + rates.tick

    packed, scalar = count_arithmetic(chain, FIRMWARE.layout.new_records(LANES), rates_of(find_device("tmcm1636"), 1))
    assert scalar > packed
