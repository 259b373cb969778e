"""Encoder, velocity and current measurement: what is quantised, shifted and noisy, and by how much."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import signal, stats

from drive_env import EmulatedDrives, motion
from drive_env.emulator.parameters import velocity_filter
from drive_env.firmware.record import LANES, get_lanes, set_lanes
from drive_env.firmware.servo.derived import derive
from drive_env.firmware.servo.sensors import measure_angle, measure_currents, measure_motion
from drive_env.firmware.servo.stages import FIRMWARE
from mechanics.kernels.compiled import cached

TWO_PI = 2.0 * math.pi
COUNTS = 4096
COUNT = TWO_PI / COUNTS  # rad
H = 1.0 / 5000.0  # s, velocity loop
STEP = 0.048828125  # A: 12 bit over +-100 A, 200/4096
FREE = {"load.coulomb": 0.0, "load.breakaway": 0.0, "load.viscous": 0.0}


@cached()
def run_encoder(drive, h, theta, position, velocity, angle):
    """Turn the rotor through theta, one row per period, and record what is measured."""
    derive(drive, h)
    for k in range(theta.shape[0]):
        for lane in range(LANES):
            drive.theta_m[lane] = theta[k, lane]
        measure_motion(drive, h)
        measure_angle(drive, h)
        for lane in range(LANES):
            position[k, lane] = drive.theta_meas[lane]
            velocity[k, lane] = drive.omega_meas[lane]
            angle[k, lane] = math.atan2(drive.sin_meas[lane], drive.cos_meas[lane])


@cached()
def run_adc(drive, i_d, i_q, raw, current):
    """Measure currents at the rotor's angle; raw (n, 2, 8) LSB, current (n, 3, 8) A."""
    derive(drive, 4e-5)
    for k in range(i_d.shape[0]):
        for lane in range(LANES):
            drive.i_d[lane] = i_d[k, lane]
            drive.i_q[lane] = i_q[k, lane]
        measure_currents(drive)
        for lane in range(LANES):
            for part in range(2):
                raw[k, part, lane] = drive.adc_raw[part, lane]
            for part in range(3):
                current[k, part, lane] = drive.adc_current[part, lane]


def new_sensors(**fields):
    b, a1, a2 = velocity_filter(np.full(LANES, 400.0), 5000.0)
    records = FIRMWARE.layout.new_records(LANES)
    values = {
        "encoder_counts": COUNTS, "encoder_steps": COUNTS, "pole_pairs": 4.0, "n_p": 4.0,
        "velocity_filter_b": b, "angle_source": 3.0, "adc_step": STEP, "adc_step_lsb": 16.0, **fields,
    }  # fmt: skip
    for name, value in values.items():
        set_lanes(records, name, np.broadcast_to(np.asarray(value, float), LANES))
    set_lanes(records, "velocity_filter_a", a1, part=0)
    set_lanes(records, "velocity_filter_a", a2, part=1)
    return records


def turn(records, theta):
    theta = np.ascontiguousarray(np.broadcast_to(theta if theta.ndim == 2 else theta[:, None], (len(theta), LANES)))
    position, velocity, angle = (np.empty_like(theta) for _ in range(3))
    run_encoder(records[0], H, theta, position, velocity, angle)
    return position, velocity, angle


def measure(records, i_d, i_q=0.0):
    i_d = np.ascontiguousarray(
        np.broadcast_to(i_d if np.ndim(i_d) == 2 else np.asarray(i_d)[:, None], (len(i_d), LANES))
    )
    i_q = np.ascontiguousarray(np.broadcast_to(i_q, i_d.shape))
    raw, current = np.empty((len(i_d), 2, LANES)), np.empty((len(i_d), 3, LANES))
    run_adc(records[0], i_d, i_q, raw, current)
    return raw, current


# --- encoder ------------------------------------------------------------------------------------------------------
def test_position_is_whole_counts_of_a_4096th_of_a_turn():
    theta = np.random.default_rng(0).uniform(-100.0, 100.0, 500)
    position, _, _ = turn(new_sensors(), theta)
    assert np.allclose(position[:, 0], np.floor(theta / COUNT) * COUNT, rtol=0, atol=1e-10)
    assert np.max(np.abs(position[:, 0] / COUNT - np.rint(position[:, 0] / COUNT))) < 1e-7


@pytest.mark.parametrize(("shaft", "encoder", "sign"), [(0, 0, 1), (1, 0, -1), (0, 1, -1), (1, 1, 1)])
def test_direction_of_shaft_2057h_and_of_encoder_2080h_01_each_turn_position_and_velocity_round(shaft, encoder, sign):
    theta = (np.arange(400) + 0.5) * COUNT * 3
    position, velocity, _ = turn(new_sensors(shaft_direction=shaft, encoder_direction=encoder), theta)
    assert position[-1, 0] == pytest.approx(sign * math.floor(theta[-1] / COUNT) * COUNT)
    assert velocity[-1, 0] == pytest.approx(sign * 3 * COUNT / H, rel=1e-9)


def test_direction_of_encoder_turns_the_commutation_angle_round_and_that_of_the_shaft_does_not():
    theta = np.array([0.3])
    expected = 4 * math.floor(0.3 / COUNT) * COUNT
    for shaft, encoder, sign in ((0, 0, 1), (1, 0, 1), (0, 1, -1), (1, 1, -1)):
        _, _, angle = turn(new_sensors(shaft_direction=shaft, encoder_direction=encoder), theta)
        assert angle[0, 0] == pytest.approx(sign * expected)


def test_a_wrong_number_of_encoder_steps_scales_position_and_velocity():
    """2080h:02 at its factory value of 8192 with an encoder of 4096 counts: half of everything."""
    theta = np.arange(400) * COUNT * 4
    position, velocity, _ = turn(new_sensors(encoder_steps=8192.0), theta)
    assert position[-1, 0] == pytest.approx(theta[-1] / 2)
    assert velocity[-1, 0] == pytest.approx(2 * COUNT / H, rel=1e-9)


def test_line_error_is_a_sine_once_per_turn():
    theta = np.linspace(0.0, 3 * TWO_PI, 3000)
    position, _, angle = turn(new_sensors(encoder_line_error=0.01, encoder_line_phase=0.6), theta)
    error = position[:, 0] + 0.5 * COUNT - theta  # half a count: floor
    assert np.max(np.abs(error - 0.01 * np.sin(theta + 0.6))) <= 0.5 * COUNT + 1e-12
    electrical = np.angle(np.exp(1j * (angle[:, 0] - 4 * theta)))
    assert np.max(np.abs(electrical + 2 * COUNT - 4 * 0.01 * np.sin(theta + 0.6))) <= 2 * COUNT + 1e-12


def test_an_interpolated_encoder_counts_finer():
    theta = np.random.default_rng(0).uniform(-100.0, 100.0, 500)
    position, _, _ = turn(new_sensors(encoder_counts=COUNTS * 4096.0, encoder_interpolation=4096.0), theta)
    assert np.max(np.abs(position[:, 0] - theta)) <= COUNT / 4096 * 1.001


# --- velocity -----------------------------------------------------------------------------------------------------
def second_order_low_pass(cutoff, damping=0.7, rate=5000.0):
    """Return numerator and denominator by SciPy: w^2/(s^2 + 2 D w s + w^2), bilinear, prewarped at the corner."""
    w = 2.0 * rate * math.tan(math.pi * cutoff / rate)
    return signal.bilinear([w * w], [1.0, 2.0 * damping * w, w * w], rate)


@pytest.mark.parametrize("cutoff", [150.0, 400.0, 800.0])
def test_velocity_filter_is_scipys(cutoff):
    numerator, denominator = second_order_low_pass(cutoff)
    b, a1, a2 = velocity_filter(np.array([cutoff]), 5000.0)
    assert np.allclose(numerator, [b[0], 2 * b[0], b[0]], rtol=1e-12)
    assert np.allclose(denominator, [1.0, a1[0], a2[0]], rtol=1e-12)


def test_one_count_of_4096_at_5_khz_is_73_rpm_through_the_filter():
    theta = np.where(np.arange(200) < 20, 0.5, 1.5) * COUNT
    _, velocity, _ = turn(new_sensors(), theta)
    pulse = np.zeros(200)
    pulse[20] = 73.2421875 * TWO_PI / 60  # 60 * 5000 / 4096 rpm, by hand
    assert np.allclose(velocity[:, 0], signal.lfilter(*second_order_low_pass(400.0), pulse), rtol=0, atol=1e-12)
    # What is left of a count behind the filter: 16.4 rpm at its peak.
    assert np.max(velocity[:, 0]) * 60 / TWO_PI == pytest.approx(16.4, abs=0.1)


def test_velocity_filter_measured_has_its_3_db_point_at_404_hz():
    """Damping .7: |H| = 1/(2 D) = .714 at the corner; -3.01 dB at 400 sqrt(1-2D^2+sqrt((1-2D^2)^2+1)) Hz, prewarped."""
    theta = np.where(np.arange(4096) < 1, 0.5, 1.5) * COUNT
    _, velocity, _ = turn(new_sensors(), theta)
    response = np.abs(np.fft.rfft(velocity[:, 0])) / (COUNT / H)
    frequency = np.fft.rfftfreq(4096, H)
    assert response[0] == pytest.approx(1.0, rel=1e-9)
    assert np.interp(400.0, frequency, response) == pytest.approx(1 / 1.4, rel=1e-4)
    x = 1.0 - 2.0 * 0.7**2
    analog = math.sqrt(x + math.sqrt(x * x + 1.0))
    half_power = 5000.0 / math.pi * math.atan(analog * math.tan(math.pi * 400.0 / 5000.0))
    assert half_power == pytest.approx(404.0, abs=1.0)
    assert np.interp(-math.sqrt(0.5), -response, frequency) == pytest.approx(half_power, rel=1e-3)


@pytest.mark.parametrize("rpm", [1.0, -7.3, 73.2421875, 1000.0, -5557.0])
def test_mean_velocity_at_constant_speed_is_right(rpm):
    omega = rpm * TWO_PI / 60
    n = 30_000
    theta = omega * H * np.arange(n)
    _, velocity, _ = turn(new_sensors(), theta)
    # The sum of count differences is exact within one count over the time that is averaged.
    assert np.mean(velocity[100:, 0]) == pytest.approx(omega, abs=1.5 * COUNT / ((n - 100) * H))


def test_velocity_noise_between_counts_is_there():
    """At 1.41 counts per period the raw velocity jumps between one and two counts: 73 rpm."""
    omega = 1.4142135 * COUNT / H
    _, velocity, _ = turn(new_sensors(), omega * H * np.arange(5000))
    rms = np.std(velocity[100:, 0]) * 60 / TWO_PI
    counts = np.floor(1.4142135 * np.arange(5000))
    raw = np.diff(counts, prepend=0.0) * 73.2421875
    oracle = signal.lfilter(*second_order_low_pass(400.0), raw)
    assert rms == pytest.approx(np.std(oracle[100:]), rel=1e-6)
    assert rms > 1.0


# --- current ------------------------------------------------------------------------------------------------------
def test_current_is_measured_in_steps_of_48_8_ma():
    """12 bit over +-100 A; the rotor at angle 0: phase a is i_d."""
    i = np.linspace(-5.0, 5.0, 5001)
    raw, current = measure(new_sensors(), i)
    assert np.allclose(current[:, 0, 0], np.floor(i / STEP + 0.5) * STEP, rtol=0, atol=1e-12)
    assert np.array_equal(raw[:, 0, 0], 33500 + 16 * np.floor(i / STEP + 0.5))
    assert np.max(np.abs(current[:, 0, 0] - i)) <= STEP / 2 + 1e-9


def test_phases_are_those_of_clarkes_transformation_and_sum_to_zero():
    angle = np.linspace(0.0, 6.0, LANES)
    records = new_sensors(theta_m=angle / 4, adc_step=1e-9, adc_step_lsb=1e-9 * 327.68)
    _, current = measure(records, np.array([3.0]), np.full((1, LANES), 2.0))
    for part, shift in enumerate((0.0, -TWO_PI / 3, TWO_PI / 3)):
        expected = 3.0 * np.cos(angle + shift) - 2.0 * np.sin(angle + shift)
        assert np.allclose(current[0, part], expected, rtol=0, atol=1e-8)


def test_offset_and_gain_error_of_each_phase_act_before_the_quantisation():
    records = new_sensors(adc_step=1e-6, adc_step_lsb=1e-6 * 327.68)
    for part, (offset, gain) in enumerate(((0.05, 1.02), (-0.03, 0.99))):
        set_lanes(records, "adc_offset_error", np.full(LANES, offset), part=part)
        set_lanes(records, "adc_gain", np.full(LANES, gain), part=part)
    _, current = measure(records, np.array([0.0, 4.0]))
    assert current[:, 0, 0] == pytest.approx([0.05, 4.0 * 1.02 + 0.05], abs=1e-6)
    assert current[:, 1, 0] == pytest.approx([-0.03, -2.0 * 0.99 - 0.03], abs=1e-6)
    assert current[:, 2, 0] == pytest.approx(-current[:, 0, 0] - current[:, 1, 0], abs=1e-12)


def test_measurement_saturates_at_the_ends_of_the_register():
    """Zero lies at 33500: 97.76 A upwards and 102.23 A downwards of 32768 LSB per 100 A."""
    raw, current = measure(new_sensors(), np.array([-150.0, -101.0, 97.0, 150.0, 1e6]))
    assert raw[0, 0, 0] == 0
    assert raw[3, 0, 0] == raw[4, 0, 0] == 65535
    assert current[:, 0, 0] == pytest.approx([-102.234, -101.0, 97.0, 97.763, 97.763], abs=STEP)


@pytest.fixture(scope="module")
def noise():
    """20,000 samples of 8 lanes at 0 A with .1 A of noise and an ADC of 24 bit, shape (n, 2 phases, lanes)."""
    records = new_sensors(
        adc_noise=0.1, adc_step=200.0 / 2**24, adc_step_lsb=65536.0 / 2**24, random=np.arange(1, 9) * 104729.0
    )
    return measure(records, np.zeros(20_000))[1][:, :2]


def test_noise_has_mean_zero_and_the_rms_asked_for(noise):
    n = noise.shape[0] * LANES
    for part in range(2):
        sample = noise[:, part].ravel()
        assert abs(sample.mean()) < 4 * 0.1 / math.sqrt(n)
        assert sample.std() == pytest.approx(0.1, rel=4 / math.sqrt(2 * n))


def test_noise_is_nearly_normal(noise):
    """A sum of four uniform bytes: excess kurtosis -1.2/4 = -.3, no skewness; 3.46 standard deviations at the most."""
    for part in range(2):
        sample = noise[:, part].ravel()
        assert stats.kurtosis(sample) == pytest.approx(-0.3, abs=0.03)
        assert stats.skew(sample) == pytest.approx(0.0, abs=0.025)
        assert 0.3 < np.max(np.abs(sample)) < 0.3465
        within = np.mean(np.abs(sample) < 0.1)
        assert within == pytest.approx(0.683, abs=0.02)


def test_noise_is_white_and_the_channels_and_lanes_do_not_know_each_other(noise):
    n = noise.shape[0]
    bound = 5.0 / math.sqrt(n)
    for lane in range(LANES):
        a, b = noise[:, 0, lane] / 0.1, noise[:, 1, lane] / 0.1
        for lag in range(1, 20):
            assert abs(np.mean(a[lag:] * a[:-lag])) < bound
            assert abs(np.mean(b[lag:] * b[:-lag])) < bound
            assert abs(np.mean(a[lag:] * b[:-lag])) < bound
            assert abs(np.mean(b[lag:] * a[:-lag])) < bound
        assert abs(np.mean(a * b)) < bound
        # Nor do their sizes, which a generator of linear shifts might betray.
        assert abs(np.mean((a * a - 1) * (b * b - 1))) < 2 * bound
        assert abs(np.mean(a * noise[:, 0, (lane + 1) % LANES] / 0.1)) < bound


# --- through the dictionary ---------------------------------------------------------------------------------------
def test_read_outs_of_2060h_at_rest_are_the_centre_and_the_true_offsets():
    """1 A and -.5 A of offset at 327.68 LSB per ampere."""
    drives = EmulatedDrives(
        load="inertia", ideal=True, parameters={"stage.adc_offset_a": 1.0, "stage.adc_offset_b": -0.5}
    )
    drives.advance(0.002)
    assert drives.read("ADC Configuration.ADC_I0_Raw")[0] == 33500 + round(327.68)
    assert drives.read("ADC Configuration.ADC_I1_Raw")[0] == 33500 - round(163.84)
    assert drives.read("ADC Configuration.ADC_I0")[0] == 328
    assert drives.read("ADC Configuration.ADC_I1")[0] == -164
    assert drives.read("ADC Configuration.ADC_I2")[0] == -164
    # The commissioner's remedy: the raw values at rest become the offsets.
    drives.write("ADC Configuration.ADC_I0_Offset", drives.read("ADC Configuration.ADC_I0_Raw"))
    drives.write("ADC Configuration.ADC_I1_Offset", drives.read("ADC Configuration.ADC_I1_Raw"))
    drives.advance(0.001)
    for name in ("ADC_I0", "ADC_I1", "ADC_I2"):
        assert abs(drives.read(f"ADC Configuration.{name}")[0]) <= 1


def test_the_default_adc_has_12_bit():
    with EmulatedDrives(load="inertia", num_machines=64, seed=3) as drives:
        drives.advance(0.001)
        raw = drives.read("ADC Configuration.ADC_I0_Raw") - 33500
        assert np.all(raw % 16 == 0)
        assert len(set(raw.tolist())) > 1  # half a step of noise


def currents_of(seed, first_machine=0, num_machines=2):
    with EmulatedDrives(load="inertia", num_machines=num_machines, seed=seed, first_machine=first_machine) as drives:
        return drives.record(["ADC Configuration.ADC_I0_Raw"], duration=0.05)[0x2060, 1]


def test_the_same_seed_gives_the_same_noise_and_another_machine_or_seed_another():
    first = currents_of(0)
    assert np.array_equal(first, currents_of(0))
    assert not np.array_equal(first[:, 0], first[:, 1])
    assert not np.array_equal(first, currents_of(1))
    # A machine is known by its number: machine 1 alone is machine 1 of the set.
    assert np.array_equal(first[:, 1], currents_of(0, first_machine=1, num_machines=1)[:, 0])


@pytest.mark.parametrize("offset", [-0.5, 0.0, 0.2, 0.8])
def test_commutation_offset_costs_torque_by_its_cosine(offset):
    """2 A at K_t = .0357143 N m/A, blocked rotor."""
    drives = EmulatedDrives(
        load="inertia", ideal=True, parameters={**FREE, "load.inertia": 1e3, "motor.commutation_offset": offset}
    )
    motion.enable(drives, mode="cst")
    drives.write("Target torque", 2000)
    drives.advance(0.05)
    assert drives.read("Torque actual value")[0] == pytest.approx(2000, abs=1)
    assert drives.machine.motor_torque[0] == pytest.approx(2.0 * 0.0357143 * math.cos(offset), rel=1e-3)


def test_2103h_is_the_electrical_angle_of_the_encoder():
    """65536 steps per electrical turn, four of them per revolution; the ideal machine's encoder starts aligned."""
    drives = EmulatedDrives(load="inertia", ideal=True, parameters={**FREE, "motor.commutation_offset": 0.25})
    motion.enable(drives, mode="pv")
    drives.write("Target velocity", 300_000)
    seen = []
    for _ in range(100):
        drives.advance(0.003)
        told = drives.read("Encoder Commutation Angle")[0]
        assert -32768 <= told <= 32767
        # The angle is that of the last tick, up to 40 us ago; at 4.6 Hz that is 12 steps of 65536.
        angle = 4 * drives.machine.rotor_angle[0] + 0.25 - 4 * drives.machine.rotor_speed[0] * 40e-6
        difference = np.angle(np.exp(1j * (told * TWO_PI / 65536 - angle)))
        assert abs(difference) < 1e-3
        seen.append(told)
    assert min(seen) < -20_000
    assert max(seen) > 20_000


def test_the_velocity_filter_must_lie_below_the_rate():
    drives = EmulatedDrives(load="inertia")
    with pytest.raises(ValueError, match="up to 2250 Hz, not 3000 Hz"):
        drives.machine.set("stage.velocity_filter", 3000.0)
    assert get_lanes(drives.inside.records, "velocity_filter_b", 1)[0] == pytest.approx(
        second_order_low_pass(400.0)[0][0]
    )
