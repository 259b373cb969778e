"""The greatest sensitivity Ms of loops with a policy in them, measured in the emulator.

Every episode is run twice with equal random numbers; in the second, a torque of many frequencies pushes one axis. The
difference of the motor's torque gives the response of the loops, drives and policy together: S = 1 + (difference of the
motor's torque) / push, with all other axes' loops closed. Neither a linear model nor knowledge of the policy is needed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from agents.policies.agent_file import AgentFile
from agents.policies.policy import policy_of
from agents.seeds import VALIDATION
from agents.tasks import environment_name, make_environments
from drive_env.emulator.emulated_drives import emulated_of
from drive_env.envs import environment_of
from drive_env.envs.tracking import Tracking
from drive_env.loops.dynamics import Dynamics
from drive_env.motors import find_motor
from mechanics.arrays import Complex, Floats

MACHINES = 32  # number of drawn machines
REPEATS = 4  # of every machine, with other trajectories and phases, to average out non-linear effects
SETTLING = 0.2  # beginning of an episode [s] that is left out, until the push is in steady state
LINES, LOWEST, HIGHEST = 40, 4.0, 0.3  # frequencies, from [Hz], to this share of the rate of actions
PUSH = 0.05  # of the motor's rated torque, root mean square
AXIS_ENTRIES, ERRORS = 8, (0, 1)  # of an axis in Tracking's observation: of them the errors of position and speed
SHARES = (1.0, 0.85, 0.7, 0.6, 0.5, 0.4, 0.3)  # shares of an agent's response to these errors that are tried


class Sensitivity(NamedTuple):
    """The loops of machines with a policy in them.

    frequencies: [Hz], shape (lines,).
    response: S of each machine and axis, complex, shape (machines, axes, lines); NaN where an episode ended early.
    """

    frequencies: Floats
    response: Complex

    @property
    def ms(self) -> Floats:
        """Greatest sensitivity of each machine and axis, shape (machines, axes); NaN where an episode ended early."""
        return np.asarray(np.abs(self.response).max(axis=2))


def measure_sensitivity(
    policy: Any,
    environment: str,
    configuration: Mapping[str, Any] | None = None,
    *,
    machines: int = MACHINES,
    seed: int = VALIDATION[0],
    told: Callable[[float], None] = lambda share: None,
) -> Sensitivity:
    """Measure the loops of drawn machines with a policy in them.

    Args:
        policy: The policy: `act(observations)`, `reset(mask)`.
        environment: Tracking or a task of it.
        configuration: Its options.
        machines: Number of drawn machines.
        seed: Seed of machines and trajectories.
        told: Called with the finished share.

    Raises:
        ValueError: For an environment whose actions are not set-points of each cycle.
    """
    name = environment_name(environment)
    if environment_of(name) != "ServoDrive/Tracking-v0":
        raise ValueError(f"a policy is part of the loops in Tracking and its tasks, not in {name}")
    lanes: Any = make_environments(name, machines, dict(configuration or {}), autoreset_mode="NextStep")
    try:
        measured = _Measured(lanes, policy, seed)
        sums: Any = 0.0
        runs, done = REPEATS * (1 + measured.axes), 0
        for repeat in range(REPEATS):
            calm, _ = measured.episode(repeat, None)
            rows = []
            for axis in range(measured.axes):
                pushed, push = measured.episode(repeat, axis)
                rows.append((pushed - calm)[:, :, axis] / push)
                done += 1 + (axis == 0)
                told(done / runs)
            sums = sums + np.stack(rows, axis=2)
        return Sensitivity(measured.frequencies, 1.0 + np.moveaxis(sums, 0, 2) / REPEATS)
    finally:
        lanes.close()


class NotKeptError(ValueError):
    """The loops with an agent in them violate the requirements; the message says by how much."""


def check_kept(found: Sensitivity, dynamics: Dynamics) -> None:
    """Raise NotKeptError unless every loop that was measured keeps the greatest sensitivity that dynamics allow."""
    ended, machines = np.isnan(found.ms).any(axis=1), len(found.ms)
    if ended.any():
        raise NotKeptError(
            f"on {ended.sum()} of {machines} machines an episode ended early: no margin holds there; train further"
        )
    if found.ms.max() > dynamics.ms:
        machine, axis = np.unravel_index(np.argmax(found.ms), found.ms.shape)
        at = found.frequencies[np.argmax(np.abs(found.response[machine, axis]))]
        raise NotKeptError(
            f"with the agent Ms is {found.ms.max():.2f} at {at:.0f} Hz on the worst of {machines} machines (axis "
            f"{axis}), and {dynamics.name} allows {dynamics.ms:g}; --out writes an agent that keeps it"
        )


def within(
    bundle: AgentFile, dynamics: Dynamics, told: Callable[[float], None] = lambda share: None
) -> tuple[AgentFile, Sensitivity]:
    """Return an agent that responds less to following errors, so that its loops keep the dynamics; and these loops.

    Its feed-forward is unchanged. Its card states the reduction.

    Raises:
        NotKeptError: If the loops violate the dynamics even with the smallest of SHARES.
    """
    for k, share in enumerate(SHARES):
        agent = _answering(bundle, share)

        def tell(part: float, k: int = k) -> None:
            told((k + part) / len(SHARES))

        found = measure_sensitivity(policy_of(agent), bundle.environment, bundle.configuration, told=tell)
        try:
            check_kept(found, dynamics)
            break
        except NotKeptError as error:
            if share == SHARES[-1]:
                raise NotKeptError(f"even with {share:g} of its answer to errors: {error}") from None
    margins = {"dynamics": dynamics.name, "answer to errors": share, "machines": len(found.ms), **figures(found)}
    return replace(agent, card={**bundle.card, "margins": margins}), found


def figures(found: Sensitivity) -> dict[str, float]:
    """Return median, 95th percentile and greatest of Ms over machines and axes."""
    values = np.quantile(found.ms, [0.5, 0.95, 1.0])
    return {name: float(value) for name, value in zip(("Ms median", "Ms 95 %", "Ms greatest"), values, strict=True)}


def _answering(bundle: AgentFile, share: float) -> AgentFile:
    """Return the agent with a share of its response to the errors of position and speed."""
    mean, scale = (np.array(bundle.arrays[f"observation_{name}"], float) for name in ("mean", "scale"))
    for axis in range(len(mean) // AXIS_ENTRIES):
        for entry in ERRORS:
            mean[AXIS_ENTRIES * axis + entry] /= share
            scale[AXIS_ENTRIES * axis + entry] *= share
    return replace(bundle, arrays={**bundle.arrays, "observation_mean": mean, "observation_scale": scale})


class _Measured:
    """Episodes of the same machines, with and without a push."""

    def __init__(self, lanes: Tracking, policy: Any, seed: int) -> None:
        self._lanes, self._policy, self._seed = lanes, policy, seed
        config = lanes.config
        self.axes = lanes.drives.num_axes // lanes.num_envs
        self._skipped = round(SETTLING * config.steps)
        window = config.steps - self._skipped
        highest = min(HIGHEST * config.rate, 0.5 * config.rate)
        wanted = np.geomspace(max(LOWEST, config.rate / window), highest, LINES)
        self._bins = np.unique(np.rint(wanted * window / config.rate).astype(int))
        self.frequencies = self._bins * config.rate / window
        motor = find_motor(config.motor)
        rated = motor.torque_constant * motor.rated_current
        self._amplitude = PUSH * rated * np.sqrt(2.0 / len(self._bins))
        self._machines = lanes.reset(seed=seed)[1]["parameters"]

    def episode(self, repeat: int, axis: int | None) -> tuple[Complex, Complex]:
        """Return lines of the motors' torque, shape (lines, machines, axes), and of the push, (lines, 1)."""
        lanes, config, everyone = self._lanes, self._lanes.config, np.ones(self._lanes.num_envs, bool)
        machine = emulated_of(lanes.drives).machine
        phases = np.random.default_rng((self._seed, repeat)).uniform(0.0, 2.0 * np.pi, len(self._bins))
        times = np.arange(config.steps) / config.rate
        push = self._amplitude * np.cos(2.0 * np.pi * np.outer(times, self.frequencies) + phases).sum(axis=1)
        torque = np.zeros((config.steps, lanes.num_envs, self.axes))
        ended = np.zeros(lanes.num_envs, bool)
        seen, info = lanes.reset(seed=self._seed + 1 + repeat, options={"machine": self._machines})
        self._policy.reset(None)
        if hasattr(self._policy, "told"):
            self._policy.told(info["parameters"], everyone)
        with machine.pushed() as pushing:
            for k in range(config.steps):
                if axis is not None:
                    pushing(np.tile(push[k] * (np.arange(self.axes) == axis), lanes.num_envs))
                torque[k] = machine.motor_torque.reshape(lanes.num_envs, self.axes)
                seen, _, terminated, _, _ = lanes.step(np.asarray(self._policy.act(seen), np.float32))
                ended |= terminated
        torque[:, ended] = np.nan
        held = np.sinc(self.frequencies / config.rate) * np.exp(-1j * np.pi * self.frequencies / config.rate)
        lines = np.fft.rfft(torque[self._skipped :], axis=0)[self._bins]
        return lines, (np.fft.rfft(push[self._skipped :])[self._bins] * held)[:, None]
