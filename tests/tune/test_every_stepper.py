"""Every stepper of the catalogue on both drives: it is identified, its trials run, and what auto leaves is told."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pytest
from rigs.commands import drive_tune

from drive_env.devices import find_device
from drive_env.devices.gain_set import LOAD_ANGLE
from drive_env.dictionary.roles import Role
from drive_env.emulator.inertia_check import MisfitWarning
from drive_env.envs.gain_tuning import GainTuning
from drive_env.motors import MOTORS
from tuning.search.trial_bench import TrialBench
from tuning.stepper.commissioning import commission
from tuning.target import emulated

STEPPERS = [name for name in MOTORS if name.startswith("qsh")]
LOOP = tuple(find_device("tmcm3313").gains.loop_of_kind(LOAD_ANGLE).gains)


@pytest.mark.every(18)
@pytest.mark.parametrize(
    ("motor", "device", "gains"),
    [(motor, *row) for motor in STEPPERS for row in (("tmcm6212", ()), ("tmcm3313", ()), ("tmcm3313", LOOP))],
)
def test_trials_of_every_motor_run(motor, device, gains):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with emulated(device, "inertia", motor, num_threads=1) as target:
            bench = TrialBench(target, anew=True, gains=gains)
            bench.identify()
            tried = bench.run(bench.rule)
            assert not tried.aborted.any(), tried.causes
            rotor = target.drives.machine.parameters["motor.inertia"] + target.drives.machine.parameters["load.inertia"]
            assert 0.6 < bench.identified.inertia[0] / rotor[0] < 2.0


@pytest.mark.parametrize(("load", "seed"), [("inertia", 1), ("two_mass", 3)])
def test_a_heavy_or_elastic_load_on_a_small_motor_is_identified_by_slower_moves(load, seed):
    """37 rotors, which a move for three loses steps with; and a load whose swing is that of the rotor alone."""
    env = GainTuning(device="tmcm3313", motor="qsh2818_32", load=load, trials=1, num_threads=1)
    try:
        _, info = env.reset(seed=[seed])
        total = info["parameters"]["motor.inertia"] + info["parameters"]["load.inertia"]
        assert env._identified.inertia[0] == pytest.approx(total[0], rel=0.4)
        assert not info["aborted"].any() and info["measured"][0] < 10.0
    finally:
        env.close()


@pytest.mark.slow
def test_what_auto_leaves_besides_gains_stands_in_its_certificate(tmp_path, monkeypatch):
    """A stall stops the axis from then on, above the speed of 20A4h; it did not before."""
    monkeypatch.chdir(tmp_path)
    done = drive_tune("auto", "--device", "tmcm6212", "--load", "inertia", "--out", "auto", "--json")
    assert done.exit_code == 0, done.output
    (axis,) = json.loads(done.stdout)["axes"]
    assert axis["settings"]["20A4:00"]["before"] == 0 < axis["settings"]["20A4:00"]["after"]
    written = json.loads((tmp_path / "auto" / "stepper-certificate.json").read_text(encoding="utf-8"))
    assert written["axes"][0]["settings"] == axis["settings"]


@pytest.mark.slow
def test_an_axis_that_is_rejected_has_its_speeds_from_before(tmp_path, monkeypatch):
    from tuning.stepper import commissioning

    monkeypatch.setattr(commissioning, "prove_with_load", _unseen)
    with emulated("tmcm6212", "inertia", num_threads=1) as target:
        target.drives.write(Role.STALL_SPEED, 123)
        result = commission(target, tmp_path / "before.toml")
        assert result.axes[0].verdict == "rejected"
        assert result.axes[0].settings["20A4:00"] == {"before": 123, "after": 123}
        assert target.drives.read(Role.STALL_SPEED) == 123


def _unseen(target, moves, speed, run, where):
    from tuning.stepper.obstacle import ObstacleProof

    return ObstacleProof(where, [""] * len(where), ~where, np.zeros(len(where)))


@pytest.mark.slow
def test_a_motor_that_loses_steps_at_the_first_speed_is_commissioned_at_a_lower_one(tmp_path):
    with emulated("tmcm6212", "inertia", "qsh2818_32", num_threads=1) as target:
        (axis,) = commission(target, tmp_path / "before.toml").axes
    assert axis.verdict == "accepted with reservations"
    assert any("the working speed is 62.2 rad/s" in text and "at 87.1 rad/s" in text for text in axis.reservations)
    assert axis.figures["working speed [rad/s]"] == pytest.approx(62.2, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(("load", "device"), [("portal", "tmcm3313"), ("gantry", "tmcm6212")])
def test_load_and_obstacle_are_put_on_independent_axes_and_else_it_is_said(load, device, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MisfitWarning)
        with emulated(device, load, num_threads=1) as target:
            result = commission(target, tmp_path / "before.toml")
    assert result.accepted.all(), [axis.reason for axis in result.axes]
    said = [any("not proved with a load and an obstacle" in text for text in axis.reservations) for axis in result.axes]
    assert said == [load == "gantry"] * len(result.axes)
    assert result.proved_with_load is (load == "portal")
    if load == "gantry":
        assert "the axes of gantry move one another" in " ".join(result.axes[0].reservations)
        assert {axis.verdict for axis in result.axes} == {"accepted with reservations"}
