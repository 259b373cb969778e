"""Begin and end of a fault: after a time or on a condition, for a duration or for ever; and its form as one line."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass, field

from drive_env.faults.table import FaultRow

NO_CONDITION, ENABLED = "", "enabled"
_COMPARISON = re.compile(r"\s*(position|speed)\s*([<>])\s*(\S+)\s*")
_WORDS = ("at", "when", "duration", "node", "axis")


@dataclass(frozen=True)
class Condition:
    """The condition of a fault; true if it holds on any axis of the fault.

    quantity: "enabled": operation enabled. "position": true rotor angle [rad]; "speed": magnitude of the true rotor
        speed [rad/s]; both are compared with `limit`. "" means no condition.
    above: True if the quantity must be above the limit, False if below.
    """

    quantity: str = NO_CONDITION
    above: bool = True
    limit: float = 0.0

    @classmethod
    def parse(cls, text: str) -> Condition:
        """Parse a condition: "enabled", or a comparison such as "speed > 100" or "position < -3.5".

        Raises:
            ValueError: For any other text.
        """
        if text.strip() in (NO_CONDITION, ENABLED):
            return cls(text.strip())
        match = _COMPARISON.fullmatch(text)
        try:
            limit = float(match[3]) if match else math.nan
        except ValueError:
            limit = math.nan
        if match is None or not math.isfinite(limit):
            raise ValueError(
                f"when={text!r} is not a condition; use 'enabled', or compare position [rad] or speed [rad/s] of the "
                "rotor with a number, as 'speed > 100'"
            )
        return cls(match[1], match[2] == ">", limit)


NEVER = 2**62  # a cycle number that is never reached


@dataclass(frozen=True)
class Order:
    """A requested fault, as `machine.fault` takes it; on a bus `axis` is the number of the axis in its `node`."""

    name: str
    at: float = 0.0
    when: str = NO_CONDITION
    duration: float | None = None
    node: int | None = None
    axis: int | None = None
    parameters: dict[str, float] = field(default_factory=dict)


def cycles_of(order: Order, row: FaultRow, cycles: Callable[[float], int]) -> tuple[int, int]:
    """Convert delay and duration of a fault to communication cycles; `cycles` converts a time [s].

    Raises:
        ValueError: If a time is not a whole number of cycles, or a fault without duration is given one.
    """
    if order.duration is not None and row.once:
        raise ValueError(f"fault {row.name} is a moment and has no duration; leave duration out")
    length = NEVER if order.duration is None else cycles(order.duration)
    if length < 1:
        raise ValueError(f"fault {row.name}: duration=0 s must be 0.001 s or more")
    return cycles(order.at), length


def parse_order(text: str) -> Order:
    """Parse one line of text: the fault's name, then at=2 duration=0.1 when="speed > 100" node=1 share=0.2.

    Raises:
        ValueError: If the syntax is wrong; the values themselves are checked by `machine.fault`.
    """
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise ValueError(f"fault {text!r}: {error}") from None
    if not words or "=" in words[0]:
        raise ValueError(f"fault {text!r} must begin with its name, as 'encoder_stuck at=2 duration=0.1'")
    when, numbers = NO_CONDITION, {}
    for word in words[1:]:
        key, equals, value = word.partition("=")
        if not equals:
            raise ValueError(f"fault {text!r}: {word!r} must be as at=2; keys are {', '.join(_WORDS)} and parameters")
        if key == "when":
            when = value
            continue
        try:
            numbers[key] = float(value)
        except ValueError:
            raise ValueError(f"fault {text!r}: {key} must be a number, not {value!r}") from None
    places = {key: numbers.pop(key, None) for key in ("node", "axis")}
    for key, place in places.items():
        if place is not None and not place.is_integer():
            raise ValueError(f"fault {text!r}: {key} must be a whole number, not {place:g}")
    node, axis = (None if place is None else int(place) for place in places.values())
    at, duration = numbers.pop("at", 0.0), numbers.pop("duration", None)
    return Order(words[0], at, when, duration, node, axis, parameters=numbers)
