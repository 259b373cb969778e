"""What a bus does to set-points and measurements on their way: latency, jitter, lost SYNCs, in communication cycles.

In cycle k the master sends an action and the drives act on the newest that has arrived; the measurement of cycle k
sets out and the master sees the newest that has arrived. Messages do not overtake each other. Without a SYNC the drives
neither latch what has arrived nor sample: the last action goes on, the last measurement stands.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drive_env.envs.randomisation import shares_of_chance

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Marks of the chances that a cycle has; the cycle's number is added.
_LOST, _ACTION, _OBSERVATION = (np.uint64(k << 40) for k in (1, 2, 3))


class BusDelays:
    """The delays of every lane's bus; a lane's chance follows from its generator alone.

    Args:
        num_lanes: Lanes.
        deepest: Longest latency and jitter together that a lane can have [communication cycles].
    """

    def __init__(self, num_lanes: int, deepest: int = 8) -> None:
        self._keys = np.zeros(num_lanes, np.uint64)
        self._lost_sync = np.zeros(num_lanes)
        self._actions = _Line(num_lanes, deepest, _ACTION)
        self._observations = _Line(num_lanes, deepest, _OBSERVATION)
        self.is_there = False  # whether any lane's bus does anything: without, all arrives at once

    def reset(
        self,
        values: Mapping[str, Floats],
        rngs: Sequence[np.random.Generator],
        action: NDArray[Any],
        observation: NDArray[Any],
        where: Mask | None = None,
    ) -> None:
        """Begin anew in the lanes where the mask is true.

        Args:
            values: `RandomMachines.values`, of which those of the bus are used: "bus.action_latency",
                "bus.observation_latency", "bus.jitter" (the most that a message takes longer) [communication cycles],
                "bus.lost_sync" (probability per cycle); each of shape (num_lanes,).
            rngs: The lanes' generators; one number is taken from each lane's that begins.
            action: What acts until the first action arrives, shape (num_lanes, ...).
            observation: What is seen until the first measurement arrives, shape (num_lanes, ...).
            where: Lanes.

        Raises:
            ValueError: For delays deeper than these lines are, or negative ones.
        """
        mask = np.ones(len(self._keys), bool) if where is None else where
        for lane in map(int, np.flatnonzero(mask)):
            self._keys[lane] = rngs[lane].integers(0, 2**64, dtype=np.uint64)
        self._lost_sync[mask] = values["bus.lost_sync"][mask]
        if np.any((self._lost_sync < 0.0) | (self._lost_sync > 1.0)):
            raise ValueError(f"bus.lost_sync must lie in 0...1, not {self._lost_sync[mask].max():g}")
        jitter = values["bus.jitter"]
        self._actions.reset(values["bus.action_latency"], jitter, np.asarray(action), mask)
        self._observations.reset(values["bus.observation_latency"], jitter, np.asarray(observation), mask)
        self.is_there = bool(self._lost_sync.any()) or self._actions.is_there or self._observations.is_there

    def act(self, action: NDArray[Any]) -> NDArray[Any]:
        """Send an action in this cycle, shape (num_lanes, ...); return the one that the drives act on in it."""
        return self._actions.pass_on(action, self._keys, self._lost_sync) if self.is_there else action

    def act_unlatched(self, action: NDArray[Any]) -> NDArray[Any]:
        """Send what needs no SYNC to act, as an SDO does not: a lost one does not hold it up."""
        return self._actions.pass_on(action, self._keys, None) if self.is_there else action

    def observe(self, observation: NDArray[Any]) -> NDArray[Any]:
        """Let the drives sample in this cycle, shape (num_lanes, ...); return what the master has by its end."""
        return self._observations.pass_on(observation, self._keys, self._lost_sync) if self.is_there else observation


class _Line:
    """Messages under way of every lane, in one direction."""

    def __init__(self, num_lanes: int, deepest: int, mark: np.uint64) -> None:
        self._mark = mark
        self._deepest = deepest
        self._lanes = np.arange(num_lanes)
        self._cycle = np.zeros(num_lanes, np.int64)
        self._latency = np.zeros(num_lanes, np.int64)
        self._jitter = np.zeros(num_lanes, np.int64)
        self._arrivals = np.zeros((deepest + 1, num_lanes), np.int64)
        self._last_arrival = np.zeros(num_lanes, np.int64)
        self._messages: NDArray[Any] = np.zeros((deepest + 1, num_lanes))
        self._held: NDArray[Any] = np.zeros(num_lanes)
        self._turn = 0

    @property
    def is_there(self) -> bool:
        return bool(self._latency.any() or self._jitter.any())

    def reset(self, latency: Floats, jitter: Floats, first: NDArray[Any], where: Mask) -> None:
        if self._messages.shape[1:] != first.shape or self._messages.dtype != first.dtype:
            self._messages = np.zeros((self._deepest + 1, *first.shape), first.dtype)
            self._held = np.zeros_like(first)
        whole = np.rint(latency).astype(np.int64), np.rint(jitter).astype(np.int64)
        longest = (whole[0] + whole[1])[where]
        if longest.max() > self._deepest or min(whole[0][where].min(), whole[1][where].min()) < 0:
            raise ValueError(
                f"latency and jitter of a bus together are 0...{self._deepest} communication cycles here, not "
                f"{longest.max()}"
            )
        self._latency[where], self._jitter[where] = whole[0][where], whole[1][where]
        self._cycle[where] = 0
        self._last_arrival[where] = 0
        self._arrivals[:, where] = -1
        self._messages[:, where] = first[where]
        self._held[where] = first[where]

    def pass_on(self, message: NDArray[Any], keys: NDArray[np.uint64], lost_sync: Floats | None) -> NDArray[Any]:
        cycle, depth, lanes = self._cycle, self._deepest + 1, self._lanes
        number = cycle.astype(np.uint64)
        delay = self._latency + (shares_of_chance(keys, self._mark + number) * (self._jitter + 1)).astype(np.int64)
        self._last_arrival = np.maximum(self._last_arrival, cycle + delay)
        self._turn = (self._turn + 1) % depth
        self._messages[self._turn] = message
        self._arrivals[self._turn] = self._last_arrival
        newest_first = (self._turn - np.arange(depth)) % depth
        age = (self._arrivals[newest_first] <= cycle).argmax(axis=0)
        arrived: NDArray[Any] = self._messages[newest_first[age], lanes]
        if lost_sync is not None and lost_sync.any():
            lost = shares_of_chance(keys, _LOST + number) < lost_sync
            arrived[lost] = self._held[lost]
        self._held = arrived
        self._cycle = cycle + 1
        return arrived.copy()
