"""One trial of gains on drives: a positioning move, the reversal, and the gain probe; and the identification before.

All of it is possible on a real drive: it uses position, position demand, current and statusword once a millisecond.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from drive_env import cia402
from drive_env.devices.gain_set import GainSet
from drive_env.dictionary.roles import Role
from drive_env.drives import motion
from drive_env.drives.currents import ampere_per_count
from drive_env.drives.interface import CYCLE, Drives, device_of
from drive_env.drives.raw_gains import write_gains
from drive_env.drives.speeds import per_increment
from drive_env.motors import Motor
from drive_env.saved_state import Saved
from drive_env.trials.demand import computed, is_recorded
from drive_env.trials.oscillation import shakes
from drive_env.trials.positioning import (
    TRIAL,
    WATCH,
    Move,
    highest_ramp,
    move_terms,
    plan_move,
    power_up,
    start,
    wrapped,
    write_profile,
)
from drive_env.trials.score import Terms, cost
from mechanics.arrays import Floats, Integers, Mask

PHASES = ("move", "reversal", "probe")
PROBE = 1.5  # velocity P of the probe over that of the trial
PHASE_TITLES = "move", "reversal", f"move with {PROBE:g} times velocity P"  # in messages

# The watch checks every 25 ms the samples since its last check: an oscillation is stopped within 50 ms.
RECOVERY, RECOVERY_TIME = 5, 0.01  # attempts, and the time between them [s]
STANDSTILL = 1.0  # rad/s, one count in 1.5 ms: below it the sign of a speed is noise
LAG = 3  # ms by which a filtered speed may lag behind its rotor: added around each motion


class Identified(NamedTuple):
    """Identified properties of a machine, each of shape (num_axes,).

    Inertia is measured relative to the torque constant, and given with the data sheet's.
    """

    inertia: Floats  # kg*m^2, rotor and load
    coulomb: Floats  # A, dry friction
    viscous: Floats  # A*s/rad
    offset: Floats  # A, current of gravity or a constant load


class Trial(NamedTuple):
    """The result of a trial; `terms`, `aborted` and `following` [s] have shape (phases, num_axes).

    following: Integral of |demand - actual| dt over a whole phase, over the move's size.
    error: Demand less actual during the move, over its size, shape (TRIAL, num_axes).
    culprit: Axes that oscillated or went into fault themselves, (num_axes,); the other axes of their machine were
        stopped with them.
    """

    terms: Terms  # its disturbance is 1
    following: Floats
    aborted: Mask
    error: Floats
    culprit: Mask

    def costs(self, softness: Floats) -> Floats:
        """Return J by measured terms of every phase, (phases, num_axes).

        Args:
            softness: `softness` of the trial's gains over that of the rule's, (num_axes,), as a factor of E_d/E_0.
        """
        disturbance = np.stack([softness, softness, softness / PROBE])
        return cost(self.terms._replace(disturbance=disturbance, tripped=self.aborted))


def softness(known: GainSet, gains: Integers) -> Floats:
    """Return a number proportional to the integral of the error after a load step, (num_axes,).

    Load steps are impossible on a bus; but the integrators of a P-PI cascade determine the result: if the load takes a
    current i, the integral of the position error is i T_i / (P k_v), as long as the error keeps its sign.
    """
    cascade = known.columns_of("velocity", "position")
    return np.asarray(1.0 / known.strength(gains, cascade).prod(axis=1))


def measured_cost(costs: Floats) -> Floats:
    """Return the cost of a trial, as in the robust cost: half the mean of move and reversal, half the worst phase."""
    return np.asarray(0.5 * costs[:2].mean(axis=0) + 0.5 * costs.max(axis=0))


class Trials(Saved):
    """Runs trials on drives; all axes of a machine are stopped together.

    Args:
        drives: The drives, in pp.
        motor: Motor of the axes.
        axes: Number of axes of a machine.
        t_0: Four times the sum of the small time constants [s].

    Attributes:
        look: If not None, called after every cycle.
        computes_demand: Whether a demand that the drives cannot send is replaced by that of the profile.
        returns: Whether a trial ends where it began; otherwise it ends where its move did.
        longer: Cycles that each motion lasts beyond `TRIAL`, a whole number of windows: slow loops arrive later.
    """

    computes_demand = True
    returns = False
    longer = 0

    def __init__(self, drives: Drives, motor: Motor, axes: int, t_0: float) -> None:
        self.look: Callable[[], None] | None = None
        self._drives = drives
        self._motor = motor
        self._axes = axes
        self._t_0 = t_0

    def identify(self, reach: Floats, where: Mask) -> tuple[Identified, Integers]:
        """Move there and back with the present gains; return the identified axes, and their first positions [inc].

        Args:
            reach: Signed angles that the rotors may turn from here [rad], shape (num_axes,).
            where: Axes that move.
        """
        drives = self._drives
        origin = drives.read(cia402.POSITION_ACTUAL)
        scaler = drives.read(Role.POSITION_SCALE)
        move = plan_move(
            self._motor,
            np.full(drives.num_axes, 3.0 * self._motor.inertia),
            scaler,
            reach,
            highest_ramp(device_of(drives)),
        )
        write_profile(drives, move, where)
        objects = [cia402.POSITION_ACTUAL, cia402.VELOCITY_ACTUAL, cia402.TORQUE_ACTUAL]
        traces = []
        self._prepare(objects)
        for target in (origin + move.distance, origin):
            start(drives, _on_the_counter(target), where)
            traces.append(self._record(objects, TRIAL))
        position, velocity, current = (np.concatenate([trace[name] for trace in traces]) for name in objects)
        angle = wrapped(position - origin) / move.increments
        speed = velocity / (scaler * per_increment(drives, cia402.VELOCITY_ACTUAL)) * 2.0 * np.pi
        moving = samples_in_motion(speed, LAG)
        return momentum_balance(angle, speed, current * ampere_per_count(drives), self._motor, moving=moving), origin

    def run(
        self, gains: Integers, incumbent: Integers, move: Move, origin: Integers, direction: Integers, where: Mask
    ) -> Trial:
        """Try gains, raw integers of shape (num_axes, count), in a move from the origin [inc], back, and there again.

        If an axis oscillates or goes into fault, its machine immediately gets the incumbent gains back, its fault is
        reset, and it continues with these gains.

        Args:
            gains: Gains to try.
            incumbent: Gains for stopped axes.
            move: The move.
            origin: Present positions of the axes [inc].
            direction: 1 to move as planned, -1 in the other direction, shape (num_axes,).
            where: Axes that take part; results of the others are meaningless.
        """
        drives = self._drives
        away = origin + direction * move.distance
        count = drives.num_axes
        shape = (len(PHASES), count)
        aborted = np.zeros(shape, bool)
        stopped, culprit = np.zeros((2, count), bool)
        settling, noise, overshoot, following = (np.zeros(shape) for _ in range(4))
        cycles = TRIAL + self.longer
        first_error = np.zeros((cycles, count))
        write_profile(drives, move, where)
        phases = ((away, gains), (origin, gains), (away, device_of(drives).gains.with_velocity_p(gains, PROBE)))
        for phase, (target, tried) in enumerate(phases):
            write_gains(drives, np.where(stopped[:, None], incumbent, tried), where)
            position, demand, current, stopped, new = self._phase(target, incumbent, stopped, where)
            culprit |= new
            aborted[phase] = stopped
            back = phase % 2 == 1
            sign = np.where(move.distance < 0, -1, 1) * direction * (-1 if back else 1)
            settling[phase], noise[phase], overshoot[phase] = move_terms(
                position, current * ampere_per_count(drives), move, self._t_0, self._motor.rated_current, target, sign
            )
            size = np.maximum(np.abs(move.distance), 1)
            if demand is None:
                demand = computed(away if back else origin, target, move, cycles)
            error = wrapped(demand - position) / size
            following[phase] = np.maximum(np.abs(error).sum(axis=0), 0.5) * CYCLE
            if phase == 0:
                first_error = error
        terms = Terms(settling, np.ones(shape), noise, overshoot, aborted)
        return Trial(terms, following, aborted, first_error, culprit)

    def recover(self, where: Mask) -> None:
        """Bring axes in any state to pp, enabled, within 50 ms; an axis that cannot be enabled stays as it is."""
        drives = self._drives
        motion.select_mode(drives, "pp", where)
        for _ in range(RECOVERY):
            down = where & self.down()
            if not down.any():
                return
            clear(drives, down)
            drives.advance(RECOVERY_TIME)

    def power_up(self, where: Mask) -> None:
        """Enable newly switched-on drives in pp, in a fixed number of milliseconds."""
        power_up(self._drives, where)

    def go(self, target: Integers, where: Mask) -> None:
        """Start a move to a position [inc]."""
        start(self._drives, _on_the_counter(target), where)

    def leave(self) -> None:
        """Restore all settings except gains and profiles that trials have changed; the axes must be disabled."""

    def down(self) -> Mask:
        """Return which axes are not enabled."""
        return np.asarray(~cia402.matches(self._drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED))

    def _phase(
        self, target: Integers, incumbent: Integers, stopped: Mask, where: Mask
    ) -> tuple[Floats, Floats | None, Floats, Mask, Mask]:
        """Move; return position, demand, current, machines stopped so far, and axes that newly caused a stop.

        The demand is None if the drives cannot send it.
        """
        drives, to = self._drives, _on_the_counter(target)
        objects = [cia402.POSITION_ACTUAL, cia402.TORQUE_ACTUAL, cia402.STATUSWORD]
        if has_demand := not self.computes_demand or is_recorded(drives):
            objects.insert(1, cia402.POSITION_DEMAND)
        traces = []
        culprit = np.zeros(len(stopped), bool)
        self._prepare(objects)
        start(drives, to, where)
        for _ in range((TRIAL + self.longer) // WATCH):
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "machine .* left the range of physics", RuntimeWarning)
                trace = self._record(objects, WATCH)
            traces.append(trace)
            down = where & ~cia402.matches(trace[cia402.STATUSWORD][-1], cia402.OPERATION_ENABLED)
            shaking = self._shaking(trace)
            new = self._whole_lanes(down | shaking) & where & ~stopped
            if new.any():
                write_gains(drives, incumbent, new)
                stopped = stopped | new
                culprit |= new & (down | shaking)
            if down.any():
                clear(drives, down)
                start(drives, to, down)
        seen = {name: np.concatenate([trace[name] for trace in traces]) for name in objects}
        demand = seen[cia402.POSITION_DEMAND] if has_demand else None
        return seen[cia402.POSITION_ACTUAL], demand, seen[cia402.TORQUE_ACTUAL], stopped, culprit

    def _shaking(self, trace: Mapping[Any, Integers]) -> Mask:
        """Return which axes oscillate in the samples of one check, (num_axes,)."""
        current = trace[cia402.TORQUE_ACTUAL] * ampere_per_count(self._drives)
        return np.asarray(shakes(current, self._motor.rated_current))

    def _prepare(self, objects: list[Any]) -> None:
        """Map the objects of a recording on a bus in advance: it takes 10 ms, which a move in real time cannot wait."""
        if not self._drives.time_waits:
            self._drives.record(objects, 0.0)

    def _record(self, objects: list[Any], cycles: int) -> Mapping[Any, Integers]:
        """Record objects for some cycles, (cycles, num_axes) each; cycle by cycle if `look` is set."""
        if self.look is None:
            trace = self._drives.record(objects, cycles * CYCLE)
            return {name: trace[name] for name in objects}
        rows = []
        for _ in range(cycles):
            rows.append(self._drives.record(objects, CYCLE))
            self.look()
        return {name: np.concatenate([row[name] for row in rows]) for name in objects}

    def _whole_lanes(self, axes: Mask) -> Mask:
        return np.repeat(axes.reshape(-1, self._axes).any(axis=1), self._axes)


def clear(drives: Drives, where: Mask) -> None:
    """Reset faults and enable again without waiting; an axis that still moves stays as it is."""
    for word in (cia402.DISABLE_VOLTAGE, cia402.FAULT_RESET, *cia402.ENABLING):
        drives.write(cia402.CONTROLWORD, word, where=where)


def _on_the_counter(position: Integers) -> Integers:
    """Wrap positions at 2^31 for 607Ah."""
    return wrapped(position).astype(np.int64)


def samples_in_motion(speed: Floats, around: int) -> Mask:
    """Return which samples of speeds [rad/s] belong to a moving rotor, or are within `around` samples of such.

    Args:
        speed: Shape (samples, num_axes).
        around: Number of samples (ms).
    """
    fast = np.abs(speed) > STANDSTILL
    found = fast.copy()
    for k in range(1, around + 1):
        found[k:] |= fast[:-k]
        found[:-k] |= fast[k:]
    return found


def momentum_balance(
    angle: Floats,
    speed: Floats,
    current: Floats,
    motor: Motor,
    inertia: Floats | None = None,
    moving: Mask | None = None,
) -> Identified:
    """Fit i = (J domega/dt) / K_t + coulomb sign(omega) + viscous omega + offset, integrated once over time.

    The integral avoids the derivative of a noisy speed, and an oscillating elastic load has little momentum of its own.
    The momentum is computed from the angle, and the impulse by trapezoids up to its samples: a lag, as of a filtered
    speed, would be mistaken for friction on an oscillating axis.
    With a known inertia [kg m^2], (num_axes,), the viscous friction is the motor's, and only dry friction is fitted: in
    a short move the two cannot be separated. `moving`, as long as `speed`, selects the samples that count, all by
    default: at rest dry friction can hold any load up to its own value, which must not count as a constant load.
    """
    sign = np.clip(speed / STANDSTILL, -1.0, 1.0)
    rate = np.gradient(angle, CYCLE, axis=0)
    sign, current = (np.concatenate([row[:1], 0.5 * (row[1:] + row[:-1])]) for row in (sign, current))
    samples, axes = speed.shape
    t = np.broadcast_to((np.arange(samples) * CYCLE)[:, None], (samples, axes))
    if moving is not None:
        sign, current = np.where(moving, sign, 0.0), np.where(moving, current, 0.0)
        t = np.cumsum(moving, axis=0) * CYCLE
    columns = np.stack(
        [rate, np.cumsum(sign, axis=0) * CYCLE, angle, t,
         np.ones((samples, axes))],
        axis=-1,
    ).transpose(1, 0, 2)  # fmt: skip
    impulse = np.cumsum(current, axis=0).T * CYCLE
    if inertia is not None:
        impulse = impulse - ((inertia * rate + motor.viscous * angle) / motor.torque_constant).T
        columns[:, :, [0, 2]] = 0.0
    scale = np.maximum(np.sqrt(np.mean(columns**2, axis=1, keepdims=True)), 1e-12)
    X = columns / scale
    # An axis that did not move has no information; the small term keeps its equations solvable.
    normal = X.transpose(0, 2, 1) @ X + 1e-6 * samples * np.eye(X.shape[2])
    solved = np.linalg.solve(normal, X.transpose(0, 2, 1) @ impulse[:, :, None])[..., 0] / scale[:, 0]
    # Values of a machine that left the range of physics are unknown; the inertia is at least about the rotor's.
    solved = np.nan_to_num(solved)
    if inertia is None:
        inertia = solved[:, 0] * motor.torque_constant
    else:
        solved[:, 2] = motor.viscous / motor.torque_constant
    inertia = np.clip(inertia, 0.8 * motor.inertia, 300.0 * motor.inertia)
    return Identified(inertia, np.maximum(solved[:, 1], 0.0), np.maximum(solved[:, 2], 0.0), solved[:, 3])
