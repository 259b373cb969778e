"""A policy on the same machines twice: in this process, and over the bus on which they are served.

In lockstep the two must agree bit by bit. In real time they differ in times: when a set-point arrives, how long an axis
rested before a move, and so the noise. The resulting difference of the figures is the gap.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from agents.evaluation.evaluation import Evaluation, GivenDrives, as_on_a_bus, evaluate, joined
from agents.evaluation.on_the_bus import drives_for
from agents.evaluation.served import Served, draw_machines, emulated, in_lockstep, in_real_time
from agents.policies.guard import LIMITS, GuardLimits, PolicyStoppedError
from agents.tasks import environment_name, make_environments
from drive_env.bus.config import Machine
from drive_env.drives.interface import Drives
from drive_env.emulator.emulated_drives import emulated_of
from drive_env.envs import environment_of
from drive_env.fieldbus.errors import BusError
from drive_env.safety.envelope import SafetyError
from mechanics.arrays import Integers

if TYPE_CHECKING:
    pass

ROBUST_COST = "robust cost"
PATIENCE = 30.0  # s, for a served node: a late answer means that the computer is busy, not that the node is gone
OTHER_NOISE = 1_000_003  # added to the seed of the drives' noise


class BothSides(NamedTuple):
    """The results.

    inside, bus: The evaluations, an episode of each machine that was evaluated on both sides, in the same order.
    again: A second evaluation in this process with other noise: the gap without any bus; None in lockstep.
    missing: Machine -> why it could not be evaluated on both sides.
    """

    inside: Evaluation
    bus: Evaluation
    again: Evaluation | None
    missing: dict[int, str]


def on_both_sides(
    policy: Any,
    environment: str,
    configuration: Mapping[str, Any] | None = None,
    *,
    machines: int = 20,
    seed: int = 0,
    name: str = "policy",
    lockstep: bool = False,
    guard: GuardLimits | None = None,
    told: Callable[[float], None] = lambda share: None,
) -> BothSides:
    """Run an episode of a policy on each of some machines, in this process and over their bus.

    Args:
        policy: The policy.
        environment: Name of the environment.
        configuration: Its options; its distributions define the machines.
        machines: Number of machines.
        seed: Seed of machines and episodes; episode k has seed + k.
        name: Name of the policy.
        lockstep: Whether to serve them in lockstep instead of in real time.
        guard: Limits of the policy over the bus.
        told: Called with the finished share.

    Raises:
        PolicyStoppedError: If the guard stopped the policy in this process.
        ValueError: For a load that cannot be served.
        BusError: If no machine could be evaluated over the bus.
    """
    environment = environment_name(environment)
    lanes: Any = make_environments(environment, 1, configuration)
    config = lanes.config
    lanes.close()
    joint = getattr(getattr(config, "task", None), "joint", None)
    if joint is not None and not lockstep:
        raise ValueError(
            f"{config.load} needs the pendulum's angle, which a drive on a bus does not have; evaluate it with "
            "--lockstep"
        )
    rows = draw_machines(config, machines, seed)
    options: dict[str, Any] = {"name": name, "episodes": 1}
    limits = guard or LIMITS[environment_of(environment)]
    noises = (0,) if lockstep else (0, OTHER_NOISE)
    found: dict[int, list[Evaluation]] = {}
    missing: dict[int, str] = {}
    serve = in_lockstep if lockstep else in_real_time
    for k, machine in enumerate(rows):
        sides = []
        for noise in noises:
            with emulated(machine, seed + noise) as drives:
                own = GivenDrives(as_on_a_bus(drives), _sensor(drives, joint), side="emulator as on a bus")
                sides.append(evaluate(policy, environment, configuration, on=own, seed=seed + k, **options))
        with serve(machine, seed) as there:
            try:
                bus = _over_the_bus(
                    policy, environment, configuration, config, there, limits, lockstep, joint, seed=seed + k, **options
                )
                found[k] = [bus, *sides]
            except (SafetyError, BusError, PolicyStoppedError, RuntimeError) as error:
                missing[k] = str(error)
        told((k + 1) / machines)
    if not found:
        raise BusError(f"no machine could be evaluated over the bus; the reason for the first: {missing[0]}")
    bus, *inside = (joined([sides[number] for sides in found.values()]) for number in range(1 + len(noises)))
    if environment == "ServoDrive/GainTuning-v0":
        _add_robust_cost([rows[k] for k in found], [bus, *inside])
    return BothSides(inside[0], bus, None if lockstep else inside[1], missing)


def _over_the_bus(
    policy: Any,
    environment: str,
    configuration: Mapping[str, Any] | None,
    config: Any,
    there: Served,
    limits: GuardLimits,
    lockstep: bool,
    joint: int | None,
    **options: Any,
) -> Evaluation:
    with drives_for(
        environment, dict(configuration or {}), limits, device=config.device, interface="slcan", channel=there.channel,
        nodes=there.nodes, lockstep=lockstep, **({"timeout": PATIENCE} if lockstep else {}),
    ) as drives:  # fmt: skip
        on = GivenDrives(drives, _sensor(there.drives, joint), limits)
        return evaluate(policy, environment, configuration, on=on, **options)


def _sensor(drives: Drives | None, joint: int | None) -> Callable[[], Any] | None:
    if joint is None or drives is None:
        return None
    machine = emulated_of(drives).machine
    return lambda: machine.joint_positions[:, joint]


def _add_robust_cost(machines: Sequence[Machine], sides: Sequence[Evaluation]) -> None:
    """Add the robust cost of the answers; it needs the true machines, which are known here."""
    from drive_env.motors import find_motor
    from tuning.compare.suite import SuiteMachine
    from tuning.compare.yardstick import Yardstick

    group = [
        SuiteMachine(str(k), row.device, row.load, row.motor_name, row.parameters, find_motor(row.motor_name).voltage)
        for k, row in enumerate(machines)
    ]
    yardstick = Yardstick(group, num_threads=1)
    try:
        for side in sides:
            costs = yardstick.score(np.concatenate([_answer(episode) for episode in side.episodes])).robust_cost
            side.values = {ROBUST_COST: list(map(float, costs)), **side.values}
            side.lower_is_better = {ROBUST_COST: True, **side.lower_is_better}
    finally:
        yardstick.close()


def _answer(episode: Any) -> Integers:
    return np.asarray(episode.last["gains"], np.int64)
