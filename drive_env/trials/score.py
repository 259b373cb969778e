"""The cost of a tuning: margins that loops must keep, and the cost J of a positioning move and a load step.

Lower is better. The performance J scores every machine on its own scales:

    J = (t_s/t_0)^0.4 (E_d/E_0)^0.4 (1 + (n/3 %)^2)^0.2 (1 + max(0, os - 2 %)/10 %)

    beyond 15 bent towards 30 (30 - 225/J, with a continuous slope); a fault scores 30

    t_s = t_0 + integral of min(1, |e|/w) dt from the profile's end to the load step; w = max(1 % of the move, 3 counts)
    t_0 = four times t, the sum of the small time constants, or 4.5 times the lag of the masses on springs if that is
        larger: with most of the inertia on one spring, w_v = 0.45/t is a tenth of the anti-resonance
    E_d = integral of |e| dt after a load step of 0.3 rated torque
    E_0 = 132 T t^3 / J, that of a rigid axis with w_v = 0.45/t, T_i = 4/w_v, k_v = w_v/3: T_i T/(J w_v k_v), with the
        load step's torque T and the inertia J at the rotor; for a machine with several axes the largest of all, since
        it would be 0 for an axis that the load does not reach
    n   = RMS increment of the demanded current from millisecond to millisecond, at rest before the load step, over the
        rated current; on a bus, and for a drive without an object for the current's error, that of the actual current
    os  = largest way beyond the target over the move

An open-loop stepper has its own J (`open_loop.py`). E_0 of steppers is E_d with the gains of the baseline rule.

The *robust performance* is half of J plus half of the largest J of the nominal machine and its variants. It counts for
gains that keep the constraints: the margins of the dynamics (drive_env/loops/dynamics.py) in every outer loop of the
true linear machine, weaker ones on its variants, the overshoot of a csp step, no swing at rest. The *robust cost* ranks
all gains that keep the constraints before all others, without a jump between them:

    s = least slack of the constraints, relative: 0 if one is only just kept
    s > 0: performance^g 30^(1-g), g = 1 - exp(-s / 1 %);  else 30 (2 - exp(s))

A stepper's loops have no linear model here: its robust cost is its robust performance. Both are for scoring and
training, not for observation: a load step and variants of the machine are impossible on hardware.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drive_env import cia402
from drive_env.devices.gains import has_linear_model, small_time_constants
from drive_env.dictionary.roles import Role
from drive_env.drives.currents import ampere_per_count
from drive_env.drives.interface import CYCLE
from drive_env.drives.raw_gains import write_gains
from drive_env.emulator.parameters import WIRING
from drive_env.loops.dynamics import DEFAULT, INERTIA_RANGE, Dynamics, find_dynamics, loop_clearance
from drive_env.loops.sampled import CascadeGains, LinearMachines, LoopRates
from drive_env.loops.true_plant import elastic_lags, true_machines
from drive_env.phase_current import swing_period
from drive_env.saved_state import Saved
from drive_env.trials.positioning import (
    SETTLED,
    TRIAL,
    Move,
    move_terms,
    plan_move,
    power_up,
    resting_swing,
    start,
    swing,
    wrapped,
    write_profile,
)
from mechanics.arrays import Floats, Integers, Mask

if TYPE_CHECKING:
    from drive_env.dictionary.entries import ObjectName
    from drive_env.emulator.emulated_drives import EmulatedDrives
    from drive_env.motors import Motor
    from mechanics.load import Load


TRIP = 30.0
BENT = TRIP / 2.0  # value from which J is bent
NOISE, OVERSHOOT_FREE, OVERSHOOT_SCALE = 0.03, 0.02, 0.1
LOAD_SHARE = 0.3  # of the rated torque
# Over the lag of masses on springs. For 17 shafts with little damping the best velocity loop had 0.04 to 0.5 of the
# lag's angular frequency, 0.1 in the median: the resonance's peak limits it.
ELASTIC = 0.45 / 0.1
E_0_SHARE = 4.0 * 3.0 / 0.45**3  # of T t^3 / J
_NOISE = 7919.0  # between the noise seeds of repeated runs
# Parts of the demanded current; objects that a drive lacks are left out.
_DEMANDED: tuple[ObjectName, ...] = (cia402.TORQUE_ACTUAL, Role.TORQUE_ERROR)

_INERTIA = ("body_inertia", "body_mass", "density")  # fields of load parameters that are the load's inertia
_STIFFNESS = ("jnt_stiffness", "contact_stiffness")


class Variant(NamedTuple):
    """A variant of the machine: factors of its inertia and stiffness, of velocity P, or of a stepper's run current."""

    name: str
    inertia: float = 1.0
    stiffness: float = 1.0
    velocity_p: float = 1.0
    run_current: float = 1.0


def servo_variants(inertia_range: tuple[float, float] = INERTIA_RANGE) -> tuple[Variant, ...]:
    """Return the variants of a servo's machine; the load inertia varies between these factors."""
    low, high = inertia_range
    return (
        Variant("nominal"),
        *(Variant(f"load inertia x {x:g}", inertia=x) for x in (high, low) if x != 1.0),
        Variant("stiffness x 0.8", stiffness=0.8),
        Variant("velocity P x 1.5", velocity_p=1.5),
        Variant("velocity P x 0.67", velocity_p=0.67),
    )


VARIANTS = servo_variants()
# A stepper's ramps are close to its torque limit: with twice the inertia it would lose steps.
STEPPER_VARIANTS = (
    Variant("nominal"),
    Variant("load inertia x 1.3", inertia=1.3),
    Variant("load inertia x 0.7", inertia=0.7),
    Variant("stiffness x 0.8", stiffness=0.8),
    Variant("velocity P x 1.5", velocity_p=1.5),
    Variant("run current x 0.8", run_current=0.8),
)
RESTING = 0.05  # greatest RMS of the current about its trend at rest, over the rated one
TRIPPED = -5.0  # slack of a machine that trips; lower slacks are set to it
BORDER = 0.01  # slack beyond which only performance counts


class Terms(NamedTuple):
    """The terms of J, all of the same shape: t_s/t_0, E_d/E_0, n and os as fractions, and whether there was a fault."""

    settling: Floats
    disturbance: Floats
    noise: Floats
    overshoot: Floats
    tripped: Mask

    def each(self, function: Callable[[NDArray[Any]], NDArray[Any]]) -> Terms:
        """Return the terms with a function applied to each."""
        return Terms(*map(function, self))


def cost(terms: Terms) -> Floats:
    """Return J from its terms, in their shape."""
    raw = (
        terms.settling**0.4
        * terms.disturbance**0.4
        * (1.0 + (terms.noise / NOISE) ** 2) ** 0.2
        * (1.0 + np.maximum(0.0, terms.overshoot - OVERSHOOT_FREE) / OVERSHOOT_SCALE)
    )
    return below_trip(raw, terms.tripped)


def below_trip(raw: Floats, tripped: Mask) -> Floats:
    """Return J: always below the score of a trip, so that an early trip never pays, but still increasing."""
    with np.errstate(divide="ignore"):
        bent = np.where(raw <= BENT, raw, TRIP - BENT**2 / raw)
    # Not finite: the axis left the range of physics.
    return np.where(tripped | ~np.isfinite(raw), TRIP, bent)


def robust_performance(j: Floats) -> Floats:
    """Return the robust performance from the variants' J; the nominal machine's is the first in the last dimension."""
    return np.asarray(0.5 * j[..., 0] + 0.5 * j.max(axis=-1))


def robust_cost(performance: Floats, slack: Floats) -> Floats:
    """Return the robust cost from performance and slack, in their shape; an infinite slack means no constraints."""
    inside = 1.0 - np.exp(-np.maximum(slack, 0.0) / BORDER)
    kept = np.minimum(performance, TRIP) ** inside * TRIP ** (1.0 - inside)
    return np.where(slack > 0.0, kept, TRIP * (2.0 - np.exp(np.minimum(slack, 0.0))))


# --- the robust cost of emulated machines -----------------------------------------------------------------------------
class Scores(NamedTuple):
    """The robust cost of every machine, (num_machines,), and J and its terms, (num_machines, variants).

    The worst axis of a machine counts; several runs are averaged.
    performance, slack: The parts of the robust cost, (num_machines,).
    clearance: Of the outer loops, (num_machines, variants); nan without a linear model.
    overshoot: Of a csp step, (num_machines,); nan without a linear model.
    swing: As a trial measures it: the largest RMS increment of the current over 25 ms until the load step, over the
        rated one, and the largest of several runs, (num_machines, variants); it is not part of J.
    rest: RMS of the current about its trend before the load step, over the rated one, and the RMS over several runs,
        (num_machines, variants); it is not part of J.
    """

    robust_cost: Floats
    j: Floats
    terms: Terms
    swing: Floats
    rest: Floats
    performance: Floats
    slack: Floats
    clearance: Floats
    overshoot: Floats


class CurrentSwings(NamedTuple):
    """The swings of currents, over the rated one, each of shape (machines, runs, axes); nan if no current is measured.

    moving: The largest RMS increment over 25 ms until the load step.
    resting: RMS about the trend before the load step.
    """

    moving: Floats
    resting: Floats


class RobustScore(Saved):
    """Scores gains on emulated machines: all variants of all machines are simulated side by side.

    The score depends on the machine and the gains only: every run begins at rest, with the same noise. A variant
    without effect on this load (stiffness of a rigid load) is left out.

    With one run of each variant, the score depends on noise and position: an axis between two counts of its encoder may
    oscillate where it would rest in the middle of a count. `repeats` runs, each with its own noise and position within
    a count, give a mean score that describes the gains.

    Args:
        device: Name of the device.
        load: The load.
        motor: The motor: its name, the path of its file, or the motor itself.
        num_machines: Number of machines to score.
        num_threads: Number of threads; the number of cores by default.
        friction: Model of the load's friction, as in EmulatedDrives.
        repeats: Runs of every variant of every machine, whose scores are averaged.
        dynamics: Requirements on the loops.
        rest: How much longer than until the load step the current at rest is judged [s]: an axis may begin to swing
            only when its integrator has brought it to the next count.
    """

    STATE = ("_drives", "_t_0", "_reference", "_move", "_loops", "_constant")

    def __init__(
        self,
        device: str,
        load: str | Path | Load,
        motor: str | Path | Motor,
        num_machines: int,
        *,
        num_threads: int | None = None,
        friction: str = "stribeck",
        repeats: int = 1,
        dynamics: str | Dynamics = DEFAULT,
        rest: float = 0.0,
    ) -> None:
        from drive_env.devices import find_device
        from drive_env.emulator.emulated_drives import EmulatedDrives
        from mechanics.loads import find_load
        from mechanics.shaft import one, way

        found = find_load(load)
        known = find_device(device)
        self.dynamics, self._has_loops = find_dynamics(dynamics), has_linear_model(known)
        by_current = self._tries_current(known.gains.is_open_loop)
        fields = {parameter.field for parameter in found.parameters}
        self.variants = tuple(
            variant
            for variant in (servo_variants(self.dynamics.inertia_range) if self._has_loops else STEPPER_VARIANTS)
            if (variant.inertia == 1.0 or fields & set(_INERTIA))
            and (variant.stiffness == 1.0 or fields & set(_STIFFNESS))
            and (variant.velocity_p == 1.0 or not by_current)
            and (variant.run_current == 1.0 or by_current)
        )
        self.num_machines, self.repeats, self._rest = num_machines, repeats, rest
        self._runs = repeats * len(self.variants)  # per machine
        # Variants with half the inertia behind a nut or a flank resonate too fast for the physics' step of the nominal
        # machine.
        faster = self._has_loops and "contact_stiffness" in fields
        self._drives: EmulatedDrives = EmulatedDrives(
            device, found, motor, num_machines * self._runs, distinct=1, num_threads=num_threads,
            friction=friction, physics_steps=2 if faster else 1,
        )  # fmt: skip
        if repeats > 1:
            self._seed_noise()
        packed = one(found)
        self._ways = way(packed).joints
        levers = np.abs(self._ways @ packed.plant.disturbance[:, 0])
        # Against the move, like an obstructing load.
        self._load_torque = -LOAD_SHARE * self._drives.motor.rated_torque / float(levers.max())
        self._pushed = LOAD_SHARE * self._drives.motor.rated_torque * levers / levers.max()  # torque at each rotor
        self._constant: Floats = np.zeros(num_machines * self._runs)
        axes = (num_machines, self._runs, found.num_axes)
        factors = np.tile([v.velocity_p * v.run_current for v in self.variants], repeats)
        self._factors = np.tile(np.repeat(factors, axes[2]), axes[0])
        self._axes = axes
        # Position within a count of the encoder at which a run ends, as a share of the count.
        self._place = np.repeat(np.tile(np.arange(self._runs) // len(self.variants), num_machines), axes[2]) / repeats
        self._t_0 = np.ones(self._drives.num_axes)
        self._reference = np.ones((axes[0], axes[2]))  # E_0 [rad s]
        zero = np.zeros(self._drives.num_axes)
        self._move = plan_move(self._drives.motor, zero + self._drives.motor.inertia, 1.0, zero)

    def _seed_noise(self) -> None:
        """Give every run its noise: the first that of a score without repeats, and all variants of a run the same."""
        run = np.tile(np.repeat(np.arange(self.repeats), len(self.variants)), self.num_machines)
        self._drives.machine.seed_noise(_NOISE * (run + 1.0), run > 0)

    def set_machines(self, parameters: Mapping[str, Floats], supply: Floats, where: Mask | None = None) -> None:
        """Set the machines to score, (num_machines,): values of `drives.machine.parameters`, and supply voltage."""
        variants = self._runs
        mask = np.ones(self.num_machines, bool) if where is None else where
        kind = {f"load.{p.name}": p.field for p in self._drives.load.parameters}
        inertia = np.tile([v.inertia for v in self.variants], self.num_machines * self.repeats)
        stiffness = np.tile([v.stiffness for v in self.variants], self.num_machines * self.repeats)
        # The wiring of motors is left out: the drives here are set for their own, and it does not affect the gains.
        values = {name: np.repeat(value, variants) for name, value in parameters.items() if name not in WIRING}
        for name, field in kind.items():
            if field in _INERTIA:
                values[name] = values[name] * inertia
            elif field in _STIFFNESS:
                values[name] = values[name] * stiffness
        machine, each = self._drives.machine, np.repeat(mask, variants)
        machine.set_all(values, each)
        volts = np.repeat(np.asarray(supply, float), variants * self._axes[2])
        machine.supply = np.where(np.repeat(each, self._axes[2]), volts, machine.supply)
        filters = machine.parameters["stage.velocity_filter"]
        self._t_0 = np.repeat(self._settling_scale(filters), self._axes[2])
        machine.reset()  # each run begins at the load's first position, where it is linearised
        if self._has_loops:
            lags = elastic_lags(self._drives).reshape(self._axes)[:, :1]
            self._t_0 = np.maximum(self._t_0, 4.0 * np.broadcast_to(ELASTIC * lags, self._axes).reshape(-1))
            self._loops = true_machines(self._drives)
        self._reference = self._disturbance_scale()

    def set_constant_load(self, torque: Floats) -> None:
        """Set a constant load [N*m], (num_machines,), signed as `machine.load_torque`."""
        self._constant = np.repeat(np.asarray(torque, float), self._runs)

    def set_moves(self, move: Move, where: Mask | None = None) -> None:
        """Set the move of every axis of the machines, shape (num_machines * axes,)."""
        lanes = np.ones(self.num_machines, bool) if where is None else where
        each = np.repeat(lanes, self._runs * self._axes[2])
        old = self._move
        self._move = Move(
            np.where(each, self._spread(move.distance), old.distance),
            np.where(each, self._spread(move.velocity), old.velocity),
            np.where(each, self._spread(move.acceleration), old.acceleration),
            np.where(each, self._spread(move.increments), old.increments),
            move.counts,
        )

    def score_rule(self, gains: Integers, where: Mask | None = None) -> Scores:
        """Return the scores of the baseline rule's gains, from which a stepper's machines `where` get their E_0."""
        return self.score(gains)

    def score(self, gains: Integers) -> Scores:
        """Return the scores of gains, raw integers of shape (num_machines * axes, count) in the device's order."""
        return self._constrained(self._scores(*self._run(gains)), gains)

    def _constrained(self, scores: Scores, gains: Integers) -> Scores:
        """Return scores with the constraints applied to their performance."""
        if not self._has_loops:
            return scores
        clearance, overshoot = self._clearance(gains, len(self.variants))
        slack = self.dynamics.slack(clearance[:, 0], clearance[:, 1:], overshoot)
        slack = np.minimum(slack, 1.0 - scores.rest[:, 0] / RESTING)
        slack = np.where(scores.terms.tripped[:, 0], TRIPPED, np.maximum(slack, TRIPPED))
        return scores._replace(
            robust_cost=robust_cost(scores.performance, slack), slack=slack, clearance=clearance, overshoot=overshoot
        )

    def loop_slack(self, gains: Integers, *, nominal: bool = False) -> Floats:
        """Return the relative slack of machines' loops to margins and overshoot, (num_machines,).

        Args:
            gains: Raw integers, (num_machines * axes, count).
            nominal: Judge the nominal machines without their variants.
        """
        clearance, overshoot = self._clearance(gains, 1 if nominal else len(self.variants))
        return self.dynamics.slack(clearance[:, 0], clearance[:, 1:], overshoot)

    def _clearance(self, gains: Integers, variants: int) -> tuple[Floats, Floats]:
        """Return the clearance of the machines' first variants, (machines, variants), and overshoots, (machines,)."""
        machines, runs, axes = self._axes
        # The variants of the first run; those of other runs are equal.
        chosen = np.arange(machines * runs) % runs < variants
        device = self._drives.device
        raw = device.gains.with_velocity_p(self._spread(np.asarray(gains, np.int64)), self._factors)
        raw = raw.reshape(machines * runs, axes, -1)[chosen]
        linear = LinearMachines(*(values[chosen] for values in self._loops))
        cascade = CascadeGains.of(device, raw)
        clearance, overshoot = loop_clearance(self.dynamics, LoopRates.of(device), linear, cascade, variants)
        return clearance.reshape(-1, variants), overshoot

    def close(self) -> None:
        """Close the drives."""
        self._drives.close()

    @staticmethod
    def _tries_current(is_open_loop: bool) -> bool:
        """Return whether a variant has less run current instead of more gain."""
        return is_open_loop

    def _settling_scale(self, filters: Floats) -> Floats:
        """Return t_0 of the machines with these velocity filters [s]."""
        return 4.0 * small_time_constants(self._drives.device, filters)

    def _disturbance_scale(self) -> Floats:
        """Return E_0 of the machines at their present position [rad s], (num_machines, axes)."""
        lag = 0.25 * self._t_0.reshape(self._axes)[:, 0]
        mass = np.concatenate([group.load.mass_matrix() for group in self._drives.inside.groups])[:: self._runs]
        inertia = np.einsum("ad,cde,ae->ca", self._ways, mass, self._ways)
        found = (E_0_SHARE * self._pushed / inertia * lag**3).max(axis=1)
        return np.repeat(found[:, None], self._axes[2], axis=1)

    def _spread(self, values: NDArray[Any]) -> NDArray[Any]:
        """Repeat values of (num_machines * axes,) for all variants and runs."""
        machines, runs, axes = self._axes
        shape = (machines, 1, axes, *values.shape[1:])
        full = (machines, runs, axes, *values.shape[1:])
        return np.broadcast_to(values.reshape(shape), full).reshape(-1, *values.shape[1:])

    def _run(self, gains: Integers) -> tuple[Any, Floats, CurrentSwings]:
        """Return the terms of every axis without E_d/E_0, E_d [rad s] and swings, (machines, runs, axes) each."""
        drives, move, shape = self._drives, self._move, self._axes
        drives.machine.load_torque = self._constant
        drives.machine.reset()
        used = self._varied(self._spread(np.asarray(gains, np.int64)))
        write_gains(drives, used)
        write_profile(drives, move)
        objects = self._objects()
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "machine .* left the range of physics", RuntimeWarning)
            target, failed = self._get_ready()
            start(drives, target)
            before = drives.record(objects, SETTLED * CYCLE)
            free = {name: before[name] for name in objects}
            later = self._resting() if self._rest and cia402.TORQUE_ACTUAL in objects else None
            loaded = self._load_step(objects)
        failed = failed | ~cia402.matches(loaded[cia402.STATUSWORD][-1], cia402.OPERATION_ENABLED)
        terms = self._terms(free, loaded, target, used)
        terms = terms._replace(tripped=terms.tripped | failed | np.repeat(drives.machine.diverged, shape[2]))
        error = np.abs(wrapped(target - loaded[cia402.POSITION_ACTUAL])).sum(axis=0) * CYCLE / move.increments
        if cia402.TORQUE_ACTUAL in objects:
            raw = [one[cia402.TORQUE_ACTUAL] for one in (free, later) if one is not None]
            measured = np.concatenate(raw).astype(float) * ampere_per_count(drives)
            seen = swings(measured, drives.motor.rated_current, shape)
        else:
            seen = CurrentSwings(np.full(shape, np.nan), np.full(shape, np.nan))
        return terms.each(lambda value: value.reshape(shape)), np.maximum(error, move.least_error).reshape(shape), seen

    def _resting(self) -> Mapping[Any, Integers]:
        """Record the current of a longer rest, after which the machines are as before."""
        state = self._drives.save_state()
        trace = self._drives.record([cia402.TORQUE_ACTUAL], self._rest)
        self._drives.restore_state(state)
        return {cia402.TORQUE_ACTUAL: trace[cia402.TORQUE_ACTUAL]}

    # Overridden for other kinds of drives.
    _cost: Callable[[Any], Floats] = staticmethod(cost)

    def _objects(self) -> list[ObjectName]:
        """Return the objects to record: position and statusword, and between them the parts of the demanded current."""
        roles = self._drives.device.roles
        demanded = [name for name in _DEMANDED if not isinstance(name, Role) or name in roles]
        return [cia402.POSITION_ACTUAL, *demanded, cia402.STATUSWORD]

    def _varied(self, gains: Integers) -> Integers:
        """Return the gains of all axes of all variants, as changed by the variants."""
        return self._drives.device.gains.with_velocity_p(gains, self._factors)

    def _get_ready(self) -> tuple[Integers, Mask]:
        """Enable the drives at rest; return their targets [inc], and axes that cannot be scored."""
        move = self._move
        power_up(self._drives)
        place = np.rint(self._place * move.increments / move.counts).astype(np.int64)
        return move.distance + place, np.zeros(self._drives.num_axes, bool)

    def _load_step(self, objects: list[ObjectName]) -> Mapping[Any, Integers]:
        """Apply the load step until the trial ends, and record the machines."""
        self._drives.machine.load_torque = self._constant + self._load_torque
        trace = self._drives.record(objects, (TRIAL - SETTLED) * CYCLE)
        return {name: trace[name] for name in objects}

    def _terms(
        self, free: Mapping[Any, Integers], loaded: Mapping[Any, Integers], target: Integers, used: Integers
    ) -> Any:
        """Return the terms of every axis from the records before and after the load step; E_d/E_0 is set to 1."""
        drives, move = self._drives, self._move
        current = sum(free[name] for name in self._objects()[1:-1]) * ampere_per_count(drives)
        settling, noise, overshoot = move_terms(
            free[cia402.POSITION_ACTUAL].astype(float), np.asarray(current, float), move, self._t_0,
            drives.motor.rated_current, target, np.where(move.distance < 0, -1, 1),
        )  # fmt: skip
        return Terms(settling, np.ones_like(settling), noise, overshoot, np.zeros(len(settling), bool))

    def _scores(self, terms: Any, disturbance: Floats, swings: CurrentSwings) -> Scores:
        terms = terms._replace(disturbance=disturbance / self._reference[:, None])
        return self._averaged(terms, self._cost(terms), swings)

    def _averaged(self, terms: Any, j: Floats, swings: CurrentSwings) -> Scores:
        """Return the scores from terms, J and swings of every axis in all runs, (machines, runs, axes)."""
        worst = j.argmax(axis=-1)[..., None]
        of_worst = terms.each(lambda value: np.take_along_axis(value, worst, -1)[..., 0])
        shape = (self.num_machines, self.repeats, len(self.variants))
        j, moving, resting = (one.max(axis=-1).reshape(shape) for one in (j, *swings))
        if self.repeats > 1:
            tripped = of_worst.tripped.reshape(shape).any(axis=1)
            of_worst = of_worst.each(lambda value: value.reshape(shape).mean(axis=1))._replace(tripped=tripped)
        worth = robust_performance(j).mean(axis=1)
        nothing = np.full(self.num_machines, np.nan)
        return Scores(
            worth, j.mean(axis=1), of_worst, moving.max(axis=1), np.sqrt(np.square(resting).mean(axis=1)), worth,
            np.full(self.num_machines, np.inf), np.full((self.num_machines, len(self.variants)), np.nan), nothing,
        )  # fmt: skip


class StepperScore(RobustScore):
    """`RobustScore` for steppers: without loops there is no E_0, so E_d with the baseline rule's gains is used."""

    def score_rule(self, gains: Integers, where: Mask | None = None) -> Scores:
        """Set E_0 of the machines `where` by the baseline rule's gains; return their scores, with E_d/E_0 of 1."""
        mask = np.ones(self.num_machines, bool) if where is None else where
        measured = self._run(gains)
        nominal = measured[1][:, :: len(self.variants)].mean(axis=1)
        self._reference = np.where(mask[:, None], nominal, self._reference)
        return self._constrained(self._scores(*measured), gains)

    def _disturbance_scale(self) -> Floats:
        return self._reference

    def _settling_scale(self, filters: Floats) -> Floats:
        return np.full(np.shape(filters), swing_period(self._drives.motor))


def swings(current: Floats, rated_current: float, shape: tuple[int, ...]) -> CurrentSwings:
    """Return the swings of runs' measured current, in the given shape.

    Args:
        current: Current until the load step [A], (SETTLED cycles or more, axes of all machines).
        rated_current: Rated current of the motor, peak i_q [A].
        shape: Machines, runs, axes.
    """
    found = (swing(current[:SETTLED], rated_current), resting_swing(current, rated_current))
    return CurrentSwings(*(one.reshape(shape) for one in found))
