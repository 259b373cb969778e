"""A load as seen by its motors: their travel, the moved joints, and the torque and inertia at their shafts."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from mechanics.arrays import Floats, Mask
from mechanics.load import Load
from mechanics.packed import PackedLoad

POSES = 16  # at which changing gravity and inertia are computed


class ShaftLoad(NamedTuple):
    """Torques and inertia of every copy's axes, shape (copies, axes): the maximum over some poses."""

    gravity: Floats  # torque against gravity [N*m]
    friction: Floats  # torque at break-away [N*m]
    inertia: Floats  # of the load, without the rotor [kg*m^2]


class Way(NamedTuple):
    """Effect of turning only one axis's rotor, with passive joints at rest and backlash taken up."""

    joints: Floats  # (axes, D) speeds of the joints per speed of the rotor [1 or m/rad]
    position: Floats  # (axes,) speed of the axis's position per speed of the rotor [1 or m/rad]
    linear: Mask  # (axes,) whether the position is one of slides alone [m], not an angle [rad]
    low: Floats  # (axes,) rotor angle from the start to the end of the travel, or to a limit switch [rad]; -inf without
    high: Floats  # (axes,)


def one(load: Load) -> PackedLoad:
    """Return the load alone, with rotors of no particular inertia: enough for `way`."""
    return PackedLoad(load, np.full((1, load.num_axes), 1e-3), np.zeros((1, load.num_axes, 4)), {}, 1e-6)


def way(load: PackedLoad) -> Way:
    """Return the travel of the axes, and the motion of joints."""
    plant, row = load.plant, load.load
    coupled = [load.num_frictions + k for k, contact in enumerate(row.contacts) if contact.transmits]
    rows = np.concatenate([plant.axis_motion, plant.motion[coupled]])
    joints = np.linalg.pinv(rows)[:, : load.num_axes].T
    position = np.einsum("ad,ad->a", plant.axis_position, joints)
    slide = load.model.jnt_type[: load.num_dofs] == int(mujoco.mjtJoint.mjJNT_SLIDE)
    linear = np.array([bool(np.any(slide & (motion != 0.0))) for motion in plant.axis_position])
    low, high = np.full(load.num_axes, -np.inf), np.full(load.num_axes, np.inf)
    for axis, travel in enumerate(row.travel):
        if travel is not None:
            low[axis], high[axis] = travel
    for axis, name in enumerate(row.joints):
        joint = [k for k in range(load.num_dofs) if load.model.joint(k).name == f"0/{name}"]
        if joint and load.model.jnt_limited[joint[0]]:
            ends = load.model.jnt_range[joint[0]]
            low[axis], high[axis] = max(low[axis], ends[0]), min(high[axis], ends[1])
    for switch in row.switches:
        if switch.kind == "left":
            low[switch.axis] = max(low[switch.axis], switch.high)
        elif switch.kind == "right":
            high[switch.axis] = min(high[switch.axis], switch.low)
    at = plant.axis_position @ load.start
    angles = np.sort(np.stack([low - at, high - at]) / position, axis=0)
    return Way(joints, position, linear, angles[0], angles[1])


def shaft_load(load: PackedLoad, turning: Floats | None = None) -> ShaftLoad:
    """Return torques and inertia at the shafts when each axis turns alone, passive joints at rest, backlash taken up.

    Args:
        load: The packed load.
        turning: The joints' speeds of `way`, the same for every packed model of a load; computed by default.
    """
    plant, turning = load.plant, way(load).joints if turning is None else turning
    frictions = plant.motion[: load.num_frictions]
    breakaway = np.einsum("fc,fa->ca", plant.friction[:, 1], np.abs(frictions @ turning.T))
    model, data = load.model, load.template.scratch
    generator = np.random.default_rng(0)
    gravity, inertia = np.zeros_like(breakaway), np.zeros_like(breakaway)
    for pose in range(POSES if load.varying else 1):
        share = generator.random(load.num_dofs) if pose else np.full(load.num_dofs, 0.5)
        data.qpos.reshape(load.copies, -1)[:] = load.start + pose_of(load, share)
        mujoco.mj_forward(model, data)
        mass, weight = load.template.inertia(data), data.qfrc_bias.reshape(load.copies, load.num_dofs)
        gravity = np.maximum(gravity, np.abs(weight @ turning.T))
        inertia = np.maximum(inertia, np.einsum("ad,cde,ae->ca", turning, mass, turning))
    return ShaftLoad(gravity, breakaway, inertia - load.armature)


def pose_of(load: PackedLoad, share: Floats) -> Floats:
    """Return joint positions relative to the start: hinges within half a turn to each side, slides at the start."""
    hinge = load.model.jnt_type[: load.num_dofs] == int(mujoco.mjtJoint.mjJNT_HINGE)
    return np.where(hinge, (2.0 * share - 1.0) * np.pi, 0.0)
