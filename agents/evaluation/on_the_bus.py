"""Drives of a bus for an evaluation: inside an envelope for the task, with everything compiled in advance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from agents.policies.guard import GuardLimits
from agents.tasks import OF_MACHINES, environment_name, make_environments
from drive_env import cia402
from drive_env.default_device import DEFAULT_DEVICE
from drive_env.dictionary.roles import Role
from drive_env.drives.limits import given
from drive_env.envs import environment_of

if TYPE_CHECKING:
    from drive_env.drives.interface import Drives
    from tuning.target import Target

# Of the task's amplitude and speed: factors beyond which the envelope stops a policy.
POSITION_SLACK, SPEED_SLACK = 1.5, 2.0


@contextmanager
def drives_for(environment: str, configuration: Mapping[str, Any], guard: GuardLimits, **options: Any) -> Iterator[Any]:
    """Open drives on a bus for a policy, as `target_for` does, and yield only them."""
    with target_for(environment, configuration, guard, **options) as target:
        yield target.drives


@contextmanager
def target_for(
    environment: str,
    configuration: Mapping[str, Any],
    guard: GuardLimits,
    *,
    device: str = DEFAULT_DEVICE,
    interface: str | None = None,
    channel: str | None = None,
    nodes: Sequence[int] | None = None,
    lockstep: bool = False,
    **options: Any,
) -> Iterator[Target]:
    """Open drives on a bus for a policy; they are at rest and disabled afterwards.

    Only the target's drives and the way to reopen them are used, not motor, supply and travel.

    The envelope's limits follow the task: 1.5 times the amplitude around the axes' present positions, and twice the
    speed; the drive's own limits apply, too. The stall limit is the guard's.

    Raises:
        BusError: If the bus cannot be opened or a node does not answer.
    """
    from drive_env.drives.limits import Limits
    from drive_env.drives.speeds import per_increment
    from drive_env.master.open_drives import open_drives
    from tuning.target import FREE, LOCKSTEP_PATIENCE, on_bus

    more: dict[str, Any] = {"device": device, "interface": interface, "channel": channel, "nodes": nodes}
    more |= {"pace": "lockstep", "timeout": LOCKSTEP_PATIENCE} if lockstep else {"pace": "real-time"}
    more |= options
    warm_up(environment, configuration)
    position, velocity = None, None
    if environment_of(environment_name(environment)) == "ServoDrive/Tracking-v0":
        lanes = make_environments(environment, 1, _emulated(configuration))
        amplitude, speed = lanes.config.amplitude, lanes.config.speed  # type: ignore[attr-defined]
        lanes.close()
        with open_drives(**more) as drives:
            turn, at = drives.read(Role.POSITION_SCALE), drives.read(cia402.POSITION_ACTUAL)
            speed_turn = turn * per_increment(drives, cia402.VELOCITY_ACTUAL)
        reach = POSITION_SLACK * amplitude * turn
        position = ((at - reach).tolist(), (at + reach).tolist())
        velocity = (SPEED_SLACK * speed * speed_turn).tolist()
    # A trial of gains may oscillate: it detects that and stops the environment by itself.
    oscillation = environment_of(environment_name(environment)) != "ServoDrive/GainTuning-v0"
    limits = Limits(position=position, velocity=velocity, oscillation=oscillation, stall=guard.stall)
    with on_bus(travel=FREE, safety=limits, **more) as target:
        yield target


def lower_profile_velocity(drives: Drives) -> None:
    """Lower 6081h if it is beyond the envelope's limit, which would refuse to restore it between episodes."""
    if not drives.safety:
        return
    limit = given(drives.safety.limits.velocity, drives.num_axes)
    now = drives.read(cia402.PROFILE_VELOCITY)
    if np.any(beyond := now > limit):  # nan, without a limit, compares false
        drives.write(cia402.PROFILE_VELOCITY, np.where(beyond, np.floor(limit), now).astype(np.int64), where=beyond)


def warm_up(environment: str, configuration: Mapping[str, Any]) -> None:
    """Compile the environment's kernels on an emulated machine; otherwise a policy would stall in its first step."""
    lanes = make_environments(environment, 1, _emulated(configuration))
    space: Any = lanes.action_space
    lanes.reset(seed=0)
    lanes.step(np.zeros(space.shape, np.float32))
    lanes.close()


def _emulated(configuration: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in configuration.items() if key not in OF_MACHINES}
