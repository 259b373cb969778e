"""A fit's plants as its intervals say: each is one that can be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drive_env.devices import find_device
from drive_env.loops.linear_model import Plant, velocity_open_loop, velocity_plant
from drive_env.motors import find_motor
from tuning.estimate import Estimate, refused
from tuning.response import plant_fit
from tuning.response.held_samples import seen_by_bus
from tuning.response.plant_fit import PlantFit, fit_plant

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


# --- what is found ----------------------------------------------------------------------------------------------------
SERVO = find_device("tgz_d")
SERVO_GAINS = np.array([6925, 3431, 4018, 31_814, 31_467, 0])
AM3041 = find_motor("am3041_e")


@pytest.mark.slow
@pytest.mark.parametrize("anti_resonance", [40.6, 69.1, 77.8, 93.6])
@pytest.mark.parametrize(("ratio", "damping"), [(1.18, 0.005), (1.35, 0.005), (1.9, 0.02), (2.6, 0.02)])
def test_one_spring_is_found_wherever_it_lies_between_the_lines(anti_resonance, ratio, damping):
    """Lines are 5 Hz apart, and a resonance is a tenth of that wide."""
    true, found = fitted(anti_resonance, ratio, damping)
    assert found.is_good and found.plant.resonance == pytest.approx(true.resonance, rel=0.01)
    assert found.plant.anti_resonance == pytest.approx(true.anti_resonance, rel=0.02)
    assert found.plant.inertia == pytest.approx(true.inertia, rel=0.05)


def test_no_search_begins_at_0_hz_where_the_response_is_lowest_at_its_first_line():
    start = Plant.from_data_sheet(SERVO, AM3041, 540.0, 3.0 * AM3041.inertia)
    f = np.arange(5.0, 401.0, 5.0)
    rising = velocity_plant(SERVO, start, SERVO_GAINS, f) * np.linspace(0.5, 2.0, len(f))
    loop = plant_fit._Loop(SERVO, SERVO_GAINS, f, rising, np.ones(len(f)), 0.0)
    assert all(5.0 <= one.anti_resonance < one.resonance for one in plant_fit._candidate_pairs(loop, rising, start))


def fitted(anti_resonance, ratio, damping):
    """Return an axis on one spring, and what is fitted to its response with 3 % of noise."""
    start = Plant.from_data_sheet(SERVO, AM3041, 540.0, 3.0 * AM3041.inertia)
    true = replace(
        start, inertia=1.17e-4, anti_resonance=anti_resonance, resonance=ratio * anti_resonance, damping=damping,
        velocity_filter=155.0,
    )  # fmt: skip
    f = np.arange(5.0, 401.0, 5.0)

    def closed(at):
        L = velocity_open_loop(SERVO, true, SERVO_GAINS, at)
        return L / (1.0 + L)

    noise = np.random.default_rng(1).normal(size=(2, len(f))) / np.sqrt(2.0)
    seen = seen_by_bus(SERVO, f, closed) * (1.0 + 0.03 * (noise[0] + 1j * noise[1]))
    return true, fit_plant(SERVO, SERVO_GAINS, f, seen, np.full(len(f), 0.03), start)
