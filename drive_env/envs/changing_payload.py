"""A payload that changes while machines run: the parameter of the load, its times and values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from drive_env.envs.vector_environment import check_choice
from drive_env.saved_state import Saved
from mechanics.arrays import Floats, Integers, Mask

if TYPE_CHECKING:
    from drive_env.emulator.machine import Machines
    from mechanics.load import Load


PAYLOADS = ("load.payload", "load.mass", "load.inertia")  # candidates for "auto": the first that the load has
NO_PAYLOAD = "none"


class Payload(NamedTuple):
    """The changing parameter, or "none", and the range of its factor on the nominal value."""

    name: str
    low: float
    high: float


def find_payload(load: Load, chosen: str, low: float | None, high: float | None) -> Payload:
    """Return the payload of a load: the changing parameter and its range.

    Args:
        load: The load.
        chosen: A parameter's name; "auto" for the load's payload, mass or inertia, "none": no change.
        low: Lower end of the factor's range; None: the load's own.
        high: Upper end, likewise.

    Raises:
        ValueError: For an unknown parameter, naming the known ones, or an invalid range.
    """
    known = [f"load.{p.name}" for p in load.parameters]
    name = next((n for n in PAYLOADS if n in known), NO_PAYLOAD) if chosen == "auto" else chosen
    if name == NO_PAYLOAD:
        return Payload(name, 1.0, 1.0)
    check_choice("payload", name, ("auto", NO_PAYLOAD, *known))
    row = load.parameters[known.index(name)]
    low = row.low if low is None else low
    high = row.high if high is None else high
    if not 0.0 < low <= high < np.inf:
        raise ValueError(f"payload_low and payload_high must be above 0 and in order, not {low:g} and {high:g}")
    return Payload(name, low, high)


class PayloadChanges(Saved):
    """The times and values of each machine's payload in an episode: one change in each of `count` equal parts.

    Args:
        payload: The changing parameter.
        machines: Emulated machines, one per environment, with the nominal value.
        num_envs: Number of environments.
        steps: Steps of an episode.
        count: Changes in an episode.

    Attributes:
        nominal: The payload's value at a factor of 1, shape (num_envs,); only with a payload.
        at: Step of each change, shape (num_envs, count).
        factor: New factor on the nominal value, shape (num_envs, count).
    """

    STATE = ("at", "factor")

    def __init__(self, payload: Payload, machines: Machines, num_envs: int, steps: int, count: int) -> None:
        self._payload = payload
        self._machines = machines
        self._steps = steps
        if payload.name != NO_PAYLOAD:
            self.nominal = machines.parameters[payload.name]
        self.at = np.zeros((num_envs, count), np.int64)
        self.factor = np.ones((num_envs, count))

    def draw(self, rngs: Sequence[np.random.Generator], where: Mask) -> None:
        """Draw new changes for the environments where the mask is true."""
        _, low, high = self._payload
        count = self.at.shape[1]
        for lane in map(int, np.flatnonzero(where)):
            chance = rngs[lane].random((2, count))
            self.at[lane] = np.floor((np.arange(count) + chance[0]) / count * self._steps)
            self.factor[lane] = low * (high / low) ** chance[1]

    def apply(self, now: Integers, parameters: dict[str, Floats]) -> dict[str, Floats]:
        """Change the payload of environments in which a change is due, unless the new machine could not be stepped.

        Args:
            now: The environments' present step, shape (num_envs,).
            parameters: The true machines before.

        Returns:
            The true machines after.
        """
        name = self._payload.name
        due = self.at == now[:, None]
        lanes = due.any(axis=1)
        if name == NO_PAYLOAD or not lanes.any():
            return parameters
        last = self.at.shape[1] - 1 - due[:, ::-1].argmax(axis=1)
        factors = np.take_along_axis(self.factor, last[:, None], axis=1)[:, 0]
        values = self.nominal * factors
        try:
            self._machines.set_all({name: values}, lanes)
        except ValueError:
            for lane in np.flatnonzero(lanes):
                one_lane = np.arange(len(lanes)) == lane
                try:
                    self._machines.set_all({name: values}, one_lane)
                except ValueError:
                    lanes[lane] = False
        return parameters | {name: np.where(lanes, values, parameters[name])}
