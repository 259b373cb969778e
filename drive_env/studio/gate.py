"""Access control of the studio: the requested host, the origin of a page, and the token for other addresses.

A page of another site must not command drives through a visitor's browser: its requests have its own Origin, and a name
that it has pointed at this computer (DNS rebinding) is no host of ours. Nor may it show one of our pages in a frame, in
which a click meant for its page would act on ours. If the studio is open to the network, a token is required once, in
the printed address, and then kept in a cookie.
"""

from __future__ import annotations

import hmac
import http.cookies
import ipaddress
import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any
from urllib.parse import parse_qsl, quote, urlencode, urlsplit

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Any]]
Send = Callable[[Any], Awaitable[None]]

COOKIE = "drive_env_studio"
QUERY = "token"
TOKEN_BYTES = 16  # random bytes: 22 characters
LEAST_TOKEN = 12  # characters
LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")
ONCE = ("host", "origin")  # headers that, if given twice, two readers of a request could interpret differently
FRAME_OPTIONS = b"x-frame-options"
NO_FRAMES = [(FRAME_OPTIONS, b"DENY"), (b"content-security-policy", b"frame-ancestors 'none'")]


def is_loopback(host: str) -> bool:
    """Return whether an address can be reached from this computer only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def new_token() -> str:
    """Return a new random token."""
    return secrets.token_urlsafe(TOKEN_BYTES)


def checked_token(token: str) -> str:
    """Check a token and return it; ValueError if it is too short, or cannot be part of an address."""
    if len(token) < LEAST_TOKEN or not all(letter.isalnum() or letter in "-_" for letter in token):
        raise ValueError(
            f"a token of {len(token)} characters is not valid: it takes {LEAST_TOKEN} or more letters, digits, - and "
            "_; leave --token out, and one is made"
        )
    return token


class StudioGate:
    """Passes requests and websockets on if their origin is allowed.

    Args:
        app: The application behind it.
        host: Address on which the server listens.
        port: Its port.
        token: Token that visitors need; None on a loopback address.
    """

    def __init__(self, app: Callable[[Scope, Receive, Send], Awaitable[None]], host: str, port: int,
                 token: str | None) -> None:  # fmt: skip
        self._app = app
        self._token = token
        names = LOOPBACK_NAMES if is_loopback(host) else ()
        self._hosts = {_with_port(name, port) for name in (*names, host)} if token is None else None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or pass it on."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        send = _unframed(send)
        given = [(name.decode("latin-1"), value.decode("latin-1")) for name, value in scope["headers"]]
        headers = dict(given)
        refusal = self.refusal(headers) or _malformed(scope["path"], [name for name, _ in given])
        if not refusal and self._token is not None and not self._has_cookie(headers):
            if scope["type"] == "http" and self._asks_in(scope):
                await _redirect(scope, self._token, send)
                return
            refusal = 401, "This studio needs a token: open the address that drive-env studio has printed."
        if not refusal:
            await self._app(scope, receive, send)
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 4400 + refusal[0] % 100, "reason": refusal[1][:100]})
        else:
            await _answer(send, *refusal)

    def refusal(self, headers: MutableMapping[str, str]) -> tuple[int, str] | None:
        """Return status and reason of a refusal by Host and Origin; None if the request is allowed."""
        host = headers.get("host", "").lower()
        if self._hosts is not None and host not in self._hosts:
            return (
                421,
                f"There is no studio named {host or 'nothing'}: open the address that drive-env studio has printed.",
            )
        origin = headers.get("origin")
        if origin is not None and _place_of(origin) != host:
            return 403, f"Pages of {origin} may not use this studio."
        return None

    def _has_cookie(self, headers: MutableMapping[str, str]) -> bool:
        try:
            jar = http.cookies.SimpleCookie(headers.get("cookie", ""))
        except http.cookies.CookieError:
            return False
        return COOKIE in jar and self._is_token(jar[COOKIE].value)

    def _asks_in(self, scope: Scope) -> bool:
        query = dict(parse_qsl(scope["query_string"].decode("latin-1")))
        return self._is_token(query.get(QUERY, ""))

    def _is_token(self, given: str) -> bool:
        return self._token is not None and hmac.compare_digest(given.encode(), self._token.encode())


def _malformed(path: str, names: list[str]) -> tuple[int, str] | None:
    """Return status and reason for a request that no browser sends and programs may misread; None for others."""
    if twice := [name for name in ONCE if names.count(name) > 1]:
        return 400, f"The request has {names.count(twice[0])} {twice[0].capitalize()} headers; it may have one."
    if path.startswith("//") or "\\" in path or not path.isprintable():
        return 400, "There is no such address: it begins with two slashes, or has a backslash or a control character."
    return None


def _place_of(origin: str) -> str:
    """Return host and port of an origin; "" if the text is not an HTTP origin."""
    try:
        found = urlsplit(origin.lower())
    except ValueError:
        return ""
    return found.netloc if found.scheme in ("http", "https") else ""


def _unframed(send: Send) -> Send:
    """Wrap `send` so that no page may show the answer in a frame, unless the answer itself allows it."""

    async def answer(message: Any) -> None:
        if message["type"] == "http.response.start":
            headers = list(message.get("headers", ()))
            if all(name.lower() != FRAME_OPTIONS for name, _ in headers):
                message = {**message, "headers": [*headers, *NO_FRAMES]}
        await send(message)

    return answer


def _with_port(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


async def _redirect(scope: Scope, token: str, send: Send) -> None:
    """Set the cookie, and remove the token from the address."""
    query = [(k, v) for k, v in parse_qsl(scope["query_string"].decode("latin-1")) if k != QUERY]
    where = quote(scope["path"]) + (f"?{urlencode(query)}" if query else "")
    headers = [
        (b"location", where.encode()),
        (b"set-cookie", f"{COOKIE}={token}; Path=/; HttpOnly; SameSite=Lax".encode()),
    ]
    await send({"type": "http.response.start", "status": 303, "headers": headers})
    await send({"type": "http.response.body", "body": b""})


async def _answer(send: Send, status: int, text: str) -> None:
    headers = [(b"content-type", b"text/plain; charset=utf-8")]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": text.encode()})
