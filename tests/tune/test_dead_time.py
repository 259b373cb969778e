"""What dead time takes: voltages in closed form, and the resistance that it looks like to a small current."""

import math

import numpy as np
import pytest

from tuning.response.dead_time import dead_time, dead_time_resistance
from tuning.target import emulated

TURN = 2.0 * math.pi


@pytest.mark.parametrize("angle", np.linspace(0.0, TURN, 7))
def test_dead_time_costs_four_thirds_of_a_phase_at_most_along_the_current(angle):
    """Saturated, the lost voltage turns in steps of 60 degrees: along the current 2 / sqrt(3) to 4 / 3."""
    lost = float(dead_time(np.array([angle]), np.array([100.0]), 0.3, False)[0])
    assert 2.0 / math.sqrt(3.0) - 1e-9 <= lost <= 4.0 / 3.0 + 1e-9
    assert float(dead_time(np.array([angle]), np.array([-100.0]), 0.3, False)[0]) == pytest.approx(-lost)


def test_dead_time_of_a_brushed_motor_is_that_of_two_legs():
    assert dead_time(np.zeros(3), np.array([-1.0, 0.15, 1.0]), 0.3, True).tolist() == [-2.0, 1.0, 2.0]


@pytest.mark.parametrize(("motor", "share"), [("qbl4208", 1.0), ("re_35", 2.0)])
def test_a_current_that_stays_small_sees_a_resistance_and_a_large_one_none(motor, share):
    """Each phase loses V t f / i_s per ampere; of three phases one share adds up along the current, of two legs two."""
    target = emulated(load="inertia", motor=motor, num_threads=1)
    stage = target.device.stage
    saturation = math.sqrt(stage["dead_time_current"].low * stage["dead_time_current"].high)
    lost = 24.0 * 0.5 * (stage["dead_time"].low + stage["dead_time"].high) * target.device.current_rate
    small = dead_time_resistance(target.device, target.motor, 24.0, np.array([-0.02, 0.0, 0.02]))
    assert small == pytest.approx(share * lost / saturation, rel=1e-6)
    assert dead_time_resistance(target.device, target.motor, 24.0, np.array([-50.0, 50.0])) < 0.01 * small
