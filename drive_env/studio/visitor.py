"""A visitor: one open browser page with the axis that it shows, and its interface for jobs."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any, TypeVar

from nicegui import Client, core, ui

from drive_env.drives.interface import Drives
from drive_env.studio.sentences import sentence

if TYPE_CHECKING:
    from drive_env.studio.axis_states import AxisState
    from drive_env.studio.session import Session

T = TypeVar("T")
KINDS = {"info": "info", "warning": "warning", "error": "negative", "done": "positive"}


class Visitor:
    """One open browser page.

    Args:
        session: The drives.
        client: NiceGUI's client of the page.
        axis: Number of the axis that it shows.

    Attributes:
        jog_speed: Jog speed of its axis.
        group: Axes that it commands together; all by default.
        group_speed: Jog speed of the group.
    """

    def __init__(self, session: Session, client: Client, axis: int) -> None:
        self.session = session
        self.client = client
        self.axis = axis
        self.jog_speed = self.group_speed = session.workspace.of(axis).jog_speed
        self.group = set(range(session.num_axes))

    @staticmethod
    def named(axes: Sequence[int]) -> str:
        """Return axes as text: "axis 0", "axes 0, 1"."""
        return f"ax{'i' if len(axes) == 1 else 'e'}s {', '.join(map(str, axes))}"

    @property
    def id(self) -> str:
        """The page's identifier."""
        return self.client.id

    @property
    def state(self) -> AxisState | None:
        """The state of its axis; None before the drives are open."""
        axes = self.session.axes
        return axes[self.axis] if self.axis < len(axes) else None

    def set(self, **changes: Any) -> None:
        """Store settings of its axis, named as in `AxisSettings`, for later pages."""
        self.keep(lambda: self.session.workspace.change(self.axis, **changes))

    def keep(self, change: Callable[[], None]) -> None:
        """Change the workspace; the page shows an error if its file cannot be written."""
        try:
            change()
        except OSError as error:
            self.say(sentence(error), "error")

    async def do(
        self, function: Callable[[Drives], T], title: str, *, paced: bool = True, quiet: bool = False
    ) -> T | None:
        """Run a job and return its result; None if it failed, which the page then shows."""
        future = self.session.do(function, title, page=self.id, paced=paced, quiet=quiet)
        try:
            return await asyncio.wrap_future(future)
        except Exception as error:
            self.say(f"{title}: {sentence(error)}", "error")
            return None

    def hand_in(self, function: Callable[[Drives], T], title: str) -> None:
        """Run a job without waiting for it; the page shows its error. Any thread may call it."""

        def tell(done: Future[T]) -> None:
            if not done.cancelled() and (error := done.exception()) is not None and core.loop is not None:
                core.loop.call_soon_threadsafe(self.say, f"{title}: {sentence(error)}", "error")

        self.session.do(function, title, page=self.id).add_done_callback(tell)

    def say(self, text: str, kind: str = "info") -> None:
        """Show a line on the page: info, warning, error or done."""
        if self.client.is_deleted:
            return
        with self.client:
            ui.notify(
                text, type=KINDS[kind], position="bottom-left", multi_line=True, close_button="Close",  # type: ignore[arg-type]
                timeout=12_000 if kind == "error" else 4_000,
            )  # fmt: skip
