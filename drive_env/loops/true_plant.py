"""Emulated machines, linearised where their loads start: the truth that scores and tests measure by.

Flanks that transmit count as pressed, dry friction and gravity as none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from drive_env.emulator.emulated_drives import emulated_of
from drive_env.loops.linear_model import Plant
from drive_env.loops.sampled import RIGID, LinearMachines, Windings, linear_machines
from mechanics.arrays import Floats
from mechanics.packed import PackedLoad

if TYPE_CHECKING:
    from drive_env.drives.interface import Drives


def true_plant(drives: Drives, axis: int = 0) -> Plant:
    """Return the plant of an emulated axis, with its first resonance.

    Raises:
        ValueError: For drives on a bus, whose true parameters are unknown, and for a machine with several axes.
    """
    if drives.machine is None:
        raise ValueError("the true parameters of a machine on a bus are unknown; identify it")
    emulated = emulated_of(drives)  # without the observers around them
    if emulated.load.num_axes != 1:
        raise ValueError(f"load {emulated.load.name!r} couples {emulated.load.num_axes} axes; the model has one")
    true = {name: float(values[axis]) for name, values in drives.machine.parameters.items()}
    group = next(g for g in emulated.inside.groups if g.machines.start <= axis < g.machines.stop)
    J, viscous, pair = _first_resonance(linear_load(group.load), axis - group.machines.start, group.load.load.name)
    motor = emulated.motor
    psi = true["motor.psi_m"]
    factor = 1.0 if motor.kind == "dc" else 1.5
    known = {} if pair is None else {"anti_resonance": pair[0], "resonance": pair[1], "damping": pair[2]}
    return Plant(
        R=float(terminal_resistance(true, motor.kind)),
        L=true["motor.L_q"],
        supply=float(drives.machine.supply[axis]),
        torque_constant=factor * motor.n_p * psi,
        emf_constant=motor.n_p * psi,
        inertia=J,
        viscous=viscous,
        delay=1.0 / emulated.device.velocity_rate,
        velocity_filter=true["stage.velocity_filter"],
        counts=round(motor.encoder_counts * true["motor.encoder_interpolation"]),
        **known,
    )


def terminal_resistance(parameters: Mapping[str, Any], kind: str) -> Any:
    """Return the resistance that a drive sees [ohm]: of one phase of the winding, with that of the stage in its path.

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
    """Return emulated machines with all that they move, each with all its axes.

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
    """Return each axis' delay by the springs of emulated machines [s], (machines, axes); 0 for a rigid axis.

    While a rotor accelerates by a and the others stand, the parts on its springs are twisted behind it: the square of
    the delay is the energy of the twist over that of the motion. On one spring it is the square root of the load's
    share of the inertia, over the angular frequency of the anti-resonance.
    """
    parts = []
    for group in emulated_of(drives).inside.groups:
        M, _, K, rotors = linear_load(group.load)
        one = np.linalg.pinv(rotors)  # each rotor turned by 1, (joints, axes)
        free = np.linalg.svd(rotors)[2][len(rotors) :].T  # how joints may move while all rotors stand
        soft = np.linalg.pinv(free.T @ K @ free, rcond=RIGID, hermitian=True)
        moved = one - free @ (soft @ (free.T @ K @ one))
        pushed = free.T @ M @ moved
        twisted, turned = (np.einsum("cja,cja->ca", a, b) for a, b in ((pushed, soft @ pushed), (moved, M @ moved)))
        parts.append(np.sqrt(twisted / turned))
    return np.concatenate(parts)


def _first_resonance(found: LinearLoad, copy: int, name: str) -> tuple[float, float, tuple[float, float, float] | None]:
    """Return inertia and viscous friction at the rotor, and anti-resonance, resonance [Hz], damping of the first."""
    M, D, K, rotor = found.M[copy], found.D[copy], found.K[copy], found.rotors[0]
    squares, modes = _modes(M, K)
    free = squares <= RIGID * max(squares.max(), 1.0)
    turning = np.flatnonzero(free)
    if turning.size != 1:
        raise ValueError(f"load {name!r} has {turning.size} motions without a spring; the model has one")
    rigid = modes[:, turning[0]]
    swing = float(rotor @ rigid)
    J, viscous = 1.0 / swing**2, float(rigid @ D @ rigid) / swing**2
    if free.all():
        return J, viscous, None
    first = int(np.flatnonzero(~free)[0])
    w = math.sqrt(squares[first])
    # With the rotor held, what is left swings at the anti-resonances.
    others = np.linalg.svd(rotor[None, :])[2][1:].T
    locked, _ = _modes(others.T @ M @ others, others.T @ K @ others)
    damping = float(modes[:, first] @ D @ modes[:, first]) / (2.0 * w)
    return J, viscous, (math.sqrt(locked[0]) / (2.0 * math.pi), w / (2.0 * math.pi), damping)


def _modes(M: Floats, K: Floats) -> tuple[Floats, Floats]:
    """Return squared angular frequencies, ascending, and the modes of M q'' + K q = 0 with unit modal mass."""
    from scipy.linalg import eigh

    squares, modes = eigh(K, M)
    return np.asarray(squares), np.asarray(modes)


def _row(load: PackedLoad, motion: Mapping[str, float]) -> Floats:
    return np.array([motion.get(name, 0.0) for name in load.joints])
