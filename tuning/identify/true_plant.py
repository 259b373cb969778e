"""What an emulated axis truly is, as the linear model has it: the truth that tests measure by."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mechanics.packed import PackedLoad
from tuning.response.linear_model import Plant

if TYPE_CHECKING:
    from drive_env.drives.interface import Drives

Floats = NDArray[np.float64]

RIGID = 1e-6  # a mode whose squared frequency is below this share of the greatest is none


def true_plant(drives: Drives, axis: int = 0) -> Plant:
    """Return the plant of an emulated axis, linearised where its load starts, with its first resonance.

    Flanks that transmit count as pressed, dry friction and gravity as none.

    Raises:
        ValueError: For drives on a bus, whose truth nobody knows, and for a machine with several axes.
    """
    if drives.machine is None:
        raise ValueError("the true parameters of a machine on a bus are unknown; identify it")
    emulated = drives.machine.drives  # whoever observes them
    if emulated.load.num_axes != 1:
        raise ValueError(f"load {emulated.load.name!r} couples {emulated.load.num_axes} axes; the model has one")
    true = {name: float(values[axis]) for name, values in drives.machine.parameters.items()}
    group = next(g for g in emulated.inside.groups if g.machines.start <= axis < g.machines.stop)
    J, viscous, pair = _mechanics(group.load, axis - group.machines.start)
    motor = emulated.motor
    psi = true["motor.psi_m"]
    factor = 1.0 if motor.kind == "dc" else 1.5
    known = {} if pair is None else {"anti_resonance": pair[0], "resonance": pair[1], "damping": pair[2]}
    return Plant(
        R=true["motor.R_s"],
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


def _mechanics(load: PackedLoad, copy: int) -> tuple[float, float, tuple[float, float, float] | None]:
    """Return inertia and viscous friction at the rotor, and anti-resonance, resonance [Hz], damping of the first."""
    rotor = load.plant.axis_motion[0]
    M = load.mass_matrix()[copy]
    K = np.diag(load.values.stiffness[copy]).astype(float)
    D = np.diag(load.values.damping[copy]).astype(float)
    D += load.values.friction[copy, 0, 3] * np.outer(rotor, rotor)
    for k, friction in enumerate(load.load.frictions, load.num_axes):
        D += load.values.friction[copy, k, 3] * _outer(load, friction.motion)
    for k, contact in enumerate(load.load.contacts):
        if contact.transmits:
            K += load.values.contact[copy, k, 2] * _outer(load, contact.motion)
            D += load.values.contact[copy, k, 3] * _outer(load, contact.motion)
    squares, modes = _modes(M, K)
    free = squares <= RIGID * max(squares.max(), 1.0)
    turning = np.flatnonzero(free)
    if turning.size != 1:
        raise ValueError(f"load {load.load.name!r} has {turning.size} motions without a spring; the model has one")
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


def _outer(load: PackedLoad, motion: Any) -> Floats:
    row = np.array([motion.get(name, 0.0) for name in load.joints])
    return np.outer(row, row)
