"""A fit's plants as its intervals say: each is one that can be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drive_env.devices import find_device
from drive_env.loops.linear_model import Plant
from drive_env.motors import find_motor
from tuning.estimate import Estimate, refused
from tuning.response.plant_fit import PlantFit

MOTOR = find_motor("qbl4208")
RIGID = Plant.from_data_sheet(find_device("tmcm1636"), MOTOR, 24.0, 3.0 * MOTOR.inertia)
ELASTIC = replace(RIGID, anti_resonance=48.0, resonance=49.0)


def known(value, width):
    return Estimate(value, value - width, value + width, "Hz")


@pytest.mark.parametrize("estimates", [
    {"anti_resonance": known(48.0, 3.0), "resonance": refused("Hz", "the response depends on its amplitude")},
    {"anti_resonance": refused("Hz", "the response depends on its amplitude"), "resonance": known(49.0, 3.0)},
    {"anti_resonance": known(48.0, 3.0), "resonance": known(49.0, 3.0)},
])  # fmt: skip
def test_what_was_refused_stays_and_the_other_does_not_pass_it(estimates):
    """An anti-resonance above its resonance is no plant: half of the draws have it, and are left out."""
    drawn = list(PlantFit(ELASTIC, estimates, 1.0).drawn(np.random.default_rng(0), 400))
    assert 100 < len(drawn) < 350
    for fit in drawn:
        assert fit.plant.anti_resonance < fit.plant.resonance
        for name, estimate in estimates.items():
            assert estimate.is_known or getattr(fit.plant, name) == getattr(ELASTIC, name)


def test_a_rigid_plant_is_drawn_every_time():
    estimates = {"inertia": known(RIGID.inertia, 0.1 * RIGID.inertia), "resonance": refused("Hz", "none")}
    drawn = list(PlantFit(RIGID, estimates, 1.0).drawn(np.random.default_rng(0), 50))
    assert len(drawn) == 50
    assert np.std([fit.plant.inertia for fit in drawn]) == pytest.approx(0.1 * RIGID.inertia / 1.96, rel=0.3)
