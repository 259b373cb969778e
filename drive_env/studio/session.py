"""The session: the one set of drives that all browser pages share, in a thread of its own.

Pages hand in jobs, functions of the drives; one runs at a time. Between jobs time passes: an emulated machine runs in
real time, drives of a bus are sampled. Stopping a motor does not wait for a job: `stop_now` acts from any thread, and
the running job ends at its next call. A job that moves axes belongs to its page: it ends with that page, and a job that
fails leaves no axis in motion.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.dictionary.quantities import Scale
from drive_env.drives import motion
from drive_env.drives.emergency import EmergencyMessage
from drive_env.drives.interface import Drives
from drive_env.fieldbus.errors import NoAnswerError
from drive_env.master.parameters import parameters
from drive_env.master.single_axes import SingleAxes
from drive_env.safety.errors import SafetyError
from drive_env.studio.axis_states import AxisState, AxisStates
from drive_env.studio.errors import JobEndedError, JobStoppedError
from drive_env.studio.presence import Presence
from drive_env.studio.recorder import ScopeRecorder
from drive_env.studio.scope_view import ScopeView
from drive_env.studio.sentences import sentence
from drive_env.studio.shared_drives import PIECE, SharedDrives
from drive_env.studio.workspace import Workspace
from mechanics.arrays import Mask

if TYPE_CHECKING:
    from drive_env.emulator.machine import Machines
    from drive_env.fieldbus.description import Description

logger = logging.getLogger(__name__)

T = TypeVar("T")

BUS_IDLE = 0.05  # s, sampled at once on a bus between two checks for jobs
RETRY = 0.5  # s until a failed bus is accessed again
STOP_WAIT = 3.0  # s for axes to come to rest before their voltage is switched off
KEPT = 200  # number of events
TOLD_ONCE = 0.5  # s within which another request to stop counts as the same one
PATIENCE = 10.0  # s for the thread to end
WATCH = 0.2  # s between two checks whether the drives' thread has stopped overdue motions


@dataclass(frozen=True)
class SessionEvent:
    """An event: time of day [s], level (info, warning, error), and text."""

    at: float
    level: str
    text: str


@dataclass(eq=False)
class Job:
    """A function of the drives, and its result.

    Attributes:
        title: Its purpose in a few words.
        page: Page that requested it; its motions stop with that page. "" for none.
        paced: Whether emulated time passes in real time during it.
        quiet: Whether pages do not show it.
        progress: Share that is done, None if unknown.
        told: Its present message.
        stopped: Why it must end; "" while it may continue.
    """

    function: Callable[[Drives], Any]
    title: str
    page: str
    paced: bool
    quiet: bool
    future: Future[Any] = field(default_factory=Future)
    progress: float | None = None
    told: str = ""
    stopped: str = ""
    is_told: bool = False  # whether the exception that stops it was raised: its cleanup must then be possible

    def refuse(self, error: BaseException) -> None:
        """End the job with an error before it begins, unless its page has cancelled it."""
        if self.future.set_running_or_notify_cancel():
            self.future.set_exception(error)


class Session:
    """The drives and their thread.

    Args:
        open_drives: Opens the drives, in the thread that will use them.
        title: Name of the drives for display.
        description: Description of the device.
        address: Options that opened drives of a bus: interface, channel, nodes, bitrate; empty for emulated ones.
        workspace: Settings of the pages; None begins with defaults.

    Attributes:
        state: "opening", "open", "failed", "closed".
        failure: Why it failed, as text.
        error: The exception if the drives could not be opened, else None.
        when_not_opened: Called by the drives' thread in this case.
        presence: The open pages.
        recorder: The recorder of samples.
        stored: Parameters by axis that the drive is known to have stored: those at the start, or when it stored last.
        scopes: The scope of each axis that a page has shown; it waits for its trigger even if no page shows it.
        at_end: Functions that restore changes, called by the drives' thread before the drives are closed, when nothing
            turns.
    """

    def __init__(
        self,
        open_drives: Callable[[], Drives],
        title: str,
        description: Description,
        address: Mapping[str, Any] | None = None,
        workspace: Workspace | None = None,
    ) -> None:
        self.title = title
        self.address = dict(address or {})
        self.description = description
        self.state = "opening"
        self.failure = ""
        self.error: BaseException | None = None
        self.when_not_opened: Callable[[], None] = lambda: None
        self.presence = Presence()
        self.recorder = ScopeRecorder(1, description.cycle)
        self.stored: dict[int, dict[Key, int]] = {}
        self.workspace = workspace or Workspace(description)
        self.scopes: dict[int, ScopeView] = {}
        self.at_end: list[Callable[[], object]] = []
        self.events: deque[SessionEvent] = deque(maxlen=KEPT)
        self.num_events = 0
        self._open = open_drives
        self._drives: SharedDrives | None = None
        self._real: Drives | None = None
        self._states: AxisStates | None = None
        self._jobs: deque[Job] = deque()
        self._waiting = threading.Condition()
        self._current: Job | None = None
        self._stop_asked: str = ""
        self._is_closing = False
        self._failed_at = self._told_at = -1e9
        self._sampled: dict[str, tuple[Key, ...]] = {}
        self._told_reason = ""
        self._is_left = False  # whether axes were already switched off since the last page was closed
        self._thread = threading.Thread(target=self._run, name="drive studio", daemon=True)
        self._ended = threading.Event()
        self._watch = threading.Thread(target=self._watch_pages, name="drive studio watch", daemon=True)

    # --- for pages, called from any thread ----------------------------------------------------------------------
    def start(self) -> None:
        """Open the drives."""
        self._thread.start()
        self._watch.start()

    def close(self) -> None:
        """Stop moving axes, close the drives, end the thread."""
        if self.state == "closed":
            return
        self.stop_now("the studio ends")
        with self._waiting:
            self._is_closing = True
            self._waiting.notify_all()
        if self._thread.is_alive():
            self._thread.join(PATIENCE)
        self._ended.set()

    def do(
        self, function: Callable[[Drives], T], title: str, *, page: str = "", paced: bool = True, quiet: bool = False
    ) -> Future[T]:
        """Run a function of the drives in their thread, after the jobs before it.

        Args:
            function: The job; it may let time pass, and is ended by an exception when it is stopped.
            title: Its purpose in a few words: "Move axis 0".
            page: Page that requests it: its motions stop with that page. "" for none.
            paced: Whether emulated time passes in real time during it; a search runs as fast as possible.
            quiet: Whether pages do not show it, such as frequent readings.

        Returns:
            Future with its result or exception: `JobEndedError` if it was stopped.
        """
        job = Job(function, title, page, paced, quiet)
        with self._waiting:
            if self._is_closing or self.state in ("failed", "closed"):
                job.refuse(RuntimeError(self.failure or "the drives are closed; start the studio again"))
                return job.future
            self._jobs.append(job)
            self._waiting.notify_all()
        return job.future

    def sample(self, page: str, keys: Iterable[Key]) -> None:
        """Set the objects to sample for a page, instead of its earlier ones."""
        self._sampled[page] = tuple(keys)
        self._choose_samples()

    def forget_samples(self, page: str) -> None:
        """Stop sampling objects for a page."""
        self._sampled.pop(page, None)
        self._choose_samples()

    def _choose_samples(self) -> None:
        states = self._states
        if states is not None:
            wanted = [key for keys in list(self._sampled.values()) for key in keys]
            self.recorder.objects = (*states.sampled, *wanted)

    def stop_now(self, reason: str) -> None:
        """Quick-stop all axes immediately, and end the running job and those that wait.

        It does not wait for the job, and not long for anything else: axes of a bus are commanded by the supervisor of
        their envelope; emulated axes here, or by the thread that lets their time pass, before its next piece.
        """
        with self._waiting:
            self._stop_asked = reason
            waiting, self._jobs = list(self._jobs), deque()
            if self._current is not None and not self._current.stopped:
                self._current.stopped = reason
        for job in waiting:
            job.refuse(JobEndedError(f"it was not begun: {reason}"))
        real, shared = self._real, self._drives
        if real is None or shared is None:
            return
        if real.safety is not None:
            real.safety.stop_at_once(reason)
        elif real.time_waits and shared.lock.acquire(timeout=PIECE):
            try:
                _stop_live(real)
            finally:
                shared.lock.release()

    def end_job(self, reason: str) -> None:
        """End the running job, and stop all axes, since it may have moved any."""
        self.stop_now(reason)

    def tell(self, text: str, progress: float | None = None) -> None:
        """Set message and progress of the present job; called by the job itself."""
        if self._current is not None:
            self._current.told, self._current.progress = text, progress

    def check(self) -> None:
        """End the present job if it was stopped; called by jobs that compute for long between two calls of drives.

        Raises:
            JobStoppedError: If it was stopped.
        """
        self._look()

    def glimpse(self, function: Callable[[Machines], T], patience: float = 1.0) -> T | None:
        """Return the result of a function of emulated machines between two pieces of time; None if `patience` runs out.

        Any thread may call it. It must only read: changes of a machine need a job.

        Args:
            function: It must be quick, since no time passes during it.
            patience: Longest wait [s].
        """
        shared = self._drives
        if shared is None or shared.machine is None or not shared.lock.acquire(timeout=patience):
            return None
        from drive_env.emulator.emulated_drives import emulated_of

        try:
            return function(emulated_of(shared).machine)
        finally:
            shared.lock.release()

    def say(self, level: str, text: str) -> None:
        """Add an event: level info, warning or error."""
        self.events.append(SessionEvent(time.time(), level, text))
        self.num_events += 1

    @property
    def job(self) -> Job | None:
        """The present job, None without one."""
        return self._current

    @property
    def waiting(self) -> int:
        """Number of waiting jobs."""
        return len(self._jobs)

    @property
    def is_emulated(self) -> bool:
        """Whether the drives are emulated."""
        return self._real is not None and self._real.machine is not None

    @property
    def axes(self) -> Sequence[AxisState]:
        """The state of every axis; empty before the drives are open."""
        return () if self._states is None else self._states.axes

    @property
    def scales(self) -> Sequence[Scale]:
        """The scales of each axis' units; empty before the drives are open."""
        return () if self._states is None else self._states.scales

    def plays(self, key: Key) -> bool:
        """Return whether the drives accept an object in every cycle; a process image may lack it."""
        bus = None if self._real is None else self._real.bus
        with contextlib.suppress(ObjectAccessError):
            if bus is not None:
                bus.link.process.check_played([self.description.dictionary.find(key)])
            return True
        return False

    def forget_faults(self, axis: int) -> None:
        """Remove the faults of an axis, which were reset."""
        if self._states is not None:
            self._states.forget_faults(axis)

    @property
    def lateness(self) -> str:
        """Share of late SYNCs of a bus since the start as text; "" for none, and for emulated drives."""
        bus = None if self._real is None else self._real.bus
        if bus is None or not bus.total_timing.late:
            return ""
        cycles, late, worst = bus.total_timing
        return f"{100.0 * late / cycles:.1f} % of the SYNCs were late, the worst by {1e3 * worst:.0f} ms"

    @property
    def num_axes(self) -> int:
        """Number of axes; 0 before the drives are open."""
        return 0 if self._real is None else self._real.num_axes

    # --- the thread of the drives -----------------------------------------------------------------------------------
    def _run(self) -> None:
        try:
            self._real = self._open()
        except BaseException as error:
            self.failure, self.error = sentence(error), error
            self.state = "failed"
            self._refuse_all(RuntimeError(self.failure))
            self.when_not_opened()
            return
        try:
            if self._real.bus is not None:
                self.description = self._real.bus.description  # it has the time between two SYNCs
            self.recorder = ScopeRecorder(self._real.num_axes, self.description.cycle)
            self._drives = SharedDrives(
                self._real, self.recorder, self._look, self._hear, self.presence.moves, self._why_stopped
            )
            self._drives.when_stored = self._read_stored
            self._states = AxisStates(self._real, self.description, self.workspace.units)
            self._choose_samples()
            self._drives.advance(PIECE)  # emulators are compiled here
            self._read_stored(np.ones(self.num_axes, bool))
            self.state = "open"
            while not self._is_closing:
                job = self._next()
                if job is None:
                    self._idle()
                else:
                    self._work(job)
        except BaseException as error:  # no error of a drive or a job may end the thread
            self.failure = sentence(error)
            logger.error("the session ends: %s", self.failure)
        finally:
            self._end()

    def _read_stored(self, where: Mask) -> None:
        """Read the parameters of the nodes of some axes: they are those stored after a start, or a write of 1010h."""
        assert self._drives is not None
        drives = self._drives
        axes = SingleAxes(drives, self.description)
        per_node = axes.description.num_axes
        there = [axis for axis in range(self.num_axes) if where.reshape(-1, per_node)[axis // per_node].any()]
        found: dict[int, dict[Key, int]] = {axis: {} for axis in there}
        for entry in parameters(axes):
            key = (entry.index, entry.sub)
            with contextlib.suppress(ObjectAccessError):
                values = drives.read(key)
                for axis in there:
                    found[axis][key] = int(values[axis])
        self.stored |= found

    def _end(self) -> None:
        real = self._real
        assert real is not None
        try:
            if real.safety is None:
                self._bring_to_rest(real)
            for put_back in self.at_end:
                try:
                    put_back()
                except Exception as error:
                    logger.error("%s", sentence(error))
            real.close()
        except BaseException as error:
            logger.error("closing the drives: %s", sentence(error))
        self.state = "failed" if self.failure else "closed"
        self._refuse_all(RuntimeError(self.failure or "the drives are closed; start the studio again"))

    def _refuse_all(self, error: BaseException) -> None:
        with self._waiting:
            waiting, self._jobs = list(self._jobs), deque()
        for job in waiting:
            job.refuse(error)

    def _next(self) -> Job | None:
        with self._waiting:
            if not self._jobs:
                return None
            self._current = self._jobs.popleft()
            return self._current

    def _work(self, job: Job) -> None:
        drives = self._drives
        assert drives is not None
        if not job.future.set_running_or_notify_cancel():  # its page has cancelled it
            with self._waiting:
                self._current = None
            return
        drives.paced, drives.moved = job.paced, np.zeros(self.num_axes, bool)
        try:
            result = job.function(drives)
        except (KeyboardInterrupt, SystemExit) as error:  # they would end the event loop that waits for it
            job.future.set_exception(JobEndedError(f"stopped: {error or job.stopped}"))
        except BaseException as error:
            if drives.moved.any() and not job.stopped:
                self._stop(drives.moved)
            job.future.set_exception(JobEndedError(f"stopped: {job.stopped}") if job.stopped else error)
        else:
            job.future.set_result(result)
        finally:
            drives.paced = True
            with self._waiting:
                self._current = None

    def _idle(self) -> None:
        """Let a short time pass, and process samples."""
        drives, states = self._drives, self._states
        assert drives is not None and states is not None
        if time.monotonic() - self._failed_at < RETRY:
            with self._waiting:
                self._waiting.wait(PIECE)
            return
        try:
            drives.advance(PIECE if drives.time_waits else BUS_IDLE)
            for told in states.refresh(drives, self.recorder):
                self.say("warning", told)
            drives.emergencies()
        except JobStoppedError:
            pass
        except SafetyError as error:  # the envelope has stopped the drives
            self._tell_stop(error)
        except Exception as error:  # a missing node: reported, and tried again
            self._failed_at = time.monotonic()
            states.lose(error.silent if isinstance(error, NoAnswerError) else ())
            told = sentence(error)
            if not self.events or self.events[-1].text != told:
                self.say("error", told)

    def _tell_stop(self, error: SafetyError) -> None:
        """Report why the envelope has stopped the drives, unless a requested stop was just reported."""
        if time.monotonic() - self._told_at > STOP_WAIT or not str(error).startswith(self._told_reason):
            self.say("error", sentence(error))

    def _look(self) -> None:
        """Do everything that must not wait for a job; called before each call and after each piece of time."""
        job = self._current
        if self._stop_asked:
            self._obey()
        if self.presence.is_coupled() and (newest := self.recorder.newest().get((cia402.STATUSWORD, 0))) is not None:
            self.presence.lose(~np.asarray(cia402.matches(newest, cia402.OPERATION_ENABLED)))
        for overdue in self.presence.take_overdue():
            self.say("warning", f"stopped: {overdue.why}")
            if job is not None and self._drives is not None and np.any(self._drives.moved & overdue.axes):
                job.stopped = job.stopped or overdue.why
            self._stop(overdue.axes)
        if not self.presence.is_abandoned():
            self._is_left = False
        elif self._is_any_live():
            self._leave_alone(job)
        if job is not None and not job.stopped:
            self._end_if_left(job)
        if job is not None and job.stopped and not job.is_told:
            job.is_told = True
            self._await_rest()
            raise JobStoppedError(job.stopped)

    def _end_if_left(self, job: Job) -> None:
        """End a job that moves axes and whose page is closed or silent, and stop these axes."""
        if why := self._why_left(job):
            assert self._drives is not None
            job.stopped = why
            self.say("warning", f"stopped: {job.title}: {why}")
            self._stop(self._drives.moved)

    def _why_left(self, job: Job | None) -> str:
        """Return why no page watches a job that moves axes; "" if a page does, or if the job moves nothing."""
        drives = self._drives
        moves = job is not None and drives is not None and not job.stopped and drives.moved.any()
        return self.presence.why_gone(job.page) if moves and job is not None and job.page else ""

    def _watch_pages(self) -> None:
        """Stop all axes if the drives' thread does not stop overdue motions because one of its calls takes too long.

        On a bus, set-points are played in a single call of any duration.
        """
        before: set[object] = set()
        while not self._ended.wait(WATCH):
            now: set[object] = set(self.presence.untaken())
            job = self._current
            if why := self._why_left(job):
                now.add(job)
            if before & now:
                self.stop_now(why or "the page of a motion is gone, or silent")
            before = now

    def _why_stopped(self) -> str:
        """Return why the present job was stopped; "" if it was not."""
        return "" if self._current is None else self._current.stopped

    def _await_rest(self) -> None:
        """Wait for rest of emulated axes: they would coast when a stopped job's cleanup switches their voltage off.

        Drives of a bus are brought to rest by the supervisor of their envelope.
        """
        real, drives = self._real, self._drives
        assert real is not None and drives is not None
        if not real.time_waits or real.safety is not None:
            return
        with drives.lock:
            live = np.asarray(cia402.is_live(real.read(cia402.STATUSWORD)))
            waited = 0.0
            while live.any() and waited < STOP_WAIT and motion.is_turning(real, live, PIECE):
                waited += PIECE

    def _obey(self) -> None:
        """Execute a `stop_now` in this thread."""
        reason, self._stop_asked = self._stop_asked, ""
        now = time.monotonic()
        if now - self._told_at > TOLD_ONCE:  # a page sends each request on two ways
            self.say("warning", f"quick stop: {reason}")
        self._told_at, self._told_reason = now, reason
        self._stop(np.ones(self.num_axes, bool))

    def _leave_alone(self, job: Job | None) -> None:
        """Stop and disable all axes, since no page shows an enabled axis."""
        if job is not None and not job.stopped:
            job.stopped = "the last page was closed"
        self._stop(np.ones(self.num_axes, bool))
        assert self._real is not None
        if self._bring_to_rest(self._real) and not self._is_left:
            self._is_left = True
            self.say("warning", "the last page was closed with an axis enabled: the axes were stopped and disabled")

    def _stop(self, axes: Mask) -> None:
        """Quick-stop live axes; it bypasses `_look`, which calls it."""
        self.presence.end_all(axes)
        real, drives = self._real, self._drives
        assert real is not None and drives is not None
        try:
            with drives.lock:
                _stop_live(real, axes)
        except SafetyError as error:  # the envelope already stops them
            self._tell_stop(error)
        except Exception as error:  # the bus failed: the drive's watchdog acts
            self.say("error", sentence(error))

    def _bring_to_rest(self, real: Drives) -> bool:
        """Wait until no axis turns, then switch the voltage off; return whether it was possible, else say why not."""
        assert self._drives is not None
        try:
            with self._drives.lock:
                live = _stop_live(real)
                waited = 0.0
                while live.any() and waited < STOP_WAIT and motion.is_turning(real, live, PIECE):
                    real.advance(PIECE)
                    waited += PIECE
                if live.any():
                    motion.disable(real, where=live)
            return True
        except Exception as error:
            self.say("error", sentence(error))
            return False

    def _is_any_live(self) -> bool:
        newest = self.recorder.newest().get((cia402.STATUSWORD, 0))
        return newest is not None and bool(np.any(cia402.is_live(newest)))

    def _hear(self, messages: Sequence[EmergencyMessage]) -> None:
        assert self._states is not None
        for message in messages:
            self.say(*self._states.hear(message))


def _stop_live(drives: Drives, axes: Mask | None = None) -> Mask:
    """Quick-stop the axes in "operation enabled"; return those whose power stage may be on."""
    status = drives.read(cia402.STATUSWORD)
    live = np.asarray(cia402.is_live(status)) & (True if axes is None else axes)
    enabled = np.asarray(live & cia402.matches(status, cia402.OPERATION_ENABLED))
    if enabled.any():
        motion.quick_stop(drives, where=enabled)
    return np.asarray(live)
