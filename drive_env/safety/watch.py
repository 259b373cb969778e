"""Monitors the drives, by every sample that comes, and by a separate thread while the program runs no cycles."""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.roles import Role
from drive_env.fieldbus.errors import BusError
from drive_env.safety.axes import Axes
from drive_env.safety.errors import SafetyError, logged
from drive_env.safety.judging import Judging
from drive_env.safety.limits_in_force import LimitsInForce
from drive_env.safety.looks import Looks
from drive_env.safety.objects import CONTROLWORD, CURRENT, MODE_DISPLAY, POSITION, STATUSWORD, VL_VELOCITY
from drive_env.safety.stop_runner import StopRunner
from drive_env.safety.stopping import BLIND as BLIND_TIMEOUT
from drive_env.safety.stopping import LONGEST_FOLLOWING, LOST, RAMP_TIMEOUT
from drive_env.safety.supervisor import Supervisor
from drive_env.safety.watchdogs import Watchdogs
from mechanics.arrays import Integers, Mask

if TYPE_CHECKING:
    from drive_env.safety.watched_drives import WatchedDrives

logger = logging.getLogger(__name__)


STALE, STALE_OFF = 0.008, 0.015  # s after which live drives, and drives that are off, are looked at
BLIND = 0.2  # s for which a live axis may be unseen, in spite of requests, before it is stopped
MISSED = 3  # consecutive SYNCs without samples from a node that otherwise answers: it is not operational
MOST_STOP_CYCLES = 5000  # in lockstep
SILENT_CYCLE = 0.1  # s of lockstep time counted when no node answers
LONGEST_STOP = LONGEST_FOLLOWING + RAMP_TIMEOUT + BLIND_TIMEOUT + LOST + 2.0  # s, all grades together
AT_ONCE = 0.1  # s after a signal within which a second one counts as the same


class Watch:
    """Watches the drives, and whether the program goes on.

    Args:
        drives: The drives.
        axes: Their present state.
        limits: The limits in force.
        stops: The stop that is under way.
        watchdogs: The drives' own watchdogs.
        prepare: Has the watched objects mapped to PDOs.
        poll: Sends a SYNC and has its samples observed; False if a node sent none, None if cycles are under way.

    Attributes:
        looks: The objects that come with every SYNC, and those that are read.
        booted: Positions of nodes that have restarted by themselves.
    """

    def __init__(
        self,
        drives: WatchedDrives,
        axes: Axes,
        limits: LimitsInForce,
        stops: StopRunner,
        watchdogs: Watchdogs,
        prepare: Callable[[], None],
        poll: Callable[[], bool | None],
    ) -> None:
        self._drives = drives
        self._known = drives.description.dictionary
        self._axes = axes
        self._limits = limits
        self._stops = stops
        self._watchdogs = watchdogs
        self._prepare = prepare
        self._poll = poll
        self._has_gate = drives.device is not None and bool(drives.device.mode_gate)
        gate = self._known.find(Role.MODE_GATE) if self._has_gate else None
        self._judging = Judging(self._known, axes, limits, self.modes, stops.stop_for, gate)
        self.looks = Looks(drives, axes, limits, self._observe_axis)
        self._supervisor: Supervisor | None = None
        self._has_seen_all = False  # from then on the supervisor looks, too; before, it only feeds the watchdogs
        self._missed = 0
        self._alive = time.monotonic()
        self._pending: SafetyError | None = None  # to be raised in the program's thread
        self._told_at = -math.inf  # when a signal came to end the program [s]
        self._asked: str | None = None  # why another thread wants everything stopped
        self.booted: set[int] = set()
        self._told_of: set[int] = set()  # those of `booted` that were reported

    @property
    def is_supervised(self) -> bool:
        """Whether the thread runs."""
        return self._supervisor is not None

    def begin(self) -> None:
        """Start the thread, unless it runs or time waits for the program.

        Until `first_look` has seen every axis it only feeds the watchdogs, as long as the program does not stall: on a
        slow bus the configuration before takes longer than a drive waits for its master.
        """
        if not self._drives.time_waits and self._supervisor is None:
            self._missed = 0
            self.alive()
            self._supervisor = Supervisor(self._turn, self._fail)
            self._supervisor.start()

    def end(self) -> None:
        """End the thread and any stop under way: the drives are not watched any more."""
        if self._supervisor is not None:
            self._supervisor.close()
            self._supervisor = None
        self._axes.is_armed = self._has_seen_all = False
        self._stops.current = None
        self._watchdogs.end()
        self._told_at = -math.inf
        self._asked = None

    def raise_pending(self) -> None:
        """Raise once for a stop that the supervisor made meanwhile."""
        pending, self._pending = self._pending, None
        if pending is not None:
            raise pending

    def note_restart(self, node: int) -> None:
        """Note that a node (by position) has booted without a reset of ours."""
        self.booted.add(node)
        self._told_of.discard(node)

    def tell_to_end(self) -> None:
        """Begin to stop, at the supervisor's next turn; callable from a signal handler."""
        self._told_at = time.monotonic()
        if self._supervisor is not None:
            self._supervisor.wake()

    def ask_to_stop(self, reason: str) -> None:
        """Have live axes stopped at the supervisor's next turn; callable from any thread."""
        supervisor = self._supervisor
        if supervisor is not None:  # without a supervisor no axis is live, and axes enabled later are not meant
            self._asked = reason
            supervisor.wake()

    def carry_on(self) -> None:
        """Report at the program's next call that a signal has stopped it, since it continues."""
        if self.is_told_to_end:
            self._pending = SafetyError("the drives were stopped, since a signal ended the program")

    def forget_signal(self) -> None:
        """Note that the program goes on after a signal, since it enables an axis."""
        self._told_at = -math.inf

    @property
    def is_told_to_end(self) -> bool:
        """Whether a signal has begun a stop that is still under way."""
        if time.monotonic() - self._told_at < AT_ONCE:
            return True
        return math.isfinite(self._told_at) and self._stops.current is not None and not self._stops.current.is_over

    def alive(self) -> None:
        """Reset the stall timer: the program waits for an answer."""
        if not self._is_supervisor():
            self._alive = time.monotonic()

    def _is_supervisor(self) -> bool:
        return self._supervisor is not None and self._supervisor.is_this_thread()

    def modes(self) -> Integers:
        """Return the mode of operation of every axis; in the supervisor's thread the last one read."""
        if self._drives.description.has(MODE_DISPLAY) and not self._is_supervisor():
            self._axes.mode = self._drives.read_entry(self._known.find(MODE_DISPLAY))
        return self._axes.mode

    def first_look(self) -> None:
        """See every axis once, or raise SafetyError: an axis that cannot be seen is not moved."""
        if not self._drives.is_dry:
            self._see_all()
        self.alive()
        self._has_seen_all = True

    def _see_all(self) -> None:
        has = self._drives.description.has
        needed = ((has(POSITION) or has(VL_VELOCITY), "6064h"), (has(STATUSWORD), "6041h"))
        missing = [label for is_there, label in needed if not is_there]
        if missing:
            raise SafetyError(f"the EDS has no {', '.join(missing)}: the drives cannot be monitored; complete the EDS")
        if not self._drives.time_waits:
            self._prepare()
            self._prove_operational()
        self.looks.sampled(self._drives.sampled_entries())
        for entry in self.looks.watched():
            values = self._drives.read_entry(entry)
            self._take({(entry.index, entry.sub): values[None, :]}, self._axes.epoch, self._axes.everywhere)

    def _prove_operational(self) -> None:
        """Raise SafetyError if a node that was started sends no process data."""
        deadline = time.monotonic() + self._drives.description.answer_timeout
        while self._poll() is False:
            if time.monotonic() > deadline:
                break
            self._drives.must_start()
            self._drives.start()
        else:
            return
        raise SafetyError(
            "a node sends no process data at SYNC, though it was started: it cannot be monitored; "
            f"{self._drives.link.wording.check_samples}"
        )

    def observe(self, rows: Mapping[Key, Integers], epoch: int, where: Mask | None = None) -> None:
        """Check samples, each object of shape (rows, num_axes); stop and raise SafetyError beyond a limit.

        Args:
            rows: The samples, one communication cycle apart.
            epoch: The envelope's epoch when they were requested.
            where: The axes that they belong to; None: all.
        """
        self.alive()
        with self._axes.lock:
            if self._drives.time_waits and (where is None) and self.looks.is_short:
                rows = self.looks.with_unsampled(rows)
            if self._drives.time_waits:
                self._axes.clock += len(next(iter(rows.values()))) * self._drives.description.cycle if rows else 0.0
            seen = self._axes.everywhere if where is None else where
            were_judged = self._stops.judged() if self._has_gate else seen
            self._take(rows, epoch, seen)
            if self._drives.time_waits and self._stops.current is not None:
                self._stops.hold()
                self._stops.step()
            if (pending := self._pending) is not None and not self._is_supervisor():
                self._pending = None
                raise pending
            if self._has_gate:
                self._judging.judge_heard(rows, (were_judged | self._stops.judged()) & seen)
            self._judging.judge(rows, self._stops.judged())

    def _take(self, rows: Mapping[Key, Integers], epoch: int, where: Mask) -> None:
        if self._axes.take(rows, epoch, where):
            self._limits.forget()

    def _observe_axis(self, rows: Mapping[Key, Integers], epoch: int, where: Mask) -> None:
        with self._axes.lock:
            were_judged = self._stops.judged() if self._has_gate else where
            self._take(rows, epoch, where)
            if self._has_gate:
                self._judging.judge_heard(rows, (were_judged | self._stops.judged()) & where)
            known = {POSITION: self._axes.position, STATUSWORD: self._axes.status}
            seen = {key: np.where(where, row, known.get(key, 0)) for key, row in rows.items()}
            self._judging.judge(seen, self._stops.judged() & where)

    def look_for_live(self) -> bool:
        """Return whether an axis is live by its present statusword; without an answer its last state counts."""
        keys = (STATUSWORD, POSITION, self._axes.velocity_object)
        entries = (self._known.find(key) for key in keys if self._drives.description.has(key))
        with contextlib.suppress(SafetyError):  # the caller is about to stop; beyond a limit the stop has already begun
            self.looks.ask(list(entries))
        return bool(self._axes.may_turn.any())

    def await_stop(self, *, ends: bool = False) -> None:
        """Wait until a stop under way is over: the program's next call must not cut it short."""
        stop = self._stops.current
        if stop is None:
            return
        cycles, deadline = 0, time.monotonic() + LONGEST_STOP
        while not stop.is_over and self._stops.current is stop:
            cycles += 1
            if not self._drives.time_waits and time.monotonic() > deadline:
                logger.error("a stop is not over after %g s", LONGEST_STOP)
                break
            if self._drives.time_waits:
                if cycles > MOST_STOP_CYCLES:
                    break
                self._stops.hold()
                self._pass_cycle()
            elif self._supervisor is None:
                break
            else:
                self.alive()
                time.sleep(0.002)
        if ends:
            for axis in sorted(stop.axes.keys() - self._axes.lost):
                with logged():
                    self._drives.write_raw(self._known.find(CONTROLWORD), axis, cia402.DISABLE_VOLTAGE)
                    self._axes.in_flight[axis] = False
            self._axes.epoch += 1
            self._stops.current = None

    def _pass_cycle(self) -> None:
        """Let one cycle of lockstep pass, and look at the axes that answer."""
        try:
            self._drives.pass_cycle()
        except BusError as error:
            logger.error("%s", error)
            self._axes.clock += SILENT_CYCLE
        keys = (STATUSWORD, POSITION, self._axes.velocity_object, CURRENT)
        self.looks.ask([self._known.find(key) for key in keys if self._drives.description.has(key)])
        self._axes.clock += self._drives.description.cycle
        with self._axes.lock:
            if self._stops.current is not None:
                self._stops.step()

    # --- the supervisor's thread -------------------------------------------------------------------------------------
    def _turn(self) -> None:
        """Take a turn: send a sign of life, look at the drives, advance a stop, check whether the program stalls.

        Raises:
            BusError: If the bus failed in one of them; the others are done in any case.
        """
        if not self._has_seen_all:
            if not self._stalls(time.monotonic() - self._alive):
                self._watchdogs.keep()
            return
        failure: BusError | None = None
        for act in (
            self._watchdogs.keep,
            self._obey_signal,
            self._stops.hold,
            self._look,
            self._go_on_stopping,
            self._look_after,
        ):
            try:
                act()
            except SafetyError as error:
                logger.error("%s", error)
                self._pending = error
            except BusError as error:
                failure = error
        if failure is not None:
            raise failure

    def _obey_signal(self) -> None:
        if self.is_told_to_end and self._axes.may_turn.any():
            with self._axes.lock:
                self._stops.begin(self._axes.may_turn, holds=False)
        asked, self._asked = self._asked, None
        if asked is not None and self._axes.may_turn.any():
            self._stops.stop_for(asked, "enable them again to go on")

    def _go_on_stopping(self) -> None:
        with self._axes.lock:
            if self._stops.current is not None:
                self._stops.step()

    def _stalls(self, pause: float) -> bool:
        """Return whether the program has made no call for longer than the `stall` limit; False without that limit."""
        return self._limits.user.stall is not None and pause > self._limits.user.stall

    def _fail(self) -> None:
        """Send a last quick stop, and leave the drives to their watchdogs."""
        with self._axes.lock, logged():
            self._stops.begin(self._axes.may_turn, holds=False)
            self._axes.lost.update(np.flatnonzero(self._axes.may_turn).tolist())
        self._watchdogs.cease()
        self._pending = SafetyError(
            "the drives cannot be monitored any more, and stop by their own watchdogs; see the log"
        )

    def _look(self) -> None:
        """Refresh the samples if the newest is too old."""
        now = time.monotonic()
        live = bool(self._axes.may_turn.any())
        if live:
            self.looks.ask_unsampled()
        if now - float(self._axes.seen.min()) < (STALE if live else STALE_OFF):
            return
        came = self._poll()
        if came:
            self._missed = 0
        elif came is None and now - float(self._axes.seen.min()) < 2 * STALE:
            return  # the program's own cycles are under way
        elif self.looks.ask(self.looks.watched()) and came is False:
            self._missed += 1

    def _look_after(self) -> None:
        """Stop axes that cannot be seen or whose node has restarted, and all axes if the program stalls."""
        now = time.monotonic()
        live = self._stops.judged()
        if not live.any():
            return
        if self.booted - self._told_of:
            self._told_of = set(self.booted)
            numbers = ", ".join(str(self._drives.nodes[k]) for k in sorted(self.booted))
            self._stops.stop_for(f"node {numbers} has restarted by itself", "check its power, and for another master")
        blind = live & (now - self._axes.seen > BLIND)
        if blind.any():
            axis = int(np.flatnonzero(blind)[0])
            self._stops.stop_for(
                f"axis {axis} could not be seen for {now - float(self._axes.seen[axis]):.2f} s",
                "check the node's power and wiring, the bus load, whether another master has stopped it, and how busy "
                "this computer is",
            )
        if self._missed >= MISSED:
            self._missed = 0
            self._drives.must_start()
            self._stops.stop_for(
                f"a node sends no process data any more: it left {self._drives.link.wording.operational}",
                "is another master there?",
            )
        if rival := self._watchdogs.take_rival():
            self._axes.is_armed = False  # the watchdogs are set anew when the program enables the next time
            self._stops.stop_for(rival, "end one of them")
        pause = now - self._alive
        if self._stalls(pause):
            logger.error("the program did nothing for %.2f s: quick stop", pause)
            with self._axes.lock:
                self._stops.begin(self._axes.may_turn, holds=True)
            self._pending = SafetyError(
                f"the drives were quick-stopped: the program made no call for {pause:.2f} s with an axis enabled; "
                f"the limit is {self._limits.user.stall:g} s; disable the drives before long work, or set "
                "Limits(stall=...)"
            )
