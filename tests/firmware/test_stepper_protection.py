"""What a stepper drive watches, by physical cause: the driver's error flags, emergencies, faults that it can have."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from rigs.stepper_rig import BARE, SMOOTH, build, hold, lane

from drive_env import EmulatedDrives, motion
from drive_env.emulator.loop_trace import SIGNALS, trace_loops
from drive_env.motors import MOTORS

MOTOR = MOTORS["qsh4218_51"]
DAMPED = SMOOTH | {"motor.viscous": MOTOR.viscous}
FAULT, ENABLED = 0x08, 0x27
# Error flags of the driver (TMCM-3313 manual, table 155).
OT, OTPW, UV, OCHS, OLB, OLA = 0x80, 0x40, 0x20, 0x10, 0x08, 0x04


def told(drives):
    """Return codes and first bytes of the emergencies since the last look."""
    return [(m.code, m.extra[0]) for m in drives.emergencies()]


@pytest.mark.parametrize(("phase", "flag", "byte"), [(0, OLA, 1), (1, OLB, 2)])
def test_a_broken_cable_is_an_open_load_once_its_phase_should_carry_current(phase, flag, byte):
    with build(parameters=DAMPED) as drives:
        hold(drives)
        drives.machine.fault("open_phase", phase=phase)
        drives.write(0x607A, 51_200)
        drives.write(0x6040, 0x1F)
        drives.advance(0.5)
        assert told(drives) == [(0x1000, byte)]
        assert drives.read(0x6041)[0] & 0x4F == FAULT
        assert drives.read(0x2102)[0] == flag
        drives.machine.clear_fault()
        drives.write(0x6040, 0x00)
        drives.write(0x6040, 0x80)
        drives.advance(0.01)
        assert drives.read(0x2102)[0] == 0
        assert drives.read(0x6041)[0] & 0x4F == 0x40


def test_a_phase_that_the_back_emf_keeps_small_is_no_open_load():
    with build(parameters=DAMPED) as drives:
        motion.enable(drives, mode="pv")
        drives.write(0x6083, 10**6)
        drives.write(0x60FF, 600_000)  # far above the rated speed: the supply hardly carries any current
        drives.advance(1.5)
        assert drives.emergencies() == []
        assert drives.read(0x6041)[0] & 0x6F == ENABLED


def test_a_short_circuit_in_the_stage_is_an_overcurrent_unless_it_is_not_watched():
    with build(num_machines=2, parameters=DAMPED) as drives:
        drives.write(0x20A1, [0, 1])
        hold(drives)
        drives.machine.fault("stage_short", conductance=2.0)
        drives.advance(0.002)
        assert next((m.axis, m.code) for m in drives.emergencies()) == (0, 0x2310)
        assert drives.read(0x2102)[0] & OCHS
        np.testing.assert_array_equal(lane(drives, "fault") > 0, [True, drives.read(0x2102)[1] & UV > 0])


@pytest.mark.parametrize(("phase", "code", "flag"), [(0, 0x2312, 0x01), (1, 0x2311, 0x02)])
def test_a_short_to_ground_is_seen_by_its_bridge(phase, code, flag):
    with build(parameters=DAMPED) as drives:
        hold(drives)
        drives.machine.fault("stage_short", phase=phase, conductance=2.0)
        drives.advance(0.002)
        assert told(drives) == [(code, 0)]
        assert drives.read(0x2102)[0] == flag
        assert lane(drives, "stage_on")[0] == 0.0
        drives.write(0x6040, 0x00)
        drives.write(0x6040, 0x80)
        drives.advance(0.01)
        assert drives.read(0x2102)[0] == 0  # a bridge that is off carries nothing
        motion.enable(drives, mode="pp", timeout=0.01)
        drives.advance(0.01)
        assert told(drives)[-1] == (code, 0)


def test_a_short_to_ground_that_is_not_watched_drains_the_link_and_burns_the_stage():
    """Its bridge is on for the share u/U of the time: the link loses G |u|, the stage gains R G^2 U |u|."""
    with build(num_machines=3, parameters=DAMPED | {"stage.thermal_time": 0.5}) as drives:
        drives.write(0x20A1, 1)
        hold(drives)
        for machine, conductance in ((1, 0.8), (2, 6.0)):
            drives.machine.fault("stage_short", phase=0, conductance=conductance, where=np.arange(3) == machine)
        drives.advance(0.02)
        u, u_dc = abs(lane(drives, "u_a")), lane(drives, "u_dc")
        assert u[1] > 0.5
        drawn = lane(drives, "drain") - lane(drives, "drain")[0]
        np.testing.assert_allclose(drawn, np.array([0.0, 0.8, 6.0]) * u, rtol=0.05)
        sags = (u_dc[0] - u_dc) / drives.machine.parameters["stage.supply_resistance"]
        np.testing.assert_allclose(sags, drawn, rtol=0.1, atol=0.01)
        drives.advance(3.0)
        rise = drives.machine.temperatures[1] - drives.machine.temperatures[1][0]
        loss = drives.machine.parameters["stage.on_resistance"] * 0.64 * lane(drives, "u_dc") * abs(lane(drives, "u_a"))
        heat = drives.machine.parameters["stage.thermal_resistance"]
        assert rise[1] == pytest.approx((loss * heat)[1], rel=0.05)
        assert {m.axis for m in drives.emergencies() if m.code == 0x4310} == {2}
        assert drives.read(0x6041)[2] & 0x4F == FAULT


@pytest.mark.parametrize(("setting", "needed"), [(0, 3.2e-6), (1, 1.6e-6), (2, 1.2e-6), (3, 0.8e-6)])
def test_a_bridge_sees_a_short_only_if_it_is_on_for_long_enough(setting, needed):
    """20A2h (TMC262 data sheet, TS2G). A high supply makes a bridge short on."""
    with build(num_machines=8, parameters=DAMPED) as drives:
        drives.write(0x20A2, setting)
        drives.write(0x2096, [0, 0, 1, 1, 2, 3, 4, 5])  # the hysteresis, and so the time that a bridge is on
        drives.write(0x2092, [0, 1, 0, 1, 1, 1, 2, 2])
        drives.machine.supply = 58.0
        hold(drives)
        on_time = lane(drives, "on_time")
        drives.machine.fault("stage_short", phase=1, conductance=2.0)
        drives.advance(0.005)
        seen = np.zeros(8, bool)
        seen[[m.axis for m in drives.emergencies() if m.code == 0x2311]] = True
        np.testing.assert_array_equal(seen, on_time > needed)


def test_a_short_is_at_a_bridge_that_there_is():
    with build() as drives, pytest.raises(ValueError, match=r"phase=2 must be -1 to 1"):
        drives.machine.fault("stage_short", phase=2)
    with (
        EmulatedDrives(load="inertia", num_threads=1) as drives,
        pytest.raises(
            ValueError,
            match="fault stage_short: phase=0 must be -1 to -1 of a tmcm1636; -1 is a short across the DC link",
        ),
    ):
        drives.machine.fault("stage_short", phase=0)


def test_too_much_amplitude_of_the_voltage_pwm_is_an_overcurrent():
    """24 V over 0.5 ohm and the stage's 0.05: nothing but they limit the current of voltage PWM."""
    with build("qsh4218_47", parameters=SMOOTH) as drives:
        drives.write(0x20B0, 10**6)
        drives.write(0x20B1, 1)
        drives.write(0x20B2, 40)
        hold(drives)
        assert lane(drives, "i_a")[0] == pytest.approx(24.0 * 40 / 255 / 0.55, rel=0.02)
        drives.write(0x20B2, 250)
        drives.advance(0.02)
        assert (0x2312, 0) in told(drives)
        assert drives.read(0x2102)[0] & 0x01
        assert lane(drives, "i_a")[0] == 0.0


def test_supply_temperature_and_enable_input_cut_the_stage():
    with build(num_machines=4, parameters=DAMPED) as drives:
        hold(drives)
        drives.machine.supply = [24.0, 24.0, 24.0, 5.0]
        drives.machine.enable_input = [True, False, True, True]
        drives.machine.set_temperatures(25.0, [25.0, 25.0, 105.0, 25.0])
        drives.advance(0.1)
        codes = {(m.axis, m.code) for m in drives.emergencies()}
        assert codes == {(1, 0x5441), (2, 0x4310), (3, 0xFF00)}
        flags = drives.read(0x2102)
        assert (flags[0], flags[1]) == (0, 0)
        assert flags[2] == OT | OTPW and flags[3] == UV
        np.testing.assert_array_equal(lane(drives, "stage_on"), [1, 0, 0, 0])
        np.testing.assert_array_equal(lane(drives, "i_a")[1:], 0.0)


def test_the_winding_warms_by_80_k_at_its_rated_current():
    quick = {"motor.thermal_time": 0.2, "motor.thermal_resistance": MOTOR.thermal_resistance}
    with build(parameters=SMOOTH | quick, ideal=True) as drives:
        drives.write(0x2095, 0)
        hold(drives)
        drives.advance(2.0)
        carried = lane(drives, "i_a")[0] ** 2 + lane(drives, "i_b")[0] ** 2 + lane(drives, "ripple")[0] ** 2 / 6.0
        loss = lane(drives, "R_s")[0] * carried
        rise = drives.machine.temperatures[0][0] - 25.0
        assert rise == pytest.approx(loss * MOTOR.thermal_resistance, rel=1e-3)
        assert rise == pytest.approx(80.0, rel=0.05)
        assert lane(drives, "R_s")[0] == pytest.approx(MOTOR.R_s * (1.0 + 0.00393 * rise))


@pytest.mark.parametrize("name", ["encoder_stuck", "encoder_noise", "encoder_lost_counts", "encoder_reversed"])
def test_faults_of_the_encoder_show_in_its_position_alone(name):
    with build(parameters=DAMPED) as drives:
        drives.write(0x606A, 0)
        hold(drives)
        drives.machine.fault(name)
        motion_end = 10_000
        drives.write(0x607A, motion_end)
        drives.write(0x6040, 0x1F)
        drives.advance(0.5)
        assert drives.read(0x6063)[0] == motion_end
        trace = drives.record([0x6064], 0.1)[0x6064][:, 0]
        assert np.any(np.abs(trace - motion_end) > 8)


def test_a_shorted_winding_and_lost_magnets_are_faults_of_a_stepper_too():
    with build(num_machines=3, parameters=DAMPED) as drives:
        hold(drives)
        drives.machine.fault("winding_short", left=0.5, where=np.array([False, True, False]))
        drives.machine.fault("demagnetised", share=0.4, where=np.array([False, False, True]))
        drives.advance(0.01)
        np.testing.assert_allclose(lane(drives, "L_s") / MOTOR.L_q, [1.0, 0.5, 1.0])
        np.testing.assert_allclose(lane(drives, "psi_nominal") / MOTOR.psi_m, [1.0, 1.0, 0.6])


@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        ("halls_lost", {}, "fault halls_lost: a .*bare_stepper and its motor have nothing that this fault changes"),
        ("current_offset", {}, "have nothing that this fault changes"),
        ("open_phase", {"phase": 2}, "fault open_phase: phase=2 must be 0 to 1 of this motor"),
    ],
)
def test_a_fault_of_what_a_stepper_lacks_is_refused(name, given, message):
    with build() as drives, pytest.raises(ValueError, match=message):
        drives.machine.fault(name, **given)


def test_loops_that_a_stepper_lacks_are_not_traced():
    with build() as drives:
        shown = trace_loops(drives, ["position_demand", "theta_meas", "omega_meas", "theta_m"], 0.002).signals
        assert all(rows.shape == (10, 1) for rows in shown.values())
        with pytest.raises(ValueError, match="no signal is named 'i_q_ref'; there are position_demand"):
            trace_loops(drives, ["i_q_ref"], 0.002)
    assert "i_q_ref" in SIGNALS


def test_a_stage_that_names_what_a_stepper_has_not_is_refused(tmp_path):
    shutil.copytree(BARE, tmp_path / "other")
    file = tmp_path / "other" / "device.toml"
    row = '[stage.dead_time]\ndefault = 3e-7\nlow = 1e-7\nhigh = 7e-7\nideal = 0.0\nunit = "s"\nsource = "x"\n'
    file.write_text(file.read_text(encoding="utf-8") + row, encoding="utf-8")
    with pytest.raises(
        ValueError, match=r"\[stage.dead_time\] is no parameter of firmware 'stepper'; there are chopper"
    ):
        EmulatedDrives(str(tmp_path / "other"), "inertia", None)


def test_tracing_the_loops_changes_nothing():
    """A cycle that is run window by window is the same cycle."""
    ends = []
    for traced in (False, True):
        with build(num_machines=3, parameters={}) as drives:
            motion.enable(drives, mode="pv")
            drives.write(0x60FF, [20_000, -40_000, 5_000])
            if traced:
                trace_loops(drives, ["omega_m"], 0.2)
            else:
                drives.advance(0.2)
            ends.append(drives.inside.records.tobytes())
    assert ends[0] == ends[1]


def test_a_machine_is_the_same_alone_and_among_others():
    seen = []
    for number, first in ((5, 0), (1, 3)):
        with build(num_machines=number, first_machine=first, parameters={}, randomise=True, seed=4) as drives:
            motion.enable(drives, mode="pv")
            drives.write(0x60FF, 30_000)
            drives.advance(0.3)
            seen.append([lane(drives, name)[3 - first] for name in ("theta_m", "i_a", "omega_m", "u_dc")])
    assert seen[0] == seen[1]


def test_a_reset_puts_everything_to_rest():
    with build(parameters={}) as drives:
        names = [name for name in drives.inside.records.dtype.names if name != "padding"]
        before = {name: drives.inside.records[name][..., 0].copy() for name in names}
        hold(drives)
        drives.write(0x607A, 30_000)
        drives.write(0x6040, 0x1F)
        drives.advance(0.4)
        drives.machine.reset()
        for name in names:
            np.testing.assert_array_equal(drives.inside.records[name][..., 0], before[name], name)
