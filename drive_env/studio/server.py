"""The web server of the studio: its pages, the life line of each, and the quick stop, which waits for nothing.

The event loop of the server receives requests and computes nothing. It handles life lines and quick stop itself; all
other requests go to the pages, in their own thread (`pages_thread.py`), which may be busy for any time.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import AsyncIterator, Callable, Iterable
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import numpy as np
import uvicorn
from fastapi import FastAPI, Response, WebSocket, WebSocketDisconnect
from nicegui import Client, app, ui

from drive_env.safety.supervisor import SWITCH_INTERVAL
from drive_env.studio import motion_jobs
from drive_env.studio.gate import StudioGate, is_loopback
from drive_env.studio.layout import frame
from drive_env.studio.page import StudioPage
from drive_env.studio.pages_thread import PagesThread, Receive, Scope, Send
from drive_env.studio.session import Session
from drive_env.studio.visitor import Visitor
from mechanics.reading.untrusted import parse_json

logger = logging.getLogger(__name__)

ASSETS = Path(__file__).parent / "assets"
PORT = 29640  # no service is registered there
LOOPBACK = "127.0.0.1"
GRACE = 1  # s for browsers to close their connections at the end
RECONNECT = 3.0  # s
LONGEST_END = 4.0  # s for the pages to end; a busy page is not waited for
QUICK_STOP, LIFE = "/studio/quick-stop", "/studio/life"


class Studio:
    """The pages of a session.

    Args:
        session: The drives.
        pages: The pages in order; "/" leads to the first one.
    """

    def __init__(self, session: Session, pages: Iterable[StudioPage]) -> None:
        self.session = session
        self.pages = list(pages)
        self.visitors: dict[str, Visitor] = {}
        for page in self.pages:
            self._add(page)
        self._add_root()
        app.add_static_files("/studio/assets", ASSETS)

    def _add(self, page: StudioPage) -> None:
        @ui.page(page.path, title=f"{page.title} · drive-env studio")
        def show(client: Client, axis: int = 0) -> None:
            visitor = Visitor(self.session, client, max(0, axis))
            self.visitors[client.id] = visitor
            client.on_delete(lambda: self.visitors.pop(client.id, None))
            frame(self.session, visitor, self.pages, page)

    def _add_root(self) -> None:
        first = self.pages[0].path

        @ui.page("/")
        def root() -> Response:
            return Response(status_code=307, headers={"location": first})

    async def live(self, line: WebSocket, page: str) -> None:
        """Receive a page's beats until it is closed; then its motions end."""
        await line.accept()
        held: dict[int, int] = {}  # the page's number of a held button -> number of its motion
        presence = self.session.presence
        presence.beat(page)
        try:
            while True:
                message = parse_json(await line.receive_text())
                self._hear(page, message, held)
        except (WebSocketDisconnect, ValueError, KeyError, TypeError, OverflowError, RecursionError):
            pass
        finally:
            presence.leave(page)

    def _hear(self, page: str, message: dict[str, Any], held: dict[int, int]) -> None:
        presence, kind = self.session.presence, message["k"]
        if kind == "beat":
            presence.beat(page, held.get(int(message.get("held", 0)), 0))
        elif kind == "stop":
            self.session.stop_now("the button or the space bar of a page")
        elif kind == "turn":
            self._turn(page, message, held)
        elif kind == "release":
            self._release(page, held.pop(int(message["hold"]), 0))

    def _turn(self, page: str, message: dict[str, Any], held: dict[int, int]) -> None:
        """Turn the axis of a page, or its group, while it holds the button."""
        hold, direction, is_group = int(message["hold"]), int(message["direction"]), bool(message.get("group"))
        visitor = self.visitors.get(page)
        if visitor is None or not self.session.num_axes:
            return
        axes = sorted(visitor.group) if is_group else [visitor.axis]
        lasting = self.session.presence.begin(page, motion_jobs.masks_of(self.session.num_axes, axes), held=True)
        held[hold] = lasting.number
        speed = motion_jobs.turned_round(visitor.group_speed if is_group else visitor.jog_speed, direction)
        visitor.hand_in(motion_jobs.turn(self.session, axes, speed, lasting.number), f"Jog {visitor.named(axes)}")

    def _release(self, page: str, number: int) -> None:
        visitor = self.visitors.get(page)
        if number and (lasting := self.session.presence.end(number)) is not None and visitor is not None:
            axes = np.flatnonzero(lasting.axes).tolist()
            visitor.hand_in(motion_jobs.end_turn(axes), f"End of the jog of {visitor.named(axes)}")


class _SlowPages(logging.Filter):
    """Shortens NiceGUI's log of a browser that answers late (busy or asleep) to one line."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Remove the traceback from the record of a time-out."""
        if record.exc_info and isinstance(record.exc_info[1], TimeoutError):
            record.msg, record.args = f"a page answers late: {record.exc_info[1]}", ()
            record.exc_info = record.exc_text = None
        return True


SLOW_PAGES = _SlowPages()


class StudioServer(uvicorn.Server):
    """Serves until a signal; then stops the drives first."""

    def __init__(self, config: uvicorn.Config, stop: Callable[[str], None]) -> None:
        super().__init__(config)
        self._stop = stop

    def handle_exit(self, sig: int, frame: FrameType | None = None) -> None:
        """Stop the drives, then end; a second Ctrl-C ends without waiting.

        Uvicorn would raise the signal again at its end: the process would die before the drives are closed.
        """
        self._stop("the studio ends")
        self.force_exit = self.should_exit and sig == signal.SIGINT
        self.should_exit = True

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Close the connections and end the pages; continue without those that do not end in time."""
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(super().shutdown(sockets), LONGEST_END)


def web_app(studio: Studio, host: str, port: int, token: str | None) -> StudioGate:
    """Return the whole application: gate, quick stop and life lines, and the pages."""
    own, pages = _stops(studio), PagesThread(_pages(studio))

    async def behind(scope: Scope, receive: Receive, send: Send) -> None:
        await (own if scope.get("path") in (QUICK_STOP, LIFE) else pages)(scope, receive, send)

    return StudioGate(behind, host=host, port=port, token=token)


def _stops(studio: Studio) -> FastAPI:
    """Return the web application that does not wait for pages: quick stop and life lines."""
    web = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

    @web.post(QUICK_STOP)
    async def quick_stop() -> dict[str, bool]:
        studio.session.stop_now("the button or the space bar of a page")
        return {"asked": True}

    @web.websocket(LIFE)
    async def life(line: WebSocket, page: str = "") -> None:
        await studio.live(line, page)

    return web


def _pages(studio: Studio) -> FastAPI:
    """Return the web application of the pages."""
    web = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    for page in studio.pages:
        if page.attach is not None:
            page.attach(web, studio.session)
    ui.run_with(
        web, title="drive-env studio", dark=None, reconnect_timeout=RECONNECT, show_welcome_message=False,
        favicon=ASSETS / "studio.svg",
    )  # fmt: skip
    # NiceGUI searches its server among all Python objects, and inspecting one of python-canopen's raises an error.
    web.router.lifespan_context = _lifespan
    logging.getLogger("nicegui").addFilter(SLOW_PAGES)
    return web


@contextlib.asynccontextmanager
async def _lifespan(_: FastAPI) -> AsyncIterator[None]:
    """Start NiceGUI, and end it."""
    async with app.router.lifespan_context(app):
        yield


def listen(host: str, port: int) -> socket.socket:
    """Return a listening socket.

    Raises:
        ValueError: If the address or port cannot be used, with a remedy.
    """
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, port), family=family)
    except OSError as error:
        if error.errno == errno.EADDRNOTAVAIL:
            raise ValueError(
                f"cannot listen on {host}:{port}: this computer has no such address; give --listen one of its own"
            ) from None
        why = "another program has it" if error.errno == errno.EADDRINUSE else os.strerror(error.errno or 0)
        raise ValueError(
            f"cannot listen on {host}:{port}: {why}; end that program, or choose another --port (0: a free one)"
        ) from None
    except (OverflowError, UnicodeError) as error:
        raise ValueError(f"cannot listen on {host}:{port}: {error}; give --listen {LOOPBACK}, --port {PORT}") from None


def address(host: str, port: int, token: str | None) -> str:
    """Return the address to open in a browser."""
    shown = f"[{host}]" if ":" in host else host
    if not is_loopback(host) and host in ("0.0.0.0", "::"):
        shown = socket.gethostname()
    return f"http://{shown}:{port}/" + (f"?token={token}" if token else "")


class ServingTerms(NamedTuple):
    """The options of serving: address, token (None: not required), duration [s] (None: until a signal)."""

    host: str
    token: str | None = None
    duration: float | None = None


def serve_studio(
    session: Session, pages: list[StudioPage], sock: socket.socket, terms: ServingTerms, ready: Callable[[], None]
) -> None:
    """Serve a session until a signal; its drives are stopped and closed at the end, also after an error.

    Args:
        session: The drives; they are opened here.
        pages: The pages.
        sock: Socket that already listens.
        terms: Options of serving.
        ready: Called before the first request is served.
    """
    port = sock.getsockname()[1]
    studio = Studio(session, pages)
    web = web_app(studio, terms.host, port, terms.token)
    config = uvicorn.Config(web, log_level="warning", timeout_graceful_shutdown=GRACE, lifespan="on")
    server = StudioServer(config, session.stop_now)
    hang_up = getattr(signal, "SIGHUP", None)  # closing the terminal acts like Ctrl-C
    before = None if hang_up is None else signal.getsignal(hang_up)
    interval = sys.getswitchinterval()
    sys.setswitchinterval(min(interval, SWITCH_INTERVAL))  # a busy page must release the interpreter after this time
    if hang_up is not None and before is not signal.SIG_IGN:
        signal.signal(hang_up, server.handle_exit)
    session.when_not_opened = lambda: server.handle_exit(signal.SIGTERM)
    session.start()
    end = threading.Timer(terms.duration or 0.0, server.handle_exit, (signal.SIGTERM, None))
    end.daemon = True
    try:
        ready()
        if terms.duration is not None:
            end.start()
        with contextlib.suppress(KeyboardInterrupt):
            server.run(sockets=[sock])
    finally:
        end.cancel()
        session.close()
        sock.close()
        sys.setswitchinterval(interval)
        if hang_up is not None:
            signal.signal(hang_up, before)
