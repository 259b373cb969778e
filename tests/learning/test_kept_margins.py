"""Margins of a tuner's proposals: computed from the identified plant, never learned; and what its card holds for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from agents.policies.agent_file import AgentFile
from agents.shipped import shipped
from agents.tuner.kept_margins import KeptMargins
from agents.tuner.known_range import HOLDS, outside
from drive_env.devices import find_device
from drive_env.devices.gains import rule_gains
from drive_env.loops.dynamics import find_dynamics
from drive_env.loops.linear_model import Plant
from drive_env.motors import find_motor
from tuning.auto.loop_model import model_of
from tuning.target import emulated

DEVICE, MOTOR = find_device("tmcm1636"), find_motor("qbl4208")
INERTIA = 3.0 * MOTOR.inertia
RULE = rule_gains(DEVICE, MOTOR, INERTIA)
CALM = np.array([[4021, 1573, 100, 100, 30]])


def margins(dynamics="standard", **elastic):
    """Those of one axis; elastic: anti_resonance and resonance [Hz], none of a rigid one."""
    plant = replace(Plant.from_data_sheet(DEVICE, MOTOR, 24.0, INERTIA), **elastic)
    asked = find_dynamics(dynamics)
    return KeptMargins([(model_of(DEVICE, MOTOR, plant, asked), np.array([0]))], asked, CALM)


def livelier(factor):
    return np.rint(RULE * np.where(np.arange(5) < 2, 1.0, factor)).astype(np.int64)


def test_gains_that_keep_the_dynamics_are_tried_as_they_are():
    assert margins().kept(RULE).tolist() == [True]
    np.testing.assert_array_equal(margins().lowered(RULE), RULE)


def test_gains_that_break_them_are_lowered_as_little_as_keeps_them():
    asked, proposal = margins(), livelier(4.0)
    assert not asked.kept(proposal).any()
    found = asked.lowered(proposal)
    assert asked.kept(found).all()
    np.testing.assert_array_equal(found[:, :2], proposal[:, :2])  # the current loop stays
    assert np.all(found[:, 2:] <= proposal[:, 2:])
    far = np.abs(np.log(found[0, 2:] / proposal[0, 2:])).sum()
    assert far < np.log(4.0) * 3.0  # less than back to the rule's gains


def test_soft_dynamics_lower_more_than_stiff_ones():
    soft, stiff = (margins(name).lowered(livelier(4.0))[0, 2:].astype(float) for name in ("soft", "stiff"))
    assert np.log(soft).sum() < np.log(stiff).sum()


def test_where_nothing_lowered_keeps_them_calm_gains_are_tried():
    np.testing.assert_array_equal(margins().lowered(livelier(30.0)), CALM)


def test_a_resonance_breaks_what_a_rigid_axis_keeps():
    assert not margins(anti_resonance=60.0, resonance=110.0).kept(RULE).any()


# --- what a card holds for --------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def ships():
    return AgentFile.load(shipped("gain_tuning"))


@pytest.mark.parametrize(("device", "load", "motor", "told"), [
    ("tmcm1636", "two_mass", "qbl4208", []),
    ("tmcm1636", "gantry", "qbl4208", ["load: gantry", "number of axes of a machine: 2"]),
    ("tmcm1636", "inertia", "faulhaber_3863", ["motor: faulhaber_3863"]),
    ("tgz_d", "inertia", None, ["device: tgz_d", "motor: "]),
])  # fmt: skip
def test_outside_its_card_it_says_so(ships, device, load, motor, told):
    with emulated(device, load, motor, num_threads=1) as target:
        found = outside(ships, target, target.machine)
        assert len(found) == len(told), found
        for text, part in zip(found, told, strict=True):
            assert f"the agent was not trained on this {part}" in text and "drive-tune auto" in text
        assert not any("load" in text for text in outside(ships, target, None))  # the load of a bus is not known


def test_an_agent_without_such_a_table_holds_for_its_own_environment(ships):
    own = replace(ships, card={}, configuration={"load": "belt", "motor": "re_40"})
    assert HOLDS in ships.card
    with emulated("tmcm1636", "belt", "qbl4208", num_threads=1) as target:
        (text,) = outside(own, target, "belt")
    assert "this motor: qbl4208, and its card holds for re_40" in text
