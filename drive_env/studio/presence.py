"""The open browser pages, and their motions: a motion lasts as long as its page says so.

A page sends a beat every tenth of a second, and which button it holds. A page that is closed says goodbye, or its
connection ends; one whose browser sleeps, or whose computer does, is silent. What moves by a job lasts as long as the
page that began it. Times are of the monotonic clock [s].
"""

from __future__ import annotations

import itertools
import threading
import time
from dataclasses import dataclass

import numpy as np

from mechanics.arrays import Mask

HOLD = 0.5  # s without a beat after which what a page holds is stopped
ASLEEP = 2.0  # s without a beat after which a page's motions that last as long as it is there are stopped
ABANDONED = 5.0  # s without any page after which an axis that is enabled is stopped and disabled


@dataclass
class PageMotion:
    """A motion of a page.

    Attributes:
        number: Of this motion.
        page: The page.
        axes: Which axes it moves, shape (num_axes,).
        held: Whether it lasts only as long as a button is held; otherwise as long as the page is there.
        beat: When the page said last that it goes on [s].
        why: Why it ended; empty while it lasts.
        coupled: Whether several axes turn by it: none goes on without the others.
    """

    number: int
    page: str
    axes: Mask
    held: bool
    beat: float
    why: str = ""
    coupled: bool = False


class Presence:
    """The pages there are; all methods may be called by any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._beats: dict[str, float] = {}
        self._motions: dict[int, PageMotion] = {}
        self._numbers = itertools.count(1)
        self._last = time.monotonic()

    def beat(self, page: str, held: int = 0) -> None:
        """Note that a page is there, and which motion it holds, 0 for none."""
        now = time.monotonic()
        with self._lock:
            self._beats[page] = self._last = now
            for motion in self._motions.values():
                if motion.page == page and (not motion.held or motion.number == held):
                    motion.beat = now

    def leave(self, page: str) -> None:
        """Expire the page's motions immediately."""
        with self._lock:
            self._beats.pop(page, None)
            for motion in self._motions.values():
                if motion.page == page and not motion.why:
                    motion.why = "its page was closed"

    def begin(self, page: str, axes: Mask, *, held: bool) -> PageMotion:
        """Return a motion that begins now."""
        with self._lock:
            motion = PageMotion(next(self._numbers), page, axes.copy(), held, time.monotonic())
            self._motions[motion.number] = motion
            return motion

    def couple(self, number: int) -> None:
        """Note that the axes of a motion turn now: where they are several, none goes on without the others."""
        with self._lock:
            motion = self._motions.get(number)
            if motion is not None:
                motion.coupled = int(motion.axes.sum()) > 1

    def is_coupled(self) -> bool:
        """Return whether any motion has axes none of which goes on without the others."""
        with self._lock:
            return any(motion.coupled for motion in self._motions.values())

    def lose(self, axes: Mask) -> None:
        """Expire the coupled motions of axes that are not enabled any more."""
        with self._lock:
            for motion in self._motions.values():
                if motion.coupled and not motion.why and np.any(motion.axes & axes):
                    lost = int(np.flatnonzero(motion.axes & axes)[0])
                    motion.why = f"axis {lost} is not enabled any more, and none goes on without it"

    def stop(self, axes: Mask, why: str) -> None:
        """Have axes stopped as those of a motion that expired, whatever moves them."""
        with self._lock:
            number = next(self._numbers)
            self._motions[number] = PageMotion(number, "", axes.copy(), False, time.monotonic(), why)

    def end(self, number: int) -> PageMotion | None:
        """Return a motion that its page has ended; None if it was over."""
        with self._lock:
            motion = self._motions.pop(number, None)
            if motion is not None and not motion.why:
                motion.why = "released"
            return motion

    def end_of_page(self, page: str, axes: Mask) -> None:
        """Note that the end of a page ended its motions that last as long as it is there, on some axes."""
        with self._lock:
            for number, motion in list(self._motions.items()):
                if motion.page == page and not motion.held and np.any(motion.axes & axes):
                    del self._motions[number]
                    motion.why = motion.why or "ended"

    def end_all(self, axes: Mask) -> None:
        """Note that axes are stopped: nothing of them goes on."""
        with self._lock:
            for number in [n for n, motion in self._motions.items() if np.any(motion.axes & axes)]:
                motion = self._motions.pop(number)
                motion.why = motion.why or "stopped"

    def is_on(self, number: int) -> bool:
        """Return whether a motion lasts."""
        with self._lock:
            motion = self._motions.get(number)
            return motion is not None and not motion.why

    def moves(self) -> bool:
        """Return whether any page has set something in motion."""
        with self._lock:
            return bool(self._motions)

    def take_overdue(self) -> list[PageMotion]:
        """Return and forget the motions whose page is gone or silent."""
        now = time.monotonic()
        with self._lock:
            for motion in self._motions.values():
                if not motion.why and now - motion.beat > (HOLD if motion.held else ASLEEP):
                    motion.why = f"its page was silent for {now - motion.beat:.1f} s"
            overdue = [motion for motion in self._motions.values() if motion.why]
            for motion in overdue:
                del self._motions[motion.number]
            return overdue

    def untaken(self) -> set[int]:
        """Return the motions that `take_overdue` would return."""
        now = time.monotonic()
        with self._lock:
            motions = self._motions.values()
            return {one.number for one in motions if one.why or now - one.beat > (HOLD if one.held else ASLEEP)}

    def why_gone(self, page: str) -> str:
        """Return why nothing goes on that a page has begun; empty while it is there, and awake."""
        now = time.monotonic()
        with self._lock:
            beat = self._beats.get(page)
        if beat is None:
            return "its page was closed"
        return f"its page was silent for {now - beat:.1f} s" if now - beat > ASLEEP else ""

    def pages(self) -> int:
        """Return how many pages are there."""
        now = time.monotonic()
        with self._lock:
            return sum(now - beat < ABANDONED for beat in self._beats.values())

    def is_abandoned(self) -> bool:
        """Return whether no page has been there for so long that axes are not left enabled."""
        with self._lock:
            return time.monotonic() - self._last > ABANDONED
