"""The response with the new gains: within what the trials have left of the travel, and what it says of both loops."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rigs.auto_stages import basis, recorded
from rigs.known_machines import true_plant

from drive_env import cia402, motion
from drive_env.drives.currents import ampere_per_count
from drive_env.drives.interface import Observer
from drive_env.drives.observed import ObservedDrives
from drive_env.drives.raw_gains import read_gains, write_gains
from drive_env.loops.dynamics import find_dynamics
from drive_env.loops.linear_model import OPEN_LOOPS
from drive_env.loops.margins import Margins, margins
from drive_env.trials.oscillation import OSCILLATION
from tuning.auto import loop_margins as auto_margins
from tuning.auto.bench import AutoBench, Journal
from tuning.auto.loop_model import loop_models
from tuning.auto.measured_margins import MeasuredAxis
from tuning.auto.stages import IdentifiedAxes
from tuning.estimate import refused
from tuning.identify.identified_axis import Identification
from tuning.identify.working_state import cautious_gains
from tuning.response import frequency_response
from tuning.response.measured_loop import AtLeast
from tuning.response.plant_fit import PlantFit
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
        bench = AutoBench(watched, clock, 60.0, find_dynamics("standard"))
        motion.enable(target.drives, mode="pp")
        motion.move_to(target.drives, target.drives.read(cia402.POSITION_ACTUAL) + round(moved * 65536))
        gains = np.array([[4000, 1500, 500, 300, 100]])
        bench.ground = SimpleNamespace(move=SimpleNamespace(distance=np.array([16384])))
        auto_margins.measure(bench, basis(gains), recorded(gains), np.ones(1, bool))
    assert asked == [pytest.approx(left, abs=5e-3)]


@pytest.mark.parametrize(("share", "seen"), [(0.59, False), (0.61, True)])
def test_a_response_of_less_inertia_than_moves_showed_is_that_of_the_play_of_a_gear(share, seen, monkeypatch):
    with emulated(load="inertia", num_threads=1) as target, timed(target) as (watched, clock):
        true = true_plant(target.drives)
        write_gains(target.drives, GAINS[None])
        response = frequency_response.measure(target)
        bench = AutoBench(watched, clock, 60.0, find_dynamics("standard"))
        bench.ground = SimpleNamespace(move=SimpleNamespace(distance=np.array([16384])), begin_here=lambda where: None)
        monkeypatch.setattr(frequency_response, "measure", lambda *given, **options: response)
        moved = replace(true, inertia=response.fits[0].plant.inertia / share)
        found = basis(GAINS[None], plant=moved, found=Identification({}, 0.0))
        after = auto_margins.measure(bench, found, recorded(GAINS[None]), np.ones(1, bool))
    why = "the response shows 59 % of the inertia that moves showed, and 60 % are needed"
    assert (after.unseen[0] == "") == seen == np.isfinite(after.slack[0])
    assert seen or after.unseen[0].startswith(why)


class Currents(Observer):
    """Keeps the currents of the first axis [A]."""

    objects = (cia402.TORQUE_ACTUAL,)

    def __init__(self, ampere):
        self.ampere, self.seen = ampere, []

    def passed(self, below, duration, trace, asked, play):
        self.seen += (trace[cia402.TORQUE_ACTUAL][:, 0] * self.ampere).tolist()


def test_gains_with_which_the_axis_oscillates_while_it_is_measured_fail_and_do_not_stay():
    """A drawn axis was accepted with reservations, and hummed at 243 Hz whenever it turned."""
    with emulated(load="two_mass", num_threads=1) as target:
        wild, calm = np.full((1, 5), 32767), cautious_gains(target, 3.0 * target.motor.inertia)
        currents = Currents(float(np.ravel(ampere_per_count(target.drives))[0]))
        with timed(replace(target, drives=ObservedDrives(target.drives, currents))) as (watched, clock):
            bench = AutoBench(watched, clock, 60.0, find_dynamics("standard"))
            move = SimpleNamespace(distance=np.array([16384]))
            bench.ground = SimpleNamespace(move=move, begin_here=lambda where: None)
            found = basis(calm, plant=true_plant(target.drives), found=Identification({}, 0.0))
            after = auto_margins.measure(bench, found, recorded(wild), np.ones(1, bool))
        assert re.fullmatch(r"its loop oscillates by itself at 2\d\d Hz while the axis turns", after.failed[0])
        assert after.swing[0] == OSCILLATION, "so that the next design has less velocity P"
        assert read_gains(target.drives).tolist() == calm.tolist()
    windows = np.array(currents.seen[: len(currents.seen) // 25 * 25]).reshape(-1, 25)
    swings = windows.std(axis=1) > 0.5 * target.current
    assert 1 <= swings.sum() <= 17, "the axis is calm within 100 ms after the trial of a third of a second"


class RealTimeDrives(ObservedDrives):
    """Drives whose time passes by itself, as on a bus."""

    time_waits = False


@pytest.mark.parametrize(("kind", "live"), [(ObservedDrives, True), (RealTimeDrives, False)])
def test_in_real_time_an_axis_is_off_while_its_response_is_evaluated(kind, live, monkeypatch):
    """An envelope in real time stops an enabled axis that gets no command for a second, and the fit takes one."""
    fit, seen = frequency_response.fit_plant, []
    with emulated(load="inertia", num_threads=1) as target:
        drives, true = kind(target.drives), true_plant(target.drives)

        def fitting(*args):
            seen.append(bool(cia402.matches(drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED)[0]))
            return fit(*args)

        monkeypatch.setattr(frequency_response, "fit_plant", fitting)
        motion.enable(drives, mode="csv")
        with timed(replace(target, drives=drives)) as (watched, clock):
            bench = AutoBench(watched, clock, 60.0, find_dynamics("standard"))
            move = SimpleNamespace(distance=np.array([16384]))
            bench.ground = SimpleNamespace(move=move, begin_here=lambda where: None)
            found = basis(GAINS[None], plant=true, found=Identification({}, 0.0))
            after = auto_margins.measure(bench, found, recorded(GAINS[None]), np.ones(1, bool))
    assert after.unseen[0] == "" and seen == [live] * len(seen) != []


# --- both loops, by a measured velocity loop --------------------------------------------------------------------------
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
        assert found.phase_deg == pytest.approx(true.phase_deg, abs=6.0), name
        assert found.crossover_hz == pytest.approx(true.crossover_hz, rel=0.06), name
        if true.gain_hz < 400.0:
            assert found.gain_db == pytest.approx(true.gain_db, abs=2.0), name


@pytest.mark.every(3)
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


def test_what_was_refused_as_a_resonance_bounds_nothing(measured):
    """The play of a gear fits a soft spring as well; what lies above it is then unknown."""
    response, _, _ = measured
    fit = response.fits[0]
    assert fit.plant.is_elastic and np.isfinite(response.at_least("velocity", GAINS)).all()
    play = fit._replace(estimates=fit.estimates | {"resonance": refused("Hz", "it depends on the direction")})
    assert np.isnan(replace(response, fits=(play,)).at_least("velocity", GAINS)).all()


def test_of_a_measured_axis_the_response_tells_what_another_velocity_p_does_and_the_model_the_rest(measured):
    response, plant, _ = measured
    identified = IdentifiedAxes((Identification({}, 0.0),), (plant,))
    with emulated(load="two_mass", num_threads=1) as target:
        for seen, names in ((recorded(GAINS[None], response=response), False), (None, True)):
            ((model, _),) = loop_models(target, identified, seen, np.ones(1, bool), find_dynamics("standard"))
            kept = model.kept(find_dynamics("standard"), GAINS[None])
            assert ("velocity P x 1.5" in kept) == names and "load inertia x 2" in kept


@pytest.mark.parametrize(("seen", "bound", "reserved"), [
    ((60.0, 12.0), (50.0, 9.0), None),
    ((np.nan, 12.0), (50.0, 9.0), False),  # a bound, and said
    ((60.0, np.nan), (50.0, 9.0), False),
    ((np.nan, 12.0), (44.0, 9.0), True),  # less than the dynamics ask for
    ((60.0, np.nan), (50.0, 7.0), True),
    ((60.0, np.nan), (50.0, np.inf), None),  # no phase of -180 degrees anywhere
])  # fmt: skip
def test_a_margin_that_was_not_seen_is_a_bound_or_a_reservation(seen, bound, reserved):
    journal = Journal()
    found = Margins(seen[0], seen[1], 30.0, 60.0, 1.5)
    auto_margins.tell_bounds(journal, find_dynamics("standard"), "velocity", found, AtLeast(*bound))
    assert (len(journal.notes), len(journal.reservations)) == (int(reserved is False), int(reserved is True))


# --- the verdict ------------------------------------------------------------------------------------------------------
SOUND = Margins(phase_deg=60.0, gain_db=12.0, crossover_hz=30.0, bandwidth_hz=60.0, ms=1.5, phase_hz=30.0, gain_hz=90.0)


@pytest.mark.parametrize(("loop", "changed", "text"), [
    ("velocity", {}, None),
    ("velocity", {"phase_deg": 43.5}, None),  # within what a measurement may be off
    ("velocity", {"phase_deg": 42.0}, "the velocity loop has a phase margin of 42 degrees, and standard dynamics ask "
                                      "for 45"),
    ("position", {"gain_db": 7.0}, "the position loop has a gain margin of 7.0 dB, and standard dynamics ask for 8"),
    ("position", {"ms": 2.05}, None),
    ("position", {"ms": 2.3}, "the position loop has a sensitivity peak Ms of 2.3, and standard dynamics ask for 2"),
    ("position", {"phase_deg": np.nan, "gain_db": np.nan}, None),  # what was not measured is a bound, told elsewhere
])  # fmt: skip
def test_what_loops_fall_short_of_is_said_in_numbers(loop, changed, text):
    found = auto_margins.short_of(find_dynamics("standard"), {loop: SOUND._replace(**changed)})
    assert found == ([] if text is None else [text])


@pytest.mark.parametrize(("changed", "overshoot", "verdict"), [
    ({}, 0.15, "accepted"),
    ({}, np.nan, "accepted"),  # no step was made
    ({"phase_deg": 40.0}, 0.15, "reserved"),  # less than standard dynamics, not less than stiff ones
    ({"ms": 2.4}, 0.15, "reserved"),
    ({}, 0.30, "reserved"),
    ({"phase_deg": 30.0}, 0.15, "rejected"),
    ({"gain_db": 4.0}, 0.15, "rejected"),
    ({"ms": 3.0}, 0.15, "rejected"),
    ({}, 0.45, "rejected"),
])  # fmt: skip
def test_beyond_stiff_dynamics_gains_are_rejected_and_between_there_is_a_reservation(
    changed, overshoot, verdict, monkeypatch
):
    found = {"velocity": SOUND, "position": SOUND._replace(**changed)}
    bench, start = verdict_on(found, overshoot, monkeypatch)
    told = auto_margins.judge(bench, basis(start.gains), start)
    (journal,) = bench.journals
    reserved, rejected = bool(journal.reservations), bool(journal.reason)
    assert ("rejected" if rejected else "reserved" if reserved else "accepted") == verdict, vars(journal)
    assert told.margins == {0: found} and "velocity loop Ms 1.5" in told.verified[0]


def test_gains_before_that_are_kept_are_not_rejected_for_what_they_were(monkeypatch):
    bench, start = verdict_on({"velocity": SOUND, "position": SOUND._replace(ms=3.0)}, np.nan, monkeypatch)
    auto_margins.judge(bench, basis(start.gains), replace(start, kept=np.ones(1, bool)))
    assert not bench.journals[0].reason and len(bench.journals[0].reservations) == 1


@pytest.mark.parametrize(
    ("distortion", "refused", "reserved"), [(0.3, "", False), (0.7, "", True), (0.7, "few", False)]
)
def test_margins_measured_across_the_play_of_a_gear_are_reserved(distortion, refused, reserved, monkeypatch):
    """A drawn gear had 55 degrees as measured, and 0.4 with its flanks closed."""
    bench, start = verdict_on({"velocity": SOUND, "position": SOUND}, 0.1, monkeypatch)
    found = Identification({}, 0.0, fit=PlantFit(None, {}, 1.0, refused, distortion=distortion))
    auto_margins.judge(bench, basis(start.gains, found=found), start)
    assert bool(bench.journals[0].reservations) == reserved


@pytest.mark.parametrize(("kept", "verdict"), [(0.5, ""), (0.38, ""), (0.35, "reserved"), (0.1, "rejected")])
def test_a_machine_as_it_may_become_keeps_less_of_the_dynamics_and_not_nothing(kept, verdict, monkeypatch):
    """Of standard dynamics 40 %, less what a model is off; of stiff ones likewise."""
    bench, start = verdict_on({"velocity": SOUND, "position": SOUND}, 0.1, monkeypatch)
    stiff = SimpleNamespace(kept=lambda dynamics, gains: {"x": kept * (1.4 if dynamics.name == "stiff" else 1.0)})
    monkeypatch.setattr(auto_margins, "loop_models", lambda *given: [(stiff, np.array([0]))])
    auto_margins.judge(bench, basis(start.gains), start)
    (journal,) = bench.journals
    assert ("rejected" if journal.reason else "reserved" if journal.reservations else "") == verdict, vars(journal)


@pytest.mark.parametrize("by_response", [True, False])
def test_of_another_velocity_p_the_worse_of_response_and_model_counts(by_response, monkeypatch):
    """A coupled axis has both: of its own velocity P, and of that of all axes together."""
    bench, start = verdict_on({"velocity": SOUND, "position": SOUND}, 0.1, monkeypatch)
    name, low, high = "velocity P x 1.5", 0.1, 0.9
    model = SimpleNamespace(kept=lambda dynamics, gains: {name: high if by_response else low})
    axis = object.__new__(MeasuredAxis)
    monkeypatch.setattr(MeasuredAxis, "kept", lambda self, dynamics, gains: {name: low if by_response else high})
    monkeypatch.setattr(MeasuredAxis, "margins", lambda self, gains: {"velocity": SOUND, "position": SOUND})
    monkeypatch.setattr(auto_margins, "measured_axis", lambda *given: axis)
    monkeypatch.setattr(auto_margins, "loop_models", lambda *given: [(model, np.array([0]))])
    auto_margins.judge(bench, basis(start.gains), start)
    assert bench.journals[0].reason.startswith(f"with {name} it keeps 10 % of the margins of stiff dynamics")


def verdict_on(found, overshoot, monkeypatch, variant=1.0):
    """Return a bench of one axis whose measured loops have these margins, and its gains."""
    monkeypatch.setattr(auto_margins, "measured_axis", lambda *given: SimpleNamespace(margins=lambda gains: found))
    model = SimpleNamespace(kept=lambda dynamics, gains: {"load inertia x 2": variant})
    monkeypatch.setattr(auto_margins, "loop_models", lambda *given: [(model, np.array([0]))])
    gains = np.array([[4000, 1500, 500, 300, 100]])
    response = SimpleNamespace(
        gains=gains, notes=((),), at_least=lambda *given: AtLeast(50.0, 9.0), fits=(None,), open_loop=np.ones((9, 1))
    )
    bench = SimpleNamespace(
        target=SimpleNamespace(linked=False, num_axes=1), journals=[Journal()], dynamics=find_dynamics("standard"),
        going=np.ones(1, bool),
    )  # fmt: skip
    return bench, recorded(gains, response=response, overshoot=np.array([overshoot]))
