"""The DC link of a two-axis module: energy from mains to shafts and from one axis to the other, chopper, charging.

The harness turns free rotors with currents that it chooses and sums every term tick by tick, by formulas of its own:
mains and resistor by the link's voltage, copper loss by the currents, work by the rotors' speeds.
"""

from __future__ import annotations

import numpy as np
import pytest

from drive_env import motors
from drive_env.firmware.cycle import Rates
from drive_env.firmware.record import LANES
from drive_env.firmware.servo.alignment import ENCODER
from drive_env.firmware.servo_mains.stages import FIRMWARE, prepare_link
from mechanics.kernels.compiled import cached

start_window, tick = FIRMWARE.start_window, FIRMWARE.tick
MOTOR = motors.MOTORS["am3041_e"]
TICKS, WINDOWS = 4, 5
RATES = Rates(50e-6, 200e-6, 1e-3, TICKS, WINDOWS, 1, 1, np.full((1, TICKS), 1.0 / TICKS), np.zeros((1, TICKS)))
MAINS, SUPPLY_LOSS, RESISTOR, IDLE, COPPER, SHAFT = range(6)
PEAK = 16.0  # A
NOMINAL = {
    "live": 1, "supply_voltage": 560.0, "u_dc": 560.0, "undervoltage": 300.0, "dc_capacitance": 500e-6,
    "supply_resistance": 0.8, "charging_resistance": 47.0, "idle_power": 12.0, "link_charged": 1.0,
    "chopper_resistance": 47.0, "chopper_voltage": 760.0, "chopper_hysteresis": 20.0, "chopper_enable": 1.0,
    "brake_power": 500.0, "brake_thermal_time": 30.0, "link_shared": 1.0,
    "R_s": MOTOR.R_s, "psi_m": MOTOR.psi_m, "L_d": MOTOR.L_d, "L_q": MOTOR.L_q, "n_p": MOTOR.n_p,
    "pole_pairs": MOTOR.n_p, "encoder_counts": MOTOR.encoder_counts, "feedback_resolution": MOTOR.encoder_counts,
    "J_rotor": 4e-4, "duty_limit": 3.0**-0.5, "adc_step": 1e-4, "adc_step_lsb": 0.05, "dead_time_current": 0.2,
    "current_p": 0.02, "current_integration": 50e-6 / 0.05, "i_max": PEAK, "peak_current": PEAK,
    "limit_negative": 1.0, "limit_positive": 1.0, "stage_on": 1.0, "drive_function": 1.0,
    "angle_source": ENCODER, "torque_share": 1.0, "loop_level": 0.0,
}  # fmt: skip


@cached()
def run_module(records, rates, periods, sums, trace):
    """Run periods of the first block: sums (6, lanes) [J], of what each axis or, of a link's terms, its link has done.

    trace (periods, 2): voltage of the links of lanes 0 and 1 at the end of each.
    """
    dt = rates.tick
    drive = records[0]
    before = np.zeros(LANES)
    omega = np.zeros(LANES)
    for period in range(periods):
        prepare_link(drive, rates)
        for _ in range(rates.windows):
            start_window(drive, rates)
            for k in range(rates.ticks):
                for lane in range(LANES):
                    before[lane] = drive.u_dc[lane]
                    omega[lane] = drive.omega_m[lane]
                tick(drive, rates, k)
                for lane in range(LANES):
                    u, mains = drive.u_dc[lane], drive.rectifier_voltage[lane]
                    bridged = drive.link_charged[lane] > 0.5
                    R = drive.supply_resistance[lane] + (0.0 if bridged else drive.charging_resistance[lane])
                    # The current falls with the time constant of resistance and capacitors, to its end in this tick.
                    tau = R * drive.dc_capacitance[lane]
                    end = (mains - u) / R if mains > u else 0.0
                    begin = end * np.exp(dt / tau)
                    sums[MAINS, lane] += mains * tau * (begin - end)
                    sums[SUPPLY_LOSS, lane] += R * 0.5 * tau * (begin * begin - end * end)
                    on = drive.chopper[lane] > 0.5
                    square = 0.5 * (before[lane] * before[lane] + u * u)
                    sums[RESISTOR, lane] += square / drive.chopper_resistance[lane] * dt if on else 0.0
                    sums[IDLE, lane] += drive.idle_now[lane] * dt
                    for start, mean, last in (
                        (drive.i_d_before[lane], drive.i_d_mean[lane], drive.i_d[lane]),
                        (drive.i_q_before[lane], drive.i_q_mean[lane], drive.i_q[lane]),
                    ):
                        # Mean square of the parabola through start and end with that mean, by Simpson's rule.
                        middle = 1.5 * mean - 0.25 * (start + last)
                        square = (start * start + 4.0 * middle * middle + last * last) / 6.0
                        sums[COPPER, lane] += 1.5 * (drive.R_s[lane] + drive.on_resistance[lane]) * square * dt
                    sums[SHAFT, lane] += drive.tau_m[lane] * 0.5 * (omega[lane] + drive.omega_m[lane]) * dt
        trace[period, 0], trace[period, 1] = drive.u_dc[0], drive.u_dc[1]


def new_module(**changed):
    records = FIRMWARE.layout.new_records(LANES)
    for name, value in (NOMINAL | changed).items():
        records[name] = value
    return records


def stored(records):
    """Return the energy of the links and of the windings of each lane [J]."""
    link = 0.5 * records["dc_capacitance"][0] * records["u_dc"][0] ** 2
    field = 0.75 * (records["L_d"][0] * records["i_d"][0] ** 2 + records["L_q"][0] * records["i_q"][0] ** 2)
    return link, field


def run(records, periods, torque):
    """Let lanes 0 and 1 have these currents [A] for so many ms; return sums, and the links' voltages."""
    sums, trace = np.zeros((6, LANES)), np.zeros((periods, 2))
    records["torque_demand"] = 0.0
    records["torque_demand"][0, :2] = torque
    run_module(records, RATES, periods, sums, trace)
    return sums, trace


def out_of_balance(records, before, sums):
    """Return what lanes 0 and 1 have lost or made, as a share of all that moved."""
    link, field = (after - start for after, start in zip(stored(records), before, strict=True))
    axes = sums[COPPER, :2].sum() + sums[SHAFT, :2].sum() + field[:2].sum() + sums[IDLE, :2].sum()
    rest = sums[MAINS, 0] - sums[SUPPLY_LOSS, 0] - sums[RESISTOR, 0] - axes - link[0]
    moved = sums[MAINS, 0] + sums[RESISTOR, 0] + np.abs(sums[SHAFT, :2]).sum()
    return abs(rest) / moved


@pytest.mark.slow
def test_the_sum_of_all_energies_is_0_within_a_thousandth():
    module = new_module(on_resistance=0.5)
    for torque, periods in (((8.0, 5.0), 150), ((8.0, -12.0), 60), ((-10.0, -10.0), 100), ((0.0, 6.0), 100)):
        before = stored(module)
        sums, _ = run(module, periods, torque)
        assert out_of_balance(module, before, sums) < 1e-3, torque
    assert sums[SHAFT, 0] != 0.0


def test_what_an_axis_brakes_the_other_one_uses():
    module = new_module(chopper_voltage=900.0)  # V, which the link does not reach: the resistor stays off
    run(module, 70, (10.0, 0.0))  # axis 0 gets to 7000 rpm, axis 1 stands
    run(module, 15, (-6.0, 6.0))
    taken, burnt = module["mains_energy"][0, 0], module["brake_energy"][0, 0]
    before = stored(module)
    sums, trace = run(module, 40, (-6.0, 6.0))
    assert sums[SHAFT, 0] < -40.0
    assert sums[SHAFT, 1] > 5.0
    assert trace[:, 0].min() > 560.0
    assert trace[:, 0].max() < 900.0
    assert module["mains_energy"][0, 0] - taken == pytest.approx(sums[MAINS, 0], rel=1e-9, abs=1e-6)
    assert sums[MAINS, 0] == 0.0  # the braking axis gives it all
    assert module["brake_energy"][0, 0] == burnt
    assert (trace[:, 0] == trace[:, 1]).all()
    assert out_of_balance(module, before, sums) < 1e-3


def test_axes_that_share_no_link_have_nothing_of_each_other():
    module = new_module(link_shared=0.0)
    run(module, 200, (10.0, 0.0))
    _, trace = run(module, 60, (-6.0, 6.0))
    assert trace[-1, 0] > 600.0
    assert trace[-1, 1] < 560.0


def test_what_nobody_uses_the_resistor_burns_between_its_two_voltages():
    module = new_module()
    run(module, 250, (12.0, 12.0))
    run(module, 15, (-12.0, -12.0))
    sums, trace = run(module, 30, (-12.0, -12.0))
    assert sums[RESISTOR, 0] > 20.0
    assert 740.0 < trace[:, 0].max() < 800.0
    assert sums[MAINS, 0] == 0.0  # the rectifier takes nothing, and gives nothing


def test_without_its_resistor_a_braking_axis_charges_the_link_alone():
    module = new_module(chopper_enable=0.0)
    run(module, 150, (8.0, 0.0))
    before = stored(module)
    sums, trace = run(module, 40, (-8.0, 0.0))
    gained = stored(module)[0][0] - before[0][0]
    field = (stored(module)[1] - before[1])[:2].sum()
    fed = sums[MAINS, 0] - sums[SUPPLY_LOSS, 0]  # until the link is above the mains
    braked = -sums[SHAFT, :2].sum() - sums[COPPER, :2].sum() - sums[IDLE, :2].sum() - field
    assert gained == pytest.approx(fed + braked, rel=3e-3)
    assert braked > 4.0 * fed
    assert trace[-1, 0] > 650.0  # far above the 560 V of the mains


def test_the_resistor_rests_when_it_is_too_hot_and_works_again_when_it_has_cooled():
    # Closed form of a first order: with p times the rated power the rise is p (1 - exp(-t / T)).
    module = new_module(brake_power=1000.0, brake_thermal_time=0.5, chopper_voltage=500.0, supply_voltage=560.0)
    power = 560.0**2 / 47.0
    run(module, 50, (0.0, 0.0))
    mean = module["brake_energy"][0, 0] / 0.05
    assert 0.8 * power < mean < power  # the supply's resistance takes some, and the mains ripple
    assert module["brake_heat"][0, 0] == pytest.approx(mean / 1000.0 * (1.0 - np.exp(-0.05 / 0.5)), rel=0.03)
    run(module, 200, (0.0, 0.0))
    assert module["brake_hot"][0, 0] == 1.0
    burnt = module["brake_energy"][0, 0]
    run(module, 50, (0.0, 0.0))
    assert module["brake_energy"][0, 0] == burnt
    run(module, 100, (0.0, 0.0))
    assert module["brake_energy"][0, 0] > burnt


def test_an_empty_link_is_charged_through_the_resistance():
    # u = U (1 - exp(-t / RC)); the rectifier's mean voltage is 3 / pi of its peak, and the last part is bridged.
    module = new_module(u_dc=1.0, link_charged=0.0, idle_power=0.0, stage_on=0.0)
    _, trace = run(module, 200, (0.0, 0.0))
    tau = (47.0 + 0.8) * 500e-6
    at_tau = trace[round(tau / 1e-3) - 1, 0]
    assert at_tau == pytest.approx(560.0 * 3.0 / np.pi * (1.0 - np.exp(-1.0)), rel=0.02)
    assert module["link_charged"][0, 0] == 1.0
    assert trace[-1, 0] == pytest.approx(560.0, rel=0.01)


def test_an_empty_link_is_charged_again_though_logic_takes_its_power():
    """Below the under-voltage logic is a resistor: u falls as exp(-P t / (C u_min^2)), and rises with the mains."""
    module = new_module(u_dc=300.0, supply_voltage=0.0, stage_on=0.0, undervoltage=300.0, idle_power=12.0)
    before = stored(module)
    sums, trace = run(module, 3000, (0.0, 0.0))
    tau = 500e-6 * 300.0**2 / (2.0 * 12.0)
    assert trace[-1, 0] == pytest.approx(300.0 * np.exp(-3.0 / tau), rel=2e-3)
    assert stored(module)[0][0] - before[0][0] == pytest.approx(-sums[IDLE, :2].sum(), rel=1e-6)
    module["supply_voltage"] = 560.0
    _, trace = run(module, 300, (0.0, 0.0))
    assert module["link_charged"][0, 0] == 1.0
    assert trace[-1, 0] == pytest.approx(560.0, rel=0.02)


def test_a_rectifier_without_a_phase_gives_less_and_ripples_more():
    sound, lost = new_module(idle_power=400.0), new_module(idle_power=400.0, mains_phase_lost=1.0)
    _, of_three = run(sound, 60, (0.0, 0.0))
    _, of_two = run(lost, 60, (0.0, 0.0))
    assert np.ptp(of_three[20:, 0]) < 20.0
    assert np.ptp(of_two[20:, 0]) > 3.0 * np.ptp(of_three[20:, 0])
    assert of_two[20:, 0].mean() < of_three[20:, 0].mean() - 10.0


def test_a_supply_that_is_gone_leaves_the_capacitors_to_the_idle_power():
    # C u^2 / 2 falls by P t.
    module = new_module(supply_voltage=0.0, stage_on=0.0)
    _, trace = run(module, 100, (0.0, 0.0))
    left = 0.5 * 500e-6 * 560.0**2 - 2.0 * 12.0 * 0.1
    assert trace[-1, 0] == pytest.approx(np.sqrt(2.0 * left / 500e-6), rel=1e-6)


def test_the_second_axis_follows_the_link_of_the_first():
    module = new_module()
    module["u_dc"][0, 1] = 100.0  # as if it had been started anew alone
    run(module, 1, (0.0, 0.0))
    assert module["u_dc"][0, 0] == module["u_dc"][0, 1]


def test_what_is_no_number_in_the_lane_beside_does_not_reach_an_axis_with_a_link_of_its_own():
    module = new_module(link_shared=0.0)
    module["psi_m"][0, 1] = np.nan
    _, trace = run(module, 2, (1.0, 1.0))
    assert trace[-1, 0] == pytest.approx(560.0, abs=15.0)
