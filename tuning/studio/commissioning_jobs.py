"""The commissioning of a session, and the jobs of its page, which run in the drives' thread."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import TYPE_CHECKING

from drive_env.drives.interface import Drives
from drive_env.drives.raw_gains import read_gains
from drive_env.studio.runs_folder import RUNS
from drive_env.studio.sentences import sentence
from tuning.commissioning.bench import CommissioningPlan
from tuning.commissioning.homing import offered_methods, unfit_for_homing
from tuning.commissioning.path import CommissioningPath
from tuning.runs.provenance import run_folder
from tuning.studio.tune_desk import TuneDesk, desk_of
from tuning.studio.tune_jobs import progress_of, rest

if TYPE_CHECKING:
    from drive_env.studio.session import Session


class CommissioningRoom:
    """The state of a commissioning that the pages of one session share.

    Args:
        session: The drives.

    Attributes:
        desk: State of the page Tune: machine and gains.
        plan: The user's plan.
        path: The present commissioning, or the last one that ended with success; None without one.
        page: Page that began it: it ends with that page.
        methods: Homing methods of the drives, each with its description.
        told: How the last one ended; "" before.
    """

    def __init__(self, session: Session) -> None:
        self.desk: TuneDesk = desk_of(session)
        self.plan = CommissioningPlan()
        self.path: CommissioningPath | None = None
        self.page = ""
        self.methods: dict[int, str] = {}
        self.told = ""
        session.at_end.append(lambda: self.end("the studio ended"))

    def begin(self, page: str) -> Callable[[Drives], None]:
        """Return the job that brings the axes to rest and saves the state before."""

        def job(drives: Drives) -> None:
            self.end("another one was begun")
            rest(drives)
            with self.desk.target(drives) as target:
                self.methods = {} if unfit_for_homing(target) else offered_methods(target)
                path = CommissioningPath(target, self.plan, run_folder("commission", RUNS))
                path.__enter__()
            self.path, self.page, self.told = path, page, ""
            self.desk.touch()

        return job

    def run(self, name: str) -> Callable[[Drives], None]:
        """Return the job that runs a step; a stop or a bus error ends the commissioning and restores everything."""

        def job(drives: Drives) -> None:
            path = self._path()
            try:
                state = path.run(name, lambda what, share: progress_of(self.desk, what)(share))
            except BaseException as error:
                stopped = "" if self.desk.session.job is None else self.desk.session.job.stopped
                self.end(stopped or sentence(error))
                raise
            finally:
                self.desk.gains = read_gains(drives)
                self.desk.touch()
            if state.state == "failed":
                raise RuntimeError(state.lines[0])

        return job

    def back_to(self, name: str) -> Callable[[Drives], None]:
        """Return the job that goes back to a step."""

        def job(drives: Drives) -> None:
            self._path().back_to(name)
            self.desk.touch()

        return job

    def leave(self, page: str, why: str) -> None:
        """End the commissioning of a closed page."""
        if self.path is not None and self.page == page:
            self.desk.session.do(lambda drives: self.end(why), "End of the commissioning")

    def end(self, why: str) -> None:
        """End the commissioning in the drives' thread: unless it was kept, the drives are switched off and restored."""
        path, self.path = self.path, None
        if path is None:
            return
        self.told = f"It ended: {why}. "
        try:
            path.__exit__(None, None, None)
            kept = f"its parameters are kept, and drive-tune undo {path.file} takes them back on a bus"
            self.told += kept if path.is_kept else "The drives are off, and have their parameters from before."
        except Exception as error:
            self.told += sentence(error)
            raise
        finally:
            self.desk.touch()

    def _path(self) -> CommissioningPath:
        if self.path is None:
            raise ValueError("no commissioning is under way; begin one")
        return self.path


_rooms: weakref.WeakKeyDictionary[Session, CommissioningRoom] = weakref.WeakKeyDictionary()


def room_of(session: Session) -> CommissioningRoom:
    """Return the commissioning of a session, the same for all its pages."""
    if session not in _rooms:
        _rooms[session] = CommissioningRoom(session)
    return _rooms[session]
