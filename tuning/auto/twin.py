"""Digital twins: emulated machines with the identified parameters, on which trials of gains take no drive time.

A twin is the generic machine that can be identified: a rotor with a disc, rigid or on one spring, with dry and viscous
friction, the identified winding and velocity filter, and the encoder and power stage of the data sheets. It scores
gains by the robust cost (drive_env/trials/score.py), many at once as machines; the robust cost cannot be measured on a
real axis.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drive_env.devices.gains import si_scales
from drive_env.loops.dynamics import DEFAULT, INERTIA_RANGE, Dynamics, find_dynamics
from drive_env.trials.oscillation import OSCILLATION
from drive_env.trials.positioning import Move, highest_ramp, plan_move
from drive_env.trials.score import TRIPPED, RobustScore
from mechanics.arrays import Floats, Integers
from tuning.auto.loop_model import corner

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.loops.linear_model import Plant
    from drive_env.motors import Motor
    from tuning.identify.identified_axis import Identification

# Bound of a search. Without an integral part a constant load leaves a permanent error, which the robust cost with its
# quarter of a second does not detect.
LONGEST_INTEGRATION = 0.65536  # s, of the velocity loop
FASTEST_RESONANCE = 500.0  # Hz; a faster one is modelled as rigid, since the physics' step does not resolve it
MOST_RESONANCE = 1.1 * FASTEST_RESONANCE  # Hz, in a variant
LEAST_LOAD = 0.05  # of the total inertia: least load, if the rotor's data sheet value is as large as the total
LEAST_RATIO = 1.03  # of resonance over anti-resonance: with a smaller ratio they cancel each other
BREAKAWAY = 1.5  # static over sliding friction, of bearings
SLOWEST_FILTER = 50.0  # Hz
UNKNOWN_FILTER = 0.5  # relative: assumed uncertainty of a velocity filter that was not identified
REST = 0.15  # s that twins rest in addition, to show gains that swing at rest


class Known(NamedTuple):
    """The data of a twin: the axis, and the signed angle that its rotor may turn [rad].

    coulomb, viscous: Identified friction at the rotor, dry [A] and viscous [A*s/rad].
    offset: Current that gravity or another constant load takes [A].
    spread: Relative half widths of the 95 % intervals of quantities that variants of the machine vary.
    """

    plant: Plant
    reach: float
    coulomb: float = 0.0
    viscous: float = 0.0
    offset: float = 0.0
    spread: Mapping[str, float] = MappingProxyType({})


def known_of(plant: Plant, identified: Identification, reach: float) -> Known:
    """Return the data of a twin from an identification; friction that was not identified counts as 0.

    Args:
        plant: The axis model.
        identified: The identification.
        reach: Signed angle that the rotor may turn [rad].
    """
    known = {name: one for name, one in identified.estimates.items() if one.is_known}
    dry, viscous, offset = (known[name].value if name in known else 0.0 for name in ("coulomb", "viscous", "offset"))
    widths = {"velocity_filter": UNKNOWN_FILTER}
    for name in set(UNCERTAIN) & set(known):
        widths[name] = 0.5 * (known[name].high - known[name].low) / known[name].value
    return Known(plant, reach, max(dry, 0.0), max(viscous, 0.0), offset, widths)


class MachineVariant(NamedTuple):
    """A variant of the machine within the uncertainty of identification; gains must be good on all variants.

    inertia, anti_resonance, resonance, velocity_filter: Relative deviation from the identified value; the half width of
        its interval is used if that is larger.
    """

    name: str
    inertia: float = 0.0
    anti_resonance: float = 0.0
    resonance: float = 0.0
    velocity_filter: float = 0.0
    damping: float = 1.0  # over the identified or assumed one
    friction: float = 1.0  # dry, over the identified one
    adc_noise: float | None = None  # A
    cogging: float = 1.0  # over the data sheet's
    supply_resistance: float | None = None  # ohm


UNCERTAIN = ("inertia", "anti_resonance", "resonance", "velocity_filter")
WORLDS = (
    MachineVariant("as identified"),
    # Dry friction can stop an oscillating axis; two short moves overestimate it, since drag and sticking look like it.
    MachineVariant(
        "rough", 0.05, -0.04, -0.03, -0.1, 0.7, friction=0.4, adc_noise=0.05, cogging=1.7, supply_resistance=0.15
    ),
    MachineVariant("smooth", -0.05, 0.03, 0.04, 0.1, damping=1.5, adc_noise=0.01, cogging=0.5),
)
MOST_SWING = 0.8 * OSCILLATION  # greatest swing of the current in a move, over the rated one
FARTHEST = 0.6  # relative: a wider interval carries no information


def is_elastic(plant: Plant) -> bool:
    """Return whether the twin of this axis has a spring."""
    return plant.anti_resonance < plant.resonance < FASTEST_RESONANCE


def twin_parameters(
    device: Device, motor: Motor, known: Known, world: MachineVariant = WORLDS[0], lightest: float = INERTIA_RANGE[0]
) -> dict[str, float]:
    """Return the parameters of the emulated machine (one inertia or two masses) that matches the identification.

    The torque constant is the data sheet's: inertia and friction are identified relative to it, so its error cancels.

    Args:
        device: The drive.
        motor: Its motor.
        known: The axis.
        world: Variant of the machine.
        lightest: Least load inertia in the variants of the robust cost, over its own.
    """
    plant = known.plant
    off = {name: _factor(getattr(world, name), known.spread.get(name, 0.0)) for name in UNCERTAIN}
    total, anti_resonance = plant.inertia * off["inertia"], plant.anti_resonance * off["anti_resonance"]
    resonance = max(plant.resonance * off["resonance"], LEAST_RATIO * anti_resonance)
    filtered = corner(device, plant) * off["velocity_filter"]
    noise, resistance = (
        device.stage[name].default if value is None else value
        for name, value in (("adc_noise", world.adc_noise), ("supply_resistance", world.supply_resistance))
    )
    values = {
        "motor.R_s": plant.R,  # measured: winding and stage together
        "stage.on_resistance": 0.0,
        "motor.L_d": plant.L,
        "motor.L_q": plant.L,
        "stage.velocity_filter": float(np.clip(filtered, SLOWEST_FILTER, 0.4 * device.velocity_rate)),
        "motor.cogging_torque": motor.cogging_torque * world.cogging,
        "stage.adc_noise": noise,
        "stage.supply_resistance": resistance,
    }
    if is_elastic(plant):
        rotor = total * (anti_resonance / resonance) ** 2
        load = total - rotor
        # Variants of the robust cost have less load on the same spring: the physics' step must resolve these, too.
        most = (2.0 * math.pi * MOST_RESONANCE) ** 2 / (1.0 / rotor + 1.0 / (lightest * load))
        stiffness = min(load * (2.0 * math.pi * anti_resonance) ** 2, most)
        values["load.stiffness"] = stiffness
        values["load.damping"] = 2.0 * plant.damping * world.damping * stiffness / (2.0 * math.pi * resonance)
    else:
        load = max(total - motor.inertia, LEAST_LOAD * total)
        rotor = total - load
    values |= {"motor.inertia": rotor, "load.inertia": load}
    dry = known.coulomb * motor.torque_constant * world.friction
    viscous = known.viscous * motor.torque_constant
    # Friction up to the data sheet's belongs to the motor's bearings, the rest to the load.
    values["motor.coulomb"] = min(dry, motor.coulomb)
    values["load.coulomb"] = dry - values["motor.coulomb"]
    values["load.breakaway"] = BREAKAWAY * values["load.coulomb"]
    values["motor.viscous"] = min(viscous, motor.viscous)
    values["load.viscous"] = viscous - values["motor.viscous"]
    return values


def _factor(way: float, spread: float) -> float:
    """Return the factor of a variant on a value with a known relative half width."""
    return 1.0 + math.copysign(max(abs(way), min(spread, FARTHEST)), way) if way else 1.0


class Twins:
    """Judges gains on twins: `sets` sets of gains for every axis at once.

    Args:
        device: The drive.
        motor: The motor with its data sheet values.
        known: Data of each of the n axes.
        scaler: 2058h of each axis, shape (n,).
        sets: Sets of gains per axis that are judged at once.
        num_threads: Number of threads; the number of cores by default.
        worlds: Variants on which the gains are judged.
        repeats: Runs of each variant, each with its own noise, whose scores are averaged.
        dynamics: Requirements on the loops.
    """

    def __init__(
        self,
        device: Device,
        motor: Motor,
        known: Sequence[Known],
        scaler: Floats,
        sets: int,
        num_threads: int | None = None,
        worlds: Sequence[MachineVariant] = WORLDS,
        repeats: int = 1,
        dynamics: str | Dynamics = DEFAULT,
    ) -> None:
        self.device, self.sets, self.dynamics = device, sets, find_dynamics(dynamics)
        self.num_axes, self._worlds = len(known), len(worlds)
        self._parts: list[tuple[Integers, RobustScore]] = []  # for each load: its axes, and their score
        elastic = np.array([is_elastic(one.plant) for one in known])
        lightest = self.dynamics.inertia_range[0]
        for load, mask in (("inertia", ~elastic), ("two_mass", elastic)):
            if not mask.any():
                continue
            axes = np.flatnonzero(mask)
            robust = RobustScore(
                device.name, load, motor, len(axes) * sets * len(worlds), num_threads=num_threads, repeats=repeats,
                dynamics=dynamics, rest=REST,
            )  # fmt: skip
            self._parts.append((axes, robust))
            chosen = [known[int(k)] for k in axes]
            rows = [[twin_parameters(device, motor, one, world, lightest) for world in worlds] for one in chosen]
            columns = {name: np.array([[row[name] for row in axis] for axis in rows]) for name in rows[0][0]}
            robust.set_machines(
                {name: np.repeat(values, sets, axis=0).reshape(-1) for name, values in columns.items()},
                self._each([one.plant.supply for one in chosen]),
            )
            # The motor pushes against the pull of the load.
            robust.set_constant_load(self._each([-one.offset * motor.torque_constant for one in chosen]))
            inertia, reach = [one.plant.inertia for one in chosen], [one.reach for one in chosen]
            move = plan_move(motor, inertia, scaler[mask], reach, highest_ramp(device))
            distance, velocity, acceleration, increments = map(self._each, move[:4])
            robust.set_moves(Move(distance, velocity, acceleration, increments, move.counts))

    def _each(self, values: ArrayLike) -> NDArray[Any]:
        """Repeat values of axes, (axes,), for all machines: each axis has its sets of gains, each set its variants."""
        return np.repeat(np.asarray(values), self.sets * self._worlds)

    def judge(self, gains: Integers) -> tuple[Floats, Floats]:
        """Return the robust performance of gains over the variants, and their slack to the constraints.

        The performance is the mean over all variants, the margins are those of the first; gains that a trial would stop
        because of oscillation have a negative slack.

        Args:
            gains: Raw, (n, any sets, count).

        Returns:
            Of shape (n, any sets) each.
        """
        found = np.empty((2, *gains.shape[:2]))
        for first in range(0, gains.shape[1], self.sets):
            rows = gains[:, first : first + self.sets]
            count = rows.shape[1]
            whole = np.concatenate([rows, np.repeat(rows[:, -1:], self.sets - count, axis=1)], axis=1)
            for axes, robust in self._parts:
                found[:, axes, first : first + count] = self._judged(robust, whole[axes])[:, :, :count]
        return found[0], found[1]

    def _judged(self, robust: RobustScore, gains: Integers) -> Floats:
        shape = (*gains.shape[:2], self._worlds)
        scores = robust.score(np.repeat(gains.reshape(-1, gains.shape[-1]), self._worlds, axis=0))
        worth = np.exp(np.log(scores.performance).reshape(shape).mean(axis=2))
        # A real drive would be stopped at this swing: a trial watches the move and the probe.
        swing = scores.swing.max(axis=1).reshape(shape).max(axis=2)
        calm = 1.0 - np.minimum(swing / MOST_SWING, 1.0 - TRIPPED)
        return np.array([worth, np.minimum(scores.slack.reshape(shape)[:, :, 0], calm)])

    def close(self) -> None:
        """Close the emulated machines."""
        for _, robust in self._parts:
            robust.close()


def gain_bounds(device: Device) -> tuple[Integers, Integers]:
    """Return the least and the greatest integers that a search may try, shape (count,) each."""
    least, most = np.minimum(device.gains.lowest, 1), device.gains.highest
    integral = device.gains.column("velocity", "I")
    if integral is not None:
        scale = si_scales(device, 1.0)["velocity", "I"]  # independent of the supply
        longest = max(round(float(scale.raw(1.0 / LONGEST_INTEGRATION))), 1)
        (most if device.gains.rows[integral].is_time else least)[integral] = longest
    return least, most
