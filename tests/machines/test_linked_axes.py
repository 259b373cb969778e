"""Machines of several axes while one of them is shaken: weights are held, and what is joined is not torn at."""

from __future__ import annotations

import numpy as np
import pytest

from drive_env import cia402, motion
from mechanics.loads import LOADS, find_load
from mechanics.shaft import one
from tuning.linked_axes import are_linked
from tuning.response.frequency_response import Signal, measure
from tuning.target import emulated

STATUS, CURRENT, MODE = 0x6041, 0x6077, 0x6060


def enabled(drives):
    return cia402.matches(drives.read(STATUS), cia402.OPERATION_ENABLED)


def test_of_the_loads_only_the_gantry_has_axes_that_pull_at_one_thing():
    assert [name for name in LOADS if are_linked(one(find_load(name)))] == ["gantry"]


@pytest.mark.slow
def test_axes_under_gravity_hold_their_places_while_another_one_is_shaken():
    with emulated(load="robot") as target:
        assert not target.linked
        motion.select_mode(target.drives, "pp")
        before = target.drives.read(MODE)
        response = measure(target, "velocity", signal=Signal(high=200.0))
        assert not enabled(target.drives).any()
        np.testing.assert_array_equal(target.drives.read(MODE), before)
    good = response.trusted.mean(axis=0)
    assert np.all(good > 0.4), good
    assert np.all(response.peak_current < 1.2 * target.current), response.peak_current  # A: what falls takes them all


@pytest.mark.slow
@pytest.mark.parametrize("were_on", [False, True])
def test_axes_that_pull_at_one_thing_run_along(were_on):
    with emulated(load="gantry") as target:
        assert target.linked
        if were_on:
            motion.enable(target.drives, mode="csv")
        response = measure(target, "velocity", signal=Signal(high=200.0))
        assert enabled(target.drives).all() == were_on
        if were_on:  # and nothing is left that one pulls at another with, beside friction
            target.drives.advance(0.3)
            assert np.all(np.abs(target.drives.read(CURRENT)) < 1000)  # mA
    assert np.all(response.trusted.mean(axis=0) > 0.4)
    assert np.all(response.peak_current < 1.2 * target.current), response.peak_current
