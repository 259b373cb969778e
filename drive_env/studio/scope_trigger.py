"""The trigger of a scope: an edge through a level, a change of state, a fault."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drive_env import cia402
from drive_env.cia402 import Key
from mechanics.arrays import Integers

EDGES = {"rising": "rising edge", "falling": "falling edge", "state": "change of state", "fault": "fault"}
# State by the low seven bits of a statusword; -1 for an invalid one.
_STATES = np.array([-1 if (state := cia402.state_of(word)) is None else int(state) for word in range(128)], np.int64)


@dataclass(frozen=True)
class ScopeTrigger:
    """The condition that starts a recording.

    Attributes:
        kind: A name of `EDGES`.
        axis: Axis of the object.
        key: The object; the statusword for a change of state and a fault.
        level: Raw value that an edge must pass; unused for other kinds.
    """

    kind: str
    axis: int
    key: Key = (cia402.STATUSWORD, 0)
    level: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in EDGES:
            raise ValueError(f"no trigger is named {self.kind!r}; there are {', '.join(EDGES)}")


def first_fired(trigger: ScopeTrigger, values: Integers) -> int | None:
    """Return the index of the first sample at which a trigger fires, None if it does not; never the first sample.

    Args:
        trigger: The trigger.
        values: Samples of its object on its axis, shape (n,).
    """
    if len(values) < 2:
        return None
    if trigger.kind == "rising":
        fires = (values[1:] >= trigger.level) & (values[:-1] < trigger.level)
    elif trigger.kind == "falling":
        fires = (values[1:] <= trigger.level) & (values[:-1] > trigger.level)
    elif trigger.kind == "state":
        states = _STATES[values & 0x7F]
        fires = states[1:] != states[:-1]
    else:
        faults = (values & cia402.FAULT_BIT.mask) != 0
        fires = faults[1:] & ~faults[:-1]
    found = np.flatnonzero(fires)
    return int(found[0]) + 1 if found.size else None
