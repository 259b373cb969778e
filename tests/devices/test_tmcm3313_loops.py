"""The TMCM-3313 in a loop: load detection, NMT, and tuning over a bus."""

from __future__ import annotations

import numpy as np
import pytest
from rigs.canopen_wire import Wire
from rigs.closed_loop_rig import MOTOR, NAME, PID_RECIPE, target_of
from rigs.world_bus import on_bus

from drive_env import EmulatedDrives, cia402, motion
from drive_env.cia402 import State, state_of
from drive_env.devices.gain_set import LOAD_ANGLE
from drive_env.dictionary.roles import Role
from drive_env.drives.raw_gains import read_gains
from drive_env.phase_current import holding_torque, run_and_standby
from tuning.search.optimise import Settings, optimise
from tuning.search.trial_bench import leave_oscillations_to_trials
from tuning.snapshot import load_snapshot, restore
from tuning.stepper.commissioning import commission

TURN = 51_200  # microsteps
AXES = 3
OPEN, CLOSED = 0, 1
LOOP_GAINS = ("correction_velocity_p", "correction_velocity_i")


def drives_of(count, **options):
    return EmulatedDrives("tmcm3313", "inertia", NAME, num_machines=count, num_threads=1, distinct=1, **options)


def turning(drives, modes, rpm):
    """Enable axes in pv, each with its loop, and bring them to a speed."""
    drives.write(cia402.SENSOR_SELECTION, 0)
    motion.enable(drives, mode="pv")
    drives.write(Role.LOOP_MODE, modes)
    drives.advance(0.6)
    assert np.array_equal(drives.read(Role.LOOP_INITIALISED) != 0, np.asarray(modes) == CLOSED)
    drives.write(cia402.PROFILE_ACCELERATION, 10 * TURN)
    drives.write(cia402.TARGET_VELOCITY, round(rpm / 60.0 * TURN))
    drives.advance(1.0)


def mean(drives, index, seconds=0.1):
    return drives.record([index], seconds)[index].mean(axis=0)


# --- load detection in closed loop ------------------------------------------------------------------------------------
def test_stall_guard_reads_the_same_in_closed_loop_as_in_open_loop_and_falls_with_the_load():
    """Below its limit load angle control leaves the field where the steps are (section 1.5): one load, one reading."""
    shares = np.repeat([0.0, 0.3, 0.6], 2)
    with drives_of(6) as drives:
        drives.write(0x2029, 255)  # as much current without a load angle
        turning(drives, np.tile([OPEN, CLOSED], 3), 300)
        held = float(holding_torque(MOTOR, run_and_standby(drives.device, read_gains(drives))[0])[0])
        drives.machine.load_torque = -shares * held
        drives.advance(0.3)
        reading = mean(drives, 0x2101).reshape(3, 2)
        np.testing.assert_allclose(reading[:, 0], reading[:, 1], atol=6.0)
        assert np.all(np.diff(reading[:, 1]) < -40.0)


def test_a_stall_stops_an_axis_in_closed_loop_too():
    """20A4h: an overload that load angle control would catch up with ends the motion, with 3230h."""
    with drives_of(2) as drives:
        drives.write(0x2029, 255)
        drives.write(0x20A4, [3 * TURN, 0])
        drives.write(cia402.FOLLOWING_WINDOW, 0)
        turning(drives, [CLOSED, CLOSED], 300)
        assert drives.emergencies() == []
        held = float(holding_torque(MOTOR, run_and_standby(drives.device, read_gains(drives))[0])[0])
        drives.machine.load_torque = -1.3 * held
        drives.advance(0.03)
        drives.machine.load_torque = 0.0
        drives.advance(2.0)
        assert [(message.axis, message.code) for message in drives.emergencies()] == [(0, 0x3230)]
        states = [state_of(int(word)) for word in drives.read(cia402.STATUSWORD)]
        assert states == [State.FAULT, State.OPERATION_ENABLED]
        behind = drives.read(cia402.POSITION_DEMAND) - drives.read(cia402.POSITION_ACTUAL)
        assert abs(int(behind[1])) < 256, "without it the axis has caught up"


def test_coolstep_follows_the_reading_in_closed_loop_too():
    """An axis without a load comes down to a quarter of the run current, and back when it is loaded."""
    with drives_of(2) as drives:
        drives.write(0x2029, 255)
        for index, value in ((0x2098, 1), (0x2099, 0), (0x209A, 1), (0x209B, 3), (0x209C, [2, 0])):
            drives.write(index, value)
        drives.write(0x20A5, TURN)
        turning(drives, [CLOSED, CLOSED], 300)
        drives.advance(0.5)
        current = mean(drives, 0x6077)
        size = np.hypot(drives.inside.records["i_a"], drives.inside.records["i_b"]).reshape(-1)[:2]
        assert size[0] < 0.35 * size[1], (size, current)
        held = float(holding_torque(MOTOR, run_and_standby(drives.device, read_gains(drives))[0])[0])
        drives.machine.load_torque = -0.6 * held
        drives.advance(0.3)
        size = np.hypot(drives.inside.records["i_a"], drives.inside.records["i_b"]).reshape(-1)[:2]
        assert size[0] > 0.7 * size[1]
        following = np.abs(drives.read(cia402.POSITION_DEMAND) - drives.read(cia402.POSITION_ACTUAL))
        assert np.all(following < 2 * 256), "no step is lost meanwhile"


# --- the node ---------------------------------------------------------------------------------------------------------
def test_stopped_takes_enabled_axes_to_fault_in_a_loop_or_not():
    """As section 2.2 of the TMCM-6212 manual has it: the one link between the automata of NMT and axes."""
    with EmulatedDrives("tmcm3313", "inertia", num_machines=AXES, num_threads=1) as drives:
        wire = Wire(drives)
        wire.start()
        for axis, loop in ((0, OPEN), (2, CLOSED)):
            assert wire.download(0x606A + 0x800 * axis, 0, 0, 2) == 0
            assert wire.download(0x6060 + 0x800 * axis, 0, 3, 1) == 0
            for word in (6, 7, 15):
                assert wire.download(0x6040 + 0x800 * axis, 0, word, 2) == 0
            assert wire.download(0x2020 + 0x200 * axis, 0, loop, 1) == 0
        wire.wait(700)
        assert wire.value(0x2120 + 0x400) == 1
        wire.take()
        wire.play("""
            rx 000  02 05
        """)
        wire.wait(1)
        states = [state_of(int(word)) for word in drives.read(cia402.STATUSWORD)]
        assert states == [State.FAULT, State.SWITCH_ON_DISABLED, State.FAULT]


# --- tuning over a bus ------------------------------------------------------------------------------------------------


def over_a_bus(act):
    """Return what acting on a node with its three motors returns, inside the safety envelope, in lockstep."""
    with on_bus(drives_of(AXES)) as drives:
        leave_oscillations_to_trials(drives)
        return act(drives)


@pytest.mark.slow
@pytest.mark.parametrize("names", [LOOP_GAINS, ("pid_p", "pid_i")])
def test_a_search_of_a_loop_of_three_axes_finds_the_same_in_process_and_over_the_bus(names):
    def act(drives):
        found = optimise(target_of(drives), Settings(trials=2, safe=True, gains=names))
        assert not drives.read(Role.LOOP_MODE).any()
        return [(row.gains.tolist(), row.cost, row.aborted) for row in found.rows]

    with drives_of(AXES) as drives:
        inside = act(drives)
    outside = over_a_bus(act)  # which is asked first whether its axes have motors: the rotors begin elsewhere
    assert [row[::2] for row in outside] == [row[::2] for row in inside] and len(inside) == 2 * AXES
    # What other gains of the PID cost differs by up to half with where the rotor begins; its own gains' cost does not.
    alike = len(inside) if names == LOOP_GAINS else AXES
    costs = [[cost for _, cost, _ in rows[:alike]] for rows in (outside, inside)]
    assert costs[0] == pytest.approx(costs[1], rel=0.02)
    assert not any(aborted for _, _, aborted in inside)
    assert len({cost for _, cost, _ in inside}) > 1


@pytest.mark.slow
def test_what_auto_changed_over_a_bus_is_undone(tmp_path):
    """Its file has the state before; restored, every setting is the commissioned one, of all axes."""
    file = tmp_path / "before.toml"

    def act(drives):
        device = drives.device
        loop = device.gains.loop_of_kind(LOAD_ANGLE)
        keys = [*device.gains.keys, *(device.roles[role] for role in (Role.STALL_SPEED, Role.COOLSTEP_SPEED))]
        keys += [(index, 0) for index in (*cia402_settings(),)]
        before = {key: drives.read(key).tolist() for key in keys}
        result = commission(target_of(drives), file, keep=False)
        assert all(axis.verdict != "rejected" for axis in result.axes), result.axes
        after = {key: drives.read(key).tolist() for key in keys}
        assert after != before and loop is not None
        restore(drives, load_snapshot(file))
        assert {key: drives.read(key).tolist() for key in keys} == before
        return result.axes

    assert len(over_a_bus(act)) == AXES


def cia402_settings():
    """Return what tuning changes besides gains while it runs."""
    return (
        cia402.PROFILE_VELOCITY, cia402.PROFILE_ACCELERATION, cia402.PROFILE_DECELERATION, cia402.FOLLOWING_WINDOW,
        cia402.SENSOR_SELECTION, 0x2020,
    )  # fmt: skip


# --- the index --------------------------------------------------------------------------------------------------------
LOOPS = (OPEN, CLOSED, 2, 3)
COUNT = 2.0 * np.pi / MOTOR.encoder_counts


def slipped(drives):
    """Enable axes and have a load pull each rotor some full steps away from its steps; return how far [microsteps]."""
    drives.write(cia402.SENSOR_SELECTION, 0)
    drives.write(cia402.FOLLOWING_WINDOW, 0)
    for index, value in PID_RECIPE.items():
        drives.write(index, value, where=np.array(LOOPS) > CLOSED)
    motion.enable(drives, mode="hm")
    held = float(holding_torque(MOTOR, run_and_standby(drives.device, read_gains(drives))[0])[0])
    drives.machine.load_torque = -1.5 * held
    drives.advance(0.02)
    drives.machine.load_torque = 0.0
    drives.advance(0.5)
    return drives.machine.rotor_angle * TURN / (2.0 * np.pi)


def position_less_rotor(drives):
    """Return what 6064h shows beyond the rotor's true angle [rad]."""
    return drives.read(cia402.POSITION_ACTUAL) * 2.0 * np.pi / TURN - drives.machine.rotor_angle


@pytest.mark.parametrize("method", [33, 34])
def test_home_is_at_the_index_in_a_loop_and_out_of_it(method):
    """2028h, which is not 0 after lost steps, is left out of no position: 0 is where the disc has its index."""
    with drives_of(len(LOOPS)) as drives:
        slip = slipped(drives)
        assert np.all(np.abs(slip) > 500.0)
        drives.write(Role.LOOP_MODE, LOOPS)
        drives.advance(0.8)
        angle = 2.0
        drives.machine.set("motor.index_angle", angle)
        drives.write(cia402.HOMING_METHOD, method)
        drives.write((cia402.HOMING_SPEEDS, 2), 20_000)
        drives.write(cia402.CONTROLWORD, 0x1F)
        drives.advance(6.0)
        assert np.all(drives.read(cia402.STATUSWORD) & 0x3400 == 0x1400)
        turn = (-position_less_rotor(drives) - angle) / (2.0 * np.pi)
        np.testing.assert_allclose(turn, np.round(turn), atol=2.0 * COUNT / (2.0 * np.pi))


def test_the_latch_holds_what_6064h_shows_at_the_index_in_a_loop_and_out_of_it():
    with drives_of(len(LOOPS)) as drives:
        slipped(drives)
        drives.write(Role.LOOP_MODE, LOOPS)
        drives.advance(0.8)
        drives.machine.set("motor.index_angle", 4.8)
        drives.write((0x200F, 1), 1)
        motion.enable(drives, mode="pv")
        drives.write(cia402.PROFILE_ACCELERATION, 10 * TURN)
        drives.write(cia402.TARGET_VELOCITY, TURN // 8)
        drives.advance(3.0)
        assert not drives.read((0x200F, 1)).any()
        motion.quick_stop(drives)
        drives.advance(0.5)
        shown = drives.read((0x200F, 3)) * 2.0 * np.pi / TURN - position_less_rotor(drives)
        turn = (shown - 4.8) / (2.0 * np.pi)
        np.testing.assert_allclose(turn, np.round(turn), atol=2.0 * COUNT / (2.0 * np.pi))


def test_an_axis_turned_by_hand_while_it_is_off_is_seen_once():
    """200Bh:03 is of the open loop: in a loop the axis is where the encoder sees it already."""
    with drives_of(len(LOOPS)) as drives:
        drives.write((0x200B, 3), 1)
        slipped(drives)
        drives.write(Role.LOOP_MODE, LOOPS)
        drives.advance(0.8)
        motion.disable(drives)
        before = position_less_rotor(drives)
        drives.machine.load_torque = 0.05
        drives.advance(0.1)
        drives.machine.load_torque = 0.0
        drives.advance(1.0)
        np.testing.assert_allclose(position_less_rotor(drives), before, atol=2.0 * COUNT)
