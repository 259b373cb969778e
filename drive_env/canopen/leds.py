"""The two LEDs of a node: run, green, and error, red (CiA 303-3).

Devices do not show patterns that are missing in the table: "triple flash" (SYNC error). While LSS configures a node or
the node waits for it, both LEDs flicker.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable
from typing import NamedTuple

from drive_env.canopen.nmt import NmtState

# Seconds on and off alternately, beginning with on; an empty pattern is permanently on or off.
PATTERNS: dict[str, tuple[float, ...]] = {
    "off": (),
    "on": (),
    "flickering": (0.05, 0.05),
    "blinking": (0.2, 0.2),
    "single flash": (0.2, 1.0),
    "double flash": (0.2, 0.2, 0.2, 1.0),
}
RUN = {
    NmtState.INITIALISING: "off",
    NmtState.PRE_OPERATIONAL: "blinking",
    NmtState.STOPPED: "single flash",
    NmtState.OPERATIONAL: "on",
}
WARNING_LIMIT = 96  # of the controller's error counter (ISO 11898-1)


class Leds(NamedTuple):
    """Patterns of both LEDs, by name."""

    run: str
    error: str


def leds_of(
    state: NmtState, is_bus_off: bool, conditions: Collection[Hashable], error_counter: int, is_lss: bool = False
) -> Leds:
    """Return the LEDs of a node; of several errors the most serious is shown.

    Args:
        state: NMT state.
        is_bus_off: Whether its controller has left the bus.
        conditions: Lasting errors; only "guarding" and ("heartbeat", node) count.
        error_counter: Its controller's error counter.
        is_lss: Whether it has no node-ID, or LSS configures it.
    """
    if is_lss and not is_bus_off:
        return Leds("flickering", "flickering")
    watched = any(key == "guarding" or (isinstance(key, tuple) and key[0] == "heartbeat") for key in conditions)
    if is_bus_off:
        return Leds(RUN[state], "on")
    if watched:
        return Leds(RUN[state], "double flash")
    return Leds(RUN[state], "single flash" if error_counter >= WARNING_LIMIT else "off")


def is_lit(pattern: str, time: float) -> bool:
    """Return whether an LED with that pattern is lit at a time [s] since the pattern began."""
    parts = PATTERNS[pattern]
    if not parts:
        return pattern == "on"
    left = time % sum(parts)
    for k, part in enumerate(parts):
        if left < part:
            return k % 2 == 0
        left -= part
    return False
