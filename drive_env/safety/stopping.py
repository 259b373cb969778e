"""A stop by grades: quick stop; check that the axis slows down by its ramp; if it does not, cut the voltage.

A stop does not access the bus: it is given samples and the time, and returns the controlword that each axis needs next.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum
from typing import NamedTuple

from drive_env import cia402

REPEAT = 0.02  # s after which a command that shows no effect is sent again
ANSWER = 0.1  # s within which a drive must have begun its ramp
GRACE = 0.02  # s from the command to a slower axis: the bus, the drive's cycle, the loops
SHARE = 0.5  # of the ramp's deceleration, which counts as slowing down by it
LONGEST_FOLLOWING = 0.5  # s until the ramp begins of an axis that may first go on to its set-point
LONGEST = 1.0  # s; an axis that will be at rest by then at its present deceleration slows down well enough, too
# Consecutive measurements of the deceleration that must be too low, until one was sufficient: a loop at its current
# limit goes on as before until the ramp has come down to the actual speed.
MEASUREMENTS = 2
# A loop whose integral has wound up takes an axis past rest and back: by this share of its speed, for this time [s].
SWING_SHARE, SWING_TIME = 0.15, 0.1
RAMP_TIMEOUT = 2.0  # s for the whole ramp
SETTLED = 0.02  # s for which samples must show an axis at rest
BLIND = 0.4  # s without a sample, after which the voltage is cut
BREAKS_LOOSE = 10.0  # times the speed of rest, above which a held axis shakes or slips
LOST = 0.6  # s for which the voltage is cut repeatedly before an axis is given up


class Phase(Enum):
    """Phase of an axis' stop."""

    FOLLOW = "following"
    RAMP = "ramp"
    REST = "at rest, held"
    CUT = "voltage off"
    OFF = "off"
    LOST = "lost"


class Sample(NamedTuple):
    """The last sample of an axis: when it was seen [s], statusword, speed [inc/s]."""

    time: float
    status: int
    speed: float


class AxisStop:
    """The stop of one axis.

    Args:
        now: The present time [s].
        speed: Its speed, if known [inc/s].
        deceleration: Of its quick stop ramp [inc/s^2]; 0 if unknown.
        rest: Speed below which it is at rest [inc/s].
        holds: Whether it stays in quick stop active, which holds its position, instead of being switched off.
        follows: Returns whether it should go on to its set-point before its ramp begins; None: never.
    """

    def __init__(
        self,
        now: float,
        speed: float,
        deceleration: float,
        rest: float,
        holds: bool,
        follows: Callable[[], bool] | None = None,
    ) -> None:
        self.phase = Phase.RAMP if follows is None else Phase.FOLLOW
        self._follows = follows
        self.why = ""  # cause of cutting the voltage
        self._begun = self._since = now
        self._first = abs(speed)
        self._way = 0.0  # sign of its first speed
        self._swung: float | None = None  # when it passed rest [s]
        self._deceleration = deceleration
        self._rest = rest
        self._settled: float | None = None  # since when it is at rest [s]
        self._sent: float | None = None
        self._seen = now
        self._check: Sample | None = None
        self._too_low, self._most = 0, MEASUREMENTS  # measurements too low in a row; allowed ones, 1 once it brakes
        self.holds = holds

    @property
    def is_over(self) -> bool:
        """Whether the stop needs no further command."""
        return self.phase in (Phase.OFF, Phase.LOST) or (self.phase is Phase.REST and self.holds)

    def step(self, now: float, sample: Sample) -> int | None:
        """Handle the newest sample; return the controlword to send, or None."""
        fresh = sample.time > self._seen
        if fresh:
            self._seen = sample.time
        if fresh and sample.time > self._begun and not cia402.is_live(sample.status) and self._sent is not None:
            self.phase = Phase.OFF
            return None
        if self.phase is Phase.FOLLOW:
            self._watch_following(now, sample)
        elif self.phase is Phase.RAMP:
            self._watch_ramp(now, sample, fresh)
        elif self.phase is Phase.CUT and now - self._since > LOST:
            self.phase = Phase.LOST
        elif self.phase is Phase.REST and fresh and abs(sample.speed) > BREAKS_LOOSE * self._rest:
            self.why = "it moves though it is held"
            self._enter(Phase.CUT, now)
        if self.phase is Phase.REST and not self.holds:
            self._enter(Phase.CUT, now)
        return self._command(now, sample)

    def rests_for(self, now: float) -> float:
        """Return for how long it has been held at rest [s]."""
        return now - self._since if self.phase is Phase.REST else 0.0

    def is_unseen(self, now: float) -> bool:
        """Return whether the voltage is to be cut but the drive does not answer."""
        return self.phase is Phase.CUT and now - self._seen > ANSWER

    def release(self) -> None:
        """Stop holding it: its voltage is cut at the next step, or once it is at rest."""
        self.holds = False

    def _watch_following(self, now: float, sample: Sample) -> None:
        assert self._follows is not None
        if now - self._begun > LONGEST_FOLLOWING or now - self._seen > ANSWER or not self._follows():
            self.phase, self._begun, self._since = Phase.RAMP, now, now
            self._first = abs(sample.speed)

    def _watch_ramp(self, now: float, sample: Sample, fresh: bool) -> None:
        if not fresh:
            if now - self._seen > BLIND:
                self.why = f"its position was not received for {now - self._seen:.1f} s"
                self._enter(Phase.CUT, now)
            return
        self._first = max(self._first, abs(sample.speed)) if sample.time < self._begun + GRACE else self._first
        if self._way == 0.0 and abs(sample.speed) > self._rest:
            self._way = math.copysign(1.0, sample.speed)
        if cia402.matches(sample.status, cia402.OPERATION_ENABLED):  # the ramp has not begun
            if now - self._begun > ANSWER:
                self.why = "it does not obey the quick stop"
                self._enter(Phase.CUT, now)
            return
        if abs(sample.speed) > self._rest:
            self._settled = None
        elif self._settled is None:
            self._settled = sample.time
        if self._settled is not None and sample.time - self._settled >= SETTLED:
            self._enter(Phase.REST, now)
        elif now - self._begun > RAMP_TIMEOUT:
            self.why = f"it is still turning after {RAMP_TIMEOUT:g} s"
            self._enter(Phase.CUT, now)
        elif not self._slows_down(now, sample):
            self.why = "it does not slow down by its ramp"
            self._enter(Phase.CUT, now)

    def _slows_down(self, now: float, sample: Sample) -> bool:
        """Return whether the speed follows the ramp, swings past rest, or will be 0 within LONGEST."""
        elapsed = max(now - self._begun - GRACE, 0.0)
        # If the ramp is unknown or too slow for this speed, only the measured deceleration counts.
        is_ramp = 0.0 < self._first <= RAMP_TIMEOUT * self._deceleration
        expected = self._first - SHARE * self._deceleration * elapsed if is_ramp else 0.0
        if self._check is None:
            self._check = sample
        if sample.speed * self._way < 0.0 and self._swung is None:
            self._swung = sample.time
        swings = self._swung is not None and sample.time - self._swung <= SWING_TIME
        if abs(sample.speed) <= max(expected, SWING_SHARE * self._first * swings) + 3.0 * self._rest:
            self._check, self._too_low = sample, 0
            return True
        span = sample.time - self._check.time
        if span < GRACE:
            return True
        rate = (abs(self._check.speed) - abs(sample.speed)) / span
        self._check = sample
        if rate * LONGEST >= abs(sample.speed):
            self._too_low, self._most = 0, 1
            return True
        self._too_low += 1
        return self._too_low < self._most

    def _enter(self, phase: Phase, now: float) -> None:
        self.phase, self._since, self._sent = phase, now, None if phase is Phase.CUT else self._sent

    def _command(self, now: float, sample: Sample) -> int | None:
        if self.phase is Phase.RAMP:
            word, wanted = (
                cia402.QUICK_STOP,
                cia402.matches(sample.status, cia402.QUICK_STOP_ACTIVE) and sample.time > self._begun,
            )
        elif self.phase is Phase.CUT:
            word, wanted = cia402.DISABLE_VOLTAGE, False
        else:
            return None
        if self._sent is not None and (wanted or now - self._sent < REPEAT):
            return None
        self._sent = now
        return word


class Stop:
    """The stop of some axes.

    Args:
        axes: Their stops, by number.
        send: Sends a controlword to an axis, without waiting for an answer.
        sample: Returns the last sample of an axis.
    """

    def __init__(
        self, axes: dict[int, AxisStop], send: Callable[[int, int], None], sample: Callable[[int], Sample]
    ) -> None:
        self.axes = axes
        self._send = send
        self._sample = sample

    @property
    def is_over(self) -> bool:
        """Whether no axis needs a further command."""
        return all(axis.is_over for axis in self.axes.values())

    def step(self, now: float) -> None:
        """Send the controlword that each axis needs at `now` [s]."""
        for number, axis in self.axes.items():
            if axis.phase not in (Phase.OFF, Phase.LOST) and (word := axis.step(now, self._sample(number))) is not None:
                self._send(number, word)
