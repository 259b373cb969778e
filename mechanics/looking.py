"""Inertias and forces that depend on the position: computed at the start of a physics step."""

from __future__ import annotations

import math

from mechanics.kernels import native
from mechanics.kernels.compiled import stage


@stage
def wind(plant):
    """Set each roll's inertia and the web's lever arm by the wound length.

    Arriving web has the roll's surface speed and its own momentum, so that growth needs no torque.
    """
    D, copies = plant.damping.shape
    qpos, roll, roll_dof, roll_armature = plant.qpos, plant.roll, plant.roll_dof, plant.roll_armature
    dof_armature, disturbance = plant.dof_armature, plant.disturbance
    inertia, start, count, roll_inertia = plant.inertia, plant.inertia_start, plant.inertia_count, plant.roll_inertia
    for r in range(roll_dof.shape[0]):
        d = roll_dof[r]
        for copy in range(copies):
            k = copy * D + d
            begun, core, thickness = roll[copy, r, 0], roll[copy, r, 1], roll[copy, r, 2]
            radius = max(begun + thickness / (2.0 * math.pi) * qpos[k], core)
            wound = 0.5 * math.pi * roll[copy, r, 3] * (radius**4 - core**4)
            dof_armature[k] = roll_armature[copy, r] + wound
            # MuJoCo's results of the first half of its step.
            inertia[start[k] + count[k] - 1] = roll_inertia[copy, r] + wound
            disturbance[d, copy] = radius


@stage
def look(plant):
    """Update bias forces and inertias to the present position by the first half of MuJoCo's step.

    Centrifugal and Coriolis forces are those at the step's middle, with the speed extrapolated.
    """
    D, copies = plant.damping.shape
    if plant.roll_dof.shape[0] > 0:
        wind(plant)
    ahead, qvel, qvel_before = plant.ahead, plant.qvel, plant.qvel_before
    if plant.looking:
        share = 0.5 if plant.staggered else 0.0
        for k in range(copies * D):
            v = qvel[k]
            ahead[k] = share * (v - qvel_before[k])
            qvel_before[k] = v
            qvel[k] = v + ahead[k]
        native.step1(plant.model_address, plant.data_address)
        bias, found, passive, constraint = plant.bias, plant.qfrc_bias, plant.qfrc_passive, plant.qfrc_constraint
        for d in range(D):
            for copy in range(copies):
                k = copy * D + d
                # The solver's force is that of the previous step: it follows the forces that are computed here.
                bias[d, copy] = found[k] - passive[k] - constraint[k]
        for k in range(copies * D):
            qvel[k] = qvel_before[k]
    else:
        native.factor(plant.model_address, plant.data_address)
    if plant.steps[0] % plant.weigh_every == 0:
        weigh(plant)
    plant.steps[0] += 1


@stage
def decompose(plant):
    """Write the copies' inertia matrices as L L', by Cholesky: the triangle with the inverse of its diagonal."""
    D, copies = plant.damping.shape
    L, inertia, start, count = plant.triangle, plant.inertia, plant.inertia_start, plant.inertia_count
    column = plant.inertia_column
    for i in range(D):
        for j in range(i + 1):
            for copy in range(copies):
                L[i, j, copy] = 0.0
        for k in range(count[i]):
            j = column[start[i] + k]
            for copy in range(copies):
                L[i, j, copy] = inertia[start[copy * D + i] + k]
    for j in range(D):
        for k in range(j):
            for copy in range(copies):
                L[j, j, copy] -= L[j, k, copy] * L[j, k, copy]
        for copy in range(copies):
            L[j, j, copy] = 1.0 / math.sqrt(L[j, j, copy])
        for i in range(j + 1, D):
            for k in range(j):
                for copy in range(copies):
                    L[i, j, copy] -= L[i, k, copy] * L[j, k, copy]
            for copy in range(copies):
                L[i, j, copy] *= L[j, j, copy]


@stage
def weigh(plant):
    """Derive the effective inertia of each element's motion from the copies' inertia matrices: M x = motion."""
    D, copies = plant.damping.shape
    L, share, mass, motion, kick = plant.triangle, plant.share, plant.mass, plant.motion, plant.axis_kick
    kicked = 0 if plant.elastic else plant.axis_motion.shape[0]
    decompose(plant)
    for e in range(motion.shape[0]):
        # The forward half gives the mobility.
        for copy in range(copies):
            mass[e, copy] = 0.0
        for i in range(D):
            for copy in range(copies):
                share[e, i, copy] = motion[e, i]
            for k in range(i):
                for copy in range(copies):
                    share[e, i, copy] -= L[i, k, copy] * share[e, k, copy]
            for copy in range(copies):
                share[e, i, copy] *= L[i, i, copy]
            for copy in range(copies):
                mass[e, copy] += share[e, i, copy] * share[e, i, copy]
        for copy in range(copies):
            mass[e, copy] = 1.0 / mass[e, copy]
        for i in range(D - 1, -1, -1):
            for k in range(i + 1, D):
                for copy in range(copies):
                    share[e, i, copy] -= L[k, i, copy] * share[e, k, copy]
            for copy in range(copies):
                share[e, i, copy] *= L[i, i, copy]
        for i in range(D):
            if e < kicked:
                for copy in range(copies):
                    kick[e, i, copy] = share[e, i, copy]
            for copy in range(copies):
                share[e, i, copy] *= mass[e, copy]
