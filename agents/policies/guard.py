"""A watch over a policy that acts on drives: it is stopped if it returns NaN, stays at its limit, or stalls.

The safety envelope of a bus monitors the drives; this monitors the policy. A policy is called in a separate thread: if
it does not answer in time it is abandoned, whether it is slow or never returns, and `stop` brings the drives to rest
and leaves them disabled. The envelope's thread has quick-stopped them by then (`Limits(stall=...)`).
"""

from __future__ import annotations

import logging
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.policies.deadline import Deadline, DeadlineError
from agents.policies.policy import PolicyError
from drive_env import cia402, motion
from drive_env.drives.interface import Drives, device_of
from mechanics.arrays import Mask

logger = logging.getLogger(__name__)

AT_LIMIT = 0.999  # of the action's range, above which it counts as at the limit
STOP_TIMEOUT, CYCLE = 2.0, 0.001  # s, for the ramp of a quick stop; a communication cycle
# Objects besides gains that an agent may change and that must be restored: offsets, profile velocity and mode.
KEPT = (
    (cia402.POSITION_OFFSET, 0),
    (cia402.VELOCITY_OFFSET, 0),
    (cia402.TORQUE_OFFSET, 0),
    (cia402.PROFILE_VELOCITY, 0),
    (cia402.MODE, 0),
)
AT_REST = 0.01  # of the speed at the beginning of the ramp


class PolicyStoppedError(PolicyError):
    """A policy was stopped; the message says why, with value, limit and remedy."""


@dataclass(frozen=True)
class GuardLimits:
    """Limits of a policy; None for no limit.

    saturation: Longest time [s] with an action at the end of its range.
    stall: Longest time [s] without an action.
    """

    saturation: float | None = 0.1
    stall: float | None = 0.1

    def __post_init__(self) -> None:
        for name in ("saturation", "stall"):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise ValueError(f"{name} must be above 0 s, not {value:g} s; None for no limit")


# Limits on given drives, by environment. A trial's gains may be at the end of their range, and between two trials the
# axes hold their position: the envelope of a bus by itself allows a second.
LIMITS = {
    "ServoDrive/Tracking-v0": GuardLimits(),
    "ServoDrive/GainScheduling-v0": GuardLimits(),
    "ServoDrive/GainTuning-v0": GuardLimits(saturation=None, stall=1.0),
}
# For emulated machines, where only the user's patience is at stake, and for a policy's first answer, which may include
# loading and compiling.
PATIENT = GuardLimits(saturation=None, stall=60.0)


class GuardedPolicy:
    """A policy within limits; it acts as its policy, in a separate thread if `limits` have a stall time.

    Args:
        policy: The policy.
        low, high: Ends of the action's range, shape (actions,).
        step: Time between two actions [s].
        limits: Its limits.
    """

    def __init__(self, policy: Any, low: ArrayLike, high: ArrayLike, step: float, limits: GuardLimits) -> None:
        self._policy, self._step, self._limits = policy, step, limits
        least, most = np.asarray(low, float), np.asarray(high, float)
        self._middle, self._reach = (most + least) / 2.0, (most - least) / 2.0
        self._at_limit = np.zeros((1, len(least)), np.int64)
        self._deadline = Deadline()

    def warm_up(self, observation: Any) -> None:
        """Call the policy once before anything moves, and drop its answer: loading or compiling is no stall then.

        Raises:
            PolicyStoppedError: If it does not answer within PATIENT.stall.
        """
        self._ask(self._policy.act, observation, within=PATIENT.stall)
        self._ask(self._policy.reset, None, within=PATIENT.stall)

    def reset(self, mask: Mask | None = None) -> None:
        """Begin an episode."""
        self._at_limit[:] = 0
        self._ask(self._policy.reset, mask, within=self._limits.stall)

    def told(self, parameters: Any, mask: Mask) -> None:
        """Pass the parameters of starting machines to the policy's `told`, if there are both."""
        if parameters is not None and hasattr(self._policy, "told"):
            self._ask(lambda known: self._policy.told(known, mask), parameters, within=self._limits.stall)

    def act(self, observation: Any) -> Any:
        """Return the policy's action.

        Raises:
            PolicyStoppedError: If it took too long, is not a number, or has been at the end of its range for too long.
        """
        action = self._ask(self._policy.act, observation, within=self._limits.stall)
        rows = self._checked(action, len(observation))
        saturation = self._limits.saturation
        if saturation is not None:
            there = np.abs(rows - self._middle) >= AT_LIMIT * self._reach
            if self._at_limit.shape != there.shape:
                self._at_limit = np.zeros(there.shape, np.int64)
            self._at_limit = np.where(there, self._at_limit + 1, 0)
            longest = float(self._at_limit.max()) * self._step
            # A single action at its end is allowed, however long the step.
            if longest >= saturation - 1e-9 and self._at_limit.max() > 1:
                entry = int(np.argmax(self._at_limit.max(axis=0)))
                raise PolicyStoppedError(
                    f"entry {entry} of the policy's action has been at the end of its range for {1e3 * longest:.0f} "
                    f"ms, and the limit is {1e3 * saturation:.0f} ms; train it on such a machine, or allow a longer "
                    "time (--saturation)"
                )
        return rows

    def answer(self, observation: Any) -> Any:
        """Return a tuner's choice after its last trial, as an action; None for a policy without a choice.

        Raises:
            PolicyStoppedError: If it took too long, or is not a number.
        """
        answer = getattr(self._policy, "answer", None)
        if answer is None:
            return None
        return self._checked(self._ask(answer, observation, within=self._limits.stall), len(observation))

    def close(self) -> None:
        """End the policy's thread."""
        self._deadline.close()

    def _checked(self, action: Any, lanes: int) -> NDArray[Any]:
        """Return an action as rows, (environments, actions)."""
        entries = len(self._middle)
        try:
            rows = np.asarray(action)
            finite = np.isfinite(rows)
        except (TypeError, ValueError):
            kind = type(action).__name__
            raise PolicyStoppedError(f"the policy's action is a {kind}, not an array of numbers") from None
        if rows.size != lanes * entries:
            raise PolicyStoppedError(
                f"the policy's action has shape {rows.shape}; {lanes} environments take ({lanes}, {entries})"
            )
        rows, finite = rows.reshape(lanes, entries), finite.reshape(lanes, entries)
        if not finite.all():
            lane, entry = np.argwhere(~finite)[0]
            raise PolicyStoppedError(f"entry {entry} of the policy's action is {rows[lane, entry]}, not a number")
        return rows

    def _ask(self, function: Callable[[Any], Any], argument: Any, within: float | None) -> Any:
        """Return the policy's answer; PolicyStoppedError if it comes too late, or the policy raises."""
        try:
            if within is None:
                return function(argument)
            start = time.perf_counter()
            answer = self._deadline.call(function, argument, within=within)
            if time.perf_counter() - start >= within:  # this thread may be late, too
                raise DeadlineError
            return answer
        except DeadlineError:
            raise PolicyStoppedError(
                f"the policy gave no answer for {1e3 * (within or 0.0):.0f} ms: it is too slow, or does not return at "
                "all; use a smaller network or a faster computer, or allow a longer time (--stall)"
            ) from None
        except PolicyError as error:
            raise PolicyStoppedError(str(error)) from error
        except Exception as error:  # foreign code
            place = traceback.extract_tb(error.__traceback__)[-1]
            raise PolicyStoppedError(
                f"the policy failed: {type(error).__name__}: {error} ({place.filename}, line {place.lineno})"
            ) from error


@contextmanager
def unchanged(drives: Drives) -> Iterator[None]:
    """Restore gains, offsets, profile velocity and mode when the block ends; log failures."""
    device = device_of(drives)
    kept = [name for name in KEPT if name in device.bindings]  # a stepper has no torque offset
    before = {name: drives.read(name) for name in (*device.gains.keys, *kept)}
    try:
        yield
    finally:
        for name, values in before.items():
            for attempt in range(2):  # after a stall the envelope refuses one call, to report it
                try:
                    other = drives.read(name) != values
                    if other.any():
                        drives.write(name, values, where=other)
                    break
                except (RuntimeError, ValueError, OSError) as error:
                    if attempt:
                        logger.error("%04Xh:%02X could not be restored: %s", *name, error)


@contextmanager
def stopping(drives: Drives) -> Iterator[None]:
    """Leave the drives at rest and disabled if the block ends with any exception, also Ctrl-C."""
    try:
        yield
    except BaseException as error:
        stop(drives, str(error) or type(error).__name__)
        raise


def stop(drives: Drives, reason: str) -> None:
    """Quick-stop drives and leave them disabled.

    Args:
        drives: The drives; on a bus the envelope does it, and continues if one of them does not answer.
        reason: For the log.
    """
    envelope = drives.safety
    if envelope:
        envelope.stop(reason)
    else:
        come_to_rest(drives)


def come_to_rest(drives: Drives) -> None:
    """Quick-stop the drives, wait for the end of the ramp, STOP_TIMEOUT at most, and switch the voltage off."""
    motion.quick_stop(drives)
    first = np.abs(drives.read(cia402.VELOCITY_ACTUAL))
    for _ in range(round(STOP_TIMEOUT / CYCLE)):
        status = drives.read(cia402.STATUSWORD)
        running = np.zeros(drives.num_axes, bool)
        for mask, value in (cia402.OPERATION_ENABLED, cia402.QUICK_STOP_ACTIVE):
            running |= status & mask == value
        moving = np.abs(drives.read(cia402.VELOCITY_ACTUAL)) > np.maximum(AT_REST * first, 1)
        if not np.any(running & moving):
            break
        drives.advance(CYCLE)
    drives.write(cia402.CONTROLWORD, 0)
