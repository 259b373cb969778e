"""What a run of auto puts into its certificate, against what the machine truly is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rigs.known_machines import true_plant

from drive_env.devices import find_device
from drive_env.drives.raw_gains import write_gains
from drive_env.loops.dynamics import find_dynamics
from drive_env.loops.linear_model import OPEN_LOOPS
from drive_env.loops.margins import Margins, margins
from drive_env.loops.sampled import CascadeGains, LoopRates, open_loops
from drive_env.loops.true_plant import true_machines
from tuning.auto.certify import certificate, requirements
from tuning.auto.measured_margins import MeasuredAxis
from tuning.auto.stages import AxisResult, Result
from tuning.certificate.certificate import CROSSOVERS, KEPT, NEARLY_KEPT, NOT_KEPT, NOT_MEASURED, SEEN_KEPT
from tuning.response import frequency_response
from tuning.response.measured_loop import AtLeast
from tuning.target import emulated

KNOWN = find_device("tmcm1636").gains
STANDARD = find_dynamics("standard")
GAINS = {"inertia": (5555, 1565, 1257, 1961, 926), "belt": (5580, 1579, 1099, 1845, 395)}  # what auto ends with


def result(axis, **known):
    """Return the result of a run of one axis with standard dynamics."""
    none = {"shown": None, "earlier": None, "response": None, "loaded": {}, "file": Path("before.toml"), "kept": False}
    zero = np.zeros(1)
    return Result(**{
        "axes": (axis,), "drive_seconds": zero, "moves": zero, "aborts": zero, "violations": zero,
        "dynamics": STANDARD, **none, **known,
    })  # fmt: skip


@pytest.mark.every(2)
@pytest.mark.parametrize("load", list(GAINS))
def test_crossovers_are_those_of_the_true_linear_machine(load):
    gains = np.array([GAINS[load]])
    with emulated(load=load, num_threads=1) as target:
        write_gains(target.drives, gains)
        truth, plant, rates = true_machines(target.drives), true_plant(target.drives), LoopRates.of(target.device)
        response = frequency_response.measure(target)
        found = MeasuredAxis(response, 0, plant).margins(gains[0])
        axis = AxisResult(GAINS[load], GAINS[load], plant=plant, margins=found)
        (paper,) = certificate(target, result(axis, response=response), seed=0).axes
    f = np.geomspace(1.0, 0.49 * rates.velocity_rate, 4000)
    loops = open_loops(rates, truth, CascadeGains.of(target.device, gains[None]), f[None])
    velocity, position = (margins(f, loop[0, 0]).crossover_hz for loop in loops)
    current = np.geomspace(10.0, 0.49 * rates.current_rate, 4000)
    designed = margins(current, OPEN_LOOPS["current"](target.device, plant, gains[0], current)).crossover_hz
    wanted = designed, velocity, position, position / velocity
    assert tuple(paper.figures) == CROSSOVERS
    np.testing.assert_allclose(list(paper.figures.values()), wanted, rtol=0.1)


# --- what is asked for, and what is kept ------------------------------------------------------------------------------
SOUND = Margins(phase_deg=60.0, gain_db=12.0, crossover_hz=30.0, bandwidth_hz=60.0, ms=1.5, phase_hz=30.0, gain_hz=90.0)


UNBOUNDED = AtLeast(np.nan, np.nan)


def kept(name, *, bound=UNBOUNDED, overshoot=0.05, **changed):
    """Return what a certificate says of a requirement of an axis whose loops are sound but for this."""
    loops = {"velocity": SOUND, "position": SOUND._replace(**changed)}
    axis = AxisResult((1,) * 5, (1,) * 5, margins=loops, at_least={"position": bound}, overshoot=overshoot)
    rows = {row.name: row for row in requirements(STANDARD, axis, KNOWN)}
    assert len(rows) == 7
    return rows[name].asked, rows[name].found, rows[name].is_bound, rows[name].kept


PHASE, GAIN, MS = (f"position loop, {name}" for name in ("phase margin [deg]", "gain margin [dB]", "Ms"))
STEP = "overshoot of a small step in csp [%]"


@pytest.mark.parametrize(("name", "given", "said"), [
    (PHASE, {}, (45.0, 60.0, False, KEPT)),
    (PHASE, {"phase_deg": 43.5}, (45.0, 43.5, False, NEARLY_KEPT)),  # a measurement may be off by 2 degrees
    (PHASE, {"phase_deg": 42.0}, (45.0, 42.0, False, NOT_KEPT)),
    (PHASE, {"phase_deg": -10.0}, (45.0, -10.0, False, NOT_KEPT)),
    (GAIN, {"gain_db": np.nan}, (8.0, np.nan, False, NOT_MEASURED)),
    (GAIN, {"gain_db": np.nan, "bound": AtLeast(50.0, 9.0)}, (8.0, 9.0, True, KEPT)),
    (GAIN, {"gain_db": np.nan, "bound": AtLeast(50.0, 7.0)}, (8.0, 7.0, True, NOT_MEASURED)),  # it may be more
    (MS, {"ms": 2.3}, (2.0, 2.3, False, NOT_KEPT)),
    (MS, {"gain_db": np.nan}, (2.0, 1.5, False, SEEN_KEPT)),  # the peak may lie where nothing was seen
    (MS, {"gain_db": np.nan, "ms": 2.3}, (2.0, 2.3, False, NOT_KEPT)),
    (STEP, {}, (20.0, 5.0, False, KEPT)),
    (STEP, {"overshoot": 0.24}, (20.0, 24.0, False, NOT_KEPT)),
    (STEP, {"overshoot": np.nan}, (20.0, np.nan, False, NOT_MEASURED)),
])  # fmt: skip
def test_of_all_that_the_dynamics_ask_for_it_is_said_whether_it_is_kept(name, given, said):
    assert kept(name, **given) == pytest.approx(said, nan_ok=True)


def test_where_nothing_was_measured_nothing_is_said_to_be_kept():
    rows = requirements(STANDARD, AxisResult((1,) * 5, (1,) * 5), KNOWN)
    assert {row.kept for row in rows} == {NOT_MEASURED} and len(rows) == 7
