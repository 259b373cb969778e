"""One physics step of a packed model, called from compiled code.

Time is staggered (leapfrog): qvel stands at step ends, qpos at step middles. MuJoCo's semi-implicit step then is the
leapfrog scheme, of second order, at the price of one force evaluation. Damping is kept second-order by giving half of
it to MuJoCo, which takes it at the step's end, and half to the applied force, at the step's start.
"""

from __future__ import annotations

import ctypes
import math
import sys
from pathlib import Path
from typing import NamedTuple

import llvmlite.binding
import mujoco
import numpy as np
from numba import types
from numpy.typing import NDArray

from mechanics.compiled import stage
from mechanics.friction import bristle_torque, friction_torque

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
_call = types.void(types.uintp, types.uintp)
_mj_step = types.ExternalFunction("mj_step", _call)
# The two halves of mj_step: what follows from positions and speeds, then from forces.
_mj_step1 = types.ExternalFunction("mj_step1", _call)
_mj_step2 = types.ExternalFunction("mj_step2", _call)


class Plant(NamedTuple):
    """What the compiled step needs of a packed model; built by packed.py.

    C copies, D degrees of freedom each, A axes, F frictions (the axes' bearings first), B contacts, E = F + B
    elements, R rolls. It holds addresses into the model and data of its PackedLoad, which has to outlive it; qpos to
    dof_armature are views of MuJoCo's own memory.
    """

    model_address: int
    data_address: int
    staggered: bool
    varying: bool  # forces and inertias are looked up every step: they change with the position, or the solver works
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
    scratch: NDArray[np.float64]  # (D, D)
    total: NDArray[np.float64]  # (C, D) all force on each degree of freedom
    axis_motion: NDArray[np.float64]  # (A, D) rotor angle from qpos [1 or rad/m]
    axis_position: NDArray[np.float64]  # (A, D) position of what presses each axis's switches, from qpos
    axis_start: NDArray[np.float64]  # (A,) rotor angle of the start, which reads as 0
    # What a unit of motor torque with a first moment in time displaces, (C, A, D) [rad/(N*m*s^2)].
    axis_kick: NDArray[np.float64]
    # Corrections of modal.py.
    stiffness: NDArray[np.float64]  # (C, D, D) [N*m/rad]
    held: NDArray[np.float64]  # (C, D, D)
    held_moment: NDArray[np.float64]  # (C, D, A) [1/s]
    spring_zero: NDArray[np.float64]  # (D,) [rad]
    damping: NDArray[np.float64]  # (C, D) whole damping [N*m*s/rad]
    bias: NDArray[np.float64]  # (C, D) forces that MuJoCo adds by itself, with its sign of qfrc_bias
    motion: NDArray[np.float64]  # (E, D) speed of each element from qvel
    # Torque on each element's motion from joint torques, and joint speeds of a unit of that motion's: (C, E, D).
    share: NDArray[np.float64]
    mass: NDArray[np.float64]  # (C, E) inertia of each element's motion; the first A are what the rotors feel at once
    # (C, F, 8): coulomb, breakaway, stribeck, viscous, drag, bristles' stiffness and damping, 1/efficiency - 1
    friction: NDArray[np.float64]
    carries: NDArray[np.int64]  # (F,) contact whose force the friction grows with, or -1
    bristle: NDArray[np.float64]  # (C, F) deflection
    stuck: NDArray[np.int64]  # (C, F) 1: friction holds this motion
    # (C, F) torque of each friction in the last step: frictions that hold coupled motions need to know of each other,
    # or the load creeps.
    holding: NDArray[np.float64]
    contact: NDArray[np.float64]  # (C, B, 6): free from, free to, stiffness, damping, and modal.py's held, held moment
    carried: NDArray[np.float64]  # (C, B) force of each contact
    roll_dof: NDArray[np.int64]  # (R,)
    roll: NDArray[np.float64]  # (C, R, 4): start, core, thickness, density
    roll_armature: NDArray[np.float64]  # (C, R) without what is wound up
    disturbance: NDArray[np.float64]  # (C, D)
    load_torque: NDArray[np.float64]  # (C,) external torque [N*m]
    # A torque from a table is added to it: profile (C, n) over profile_at (n,), see PackedLoad.set_profile.
    profile_at: NDArray[np.float64]
    profile: NDArray[np.float64]
    profile_of_position: bool
    profile_period: float
    profile_now: NDArray[np.float64]  # (C,)
    clock: NDArray[np.float64]  # (C,) time since the table was given [s]
    brake: NDArray[np.float64]  # (C, A) torque of each axis's holding brake, 0 where it is open [N*m]
    diverged: NDArray[np.int64]  # (C,) 1: frozen


# The plant is a tuple of many arrays: handing it on, or taking an array out of it, counts references. The stages below
# therefore loop over copies themselves, and take out what they need before the loop. A call per copy costs 0.6 us.
@stage
def wind(plant):
    """Let what is wound up so far give each roll its inertia, and the web its lever.

    What arrives comes with the roll's surface speed and brings its own momentum, so that growing costs no torque.
    """
    copies, D = plant.damping.shape
    qpos, roll, roll_dof, roll_armature = plant.qpos, plant.roll, plant.roll_dof, plant.roll_armature
    dof_armature, disturbance = plant.dof_armature, plant.disturbance
    for copy in range(copies):
        for r in range(roll_dof.shape[0]):
            d = roll_dof[r]
            start, core, thickness = roll[copy, r, 0], roll[copy, r, 1], roll[copy, r, 2]
            radius = max(start + thickness / (2.0 * math.pi) * qpos[copy * D + d], core)
            wound = 0.5 * math.pi * roll[copy, r, 3] * (radius**4 - core**4)
            dof_armature[copy * D + d] = roll_armature[copy, r] + wound
            disturbance[copy, d] = radius


@stage
def look(plant):
    """Bring bias forces and inertias to the present position, by the first half of MuJoCo's step.

    Centrifugal and Coriolis forces are taken at the step's middle, with the speed extrapolated to there.
    """
    copies, D = plant.damping.shape
    if plant.roll_dof.shape[0] > 0:
        wind(plant)
    ahead, qvel, qvel_before = plant.ahead, plant.qvel, plant.qvel_before
    share = 0.5 if plant.staggered else 0.0
    for d in range(copies * D):
        v = qvel[d]
        ahead[d] = share * (v - qvel_before[d])
        qvel_before[d] = v
        qvel[d] = v + ahead[d]
    _mj_step1(plant.model_address, plant.data_address)
    bias, found, passive, constraint = plant.bias, plant.qfrc_bias, plant.qfrc_passive, plant.qfrc_constraint
    for copy in range(copies):
        for d in range(D):
            k = copy * D + d
            qvel[k] = qvel_before[k]
            # The solver's force is that of the step before: it comes after those that are computed here.
            bias[copy, d] = found[k] - passive[k] - constraint[k]
    if plant.steps[0] % plant.weigh_every == 0:
        weigh(plant)
    plant.steps[0] += 1


@stage
def weigh(plant):
    """Derive what each element's motion weighs from the copies' inertia matrices: M x = motion, by Cholesky."""
    copies, D = plant.damping.shape
    L, share, mass, motion, kick = plant.scratch, plant.share, plant.mass, plant.motion, plant.axis_kick
    inertia, start, count = plant.inertia, plant.inertia_start, plant.inertia_count
    column = plant.inertia_column
    kicked = 0 if plant.elastic else plant.axis_motion.shape[0]
    for copy in range(copies):
        base = copy * D
        for i in range(D):
            for j in range(i + 1):
                L[i, j] = 0.0
            for k in range(start[base + i], start[base + i] + count[base + i]):
                L[i, column[k] - base] = inertia[k]
        # L holds the triangle with the inverse of its diagonal.
        for j in range(D):
            square = L[j, j]
            for k in range(j):
                square -= L[j, k] * L[j, k]
            L[j, j] = 1.0 / math.sqrt(square)
            for i in range(j + 1, D):
                total = L[i, j]
                for k in range(j):
                    total -= L[i, k] * L[j, k]
                L[i, j] = total * L[j, j]
        for e in range(motion.shape[0]):
            # The forward half gives the mobility; it begins where the motion does.
            mobility = 0.0
            for i in range(D):
                total = motion[e, i]
                for k in range(i):
                    total -= L[i, k] * share[copy, e, k]
                total *= L[i, i]
                share[copy, e, i] = total
                mobility += total * total
            mass[copy, e] = 1.0 / mobility
            for i in range(D - 1, -1, -1):
                total = share[copy, e, i]
                for k in range(i + 1, D):
                    total -= L[k, i] * share[copy, e, k]
                share[copy, e, i] = total * L[i, i]
            if e < kicked:
                for i in range(D):
                    kick[copy, e, i] = share[copy, e, i]
            for i in range(D):
                share[copy, e, i] *= mass[copy, e]


@stage
def drive(plant, torque, moment, h):
    """Write qfrc_applied for one step of h [s]: motor torque (C A,), load torque, springs, half of the damping.

    `total` becomes all force on each degree of freedom, what MuJoCo adds included.
    """
    copies, D = plant.damping.shape
    axis_motion, disturbance, load_torque = plant.axis_motion, plant.disturbance, plant.load_torque
    A = axis_motion.shape[0]
    qpos, qvel, ahead, applied, total = plant.qpos, plant.qvel, plant.ahead, plant.qfrc_applied, plant.total
    held, stiffness, held_moment = plant.held, plant.stiffness, plant.held_moment
    bias, damping, diverged, spring_zero = plant.bias, plant.damping, plant.diverged, plant.spring_zero
    elastic, profiled = plant.elastic, plant.profile_at.shape[0] > 0
    half = 0.5 if plant.staggered else 0.0
    given = 0.0 if plant.varying else half
    if profiled:
        follow_profile(plant, h)
    profile_now = plant.profile_now
    for copy in range(copies):
        base = copy * D
        external = load_torque[copy] + profile_now[copy]
        if not abs(external) < 1e9:  # also true of nan
            diverged[copy] = 1
        for a in range(A):
            if not abs(torque[copy * A + a]) < 1e9:
                diverged[copy] = 1
        if diverged[copy]:
            continue
        for d in range(D):
            force = disturbance[copy, d] * external
            for a in range(A):
                force += axis_motion[a, d] * torque[copy * A + a]
            applied[base + d] = force
            total[copy, d] = force - bias[copy, d]
        if elastic:
            for d in range(D):
                force = 0.0
                for k in range(D):
                    force += held[copy, d, k] * total[copy, k]
                    force -= stiffness[copy, d, k] * (qpos[base + k] - spring_zero[k])
                for a in range(A):
                    force += held_moment[copy, d, a] * moment[copy * A + a]
                applied[base + d] += force
        for d in range(D):
            # MuJoCo's half was taken at the speed ahead in `look`.
            applied[base + d] -= half * damping[copy, d] * (qvel[base + d] - ahead[base + d])
            total[copy, d] = applied[base + d] - bias[copy, d] - given * damping[copy, d] * qvel[base + d]


@stage
def follow_profile(plant, h):
    """Look up what the table of torque says for the middle of this step, interpolated."""
    copies, D = plant.damping.shape
    at, profile = plant.profile_at, plant.profile
    for copy in range(copies):
        x = 0.0
        if plant.profile_of_position:
            for d in range(D):
                x += plant.axis_position[0, d] * plant.qpos[copy * D + d]
        else:
            x = plant.clock[copy] + 0.5 * h
            plant.clock[copy] += h
        if plant.profile_period > 0.0:
            x = at[0] + (x - at[0]) % plant.profile_period
        k = np.searchsorted(at, x)
        if k == 0:
            plant.profile_now[copy] = profile[copy, 0]
        elif k == at.shape[0]:
            plant.profile_now[copy] = profile[copy, k - 1]
        else:
            share = (x - at[k - 1]) / (at[k] - at[k - 1])
            plant.profile_now[copy] = profile[copy, k - 1] + share * (profile[copy, k] - profile[copy, k - 1])


@stage
def press(plant, moment, h):
    """Add the force of contacts: a spring and a damper beyond the gap, which push and never pull."""
    copies, D = plant.damping.shape
    contact, carried, diverged, axis_motion = plant.contact, plant.carried, plant.diverged, plant.axis_motion
    qpos, qvel, applied, total = plant.qpos, plant.qvel, plant.qfrc_applied, plant.total
    motion, share, mass = plant.motion, plant.share, plant.mass
    A, F = axis_motion.shape[0], plant.friction.shape[1]
    for copy in range(copies):
        if diverged[copy]:
            continue
        base = copy * D
        for b in range(contact.shape[1]):
            e = F + b
            x = 0.0
            for d in range(D):
                x += motion[e, d] * qpos[base + d]
            carried[copy, b] = 0.0
            low, high = contact[copy, b, 0], contact[copy, b, 1]
            if low <= x <= high:
                continue
            pressed = low - x if x < low else high - x
            v = 0.0
            other = 0.0
            for d in range(D):
                v += motion[e, d] * qvel[base + d]
                other += share[copy, e, d] * total[copy, d]
            correction = contact[copy, b, 4] * other
            for a in range(A):
                turned = 0.0
                for d in range(D):
                    turned += share[copy, e, d] * axis_motion[a, d]
                correction += contact[copy, b, 5] * turned * moment[copy * A + a]
            spring = contact[copy, b, 2] * pressed
            # The damper at the speed of the step's middle, which it slows itself: stable for any damping.
            half, damping = 0.5 * h / mass[copy, e], contact[copy, b, 3]
            force = spring - damping * (v + half * (other + correction + spring)) / (1.0 + half * damping)
            if (force > 0.0) != (pressed > 0.0):
                continue
            carried[copy, b] = force
            force += correction
            for d in range(D):
                applied[base + d] += motion[e, d] * force
                total[copy, d] += motion[e, d] * force


@stage
def rub(plant, h):
    """Add friction, one motion after the other: each sees all other forces, of later frictions those a step ago."""
    copies, D = plant.damping.shape
    friction, brake, carries, carried = plant.friction, plant.brake, plant.carries, plant.carried
    qvel, applied, total, diverged = plant.qvel, plant.qfrc_applied, plant.total, plant.diverged
    motion, share, masses, bristle, stuck = plant.motion, plant.share, plant.mass, plant.bristle, plant.stuck
    holding = plant.holding
    A, F = plant.axis_motion.shape[0], friction.shape[1]
    for copy in range(copies):
        if diverged[copy]:
            continue
        base = copy * D
        for f in range(1, F):
            for d in range(D):
                total[copy, d] += motion[f, d] * holding[copy, f]
        for f in range(F):
            v = 0.0
            other = 0.0
            if f > 0:
                for d in range(D):
                    total[copy, d] -= motion[f, d] * holding[copy, f]
            for d in range(D):
                v += motion[f, d] * qvel[base + d]
                other += share[copy, f, d] * total[copy, d]
            mass = masses[copy, f]
            if not abs(h * other) < SPEED_LIMIT * mass:
                # Seen before MuJoCo sees it: its own check would write a log file.
                diverged[copy] = 1
                break
            # What holds beside the row's own: a brake, or a screw that is pressed.
            more = brake[copy, f] if f < A else 0.0
            if carries[f] >= 0:
                more += friction[copy, f, 7] * abs(carried[copy, carries[f]])
            coulomb, breakaway = friction[copy, f, 0] + more, friction[copy, f, 1] + more
            stribeck, viscous, drag = friction[copy, f, 2], friction[copy, f, 3], friction[copy, f, 4]
            if friction[copy, f, 5] > 0.0:
                force, bristle[copy, f] = bristle_torque(
                    v, other, mass, h, bristle[copy, f], friction[copy, f, 5], friction[copy, f, 6],
                    coulomb, breakaway, stribeck, viscous, drag,
                )  # fmt: skip
            else:
                force = friction_torque(v, other, mass, h, coulomb, breakaway, stribeck, viscous, drag)
                rest = abs(mass * v + h * (other + force))
                stuck[copy, f] = 1 if rest < ROUNDING * h * breakaway else 0
            holding[copy, f] = force
            for d in range(D):
                applied[base + d] += motion[f, d] * force
                total[copy, d] += motion[f, d] * force


@stage
def freeze(plant):
    """Hold diverged copies at rest, so that they disturb no other and cost no numbers."""
    copies, D = plant.damping.shape
    for copy in range(copies):
        if plant.diverged[copy]:
            for d in range(D):
                k = copy * D + d
                plant.qpos[k] = 0.0
                plant.qvel[k] = 0.0
                plant.qvel_before[k] = 0.0
                plant.qfrc_applied[k] = 0.0
                plant.bias[copy, d] = 0.0
            for f in range(plant.holding.shape[1]):
                plant.holding[copy, f] = 0.0
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
    copies, D = plant.damping.shape
    axis_motion, axis_position, axis_start = plant.axis_motion, plant.axis_position, plant.axis_start
    A, F = axis_motion.shape[0], plant.friction.shape[1]
    qpos, qvel, qvel_before, diverged = plant.qpos, plant.qvel, plant.qvel_before, plant.diverged
    if plant.varying:
        look(plant)
    else:
        for d in range(copies * D):
            qvel_before[d] = qvel[d]
    drive(plant, torque, moment, h)
    if plant.contact.shape[1] > 0:
        press(plant, moment, h)
    rub(plant, h)
    freeze(plant)
    if plant.varying and plant.staggered:
        _mj_step2(plant.model_address, plant.data_address)
    else:
        _mj_step(plant.model_address, plant.data_address)
    for copy in range(copies):
        for d in range(copy * D, copy * D + D):
            if not abs(qvel[d]) < SPEED_LIMIT:
                diverged[copy] = 1
    freeze(plant)
    stuck, motion, share, mass = plant.stuck, plant.motion, plant.share, plant.mass
    staggered, axis_kick = plant.staggered, plant.axis_kick
    # From the step's middle back to its end.
    back = 0.5 * h if staggered else 0.0
    rate = 1.0 / h
    for copy in range(copies):
        base = copy * D
        if diverged[copy]:
            for axis in range(copy * A, copy * A + A):
                theta[axis], omega[axis], reaction[axis], position[axis] = 0.0, 0.0, 0.0, 0.0
            continue
        for f in range(F):
            if stuck[copy, f]:
                rest = 0.0
                for d in range(D):
                    rest += motion[f, d] * qvel[base + d]
                for d in range(D):
                    qvel[base + d] -= share[copy, f, d] * rest
        if staggered:
            for a in range(A):
                late = moment[copy * A + a] * h
                for d in range(D):
                    qpos[base + d] -= axis_kick[copy, a, d] * late
        for a in range(A):
            axis = copy * A + a
            angle, w, w_before, place = 0.0, 0.0, 0.0, 0.0
            for d in range(D):
                v = qvel[base + d]
                angle += axis_motion[a, d] * qpos[base + d]
                w += axis_motion[a, d] * v
                w_before += axis_motion[a, d] * qvel_before[base + d]
                place += axis_position[a, d] * (qpos[base + d] - back * v)
            acceleration = (w - w_before) * rate
            omega[axis] = w
            theta[axis] = angle - axis_start[a] - back * (w + 0.5 * back * acceleration)
            position[axis] = place
            reaction[axis] = torque[axis] - mass[copy, a] * acceleration
