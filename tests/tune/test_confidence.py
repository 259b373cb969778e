"""95 % intervals against what they must cover, drawn a million times."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tuning.identify.confidence import gain_error, interval, t_quantile

WORST = 0.02
DEVICE = SimpleNamespace(stage={"adc_gain_error_a": SimpleNamespace(low=-WORST, high=WORST)})


@pytest.mark.parametrize(
    ("kind", "turns", "channels"), [("pmsm", True, 2), ("pmsm", False, 1), ("dc", True, 1), ("dc", False, 1)]
)
def test_the_gain_error_of_a_current_covers_95_percent_of_the_sensors(kind, turns, channels):
    """Each channel is anywhere within its limits; a turning field averages two."""
    drawn = np.random.default_rng(1).uniform(-WORST, WORST, (1_000_000, channels)).mean(axis=1)
    bound = gain_error(DEVICE, SimpleNamespace(kind=kind), turns=turns)
    assert np.mean(np.abs(drawn) <= bound) == pytest.approx(0.95, abs=0.001)


def test_a_field_turns_unless_it_is_said_to_stand():
    motor = SimpleNamespace(kind="bldc")
    assert gain_error(DEVICE, motor) == gain_error(DEVICE, motor, turns=True) < gain_error(DEVICE, motor, turns=False)


def test_the_larger_side_of_a_gain_error_counts():
    lopsided = SimpleNamespace(stage={"adc_gain_error_a": SimpleNamespace(low=-0.03, high=0.01)})
    assert gain_error(lopsided, SimpleNamespace(kind="dc")) == pytest.approx(0.95 * 0.03)


@pytest.mark.parametrize(("freedom", "quantile"), [(1, 12.706), (2, 4.303), (10, 2.228), (0, 12.706), (1e9, 1.960)])
def test_student_s_quantiles(freedom, quantile):
    assert t_quantile(freedom) == pytest.approx(quantile, abs=5e-4)


def test_an_interval_adds_its_parts_as_squares():
    found = interval(-2.0, 0.3, 0.2, "A", 1.2)  # 0.3, 0.4 and 1.2
    assert (found.value, found.unit) == (-2.0, "A")
    assert (found.low, found.high) == pytest.approx((-3.3, -0.7))


def test_an_interval_without_what_no_repetition_shows_has_two_parts():
    found = interval(2.0, 0.3, 0.2, "A")  # 0.3 and 0.4
    assert (found.low, found.high) == pytest.approx((1.5, 2.5))
