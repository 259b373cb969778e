"""Linear models of identified machines and their variants: margins of their outer loops with any gains.

A single axis is a rotor with a disc, rigid or on one spring. The two ends of one part, as of a gantry, are two rotors
on one mass that can turn out of square on a spring: the response of each, with the other one off, shows how much of the
mass moves with it (at its anti-resonance that end stands still, at its resonance neither); both together give all
parameters.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from drive_env.loops.dynamics import INERTIA_RANGE, loop_clearance
from drive_env.loops.margins import margins
from drive_env.loops.sampled import CascadeGains, LinearMachines, LoopRates, Windings, linear_machines, open_loops
from drive_env.loops.worst_margins import HIGHEST, LOWEST, POINTS
from drive_env.trials.score import servo_variants
from mechanics.arrays import Floats, Integers, Mask

if TYPE_CHECKING:
    from collections.abc import Sequence

    from drive_env.devices import Device
    from drive_env.loops.dynamics import Dynamics
    from drive_env.loops.linear_model import Plant
    from drive_env.loops.margins import Margins
    from drive_env.loops.sampled import OuterLoops
    from drive_env.motors import Motor
    from tuning.auto.stages import IdentifiedAxes, RecordedGains
    from tuning.identify.identified_axis import Identification
    from tuning.response.measured_loop import MeasuredLoop
    from tuning.target import Target

# Elements of the mass matrix over the axes' own inertia: greatest coupling that may be a measurement error; and least
# own inertia of a motion for a coupling to be believed.
FELT, LEAST_OWN = 0.15, 0.1
AT_ONCE = 512  # number of machines that are computed at once
TWIST = np.array([[1.0, -1.0], [-1.0, 1.0]])  # of two inertias on one spring


class Mechanism(NamedTuple):
    """Moved masses: M q'' + D q' + K q = torque, (joints, joints) each; motion of each rotor, (axes, joints)."""

    M: Floats
    D: Floats
    K: Floats
    rotors: Floats

    def varied(self, rotor: float, inertia: float, stiffness: float) -> Mechanism:
        """Scale inertia and stiffness of everything except the rotors, each of which has inertia `rotor` [kg*m^2]."""
        own = self.rotors.T @ (np.minimum(rotor, np.diag(self.rotors @ self.M @ self.rotors.T))[:, None] * self.rotors)
        return self._replace(M=own + inertia * (self.M - own), K=stiffness * self.K)


def one_axis(plant: Plant) -> Mechanism:
    """Return the mechanism of a single axis."""
    if not plant.is_elastic:
        return Mechanism(np.array([[plant.inertia]]), np.array([[plant.viscous]]), np.zeros((1, 1)), np.eye(1))
    rotor = plant.rotor_inertia
    stiffness = (plant.inertia - rotor) * (2.0 * math.pi * plant.anti_resonance) ** 2
    damping = 2.0 * plant.damping * stiffness / (2.0 * math.pi * plant.resonance)
    return Mechanism(
        np.diag([rotor, plant.inertia - rotor]), damping * TWIST + np.diag([plant.viscous, 0.0]), stiffness * TWIST,
        np.eye(2)[:1],
    )  # fmt: skip


def two_ends(first: Plant, second: Plant) -> Mechanism | None:
    """Return the mechanism of two axes that drive one part, from the plant of each while the other one is off.

    Args:
        first: One axis; its inertia is that of everything, its anti-resonance that of the part on the other rotor.
        second: The other axis, likewise.

    Returns:
        The mechanism; None if neither resonance is known, or no mass has these frequencies.
    """
    elastic = [plant for plant in (first, second) if plant.is_elastic]
    if not elastic:
        return None
    total = math.sqrt(first.inertia * second.inertia)
    w = float(np.mean([plant.resonance for plant in elastic])) * 2.0 * math.pi
    held = [(plant if plant.is_elastic else elastic[0]).anti_resonance * 2.0 * math.pi for plant in (first, second)]
    u, v, free = 1.0 / held[0] ** 2, 1.0 / held[1] ** 2, 1.0 / w**2
    half = u + v - 2.0 * free
    if half <= abs(u - v):
        return None
    k = total / (half + math.sqrt(half**2 - (u - v) ** 2))
    own = np.diag([k * v, k * u])
    M = own + 0.5 * (total - own.sum()) * np.array([[0.0, 1.0], [1.0, 0.0]])
    damping = 2.0 * float(np.mean([plant.damping for plant in elastic])) * k / w
    viscous = 0.25 * (first.viscous + second.viscous) * np.eye(2)
    # Each inertia was identified with the torque constant of its own axis, which may differ from the other's.
    scale = np.sqrt([first.inertia / total, second.inertia / total])
    scale = np.outer(scale, scale)
    return Mechanism(M * scale, damping * TWIST + viscous, k * TWIST, np.eye(2))


class LoopModel:
    """The outer loops of one machine with any gains.

    Args:
        device: The drive.
        motor: The motor; its rotor's inertia stays the same in all variants of the load.
        plants: Its axes, with their windings, filters and delays.
        moved: The mechanism that they move.
        inertia_range: Range of the load's inertia over the present one.
        measured: Whether the axis' response was measured: that covers other values of velocity P, so no model is needed
            for them.
    """

    def __init__(
        self,
        device: Device,
        motor: Motor,
        plants: Sequence[Plant],
        moved: Mechanism,
        inertia_range: tuple[float, float] = INERTIA_RANGE,
        *,
        measured: bool = False,
    ) -> None:
        self.device, self.axes = device, len(plants)
        self._variants = [one for one in servo_variants(inertia_range) if not measured or one.velocity_p == 1.0]
        self._velocity_p = np.array([variant.velocity_p for variant in self._variants])
        parts = [moved.varied(motor.inertia, variant.inertia, variant.stiffness) for variant in self._variants]

        def each(values: Sequence[float]) -> Floats:
            return np.tile(values, (len(parts), 1))

        torque = [plant.torque_constant for plant in plants]
        emf = [t / 1.5 if math.isnan(p.emf_constant) else p.emf_constant for t, p in zip(torque, plants, strict=True)]
        windings = Windings(
            each([plant.R for plant in plants]), each([plant.L for plant in plants]), each(emf), each(torque),
            each([plant.supply for plant in plants]), each([corner(device, plant) for plant in plants]),
        )  # fmt: skip
        M, D, K = (np.array([getattr(part, name) for part in parts]) for name in ("M", "D", "K"))
        self._machines = linear_machines(windings, M, D, K, moved.rotors)

    def slack(self, dynamics: Dynamics, gains: Integers, *, nominal: bool = False) -> Floats:
        """Return the relative slack of the loops to the dynamics, (sets,): 0 if a constraint is only just kept.

        Args:
            dynamics: Requirements on the loops.
            gains: Raw, (sets, axes, count).
            nominal: Judge the present machine without its variants.
        """
        count = 1 if nominal else len(self._velocity_p)
        size = max(AT_ONCE // count, 1)
        parts = [self._clearance(dynamics, gains[k : k + size], count) for k in range(0, len(gains), size)]
        clearance, overshoot = (np.concatenate(part) for part in zip(*parts, strict=True))
        return dynamics.slack(clearance[:, 0], clearance[:, 1:], overshoot)

    def kept(self, dynamics: Dynamics, gains: Integers) -> dict[str, float]:
        """Return the kept share of the dynamics for each variant of the machine, by the name of the variant.

        Args:
            dynamics: The dynamics that count as 1.
            gains: Raw, (axes, count).
        """
        clearance, _ = self._clearance(dynamics, gains[None], len(self._variants))
        rows = zip(self._variants[1:], clearance[0, 1:].tolist(), strict=True)
        return {variant.name: max(kept, 0.0) for variant, kept in rows}

    def _clearance(self, dynamics: Dynamics, gains: Integers, count: int) -> tuple[Floats, Floats]:
        """Return the clearance of the first variants, (sets, count), and the overshoot of a csp step, (sets,)."""
        sets = len(gains)
        machines = LinearMachines(*(np.tile(part[:count], (sets, 1, 1)[: part.ndim]) for part in self._machines))
        raw = np.repeat(gains, count, axis=0).reshape(-1, gains.shape[-1])
        raw = self.device.gains.with_velocity_p(raw, np.tile(np.repeat(self._velocity_p[:count], self.axes), sets))
        cascade = CascadeGains.of(self.device, raw.reshape(sets * count, self.axes, -1))
        clearance, overshoot = loop_clearance(dynamics, LoopRates.of(self.device), machines, cascade, count)
        return clearance.reshape(sets, count), overshoot

    def margins(self, gains: Integers) -> list[dict[str, Margins]]:
        """Return the margins of the outer loops of each axis of the present machine, for raw gains, (axes, count)."""
        f = np.geomspace(LOWEST, HIGHEST * self.device.velocity_rate, POINTS)
        loops = self.open_loops(gains, f)
        return [
            {name: margins(f, loop[axis]) for name, loop in zip(loops._fields, loops, strict=True)}
            for axis in range(self.axes)
        ]

    def open_loops(self, gains: Integers, f: Floats) -> OuterLoops:
        """Return the open loops of the present machine, each with the others closed, (axes, n).

        Args:
            gains: Raw, (axes, count).
            f: Frequencies [Hz], (n,).
        """
        machine = LinearMachines(*(part[:1] for part in self._machines))
        loops = open_loops(LoopRates.of(self.device), machine, CascadeGains.of(self.device, gains[None]), f[None])
        return type(loops)(*(loop[0] for loop in loops))


def corner(device: Device, plant: Plant) -> float:
    """Return the corner of a velocity filter [Hz] with the same lag as filter and delay of an axis together.

    An emulated drive has only its own delay; at low frequencies both lags are nearly equivalent.
    """
    from drive_env.devices.gains import VELOCITY_FILTER_DAMPING

    lag = VELOCITY_FILTER_DAMPING / math.pi
    more = plant.delay - 1.0 / device.velocity_rate
    return lag / max(lag / plant.velocity_filter + more, 1e-6)


def model_of(device: Device, motor: Motor, plant: Plant, dynamics: Dynamics, *, measured: bool = False) -> LoopModel:
    """Return the model of a single axis with the load range of the dynamics; `measured` as in `LoopModel`."""
    return LoopModel(device, motor, [plant], one_axis(plant), dynamics.inertia_range, measured=measured)


def measured_response(target: Target, recorded: RecordedGains | None, k: int) -> MeasuredLoop | None:
    """Return the measured response of an axis; None if it was not measured, or the axis is linked."""
    if target.linked or recorded is None or recorded.response is None or recorded.unseen[k]:
        return None
    return recorded.response if np.isfinite(recorded.response.open_loop[:, k]).any() else None


class LinkedAxis:
    """One of two linked axes with any gains, the other one with its present ones; an interface like `MeasuredAxis`.

    Args:
        model: Model of their machine, from the measured responses of both.
        axis: Index of the axis, 0 or 1.
        gains: Present raw gains of both, (2, count).
    """

    def __init__(self, model: LoopModel, axis: int, gains: Integers) -> None:
        self._model, self._axis, self._gains = model, axis, gains

    def _whole(self, gains: Integers) -> Integers:
        whole = np.repeat(self._gains[None], len(gains), axis=0)
        whole[:, self._axis] = gains
        return whole

    def margins(self, gains: Integers) -> dict[str, Margins]:
        """Return the margins of the outer loops with gains of this axis, (count,)."""
        return self._model.margins(self._whole(gains[None])[0])[self._axis]

    def slack(self, dynamics: Dynamics, gains: Integers) -> Floats:
        """Return the slack of the machine to the dynamics with raw gains of this axis, (sets, count): (sets,)."""
        return self._model.slack(dynamics, self._whole(gains))


def fitted_plant(
    target: Target, identified: IdentifiedAxes, recorded: RecordedGains | None, k: int
) -> tuple[Plant, Identification]:
    """Return plant and identification of an axis, with the last good fit of its response.

    The plant of an axis that is coupled to others by acceleration is the rigid inertia that it moves while the others
        give way: its response contains their loops, which look like a resonance.
    """
    plant, found = identified.known(k)
    response = measured_response(target, recorded, k)
    fit = None if response is None else response.fits[k]
    if fit is not None and fit.is_good:
        plant = replace(fit.plant, R=plant.R, L=plant.L, supply=plant.supply)
        known = {name: one for name, one in fit.estimates.items() if one.is_known and name in found.estimates}
        found = replace(found, estimates={**found.estimates, **known})
    group = next(axes for axes in one_plant(target, identified) if k in axes)
    if len(group) > 1 and not target.linked:
        free = 1.0 / np.diag(np.linalg.inv(mass_matrix(target, identified, group)))[group.tolist().index(k)]
        plant = replace(plant, inertia=float(free), anti_resonance=math.inf, resonance=math.inf)
    return plant, found


def loop_models(
    target: Target, identified: IdentifiedAxes, recorded: RecordedGains | None, where: Mask, dynamics: Dynamics
) -> list[tuple[LoopModel, Integers]]:
    """Return models with their axes: one for each group of coupled axes, and one for each other axis."""
    models = []
    for group in one_plant(target, identified):
        axes = group[where[group]]
        plants = [fitted_plant(target, identified, recorded, int(k))[0] for k in axes]
        moved: Mechanism | None = None
        if target.linked:
            plants = [replace(plant, anti_resonance=math.inf, resonance=math.inf) for plant in plants]
            if len(axes) == target.axes_per_machine == 2:
                moved = two_ends(*(alone(identified, recorded, int(k)) for k in axes))
        elif len(axes) > 1:
            M = mass_matrix(target, identified, axes)
            moved = Mechanism(M, np.diag([plant.viscous for plant in plants]), np.zeros_like(M), np.eye(len(axes)))
        if moved is not None:
            models.append((LoopModel(target.device, target.motor, plants, moved, dynamics.inertia_range), axes))
            continue
        for k, plant in zip(axes, plants, strict=True):
            measured = measured_response(target, recorded, int(k)) is not None
            models.append((model_of(target.device, target.motor, plant, dynamics, measured=measured), np.array([k])))
    return models


def one_plant(target: Target, identified: IdentifiedAxes) -> list[Integers]:
    """Return groups of identified axes: axes that drive one part or are coupled by acceleration form one group."""
    lanes, groups = target.axes_per_machine, []
    for machine in np.arange(target.num_axes).reshape(-1, lanes):
        axes = np.array([k for k in machine if identified.plants[k] is not None], np.int64)
        felt = np.full((len(axes), len(axes)), target.linked)
        if not target.linked and len(axes):
            M = mass_matrix(target, identified, axes)
            shares = M / np.sqrt(np.outer(np.diag(M), np.diag(M)))
            if np.linalg.eigvalsh(shares)[0] > LEAST_OWN:
                felt = np.abs(shares) > FELT
        # Two axes that are both coupled to a third one belong to one group.
        felt = np.linalg.matrix_power(felt | np.eye(len(axes), dtype=bool), lanes)
        while len(axes):
            groups.append(axes[felt[0]])
            axes, felt = axes[~felt[0]], felt[np.ix_(~felt[0], ~felt[0])]
    return groups


def mass_matrix(target: Target, identified: IdentifiedAxes, axes: Integers) -> Floats:
    """Return the mass matrix of axes of a machine at their rotors [kg*m^2]; diagonal if it was not measured."""
    lanes = target.axes_per_machine
    rows = []
    for axis in map(int, axes):
        plant, found = identified.known(axis)
        rows.append(found.pushed or plant.inertia * np.eye(lanes)[axis % lanes])
    return np.array(rows)[:, axes % lanes]


def alone(identified: IdentifiedAxes, recorded: RecordedGains | None, k: int) -> Plant:
    """Return the plant of one of two linked axes while the other one is off: it moves the whole part."""
    plant, found = identified.known(k)
    fits = [found.fit]
    if recorded is not None and recorded.response is not None and not recorded.unseen[k]:
        fits.append(recorded.response.fits[k])
    good = [fit for fit in fits if fit is not None and fit.is_good]
    return good[-1].plant if good else replace(plant, inertia=2.0 * plant.inertia)
