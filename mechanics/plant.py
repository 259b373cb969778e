"""What the compiled physics step knows of a packed model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Plant(NamedTuple):
    """What the compiled step needs of a packed model; built by packed.py.

    C copies, D degrees of freedom each, A axes, F frictions (the axes' bearings first), B contacts, E = F + B
    elements, R rolls. Copies come last, so that loops over them go through memory in order; MuJoCo's own arrays have
    them first. It holds addresses into the model and data of its PackedLoad, which has to outlive it; qpos to
    dof_armature are views of MuJoCo's own memory.
    """

    model_address: int
    data_address: int
    staggered: bool
    varying: bool  # inertias change: what rotors and frictions feel is looked up
    looking: bool  # every step begins with the first half of MuJoCo's: forces change, too, or the solver works
    constant: bool  # the first half of MuJoCo's step would find what it found before, rolls apart
    elastic: bool  # joints have springs
    qpos: NDArray[np.float64]  # (C D,)
    qvel: NDArray[np.float64]  # (C D,)
    qfrc_applied: NDArray[np.float64]  # (C D,)
    qfrc_bias: NDArray[np.float64]  # (C D,) gravity, Coriolis
    qfrc_passive: NDArray[np.float64]  # (C D,)
    qfrc_constraint: NDArray[np.float64]  # (C D,)
    inertia: NDArray[np.float64]  # lower triangle of the inertia matrix, row by row
    inertia_start: NDArray[np.int64]  # (C D,) of each row
    inertia_count: NDArray[np.int64]  # (C D,)
    inertia_column: NDArray[np.int64]
    dof_armature: NDArray[np.float64]  # (C D,)
    qvel_before: NDArray[np.float64]  # (C D,) a step ago
    ahead: NDArray[np.float64]  # (C D,) speed at which MuJoCo takes its forces, less qvel
    weigh_every: int
    steps: NDArray[np.int64]  # (1,) counted
    triangle: NDArray[np.float64]  # (D, D, C) scratch
    lane: NDArray[np.float64]  # (8, C) scratch
    position: NDArray[np.float64]  # (D, C) qpos, scratch
    speed: NDArray[np.float64]  # (D, C) qvel at the step's start, scratch
    reached: NDArray[np.float64]  # (D, C) and at its end
    applied: NDArray[np.float64]  # (D, C) qfrc_applied, scratch
    total: NDArray[np.float64]  # (D, C) all force on each degree of freedom
    axis_motion: NDArray[np.float64]  # (A, D) rotor angle from qpos [1 or rad/m]
    axis_position: NDArray[np.float64]  # (A, D) position of what presses each axis's switches, from qpos
    axis_start: NDArray[np.float64]  # (A,) rotor angle of the start, which reads as 0
    # What a unit of motor torque with a first moment in time displaces, (A, D, C) [rad/(N*m*s^2)].
    axis_kick: NDArray[np.float64]
    # Corrections of modal.py.
    stiffness: NDArray[np.float64]  # (D, D, C) [N*m/rad]
    held: NDArray[np.float64]  # (D, D, C)
    held_moment: NDArray[np.float64]  # (D, A, C) [1/s]
    spring_zero: NDArray[np.float64]  # (D,) [rad]
    damping: NDArray[np.float64]  # (D, C) whole damping [N*m*s/rad]
    bias: NDArray[np.float64]  # (D, C) forces that MuJoCo adds by itself, with its sign of qfrc_bias
    motion: NDArray[np.float64]  # (E, D) speed of each element from qvel
    # Torque on each element's motion from joint torques, and joint speeds of a unit of that motion's: (E, D, C).
    share: NDArray[np.float64]
    mass: NDArray[np.float64]  # (E, C) inertia of each element's motion; the first A are what the rotors feel at once
    # (F, 8, C): coulomb, breakaway, stribeck, viscous, drag, bristles' stiffness and damping, 1/efficiency - 1
    friction: NDArray[np.float64]
    carries: NDArray[np.int64]  # (F,) contact whose force the friction grows with, or -1
    bristle: NDArray[np.float64]  # (C, F) deflection
    stuck: NDArray[np.int64]  # (F, C) 1: friction holds this motion
    # (F, C) torque of each friction in the last step: frictions that hold coupled motions need to know of each other,
    # or the load creeps.
    holding: NDArray[np.float64]
    contact: NDArray[np.float64]  # (B, 6, C): free from, free to, stiffness, damping, and modal.py's held, held moment
    carried: NDArray[np.float64]  # (C, B) force of each contact
    roll_dof: NDArray[np.int64]  # (R,)
    roll: NDArray[np.float64]  # (C, R, 4): start, core, thickness, density
    roll_armature: NDArray[np.float64]  # (C, R) without what is wound up
    roll_inertia: NDArray[np.float64]  # (C, R) entry of the inertia matrix without what is wound up
    disturbance: NDArray[np.float64]  # (D, C)
    load_torque: NDArray[np.float64]  # (C,) external torque [N*m]
    # A torque from a table is added to it: profile (C, n) over profile_at (n,), see PackedLoad.set_profile.
    profile_at: NDArray[np.float64]
    profile: NDArray[np.float64]
    profile_of_position: bool
    profile_period: float
    profile_now: NDArray[np.float64]  # (C,)
    clock: NDArray[np.float64]  # (C,) time since the table was given [s]
    brake: NDArray[np.float64]  # (A, C) torque of each axis's holding brake, 0 where it is open [N*m]
    diverged: NDArray[np.int64]  # (C,) 1: frozen
