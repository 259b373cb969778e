"""The linear model of the cascade: closed forms, a simulation tick by tick, and the emulator itself."""

import dataclasses
import math

import numpy as np
import pytest
from rigs.chip_gains import Gains, chip_gains
from rigs.known_machines import true_plant
from scipy.linalg import expm

from drive_env import EmulatedDrives, motion
from drive_env.devices import find_device
from drive_env.devices.gains import gains_in_si
from drive_env.drives.raw_gains import write_gains
from drive_env.emulator.loop_trace import trace_loops
from drive_env.loops.linear_model import (
    Controllers,
    Plant,
    controllers,
    current_open_loop,
    mean_velocity,
    outer_loop,
    position_open_loop,
    velocity_filter_response,
    velocity_open_loop,
    velocity_plant,
)
from drive_env.loops.sampled import exponential
from drive_env.motors import find_motor
from tuning.estimate import Estimate, refused
from tuning.identify.identified_axis import Identification

DEVICE, MOTOR = find_device("tmcm1636"), find_motor("qbl4208")
RIGID = Plant.from_data_sheet(DEVICE, MOTOR, 24.0, 1.5e-5)
ELASTIC = Plant.from_data_sheet(DEVICE, MOTOR, 24.0, 1.5e-5, anti_resonance=80.0, resonance=140.0, damping=0.02)
GAINS = chip_gains(DEVICE, MOTOR, RIGID.inertia, current_hz=1000.0, velocity_hz=30.0, position_hz=5.0, supply=24.0)
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
        gains = chip_gains(
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


# --- by hand ----------------------------------------------------------------------------------------------------------
def test_a_position_loop_around_a_known_velocity_loop_is_the_models_where_that_is():
    f = np.array([1.0, 20.0, 150.0, 900.0])
    later = dataclasses.replace(ELASTIC, delay=ELASTIC.delay + 3e-4)
    for plant in (RIGID, ELASTIC, later):
        velocity = velocity_open_loop(DEVICE, plant, GAINS, f)
        np.testing.assert_allclose(
            outer_loop(DEVICE, plant, GAINS, f, velocity), position_open_loop(DEVICE, plant, GAINS, f), rtol=1e-9
        )
    slow = outer_loop(DEVICE, RIGID, GAINS, f[:1], np.array([1e9 + 0j]))  # as fast as can be: an integrator of its gain
    assert np.abs(slow[0]) == pytest.approx(5.0, rel=1e-2)


def test_regulators_are_an_integrator_at_low_and_their_p_at_high_frequencies():
    """P (1 + I / (1 - 1/z)): at z = -1 it is P (1 + I / 2), near z = 1 it is P I / (j w)."""
    made = Controllers(2.0, 0.1, 3.0, 0.2, 4.0)
    z = np.array([-1.0 + 0j, np.exp(1e-4j)])
    np.testing.assert_allclose(made.current(z), [2.0 * 1.05, 2.0 * 0.1 / 1e-4j], rtol=2e-3)
    np.testing.assert_allclose(made.velocity(z), [3.0 * 1.1, 3.0 * 0.2 / 1e-4j], rtol=2e-3)


def test_raw_gains_are_regulators_of_the_cascade():
    found = controllers(DEVICE, GAINS)
    si = gains_in_si(DEVICE, 24.0, GAINS)
    assert found.velocity_p == pytest.approx(si.velocity_p) and found.position == pytest.approx(TWO_PI * 5.0, rel=0.01)
    # The sample time over the integration time is the share of P e that is added in each.
    assert found.velocity_i == pytest.approx(1.0 / DEVICE.velocity_rate / si.velocity_integration)


@pytest.mark.parametrize("corner", [150.0, 400.0])
def test_the_velocity_filter_is_of_second_order_with_the_delay_that_an_axis_has_besides(corner):
    plant = dataclasses.replace(RIGID, velocity_filter=corner, delay=RIGID.delay + 5e-4)
    f = np.array([1e-6, corner, 2499.999])
    found = velocity_filter_response(DEVICE, plant, f)
    assert found[0] == pytest.approx(1.0) and abs(found[1]) == pytest.approx(math.sqrt(0.5), rel=0.02)
    assert abs(found[2]) < 1e-6
    alone = velocity_filter_response(DEVICE, dataclasses.replace(plant, delay=RIGID.delay), f)
    np.testing.assert_allclose(found[1] / alone[1], np.exp(-1j * TWO_PI * corner * 5e-4))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({}, None),
        ({"R": math.inf}, "R must be above 0 and finite, not inf"),
        ({"L": 0.0}, "L must be above 0 and finite, not 0"),
        ({"supply": -1.0}, "supply must be above 0 and finite, not -1"),
        ({"torque_constant": math.nan}, "torque_constant must be above 0 and finite, not nan"),
        ({"velocity_filter": 0.0}, "velocity_filter must be above 0"),
        ({"anti_resonance": 80.0, "resonance": 80.0}, "the anti-resonance, 80 Hz, must lie above 0 and below the res"),
        ({"anti_resonance": 0.0, "resonance": 80.0}, "the anti-resonance, 0 Hz, must lie above 0"),
        ({"anti_resonance": -1.0, "resonance": 80.0}, "must lie above 0"),
        ({"anti_resonance": 80.0}, None),
        ({"resonance": 80.0}, None),
    ],
)
def test_what_an_axis_can_be(fields, message):
    if message is None:
        plant = dataclasses.replace(RIGID, **fields)
        assert not plant.is_elastic and plant.rotor_inertia == RIGID.inertia
        return
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(RIGID, **fields)


def test_what_an_axis_is_unless_it_is_known_better():
    plant = Plant(1.0, 1e-3, 24.0, 0.1, 1e-5)
    assert (plant.viscous, plant.anti_resonance, plant.resonance, plant.damping) == (0.0, math.inf, math.inf, 0.02)
    assert (plant.delay, plant.velocity_filter, plant.counts) == (200e-6, 400.0, 4096) and math.isnan(
        plant.emf_constant
    )
    assert ELASTIC.rotor_inertia == pytest.approx(1.5e-5 * (80.0 / 140.0) ** 2)
    assert (RIGID.R, RIGID.L, RIGID.torque_constant) == (MOTOR.R_s, MOTOR.L_q, MOTOR.torque_constant)
    assert RIGID.emf_constant == MOTOR.n_p * MOTOR.psi_m
    # Without one it is that of a PMSM: two thirds of the torque constant.
    f = np.array([3.0, 50.0])
    own = dataclasses.replace(RIGID, emf_constant=RIGID.torque_constant / 1.5)
    none = dataclasses.replace(RIGID, emf_constant=math.nan)
    np.testing.assert_allclose(mean_velocity(DEVICE, none, GAINS, f), mean_velocity(DEVICE, own, GAINS, f))


def test_what_was_identified_counts():
    found = estimates(inertia=2e-5, inductance=3e-4, loop_delay=3e-4, velocity_filter=250.0, damping=0.07, viscous=-1.0,
                      anti_resonance=70.0)  # fmt: skip
    plant = Plant.from_identification(DEVICE, MOTOR, 30.0, found)
    assert (plant.supply, plant.L, plant.delay, plant.velocity_filter, plant.damping) == (30.0, 3e-4, 3e-4, 250.0, 0.07)
    assert plant.viscous == 0.0 and not plant.is_elastic and plant.anti_resonance == math.inf  # half a pair is none
    with pytest.raises(ValueError, match="the axis has no identified inertia: it was not measured"):
        Plant.from_identification(DEVICE, MOTOR, 24.0, estimates(resistance=0.4))


@pytest.mark.parametrize("loop", [current_open_loop, velocity_open_loop, position_open_loop, velocity_plant])
def test_a_response_has_frequencies_up_to_half_its_loops_rate(loop):
    rate = DEVICE.current_rate if loop is current_open_loop else DEVICE.velocity_rate
    assert np.isfinite(loop(DEVICE, RIGID, GAINS, [1e-3, 0.499 * rate])).all()
    assert loop(DEVICE, RIGID, GAINS, []).shape == (0,)
    for f in ([0.5 * rate], [-1.0], [0.0]):
        with pytest.raises(ValueError, match=f"above 0 and below {0.5 * rate:g} Hz"):
            loop(DEVICE, RIGID, GAINS, f)


def test_what_is_handed_out_to_every_caller_cannot_be_changed():
    found = mean_velocity(DEVICE, RIGID, GAINS, np.array([10.0]))
    with pytest.raises(ValueError, match="read-only"):
        found[0] = 0.0


@pytest.mark.parametrize("size", [0.0, 0.49, 0.5, 0.51, 1.0, 2.0, 31.0])
def test_the_exponential_of_a_diagonal_is_that_of_its_entries(size):
    assert exponential(np.diag([size, -size])) == pytest.approx(np.diag([math.exp(size), math.exp(-size)]), rel=1e-13)
    turn = exponential(np.array([[0.0, -size], [size, 0.0]]))
    assert turn == pytest.approx(
        np.array([[math.cos(size), -math.sin(size)], [math.sin(size), math.cos(size)]]), abs=1e-12
    )
