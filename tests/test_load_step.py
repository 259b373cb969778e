"""The load step of a certificate against what the integrators of a cascade leave no choice about."""

from __future__ import annotations

import numpy as np
import pytest

from drive_env.gains import Gains, gains_in_si, write_gains
from tuning.auto.load_step import BEFORE, NAME, load_step
from tuning.target import emulated

SOFT, STIFF = Gains(4021, 1573, 600, 1200, 300), Gains(4021, 1573, 900, 1800, 500)


@pytest.fixture
def target():
    with emulated(load="inertia", num_machines=3, ideal=True, friction="none") as made:
        write_gains(made.drives, np.array([SOFT, STIFF, STIFF]))
        yield made


def test_the_error_adds_up_to_what_the_gains_say(target):
    """A load that takes the current i leaves the integral of the position error at i T_i / (P k_v)."""
    found = load_step(target, np.array([True, True, False]))
    assert set(found) == {0, 1}
    i = 0.3 * target.motor.rated_torque / target.motor.torque_constant
    for axis, gains in ((0, SOFT), (1, STIFF)):
        step = found[axis]
        si = gains_in_si(target.device, 24.0, gains)
        expected = i * si.velocity_integration / (si.velocity_p * si.position_p)
        after = step.t >= BEFORE
        assert abs(np.sum(step.actual[after]) * 1e-3) == pytest.approx(expected, rel=0.05)
        assert np.mean(step.current[-50:]) - np.mean(step.current[:20]) == pytest.approx(i, rel=0.1)
        assert step.figures["disturbance dip [rad]"] == pytest.approx(np.abs(step.actual[after]).max(), rel=0.02)
        assert step.tuned and step.name == NAME and step.unit == "rad"
    dips = [found[axis].figures["disturbance dip [rad]"] for axis in (0, 1)]
    assert dips[1] < 0.7 * dips[0]


def test_the_machines_are_left_alone_afterwards(target):
    load_step(target, np.ones(3, bool))
    assert target.drives.machine.load_torque.tolist() == [0.0, 0.0, 0.0]
    assert np.all(target.drives.read(0x6041) & 0x6F != 0x27)
    assert load_step(target, np.zeros(3, bool)) == {}
