"""The response with the new gains: within what the trials have left of the travel, and what it says of both loops."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from auto_stages import basis, recorded

from drive_env import cia402, motion
from drive_env.devices import find_device
from drive_env.gains import write_gains
from drive_env.loops.linear_model import OPEN_LOOPS
from drive_env.loops.margins import Margins, margins
from drive_env.loops.true_plant import true_plant
from tuning.auto import calmer_gains
from tuning.auto import loop_margins as auto_margins
from tuning.auto.bench import AutoBench, Journal
from tuning.auto.calmer_gains import far_enough
from tuning.auto.measured_margins import SENSITIVITY, SOUGHT
from tuning.response import frequency_response
from tuning.response.measured_loop import AtLeast
from tuning.target import emulated, timed

TURN = 2.0 * np.pi


class FarEnoughError(ValueError):
    """The measurement was asked for."""


@pytest.mark.parametrize(("moved", "left"), [(0.2, (-0.5, 0.1)), (-0.2, (-0.1, 0.5)), (0.35, (-0.65, 0.0))])
def test_the_response_is_measured_within_what_is_left_of_the_travel(moved, left, monkeypatch):
    asked = []

    def measure(target, loop, **options):
        asked.append((target.low[0] / TURN, target.high[0] / TURN))
        raise FarEnoughError("far enough")

    monkeypatch.setattr(frequency_response, "measure", measure)
    travel = (-0.3 * TURN, 0.3 * TURN)
    with emulated(load="inertia", travel=travel, num_threads=1) as target, timed(target) as (watched, clock):
        bench = AutoBench(watched, 0, clock, 60.0)
        motion.enable(target.drives, mode="pp")
        motion.move_to(target.drives, target.drives.read(cia402.POSITION_ACTUAL) + round(moved * 65536))
        gains = np.array([[4000, 1500, 500, 300, 100]])
        bench.ground = SimpleNamespace(move=SimpleNamespace(distance=np.array([16384])))
        auto_margins.measure(bench, basis(gains), recorded(gains))
    assert asked == [pytest.approx(left, abs=5e-3)]


# --- both loops, by a measured velocity loop --------------------------------------------------------------------------
@pytest.mark.parametrize(("limit", "share"), [(9.0, 1.0), (4.0, 0.85), (3.0, 0.6), (0.1, 1.0)])
def test_gains_are_lowered_until_both_loops_are_as_far_from_instability_as_is_asked(limit, share, monkeypatch):
    """P of the loop that is too near, and of those above it; what does not help is left alone."""
    names = find_device("tmcm1636").gains.names

    def ms(basis, response, gains, k):
        near = {
            "velocity": 1e-3 * gains[names.index("velocity_p")],
            "position": 1e-3 * gains[names.index("position_p")],
        }
        return {loop: SimpleNamespace(ms=value) for loop, value in near.items()}

    monkeypatch.setattr(auto_margins, "margins_with", ms)
    bench = SimpleNamespace(target=SimpleNamespace(device=find_device("tmcm1636"), linked=False))
    given = np.array([4000, 1500, 2000, 700, 4600])
    seen = recorded([given], response=object())
    found = auto_margins.not_beyond(bench, basis([given]), seen, given, 0, limit)
    assert found.tolist() == [*given[:4], round(share * 4600)]
    both = np.array([4000, 1500, 4600, 700, 4600])
    found = auto_margins.not_beyond(bench, basis([given]), seen, both, 0, limit)
    assert found.tolist() == [4000, 1500, round(share * 4600), 700, round(share * 4600)]
    unseen = recorded([given], response=object(), unseen=np.ones(1, bool))
    for nothing in (unseen, recorded([given], response=None)):
        assert auto_margins.not_beyond(bench, basis([given]), nothing, given, 0, 1.0).tolist() == given.tolist()


GAINS = np.array([8009, 9699, 847, 1112, 1420])
OTHERS = np.array([[4021, 1573, 445, 329, 118], [8009, 9699, 500, 600, 700], [6000, 4000, 900, 1000, 1400]])


@pytest.fixture(scope="module")
def measured():
    """A measured velocity loop of two masses on a spring, and the plant that it truly is."""
    with emulated(load="two_mass", num_threads=1) as target:
        write_gains(target.drives, GAINS[None])
        yield frequency_response.measure(target), true_plant(target.drives), target.device


def true_margins(device, plant, gains):
    f = np.geomspace(2.0, 0.49 * device.velocity_rate, 4000)
    return {name: margins(f, OPEN_LOOPS[name](device, plant, gains, f)) for name in ("velocity", "position")}


@pytest.mark.parametrize("gains", [GAINS, *OTHERS], ids=["as then", "slow", "other outer gains", "other torque gains"])
def test_a_measured_velocity_loop_tells_the_margins_of_both_loops_with_any_gains(measured, gains):
    """Against the linear model of what the machine truly is."""
    response, plant, device = measured
    f, velocity, position, trusted = response.loops(gains, plant=plant)
    for name, L in (("velocity", velocity), ("position", position)):
        found, true = margins(f, L, trusted), true_margins(device, plant, gains)[name]
        assert found.phase_deg == pytest.approx(true.phase_deg, abs=5.0), name
        assert found.crossover_hz == pytest.approx(true.crossover_hz, rel=0.06), name
        if true.gain_hz < 400.0:
            assert found.gain_db == pytest.approx(true.gain_db, abs=2.0), name


@pytest.mark.parametrize("gains", [GAINS, *OTHERS])
@pytest.mark.parametrize("loop", ["velocity", "position"])
def test_what_margins_are_at_least_is_less_than_what_they_are_and_not_by_much(measured, gains, loop):
    response, plant, device = measured
    least, true = response.at_least(loop, gains), true_margins(device, plant, gains)[loop]
    assert true.phase_deg - 12.0 < least.phase_deg < true.phase_deg + 1.0
    assert true.gain_db - 6.0 < least.gain_db < true.gain_db + 0.5


def test_without_a_model_that_fits_nothing_is_said(measured):
    response, _, _ = measured
    without = replace(response, fits=(response.fits[0]._replace(misfit=3.0),))
    assert np.isnan(without.at_least("velocity", GAINS)).all()


@pytest.mark.parametrize(("seen", "bound", "reserved"), [
    ((40.0, 12.0), (30.0, 9.0), None),
    ((np.nan, 12.0), (30.0, 9.0), False),  # a bound, and said
    ((40.0, np.nan), (30.0, 9.0), False),
    ((np.nan, 12.0), (9.0, 9.0), True),  # too near to rely on
    ((40.0, np.nan), (30.0, np.inf), None),  # no phase of -180 degrees anywhere
])  # fmt: skip
def test_a_margin_that_was_not_seen_is_a_bound_or_a_reservation(seen, bound, reserved):
    journal = Journal()
    found = Margins(seen[0], seen[1], 30.0, 60.0, 1.5)
    auto_margins.tell_bounds(journal, "velocity", found, AtLeast(*bound))
    assert (len(journal.notes), len(journal.reservations)) == (int(reserved is False), int(reserved is True))


@pytest.mark.parametrize("linked", [False, True])
@pytest.mark.parametrize(("velocity", "position", "factors"), [
    (3.0, 3.0, (1.0, 1.0)),
    (3.1, 2.2, (0.5, 0.5)),
    (9.0, 2.2, (0.5, 0.5)),  # the velocity loop wants half of velocity P, and position P goes with it
    (2.2, 9.0, (1.0, 0.5)),
    (9.0, 9.0, (0.5, 0.25)),
])  # fmt: skip
def test_a_loop_that_comes_too_near_to_instability_gets_half_its_gain(velocity, position, factors, linked, monkeypatch):
    monkeypatch.setattr(auto_margins, "SOFTER", (1.0, 0.5))
    full = np.array([4000, 1500, 400, 300, 200])

    def found(basis, response, gains, k):
        one = Margins(40.0, 10.0, 30.0, 60.0, 1.0)
        half = [velocity if gains[2] > 300 else 2.0, position if gains[4] > 0.6 * full[4] * gains[2] / 400 else 2.0]
        return {loop: one._replace(ms=ms) for loop, ms in zip(("velocity", "position"), half, strict=True)}

    monkeypatch.setattr(auto_margins, "margins_with", found)
    target = SimpleNamespace(linked=linked, device=find_device("tmcm1636"))
    bench = SimpleNamespace(target=target, journals=[Journal()])
    response = SimpleNamespace(f=np.arange(80.0), refined=lambda k: (None, None, np.ones(80, bool)))
    if linked:  # nothing is known of its position loop
        factors = (factors[0], factors[0])
    start = recorded(full[None], spare=9)
    calmed = auto_margins.calm(bench, basis(full[None]), start, 0, response)
    np.testing.assert_array_equal(calmed.gains[0], full * [1, 1, factors[0], 1, factors[1]])
    is_calmed = factors != (1.0, 1.0)
    assert (calmed is not start, not calmed.spare.any(), bool(bench.journals[0].notes)) == (is_calmed,) * 3


@pytest.mark.parametrize("tell", [True, False])
@pytest.mark.parametrize("found", [[4000, 1500, 300, 250, 400], None])
def test_what_less_p_cannot_calm_gets_other_gains_by_its_twins_or_the_rules(found, tell, monkeypatch):
    """Less velocity P beside the same integral part may be nearer to instability."""
    own, rule = np.array([4000, 1500, 400, 300, 200]), np.array([4000, 1500, 100, 90, 80])
    near = Margins(40.0, 10.0, 30.0, 60.0, 9.0)
    monkeypatch.setattr(auto_margins, "margins_with", lambda *given: {"velocity": near, "position": near})
    monkeypatch.setattr(auto_margins, "sensitivity", lambda target, basis, response, gains, k: 2.0)
    monkeypatch.setattr(auto_margins, "twins_tell", lambda *given: tell)
    by_twins = None if found is None else np.array(found)
    monkeypatch.setattr(auto_margins, "far_enough", lambda bench, basis, recorded, k: by_twins)
    bench = SimpleNamespace(target=SimpleNamespace(linked=False, device=find_device("tmcm1636")), journals=[Journal()])
    response = SimpleNamespace(f=np.arange(80.0), refined=lambda k: (None, None, np.ones(80, bool)))
    calmed = auto_margins.calm(bench, basis(rule[None]), recorded(own[None], spare=9), 0, response)
    is_searched = tell and found is not None
    assert calmed.gains[0].tolist() == (found if is_searched else rule.tolist())
    assert bench.journals[0].notes[0].startswith("other gains were searched" if is_searched else "the gains of the")
    assert "the measured velocity loop has a sensitivity peak Ms of 9.0" in bench.journals[0].notes[0]


def test_gains_by_twins_are_far_from_instability_by_the_measured_loop(monkeypatch):
    """By the twins more velocity P is better, without an end; the measured loop ends it."""

    @contextmanager
    def twins(bench, basis, k, sets, repeats):
        device = find_device("tmcm1636")
        yield SimpleNamespace(device=device, num_axes=1, sets=sets, score=lambda gains: 100.0 / gains[..., 2])

    monkeypatch.setattr(calmer_gains, "_twins_of", twins)
    monkeypatch.setattr(calmer_gains, "cost_on_twins", lambda bench, basis, axes, gains: 100.0 / gains[..., 2])
    most = SOUGHT
    monkeypatch.setattr(calmer_gains, "sensitivity", lambda target, basis, response, gains, k: most * gains[2] / 300.0)
    bench = SimpleNamespace(target=SimpleNamespace(device=find_device("tmcm1636")), rng=np.random.default_rng(1))
    start = recorded(np.array([[4000, 1500, 400, 300, 200]]), response=object())
    rule = basis([[4000, 1500, 200, 300, 200]])
    found = far_enough(bench, rule, start, 0)
    assert found is not None and 270 < found[2] <= 300
    most = 1.2 * SENSITIVITY
    found = far_enough(bench, rule, start, 0)
    assert found is not None and found[2] <= 300 * SENSITIVITY / most, "as far as it must be, at least"
    most = 4000.0
    assert far_enough(bench, rule, start, 0) is None, "nothing near is far enough"
