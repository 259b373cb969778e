"""The linear model of the cascade: closed forms, a simulation tick by tick, and the emulator itself."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.linalg import expm

from drive_env import EmulatedDrives, motion
from drive_env.devices import find_device
from drive_env.emulator.loop_trace import trace_loops
from drive_env.gains import Gains, gains_from_bandwidths, write_gains
from drive_env.motors import find_motor
from tuning.identify.estimate import Estimate, Identification, refused
from tuning.identify.true_plant import true_plant
from tuning.response.linear_model import (
    Plant,
    current_open_loop,
    exponential,
    mean_velocity,
    position_open_loop,
    velocity_open_loop,
    velocity_plant,
)

DEVICE, MOTOR = find_device("tmcm1636"), find_motor("qbl4208")
RIGID = Plant.from_data_sheet(DEVICE, MOTOR, 24.0, 1.5e-5)
ELASTIC = Plant.from_data_sheet(DEVICE, MOTOR, 24.0, 1.5e-5, anti_resonance=80.0, resonance=140.0, damping=0.02)
GAINS = gains_from_bandwidths(
    DEVICE, MOTOR, RIGID.inertia, current_hz=1000.0, velocity_hz=30.0, position_hz=5.0, supply=24.0
)
TWO_PI = 2.0 * math.pi


def decibels(ratio):
    return 20.0 * np.log10(np.abs(ratio))


# --- closed forms -----------------------------------------------------------------------------------------------------
def test_the_current_loop_crosses_over_at_its_bandwidth():
    f = np.geomspace(100.0, 5000.0, 4000)
    assert f[np.argmin(np.abs(np.abs(current_open_loop(DEVICE, RIGID, GAINS, f)) - 1.0))] == pytest.approx(
        1000, rel=0.03
    )


def test_at_low_frequencies_a_rotor_is_an_integrator():
    f = np.array([10.0, 20.0])
    # The back-EMF grows with what the current did; the regulator's integral part, here R w_c, lags behind it.
    lag = RIGID.torque_constant * RIGID.emf_constant / RIGID.inertia / (RIGID.R * TWO_PI * 1000.0)
    expected = RIGID.torque_constant / (RIGID.inertia * TWO_PI * 1j * f) / (1.0 + lag)
    assert velocity_plant(DEVICE, RIGID, GAINS, f) == pytest.approx(expected, rel=0.12)  # the filter's lag
    assert np.abs(velocity_plant(DEVICE, RIGID, GAINS, f)) == pytest.approx(np.abs(expected), rel=5e-3)


def test_a_load_on_a_spring_leaves_the_rotor_alone_above_its_resonance():
    f = np.array([5.0, 2000.0])
    rotor = Plant.from_data_sheet(DEVICE, MOTOR, 24.0, 1.5e-5 * (80.0 / 140.0) ** 2)
    seen = np.abs(velocity_plant(DEVICE, ELASTIC, GAINS, f))
    assert seen[0] == pytest.approx(np.abs(velocity_plant(DEVICE, RIGID, GAINS, f[:1]))[0], rel=0.01)
    assert seen[1] == pytest.approx(np.abs(velocity_plant(DEVICE, rotor, GAINS, f[1:]))[0], rel=0.01)


def test_anti_resonance_and_resonance_lie_where_they_were_put():
    f = np.arange(60.0, 180.0, 0.1)
    # A back-EMF would damp the resonance as well.
    plant = dataclasses.replace(ELASTIC, emf_constant=1e-9)
    swing = np.abs(mean_velocity(DEVICE, plant, GAINS, f)) * f
    assert f[np.argmin(swing)] == pytest.approx(80.0, abs=0.3)
    assert f[np.argmax(swing)] == pytest.approx(140.0, rel=0.01)
    # Half power at f_r (1 +- damping).
    wide = f[(f > 120.0) & (swing > swing.max() / math.sqrt(2.0))]
    assert (wide[-1] - wide[0]) / 140.0 / 2.0 == pytest.approx(0.02, rel=0.2)


def test_the_position_loop_is_an_integrator_of_its_gain():
    f = np.array([0.5])
    assert position_open_loop(DEVICE, RIGID, GAINS, f) == pytest.approx(5.0 / (1j * f), rel=0.03)


def test_more_delay_turns_the_phase_and_nothing_else():
    f = np.array([50.0, 200.0])
    later = Plant.from_data_sheet(DEVICE, MOTOR, 24.0, 1.5e-5, delay=RIGID.delay + 1e-3)
    ratio = velocity_open_loop(DEVICE, later, GAINS, f) / velocity_open_loop(DEVICE, RIGID, GAINS, f)
    assert ratio == pytest.approx(np.exp(-1j * TWO_PI * f * 1e-3), rel=1e-9)


@pytest.mark.parametrize("size", [1e-8, 0.3, 5.0, 60.0])
def test_the_exponential_is_scipys(size):
    X = np.random.default_rng(0).normal(size=(5, 5)) * size / 5.0
    assert exponential(X) == pytest.approx(expm(X), rel=1e-9, abs=1e-12 * np.abs(expm(X)).max())


# --- a second implementation: the firmware's equations, tick by tick --------------------------------------------------
def simulate(plant, gains, current):
    """Return rotor angles at the beginning of each window, for demanded currents held for a window each."""
    k, supply = 1.0 / (256.0 * DEVICE.current_full_scale), plant.supply
    P, share = gains.torque_p * k, gains.torque_i / 65536.0
    J = plant.inertia
    J_r = J * (plant.anti_resonance / plant.resonance) ** 2
    stiffness = (J - J_r) * (TWO_PI * plant.anti_resonance) ** 2
    c = 2.0 * plant.damping * stiffness / (TWO_PI * plant.resonance)
    K, E = plant.torque_constant, plant.emf_constant
    # Current, rotor angle and speed, load angle and speed; then the voltage.
    A = np.zeros((6, 6))
    A[0, [0, 2, 5]] = -plant.R / plant.L, -E / plant.L, 1.0 / plant.L
    A[1, 2] = A[3, 4] = 1.0
    A[2, :5] = K / J_r, -stiffness / J_r, -(c + plant.viscous) / J_r, stiffness / J_r, c / J_r
    A[4, 1:5] = np.array([stiffness, c, -stiffness, -c]) / (J - J_r)
    step = expm(A / DEVICE.current_rate)
    state, integral, pending, angles = np.zeros(6), 0.0, 0.0, []
    for demanded in current:
        angles.append(state[1])
        for _ in range(5):
            error = demanded - state[0]
            integral += P * share * error
            state[5], pending = pending, supply * (P * error + integral)
            state = step @ state
    return np.array(angles)


def test_the_drive_s_equations_tick_by_tick_give_the_same_response():
    n, rng = 500, np.random.default_rng(1)
    current = np.tile(rng.normal(size=n), 30)  # 10 Hz apart; the resonance has died away in the last period
    current -= current.mean()
    damped = Plant.from_data_sheet(
        DEVICE, MOTOR, 24.0, 1.5e-5, anti_resonance=80.0, resonance=140.0, damping=0.1, viscous=1e-4
    )
    angle = simulate(damped, Gains(*GAINS), current)
    velocity = np.diff(angle, prepend=0.0)[-n:] * DEVICE.velocity_rate
    bins = np.array([1, 3, 8, 14, 20, 50, 120, 240])
    seen = (np.fft.rfft(velocity) / np.fft.rfft(current[-n:]))[bins]
    assert mean_velocity(DEVICE, damped, GAINS, bins * 10.0) == pytest.approx(seen, rel=1e-6)


# --- the emulator -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("load", ["inertia", "two_mass"])
def test_a_machine_without_faults_has_the_loop_that_the_model_computes(load):
    with EmulatedDrives(
        load=load, ideal=True, friction="none", parameters={"motor.encoder_interpolation": 65536.0}
    ) as drives:
        plant = true_plant(drives)
        gains = gains_from_bandwidths(
            drives.device, drives.motor, plant.inertia, current_hz=1000.0, velocity_hz=20.0, position_hz=5.0
        )
        write_gains(drives, np.array([gains]))
        motion.enable(drives, mode="csv")
        n = 200
        spectrum = np.zeros(n // 2 + 1, complex)
        spectrum[1:80] = np.exp(1j * TWO_PI * np.random.default_rng(0).random(79))
        wave = np.fft.irfft(spectrum, n)
        played = np.rint(np.tile(wave / wave.std() * 2.0, 8) * 65536.0 / TWO_PI).astype(int)
        trace = trace_loops(drives, ["velocity_demand", "omega_meas"], len(played) * 1e-3, {0x60FF: played})
    demand, answer = (trace.signals[name][-5 * n :, 0] for name in ("velocity_demand", "omega_meas"))
    R, Y = np.fft.rfft(demand), np.fft.rfft(answer)
    bins = np.array([2, 4, 6, 10, 20, 30, 40, 60, 79])
    ratio = (Y / (R - Y))[bins] / velocity_open_loop(drives.device, plant, gains, bins * 5.0)
    # The emulator's angle is early by an eighth of h^2 times its acceleration: 0.25 dB at 400 Hz.
    assert np.abs(decibels(ratio)).max() < 0.3
    assert np.abs(np.degrees(np.angle(ratio))).max() < 1.0


def test_the_true_plant_of_a_two_mass_machine_is_what_its_parameters_say():
    values = {"load.inertia": 2e-5, "load.stiffness": 3.0, "load.damping": 1e-4, "motor.inertia": 5e-6}
    with EmulatedDrives(load="two_mass", parameters=values) as drives:
        plant = true_plant(drives)
    hub = 1e-9  # of the MJCF
    J_r = 5e-6 + hub
    assert plant.inertia == pytest.approx(J_r + 2e-5)
    assert plant.anti_resonance == pytest.approx(math.sqrt(3.0 / 2e-5) / TWO_PI, rel=1e-6)
    resonance = math.sqrt(3.0 * (1.0 / 2e-5 + 1.0 / J_r))
    assert plant.resonance == pytest.approx(resonance / TWO_PI, rel=1e-6)
    assert plant.damping == pytest.approx(1e-4 * resonance / 3.0 / 2.0, rel=0.05)  # and the bearings' viscous friction
    assert plant.rotor_inertia == pytest.approx(J_r, rel=1e-3)


@pytest.mark.parametrize(("load", "message"), [("gantry", "couples 2 axes")])
def test_a_machine_with_several_axes_has_no_such_plant(load, message):
    with EmulatedDrives(load=load) as drives, pytest.raises(ValueError, match=message):
        true_plant(drives)


# --- what is identified -----------------------------------------------------------------------------------------------
def estimates(**values):
    return Identification({name: Estimate(value, value, value, "") for name, value in values.items()}, 1.0)


def test_what_was_refused_is_taken_from_the_data_sheet():
    found = estimates(inertia=2e-5, resistance=0.4, viscous=1e-3)
    found.estimates["resonance"] = refused("Hz", "no resonance between")
    plant = Plant.from_identification(DEVICE, MOTOR, 24.0, found)
    assert (plant.inertia, plant.R, plant.L) == (2e-5, 0.4, MOTOR.L_q)
    assert plant.viscous == pytest.approx(1e-3 * MOTOR.torque_constant)
    assert not plant.is_elastic
    assert (plant.delay, plant.velocity_filter, plant.counts) == (1.0 / 5000.0, 400.0, 4096)


def test_an_identified_pair_makes_an_elastic_plant():
    plant = Plant.from_identification(
        DEVICE, MOTOR, 24.0, estimates(inertia=2e-5, anti_resonance=70.0, resonance=130.0)
    )
    assert (plant.anti_resonance, plant.resonance) == (70.0, 130.0)


def test_without_an_inertia_there_is_no_plant_and_the_reason_is_told():
    refusal = Identification({"inertia": refused("kg*m^2", "the travel is too short")}, 1.0)
    with pytest.raises(ValueError, match=r"no identified inertia: the travel is too short"):
        Plant.from_identification(DEVICE, MOTOR, 24.0, refusal)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"inertia": 0.0}, "inertia must be above 0"),
        ({"inertia": 1e-5, "anti_resonance": 140.0, "resonance": 80.0}, "must lie above 0 and below the resonance"),
    ],
)
def test_a_plant_that_cannot_be_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        Plant.from_data_sheet(DEVICE, MOTOR, 24.0, **fields)


@pytest.mark.parametrize("f", [[0.0, 10.0], [2500.0], [[10.0]]])
def test_frequencies_lie_below_half_the_loops_rate(f):
    with pytest.raises(ValueError, match="below 2500 Hz, half the loop's rate"):
        velocity_open_loop(DEVICE, RIGID, GAINS, f)
