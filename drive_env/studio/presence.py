"""The open browser pages and their motions: a motion lasts only while its page confirms it.

A page sends a beat every tenth of a second, with the button that it holds. A closed page says goodbye, or its
connection ends; a page whose browser or computer sleeps is silent. Motions of a job last as long as the page that began
it. Times are of the monotonic clock [s].
"""

from __future__ import annotations

import itertools
import threading
import time
from dataclasses import dataclass

import numpy as np

from mechanics.arrays import Mask

HOLD = 0.5  # s without a beat after which motions of a held button are stopped
ASLEEP = 2.0  # s without a beat after which a page's other motions are stopped
ABANDONED = 5.0  # s without any page after which enabled axes are stopped and disabled


@dataclass
class PageMotion:
    """A motion of a page.

    Attributes:
        number: Number of this motion.
        page: Page of the motion.
        axes: Axes that it moves, shape (num_axes,).
        held: Whether it lasts only while a button is held; otherwise it lasts as long as the page.
        beat: Time at which the page last confirmed it [s].
        why: Why it ended; "" while it lasts.
        coupled: Whether several axes turn together, so that all stop if one is lost.
    """

    number: int
    page: str
    axes: Mask
    held: bool
    beat: float
    why: str = ""
    coupled: bool = False


class Presence:
    """The open pages; all methods may be called from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._beats: dict[str, float] = {}
        self._motions: dict[int, PageMotion] = {}
        self._numbers = itertools.count(1)
        self._last = time.monotonic()

    def beat(self, page: str, held: int = 0) -> None:
        """Record a page's beat, and the motion whose button it holds, 0 for none."""
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
        """Begin a motion and return it."""
        with self._lock:
            motion = PageMotion(next(self._numbers), page, axes.copy(), held, time.monotonic())
            self._motions[motion.number] = motion
            return motion

    def couple(self, number: int) -> None:
        """Mark a motion whose axes now turn: if there are several, all stop if one is lost."""
        with self._lock:
            motion = self._motions.get(number)
            if motion is not None:
                motion.coupled = int(motion.axes.sum()) > 1

    def is_coupled(self) -> bool:
        """Return whether any motion has axes that must all stop if one is lost."""
        with self._lock:
            return any(motion.coupled for motion in self._motions.values())

    def lose(self, axes: Mask) -> None:
        """Expire the coupled motions of axes that are no longer enabled."""
        with self._lock:
            for motion in self._motions.values():
                if motion.coupled and not motion.why and np.any(motion.axes & axes):
                    lost = int(np.flatnonzero(motion.axes & axes)[0])
                    motion.why = f"axis {lost} is not enabled any more, and none goes on without it"

    def stop(self, axes: Mask, why: str) -> None:
        """Have axes stopped like those of an expired motion, independent of their present motion."""
        with self._lock:
            number = next(self._numbers)
            self._motions[number] = PageMotion(number, "", axes.copy(), False, time.monotonic(), why)

    def end(self, number: int) -> PageMotion | None:
        """End a motion and return it; None if it was already over."""
        with self._lock:
            motion = self._motions.pop(number, None)
            if motion is not None and not motion.why:
                motion.why = "released"
            return motion

    def end_of_page(self, page: str, axes: Mask) -> None:
        """Remove motions of some axes that last as long as this page, without stopping the axes."""
        with self._lock:
            for number, motion in list(self._motions.items()):
                if motion.page == page and not motion.held and np.any(motion.axes & axes):
                    del self._motions[number]
                    motion.why = motion.why or "ended"

    def end_all(self, axes: Mask) -> None:
        """Remove the motions of axes that are being stopped."""
        with self._lock:
            for number in [n for n, motion in self._motions.items() if np.any(motion.axes & axes)]:
                motion = self._motions.pop(number)
                motion.why = motion.why or "stopped"

    def is_on(self, number: int) -> bool:
        """Return whether a motion has begun and not ended."""
        with self._lock:
            motion = self._motions.get(number)
            return motion is not None and not motion.why

    def moves(self) -> bool:
        """Return whether any page has a motion."""
        with self._lock:
            return bool(self._motions)

    def take_overdue(self) -> list[PageMotion]:
        """Return and remove the motions whose page is closed or silent."""
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
        """Return the numbers of the motions that `take_overdue` would return."""
        now = time.monotonic()
        with self._lock:
            motions = self._motions.values()
            return {one.number for one in motions if one.why or now - one.beat > (HOLD if one.held else ASLEEP)}

    def why_gone(self, page: str) -> str:
        """Return why motions of a page must end; "" while the page is open and sends beats."""
        now = time.monotonic()
        with self._lock:
            beat = self._beats.get(page)
        if beat is None:
            return "its page was closed"
        return f"its page was silent for {now - beat:.1f} s" if now - beat > ASLEEP else ""

    def pages(self) -> int:
        """Return the number of open pages."""
        now = time.monotonic()
        with self._lock:
            return sum(now - beat < ABANDONED for beat in self._beats.values())

    def is_abandoned(self) -> bool:
        """Return whether there has been no page for so long that enabled axes must be stopped."""
        with self._lock:
            return time.monotonic() - self._last > ABANDONED
