"""The inertia that axes push which move together, against MuJoCo's inverse dynamics and the shafts' own."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from mechanics.loads import find_load
from mechanics.packed import PackedLoad
from mechanics.shaft import shaft_load, way
from tuning.identify.moved_inertia import moved_inertia


def packed(name):
    row = find_load(name)
    n = row.num_axes
    return PackedLoad(row, np.linspace(4e-6, 6e-6, 2 * n).reshape(2, n), np.zeros((2, n, 4)), {}, 200e-6)


@pytest.mark.parametrize("name", ["gantry", "robot"])
def test_it_is_the_torque_that_a_common_acceleration_takes(name):
    load = packed(name)
    joints = way(load).joints
    model, data = load.model, mujoco.MjData(load.model)
    data.qpos[:] = load.data.qpos
    forces = []
    for acceleration in (0.0, 1.0):  # the difference: without gravity and bearings
        data.qvel[:] = 0.0
        data.qacc[:] = np.tile(acceleration * joints.sum(axis=0), load.copies)
        mujoco.mj_inverse(model, data)
        forces.append(data.qfrc_inverse.reshape(load.copies, -1).copy())
    torque = (forces[1] - forces[0]) @ joints.T
    np.testing.assert_allclose(moved_inertia(load), torque, rtol=1e-6)


@pytest.mark.parametrize("name", ["inertia", "two_mass", "belt"])
def test_of_one_axis_it_is_the_shafts_own(name):
    load = packed(name)
    np.testing.assert_allclose(moved_inertia(load), shaft_load(load).inertia + load.armature, rtol=1e-9)


def test_on_a_gantry_it_is_more_than_of_an_axis_alone():
    load = packed("gantry")
    assert np.all(moved_inertia(load) > 1.2 * (shaft_load(load).inertia + load.armature))
