"""Puts a load and an obstacle on axes of emulated machines: proves that a stall stops the motor in time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from drive_env import cia402
from drive_env.drives.interface import machine_of
from drive_env.phase_current import LOAD_SHARE, holding_torque
from drive_env.trials.working_moves import SETTLE, Steady, WorkingMoves
from mechanics.arrays import Floats, Mask
from tuning.linked_axes import are_independent
from tuning.stop_causes import told_causes
from tuning.target import Target

OBSTACLE = 1.3  # times the holding torque at the run current: more than the motor can move
# s, rise times of load and obstacle. Faster ones are not realistic: the drive takes a load of 30 % within 5 ms for a
# stall, and a sudden obstacle, which is a torque and no wall, throws the rotor back by ten teeth and more.
RISE, OBSTACLE_RISE = 0.15, 0.03
REACTION = 0.3  # s, greatest duration of a fault reaction
AFTER = 0.05  # s at constant speed until the obstacle begins
STALL = "stall"  # word in the drive's emergency


@dataclass(frozen=True)
class ObstacleProof:
    """The reaction of the axes to load and obstacle, each of shape (num_axes,).

    withstood: The axis neither stopped nor lost steps with the acceptable load.
    causes: Emergencies of the drives during the proof, "" without any.
    stopped: A stall stopped the axis at the obstacle.
    lost: Whole teeth (four full steps) lost until then.
    """

    withstood: Mask
    causes: list[str]
    stopped: Mask
    lost: Floats


def can_load(target: Target) -> bool:
    """Return whether each axis can be loaded separately: only emulated machines whose axes move independently."""
    from mechanics.shaft import one

    machine = target.drives.machine
    return machine is not None and are_independent(one(machine.load))


def why_not_loaded(target: Target) -> str:
    """Return why the axes cannot be loaded separately."""
    if target.drives.machine is None:
        return "nothing puts a load on an axis here"
    return f"the axes of {target.machine} move one another, so that no load is one axis' alone"


def prove_with_load(target: Target, moves: WorkingMoves, speed: float, run: Floats, where: Mask) -> ObstacleProof:
    """Move with the acceptable load, then against an obstacle; the axes are enabled again afterwards.

    Args:
        target: Emulated machines for which `can_load` is true.
        moves: Moves at the working speed.
        speed: Working speed [rad/s].
        run: Amplitudes of the run current [A].
        where: Axes that take part.
    """
    drives, motor = target.drives, target.motor
    against = -np.sign(moves.reach)
    ramp = float((speed / moves.acceleration).max()) + SETTLE

    def with_torque(torque: Floats, begin: float, rise: float) -> Steady:
        with _loading(target) as push:

            def load(leg: int, t: float) -> None:
                share = float(np.clip((t - begin) / rise, 0.0, 1.0)) if leg == 0 else 0.0
                push(np.where(where, share * against * torque, 0.0))

            return moves.run(speed, where, load, until_stopped=True)

    told_causes(drives)  # discards earlier ones
    # The load rises slowly: a sudden one would make the rotor oscillate in its field.
    loaded = with_torque(np.full(target.num_axes, LOAD_SHARE * motor.rated_torque), ramp, RISE)
    drives.advance(REACTION if loaded.stopped.any() else SETTLE)
    moves.trials.recover(where)
    drives.advance(SETTLE)
    causes = told_causes(drives)
    before = moves.trials.shift()
    blocked = with_torque(OBSTACLE * holding_torque(motor, run), ramp + AFTER, OBSTACLE_RISE)
    stalled = np.array([STALL in told for told in told_causes(drives)])
    drives.advance(REACTION)
    moves.trials.recover(where)
    drives.advance(SETTLE)
    tooth = 2.0 * np.pi * moves.increments / motor.n_p
    lost = np.abs(moves.trials.shift() - before) / tooth
    enabled = cia402.matches(drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED)
    return ObstacleProof(where & ~loaded.failed, causes, where & blocked.stopped & stalled & enabled, np.rint(lost))


@contextmanager
def _loading(target: Target) -> Iterator[Callable[[Floats], None]]:
    """Yield a function that sets torques at the rotors; on machines with one axis they act on the load."""
    machine = machine_of(target.drives)
    if target.axes_per_machine > 1:
        with machine.pushed() as push:
            yield push
        return
    lever, calm = _lever(target), np.asarray(machine.load_torque, float).copy()

    def load(torque: Floats) -> None:
        machine.load_torque = calm + torque / lever

    try:
        yield load
    finally:
        machine.load_torque = calm


def _lever(target: Target) -> Floats:
    """Return the transmission ratio from a torque on the load to the rotor of each axis."""
    from mechanics.shaft import one, way

    packed = one(machine_of(target.drives).load)
    return np.full(target.num_axes, float(np.abs(way(packed).joints @ packed.plant.disturbance[:, 0]).max()))
