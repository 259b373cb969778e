"""The response with the new gains is measured within what the trials have left of the travel."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from drive_env import motion
from drive_env.gains import Gains
from drive_env.positioning import POSITION
from tuning import auto_margins, frequency_response
from tuning.auto_result import AxisRun
from tuning.auto_run import Run
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
        run = Run(watched, 0, clock, 60.0)
        motion.enable(target.drives, mode="pp")
        motion.move_to(target.drives, target.drives.read(POSITION) + round(moved * 65536))
        run.gains = np.array([[4000, 1500, 500, 300, 100]])
        run.ground = SimpleNamespace(move=SimpleNamespace(distance=np.array([16384])))
        auto_margins.measure(run)
    assert asked == [pytest.approx(left, abs=5e-3)]


@pytest.mark.parametrize(("hidden", "linked"), [(False, False), (True, False), (False, True)])
def test_where_no_phase_margin_is_told_it_says_which_lines_hide_it(hidden, linked):
    f = np.arange(5.0, 405.0, 5.0)
    coherent = ~((f > 80.0) & (f < 120.0)) if hidden else np.ones(f.shape, bool)
    response = SimpleNamespace(f=f, open_loop=(100.0 / (1j * f))[:, None], trusted=coherent[:, None])
    axis = AxisRun(Gains(1, 1, 1, 1, 1), Gains(1, 1, 1, 1, 1))
    run = SimpleNamespace(axes=[axis], gains=np.ones((1, 5), np.int64), target=SimpleNamespace(linked=linked))
    assert not auto_margins._calm(run, 0, response)
    note = "no phase margin is told: the gain passes 1 between 80 and 120 Hz, where the coherence is below 0.95"
    assert axis.notes == [note] * hidden + [auto_margins.ALONE] * linked
    assert np.isnan(axis.margins.phase_deg) == hidden
