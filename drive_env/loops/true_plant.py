"""Emulated machines, linearised where their loads start: the true plant for scores and tests.

Backlash is taken as closed; dry friction and gravity are neglected.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from drive_env.emulator.emulated_drives import emulated_of
from drive_env.loops.sampled import RIGID, LinearMachines, Windings, linear_machines
from mechanics.arrays import Floats
from mechanics.packed import PackedLoad

if TYPE_CHECKING:
    from drive_env.drives.interface import Drives


def terminal_resistance(parameters: Mapping[str, Any], kind: str) -> Any:
    """Return the resistance seen by a drive [ohm]: one phase of the winding and the stage in its path.

    A brushed motor's current flows through both legs of its bridge.
    """
    return parameters["motor.R_s"] + (2.0 if kind == "dc" else 1.0) * parameters["stage.on_resistance"]


class LinearLoad(NamedTuple):
    """M q'' + D q' + K q = torque: (copies, D, D) each, and the joint coordinates of each rotor's angle, (axes, D)."""

    M: Floats
    D: Floats
    K: Floats
    rotors: Floats


def linear_load(load: PackedLoad) -> LinearLoad:
    """Return the copies of a load at their present position."""
    values, row = load.values, load.load
    unit = np.eye(load.num_dofs)
    K, D = values.stiffness[:, :, None] * unit, values.damping[:, :, None] * unit
    turned = [*load.plant.axis_motion, *(_row(load, friction.motion) for friction in row.frictions)]
    for k, motion in enumerate(turned):
        D = D + values.friction[:, k, 3, None, None] * np.outer(motion, motion)
    for k, contact in enumerate(row.contacts):
        if contact.transmits:
            both = np.outer(*[_row(load, contact.motion)] * 2)
            K, D = K + values.contact[:, k, 2, None, None] * both, D + values.contact[:, k, 3, None, None] * both
    return LinearLoad(load.mass_matrix(), D, K, load.plant.axis_motion)


def true_machines(drives: Drives) -> LinearMachines:
    """Return emulated machines with their loads, each with all its axes.

    Raises:
        ValueError: For drives on a bus, whose true parameters are unknown.
    """
    if drives.machine is None:
        raise ValueError("the true parameters of a machine on a bus are unknown; identify it")
    emulated = emulated_of(drives)
    axes, motor = emulated.load.num_axes, emulated.motor
    true = {
        name: np.asarray(values, float).reshape(-1, axes)
        if np.size(values) == emulated.num_axes
        else np.repeat(np.asarray(values, float)[:, None], axes, axis=1)
        for name, values in drives.machine.parameters.items()
    }
    parts = [linear_load(group.load) for group in emulated.inside.groups]
    M, D, K = (np.concatenate([getattr(part, name) for part in parts]) for name in ("M", "D", "K"))
    emf = motor.n_p * true["motor.psi_m"]
    windings = Windings(
        terminal_resistance(true, motor.kind), true["motor.L_q"], emf, (1.0 if motor.kind == "dc" else 1.5) * emf,
        np.asarray(drives.machine.supply, float).reshape(len(M), axes), true["stage.velocity_filter"],
    )  # fmt: skip
    return linear_machines(windings, M, D, K, parts[0].rotors)


def elastic_lags(drives: Drives) -> Floats:
    """Return each axis' delay due to the springs of emulated machines [s], (machines, axes); 0 for a rigid axis.

    While a rotor accelerates by a and the others stand, the parts on its springs are twisted behind it: the square of
    the delay is the energy of the twist over that of the motion. On one spring it is the square root of the load's
    share of the inertia, over the angular frequency of the anti-resonance.
    """
    parts = []
    for group in emulated_of(drives).inside.groups:
        M, _, K, rotors = linear_load(group.load)
        one = np.linalg.pinv(rotors)  # each rotor turned by 1, (joints, axes)
        free = np.linalg.svd(rotors)[2][len(rotors) :].T  # motions of joints while all rotors stand
        soft = np.linalg.pinv(free.T @ K @ free, rcond=RIGID, hermitian=True)
        moved = one - free @ (soft @ (free.T @ K @ one))
        pushed = free.T @ M @ moved
        twisted, turned = (np.einsum("cja,cja->ca", a, b) for a, b in ((pushed, soft @ pushed), (moved, M @ moved)))
        parts.append(np.sqrt(twisted / turned))
    return np.concatenate(parts)


def _row(load: PackedLoad, motion: Mapping[str, float]) -> Floats:
    return np.array([motion.get(name, 0.0) for name in load.joints])
