"""Emulated machines whose truth is known: their plants, and identifications that cost nothing."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import eigh

from drive_env import EmulatedDrives
from drive_env.devices import find_device
from drive_env.devices.gains import rule_gains
from drive_env.drives.raw_gains import write_gains
from drive_env.emulator.emulated_drives import emulated_of
from drive_env.loops.linear_model import Plant
from drive_env.loops.sampled import RIGID
from drive_env.loops.true_plant import LinearLoad, linear_load, terminal_resistance, true_machines
from mechanics.arrays import Floats
from mechanics.shaft import way
from tuning.auto.identified import calm_gains
from tuning.auto.proving import ProvingGround
from tuning.compare.suite import groups, open_group
from tuning.estimate import refused


def true_plant(drives, axis: int = 0) -> Plant:
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
    squares, modes = eigh(K, M)
    return np.asarray(squares), np.asarray(modes)


def truth(drives, axis, offset):
    """Return the true values of an axis, in data sheet units of torque."""
    plant = true_plant(drives, axis)
    group = next(g for g in drives.inside.groups if g.machines.start <= axis < g.machines.stop)
    load, copy = group.load, axis - group.machines.start
    ratio = np.abs(load.plant.motion[: load.num_frictions] @ way(load).joints.T)[:, 0]
    each = load.plant.friction[:, 0].T[copy] * ratio
    dry = each.sum()
    parameters = drives.machine.parameters
    if "load.efficiency" in parameters:
        # What a screw or a gear carries at constant speed: gravity, or the friction behind it.
        carried = max(each[-1], abs(offset) * plant.torque_constant)
        dry += (1.0 / parameters["load.efficiency"][axis] - 1.0) * carried
    viscous = plant.viscous
    if "load.efficiency" in parameters and abs(offset) * plant.torque_constant < 2.0 * each[-1]:
        # What lies behind the transmission is dearer by its losses, unless it is gravity that is carried.
        viscous += (1.0 / parameters["load.efficiency"][axis] - 1.0) * (viscous - parameters["motor.viscous"][axis])
    K = plant.torque_constant
    return {
        "resistance": parameters["motor.R_s"][axis],
        "inductance": parameters["motor.L_q"][axis],
        "inertia": plant.inertia * drives.motor.torque_constant / K,
        "coulomb": dry / K,
        "viscous": viscous / K,
        "resonance": plant.resonance,
        "anti_resonance": plant.anti_resonance,
    }


def proving(target, held=(0.0, 0.0)):
    """Return where gains are tried on a machine that is known, and the rule's gains."""
    plant = true_plant(target.drives)
    rule = rule_gains(target.device, target.motor, plant.inertia, supply=plant.supply)
    write_gains(target.drives, rule)
    return ProvingGround(target, [plant], (target.low, target.high), calm_gains(target, plant)[None], rule, held), rule


def machine_of(load, axes=1, **options):
    """Return the linear machine, an axis's inertia [kg*m^2], and the emulated one's plant, None of several axes."""
    with EmulatedDrives(load=load, num_threads=1, **options) as drives:
        machines = true_machines(drives)
        if axes == 1:
            plant = true_plant(drives)
            return machines, plant.inertia, plant
        found = linear_load(drives.inside.groups[0].load)
        # An axis moves as if the others' motors were loose: 1 / (rotors M^-1 rotors).
        return machines, float(1.0 / (found.rotors @ np.linalg.solve(found.M[0], found.rotors.T))[0, 0]), None


def open_machines(machines, num_threads=None):
    """Yield machines ready to be tuned, those of one load and motor as one target, and their indices."""
    for indices in groups(machines):
        with open_group([machines[k] for k in indices], num_threads) as target:
            yield target, indices


GAIN_OBJECTS = find_device("tmcm1636").gains.keys


def gains(drives):
    return np.stack([drives.read(name) for name in GAIN_OBJECTS], axis=1)


def standing_in(target, where=None):
    """Return the identification of drives whose truth is known: what the search needs, at no cost."""
    from tuning.estimate import Estimate
    from tuning.identify.identified_axis import Identification

    found = []
    for axis in range(target.num_axes):
        plant = true_plant(target.drives, axis)
        values = {
            "resistance": plant.R, "inductance": plant.L, "inertia": plant.inertia, "coulomb": 0.1, "viscous": 1e-4,
            "offset": 0.0, "velocity_filter": plant.velocity_filter, "pole_pairs": 4.0, "encoder_direction": 1.0,
            "loop_delay": plant.delay,
        }  # fmt: skip
        estimates = {name: Estimate(value, 0.97 * value, 1.03 * value, "") for name, value in values.items()}
        blank = {name: refused("Hz", "rigid") for name in ("anti_resonance", "resonance")}
        found.append(Identification(estimates | blank, 0.0))
    return found
