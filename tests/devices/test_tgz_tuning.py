"""Both axes of a TGZ-D, each with a load of its own, are tuned: over its bus, and in a sweep."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from rigs.fault_injection import eds_read_once
from rigs.world_bus import on_bus

from drive_env import EmulatedDrives, Limits, cia402, motion
from drive_env.devices import find_device
from drive_env.drives.currents import ampere_per_count, to_counts
from drive_env.motors import find_motor
from tuning.auto.certify import certificate
from tuning.auto.one_button import auto
from tuning.identify.working_state import working_state
from tuning.runs import sweep
from tuning.runs.experiment import SweptObject, load_experiment
from tuning.snapshot import load_snapshot, restore
from tuning.target import Target

DEVICE = find_device("tgz_d")
MOTOR = find_motor("am3041_e")
AXES = 2
WAY = np.full(AXES, 120.0)  # rad


def gains(drives):
    """Return the gains that a drive has, (num_axes, count)."""
    return np.stack([drives.read(name) for name in DEVICE.gains.keys], axis=1)


@pytest.mark.parametrize("rated", [1.52, 1.531, 1.557, 1.58])
def test_the_current_of_identification_is_one_that_the_envelope_lets_pass(rated):
    """The limit counts thousandths of the nominal current, 6071h 32767ths of the peak current: neither rounds up."""
    with EmulatedDrives("tgz_d", "inertia", num_machines=AXES, num_threads=1) as inside:
        inside.inside.connect_axes(0, AXES)
        with on_bus(inside, stay=True, timeout=5.0, safety=Limits(silence=5.0)) as drives:
            target = Target(drives, DEVICE, MOTOR, np.full(AXES, 560.0), -WAY, WAY, MOTOR.rated_speed, rated)
            with working_state(target) as working:
                counts = to_counts(drives, working.current)
                drives.write(cia402.TARGET_TORQUE, -counts)  # SafetyError if it is beyond the limit
                assert (counts * ampere_per_count(drives) > 0.998 * rated).all()


@pytest.mark.slow
def test_auto_over_a_bus_certifies_both_axes_and_undoes_itself(tmp_path):
    """What the certificate says is in the emulator's dictionary, and so is what was there before, afterwards."""
    before_file = tmp_path / "before.toml"
    with eds_read_once(), EmulatedDrives("tgz_d", "inertia", num_machines=AXES, num_threads=1) as inside:
        inside.inside.connect_axes(0, AXES)  # as on the node
        before = gains(inside)
        with on_bus(inside, stay=True, timeout=5.0, safety=Limits(silence=5.0)) as drives:
            volts = np.full(AXES, float(MOTOR.voltage))
            where = {"channel": "here", "nodes": [1]}
            target = Target(drives, DEVICE, MOTOR, volts, -WAY, WAY, MOTOR.rated_speed, MOTOR.rated_current, bus=where)
            result = auto(target, before_file)
            told = certificate(target, result, seed=0)
            assert [axis.verdict != "rejected" for axis in told.axes] == [True] * AXES, told.axes
            found = gains(inside)
            np.testing.assert_array_equal(found, [axis.after for axis in told.axes])
            assert (found != before).any(axis=1).all()
            ahead = DEVICE.gains.column("feed-forward", "speed")
            assert (found[:, ahead] > before[:, ahead]).all(), "P-SFF, of which the factory has none"
            assert not cia402.is_live(inside.read(cia402.STATUSWORD)).any()
            restore(drives, load_snapshot(before_file), whole=False)
            np.testing.assert_array_equal(gains(inside), before)
            motion.disable(drives)


def test_a_sweep_moves_both_axes_of_each_machine_with_a_points_gains():
    """Two motors on a gantry: the best point's recording is that of a machine by itself, in the TGZ's own units."""
    swept = tuple(
        SweptObject(f"{index:04X}h:00", *ends, 2, "log")
        for index, ends in ((0x2700, (2900, 5700)), (0x2701, (220_000, 440_000)))
    )
    given = replace(load_experiment(), device="tgz_d", load="gantry", motor="am3041_e", sweep=swept)
    found = sweep.run(given)
    assert np.isfinite(found.score).any()
    best = found.best(1)[0]
    excitation = given.excitation
    with EmulatedDrives("tgz_d", "gantry", seed=given.seed) as drives:
        motion.enable(drives, mode="pv")
        drives.write("Profile acceleration", f"{excitation.acceleration_rpm_per_s} rpm/s")
        for row in swept:
            drives.write(int(row.object[:4], 16), best[row.object])
        lead = drives.record([cia402.VELOCITY_ACTUAL], excitation.velocity_time)
        drives.write(cia402.TARGET_VELOCITY, f"{excitation.velocity_rpm} rpm")
        step = drives.record([cia402.VELOCITY_ACTUAL], excitation.load_time - excitation.velocity_time)
        speed = np.concatenate([part[cia402.VELOCITY_ACTUAL, "rpm"] for part in (lead, step)])
    same = np.isclose(found.response.speed_rpm[: len(speed)], speed, rtol=0, atol=1e-6).all(axis=0)
    assert same.any(), "a point is as good as its worst axis, whose recording it has"
    assert (np.ptp(speed, axis=0) > excitation.velocity_rpm).all(), "both axes turn"


def test_an_agent_tunes_the_speed_feed_forward_beside_the_loops():
    """P-SFF is one of the gains that GainTuning's action may have; more of it from the rule's 0 is rewarded."""
    chosen = ("velocity_p", "velocity_i", "position_p", "feed_forward")
    own = {"device": "tgz_d", "gains": chosen, "distributions": {"parameters": {}}, "num_threads": 1}
    with gymnasium.make("ServoDrive/GainTuning-v0", **own) as env:
        assert env.action_space.shape == (len(chosen),)
        _, info = env.reset(seed=1)
        begun = info["gains"]
        ahead = DEVICE.gains.column("feed-forward", "speed")
        assert begun[0, ahead] == 0
        total = sum(env.step(np.array([0.0, 0.0, 0.0, 1.0], np.float32))[1] for _ in range(2))
        *_, info = env.step(np.zeros(len(chosen), np.float32))
    assert total > 0.0
    assert info["gains"][0, ahead] > 300
    np.testing.assert_array_equal(np.delete(info["gains"], ahead, 1), np.delete(begun, ahead, 1))
