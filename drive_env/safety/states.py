"""What a statusword says of an axis that matters to whoever must stop it (CiA 402, state coding)."""

from __future__ import annotations

from typing import Any

# Mask and value. In these states the power stage is on, or may be.
OPERATION_ENABLED, QUICK_STOP_ACTIVE, FAULT_REACTION_ACTIVE = (0x6F, 0x27), (0x6F, 0x07), (0x4F, 0x0F)
SWITCH_ON_DISABLED, FAULT, NOT_READY = (0x4F, 0x40), (0x4F, 0x08), (0x4F, 0x00)
LIVE = (OPERATION_ENABLED, QUICK_STOP_ACTIVE, FAULT_REACTION_ACTIVE)

ENABLE_OPERATION, SWITCH_ON, SHUTDOWN, QUICK_STOP, DISABLE_VOLTAGE = 0x0F, 0x07, 0x06, 0x02, 0x00


def matches(status: Any, state: tuple[int, int]) -> Any:
    """Return where a statusword shows a state; an integer or an array."""
    return status & state[0] == state[1]


def is_live(status: Any) -> Any:
    """Return where a statusword shows that the power stage may be on."""
    return matches(status, LIVE[0]) | matches(status, LIVE[1]) | matches(status, LIVE[2])


def is_disabled(status: Any) -> Any:
    """Return where a statusword shows a state that no single controlword takes to operation enabled."""
    return matches(status, SWITCH_ON_DISABLED) | matches(status, FAULT) | matches(status, NOT_READY)


def leads_on(words: Any) -> Any:
    """Return where a controlword takes an axis that is off a step towards operation enabled."""
    return (words & 0x87 == SHUTDOWN) | (words & 0x8F == SWITCH_ON)


def may_enable(words: Any) -> Any:
    """Return where a controlword can bring an axis into operation enabled, or keep it there."""
    return words & 0x0F == ENABLE_OPERATION


def cuts_voltage(words: Any) -> Any:
    """Return where a controlword takes the voltage away at once: disable voltage, shutdown."""
    return (words & 0x82 == DISABLE_VOLTAGE) | (words & 0x87 == SHUTDOWN)
