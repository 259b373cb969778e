"""Communication cycles of `advance` and `record`: objects mapped, rows sent and received, watched by the envelope."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.dictionary.access import check_in_range, check_readable, check_writable
from drive_env.dictionary.entries import Entry, ObjectName
from drive_env.fieldbus.description import Description
from drive_env.fieldbus.link import Link, Outputs, Samples
from drive_env.master.asked_rows import CAN_BE_ASKED, AskedRows
from drive_env.master.pace import Pace
from drive_env.master.sampling import run_cycles
from mechanics.arrays import Integers

if TYPE_CHECKING:
    from drive_env.safety.watched_drives import CycleWatch

logger = logging.getLogger(__name__)

MOST_CALLS = 64  # remembered calls
NOTHING: Sequence[Entry] = ()
CONTROLWORD = (cia402.CONTROLWORD, 0)
POLL_TIMEOUT = 0.008  # s for the samples of one SYNC
_NOW = 0


@dataclass(eq=False)
class RecordCall:
    """The entries of a call of `record`, looked up once: a policy makes the same call every millisecond.

    sampled: Entries to return.
    played: Entries to write, in the order given.
    watched: The objects that the envelope watched when `chosen` was made.
    chosen: The objects to sample: `sampled` and as many of `watched` as fit.
    mapping: The number of the mapping that has all of them.
    asked: Those of `sampled` that do not fit and are read by SDO meanwhile.
    """

    sampled: tuple[Entry, ...]
    played: tuple[Entry, ...]
    watched: Sequence[Entry] | None = None
    chosen: tuple[Entry, ...] = ()
    mapping: int = -1
    asked: tuple[Entry, ...] = ()

    @property
    def mapped(self) -> tuple[Entry, ...]:
        """Those of `sampled` that go into process data."""
        return tuple(entry for entry in self.sampled if entry not in self.asked)

    def ask_for_states(self) -> bool:
        """Have sampled states read by SDO instead; return whether that leaves less for process data."""
        before = self.asked
        self.asked = tuple(entry for entry in self.sampled if (entry.index, entry.sub) in CAN_BE_ASKED)
        return self.asked != before


class CycleRunner:
    """Runs communication cycles of the drives of a bus.

    Args:
        description: The nodes' device.
        num_axes: Axes of all nodes.
        link: The bus.
        pace: When SYNCs are due.
        start: Makes the nodes operational, once.
        catch_up: Waits until nodes in lockstep have handled every SYNC.
        read: Reads an object of every axis by SDO.
    """

    def __init__(
        self,
        description: Description,
        num_axes: int,
        link: Link,
        pace: Pace,
        start: Callable[[], None],
        catch_up: Callable[[], None],
        read: Callable[[Entry], Integers],
    ) -> None:
        self._description, self._num_axes = description, num_axes
        self._link, self._pace, self._process = link, pace, link.process
        self._start, self._catch_up, self._read = start, catch_up, read
        self._calls: dict[object, RecordCall] = {}
        self._running = threading.RLock()  # one user of SYNC at a time: the program, or its supervisor
        self._nothing = RecordCall((), ())

    def pass_time(self, cycles: int, envelope: CycleWatch | None) -> None:
        """Let cycles pass by the clock: SYNCs for which this computer was too late are left out."""
        with self._running:
            samples = None
            if envelope is not None:
                self._map(self._nothing, envelope)
                samples = self._process.samples()
            self._run(cycles, None, samples, envelope, skip_missed=True)
            self._pace.end(self._link.receive)

    def prepare(self, envelope: CycleWatch) -> None:
        """Have the objects mapped that the envelope watches, as far as they fit."""
        with self._running:
            self._map(self._nothing, envelope)

    def mapped(self) -> tuple[Entry, ...]:
        """Return the objects that are sampled with every SYNC."""
        return self._process.sampled_entries()

    def poll(self, envelope: CycleWatch) -> bool | None:
        """Send a SYNC of the supervisor's own and observe its samples.

        Returns:
            False if not all of them came; None if the program's own cycles are under way or nothing is mapped.
        """
        if not self._running.acquire(blocking=False):
            return None
        try:
            samples, epoch = self._process.samples(), envelope.epoch
            if samples is None:
                return None
            try:
                self._link.sync()
                if not self._link.wait(lambda: samples.complete() >= 1, POLL_TIMEOUT):
                    return False
            finally:
                samples.close()
            rows = samples.decode(0, 1)
        finally:
            self._running.release()
        envelope.observe(rows, epoch)
        return True

    def call(self, objects: Sequence[ObjectName], play: Sequence[ObjectName]) -> RecordCall:
        """Return the entries of a call, looked up once for equal names.

        Raises:
            ObjectAccessError: For an object that cannot be recorded or played.
        """
        names = (tuple(objects), tuple(play))
        try:
            if (known := self._calls.get(names)) is not None:
                return known
        except TypeError:  # a name of a wrong type, for which `find` has the message
            pass
        entries = self._description.dictionary
        sampled = tuple(dict.fromkeys(entries.find(name) for name in objects))
        for entry in sampled:
            check_readable(entry)
        self._process.check_sampled(sampled)
        played = tuple(entries.find(name) for name in play)
        for entry in played:
            check_writable(entry)
        self._process.check_played(played)
        if len(self._calls) >= MOST_CALLS:
            self._calls.clear()
        made = self._calls[names] = RecordCall(sampled, played)
        return made

    def can_record(self, objects: Sequence[ObjectName]) -> bool:
        """Return whether objects can be recorded together."""
        try:
            self._choose(self.call(objects, ()), NOTHING, ())
        except ObjectAccessError:
            return False
        return True

    def rows(self, call: RecordCall, given: Sequence[ArrayLike], cycles: int) -> dict[Entry, Integers]:
        """Return the integers to play by entry, each of shape (cycles, num_axes).

        Raises:
            ValueError: For another shape; ObjectAccessError for a value out of range.
        """
        played = {}
        for entry, one in zip(call.played, given, strict=True):
            raw = np.asarray(one)
            if raw.shape not in ((cycles, self._num_axes), (cycles,)):
                raise ValueError(
                    f"{entry.label}: play takes shape ({cycles},) or ({cycles}, {self._num_axes}), one row per cycle, "
                    f"not {raw.shape}"
                )
            check_in_range(entry, raw)
            rows = raw.astype(np.int64)
            played[entry] = rows if rows.ndim == 2 else np.broadcast_to(rows[:, None], (cycles, self._num_axes))
        return played

    def record(
        self, call: RecordCall, played: Mapping[Entry, Integers], cycles: int, envelope: CycleWatch | None
    ) -> dict[Key, Integers]:
        """Let cycles pass and return the samples of each object, shape (cycles, num_axes)."""
        if envelope is not None:
            envelope.before_play(played)
        with self._running:
            self._map(call, envelope)
            outputs = self._process.outputs(played)
            samples = self._process.samples()
            epoch = None if any((entry.index, entry.sub) == CONTROLWORD for entry in played) else _NOW
            try:
                if call.asked and samples is not None:
                    with AskedRows(call.asked, self._read, samples.complete) as asked:
                        found = self._run(cycles, outputs, samples, envelope, epoch=epoch)
                    found |= asked.rows(cycles)
                else:
                    found = self._run(cycles, outputs, samples, envelope, epoch=epoch)
            except BaseException:
                if envelope is not None:
                    envelope.after_failed_play(played)
                raise
        if envelope is not None and cycles:
            envelope.after_play(played)
        return found

    # --- inside ---------------------------------------------------------------------------------------------------
    def _map(self, call: RecordCall, envelope: CycleWatch | None) -> None:
        """Map a call's objects and, if they fit, the objects that the envelope watches."""
        watched = NOTHING if envelope is None else envelope.watched()
        played = tuple(dict.fromkeys(call.played))
        if call.watched is not watched:
            call.watched, call.chosen, call.mapping = watched, self._choose(call, watched, played), -1
        if call.mapping == self._process.mapping:
            return
        try:
            self._have_mapped(call, played)
        except ObjectAccessError:  # say, while an axis is enabled: some drives change no mapping then
            if not self._asks_for_states(call):
                raise
            call.chosen = self._choose(call, watched, played)
            self._have_mapped(call, played)
        call.mapping = self._process.mapping
        if envelope is not None:
            envelope.sampled(self._process.sampled_entries())

    def _have_mapped(self, call: RecordCall, played: tuple[Entry, ...]) -> None:
        if not self._process.is_mapped(played, call.chosen):
            self._start()
            self._process.map(played, call.chosen)

    def _asks_for_states(self, call: RecordCall) -> bool:
        """Have states of a call read by SDO, in real time only: in lockstep nothing would come between two cycles."""
        return not self._pace.time_waits and call.ask_for_states()

    def _choose(self, call: RecordCall, watched: Sequence[Entry], played: tuple[Entry, ...]) -> tuple[Entry, ...]:
        """Return the entries to sample; states are read by SDO if the call's objects do not all fit."""
        try:
            return self._process.choose(call.mapped, watched, played)
        except ObjectAccessError:
            if not self._asks_for_states(call):
                raise
            return self._process.choose(call.mapped, watched, played)

    def _run(
        self,
        cycles: int,
        outputs: Outputs | None,
        samples: Samples | None,
        envelope: CycleWatch | None,
        *,
        skip_missed: bool = False,
        epoch: int | None = _NOW,
    ) -> dict[Key, Integers]:
        last: tuple[int, int, dict[Key, Integers]] | None = None
        watch = None
        if envelope is not None and samples is not None:
            # Bound here: the closure is called once a millisecond.
            watcher, held = envelope, samples
            # Samples of a run that plays controlwords may be from before or after their effect.
            asked = envelope.epoch if epoch is _NOW else -1

            def watch(first: int, end: int) -> None:
                nonlocal last
                last = (first, end, held.decode(first, end))
                watcher.observe(last[2], asked, None, None if outputs is None else end)

        try:
            run_cycles(
                self._link,
                self._pace,
                cycles,
                outputs,
                samples,
                self._description.answer_timeout,
                observe=watch,
                barrier=self._catch_up if self._pace.time_waits else None,
                skip_missed=skip_missed,
            )
        finally:
            if samples is not None:
                samples.close()
        if samples is None and self._pace.time_waits:
            self._catch_up()
        timing = self._pace.timing
        if timing.late:
            logger.info(
                "%d of %d SYNCs were late, the worst by %.1f ms", timing.late, timing.cycles, 1e3 * timing.worst
            )
        if samples is None or skip_missed:
            return {}
        if last is not None and last[:2] == (0, cycles):
            return last[2]
        return samples.decode(0, cycles)
