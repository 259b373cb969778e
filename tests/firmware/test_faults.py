"""Faults of machines: each row of the table against physics, what the drive makes of it, and the way back."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rigs import ROOT, TESTS
from rigs.tables import every_row

from drive_env import EmulatedDrives, motion
from drive_env.devices import device_names, find_device
from drive_env.faults.effects import CHANGES, MOMENTS
from drive_env.faults.page import page
from drive_env.faults.schedule import Order, parse_order
from drive_env.faults.table import FAULTS, GROUPS, STEPS
from drive_env.firmware.record import get_lanes

# Files of the tests that the table names.
NAMED = ("firmware/test_faults.py", "bus/test_bus_faults.py", "firmware/test_fault_recovery.py")
FIRST = np.array([True, False])
REV = 65536  # increments per revolution
FAST = 500_000  # pps: 458 rpm, 47.9 rad/s
OMEGA = FAST / REV * 2.0 * math.pi
OF_MACHINES = [row.name for row in FAULTS.values() if row.group != "bus" and row.name != "store_interrupted"]
WITH_EMERGENCY = [name for name in OF_MACHINES if FAULTS[name].emergency is not None and name != "limit_switch"]
UNSEEN = [name for name in OF_MACHINES if FAULTS[name].emergency is None and name != "node_reset"]


def lanes(drives, name, part=0):
    return get_lanes(drives.inside.records, name, drives.num_axes, part).astype(float)


def turning(load="two_mass", window=30_000, friction=0.0, **options):
    """Two machines at 458 rpm in pv; `friction` [N*m] on the load."""
    drives = EmulatedDrives(load=load, num_machines=2, num_threads=1, **options)
    if friction:
        drives.machine.set_all({"load.coulomb": friction, "load.breakaway": friction})
    drives.write("Following error window", window)
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, FAST)
    drives.advance(0.4)
    assert drives.emergencies() == []
    return drives


def restart(drives):
    """The way back that needs most: reset the node, which aligns the commutation, and turn again."""
    drives.reset_node(FIRST)
    drives.advance(0.01)
    drives.write("Following error window", 30_000)
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, FAST)
    drives.emergencies()
    drives.advance(1.5)


# --- the table --------------------------------------------------------------------------------------------------------
def test_every_fault_of_a_machine_has_an_effect_and_every_effect_a_row():
    assert sorted({*CHANGES, *MOMENTS}) == sorted(OF_MACHINES)
    assert {row.group for row in FAULTS.values()} == set(GROUPS)


@every_row("name", FAULTS)
def test_a_row_is_whole(name):
    row = FAULTS[name]
    text = "".join((TESTS / name).read_text(encoding="utf-8") for name in NAMED)
    assert f"def {row.test}(" in text
    assert (row.emergency is None) == (row.detection is None)
    assert row.once == (name in MOMENTS)
    for parameter in row.parameters.values():
        assert parameter.low <= parameter.default <= parameter.high
    assert set(row.steps) <= set(STEPS)
    assert set(row.on) <= {find_device(device).firmware_name for device in device_names()}
    for sentence in (row.physics, row.drive, row.master, row.way_back):
        assert sentence[0].isupper() or sentence[0].isdigit()
        assert sentence.endswith(".")


def test_the_page_is_what_the_table_says():
    """Stale? Write it anew: python -m drive_env.faults.page docs/faults.md."""
    written = (ROOT / "docs" / "faults.md").read_text(encoding="utf-8")
    assert written == page()
    for row in FAULTS.values():
        assert f"### {row.name}\n" in written


# --- what each does to the drive --------------------------------------------------------------------------------------
SCENARIOS = {"open_phase": {"friction": 0.04}, "supply_surge": {"load": "inertia"}}


@pytest.mark.every(5)
@pytest.mark.parametrize("name", WITH_EMERGENCY)
def test_every_fault_does_what_its_row_says(name):
    """Its emergency comes within its detection time, the neighbour goes on, and the way back needs no new program."""
    row = FAULTS[name]
    with turning(**SCENARIOS.get(name, {})) as drives:
        if name == "halls_lost":
            drives.write("Commutation Mode", 2)
            drives.advance(0.1)
        number = drives.machine.fault(name, at=0.01, where=FIRST)
        drives.advance(0.01)
        assert drives.emergencies() == []
        cycles = 0
        while not (found := drives.emergencies()):
            cycles += 1
            assert cycles * 0.001 <= row.detection + 1e-9, "not detected"
            drives.advance(0.001)
        assert (found[0].axis, found[0].code) == (0, row.emergency)
        assert drives.machine.faults()[0].active.tolist() == [True, False]
        drives.advance(1.5)  # the fault reaction gives an axis up that does not come to rest within a second
        assert drives.read(0x6041)[0] & 0x4F == 0x08
        assert lanes(drives, "i_q")[0] == 0.0
        assert drives.read(0x6041)[1] & 0x6F == 0x27
        drives.machine.clear_fault(number)
        assert drives.machine.faults() == []
        drives.advance(1.0)
        if "reset_node" in row.steps:
            restart(drives)
        else:
            motion.reset_fault(drives, where=FIRST)
            motion.enable(drives, mode="pv")
            drives.write(0x60FF, FAST)
            drives.emergencies()
            drives.advance(1.5)
        np.testing.assert_allclose(drives.machine.rotor_speed, OMEGA, rtol=0.03)
        assert drives.emergencies() == []


@pytest.mark.parametrize("name", UNSEEN)
def test_what_no_drive_sees_ends_in_no_emergency(name):
    row = FAULTS[name]
    with turning() as drives:
        drives.machine.fault(name, duration=None if row.once else 0.3, where=FIRST)
        drives.advance(0.5)
        assert drives.machine.faults() == []
        drives.advance(0.5)
        assert drives.emergencies() == []
        np.testing.assert_allclose(drives.machine.rotor_speed[1], OMEGA, rtol=0.03)


# --- sensors ----------------------------------------------------------------------------------------------------------
COUNTED = {"encoder_lost_counts": 0.9, "encoder_stuck": 0.0, "encoder_reversed": -1.0}


@pytest.mark.parametrize("name", [*COUNTED, "encoder_jump"])
def test_encoder_faults_touch_what_is_counted_and_not_the_rotor(name):
    """A coasting rotor: only what 6064h tells changes, by the counts that it should; and nothing comes back after."""
    with turning(load="inertia") as drives:
        motion.disable(drives)
        drives.advance(0.01)
        drives.machine.fault(name, duration=None if name == "encoder_jump" else 0.05, where=FIRST)
        start, counted = drives.machine.rotor_angle, drives.read(0x6064)
        drives.advance(0.05)
        turned = (drives.machine.rotor_angle - start) / (2.0 * math.pi) * REV
        moved = drives.read(0x6064) - counted
        count = REV / 4096
        expected = turned[0] + 0.1 / (2.0 * math.pi) * REV if name == "encoder_jump" else COUNTED[name] * turned[0]
        assert turned[0] == pytest.approx(turned[1], rel=0.01)
        assert turned[0] > 20_000
        # Each sample is a window older than the rotor: 200 us at 458 rpm are 6 counts, told in either direction.
        assert moved[0] - expected == pytest.approx(0.0, abs=14 * count)
        assert moved[1] - turned[1] == pytest.approx(0.0, abs=2 * count)
        drives.advance(0.001)
        assert drives.machine.faults() == []
        before, angle = drives.read(0x6064), drives.machine.rotor_angle
        drives.advance(0.05)
        after = (drives.machine.rotor_angle - angle) / (2.0 * math.pi) * REV
        np.testing.assert_allclose(drives.read(0x6064) - before, after, atol=8 * count)


def test_a_jump_is_one_wild_sample_of_velocity():
    with turning(load="inertia") as drives:
        motion.disable(drives)
        drives.machine.fault("encoder_jump", at=0.005, where=FIRST, angle=0.5)
        speed, sound = drives.record([0x606C], 0.03)[0x606C].T
    np.testing.assert_allclose(speed[:5], sound[:5], rtol=0.1)
    assert speed[6] > 3.0 * FAST
    assert speed[-1] == pytest.approx(sound[-1], rel=0.1)


def test_encoder_noise_scatters_what_is_measured_by_its_rms_and_ends_without_a_trace():
    def positions(seed, angle):
        with EmulatedDrives(load="inertia", num_machines=2, seed=seed, num_threads=1) as drives:
            drives.machine.fault("encoder_noise", duration=2.0, where=FIRST, angle=angle)
            trace = drives.record([0x6064], 2.0)[0x6064]
            drives.advance(0.01)
            return trace, drives.read(0x6064)

    trace, after = positions(3, 0.02)
    counts = trace[10:, 0] / REV * 2.0 * math.pi
    assert np.std(counts) == pytest.approx(0.02, rel=0.1)
    assert abs(np.mean(counts)) < 0.002
    assert np.all(trace[:, 1] == trace[0, 1])
    assert after[0] == after[1]
    # By the seed: the same again, another one otherwise.
    assert np.array_equal(positions(3, 0.02)[0], trace)
    assert not np.array_equal(positions(4, 0.02)[0], trace)


def test_a_current_offset_is_a_wrong_current_of_that_size():
    """The loop drives the measured current to its set-point: what flows in phase A is off by what the sensor is."""
    held = {"load.coulomb": 5.0, "load.breakaway": 5.0}
    with EmulatedDrives(load="inertia", num_machines=2, ideal=True, parameters=held, num_threads=1) as drives:
        motion.enable(drives, mode="cst")
        drives.machine.fault("current_offset", where=FIRST, current=1.5)
        drives.advance(0.2)
        angle = lanes(drives, "n_p") * lanes(drives, "theta_m")
        i_a = np.cos(angle) * lanes(drives, "i_d") - np.sin(angle) * lanes(drives, "i_q")
    assert i_a[0] == pytest.approx(-1.5, abs=0.05)
    assert i_a[1] == pytest.approx(0.0, abs=0.05)


# --- motor ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("phase", [0, 1, 2])
def test_an_open_phase_carries_no_current(phase):
    with turning(load="inertia", friction=0.04, window=0) as drives:
        drives.machine.fault("open_phase", where=FIRST, phase=phase)
        largest = np.zeros(2)
        for _ in range(20):
            drives.advance(0.001)
            angle = lanes(drives, "n_p") * lanes(drives, "theta_m")
            i_alpha = np.cos(angle) * lanes(drives, "i_d") - np.sin(angle) * lanes(drives, "i_q")
            i_beta = np.sin(angle) * lanes(drives, "i_d") + np.cos(angle) * lanes(drives, "i_q")
            axis = 2.0 * math.pi / 3.0 * phase
            largest = np.maximum(largest, np.abs(np.cos(axis) * i_alpha + np.sin(axis) * i_beta))
    # The rotor turns by 0.008 rad within the last tick, in whose middle the current was projected out.
    assert largest[0] < 0.2
    assert largest[1] > 0.7


def test_a_demagnetised_motor_needs_more_current_for_the_same_torque():
    held = {"load.coulomb": 0.05, "load.breakaway": 0.05, "load.viscous": 0.0}
    with turning(load="inertia", ideal=True, parameters=held) as drives:
        drives.machine.fault("demagnetised", where=FIRST, share=0.4)
        drives.advance(0.5)
        current = lanes(drives, "i_q")
        np.testing.assert_allclose(drives.machine.rotor_speed, OMEGA, rtol=0.01)
        assert current[0] / current[1] == pytest.approx(1.0 / 0.6, rel=0.02)
        # As it was built, and what it is.
        assert drives.machine.parameters["motor.psi_m"][0] == drives.machine.parameters["motor.psi_m"][1]


# --- supply -----------------------------------------------------------------------------------------------------------
def test_a_short_dip_is_bridged_by_the_capacitor_and_a_long_one_trips():
    """C du/dt = -i: the link of 2 mF falls from 24 V to the limit of 8 V in C (u0 - u1) / i with the idle current."""
    parameters = {"stage.idle_current": 0.2, "stage.dc_capacitance": 2e-3}
    with EmulatedDrives(load="inertia", num_machines=2, parameters=parameters, num_threads=1) as drives:
        motion.enable(drives, mode="pv")
        drives.machine.fault("supply_dip", duration=0.1, where=FIRST, voltage=0.0)
        drives.advance(0.3)
        assert drives.emergencies() == []
        start = drives.inside.cycle
        drives.machine.fault("supply_dip", where=FIRST, voltage=0.0)
        while not (found := drives.emergencies()):
            drives.advance(0.001)
    assert found[0].code == 0xFF00
    assert (drives.inside.cycle - start) * 0.001 == pytest.approx(2e-3 * 16.0 / 0.2, rel=0.05)


# --- load -------------------------------------------------------------------------------------------------------------
LOADS = ("inertia", "two_mass", "belt", "ball_screw", "geared_joint", "gantry")


@pytest.mark.parametrize("load", LOADS)
def test_a_jam_holds_the_load_and_lets_it_go_again(load):
    """It holds against gravity and all the torque the motor has; the joints stay within what is elastic."""
    with EmulatedDrives(load=load, num_machines=2, num_threads=1) as drives:
        drives.write("Following error window", 0)
        motion.enable(drives, mode="cst")
        number = drives.machine.fault("jam", where=FIRST, torque=50.0)
        drives.advance(0.05)
        place = drives.machine.joint_positions.copy()
        drives.write("Target torque", 2000)
        drives.advance(0.05)
        held = drives.machine.joint_positions.copy()
        drives.advance(0.05)
        moved = np.abs(drives.machine.joint_positions - held)
        assert np.all(moved[0] <= 1e-3 + 0.02 * moved[1].max()), moved
        assert np.abs(held - place)[1].max() > 20.0 * max(np.abs(drives.machine.rotor_speed)[0] * 1e-3, 1e-6)
        drives.machine.clear_fault(number)
        drives.advance(0.1)
        assert np.abs(drives.machine.joint_positions - held)[0].max() > 10.0 * moved[0].max()


def test_a_broken_coupling_frees_the_load():
    """The load coasts with its own friction alone; the rotor accelerates as if alone."""
    free = {"load.coulomb": 0.0, "load.breakaway": 0.0, "load.viscous": 0.0}
    with turning(ideal=True, parameters=free) as drives:
        drives.machine.fault("broken_coupling", where=FIRST)
        drives.advance(0.1)
        before = drives.machine.joint_positions
        drives.write(0x60FF, 0)
        drives.advance(0.2)
        after = drives.machine.joint_positions
        load = (after - before).sum(axis=1) / 0.2
        assert load[0] == pytest.approx(OMEGA, rel=0.02)  # it goes on while the rotor stands
        assert abs(load[1]) < 0.3 * OMEGA
        assert abs(drives.machine.rotor_speed[0]) < 1.0
        drives.machine.clear_fault()
        drives.advance(0.05)
        np.testing.assert_allclose(drives.machine.joint_positions[:, 1], 0.0, atol=0.02)  # joined again, at rest
        drives.write(0x60FF, FAST)
        drives.advance(0.5)
        np.testing.assert_allclose(drives.machine.rotor_speed, OMEGA, rtol=0.02)


@pytest.mark.parametrize("load", ["belt", "ball_screw", "geared_joint", "three_mass"])
def test_couplings_of_other_loads_break_and_are_mended(load):
    with EmulatedDrives(load=load, num_machines=2, num_threads=1) as drives:
        motion.enable(drives, mode="pv")
        number = drives.machine.fault("broken_coupling", where=FIRST)
        drives.write(0x60FF, 100_000)
        drives.advance(0.3)
        joints = np.abs(drives.machine.joint_positions)
        assert joints[0].max() == pytest.approx(joints[1].max(), rel=0.3)
        drives.machine.clear_fault(number)
        drives.advance(0.3)
        assert drives.emergencies() == []
        assert not drives.machine.diverged.any()
        np.testing.assert_allclose(*drives.machine.rotor_speed, rtol=0.1)


@pytest.mark.parametrize("load", ["inertia", "robot", "gantry"])
def test_what_no_coupling_joins_cannot_break(load):
    with (
        EmulatedDrives(load=load, num_threads=1) as drives,
        pytest.raises(ValueError, match=f"load '{load}' has no coupling .*two_mass, three_mass, belt"),
    ):
        drives.machine.fault("broken_coupling")


def test_a_load_without_switches_has_none_that_sticks():
    with (
        EmulatedDrives(load="inertia", num_threads=1) as drives,
        pytest.raises(ValueError, match="load 'inertia' has no switches; take one that has: belt"),
    ):
        drives.machine.fault("limit_switch")


def test_a_payload_jump_is_that_factor_of_inertia():
    with EmulatedDrives(load="inertia", num_machines=2, num_threads=1) as drives:
        rotor, load = drives.machine.parameters["motor.inertia"][0], drives.machine.parameters["load.inertia"][0]
        drives.machine.fault("payload_jump", at=0.002, duration=0.01, where=FIRST, factor=4.0)
        drives.advance(0.005)
        np.testing.assert_allclose(lanes(drives, "J_rotor"), [rotor + 4.0 * load, rotor + load], rtol=1e-9)
        drives.advance(0.01)
        np.testing.assert_allclose(lanes(drives, "J_rotor"), rotor + load, rtol=1e-9)


def test_a_change_that_cannot_be_stepped_is_refused_at_once_and_changes_nothing():
    with EmulatedDrives(load="two_mass", num_threads=1) as drives:
        inertia = lanes(drives, "J_rotor")
        drives.machine.set("load.stiffness", 3.9 * drives.machine.parameters["load.stiffness"])
        with pytest.raises(ValueError, match="resonates at"):
            drives.machine.fault("payload_jump", at=1.0, factor=0.05)
        assert np.array_equal(lanes(drives, "J_rotor"), inertia)
        assert drives.machine.faults() == []


# --- node -------------------------------------------------------------------------------------------------------------
def test_a_node_that_resets_in_motion_lets_the_rotor_coast_and_counts_from_0():
    with turning(load="inertia") as drives:
        drives.machine.fault("node_reset", at=0.01, where=FIRST)
        drives.advance(0.012)
        assert drives.read(0x6041)[0] & 0x4F == 0x40
        assert drives.read(0x6041)[1] & 0x6F == 0x27
        assert 0 < drives.read(0x6064)[0] < 3 * FAST * 0.001
        assert lanes(drives, "i_q")[0] == 0.0
        assert drives.machine.rotor_speed[0] == pytest.approx(OMEGA, rel=0.05)
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, FAST)
        drives.advance(0.5)
        np.testing.assert_allclose(drives.machine.rotor_speed, OMEGA, rtol=0.03)


# --- schedules --------------------------------------------------------------------------------------------------------
def test_a_fault_begins_and_ends_at_its_cycles():
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        drives.machine.fault("supply_surge", at=0.003, duration=0.004, voltage=30.0)
        seen = []
        for _ in range(10):
            drives.advance(0.001)
            seen.append(drives.machine.supply[0])
        drives.machine.fault("supply_surge", at=0.003, duration=0.004, voltage=30.0)
        drives.advance(0.005)
        assert drives.machine.supply[0] == 30.0
    assert seen == [24.0] * 3 + [30.0] * 4 + [24.0] * 3


def test_conditions_are_of_each_machine():
    with EmulatedDrives(load="inertia", num_machines=2, num_threads=1) as drives:
        drives.machine.fault("demagnetised", when="enabled", at=0.005)
        drives.machine.fault("supply_surge", when="speed > 20", duration=0.01, voltage=30.0)
        drives.machine.fault("enable_lost", when="position < -3.0")
        motion.enable(drives, mode="pv", where=FIRST)
        enabled = drives.inside.cycle
        while not drives.machine.faults()[0].active[0]:
            drives.advance(0.001)
        # Seen at the end of the cycle in which the state was reached.
        assert 5 <= drives.inside.cycle - enabled <= 7
        assert not drives.machine.faults()[0].active[1]
        drives.write(0x60FF, FAST, where=FIRST)
        drives.advance(0.5)
        names = [fault.order.name for fault in drives.machine.faults()]
        assert names == ["demagnetised", "supply_surge", "enable_lost"]
        assert [fault.waiting.tolist() for fault in drives.machine.faults()[1:]] == [[False, True], [True, True]]
        drives.write(0x60FF, -FAST, where=FIRST)
        drives.advance(2.0)
        assert [(m.axis, m.code) for m in drives.emergencies()] == [(0, 0x5441)]


def test_faults_of_one_quantity_act_one_on_the_other_and_end_in_any_order():
    with EmulatedDrives(load="inertia", num_machines=2, num_threads=1) as drives:
        psi = lanes(drives, "psi_nominal")
        first = drives.machine.fault("demagnetised", share=0.5, where=FIRST)
        drives.machine.fault("demagnetised", share=0.2, at=0.005)
        drives.advance(0.01)
        np.testing.assert_allclose(lanes(drives, "psi_nominal") / psi, [0.4, 0.8])
        drives.machine.clear_fault(first)
        np.testing.assert_allclose(lanes(drives, "psi_nominal") / psi, [0.8, 0.8])
        # What the machine is built of may change meanwhile; the fault stays on top.
        drives.machine.set("motor.psi_m", 2.0 * psi[0], FIRST)
        np.testing.assert_allclose(lanes(drives, "psi_nominal") / psi, [1.6, 0.8])
        drives.machine.clear_fault()
        np.testing.assert_allclose(lanes(drives, "psi_nominal") / psi, [2.0, 1.0])


def test_supply_and_enable_input_that_are_set_during_a_fault_come_back_as_set():
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        drives.machine.fault("supply_dip")
        drives.machine.fault("enable_lost")
        drives.advance(0.001)
        drives.machine.supply = 30.0
        drives.machine.enable_input = True
        assert drives.machine.supply[0] == 5.0
        assert not drives.machine.enable_input[0]
        drives.machine.clear_fault()
        assert drives.machine.supply[0] == 30.0
        assert drives.machine.enable_input[0]


def test_a_reset_ends_faults_of_these_machines():
    with EmulatedDrives(load="inertia", num_machines=2, num_threads=1) as drives:
        drives.machine.fault("supply_dip", duration=1.0)
        drives.machine.fault("demagnetised", at=0.5)
        drives.advance(0.001)
        drives.machine.reset(FIRST)
        assert drives.machine.supply.tolist() == [24.0, 5.0]
        assert [fault.waiting.tolist() for fault in drives.machine.faults()] == [[False] * 2, [False, True]]
        drives.machine.reset()
        assert drives.machine.faults() == []


def test_an_axis_of_a_machine_fails_alone():
    with EmulatedDrives(load="gantry", num_machines=2, num_threads=1) as drives:
        drives.machine.fault("demagnetised", axis=1, where=FIRST, share=0.5)
        drives.advance(0.001)
        psi = lanes(drives, "psi_nominal")
        np.testing.assert_allclose(psi / psi[0], [1.0, 0.5, 1.0, 1.0])


def test_the_run_is_the_same_however_it_is_cut_and_without_a_fault_nothing_changes():
    def trace(fault, pieces):
        with turning() as drives:
            if fault:
                drives.machine.fault("encoder_lost_counts", at=0.013, duration=0.02, where=FIRST)
                drives.machine.fault("payload_jump", when="speed > 10", at=0.03, where=FIRST)
            parts = [drives.record([0x6064, 0x6077], 0.06 / pieces) for _ in range(pieces)]
            return np.concatenate([np.stack([p[0x6064], p[0x6077]]) for p in parts], axis=1)

    sound, whole, cut = trace(False, 1), trace(True, 1), trace(True, 12)
    assert np.array_equal(whole, cut)
    assert np.array_equal(whole[:, :, 1], sound[:, :, 1])
    assert not np.array_equal(whole[:, :, 0], sound[:, :, 0])
    assert np.array_equal(whole[:, :13, 0], sound[:, :13, 0])


# --- mistakes ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("name", "options", "message"), [
    ("encoder_stuk", {}, "no fault is named 'encoder_stuk'; there are encoder_lost_counts, "),
    ("bus_loss", {}, "of a bus and its nodes, .* drive-env serve --fault 'bus_loss'"),
    ("store_interrupted", {}, "of a bus and its nodes"),
    ("encoder_stuck", {"share": 1.0}, "fault encoder_stuck has no parameter 'share'; it has none"),
    ("demagnetised", {"share": 1.5}, "share=1.5 must be 0 to 0.95$"),
    ("demagnetised", {"share": math.nan}, "share must be a finite number, not nan"),
    ("open_phase", {"phase": 0.5}, "phase=0.5 must be a whole number"),
    ("encoder_stuck", {"at": 0.0005}, "not a whole number of communication cycles"),
    ("encoder_stuck", {"duration": 0.0}, "duration=0 s must be 0.001 s or more"),
    ("encoder_jump", {"duration": 0.1}, "is a moment and has no duration"),
    ("encoder_stuck", {"when": "torque > 3"}, "is not a condition; use 'enabled', or compare position"),
    ("encoder_stuck", {"when": "speed > nan"}, "is not a condition"),
    ("encoder_stuck", {"axis": 1}, "axis=1 must be 0 to 0 of a machine"),
    ("encoder_stuck", {"where": np.ones(3, bool)}, r"shape \(1,\)"),
])  # fmt: skip
def test_a_mistake_is_told_and_changes_nothing(name, options, message):
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        with pytest.raises(ValueError, match=message):
            drives.machine.fault(name, **options)
        assert drives.machine.faults() == []


def test_an_unknown_number_is_told_with_those_there_are():
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        number = drives.machine.fault("encoder_stuck")
        with pytest.raises(ValueError, match=f"there is no fault 77; there are {number}"):
            drives.machine.clear_fault(77)


@pytest.mark.parametrize(("text", "order"), [
    ("encoder_stuck", Order("encoder_stuck")),
    ("jam at=2 duration=0.1 torque=3", Order("jam", 2.0, duration=0.1, parameters={"torque": 3.0})),
    ("jam when='speed > 3' node=2", Order("jam", when="speed > 3", node=2)),
])  # fmt: skip
def test_a_fault_as_a_line_of_text(text, order):
    assert parse_order(text) == order


@pytest.mark.parametrize(("text", "message"), [
    ("", "must begin with its name"),
    ("at=2", "must begin with its name"),
    ("jam now", "'now' must be as at=2; keys are at, when, duration, node, axis and parameters"),
    ("jam at=soon", "at must be a number, not 'soon'"),
    ("jam node=1.5", "node must be a whole number, not 1.5"),
    ("jam when='speed", "No closing quotation"),
])  # fmt: skip
def test_a_line_that_is_none_is_told(text, message):
    with pytest.raises(ValueError, match=message):
        parse_order(text)


def test_faults_that_together_cannot_be_stepped_are_called_off_with_a_warning():
    with EmulatedDrives(load="two_mass", num_threads=1) as drives:
        inertia = drives.inside.groups[0].load.get("inertia")
        drives.machine.fault("payload_jump", factor=0.1)
        drives.machine.fault("payload_jump", factor=0.1, at=0.005)
        drives.advance(0.003)
        np.testing.assert_allclose(drives.inside.groups[0].load.get("inertia"), 0.1 * inertia)
        with pytest.warns(RuntimeWarning, match=r"fault 2 \(payload_jump\) is called off: together with the others"):
            drives.advance(0.01)
        np.testing.assert_allclose(drives.inside.groups[0].load.get("inertia"), 0.1 * inertia)
        assert [fault.number for fault in drives.machine.faults()] == [1]
        drives.machine.clear_fault()
        np.testing.assert_allclose(drives.inside.groups[0].load.get("inertia"), inertia)
