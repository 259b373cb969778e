"""Loops of an axis with any gains, by its measured velocity loop: against the linear model that was "measured"."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from rigs.known_machines import machine_of

from drive_env.devices import find_device
from drive_env.devices.gains import bandwidth_gains
from drive_env.loops.dynamics import find_dynamics
from drive_env.loops.linear_model import OPEN_LOOPS, velocity_open_loop
from drive_env.loops.margins import margins
from drive_env.loops.sampled import CascadeGains, LoopRates, closed_loops, window
from drive_env.motors import find_motor
from tuning.auto.loop_model import LoopModel, one_axis
from tuning.auto.measured_margins import AT_ONCE, MeasuredAxis

DEVICE, MOTOR, STANDARD = find_device("tmcm1636"), find_motor("qbl4208"), find_dynamics("standard")
BOTH = ("velocity", "position")
F = np.geomspace(2.0, 0.49 * DEVICE.velocity_rate, 3000)
# Velocity loop and position loop [Hz], integration time; of the second ones a loop is unstable.
SOFT, LIVELY = (25.0, 6.0, 6.0), (60.0, 25.0, 4.0)
STABLE = (SOFT, LIVELY, (60.0, 8.0, 12.0), (15.0, 12.0, 5.0))
UNSTABLE = ((60.0, 400.0, 4.0), (900.0, 20.0, 5.0), (60.0, 60.0, 0.3))


def raw(inertia, velocity, position, integration):
    return bandwidth_gains(
        DEVICE, MOTOR, inertia, current_hz=1000.0, velocity_hz=velocity, position_hz=position, integration=integration
    )


def measured(plant, gains, f=F, trusted=None, fit=None):
    """Return an axis whose measured velocity loop is the model's, without noise."""
    L = velocity_open_loop(DEVICE, plant, gains, f)
    good = np.ones(len(f), bool) if trusted is None else trusted
    response = SimpleNamespace(device=DEVICE, fits=(fit,), gains=gains[None], refined=lambda axis: (f, L, good))
    return MeasuredAxis(response, 0, plant)


@pytest.fixture(scope="module", params=["inertia", "two_mass"])
def axis(request):
    """The linear machine of a load, its inertia, and its plant."""
    return machine_of(request.param)


@pytest.mark.parametrize("others", STABLE)
def test_margins_with_other_gains_are_those_of_the_axis(axis, others):
    _, inertia, plant = axis
    gains = raw(inertia, *others)
    found = measured(plant, raw(inertia, *SOFT)).margins(gains)
    for loop in BOTH:
        true = margins(F, OPEN_LOOPS[loop](DEVICE, plant, gains, F))
        assert found[loop].phase_deg == pytest.approx(true.phase_deg, abs=0.1), loop
        assert found[loop].gain_db == pytest.approx(true.gain_db, abs=0.1), loop
        assert found[loop].ms == pytest.approx(true.ms, rel=0.01), loop


def test_other_gains_of_the_torque_loop_are_those_of_the_winding(axis):
    _, inertia, plant = axis
    gains = raw(inertia, *LIVELY)
    gains[:2] = 0.5 * gains[:2]
    found = measured(plant, raw(inertia, *SOFT)).open_loops(gains[None])
    for loop in BOTH:
        np.testing.assert_allclose(found[loop][0], OPEN_LOOPS[loop](DEVICE, plant, gains, F), rtol=1e-6)


@pytest.mark.parametrize(("others", "stable"), [*((one, True) for one in STABLE), *((one, False) for one in UNSTABLE)])
def test_gains_are_unstable_by_the_measured_loop_exactly_where_the_closed_loop_grows(axis, others, stable):
    """The measured loop turns round -1 or not; the truth is the closed loop's poles."""
    machines, inertia, plant = axis
    gains = raw(inertia, *others)
    one, rates = CascadeGains.of(DEVICE, gains[None, None]), LoopRates.of(DEVICE)
    growth = closed_loops(rates, machines, one, window(rates, machines, one)).growth[0]
    assert (growth <= 1e-6) == stable
    seen = measured(plant, raw(inertia, *SOFT))
    clearance = seen._clearance(STANDARD, gains[None])[0]
    assert (clearance > 0.0) == stable
    if not stable:
        assert seen.slack(STANDARD, gains[None])[0] < -1.0, "worse than at the border of stability"


def test_slack_falls_on_the_way_to_instability_and_past_it(axis):
    _, inertia, plant = axis
    rows = np.array([raw(inertia, 20.0, position, 6.0) for position in (20.0, 30.0, 45.0, 70.0, 900.0)])
    slack = measured(plant, raw(inertia, *SOFT)).slack(STANDARD, rows)
    assert np.all(np.diff(slack) < 0.0) and slack[-1] < -1.0, slack


def test_slack_is_that_of_the_dynamics_and_of_less_and_more_velocity_p(axis):
    _, inertia, plant = axis
    gains = raw(inertia, 20.0, 12.0, 5.0)
    known = DEVICE.gains
    rows = [gains, *(known.with_velocity_p(gains[None], np.array([factor]))[0] for factor in (0.67, 1.5))]
    clearances = [
        min(float(STANDARD.clearance(OPEN_LOOPS[loop](DEVICE, plant, row, F))) for loop in BOTH) for row in rows
    ]
    least = min(clearances[0] - 1.0, min(clearances[1:]) / 0.4 - 1.0)
    seen = measured(plant, raw(inertia, *SOFT))
    assert seen.slack(STANDARD, gains[None]) == pytest.approx([least], abs=0.01)
    kept = seen.kept(STANDARD, gains)
    assert [kept["velocity P x 0.67"], kept["velocity P x 1.5"]] == pytest.approx(clearances[1:], abs=0.01)
    model = LoopModel(DEVICE, MOTOR, [plant], one_axis(plant), measured=True)
    assert not kept.keys() & model.kept(STANDARD, gains[None]).keys(), "what was measured needs no model"


def test_many_sets_at_once_are_each_by_itself():
    _, inertia, plant = machine_of("inertia")
    seen = measured(plant, raw(inertia, *SOFT), f=F[::10])
    rows = np.array([raw(inertia, 20.0 + k, 5.0 + 0.3 * k, 5.0) for k in range(AT_ONCE + 5)])
    alone = [float(seen.slack(STANDARD, row[None])[0]) for row in rows[::17]]
    assert seen.slack(STANDARD, rows)[::17] == pytest.approx(alone)


def test_lines_that_are_not_coherent_count_only_where_a_model_fits():
    """Below 400 Hz they are: there no phase of -180 degrees is seen, and no gain margin told."""
    _, inertia, plant = machine_of("inertia")
    gains, below = raw(inertia, *SOFT), F < 100.0
    for fit in (None, SimpleNamespace(reason="", is_good=True, plant=plant)):
        found = measured(plant, gains, trusted=below, fit=fit)
        assert np.isnan(found.margins(gains)["velocity"].gain_db)
        assert len(found._f) == (below.sum() if fit is None else len(F))
