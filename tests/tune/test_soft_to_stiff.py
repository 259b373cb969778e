"""Gains from soft to stiff by a measured velocity loop: against the true machine, and steps that the emulator makes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rigs.known_machines import machine_of

from drive_env import EmulatedDrives, cia402, motion
from drive_env.drives.raw_gains import read_gains, write_gains
from drive_env.loops.dynamics import find_dynamics, known_dynamics
from drive_env.loops.linear_model import OPEN_LOOPS
from drive_env.loops.margins import margins
from drive_env.trials.response import step_metrics
from tuning.auto.soft_to_stiff import soft_to_stiff
from tuning.response.frequency_response import measure
from tuning.response.predicted_step import predicted_step
from tuning.target import of_machines

# Without friction, cogging and noise a machine is what a linear model can be.
FREE = {
    "load.coulomb": 0.0, "load.breakaway": 0.0, "motor.coulomb": 0.0, "motor.cogging_torque": 0.0,
    "stage.adc_noise": 0.0,
}  # fmt: skip
F = np.geomspace(1.0, 2000.0, 6000)
OFF = {"phase_deg": 3.0, "gain_db": 0.7, "ms": 0.12}  # what a measurement of two seconds may be off
SIGNS = {"phase_deg": 1.0, "gain_db": 1.0, "ms": -1.0}


@pytest.fixture(scope="module")
def measured():
    """An elastic axis as it was measured with its first gains, and its motor."""
    with EmulatedDrives(load="two_mass", num_threads=1, parameters=FREE) as drives:
        target = of_machines(drives, drives)
        before = read_gains(drives)
        response = measure(target, "velocity")
        assert np.array_equal(read_gains(drives), before)
        return response, target.motor


@pytest.fixture(scope="module")
def designed(measured):
    return soft_to_stiff(*measured, 0)


def true_margins(device, gains):
    plant = machine_of("two_mass", parameters=FREE)[2]
    return {loop: margins(F, OPEN_LOOPS[loop](device, plant, np.array(gains), F)) for loop in ("velocity", "position")}


@pytest.mark.parametrize("place", [0.0, 0.2, 0.5, 0.7, 1.0])
def test_gains_of_a_place_keep_its_dynamics_on_the_true_machine_and_are_near_their_limit(measured, designed, place):
    response, _ = measured
    dynamics, found = designed.dynamics(place), true_margins(response.device, designed.at(place, response.gains[0]))
    over = {
        (loop, field): sign * (getattr(one, field) - getattr(dynamics, field)) / off
        for loop, one in found.items() for (field, off), sign in zip(OFF.items(), SIGNS.values(), strict=True)
    }  # fmt: skip
    assert min(over.values()) > -1.0, over
    assert min(over.values()) < 2.0, "softer than the dynamics ask for"


def test_the_ends_and_the_middle_are_the_named_dynamics(designed):
    names = list(known_dynamics())
    assert [designed.dynamics(k / (len(names) - 1)) for k in range(len(names))] == [find_dynamics(one) for one in names]
    between = designed.dynamics(0.25)
    assert (between.phase_deg, between.gain_db, between.ms) == (52.5, 10.0, 1.75)


def test_the_slider_is_continuous_and_stiffer_is_faster(measured, designed):
    response, _ = measured
    rows = np.array([designed.at(place, response.gains[0]) for place in np.linspace(0.0, 1.0, 101)])
    assert np.abs(np.diff(np.log(rows), axis=0)).max() < 0.05
    found = [true_margins(response.device, rows[k])["velocity"].crossover_hz for k in (0, 50, 100)]
    assert found == sorted(found) and found[2] > 1.5 * found[0]


def test_a_response_without_a_fit_gives_no_gains(measured):
    response, motor = measured
    for fits, why in (((None,), "there is none"), ((response.fits[0]._replace(misfit=9.0),), "misses it by 9.0 times")):
        with pytest.raises(ValueError, match=why):
            soft_to_stiff(replace(response, fits=fits), motor, 0)


# --- predicted steps --------------------------------------------------------------------------------------------------
def real_step(gains, mode, target, actual, height):
    """Make a step of a set-point on the machine, and return the answer over its height, 1 kHz."""
    with EmulatedDrives(load="two_mass", num_threads=1, parameters=FREE) as drives:
        write_gains(drives, np.array([gains]), np.array([True]))
        origin = int(drives.read(actual)[0])
        drives.write(target, origin)
        motion.enable(drives, mode=mode)
        course = origin + np.concatenate([np.zeros(20), np.full(200, height)])[:, None]
        trace = drives.record((actual,), 0.22, play={target: course.astype(np.int64)})
        return (np.asarray(trace[actual])[20:, 0] - origin) / height


@pytest.mark.parametrize(("loop", "mode", "place", "height"), [
    ("velocity", "csv", 0.0, 400_000),
    ("velocity", "csv", 1.0, 400_000),
    ("position", "csp", 0.0, 6_500),  # a tenth of a turn
    ("position", "csp", 1.0, 1_300),
])  # fmt: skip
def test_the_emulator_makes_the_step_that_is_predicted(measured, designed, loop, mode, place, height):
    """The measured gains are others than both; the set-point travels and is interpolated for up to 2 ms."""
    response, _ = measured
    gains = designed.at(place, response.gains[0])
    objects = {
        "csv": (cia402.TARGET_VELOCITY, cia402.VELOCITY_ACTUAL),
        "csp": (cia402.TARGET_POSITION, cia402.POSITION_ACTUAL),
    }
    real = real_step(gains, mode, *objects[mode], height)
    predicted = predicted_step(response, gains)
    t, answer = 1e-3 * np.arange(len(real)), getattr(predicted, loop)
    off = [np.sqrt(np.mean((np.interp(t - late, predicted.t, answer, left=0.0) - real) ** 2))
           for late in np.linspace(-0.5e-3, 2e-3, 26)]  # fmt: skip
    assert min(off) < 0.03
    ours, theirs = (step_metrics(x, y, 1.0, t_step=0.0, initial=0.0) for x, y in ((predicted.t, answer), (t, real)))
    assert ours.overshoot == pytest.approx(theirs.overshoot, abs=0.04)
    assert ours.rise_time == pytest.approx(theirs.rise_time, rel=0.1, abs=1.5e-3)


@pytest.mark.parametrize("gains", [(5547, 1573, 2277, 3399, 100), (4021, 1573, 445, 329, 10_000)])
def test_gains_with_which_a_loop_would_be_unstable_have_no_step(measured, gains):
    """The velocity loop of the first, the position loop of the second."""
    response, _ = measured
    found = true_margins(response.device, gains)
    assert min(one.gain_db for one in found.values()) < 0.0
    assert predicted_step(response, gains) is None
