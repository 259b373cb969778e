"""One physics step of a packed model, called from compiled code.

Time is staggered (leapfrog): qvel stands at step ends, qpos at step middles. MuJoCo's semi-implicit step then is the
leapfrog scheme, of second order, at the price of one force evaluation. Damping is kept second-order by giving half of
it to MuJoCo, which takes it at the step's end, and half to the applied force, at the step's start.
"""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path
from typing import NamedTuple

import llvmlite.binding
import mujoco
import numpy as np
from numba import types
from numpy.typing import NDArray

from mechanics.compiled import stage
from mechanics.friction import friction_torque

# Speed that rounding leaves of a motion that friction holds, as a share of what the break-away torque could give.
ROUNDING = 1e-9

# Beyond this speed [rad/s or m/s] a machine has left physics: 1e5 rad/s is a million rpm.
SPEED_LIMIT = 1e5


def _load_mujoco() -> None:
    """Make `mj_step` known to the compiler by name; a name can be cached on disk, an address cannot."""
    folder = Path(mujoco.__file__).parent
    pattern = {"win32": "mujoco*.dll", "darwin": "libmujoco*.dylib"}.get(sys.platform, "libmujoco.so*")
    found = sorted(folder.glob(pattern))
    if not found:
        raise ImportError(f"no MuJoCo library ({pattern}) in {folder}; install the package mujoco 3 or later")
    llvmlite.binding.load_library_permanently(str(found[0]))
    ctypes.CDLL(str(found[0]))


_load_mujoco()
_mj_step = types.ExternalFunction("mj_step", types.void(types.uintp, types.uintp))


class Plant(NamedTuple):
    """What the compiled step needs of a packed model; built by packed.py. C copies, D degrees of freedom each, A axes.

    It holds addresses into the model and data of its PackedLoad, which has to outlive it.

    qpos, qvel and qfrc_applied are views of MuJoCo's own memory.
    """

    model_address: int
    data_address: int
    staggered: bool
    qpos: NDArray[np.float64]  # (C D,)
    qvel: NDArray[np.float64]  # (C D,)
    qfrc_applied: NDArray[np.float64]  # (C D,)
    qvel_before: NDArray[np.float64]  # (C D,) scratch
    axis_dof: NDArray[np.int64]  # (A,) degree of freedom that each axis turns
    axis_gear: NDArray[np.float64]  # (A,) rotor angle per unit of that joint [1 or rad/m]
    axis_inertia: NDArray[np.float64]  # (C, A) inertia that the rotor feels at once [kg*m^2]
    axis_position: NDArray[np.float64]  # (A, D) position of what presses each axis's switches, from qpos
    # What a unit of motor torque with a first moment in time displaces, (C, A, D) [rad/(N*m*s^2)].
    axis_kick: NDArray[np.float64]
    stiffness: NDArray[np.float64]  # (C, D) [N*m/rad]
    # Torque to add in each compliance per joint torque held over the step, (C, D, D), see packed.py.
    compliance: NDArray[np.float64]
    # The same per first moment of the motor torque, (C, D, A) [1/s].
    compliance_moment: NDArray[np.float64]
    stuck: NDArray[np.int64]  # (C, F) 1: friction holds this motion
    spring_zero: NDArray[np.float64]  # (D,) [rad]
    damping: NDArray[np.float64]  # (C, D) whole damping [N*m*s/rad]
    friction_motion: NDArray[np.float64]  # (F, D) speed of each friction from qvel
    # Torque on each friction's motion from joint torques, and joint speeds of a unit of that motion's: (C, F, D).
    friction_share: NDArray[np.float64]
    friction: NDArray[np.float64]  # (C, F, 5) inertia, coulomb, breakaway, stribeck, viscous
    bumper_motion: NDArray[np.float64]  # (B, D) position of what runs against each end stop, from qpos
    bumper: NDArray[np.float64]  # (C, B, 4) free from, free to, stiffness, damping of the stop
    disturbance: NDArray[np.float64]  # (D,)
    load_torque: NDArray[np.float64]  # (C,) external torque [N*m]
    diverged: NDArray[np.int64]  # (C,) 1: frozen


@stage
def apply_forces(plant, torque, moment, h):
    """Write qfrc_applied for one step of h [s]: motor torque (C A,), load torque, friction, half of the damping."""
    copies, D = plant.stiffness.shape
    A = plant.axis_dof.shape[0]
    F = plant.friction_motion.shape[0]
    half = 0.5 if plant.staggered else 0.0
    for copy in range(copies):
        base = copy * D
        for d in range(D):
            plant.qvel_before[base + d] = plant.qvel[base + d]
        for a in range(A):
            if not abs(torque[copy * A + a]) < 1e9:  # also true of nan
                plant.diverged[copy] = 1
        if not abs(plant.load_torque[copy]) < 1e9:
            plant.diverged[copy] = 1
        if plant.diverged[copy]:
            freeze(plant, copy)
            continue
        for d in range(D):
            plant.qfrc_applied[base + d] = plant.disturbance[d] * plant.load_torque[copy]
        for a in range(A):
            plant.qfrc_applied[base + plant.axis_dof[a]] += torque[copy * A + a] * plant.axis_gear[a]
        for b in range(plant.bumper_motion.shape[0]):
            x = 0.0
            v = 0.0
            for d in range(D):
                x += plant.bumper_motion[b, d] * plant.qpos[base + d]
                v += plant.bumper_motion[b, d] * plant.qvel[base + d]
            force = bumper_force(x, v, plant.bumper[copy, b])
            if force != 0.0:
                for d in range(D):
                    plant.qfrc_applied[base + d] += plant.bumper_motion[b, d] * force
        # Torque that is held over the step shakes a compliance less than an impulse in its middle would.
        for d in range(D):
            if plant.stiffness[copy, d] != 0.0:
                extra = 0.0
                for k in range(D):
                    extra += plant.compliance[copy, d, k] * plant.qfrc_applied[base + k]
                for a in range(A):
                    extra += plant.compliance_moment[copy, d, a] * moment[copy * A + a]
                plant.qfrc_applied[base + d] += extra
        for d in range(D):
            damping = plant.damping[copy, d] * plant.qvel[base + d]
            plant.qfrc_applied[base + d] -= half * damping
        for f in range(F):
            v = 0.0
            other = 0.0
            for d in range(D):
                v += plant.friction_motion[f, d] * plant.qvel[base + d]
                passive = (
                    plant.stiffness[copy, d] * (plant.qpos[base + d] - plant.spring_zero[d])
                    + (1.0 - half) * plant.damping[copy, d] * plant.qvel[base + d]
                )
                other += plant.friction_share[copy, f, d] * (plant.qfrc_applied[base + d] - passive)
            row = plant.friction[copy, f]
            if not abs(h * other) < SPEED_LIMIT * row[0]:
                # Seen before MuJoCo sees it: its own check would write a log file.
                plant.diverged[copy] = 1
            force = friction_torque(v, other, row[0], h, row[1], row[2], row[3], row[4])
            plant.stuck[copy, f] = 1 if abs(row[0] * v + h * (other + force)) < ROUNDING * h * row[2] else 0
            for d in range(D):
                plant.qfrc_applied[base + d] += plant.friction_motion[f, d] * force
        if plant.diverged[copy]:
            freeze(plant, copy)


@stage
def bumper_force(x, v, row):
    """Return the force of the rubber end stops on a part at x with speed v; a stop pushes and never pulls."""
    low, high, stiffness, damping = row[0], row[1], row[2], row[3]
    if x < low:
        return max(stiffness * (low - x) - damping * v, 0.0)
    if x > high:
        return min(stiffness * (high - x) - damping * v, 0.0)
    return 0.0


@stage
def freeze(plant, copy):
    """Hold a diverged copy at rest, so that it disturbs no other and costs no numbers."""
    D = plant.stiffness.shape[1]
    for d in range(copy * D, (copy + 1) * D):
        plant.qpos[d] = 0.0
        plant.qvel[d] = 0.0
        plant.qfrc_applied[d] = 0.0
    plant.load_torque[copy] = 0.0


@stage
def step(plant, torque, moment, h, theta, omega, reaction, position):
    """Advance every copy by h [s].

    Args:
        plant: The packed model.
        torque: Mean motor torque over the step [N*m], shape (C A,).
        moment: Mean of torque times (time minus the step's middle) [N*m*s], shape (C A,): torque that comes late in
            the step has moved the rotor less by the next.
        h: Step [s].
        theta: Rotor angle at the step's end [rad], written, shape (C A,).
        omega: Rotor speed at the step's end [rad/s], written, shape (C A,).
        reaction: Mean torque of the load against the rotor over the step [N*m], written, shape (C A,).
        position: Of what presses the axis's switches, at the step's end [rad or m], written, shape (C A,).
    """
    copies, D = plant.stiffness.shape
    A = plant.axis_dof.shape[0]
    apply_forces(plant, torque, moment, h)
    _mj_step(plant.model_address, plant.data_address)
    for copy in range(copies):
        base = copy * D
        for d in range(base, base + D):
            if not abs(plant.qvel[d]) < SPEED_LIMIT:
                plant.diverged[copy] = 1
        if plant.diverged[copy]:
            freeze(plant, copy)
        for f in range(plant.friction_motion.shape[0]):
            if plant.stuck[copy, f]:
                rest = 0.0
                for d in range(D):
                    rest += plant.friction_motion[f, d] * plant.qvel[base + d]
                for d in range(D):
                    plant.qvel[base + d] -= plant.friction_share[copy, f, d] * rest
        if plant.staggered and plant.diverged[copy] == 0:
            for a in range(A):
                for d in range(D):
                    plant.qpos[base + d] -= plant.axis_kick[copy, a, d] * moment[copy * A + a] * h
        for a in range(A):
            d = base + plant.axis_dof[a]
            axis = copy * A + a
            if plant.diverged[copy] == 1:
                theta[axis], omega[axis], reaction[axis], position[axis] = 0.0, 0.0, 0.0, 0.0
                continue
            gear = plant.axis_gear[a]
            w = gear * plant.qvel[d]
            acceleration = (w - gear * plant.qvel_before[d]) / h
            omega[axis] = w
            # From the step's middle back to its end.
            back = 0.5 * h if plant.staggered else 0.0
            theta[axis] = gear * plant.qpos[d] - back * (w + 0.5 * back * acceleration)
            position[axis] = 0.0
            for k in range(D):
                position[axis] += plant.axis_position[a, k] * (plant.qpos[base + k] - back * plant.qvel[base + k])
            reaction[axis] = torque[axis] - plant.axis_inertia[copy, a] * acceleration
