"""The thread of the pages: long computations of a page delay other pages, but neither quick stop nor life lines.

The web server receives requests in an event loop without computations; the pages run in another loop, in their own
thread.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Any]]
Send = Callable[[Any], Awaitable[None]]


class PagesThread:
    """An ASGI application that passes requests to another one, which runs in the event loop of this thread.

    Args:
        app: The other one.
    """

    def __init__(self, app: Callable[[Scope, Receive, Send], Awaitable[None]]) -> None:
        self._app = app
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self.loop.run_forever, name="drive studio pages", daemon=True)
        self._thread.start()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Have the other application answer a request."""
        here = asyncio.get_running_loop()

        async def receive_there() -> Any:
            return await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(_awaited(receive()), here))

        async def send_there(message: Any) -> None:
            await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(_awaited(send(message)), here))

        there = _awaited(self._app(scope, receive_there, send_there))
        with contextlib.suppress(asyncio.CancelledError):  # at its end, the server does not wait for a busy page
            await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(there, self.loop))

    def close(self) -> None:
        """End the thread after its current work, without waiting for it."""
        self.loop.call_soon_threadsafe(self.loop.stop)


async def _awaited(what: Awaitable[Any]) -> Any:
    return await what
