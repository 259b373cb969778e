"""Inverter and winding: exact solutions against closed forms and an independent integration, motors against hand
calculation, and what the real stage loses."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from drive_env import EmulatedDrives, motion
from drive_env.firmware.record import LANES, get_lanes, set_lanes
from drive_env.firmware.servo.derived import derive
from drive_env.firmware.servo.power_stage import convert_energy, power_stage, refresh_winding
from drive_env.firmware.servo.stages import FIRMWARE
from mechanics.kernels.compiled import cached

DT = 40e-6  # s, current loop
WINDOW = 200e-6  # s, velocity loop
TICKS = 100
LOCKED = 1e30  # kg*m^2: the rotor keeps its speed

# A motor of the 24 V, 50 W class.
R, L, PSI, N_P, SUPPLY = 0.36, 0.6e-3, 5.952380952e-3, 4, 24.0


@cached()
def run_stage(drive, dt, window, duty, trace):
    """Hold duty[k] (alpha, beta per lane) in tick k; trace: i_d, i_q after, tau_m, u_dc after, theta_m before."""
    derive(drive, dt)
    refresh_winding(drive, dt, window)
    for k in range(duty.shape[0]):
        for lane in range(LANES):
            drive.sin_e[lane] = math.sin(drive.n_p[lane] * drive.theta_m[lane])
            drive.cos_e[lane] = math.cos(drive.n_p[lane] * drive.theta_m[lane])
            drive.duty_alpha[lane] = duty[k, 0, lane]
            drive.duty_beta[lane] = duty[k, 1, lane]
            trace[k, 4, lane] = drive.theta_m[lane]
        power_stage(drive)
        convert_energy(drive, dt, 0.5)
        for lane in range(LANES):
            trace[k, 0, lane] = drive.i_d[lane]
            trace[k, 1, lane] = drive.i_q[lane]
            trace[k, 2, lane] = drive.tau_m[lane]
            trace[k, 3, lane] = drive.u_dc[lane]


def new_stage(**fields):
    """Return records of 8 ideal stages that drive motors whose rotors keep their speed."""
    records = FIRMWARE.layout.new_records(LANES)
    values = {
        "R_s": R, "L_d": L, "L_q": L, "psi_m": PSI, "n_p": N_P, "supply_voltage": SUPPLY, "u_dc": SUPPLY,
        "J_rotor": LOCKED, "stage_on": 1.0, "supply_sinks": 1.0, "dc_capacitance": 1e-9, "dead_time_current": 0.3,
        **fields,
    }  # fmt: skip
    for name, value in values.items():
        set_lanes(records, name, np.broadcast_to(np.asarray(value, float), LANES))
    return records


def run(records, duty, dt=DT):
    duty = np.broadcast_to(np.asarray(duty, float), (len(duty), 2, LANES))
    trace = np.empty((len(duty), 5, LANES))
    run_stage(records[0], dt, WINDOW, np.ascontiguousarray(duty), trace)
    return trace


def turn(angle, alpha, beta):
    """Return d, q of alpha, beta."""
    return np.cos(angle) * alpha + np.sin(angle) * beta, np.cos(angle) * beta - np.sin(angle) * alpha


# --- the winding, exact -------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("saliency", [1.0, 1.7])
def test_locked_rotor_is_the_closed_form_to_1e_12_of_the_final_current(saliency):
    angles = np.linspace(0.0, 2.0, LANES)  # rad, electrical
    records = new_stage(L_q=saliency * L, theta_m=angles / N_P)
    duty = np.array([0.11, -0.07])
    trace = run(records, np.broadcast_to(duty[:, None], (TICKS, 2, LANES)))
    u_d, u_q = turn(angles, *(duty * SUPPLY))
    t = DT * np.arange(1, TICKS + 1)[:, None]
    final = np.hypot(u_d, u_q) / R
    exact_d = u_d / R * -np.expm1(-t * R / L)
    exact_q = u_q / R * -np.expm1(-t * R / (saliency * L))
    assert np.max(np.hypot(trace[:, 0] - exact_d, trace[:, 1] - exact_q) / final) <= 1e-12


# One lane each: electrical frequency [Hz], L_q / L_d. At 2.5 kHz a tick of 40 us is a tenth of a turn.
CASES = [(1000, 1.0), (1000, 1.7), (0, 1.7), (50, 1.7), (-1000, 1.7), (2500, 1.0), (2500, 1.7), (-2500, 0.6)]
NAMES = [f"{f} Hz, Lq/Ld {s}" for f, s in CASES]


def integrate(omega_e, saliency, theta_e, u_alpha_beta):
    """Return i_d, i_q at the ends of ticks, and integrals over each tick: i_d, i_q, torque, power in, copper loss.

    Independent of the code under test: flux linkages in the stator frame, du held there, d psi/dt = u - R i; torque is
    1.5 n_p (psi x i). DOP853, rtol 1e-10.
    """
    L_q = saliency * L

    def currents(t, psi):
        angle = theta_e + omega_e * t
        psi_d, psi_q = turn(angle, psi[0], psi[1])
        return angle, (psi_d - PSI) / L, psi_q / L_q

    def derivative(t, x, u):
        angle, i_d, i_q = currents(t, x)
        i_alpha, i_beta = turn(-angle, i_d, i_q)
        return [
            u[0] - R * i_alpha,
            u[1] - R * i_beta,
            i_d,
            i_q,
            1.5 * N_P * (x[0] * i_beta - x[1] * i_alpha),
            1.5 * (u[0] * i_alpha + u[1] * i_beta),
            1.5 * R * (i_d * i_d + i_q * i_q),
        ]

    psi = np.array(turn(-theta_e, PSI, 0.0))
    rows = []
    for k, u in enumerate(u_alpha_beta):
        start = [*psi, 0.0, 0.0, 0.0, 0.0, 0.0]
        solution = solve_ivp(
            derivative,
            (k * DT, (k + 1) * DT),
            start,
            "DOP853",
            rtol=1e-10,
            atol=1e-15,
            args=(u,),
            t_eval=[(k + 1) * DT],
        )
        end = solution.y[:, -1]
        psi = end[:2]
        rows.append([*currents((k + 1) * DT, psi)[1:], *end[2:]])
    return np.array(rows)


@pytest.fixture(scope="module")
def driven():
    """Run each case for 100 ticks with another voltage in each, beside its oracle."""
    omega_e = np.array([2.0 * math.pi * f for f, _ in CASES])
    saliency = np.array([s for _, s in CASES])
    theta_e = np.linspace(0.3, 5.0, LANES)
    generator = np.random.default_rng(7)
    duty = generator.uniform(-0.4, 0.4, (TICKS, 2, LANES))
    records = new_stage(L_q=saliency * L, theta_m=theta_e / N_P, omega_m=omega_e / N_P)
    trace = run(records, duty)
    oracle = [integrate(omega_e[c], saliency[c], theta_e[c], duty[:, :, c] * SUPPLY) for c in range(LANES)]
    return records, duty, trace, np.array(oracle), theta_e, omega_e, saliency


@pytest.mark.parametrize("case", range(LANES), ids=NAMES)
def test_driven_rotor_agrees_with_dop853_to_1e_9_of_the_peak_current(driven, case):
    _, _, trace, oracle, *_ = driven
    peak = np.max(np.hypot(oracle[case, :, 0], oracle[case, :, 1]))
    assert peak > 2.0
    error = np.hypot(trace[:, 0, case] - oracle[case, :, 0], trace[:, 1, case] - oracle[case, :, 1])
    assert np.max(error) <= 1e-9 * peak


@pytest.mark.parametrize("case", range(LANES), ids=NAMES)
def test_mean_current_of_a_tick_is_the_integral_of_the_solution(driven, case):
    records, duty, trace, oracle, theta_e, omega_e, _ = driven
    angle = theta_e[case] + omega_e[case] * DT * np.arange(TICKS)
    u_d, u_q = turn(angle, *(duty[:, :, case].T * SUPPLY))
    i_d = np.concatenate([[0.0], trace[:-1, 0, case]])
    i_q = np.concatenate([[0.0], trace[:-1, 1, case]])
    m_i, m_u, m_e = (records[0][name][:, case] for name in ("mean_i", "mean_u", "mean_e"))
    mean_d = m_i[0] * i_d + m_i[1] * i_q + m_u[0] * u_d + m_u[1] * u_q + m_e[0]
    mean_q = m_i[2] * i_d + m_i[3] * i_q + m_u[2] * u_d + m_u[3] * u_q + m_e[1]
    peak = np.max(np.hypot(oracle[case, :, 0], oracle[case, :, 1]))
    error = np.hypot(mean_d - oracle[case, :, 2] / DT, mean_q - oracle[case, :, 3] / DT)
    assert np.max(error) <= 1e-9 * peak


@pytest.mark.parametrize("case", range(LANES), ids=NAMES)
def test_mean_torque_of_a_tick_is_the_integral_of_the_solution(driven, case):
    _, _, trace, oracle, _, _, saliency = driven
    torque = oracle[case, :, 4] / DT
    # Exact without saliency; with it, mean(i_d i_q) is that of currents which change linearly within the tick.
    bound = TORQUE_BOUND[abs(CASES[case][0])] if saliency[case] != 1.0 else 1e-9
    assert np.max(np.abs(trace[:, 2, case] - torque)) <= bound * np.max(np.abs(torque))


# Share of the peak torque, by electrical frequency [Hz], L_q/L_d 1.7 or 0.6.
TORQUE_BOUND = {0: 1e-7, 50: 1e-7, 1000: 5e-6, 2500: 1e-4}


@pytest.mark.parametrize("case", range(LANES), ids=NAMES)
def test_energy_of_a_tick_is_conserved(driven, case):
    """Electrical energy in = copper loss + change of magnetic energy + mechanical work, tick by tick."""
    _, _, trace, oracle, _, omega_e, saliency = driven
    i_d = np.concatenate([[0.0], trace[:, 0, case]])
    i_q = np.concatenate([[0.0], trace[:, 1, case]])
    magnetic = np.diff(0.75 * L * (i_d**2 + saliency[case] * i_q**2))
    mechanical = trace[:, 2, case] * (omega_e[case] / N_P) * DT
    electrical, copper = oracle[case, :, 5], oracle[case, :, 6]
    scale = np.max(np.abs(electrical) + np.abs(mechanical) + copper)
    bound = TORQUE_BOUND[abs(CASES[case][0])] if saliency[case] != 1.0 else 1e-9
    assert np.max(np.abs(electrical - copper - magnetic - mechanical)) <= bound * scale


@pytest.mark.parametrize("saliency", [1.0, 1.7])
def test_short_circuited_winding_settles_to_the_closed_form_of_its_back_emf(saliency):
    omega_e = 2.0 * math.pi * np.array([0.0, 20.0, 100.0, 400.0, 1000.0, 2500.0, -100.0, -1000.0])
    L_q = saliency * L
    records = new_stage(L_q=L_q, omega_m=omega_e / N_P)
    trace = run(records, np.zeros((1500, 2, LANES)))
    determinant = R * R + omega_e**2 * L * L_q
    scale = PSI / L
    assert np.allclose(trace[-1, 0], -(omega_e**2) * L_q * PSI / determinant, rtol=0, atol=1e-10 * scale)
    assert np.allclose(trace[-1, 1], -omega_e * R * PSI / determinant, rtol=0, atol=1e-10 * scale)
    # Braking: the shaft's power is the copper loss.
    loss = 1.5 * R * (trace[-1, 0] ** 2 + trace[-1, 1] ** 2)
    assert np.allclose(trace[-1, 2] * omega_e / N_P, -loss, rtol=1e-9, atol=1e-12)


def test_an_open_stage_carries_no_current_and_makes_no_torque():
    records = new_stage(stage_on=0.0, omega_m=300.0, i_d=3.0, i_q=-4.0)
    trace = run(records, np.full((5, 2, LANES), 0.3))
    assert np.all(trace[:, :3] == 0.0)


def test_motor_torque_accelerates_the_rotor_against_the_extrapolated_reaction():
    """progress: reaction of the middles of the last two windows, .01 and .03 N m, half a window on."""
    records = new_stage(psi_m=0.0, J_rotor=1e-5, tau_reaction=0.03, tau_reaction_before=0.01, tau_cogging=0.005)
    trace = run(records, np.zeros((1, 2, LANES)))
    assert np.all(trace[0, 2] == 0.0)
    omega = DT * (0.005 - (0.03 + 0.5 * 0.02)) / 1e-5
    assert get_lanes(records, "omega_m", 8) == pytest.approx(np.full(8, omega), rel=1e-12)
    assert get_lanes(records, "theta_m", 8) == pytest.approx(np.full(8, 0.5 * DT * omega), rel=1e-12)


# --- what the real stage loses ------------------------------------------------------------------------------------
@pytest.mark.slow
def test_supply_sags_with_the_current_it_delivers():
    """Locked rotor: i = duty u_dc / R and u_dc = V - R_supply 1.5 duty^2 u_dc / R."""
    resistance = np.array([0.0, 0.01, 0.05, 0.1, 0.2, 0.3, 0.3, 0.3])
    duty = np.array([0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.1, 0.5])
    records = new_stage(supply_resistance=resistance)
    trace = run(records, np.broadcast_to(np.array([duty, np.zeros(8)]), (1500, 2, 8)))
    u_dc = SUPPLY / (1.0 + 1.5 * resistance * duty**2 / R)
    assert trace[-1, 3] == pytest.approx(u_dc, rel=1e-9)
    assert trace[-1, 0] == pytest.approx(duty * u_dc / R, rel=1e-9)
    assert np.all(trace[0, 3, 1:] > trace[-1, 3, 1:])  # the sag follows the current, which has to rise first


@pytest.mark.slow
@pytest.mark.parametrize("is_dc", [0.0, 1.0])
def test_the_stages_resistance_is_in_the_windings_circuit(is_dc):
    """Locked rotor: i = duty u_dc / R (1 - exp(-R t / L)), R with one switch of a phase, two of a brushed motor."""
    on = np.array([0.0, 0.004, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0])
    axis = {"is_dc": 1.0, "phase_factor": 1.0, "n_p": 1.0, "theta_m": -0.5 * math.pi} if is_dc else {}
    records = new_stage(on_resistance=on, psi_m=0.0, **axis)
    n = 40
    trace = run(records, np.broadcast_to(np.array([0.2, 0.0])[:, None], (n, 2, LANES)))
    path = R + (2.0 if is_dc else 1.0) * on
    t = (np.arange(n) + 1)[:, None] * DT
    current = trace[:, 1] if is_dc else trace[:, 0]
    assert current == pytest.approx(0.2 * SUPPLY / path * -np.expm1(-path * t / L), rel=1e-9)


def test_dead_time_costs_each_phase_its_share_of_the_supply_against_the_current():
    """Mean voltage error of a phase: dead time per period times the supply, in the sign of its current."""
    lost = 0.0075 * SUPPLY  # 300 ns at 25 kHz
    angle = np.radians([6.0, 20.0, 45.0, 75.0, 100.0, 135.0, 170.0, 200.0])
    duty = 0.2 * np.array([np.cos(angle), np.sin(angle)])
    records = new_stage(dead_time_duty=0.0075, dead_time_current=0.05)
    trace = run(records, np.broadcast_to(duty, (1500, 2, LANES)))
    i_alpha, i_beta = trace[-1, 0], trace[-1, 1]  # the rotor stands at angle 0
    error_alpha = duty[0] * SUPPLY - R * i_alpha
    error_beta = duty[1] * SUPPLY - R * i_beta
    # Clarke's transformation of the three phases' losses, every phase far above 50 mA.
    phases = [i_alpha, -0.5 * i_alpha + 0.5 * math.sqrt(3) * i_beta, -0.5 * i_alpha - 0.5 * math.sqrt(3) * i_beta]
    assert np.min(np.abs(phases)) > 0.05
    a, b, c = (lost * np.sign(i) for i in phases)
    assert error_alpha == pytest.approx((2 * a - b - c) / 3, abs=1e-9)
    assert error_beta == pytest.approx((b - c) / math.sqrt(3), abs=1e-9)


def test_dead_time_takes_four_over_pi_of_its_voltage_from_a_turning_current():
    """Three square waves: the fundamental of the loss is 4/pi of a phase's."""
    lost = 0.0075 * SUPPLY
    along = []
    for start in range(0, 48, LANES):
        angle = 2 * np.pi * (start + np.arange(LANES) + 0.5) / 48
        duty = 0.2 * np.array([np.cos(angle), np.sin(angle)])
        trace = run(new_stage(dead_time_duty=0.0075, dead_time_current=1e-3), np.broadcast_to(duty, (1500, 2, LANES)))
        along += list(0.2 * SUPPLY - R * (trace[-1, 0] * np.cos(angle) + trace[-1, 1] * np.sin(angle)))
    assert np.mean(along) == pytest.approx(4 / math.pi * lost, rel=2e-3)


def test_dead_time_fades_below_its_current():
    """Under the fading current the loss acts as a resistance: per phase lost / 0.3 A."""
    lost = 0.0075 * SUPPLY
    records = new_stage(dead_time_duty=0.0075, dead_time_current=0.3)
    trace = run(records, np.broadcast_to(np.array([0.005, 0.0])[:, None], (2000, 2, LANES)))
    # Alpha current I: phases I, -I/2, -I/2; error (2 I + I/2 + I/2)/3 lost/0.3 = I lost/0.3.
    expected = 0.005 * SUPPLY / (R + lost / 0.3)
    assert expected < 0.3
    assert trace[-1, 0] == pytest.approx(np.full(LANES, expected), rel=1e-9)


# --- the motors' rows against hand calculation --------------------------------------------------------------------
# Typed from the sources, not read from the rows. QBL4208-61: .125 N m at 3.5 A peak, so K_t = .0357143 N m/A and
# psi = K_t/6 = 5.95238 mV s; 24 V, .36 ohm (class). EC-i 40: k_t .0315 N m/A and .807 ohm line to line, 36 V.
#   torque constant of peak i_q: QBL .0357143; EC-i .0315 sqrt(3)/2 = .0272798 N m/A
#   no-load speed: phase voltage V/sqrt(3) over n_p psi: QBL 13.8564/.0238095 = 581.97 rad/s = 5557 rpm;
#       EC-i 36/.0315 = 1142.9 rad/s = 10,913 rpm; catalogue, with its friction: 10,700 rpm
#   stall torque at V/sqrt(3) per phase: QBL 13.8564/.36 * .0357143 = 1.3746 N m; EC-i .0315*36/.807 = 1.4052 N m
#   stall torque at the preset's current limit: QBL 7 A: .25 N m; EC-i 5 A: .13640 N m
HAND = {
    "qbl4208": {
        "K_t": 0.0357143, "no_load_rpm": 5557.4, "stall": 1.37463, "limited": 0.25000, "psi_e": 0.00595238,
        "n_p": 4, "volts": 24.0, "limit_ma": 7000,
    },
    "ec_i_40": {
        "K_t": 0.0272798, "no_load_rpm": 10913.5, "stall": 1.40520, "limited": 0.136399, "psi_e": 0.00259808,
        "n_p": 7, "volts": 36.0, "limit_ma": 5000,
    },
}  # fmt: skip
FREE = {"load.coulomb": 0.0, "load.breakaway": 0.0, "load.viscous": 0.0}
BOTH = pytest.mark.parametrize("motor", ["qbl4208", "ec_i_40"])


def ideal_drives(motor, **parameters):
    drives = EmulatedDrives(load="inertia", motor=motor, ideal=True, num_threads=1, parameters={**FREE, **parameters})
    drives.write("Following error window", 0)
    return drives


def held_voltage(omega_e):
    """Return the no-load speed of a voltage held for ticks of T over that of a voltage that turns with the rotor.

    Second order in x = omega_e T. The held voltage turns by x within a tick: its mean is less by x^2/24. The ripple
    that this makes is 0 when the current is sampled, at the tick's start, but has the mean -u x T/(12 L) in d, which
    weakens the field by u x^2/12. Together: higher by x^2/24.
    """
    return 1.0 + (omega_e * DT) ** 2 / 24.0


def no_load_rpm(drives):
    motion.enable(drives, mode="pv")
    drives.write("Profile acceleration", 500_000_000)
    drives.write("Target velocity", 30_000_000)  # 27,466 rpm: out of reach
    drives.advance(0.3)
    return drives.machine.rotor_speed[0] * 60 / (2 * math.pi)


@BOTH
def test_no_load_speed(motor):
    drives = ideal_drives(motor)
    rpm = no_load_rpm(drives)
    omega_e = HAND[motor]["n_p"] * HAND[motor]["no_load_rpm"] * 2 * math.pi / 60
    assert rpm == pytest.approx(HAND[motor]["no_load_rpm"] * held_voltage(omega_e), rel=2e-4)
    assert drives.read("Velocity actual value")[0] * 60 / 65536 == pytest.approx(rpm, rel=1e-4)
    assert abs(drives.machine.motor_torque[0]) < 1e-3 * HAND[motor]["stall"]


def test_friction_costs_the_ec_i_40_the_speed_of_its_torque_gradient():
    """Catalogue 10,700 rpm; by hand R_pp/k_t^2 tau = .807/.0315^2 (1.2e-3 + 8e-7 * 1143) = 1.72 rad/s = 16.4 rpm."""
    ideal = no_load_rpm(ideal_drives("ec_i_40"))
    rubbing = no_load_rpm(ideal_drives("ec_i_40", **{"motor.coulomb": 1.2e-3, "motor.viscous": 8e-7}))
    assert ideal - rubbing == pytest.approx(16.4, rel=0.1)
    assert rubbing == pytest.approx(10_700, rel=0.025)


@BOTH
def test_stall_torque_at_the_current_limit(motor):
    drives = ideal_drives(motor, **{"load.inertia": 1e3})
    motion.enable(drives, mode="cst")
    drives.write("Target torque", 20_000)  # mA, above 2003h
    drives.advance(0.1)
    assert drives.read("Torque actual value")[0] == pytest.approx(HAND[motor]["limit_ma"], abs=1)
    assert drives.machine.motor_torque[0] == pytest.approx(HAND[motor]["limited"], rel=1e-4)


@BOTH
def test_stall_torque_at_the_supplys_voltage(motor):
    """45 A is the highest that 2003h takes: below the voltage's limit, so the supply is lowered to a quarter."""
    drives = ideal_drives(motor, **{"load.inertia": 1e3})
    drives.machine.supply = HAND[motor]["volts"] / 4
    drives.write("Maximum Current", 45_000)
    records = drives.inside.records
    set_lanes(records, "undervoltage", np.zeros(1))
    motion.enable(drives, mode="cst")
    drives.write("Target torque", 32_000)
    drives.advance(0.2)
    assert drives.machine.motor_torque[0] == pytest.approx(HAND[motor]["stall"] / 4, rel=1e-4)
    # All of the voltage circle is used, and it is 1/sqrt(3) of the supply.
    used = math.hypot(get_lanes(records, "duty_alpha", 1)[0], get_lanes(records, "duty_beta", 1)[0])
    assert used == pytest.approx(0.577350, abs=1e-6)


@BOTH
def test_torque_constant_of_the_measured_current(motor):
    drives = ideal_drives(motor, **{"load.inertia": 1e3})
    motion.enable(drives, mode="cst")
    for milliamperes in (500, 2000, -3000):
        drives.write("Target torque", milliamperes)
        drives.advance(0.1)
        assert drives.read("Torque actual value")[0] == pytest.approx(milliamperes, abs=1)
        expected = HAND[motor]["K_t"] * milliamperes * 1e-3
        assert drives.machine.motor_torque[0] == pytest.approx(expected, rel=1e-3)


@BOTH
def test_back_emf_is_what_the_torque_integrator_holds_against(motor):
    """2041h:04 at constant speed without torque: duty x supply = omega_e psi, turned by the delay of 1.5 periods."""
    drives = ideal_drives(motor)
    motion.enable(drives, mode="pv")
    drives.write("Profile acceleration", 50_000_000)
    hand = HAND[motor]
    for rpm in (500, -1500):
        drives.write("Target velocity", round(rpm * 65536 / 60))
        drives.advance(0.5)
        omega_e = hand["n_p"] * rpm * 2 * math.pi / 60
        volts = drives.read("Torque Mode Settings.PID_Torque_Error_Sum")[0] / 256 / 32768 * hand["volts"]
        assert volts == pytest.approx(omega_e * hand["psi_e"] * math.cos(1.5 * DT * omega_e), rel=2e-3)
