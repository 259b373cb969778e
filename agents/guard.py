"""A watch over a policy that acts on drives: one that gives no number, sticks at its limit or stalls is stopped.

The safety envelope of a bus watches what the drives do; this watches what acts. While a policy stalls, the envelope's
own thread quick-stops the drives (`Limits(stall=...)`); when it comes back at last, or does otherwise what it must not,
`stop` brings the drives to rest and leaves them disabled.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.policy import PolicyError
from drive_env import motion
from drive_env.gains import GAIN_OBJECTS

logger = logging.getLogger(__name__)

AT_LIMIT = 0.999  # of the action's range: it cannot ask for more
STOP_TIMEOUT, CYCLE = 2.0, 0.001  # s, for the ramp of a quick stop; a communication cycle
# What an agent may change and what must not stay so: gains, offsets, profile velocity and mode.
KEPT = (*GAIN_OBJECTS, (0x60B0, 0), (0x60B1, 0), (0x60B2, 0), (0x6081, 0), (0x6060, 0))
AT_REST = 0.01  # of the speed at the begin of the ramp


class PolicyStoppedError(PolicyError):
    """A policy was stopped; the message says why, with value, limit and remedy."""


@dataclass(frozen=True)
class GuardLimits:
    """What a policy may do; None for no limit.

    saturation: Longest time with an action at the end of its range [s].
    stall: Longest time for an action [s].
    """

    saturation: float | None = 0.1
    stall: float | None = 0.1

    def __post_init__(self) -> None:
        for name in ("saturation", "stall"):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise ValueError(f"{name} must be above 0 s, not {value:g} s; None for no limit")


class GuardedPolicy:
    """A policy under watch; it acts as the one that it holds.

    Args:
        policy: What acts.
        low, high: Ends of the action's range, shape (actions,).
        step: Time between two actions [s].
        limits: What it may do.
    """

    def __init__(self, policy: Any, low: NDArray[Any], high: NDArray[Any], step: float, limits: GuardLimits) -> None:
        self._policy, self._step, self._limits = policy, step, limits
        self._middle, self._reach = (high + low) / 2.0, (high - low) / 2.0
        self._at_limit = np.zeros((1, len(low)), np.int64)

    def reset(self, mask: NDArray[np.bool_] | None = None) -> None:
        """Begin an episode."""
        self._at_limit[:] = 0
        self._policy.reset(mask)

    def act(self, observation: Any) -> Any:
        """Return the policy's action.

        Raises:
            PolicyStoppedError: If it took too long, is no number, or has been at the end of its range for too long.
        """
        start = time.perf_counter()
        try:
            action = np.asarray(self._policy.act(observation))
        except PolicyStoppedError:
            raise
        except PolicyError as error:
            raise PolicyStoppedError(str(error)) from error
        took = time.perf_counter() - start
        stall, saturation = self._limits.stall, self._limits.saturation
        if stall is not None and took > stall:
            raise PolicyStoppedError(
                f"the policy took {1e3 * took:.0f} ms for an action, and its limit is {1e3 * stall:.0f} ms; "
                "use a smaller network or a faster computer"
            )
        rows = action.reshape(-1, len(self._middle))
        if not np.isfinite(rows).all():
            lane, entry = np.argwhere(~np.isfinite(rows))[0]
            raise PolicyStoppedError(f"entry {entry} of the policy's action is {rows[lane, entry]}, no number")
        if saturation is not None:
            there = np.abs(rows - self._middle) >= AT_LIMIT * self._reach
            if self._at_limit.shape != there.shape:
                self._at_limit = np.zeros(there.shape, np.int64)
            self._at_limit = np.where(there, self._at_limit + 1, 0)
            longest = float(self._at_limit.max()) * self._step
            # One action at its end is no sticking, however long the step.
            if longest >= saturation - 1e-9 and self._at_limit.max() > 1:
                entry = int(np.argmax(self._at_limit.max(axis=0)))
                raise PolicyStoppedError(
                    f"entry {entry} of the policy's action has been at the end of its range for {1e3 * longest:.0f} "
                    f"ms, and the limit is {1e3 * saturation:.0f} ms; train it on such a machine, or allow more "
                    "(--saturation)"
                )
        return action


@contextmanager
def unchanged(drives: Any) -> Iterator[None]:
    """Put gains, offsets, profile velocity and mode back as they were when what is inside ends; log what fails."""
    before = {name: drives.read(name) for name in KEPT}
    try:
        yield
    finally:
        for name, values in before.items():
            for attempt in range(2):  # after a stall the envelope refuses one call, to tell of it
                try:
                    other = drives.read(name) != values
                    if other.any():
                        drives.write(name, values, where=other)
                    break
                except (RuntimeError, ValueError, OSError) as error:
                    if attempt:
                        logger.error("%04Xh:%02X stays changed: %s", *name, error)


@contextmanager
def stopping(drives: Any) -> Iterator[None]:
    """Leave the drives at rest and disabled if what is inside ends with any exception, Ctrl-C too."""
    try:
        yield
    except BaseException as error:
        stop(drives, str(error) or type(error).__name__)
        raise


def stop(drives: Any, reason: str) -> None:
    """Bring drives to rest in a hurry and leave them disabled.

    Args:
        drives: Emulated ones, or on a bus; there the envelope does it, which goes on where one of them does not answer.
        reason: For the log.
    """
    envelope = getattr(drives, "safety", None)
    if envelope:
        envelope.stop(reason)
    else:
        come_to_rest(drives)


def come_to_rest(drives: Any) -> None:
    """Quick-stop the drives, wait for the end of the ramp, and switch the voltage off."""
    motion.quick_stop(drives)
    first = np.abs(drives.read(0x606C))
    for _ in range(round(STOP_TIMEOUT / CYCLE)):
        status = drives.read(0x6041)
        running = np.zeros(drives.num_axes, bool)
        for mask, value in (motion.OPERATION_ENABLED, motion.QUICK_STOP_ACTIVE):
            running |= status & mask == value
        moving = np.abs(drives.read(0x606C)) > np.maximum(AT_REST * first, 1)
        if not np.any(running & moving):
            break
        drives.advance(CYCLE)
    drives.write(0x6040, 0)
