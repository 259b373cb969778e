"""Baselines that an agent must beat, as policies, by name: `drive-agent evaluate feed_forward --environment tracking`.

`nothing` is the drive's own cascade, or the baseline rule's gains; `surrogate` is the shipped tuner. The others are
identified feed-forward: the constants below gave the least mean following error over 64 machines drawn from the load's
distribution.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from agents.policies.experts import (
    CarriageServo,
    ComputedTorque,
    HighestSpeed,
    LeadAndFeedback,
    LoadAngle,
    MarginDesign,
    PayloadSchedule,
    Pendulum,
    SwingUp,
    TorqueCascade,
    nominal,
)
from agents.tasks import environment_name
from mechanics.arrays import Singles

AXIS_ENTRIES = 8  # of an axis in Tracking's observation
ERROR, SPEED, SPEED_LATER = 0, 5, 6
PREVIEW = 0.01  # s, time until the later reference
# The commissioned cascade's lag behind its reference: times velocity [s], about 1/k_v, and times acceleration [s^2], of
# the velocity loop and the bus.
LAG = (0.030, 3e-4)
LAGS = {"gantry": (0.032, 4e-4)}  # of loads with another lag
GAIN = 60.0  # 1/s, k_v of a position loop in the master
ACCELERATION_TIME = 0.010  # s, the lag of the commissioned velocity loop
# Entry of Tracking's observation of inverted_pendulum -> weight: position, velocity, angle and its rate. Found by the
# cross-entropy method (examples/own_algorithm.py) over machines drawn from the load's distribution.
BALANCE = {2: 0.44, 3: 0.57, 8: 5.3, 9: 0.33}


def nothing(axes: int) -> Any:
    """Return the policy whose actions are 0."""
    return ControlLaw(lambda rows: np.zeros((len(rows), axes)))


class ControlLaw:
    """A function of observations, shape (environments, entries), as a policy."""

    def __init__(self, function: Any) -> None:
        self._function = function

    def act(self, observation: Any) -> Singles:
        """Return the action for one observation, or one for each environment."""
        action = np.clip(self._function(np.atleast_2d(observation)), -1.0, 1.0).astype(np.float32)
        found: Singles = action[0] if np.ndim(observation) == 1 else action
        return found

    def reset(self, mask: Any = None) -> None:
        """Do nothing."""


def state_feedback(configuration: Any) -> ControlLaw:
    """Return the law that balances the inverted pendulum in cst: BALANCE times the state; ValueError elsewhere."""
    if configuration.load != "inverted_pendulum" or configuration.mode != "cst" or configuration.action != "direct":
        raise ValueError(
            "the baseline state_feedback is for load inverted_pendulum, mode cst and action direct alone; here they "
            f"are {configuration.load}, {configuration.mode} and {configuration.action}: give a baseline of this task "
            "(nothing, or feed_forward with action = 'offset')"
        )
    entries, weights = list(BALANCE), np.array(list(BALANCE.values()))
    return ControlLaw(lambda rows: (rows[:, entries] @ weights)[:, None])


def feed_forward(configuration: Any, lags: Any = None) -> ControlLaw:
    """Return the identified feed-forward for a configuration of Tracking; ValueError unless its action is the offset.

    csp: 60B0h leads by the lags, those of the load or given ones, each a number or of shape (environments, axes). csv:
    a position loop in the master, and 60B1h adds the velocity for the acceleration. In cst it is 0: the profile already
    is the current.
    """
    mode, offset = configuration.mode, configuration.offset
    if configuration.action != "offset":
        raise ValueError(
            f"the baseline feed_forward adds to the profile, and action is {configuration.action!r}: give a --config "
            "file with action = 'offset' (in Python the environment's option), or the baseline nothing"
        )
    speed, amplitude = configuration.speed, configuration.amplitude
    lag, lag_of_speed = LAGS.get(str(configuration.load), LAG) if lags is None else lags

    def rows_of(observation: Any) -> Any:
        count = np.shape(observation)[-1] // AXIS_ENTRIES
        return np.asarray(observation)[:, : AXIS_ENTRIES * count].reshape(-1, count, AXIS_ENTRIES)

    def lead(observation: Any) -> Any:
        rows = rows_of(observation)
        wanted = lag * rows[:, :, SPEED] * speed + lag_of_speed * acceleration_of(rows)
        return wanted / (1.25 * offset * amplitude)

    def loop(observation: Any) -> Any:
        rows = rows_of(observation)
        wanted = GAIN * rows[:, :, ERROR] * amplitude + ACCELERATION_TIME * acceleration_of(rows)
        return wanted / (1.25 * offset * speed)

    def acceleration_of(rows: Any) -> Any:
        return (rows[:, :, SPEED_LATER] - rows[:, :, SPEED]) * speed / PREVIEW

    return ControlLaw({"csp": lead, "csv": loop}.get(mode, lambda rows: np.zeros(rows_of(rows).shape[:2])))


def surrogate(configuration: Any) -> Any:
    """Return the shipped tuner for a configuration of GainTuning; ValueError if it was trained for another one."""
    from agents.policies.agent_file import AgentFile
    from agents.policies.policy import policy_of
    from agents.shipped import TUNER, shipped

    bundle = AgentFile.load(shipped(TUNER))
    own = tuple(bundle.configuration["gains"])
    if tuple(configuration.gains) != own or configuration.waveform:
        raise ValueError(
            f"the baseline surrogate changes the gains {', '.join(own)} and observes no waveform, and here gains are "
            f"{', '.join(configuration.gains)} and waveform is {configuration.waveform}: configure these gains, and "
            "waveform = 0"
        )
    return policy_of(replace(bundle, settings={**bundle.settings, "step": configuration.step}))


# Environment -> name of a baseline -> function that makes it from configuration and number of actions.
BASELINES: dict[str, dict[str, Any]] = {
    "ServoDrive/GainTuning-v0": {
        "nothing": lambda configuration, actions: nothing(actions),
        "surrogate": lambda configuration, actions: surrogate(configuration),
    },
    "ServoDrive/GainScheduling-v0": {"nothing": lambda configuration, actions: nothing(actions)},
    "ServoDrive/Tracking-v0": {
        "nothing": lambda configuration, actions: nothing(actions),
        "feed_forward": lambda configuration, actions: feed_forward(configuration),
        "state_feedback": lambda configuration, actions: state_feedback(configuration),
    },
}


# Task of the suite -> name of a baseline -> function that makes it. A baseline that cannot act has no row: a drive that
# follows a profile cannot be held at rest by an offset, and no cascade balances a pole. In a tuning the cascade is that
# of the commissioned drive. Where the expert is told the machine's parameters, `nominal` is the same one without them.
SUITE_TASKS: dict[str, dict[str, Any]] = {
    "ServoDrive/TorqueTracking-v1": {
        "rest": nothing,
        "cascade": TorqueCascade,
        "expert": ComputedTorque,
        "nominal": nominal(ComputedTorque),
    },
    "ServoDrive/GantryBeam-v1": {"cascade": nothing, "expert": LeadAndFeedback},
    "ServoDrive/Crane-v1": {
        "rest": nothing,
        "cascade": CarriageServo,
        "expert": Pendulum,
        "nominal": nominal(Pendulum),
    },
    "ServoDrive/PoleBalance-v1": {"rest": nothing, "expert": Pendulum, "nominal": nominal(Pendulum)},
    "ServoDrive/PoleSwingUp-v1": {"rest": nothing, "expert": SwingUp, "nominal": nominal(SwingUp)},
    "ServoDrive/ArmPath-v1": {"cascade": nothing, "expert": LeadAndFeedback},
    "ServoDrive/StepperRun-v1": {"rest": nothing, "expert": LoadAngle, "oracle": HighestSpeed},
    "ServoDrive/PayloadScheduling-v1": {
        "cascade": nothing,
        "expert": PayloadSchedule,
        "nominal": nominal(PayloadSchedule),
    },
    "ServoDrive/KnownPayload-v1": {"cascade": nothing, "expert": PayloadSchedule},
    "ServoDrive/ServoTuning-v1": {"cascade": nothing, "expert": MarginDesign},
    "ServoDrive/AmplifierTuning-v1": {"cascade": nothing, "expert": MarginDesign},
}


def baselines_of(environment: str) -> dict[str, Any]:
    """Return the baselines of an environment or task by name: functions of configuration and actions."""
    name = environment_name(environment)
    if name not in SUITE_TASKS:
        return BASELINES[name]
    return {
        row: (lambda configuration, actions, made=made: made(actions if made is nothing else configuration))
        for row, made in SUITE_TASKS[name].items()
    }


def baseline(name: str, environment: str, configuration: Any, actions: int) -> Any:
    """Return a baseline of an environment by name.

    Raises:
        ValueError: If it has no baseline of that name.
    """
    rows = baselines_of(environment)
    if name not in rows:
        raise ValueError(f"{environment} has no baseline {name!r}; it has {', '.join(rows)}")
    return rows[name](configuration, actions)
