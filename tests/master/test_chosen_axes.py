"""Chosen axes of drives: what is tuned of a module on which motors are wired to some axes alone.

The others of such a module have no motor: a phase carries no current, and an axis that is enabled goes into fault.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from rigs.commands import drive_tune
from rigs.six_axes import AXES, WIRED, partly_wired
from rigs.world_bus import WorldBus, on_bus

from drive_env import CanDrives, Limits, cia402, motion
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.drives.chosen_axes import ChosenAxes
from tuning.snapshot import load_snapshot
from tuning.target import emulated

FULL_STEPS = np.radians(2 * 1.8)  # rad: how far a rotor goes to the field when its axis gets current
LEFT_OUT = [axis for axis in range(AXES) if axis not in WIRED]


class Enabled:
    """Takes note of the axes that are ever in operation enabled, in the emulator itself."""

    def __init__(self, drives):
        self.ever = np.zeros(AXES, bool)
        self._drives, self._advance = drives, drives.advance
        drives.advance = self._look

    def _look(self, duration):
        self._advance(duration)
        self.ever |= cia402.matches(self._drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED)


def settings_of(drives, axis):
    """Return what is set on an axis, as the emulator has it."""
    from tuning.snapshot import take_of

    return dict(take_of(drives, {}).axes[axis])


@pytest.fixture
def served(tmp_path, monkeypatch):
    """The module as node 1 of a hub, in lockstep: the emulator, who was enabled, and the options that name it."""
    monkeypatch.chdir(tmp_path)
    world = World(lockstep=True)
    drives = partly_wired()
    drives.advance(0.001)  # compiles
    enabled = Enabled(drives)
    world.add(drives, [1])
    hub = Hub()
    options = ["--bus", "--device", "tmcm6212", "--interface", "slcan", "--channel", hub.channel, "--lockstep",
               "--travel", "free", "--yes"]  # fmt: skip
    with Server(world, hub):
        yield drives, enabled, options
    world.close()


@pytest.mark.slow
def test_auto_on_the_axes_that_have_motors_is_accepted_and_lets_the_others_alone(served, tmp_path):
    drives, enabled, options = served
    before = [settings_of(drives, axis) for axis in LEFT_OUT]
    done = drive_tune("auto", *options, "--axis", "3", "--axis", "1", "--out", tmp_path / "auto", "--json")
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert [axis["axis"] for axis in told["axes"]] == list(WIRED)
    assert all(axis["verdict"].startswith("accepted") for axis in told["axes"])
    assert told["machine"].endswith("node 1, axis 1, 3")
    assert np.flatnonzero(enabled.ever).tolist() == list(WIRED)
    assert [settings_of(drives, axis) for axis in LEFT_OUT] == before
    for axis in told["axes"]:
        assert settings_of(drives, axis["axis"])[0x2003, 0] == axis["after"]["run_current"]
        assert axis["after"] != axis["before"]
    snapshot = load_snapshot(told["snapshot"])
    assert len(snapshot.axes) == 2 and snapshot.bus["axes"] == list(WIRED)
    undone = drive_tune("undo", told["snapshot"], "--yes", "--json")
    assert undone.exit_code == 0, undone.output
    assert {row["axis"] for row in json.loads(undone.stdout)["changed"]} == set(WIRED)
    for axis in told["axes"]:
        assert settings_of(drives, axis["axis"])[0x2003, 0] == axis["before"]["run_current"]


@pytest.mark.slow
@pytest.mark.parametrize("command", [("auto",), ("auto", "--by", "random", "--trials", "1")], ids=" ".join)
def test_axes_without_a_motor_are_named_before_anything_moves(served, tmp_path, command):
    """It wrote 6060h and ramps of all axes, and failed with advice on 6085h of one that has no motor."""
    drives, _, options = served
    drives.write(0x6085, 51200, where=~np.isin(np.arange(AXES), WIRED))  # as it comes from the factory
    before, modes = [settings_of(drives, axis) for axis in range(AXES)], drives.read(cia402.MODE)
    angles = drives.machine.rotor_angle.copy()
    done = drive_tune(*command, *options, "--out", tmp_path / "run")
    assert done.exit_code == 1, done.output
    assert done.stderr.strip().splitlines()[-1] == (
        "drive-tune: axes 0, 2, 4, 5: a phase carries no current (1000h, open load), so no motor is connected there, "
        "or its cable is broken; look at the cable, or tune the other axes alone (--axis 1 --axis 3)"
    )
    assert "the drives have their state from before, by a second reading" in done.stderr
    assert [settings_of(drives, axis) for axis in range(AXES)] == before
    assert drives.read(cia402.MODE).tolist() == modes.tolist()
    np.testing.assert_allclose(drives.machine.rotor_angle, angles, atol=FULL_STEPS)
    assert (drives.read(cia402.STATUSWORD) & 0x4F == 0x40).all()


@pytest.mark.parametrize("command", [("auto",), ("auto", "--by", "tpe"), ("identify",), ("response",), ("rules",)])
def test_an_axis_that_is_not_there_names_which_there_are(command, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    done = drive_tune(*command, "--device", "tmcm6212", "--node", "1", "--travel", "free", "--yes", "--axis", "6")
    assert (done.exit_code, done.stdout) == (2, "")
    assert done.stderr == "drive-tune: --axis 6: a tmcm6212 has 6 axes: 0 to 5\n"


def test_axes_of_a_machine_that_pull_at_one_thing_are_not_parted():
    with pytest.raises(ValueError, match=r"--axis 1: the axes of gantry pull at one thing.*leave --axis out"):
        emulated("tmcm6212", "gantry", chosen=(1,))
    with pytest.raises(ValueError, match=r"--axis 1: a load inertia has 1 axis: 0"):
        emulated("tmcm6212", "inertia", chosen=(1,))


# --- the view ---------------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("on_bus", [False, True])
def test_what_is_done_to_chosen_axes_is_done_to_no_other(on_bus):
    whole = partly_wired()
    world = World(lockstep=True)
    bus = None
    drives = whole
    if on_bus:
        world.add(whole, [1])
        bus = WorldBus(world)
        drives = CanDrives("tmcm6212", bus=bus, pace="lockstep", safety=Limits(silence=5.0))
    before = [settings_of(whole, axis) for axis in LEFT_OUT]
    with ChosenAxes(drives, WIRED) as chosen:
        assert chosen.num_axes == 2 and list(chosen.axis_numbers) == list(WIRED)
        chosen.write(0x2003, [100, 120])
        assert chosen.read(0x2003).tolist() == [100, 120]
        assert whole.read(0x2003)[list(WIRED)].tolist() == [100, 120]
        if on_bus:
            chosen.safety.change(Limits(velocity=[2e6, 1e6], current=None, silence=5.0))
            assert drives.safety.limits.velocity == [None, 2e6, None, 1e6, None, None]
            assert chosen.safety.limits.velocity == [2e6, 1e6]
        motion.enable(chosen, mode="pv")
        chosen.write(0x60FF, [51200, 25600])
        trace = chosen.record([0x606C, 0x6041], 0.3)
        assert trace[0x606C].shape == (300, 2)
        np.testing.assert_allclose(trace[0x606C][-1], [51200, 25600], rtol=0.05)
        assert chosen.emergencies() == []
        only = np.array([False, True])
        motion.quick_stop(chosen, where=only)
        chosen.advance(0.2)
        live = cia402.matches(whole.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED)
        assert np.flatnonzero(live).tolist() == [1]
        motion.disable(chosen)
    if on_bus:
        bus.shutdown()
        world.close()
    assert [settings_of(whole, axis) for axis in LEFT_OUT] == before
    whole.close()


def test_errors_call_an_axis_by_its_own_number():
    with partly_wired() as whole:
        chosen = ChosenAxes(whole, (2, 3))  # 2 has no motor
        with pytest.raises(RuntimeError, match=r"axis 2 "):
            motion.enable(chosen, mode="pv")
            chosen.write(0x60FF, 51200)
            chosen.advance(0.3)
            motion.move_to(chosen, 1000)
        assert {message.axis for message in chosen.emergencies()} == {0}


# --- drive-env export eds ---------------------------------------------------------------------------------------------
def test_export_of_one_axis_has_its_values_and_the_nodes_in_process_and_on_a_bus():
    from drive_env.master.commissioned_eds import commissioned_values

    whole = partly_wired()
    with on_bus(whole, safety=False) as drives:
        whole.write(0x2003, np.arange(100, 100 + AXES))
        every, one = commissioned_values(whole), commissioned_values(whole, axis=3)
        read = commissioned_values(drives, axis=3)
    assert (one[0x2603, 0], (0x2003, 0) in one, (0x2203, 0) in one) == (103, False, False)
    of_node = {key: value for key, value in every.items() if key[0] >= 0x2000 and whole.device.is_shared(key[0])}
    of_axis = {key: value for key, value in every.items() if whole.device.locate(key[0])[0] == 3}
    assert len(of_axis) > 30 and one.items() >= (of_node | of_axis).items()
    assert {key: value for key, value in read.items() if key[0] >= 0x2000} == {
        key: value for key, value in one.items() if key[0] >= 0x2000
    }
    assert {whole.device.locate(index)[0] for index, _ in read if not whole.device.is_shared(index)} == {3}
