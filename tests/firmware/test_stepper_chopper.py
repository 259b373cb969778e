"""The chopper's mean effect against a chopper that is switched step by step, the winding against an independent
integration, and which current flows when."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rigs.stepper_rig import MICROSTEPS, SMOOTH, build, hold, lane
from scipy.integrate import solve_ivp

from drive_env import motion
from drive_env.firmware.common.dc_link import derive_link
from drive_env.firmware.record import LANES, get_lanes, set_lanes
from drive_env.firmware.stepper.stages import FIRMWARE
from drive_env.firmware.stepper.winding import chop, move_rotor, power_stage, refresh_winding
from drive_env.motors import MOTORS
from mechanics.kernels.compiled import cached

MOTOR = MOTORS["qsh4218_51"]
R, L, PSI, N_P, SUPPLY = MOTOR.R_s, MOTOR.L_q, MOTOR.psi_m, 50, 24.0
AMPLITUDE = MOTOR.rated_current
CLOCK = 16e6
DT, WINDOW, TICKS = 40e-6, 200e-6, 60
LOCKED = 1e30  # kg m^2: the rotor keeps its speed
HELD = SMOOTH | {"motor.coulomb": 100.0}
PPS = MICROSTEPS / (2.0 * math.pi)
BLANK = (16, 24, 36, 54)


# --- the winding, exact -------------------------------------------------------------------------------------------
@cached()
def run_stage(drive, dt, window, ticks, trace):
    """Hold the PWM's voltage for some ticks; trace: i_a, i_b after, torque and power of each tick."""
    derive_link(drive, dt)
    refresh_winding(drive, dt, window)
    for k in range(ticks):
        chop(drive)
        power_stage(drive)
        move_rotor(drive, dt, 0.5)
        for lane_ in range(LANES):
            trace[k, 0, lane_] = drive.i_a[lane_]
            trace[k, 1, lane_] = drive.i_b[lane_]
            trace[k, 2, lane_] = drive.tau_m[lane_]
            trace[k, 3, lane_] = drive.bridge_power[lane_]


def held_voltage(omega_e, share, angle):
    """Return the trace of 8 pairs of phases at constant speeds, and what DOP853 makes of the same circuit."""
    records = FIRMWARE.layout.new_records(LANES)
    values = {
        "R_s": R, "L_s": L, "psi_m": PSI, "n_p": N_P, "supply_voltage": SUPPLY, "u_dc": SUPPLY, "J_rotor": LOCKED,
        "stage_on": 1.0, "supply_sinks": 1.0, "dc_capacitance": 1e-9, "in_pwm": 1.0, "pwm_scale": 255.0 * share,
        "cos_ref": math.cos(angle), "sin_ref": math.sin(angle), "omega_m": omega_e / N_P, "theta_m": 0.3 / N_P,
    }  # fmt: skip
    for name, value in values.items():
        set_lanes(records, name, np.broadcast_to(np.asarray(value, float), LANES))
    trace = np.empty((TICKS, 4, LANES))
    run_stage(records[0], DT, WINDOW, TICKS, trace)
    exact = np.empty_like(trace)
    u_a, u_b = share * SUPPLY * math.cos(angle), share * SUPPLY * math.sin(angle)
    for each, w in enumerate(omega_e):

        def derivative(t, x, w=w):
            s, c = math.sin(0.3 + w * t), math.cos(0.3 + w * t)
            return [
                (u_a - R * x[0] + PSI * w * s) / L,
                (u_b - R * x[1] - PSI * w * c) / L,
                N_P * PSI * (x[1] * c - x[0] * s),
                u_a * x[0] + u_b * x[1],
            ]

        t = DT * np.arange(1, TICKS + 1)
        x = solve_ivp(derivative, (0.0, t[-1]), np.zeros(4), "DOP853", t_eval=t, rtol=1e-10, atol=1e-14).y.T
        exact[:, :2, each] = x[:, :2]
        exact[:, 2:, each] = np.diff(x[:, 2:], axis=0, prepend=np.zeros((1, 2))) / DT
    return trace, exact


@pytest.mark.slow
def test_currents_torque_and_power_at_constant_speed_are_those_of_an_independent_integration():
    omega_e = 2.0 * math.pi * np.array([0.0, 10.0, -10.0, 100.0, -300.0, 1000.0, -1000.0, 2000.0])
    trace, exact = held_voltage(omega_e, 0.4, 0.7)
    current = np.abs(exact[:, :2]).max(axis=(0, 1))
    assert np.max(np.abs(trace[:, :2] - exact[:, :2]).max(axis=(0, 1)) / current) < 1e-8
    torque, power = np.abs(exact[:, 2]).max(axis=0), np.abs(exact[:, 3]).max(axis=0)
    assert np.max(np.abs(trace[:, 3] - exact[:, 3]).max(axis=0) / power) < 1e-7
    error = np.abs(trace[:, 2] - exact[:, 2]).max(axis=0) / torque
    assert np.all(error[:5] < 1e-4)
    assert np.all(error < 5e-3)  # a tick of 40 us is a twelfth of a turn at 2 kHz


def test_the_current_of_a_held_rotor_rises_with_the_windings_time_constant():
    """i = u/R (1 - exp(-t R/L)); 8 mH / 5 ohm is 1.6 ms."""
    with build(parameters=HELD, ideal=True) as drives:
        drives.write(0x20B0, 10**6)
        drives.write(0x20B1, 1)
        drives.write(0x20B2, 64)
        drives.write(0x6060, 1)
        for word in (6, 7, 15):
            drives.write(0x6040, word)
        found = []
        for _ in range(12):
            found.append(lane(drives, "i_a")[0])
            drives.advance(0.001)
    t = 0.001 * np.arange(12)
    final = SUPPLY * 64.0 / 255.0 / R
    np.testing.assert_allclose(found, final * -np.expm1(-t * R / L), atol=2e-3 * final)


# --- a chopper that is switched step by step ----------------------------------------------------------------------
def switched(target, *, constant, toff, hstrt, hend, tbl=2, hdec=0, dt=50e-9, until=4e-3):
    """Return mean current, ripple and frequency of one phase of a held rotor, switched as the data sheet says."""
    unit = AMPLITUDE / 512.0
    off, blank = max(12 + 32 * toff, 64) / CLOCK, BLANK[tbl] / CLOCK
    decrement = unit * CLOCK / (16.0 * (1.0 + hdec))
    end, start = hend * unit, (hend + hstrt) * unit
    i, phase, since, h, cycles, trace = target, "on", 0.0, start, 0, []
    for k in range(round(until / dt)):
        voltage = {"on": SUPPLY, "fast": -SUPPLY}.get(phase, 0.0)
        i += dt / L * (voltage - R * i)
        since += dt
        following = phase
        if constant:
            if phase == "on" and since >= blank and i >= target + end:
                following = "fast" if hstrt else "slow"
            elif phase == "fast" and since >= 32.0 * hstrt / CLOCK:
                following = "slow"
            elif phase == "slow" and since >= off:
                following = "on"
        else:
            if phase in ("on", "fast"):
                h = max(h - decrement * dt, end)
            if phase == "on" and since >= blank and i >= target + h:
                following = "slow"
            elif phase == "slow" and since >= off:
                following = "fast"
            elif phase == "fast" and since >= blank and i <= target - h:
                following = "last"
            elif phase == "last" and since >= off:
                following, h = "on", start
        if following != phase:
            cycles += following == "on" and k * dt > 0.5 * until
            phase, since = following, 0.0
        if k * dt > 0.5 * until:
            trace.append(i)
    return float(np.mean(trace)), float(np.ptp(trace)), cycles / (0.5 * until)


def settled(**objects):
    """Return the fields of a held rotor whose phase A carries all the current."""
    with build(parameters=HELD, ideal=True) as drives:
        for name, value in objects.items():
            drives.write(int(name[1:], 16), value)
        hold(drives)
        names = ("i_a", "i_b", "ripple", "chopper_frequency", "bridge_power")
        return {name: lane(drives, name)[0] for name in names}


@pytest.mark.parametrize("toff", [2, 5, 9, 15])
def test_constant_off_time_has_the_ripple_mean_and_frequency_of_one_that_is_switched(toff):
    found = settled(o2093=1, o2097=toff, o2096=2)
    mean, ripple, frequency = switched(AMPLITUDE, constant=True, toff=toff, hstrt=2, hend=0)
    assert found["ripple"] == pytest.approx(ripple, rel=0.05)
    assert found["chopper_frequency"] == pytest.approx(frequency, rel=0.05)
    assert found["i_a"] == pytest.approx(mean, abs=0.002 * AMPLITUDE)
    # By hand: what fast decay of 64 clocks and slow decay take off.
    t_fast, t_off = 64 / CLOCK, max(12 + 32 * toff, 64) / CLOCK
    by_hand = t_fast * (SUPPLY + R * AMPLITUDE) / L + t_off * R * AMPLITUDE / L
    assert found["ripple"] == pytest.approx(by_hand, rel=1e-3)


@pytest.mark.parametrize(
    ("toff", "hstrt", "hend", "hdec"), [(2, 3, 0, 0), (5, 8, 2, 3), (5, 4, 10, 1), (12, 8, 12, 0), (12, 0, 0, 0)]
)
def test_spread_cycle_has_the_ripple_mean_and_frequency_of_one_that_is_switched(toff, hstrt, hend, hdec):
    found = settled(o2097=toff, o2096=hstrt, o2095=hend, o2094=hdec)
    mean, ripple, frequency = switched(AMPLITUDE, constant=False, toff=toff, hstrt=hstrt, hend=hend, hdec=hdec)
    assert found["ripple"] == pytest.approx(ripple, rel=0.04)
    assert found["chopper_frequency"] == pytest.approx(frequency, rel=0.04)
    assert found["i_a"] == pytest.approx(mean, rel=5e-4)


def test_every_setting_of_the_chopper_changes_its_ripple():
    base = settled()["ripple"]
    longer = settled(o2097=12)["ripple"]
    assert longer > 1.5 * base
    assert settled(o2096=8, o2094=3)["ripple"] > settled(o2096=3, o2094=3)["ripple"] >= base
    assert settled(o2096=8, o2094=3)["ripple"] > settled(o2096=8, o2094=1)["ripple"]
    assert settled(o2095=8)["ripple"] > base
    assert settled(o2097=2, o2096=0, o2092=3)["ripple"] > settled(o2097=2, o2096=0, o2092=0)["ripple"]
    assert settled(o20A3=1)["ripple"] < base


def test_the_ripple_costs_what_its_mean_square_dissipates():
    still, rough = settled(o2093=1, o2097=2, o2096=0), settled(o2093=1, o2097=15, o2096=8)
    for found in (still, rough):
        copper = R * (found["i_a"] ** 2 + found["i_b"] ** 2 + found["ripple"] ** 2 / 6.0)
        assert found["bridge_power"] == pytest.approx(copper, rel=1e-4)
    assert rough["ripple"] ** 2 / 6.0 > 5e-4 * rough["i_a"] ** 2  # or nothing would have been seen


def test_a_blank_time_keeps_a_small_current_up():
    """The least on-time of constant off time: mean voltage u (blank - fast) / (blank + fast + off)."""
    with build(parameters=HELD, ideal=True, current=0.02) as drives:
        drives.write(0x2093, 1)
        drives.write(0x2096, 0)
        drives.write(0x2092, 3)
        drives.write(0x2097, 2)
        hold(drives)
        found = lane(drives, "i_a")[0]
    blank, off = 54 / CLOCK, 76 / CLOCK
    assert found == pytest.approx(SUPPLY * blank / (blank + off) / R, rel=0.01)
    assert found > 10.0 * 0.02 * AMPLITUDE


def test_a_current_falls_slower_without_fast_decay():
    """Turning the field takes current out of a phase; with slow decay alone only the winding's resistance does."""
    with build(num_machines=3, parameters=HELD, ideal=True) as drives:
        drives.write(0x2093, [0, 1, 1])
        drives.write(0x2096, [3, 8, 0])
        motion.enable(drives, mode="csp")
        drives.advance(0.05)
        drives.record([0x6064], 0.002, {0x607A: np.array([200, 200])})  # set-point of A: cos 70 degrees
        left = lane(drives, "i_a") / AMPLITUDE
    assert left[0] == pytest.approx(math.cos(200.5 * math.pi / 512.0), abs=0.01)
    assert left[1] < 0.05 + left[0] < 0.2 + left[0] < left[2]
    # Nothing but the resistance lowers it, down to what blank times of 36 clocks in each 208 drive.
    floor = SUPPLY * 36 / 208 / R / AMPLITUDE
    assert left[2] == pytest.approx(floor + (1.0 - floor) * math.exp(-1.9e-3 * R / L), abs=0.03)


# --- voltage PWM and high speed -----------------------------------------------------------------------------------
def test_voltage_pwm_drives_below_its_threshold_with_an_amplitude_that_grows_with_speed():
    """A + G 256 / T, T clocks of 16 MHz between microsteps of 1/256, up to 255."""
    speeds = np.array([0, 5_000, 20_000, 60_000])
    with build(num_machines=4, parameters=HELD, ideal=True) as drives:
        drives.write(0x20B0, 50_000)
        drives.write(0x20B1, 100)
        drives.write(0x20B2, 40)
        motion.enable(drives, mode="pv")
        drives.write(0x6083, 10**7)
        drives.write(0x60FF, speeds)
        drives.advance(0.1)
        expected = np.minimum(40 + 100 * 256 * speeds / CLOCK, 255)
        np.testing.assert_allclose(drives.read(0x2121), np.rint(expected), atol=1)
        np.testing.assert_array_equal(lane(drives, "in_pwm"), [1, 1, 1, 0])
        assert lane(drives, "ripple")[0] == 0.0 < lane(drives, "ripple")[3]
        drives.write(0x20B1, 0)  # 0 turns it off
        drives.advance(0.01)
        assert not np.any(lane(drives, "in_pwm"))


def test_voltage_pwm_makes_the_current_that_resistance_leaves():
    with build(num_machines=2, parameters=HELD, ideal=True) as drives:
        drives.write(0x20B0, 50_000)
        drives.write(0x20B1, 1)
        drives.write(0x20B2, 80)
        drives.write(0x2003, [255, 127])  # the current's scale lowers the amplitude
        hold(drives)
        np.testing.assert_allclose(lane(drives, "i_a"), SUPPLY * 80 / 255 / R * np.array([1.0, 0.5]), rtol=1e-3)
        np.testing.assert_array_equal(drives.read(0x2121), [80, 40])


def test_above_the_full_step_threshold_the_chosen_modes_act():
    with build(num_machines=4, parameters=SMOOTH) as drives:
        drives.write(0x20B6, 20_000)
        drives.write(0x20B8, [0, 1, 0, 0])
        drives.write(0x20B7, [0, 0, 1, 1])
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, [40_000, 40_000, 40_000, 10_000])
        drives.advance(0.3)
        seen = []
        for _ in range(40):
            drives.advance(0.001)
            seen.append(np.abs(lane(drives, "cos_ref")))
        assert np.all(np.isclose(np.array(seen)[:, 1], math.sqrt(0.5)))
        assert np.ptp(np.array(seen)[:, 0]) > 0.5
        # Without fast decay a current cannot be pushed down.
        np.testing.assert_array_equal(lane(drives, "lowest_share")[[0, 1, 3]], [-1.0, -1.0, -1.0])
        # The least on-time against twice the off time of 172 clocks.
        assert lane(drives, "lowest_share")[2] == pytest.approx(36 / (36 + 2 * 172))


def test_an_off_time_of_0_lets_the_motor_run_free():
    with build(parameters=SMOOTH) as drives:
        hold(drives)
        assert lane(drives, "i_a")[0] > 1.0
        drives.write(0x2097, 0)
        drives.advance(0.01)
        assert lane(drives, "i_a")[0] == 0.0
        drives.machine.load_torque = 0.01
        drives.advance(0.2)
        assert lane(drives, "omega_m")[0] > 10.0


# --- which current flows when -------------------------------------------------------------------------------------
@pytest.mark.parametrize(("raw", "step"), [(255, 32), (128, 17), (127, 16), (8, 2), (7, 1), (0, 1)])
def test_a_current_has_32_steps(raw, step):
    with build(parameters=HELD, ideal=True) as drives:
        drives.write(0x2003, raw)
        hold(drives)
        assert lane(drives, "amplitude")[0] == pytest.approx(AMPLITUDE * step / 32.0)
        assert lane(drives, "i_a")[0] == pytest.approx(AMPLITUDE * step / 32.0, rel=0.06)  # less what a cycle loses
        drives.write(0x20A3, 1)
        drives.advance(0.02)
        assert lane(drives, "amplitude")[0] == pytest.approx(0.5 * AMPLITUDE * step / 32.0)


def test_the_current_goes_down_some_time_after_the_last_step_and_up_at_the_next():
    with build(parameters=SMOOTH | {"motor.viscous": MOTOR.viscous}) as drives:
        drives.write(0x2003, 191)
        drives.write(0x2004, 63)
        drives.write(0x204E, 255)
        drives.write(0x2089, 200)
        hold(drives)

        def share():
            return lane(drives, "amplitude")[0] / AMPLITUDE * 32.0

        assert share() == pytest.approx(24)
        drives.advance(0.3)
        assert share() == pytest.approx(8)
        drives.write(0x607A, 50_000)
        drives.write(0x6040, 0x1F)
        drives.advance(0.05)
        assert share() == pytest.approx(32)  # it speeds up
        drives.advance(0.5)
        assert lane(drives, "step_rate")[0] * PPS == pytest.approx(51_200)
        assert share() == pytest.approx(24)
        drives.advance(0.75)
        assert drives.read(0x6064)[0] == 50_000
        assert share() == pytest.approx(8)
        drives.write(0x204E, 0)
        drives.write(0x607A, 0)
        drives.write(0x6040, 0x0F)
        drives.write(0x6040, 0x1F)
        drives.advance(0.05)
        assert share() == pytest.approx(24)


def test_the_way_down_takes_a_while_for_each_step_of_the_current():
    with build(parameters=HELD) as drives:
        drives.write(0x2004, 0)
        drives.write(0x2089, 100)
        drives.write(0x20B9, 2)
        hold(drives)
        drives.advance(0.053)
        begin = lane(drives, "current_scale")[0]
        drives.advance(0.3)
        per_step = 2 * 2**18 / CLOCK  # 33 ms
        assert begin - lane(drives, "current_scale")[0] == pytest.approx(0.3 / per_step, rel=0.02)
        drives.advance(1.0)
        assert lane(drives, "amplitude")[0] == pytest.approx(AMPLITUDE / 32.0)


def test_parameters_of_a_drawn_machine_reach_its_record():
    with build(parameters={}, num_machines=4, randomise=True, seed=5) as drives:
        drawn = drives.machine.parameters
        fields = {"motor.L_s": "L_s", "motor.R_s": "R_nominal", "motor.detent_torque": "detent_torque",
                  "stage.chopper_clock": "chopper_clock"}  # fmt: skip
        for name, field in fields.items():
            np.testing.assert_allclose(lane(drives, field), drawn[name])
            assert np.ptp(drawn[name]) > 0.0
        drives.machine.set("motor.L_s", 1e-3)
        assert np.all(get_lanes(drives.inside.records, "L_s", 4) == 1e-3)
