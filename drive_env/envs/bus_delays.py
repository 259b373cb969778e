"""Effects of a bus on set-points and measurements: latency, jitter, lost SYNCs, in communication cycles.

In cycle k the master sends an action and the drives act on the newest that has arrived; the measurement of cycle k is
sent, and the master sees the newest that has arrived. Messages do not overtake each other. Without a SYNC the drives
neither apply arrived actions nor sample: the last action and measurement stay.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from drive_env.saved_state import Saved
from mechanics.arrays import Floats, Mask
from mechanics.kernels.bundle import Bundle, Cube, Matrix, NumberMatrix, Numbers, Vector, reader
from mechanics.kernels.compiled import cached, inlined, stage

# Marks of a cycle's random numbers; the cycle's number is added.
_LOST, _ACTION, _OBSERVATION = (k << 40 for k in (1, 2, 3))


class BusDelays(Saved):
    """The delays of every environment's bus; an environment's random numbers follow only from its generator.

    Args:
        num_envs: Number of environments.
        deepest: Largest possible sum of latency and jitter [communication cycles].

    Compiled code calls `pass_on` with the lines' addresses.
    """

    STATE = ("actions", "observations", "is_there")

    def __init__(self, num_envs: int, deepest: int = 8) -> None:
        self._keys = np.zeros(num_envs, np.uint64)
        self._lost_sync = np.zeros(num_envs)
        self.actions = _new_line(_ACTION, self._keys, self._lost_sync, deepest)
        self.observations = _new_line(_OBSERVATION, self._keys, self._lost_sync, deepest)
        self.is_there = False  # whether any environment's bus delays or loses anything: if not, all arrives at once

    def reset(
        self,
        values: Mapping[str, Floats],
        rngs: Sequence[np.random.Generator],
        action: NDArray[Any],
        observation: NDArray[Any],
        where: Mask | None = None,
    ) -> None:
        """Restart the environments where the mask is true.

        Args:
            values: `RandomMachines.values`, of which the bus uses "bus.action_latency", "bus.observation_latency",
                "bus.jitter" (largest additional delay of a message) [communication cycles], "bus.lost_sync"
                (probability per cycle); each of shape (num_envs,).
            rngs: The environments' generators; one number is taken from that of each starting environment.
            action: Acts until the first action arrives, shape (num_envs, ...).
            observation: Seen until the first measurement arrives, shape (num_envs, ...).
            where: Environments.

        Raises:
            ValueError: For negative delays, or larger ones than `deepest`.
        """
        mask = np.ones(len(self._keys), bool) if where is None else where
        for lane in map(int, np.flatnonzero(mask)):
            self._keys[lane] = rngs[lane].integers(0, 2**64, dtype=np.uint64)
        self._lost_sync[mask] = values["bus.lost_sync"][mask]
        if np.any((self._lost_sync < 0.0) | (self._lost_sync > 1.0)):
            raise ValueError(f"bus.lost_sync must lie in 0...1, not {self._lost_sync[mask].max():g}")
        jitter = values["bus.jitter"]
        self.actions.reset(values["bus.action_latency"], jitter, np.asarray(action), mask)
        self.observations.reset(values["bus.observation_latency"], jitter, np.asarray(observation), mask)
        self.is_there = bool(self._lost_sync.any()) or self.actions.is_there or self.observations.is_there

    def act(self, actions: NDArray[Any]) -> NDArray[Any]:
        """Send actions of some cycles, shape (cycles, num_envs, ...); return those that the drives apply in each."""
        return self.actions.pass_on(actions) if self.is_there else actions

    def act_unlatched(self, actions: NDArray[Any]) -> NDArray[Any]:
        """Send actions that need no SYNC to act, such as SDO writes: a lost SYNC does not delay them."""
        return self.actions.pass_on(actions, latched=False) if self.is_there else actions

    def observe(self, observations: NDArray[Any]) -> NDArray[Any]:
        """Return the observations that have reached the master by the ends of some cycles, (cycles, num_envs, ...)."""
        return self.observations.pass_on(observations) if self.is_there else observations


@dataclass(eq=False)
class Line(Bundle):
    """Messages under way of every environment in one direction, as doubles, which hold all integers of 32 bits."""

    keys: Annotated[NDArray[np.uint64], types.uint64[::1]]  # of random numbers, (num_envs,)
    mark: int  # of this direction's random numbers
    lost_sync: Vector  # probability per cycle, (num_envs,)
    latency: Numbers  # [communication cycles]
    jitter: Numbers
    cycle: Numbers  # of each environment, counted since its reset
    last_arrival: Numbers
    arrivals: NumberMatrix  # of the last messages, (num_envs, depth)
    messages: Cube  # (num_envs, depth, width)
    held: Matrix  # the arrived message, (num_envs, width)

    @property
    def is_there(self) -> bool:
        """Whether this direction of any environment delays anything."""
        return bool(self.latency.any() or self.jitter.any())

    def reset(self, latency: Floats, jitter: Floats, first: NDArray[Any], where: Mask) -> None:
        """Restart environments with the message that counts before the first; ValueError for delays beyond `depth`."""
        lanes, width, depth = len(where), first[0].size, self.arrivals.shape[1]
        if self.held.shape[1] != width:
            self.replace(messages=np.zeros((lanes, depth, width)), held=np.zeros((lanes, width)))
        whole = np.rint(latency).astype(np.int64), np.rint(jitter).astype(np.int64)
        longest = (whole[0] + whole[1])[where]
        if longest.max() >= depth or min(whole[0][where].min(), whole[1][where].min()) < 0:
            raise ValueError(
                f"latency and jitter of a bus together are 0...{depth - 1} communication cycles here, not "
                f"{longest.max()}"
            )
        self.latency[where], self.jitter[where] = whole[0][where], whole[1][where]
        self.cycle[where] = 0
        self.last_arrival[where] = 0
        self.arrivals[where] = -1
        begun = np.asarray(first, float).reshape(lanes, width)
        self.messages[where] = begun[where, None]
        self.held[where] = begun[where]

    def pass_on(self, messages: NDArray[Any], latched: bool = True) -> NDArray[Any]:
        """Send messages in cycles, shape (cycles, num_envs, ...); return those that have arrived by each cycle."""
        sent = np.ascontiguousarray(messages, float).reshape(*messages.shape[:2], -1)
        arrived = np.empty_like(sent)
        _pass_rows_on(self.address, sent, arrived, latched)
        return arrived.reshape(messages.shape).astype(messages.dtype)


def _new_line(mark: int, keys: NDArray[np.uint64], lost_sync: Floats, deepest: int) -> Line:
    lanes, depth = len(keys), deepest + 1
    latency, jitter, cycle, last_arrival = (np.zeros(lanes, np.int64) for _ in range(4))
    return Line(
        keys, mark, lost_sync, latency, jitter, cycle, last_arrival, np.zeros((lanes, depth), np.int64),
        np.zeros((lanes, depth, 1)), np.zeros((lanes, 1)),
    )  # fmt: skip


# --- compiled ---------------------------------------------------------------------------------------------------------
line_at = reader(Line)


@inlined
def _share(key: Any, mark: Any) -> Any:
    """Return `randomisation.shares_of_chance` of one key and one mark."""
    z = key + np.uint64(mark) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return np.float64(z >> np.uint64(11)) * 2.0**-53


@stage
def pass_on(line: Any, lane: Any, message: Any, latched: Any) -> None:
    """Begin a cycle of an environment with a message, shape (width,); `line.held` becomes the last arrived one."""
    held, latency, jitter, lost = line.held, line.latency[lane], line.jitter[lane], line.lost_sync[lane]
    if latency == 0 and jitter == 0 and (lost == 0.0 or not latched):
        for part in range(message.shape[0]):
            held[lane, part] = message[part]
        line.cycle[lane] += 1
        return
    arrivals, messages, last_arrival, key = line.arrivals, line.messages, line.last_arrival, line.keys[lane]
    depth = arrivals.shape[1]
    now = line.cycle[lane]
    line.cycle[lane] = now + 1
    late = latency
    if jitter > 0:
        late += np.int64(_share(key, line.mark + now) * (jitter + 1))
    last_arrival[lane] = max(last_arrival[lane], now + late)
    place = now % depth
    arrivals[lane, place] = last_arrival[lane]
    for part in range(message.shape[0]):
        messages[lane, place, part] = message[part]
    if latched and lost > 0.0 and _share(key, _LOST + now) < lost:
        return
    while arrivals[lane, place] > now:
        place = place - 1 if place > 0 else depth - 1
    for part in range(message.shape[0]):
        held[lane, part] = messages[lane, place, part]


@cached(allocates=False)
def _pass_rows_on(address: Any, sent: Any, arrived: Any, latched: Any) -> None:
    line = line_at(address)
    for lane in range(sent.shape[1]):
        for k in range(sent.shape[0]):
            pass_on(line, lane, sent[k, lane], latched)
            for part in range(sent.shape[2]):
                arrived[k, lane, part] = line.held[lane, part]
