"""The data of a packed model for the compiled physics step."""

from __future__ import annotations

from dataclasses import dataclass

from mechanics.kernels.bundle import Bundle, Cube, Matrix, NumberMatrix, Numbers, Vector


@dataclass(eq=False)
class PackedPlant(Bundle):
    """The data of a packed model for the compiled step; built by packed.py.

    C copies, D degrees of freedom each, A axes, F frictions (the axes' bearings first), B contacts, E = F + B
    elements, R rolls. Copies come last, so that loops over them go through memory in order; MuJoCo's own arrays have
    them first. It holds addresses into the model and data of its PackedLoad, which has to outlive it; qpos to
    dof_armature are views of MuJoCo's own memory.
    """

    model_address: int
    data_address: int
    staggered: bool
    varying: bool  # inertias change: those of rotors and frictions are recomputed
    looking: bool  # every step begins with the first half of MuJoCo's, since forces change, too, or the solver works
    constant: bool  # the first half of MuJoCo's step would not change anything, except for rolls
    elastic: bool  # joints have springs
    qpos: Vector  # (C D,)
    qvel: Vector  # (C D,)
    qfrc_applied: Vector  # (C D,)
    qfrc_bias: Vector  # (C D,) gravity, Coriolis
    qfrc_passive: Vector  # (C D,)
    qfrc_constraint: Vector  # (C D,)
    inertia: Vector  # lower triangle of the inertia matrix, row by row
    inertia_start: Numbers  # (C D,) of each row
    inertia_count: Numbers  # (C D,)
    inertia_column: Numbers
    dof_armature: Vector  # (C D,)
    qvel_before: Vector  # (C D,) a step ago
    ahead: Vector  # (C D,) speed at which MuJoCo computes forces, minus qvel
    weigh_every: int
    steps: Numbers  # (1,) counted
    triangle: Cube  # (D, D, C) scratch
    lane: Matrix  # (8, C) scratch
    position: Matrix  # (D, C) qpos, scratch
    speed: Matrix  # (D, C) qvel at the step's start, scratch
    reached: Matrix  # (D, C) and at its end
    applied: Matrix  # (D, C) qfrc_applied, scratch
    total: Matrix  # (D, C) all force on each degree of freedom
    axis_motion: Matrix  # (A, D) rotor angle from qpos [1 or rad/m]
    axis_position: Matrix  # (A, D) position that presses each axis's switches, from qpos
    axis_start: Vector  # (A,) rotor angle of the start, which reads as 0
    # Displacement by a unit of motor torque with a first moment in time, (A, D, C) [rad/(N*m*s^2)].
    axis_kick: Cube
    # Corrections of modal.py.
    stiffness: Cube  # (D, D, C) [N*m/rad]
    held: Cube  # (D, D, C)
    held_moment: Cube  # (D, A, C) [1/s]
    damper: Cube  # (D, D, C) [N*m*s/rad]
    ends: Cube  # (A, D, C)
    ends_of_speed: Cube  # (A, D, C) [s]
    spring_zero: Vector  # (D,) [rad]
    damping: Matrix  # (D, C) whole damping [N*m*s/rad]
    bias: Matrix  # (D, C) forces added by MuJoCo, with the sign of qfrc_bias
    motion: Matrix  # (E, D) speed of each element from qvel
    # Torque on each element's motion from joint torques, and joint speeds of a unit of that motion's: (E, D, C).
    share: Cube
    mass: Matrix  # (E, C) inertia of each element's motion; the first A are what the rotors feel at once
    # (F, 8, C): coulomb, breakaway, stribeck, viscous, drag, bristles' stiffness and damping, 1/efficiency - 1
    friction: Cube
    carries: Numbers  # (F,) contact whose force increases the friction, or -1
    bristle: Matrix  # (C, F) deflection
    stuck: NumberMatrix  # (F, C) 1: friction holds this motion
    # (F, C) torque of each friction in the last step: frictions of coupled motions need each other's, or the load
    # creeps.
    holding: Matrix
    contact: Cube  # (B, 7, C): free from, free to, stiffness, damping, and modal.py's held, held moment, ends
    carried: Matrix  # (C, B) mean force of each contact over the last step
    roll_dof: Numbers  # (R,)
    roll: Cube  # (C, R, 4): start, core, thickness, density
    roll_armature: Matrix  # (C, R) without the wound web
    roll_inertia: Matrix  # (C, R) entry of the inertia matrix without the wound web
    disturbance: Matrix  # (D, C)
    load_torque: Vector  # (C,) external torque [N*m]
    # A torque from a table is added to it: profile (C, n) over profile_at (n,), see PackedLoad.set_profile.
    profile_at: Vector
    profile: Matrix
    profile_of_position: bool
    profile_period: float
    profile_now: Vector  # (C,)
    clock: Vector  # (C,) time since the table was given [s]
    # (F, C) further holding torque on each friction's motion [N*m or N]: for the axes' bearings that of holding brake
    # and jam, for the load's frictions that of a jam.
    brake: Matrix
    jam: Matrix  # (A, C) the part of it on the axes that is a jam
    diverged: Numbers  # (C,) 1: frozen
