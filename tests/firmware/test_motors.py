"""The motors' rows against each other and against their classes; the presets against the gain scale; the DC motor."""

import itertools
import math
import re

import numpy as np
import pytest
from rigs.chip_gains import chip_gains
from rigs.tables import every_row

from drive_env import EmulatedDrives, motion
from drive_env.devices import find_device
from drive_env.devices.commissioning import preset as rule
from drive_env.firmware.record import get_lanes, set_lanes
from drive_env.motors import find_motor
from mechanics.reading.untrusted import read_toml

DEVICE = find_device("tmcm1636")
MOTORS = DEVICE.motors  # steppers: test_stepper_motors.py
NAMES = sorted(MOTORS)
INC = 65536.0 / (2.0 * math.pi)  # increments per rad
TICK = 1.0 / 25_000.0  # s


@pytest.fixture(params=NAMES)
def motor(request):
    return MOTORS[request.param]


def dc(motor):
    return motor.kind == "dc"


def largest_voltage(motor):
    """Return the largest voltage of the winding [V]: the supply, or the radius of the voltage circle."""
    return motor.voltage if dc(motor) else motor.voltage / math.sqrt(3.0)


def torque_per_ampere(motor):
    """Return torque per ampere of peak i_q, and by power balance the back-EMF's share of it."""
    return motor.psi_m if dc(motor) else 1.5 * motor.n_p * motor.psi_m


# --- the rows -----------------------------------------------------------------------------------------------------
def test_there_are_motors_from_20_w_to_1_kw_with_and_without_brushes():
    powers = {name: row.rated_torque * row.rated_speed for name, row in MOTORS.items()}
    assert len(MOTORS) >= 12
    assert min(powers.values()) <= 20.0
    assert max(powers.values()) == pytest.approx(1000.0, rel=0.01)
    assert powers["class_20w"] == pytest.approx(20.0, rel=0.01)
    assert sum(row.kind == "dc" for row in MOTORS.values()) >= 3
    # No gap of more than a factor three from one power to the next.
    ordered = sorted(powers.values())
    assert max(b / a for a, b in itertools.pairwise(ordered)) < 3.0


@every_row("motor", MOTORS.values())
def test_names_are_plain_and_sources_tell_where_numbers_are_from(motor):
    assert re.fullmatch(r"[a-z0-9_]+", motor.name)
    assert find_motor(motor.name) is motor
    given = dict(motor.sources)
    assert {"inertia_kg_m2", "rated_torque_nm", "voltage_v"} <= set(given)
    assert all(len(text) > 10 for text in given.values())
    assert motor.kind in ("pmsm", "dc")


@every_row("motor", MOTORS.values())
def test_rated_power_is_that_of_the_class_in_the_title(motor):
    watts = float(re.search(r"([0-9]+) W$", motor.title)[1])
    volts = float(re.search(r"([0-9]+) V,", motor.title)[1])
    # Makers round the class up to what the motor gives at its best: down to 0.7, up to 1.15.
    assert 0.7 * watts <= motor.rated_torque * motor.rated_speed <= 1.15 * watts
    assert motor.voltage == volts


@every_row("motor", MOTORS.values())
def test_rated_torque_is_torque_constant_times_rated_current(motor):
    assert motor.torque_constant == pytest.approx(torque_per_ampere(motor), rel=1e-12)
    assert motor.rated_torque == pytest.approx(torque_per_ampere(motor) * motor.rated_current, rel=0.05)


@every_row("motor", MOTORS.values())
def test_no_load_speed_lies_above_the_rated_speed(motor):
    no_load = largest_voltage(motor) / (motor.n_p * motor.psi_m)
    assert no_load >= 1.05 * motor.rated_speed
    assert no_load <= 2.5 * motor.rated_speed  # a motor is wound for its speed


@every_row("motor", MOTORS.values())
def test_the_supply_suffices_for_the_rated_point(motor):
    """The winding's voltage at rated speed and current, u = R i + w psi along q and w L i along d."""
    omega_e = motor.n_p * motor.rated_speed
    u_q = motor.R_s * motor.rated_current + omega_e * motor.psi_m
    u_d = 0.0 if dc(motor) else omega_e * motor.L_q * motor.rated_current
    assert math.hypot(u_d, u_q) <= largest_voltage(motor)


@every_row("motor", MOTORS.values())
def test_time_constants_are_those_of_servo_motors(motor):
    assert 1e-4 <= motor.L_q / motor.R_s <= 1e-2
    assert motor.L_d == motor.L_q  # surface magnets, all of them
    k = torque_per_ampere(motor)
    back_emf = motor.n_p * motor.psi_m  # V per rad/s
    assert 4e-4 <= motor.R_s * motor.inertia / (k * back_emf) <= 2e-2
    # From standstill to rated speed with the rated torque.
    assert 5e-3 <= motor.inertia * motor.rated_speed / motor.rated_torque <= 0.1


@every_row("motor", MOTORS.values())
def test_friction_and_cogging_are_small_against_the_rated_torque(motor):
    drag = motor.coulomb + motor.viscous * motor.rated_speed
    assert 0.0 < drag < 0.12 * motor.rated_torque
    assert 0.0 <= motor.cogging_torque < 0.03 * motor.rated_torque
    if not dc(motor):
        # Cogging repeats with the poles: its order is a multiple of their number.
        assert motor.cogging_order % (2 * motor.n_p) == 0


@every_row("motor", MOTORS.values())
def test_encoders_fit_the_object_and_the_drive(motor):
    assert 1000 <= motor.encoder_counts <= 65535  # 2080h:02 is unsigned 16 bit


@every_row("motor", MOTORS.values())
def test_the_rated_current_warms_the_winding_by_80_k(motor):
    phases = 1.0 if dc(motor) else 1.5
    hot = motor.R_s * (1.0 + 0.00393 * 80.0)
    loss = phases * hot * motor.rated_current**2
    assert loss * motor.thermal_resistance == pytest.approx(80.0, rel=1e-12)
    assert 60.0 <= motor.thermal_time <= 3600.0


@pytest.mark.parametrize(
    ("name", "k_t", "no_load_rpm"),
    [
        ("ec_i_40", 0.0315, 10_700),  # catalogue: torque per ampere between two terminals, speed without load
        ("ec_60_flat", 0.0525, 4300),
        ("re_40", 0.0603, 7590),
        ("re_65", 0.123, 3670),
        ("faulhaber_3863", 0.0398, 5800),
    ],
)
def test_catalogue_values_between_terminals_give_the_catalogues_no_load_speed(name, k_t, no_load_rpm):
    row = MOTORS[name]
    assert row.n_p * row.psi_m == pytest.approx(k_t / (1.0 if dc(row) else math.sqrt(3.0)), rel=1e-9)
    omega = largest_voltage(row) / (row.n_p * row.psi_m)
    assert omega == pytest.approx(no_load_rpm * math.pi / 30.0, rel=0.025)


def test_the_qube_servo_3_row_is_that_of_its_manual():
    row = MOTORS["qube_servo_3"]
    assert (row.R_s, row.L_q, row.psi_m, row.encoder_counts) == (7.5, 1.15e-3, 0.0422, 2048)
    assert row.inertia == pytest.approx(1.4e-6 + 0.6e-6)  # rotor and hub
    assert (row.kind, row.n_p, row.voltage) == ("dc", 1, 18.0)


@pytest.mark.parametrize(
    ("name", "R", "L", "K_t", "J"),
    [("class_20w", 2.2, 0.45e-3, 0.022, 0.9e-6), ("class_750w", 0.05, 0.1e-3, 0.11, 1.2e-4)],
)
def test_class_rows_are_those_of_the_gain_tables_columns(name, R, L, K_t, J):
    row = MOTORS[name]
    assert (row.R_s, row.L_q, row.inertia) == (R, L, J)
    assert row.torque_constant == pytest.approx(K_t)


# --- the presets --------------------------------------------------------------------------------------------------
def test_what_is_written_is_for_a_motor_that_the_rule_serves_otherwise():
    written = sorted(path.stem for path in DEVICE.presets.glob("*.toml"))
    assert set(written) < set(NAMES)
    table = read_toml(DEVICE.presets.parent / "commissioning.toml")
    for name in written:
        assert DEVICE.preset(MOTORS[name]) != rule(DEVICE, MOTORS[name], table), f"{name}: the rule says the same"


@every_row("motor", MOTORS.values())
def test_preset_gains_are_those_of_its_bandwidths(motor):
    gains = chip_gains(DEVICE, motor, 3.0 * motor.inertia, current_hz=1000, velocity_hz=20, position_hz=5)
    objects = DEVICE.preset(motor)
    written = (
        objects["Torque Mode Settings.Torque_P"],
        objects["Torque Mode Settings.Torque_I"],
        objects["Velocity Mode Settings.P_Parameter"],
        objects["Velocity Mode Settings.I_Parameter"],
        objects["Position Mode Settings.P_Parameter"],
    )
    assert np.all(np.abs(np.subtract(written, gains)) <= 1)


@every_row("motor", MOTORS.values())
def test_preset_describes_the_motor(motor):
    objects = DEVICE.preset(motor)
    assert objects["Motor Type"] == (1 if dc(motor) else 3)
    assert objects["Commutation Mode"] == 3
    assert objects["Motor Pole Pairs"] == motor.n_p
    assert objects["ABN Encoder Settings.Encoder Steps"] == motor.encoder_counts
    assert objects["Maximum Current"] == pytest.approx(min(2000.0 * motor.rated_current, 45_000), rel=0.03)


@every_row("motor", MOTORS.values())
def test_preset_motions_are_within_the_motors_reach(motor):
    objects = DEVICE.preset(motor)
    assert 0.35 <= objects["Profile velocity"] / INC / motor.rated_speed <= 0.6
    torque = objects["Profile acceleration"] / INC * 3.0 * motor.inertia
    assert 0.3 <= torque / motor.rated_torque <= 0.7
    assert objects["Profile deceleration"] == objects["Profile acceleration"]
    assert objects["Quick stop deceleration"] == 2 * objects["Profile acceleration"]
    assert objects["Homing acceleration"] == objects["Profile acceleration"]
    assert objects["Position window"] == 200
    assert objects["Position window time"] == 2
    assert objects["Following error window"] == 655_360


# --- every motor turns --------------------------------------------------------------------------------------------
def test_motor_follows_a_velocity_step(motor):
    with EmulatedDrives(motor=motor.name, load="inertia", parameters={"load.inertia": 2.0 * motor.inertia}) as drives:
        motion.enable(drives, mode="pv")
        target = 0.3 * motor.rated_speed
        drives.write("Target velocity", round(target * INC))
        drives.advance(0.45)
        trace = drives.record([0x606C, 0x6077], 0.05)
        assert trace[0x606C].mean() / INC == pytest.approx(target, rel=0.03)
        assert drives.machine.rotor_speed[0] == pytest.approx(target, rel=0.03)
        assert drives.read("Statusword")[0] & 0x6F == 0x27
        assert drives.emergencies() == []
        # The current carries friction, of motor and load, and no more.
        drag = motor.coulomb + 2e-3 + (motor.viscous + 2e-6) * target
        assert trace[0x6077].mean() * 1e-3 == pytest.approx(
            drag / motor.torque_constant, abs=0.1 + 0.02 * motor.rated_current
        )


# --- the DC motor of the QUBE-Servo 3 -----------------------------------------------------------------------------
R, L, K, J = 7.5, 1.15e-3, 0.0422, 2.0e-6  # user manual: ohm, H, N*m/A, kg*m^2
FRICTIONLESS = {"load.inertia": 1e-10, "load.coulomb": 0.0, "load.breakaway": 0.0, "load.viscous": 0.0}


def hold_duty(drives, duty):
    """Have the current loop hold a duty: without gain its integrator stays at what it is given."""
    motion.enable(drives, mode="cst")
    drives.write("Torque Mode Settings.Torque_P", 0)
    set_lanes(drives.inside.records, "current_sum_q", np.full(drives.num_axes, duty))


@pytest.fixture
def qube():
    """The motor without friction and load on an ideal stage."""
    with EmulatedDrives(motor="qube_servo_3", load="inertia", ideal=True, parameters=FRICTIONLESS) as drives:
        yield drives


@pytest.mark.parametrize("duty", [0.5, -0.9])
def test_qube_gain_and_time_constant_are_those_of_its_data(qube, duty):
    """w / u = (1/k) / (1 + s J R/k^2 + s^2 J L/k^2); the area above a step response is the coefficient of s."""
    hold_duty(qube, duty)
    qube.advance(0.2)
    speed, turned = qube.machine.rotor_speed[0], qube.machine.rotor_angle[0]
    assert speed / (duty * 18.0) == pytest.approx(1.0 / 0.0422, rel=1e-3)  # 23.70 rad/s per V
    assert 0.2 - TICK - turned / speed == pytest.approx(2.0e-6 * 7.5 / 0.0422**2, rel=2e-3)  # 8.423 ms
    assert qube.read(0x606C)[0] / INC == pytest.approx(speed, rel=0.01)


def test_qube_step_response_is_the_second_order_closed_form(qube):
    hold_duty(qube, 0.5)
    omega, current = [], []
    for _ in range(40):
        qube.advance(0.001)
        omega.append(qube.machine.rotor_speed[0])
        current.append(qube.machine.motor_torque[0] / K)
        assert abs(get_lanes(qube.inside.records, "i_d", 1)[0]) < 1e-12  # one winding in a frame that does not turn
    t = 0.001 * np.arange(1, 41) - TICK  # the bridge gets a duty one period after it was computed
    p1, p2 = np.roots([J * L, J * R, K * K])
    u = 9.0
    exact = u / K * (1.0 + (p2 * np.exp(p1 * t) - p1 * np.exp(p2 * t)) / (p1 - p2))
    exact_current = J * u / (K * K) * p1 * p2 / (p1 - p2) * (np.exp(p1 * t) - np.exp(p2 * t))
    assert np.max(np.abs(omega - exact)) < 0.003 * u / K
    # The torque is the mean of the last tick.
    assert np.max(np.abs(current - exact_current)) < 0.01 * u / R


def test_qube_gain_and_time_constant_over_the_bus(qube):
    """A proportional current loop is a resistor: u = V P (i_ref - i), so gain V P i_ref / k, time J (R + V P)/k^2."""
    motion.enable(qube, mode="cst")
    qube.write("Torque Mode Settings.Torque_I", 0)
    qube.write("Torque Mode Settings.Torque_P", 12_800)  # 12800 / (256 * 100 A) = 0.5 of 18 V per A: 9 ohm
    qube.write("Target torque", 1000)
    qube.advance(0.4)
    assert qube.read("Statusword")[0] & 0x6F == 0x27
    speed, turned = qube.machine.rotor_speed[0], qube.machine.rotor_angle[0]
    assert speed == pytest.approx(9.0 / 0.0422, rel=0.01)
    assert 0.4 - turned / speed == pytest.approx(2.0e-6 * (7.5 + 9.0) / 0.0422**2, rel=0.01)  # 18.53 ms


@pytest.mark.parametrize("current", [300, -300])
def test_qube_current_loop_gives_torque_k_i(current):
    """A torque set-point is a torque: acceleration k i / J with no back-EMF in the way, torque k times 6077h."""
    parameters = {**FRICTIONLESS, "load.inertia": 2e-5}
    with EmulatedDrives(motor="qube_servo_3", load="inertia", ideal=True, parameters=parameters) as drives:
        motion.enable(drives, mode="cst")
        drives.write("Target torque", current)
        drives.advance(0.02)
        before = drives.machine.rotor_speed[0]
        trace = drives.record([0x6077], 0.1)
        assert trace[0x6077].mean() == pytest.approx(current, abs=6)  # current that the back-EMF's ramp holds back
        measured = drives.read(0x6077)[0] * 1e-3
        assert drives.machine.motor_torque[0] == pytest.approx(0.0422 * measured, rel=0.01)
        acceleration = (drives.machine.rotor_speed[0] - before) / 0.1
        assert acceleration == pytest.approx(0.0422 * trace[0x6077].mean() * 1e-3 / 2.2e-5, rel=0.01)


def test_a_stage_set_for_three_phases_does_not_drive_a_dc_motor():
    with EmulatedDrives(motor="qube_servo_3", load="inertia") as drives:
        drives.write("Motor Type", 3)
        motion.enable(drives, mode="cst")
        drives.write("Target torque", 500)
        drives.advance(0.03)
        assert drives.machine.motor_torque[0] == 0.0
        assert drives.machine.rotor_speed[0] == 0.0
