"""What an agent must beat, as policies, by name: `drive-agent evaluate feed_forward --environment tracking`.

`nothing` is the drive's own cascade, or the fitted rule's gains. The others are feed-forward as one identifies it: the
constants below gave the least mean following error over 64 machines drawn from the load's distribution.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.tasks import environment_name

Array = NDArray[np.float32]
AXIS_ENTRIES = 8  # of an axis in Tracking's observation
ERROR, SPEED, SPEED_LATER = 0, 5, 6
PREVIEW = 0.01  # s, how much later
LEAD = 0.03  # s, the lag of the commissioned cascade: about 1/k_v
GAIN = 40.0  # 1/s, k_v of a position loop in the master
ACCELERATION_TIME = 0.008  # s, the lag of the commissioned velocity loop
# Entry of Tracking's observation of inverted_pendulum -> weight: position, velocity, angle and its rate. Found by the
# cross-entropy method (examples/own_algorithm.py) over machines drawn from the load's distribution.
BALANCE = {2: 0.44, 3: 0.57, 8: 5.3, 9: 0.33}


def nothing(axes: int) -> Any:
    """Return the policy of so many actions that adds nothing."""
    return Law(lambda rows: np.zeros((len(rows), axes)))


class Law:
    """A function of observations, shape (lanes, entries), as a policy."""

    def __init__(self, function: Any) -> None:
        self._function = function

    def act(self, observation: Any) -> Array:
        """Return the action for one observation, or one for each lane."""
        action = np.clip(self._function(np.atleast_2d(observation)), -1.0, 1.0).astype(np.float32)
        found: Array = action[0] if np.ndim(observation) == 1 else action
        return found

    def reset(self, mask: Any = None) -> None:
        """Do nothing."""


def state_feedback(configuration: Any) -> Law:
    """Return the law that holds the inverted pendulum through cst: BALANCE on its state."""
    if configuration.load != "inverted_pendulum" or configuration.mode != "cst" or configuration.action != "direct":
        raise ValueError("state_feedback holds the load inverted_pendulum in mode cst with action = 'direct'")
    entries, weights = list(BALANCE), np.array(list(BALANCE.values()))
    return Law(lambda rows: (rows[:, entries] @ weights)[:, None])


def feed_forward(configuration: Any) -> Law:
    """Return the identified feed-forward for a configuration of Tracking whose action is the offset.

    csp: 60B0h leads by LEAD times the velocity. csv: a position loop in the master, and through 60B1h the velocity that
    the acceleration needs besides. Of cst it is nothing: its profile is the current already.
    """
    mode, offset = configuration.mode, configuration.offset
    if configuration.action != "offset":
        raise ValueError("the baselines of Tracking add to the profile: configure action = 'offset'")
    speed, amplitude = configuration.speed, configuration.amplitude

    def rows_of(observation: Any) -> Any:
        count = np.shape(observation)[-1] // AXIS_ENTRIES
        return np.asarray(observation)[:, : AXIS_ENTRIES * count].reshape(-1, count, AXIS_ENTRIES)

    def lead(observation: Any) -> Any:
        return rows_of(observation)[:, :, SPEED_LATER] * speed * LEAD / (1.25 * offset * amplitude)

    def loop(observation: Any) -> Any:
        rows = rows_of(observation)
        acceleration = (rows[:, :, SPEED_LATER] - rows[:, :, SPEED]) * speed / PREVIEW
        wanted = GAIN * rows[:, :, ERROR] * amplitude + ACCELERATION_TIME * acceleration
        return wanted / (1.25 * offset * speed)

    return Law({"csp": lead, "csv": loop}.get(mode, lambda rows: np.zeros(rows_of(rows).shape[:2])))


# Environment -> name of a baseline -> what makes it from configuration and number of actions.
BASELINES: dict[str, dict[str, Any]] = {
    "ServoDrive/GainTuning-v0": {"nothing": lambda configuration, actions: nothing(actions)},
    "ServoDrive/GainScheduling-v0": {"nothing": lambda configuration, actions: nothing(actions)},
    "ServoDrive/Tracking-v0": {
        "nothing": lambda configuration, actions: nothing(actions),
        "feed_forward": lambda configuration, actions: feed_forward(configuration),
        "state_feedback": lambda configuration, actions: state_feedback(configuration),
    },
}


def baseline(name: str, environment: str, configuration: Any, actions: int) -> Law:
    """Return a baseline of an environment by name.

    Raises:
        ValueError: If it has none of that name.
    """
    rows = BASELINES[environment_name(environment)]
    if name not in rows:
        raise ValueError(f"{environment} has no baseline {name!r}; it has {', '.join(rows)}")
    found: Law = rows[name](configuration, actions)
    return found
