"""The drives' interface for jobs of the studio: any call can be stopped, and all time that passes is recorded.

Emulated drives run in real time here, in pieces of 20 ms, unless a job wants full speed; drives of a bus do so by
themselves.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.dictionary.roles import Role
from drive_env.drives.arguments import object_names, whole_cycles
from drive_env.drives.drives_proxy import DrivesProxy
from drive_env.drives.interface import CYCLE, Drives
from drive_env.drives.trace import Trace
from drive_env.safety.errors import SafetyError
from drive_env.safety.objects import STORE
from drive_env.studio.errors import JobStoppedError
from drive_env.studio.recorder import ScopeRecorder
from mechanics.arrays import Integers, Mask

if TYPE_CHECKING:
    from drive_env.dictionary.entries import ObjectName
    from drive_env.drives.emergency import EmergencyMessage

PIECE = 0.02  # s of emulated time between two checks for stops
BUS_PIECE = 0.1  # s of a recording on a bus, where nothing is played
SEAMLESS = 0.004  # s, greatest distance of two recordings on a bus without a gap
MOST_BEHIND = 0.1  # s; a slower computer does not catch up


T = TypeVar("T")

# All names of the objects.
CONTROLWORDS = (cia402.CONTROLWORD, (cia402.CONTROLWORD, 0), "Controlword")
SET_POINTS = frozenset(
    one
    for index, name in (
        (cia402.TARGET_POSITION, "Target position"), (cia402.TARGET_VELOCITY, "Target velocity"),
        (cia402.TARGET_TORQUE, "Target torque"), (cia402.VL_TARGET_VELOCITY, "vl target velocity"),
        (cia402.POSITION_OFFSET, "Position offset"), (cia402.VELOCITY_OFFSET, "Velocity offset"),
        (cia402.TORQUE_OFFSET, "Torque offset"),
    )
    for one in (index, (index, 0), name)
) | {(cia402.INTERPOLATION_DATA, 1), Role.TARGET_INSIDE}  # fmt: skip


def _operates(value: ArrayLike) -> bool:
    """Return whether a controlword enables operation without halt."""
    words = np.asarray(value)
    if words.dtype.kind not in "iu":
        return True  # a text, which the drives interpret
    return bool(np.any((words & 0x0F == cia402.ENABLE_OPERATION) & (words & cia402.HALT == 0)))


class SharedDrives(DrivesProxy):
    """Drives whose calls end when their job is stopped.

    Args:
        drives: The drives, emulated or on a bus.
        recorder: Recorder of the samples.
        look: Called between two pieces of time, by the calling thread; its exceptions end the call.
        hear: Called with all emergencies that were read.
        moves: Returns whether any page has a motion.
        stopped: Returns why the running job was stopped, "" if it was not. The job gets this exception once, by `look`,
            so that it can restore its changes. Until it has ended it cannot enable operation again, and the envelope's
            own error for the same stop is not raised, since it would interrupt the restoring.

    Attributes:
        lock: Held during calls of emulated drives: a stop from another thread waits for one piece at most.
        paced: Whether emulated time passes in real time; otherwise at full speed.
        when_stored: Called with the axes whose nodes have stored their parameters (1010h:01).
        moved: Axes that the present job may have moved, shape (num_axes,): by a controlword that enables operation, or
            by a set-point.
    """

    def __init__(
        self,
        drives: Drives,
        recorder: ScopeRecorder,
        look: Callable[[], None],
        hear: Callable[[Sequence[EmergencyMessage]], None],
        moves: Callable[[], bool],
        stopped: Callable[[], str],
    ) -> None:
        super().__init__(drives)
        self.lock = threading.RLock()
        self.paced = True
        self.when_stored: Callable[[Mask], None] = lambda where: None
        self.moved: Mask = np.zeros(drives.num_axes, bool)
        self._recorder = recorder
        self._look = look
        self._hear = hear
        self._moves = moves
        self._stopped = stopped
        roles = drives.device.roles if drives.device is not None else {}
        self._set_points = SET_POINTS | {roles.get(Role.TARGET_INSIDE)}
        self._refused: set[tuple[Key, ...]] = set()  # objects that cannot be sampled together
        self._due = time.perf_counter()
        self._start = time.monotonic()

    # --- the interface --------------------------------------------------------------------------------------------
    def read(self, name: ObjectName) -> Integers:
        """Return an object of every axis."""
        self._look()
        with self.lock:
            return self._calling(lambda: self._drives.read(name))

    def write(self, name: ObjectName, value: ArrayLike, where: Mask | None = None) -> None:
        """Write an object of every axis, or of some; JobStoppedError for an enabling controlword of a stopped job."""
        operates = name in CONTROLWORDS and _operates(value)
        before, moves = self.moved, self.moved | (True if where is None else where)
        self.moved = moves if operates else before  # set before `_look`, which ends the job if its page is closed
        self._look()
        if operates and (reason := self._stopped()):
            raise JobStoppedError(reason)
        try:
            with self.lock:
                self._calling(lambda: self._drives.write(name, value, where=where))
        except SafetyError:  # it was not sent
            self.moved = before
            raise
        if name in self._set_points:
            self.moved = moves
        if name == (STORE, 1):
            self.when_stored(np.broadcast_to(True if where is None else where, (self.num_axes,)))

    def advance(self, duration: float) -> None:
        """Let time pass [s], whole communication cycles, and record it."""
        if not self._drives.time_waits:
            cycle = self._recorder.period
            duration = max(1, -int(-(duration + 1e-9) // cycle)) * cycle if duration > 0.0 else 0.0
        if duration > 0.0:
            self.record((), duration, period=self._recorder.period)

    def record(
        self,
        objects: ObjectName | Sequence[ObjectName],
        duration: float,
        play: Mapping[Any, ArrayLike] | None = None,
        period: float = CYCLE,
    ) -> Trace:
        """Let time pass [s] while objects are recorded and played, as `Drives.record`, also to the recorder."""
        if play:
            self.moved = np.ones(self.num_axes, bool)
        self._look()
        asked = tuple(object_names(objects))
        if self._drives.time_waits:
            return self._in_pieces(asked, duration, play, period, PIECE)
        if play and self._moves():  # played set-points are one piece, during which a silent page would not be noticed
            raise RuntimeError("a page moves an axis; end its jog, or its target, before set-points are played")
        return self._in_pieces(asked, duration, play, period, duration if play else BUS_PIECE)

    def emergencies(self) -> list[EmergencyMessage]:
        """Return the emergencies of the drives since the last call."""
        with self.lock:
            found = self._drives.emergencies()
        if found:
            self._hear(found)
        return found

    def reset_node(self, where: Mask | None = None) -> None:
        """Restart nodes, as after power-on."""
        self._look()
        with self.lock:
            self._drives.reset_node(where)

    def start_node(self, where: Mask | None = None) -> None:
        """Start nodes that have left operational."""
        self._look()
        with self.lock:
            self._drives.start_node(where)

    def close(self) -> None:
        """Do nothing: the session closes its drives."""

    def __exit__(self, *_: object) -> None:
        """Do nothing, as `close` does."""

    # --- private methods ------------------------------------------------------------------------------------------
    def _calling(self, call: Callable[[], T]) -> T:
        """Call a function of the drives; repeat it once if the envelope reports a stop that the job already knows."""
        try:
            return call()
        except SafetyError:
            if not self._stopped():
                raise
            return call()

    def _in_pieces(
        self,
        asked: tuple[ObjectName, ...],
        duration: float,
        play: Mapping[Any, ArrayLike] | None,
        period: float,
        longest: float,
    ) -> Trace:
        cycle = self._recorder.period
        cycles, every = whole_cycles(duration, cycle), whole_cycles(period, cycle)
        rows = {name: np.asarray(values) for name, values in (play or {}).items()}
        if cycles == 0 or every == 0 or any(one.ndim == 0 or len(one) != cycles for one in rows.values()):
            with self.lock:
                return self._drives.record(asked, duration, play, period)  # the drives report what is wrong
        piece = max(1, round(longest / cycle) // every) * every
        parts = []
        for first in range(0, cycles, piece):
            count = min(piece, cycles - first)
            part = {name: values[first : first + count] for name, values in rows.items()} or None
            parts.append(self._piece(asked, count * cycle, part, period))
            self._keep_pace(count * cycle)
            self._look()
        return parts[0] if len(parts) == 1 else Trace.joined(parts, period)

    def _piece(
        self,
        asked: tuple[ObjectName, ...],
        span: float,
        play: Mapping[Any, ArrayLike] | None,
        period: float,
    ) -> Trace:
        """Let a piece of time pass, and sample as many of the recorder's objects as possible."""
        wanted = self._recorder.objects
        while (chosen := (*asked, *wanted)) in self._refused and wanted:
            wanted = wanted[:-1]
        start = self._begin()
        while True:
            try:
                with self.lock:
                    trace = self._calling(partial(self._drives.record, (*asked, *wanted), span, play, period))
                break
            except ObjectAccessError:
                if not wanted:
                    raise
                # Too many for the process data of a bus, or one that cannot be sampled: detected before time passes.
                self._refused.add(chosen)  # type: ignore[arg-type]
                wanted = wanted[:-1]
                chosen = (*asked, *wanted)
        end = start + span
        self._recorder.keep(trace, wanted, start, end)
        return trace

    def _begin(self) -> float:
        """Return the beginning of the present piece of time [s]: the end of the last one, unless there was a gap."""
        before = self._recorder.now
        if self._drives.time_waits:
            return before
        now = time.monotonic() - self._start
        return before if abs(now - before) < SEAMLESS else max(now, before)

    def _keep_pace(self, span: float) -> None:
        """Wait for real time if emulated time is ahead of it."""
        now = time.perf_counter()
        if not self._drives.time_waits or not self.paced:
            self._due = now
            return
        self._due = max(self._due + span, now - MOST_BEHIND)
        if self._due > now:
            time.sleep(self._due - now)
