"""A hub on localhost: each TCP client is an slcan adapter on the same bus.

Every unmodified python-can client connects with `interface="slcan", channel="socket://127.0.0.1:PORT"`.

No client can block the bus for the others or exhaust the hub's memory. Clients take turns, frame by frame; a few frames
of each wait for the bus, a few more in the hub, and the rest stays in the client's own socket. A client that does not
read is dropped; if all places are taken, a newcomer gets that of the least active client.
"""

from __future__ import annotations

import errno
import ipaddress
import logging
import os
import select
import socket
import time
from collections import deque
from collections.abc import Iterator
from typing import Any

from drive_env.bus.slcan import TOKEN_WANTED, Channel, check_token
from drive_env.bus.transport import Incoming
from drive_env.bus.wire import BIT_RATE, Transmission, Wire
from drive_env.canopen.frames import Frame

LOOPBACK = "127.0.0.1"
MAX_CLIENTS = 64
MAX_STRANGERS = 16  # additional clients that have not yet presented the token
FILE_NUMBERS = 1024  # select() accepts no higher ones on most systems
CHUNK = 512  # bytes read from a client at a turn: 23 frames of eight bytes, at most 85 empty ones
# Frames of a client that wait for the bus, where the lowest identifier wins; further ones wait in its socket. More
# would only let a flood with another master's identifiers delay that master longer: 1 ms for 8 frames.
MAX_WAITING = 8
# Bytes that may wait for a client that does not read: five seconds of a full bus of 1 Mbit/s (216 kB/s as text), many
# times the pause of a garbage collection or a slow disk. The kernel holds KERNEL_BUFFER in addition.
MAX_UNSENT = 1 << 20
KERNEL_BUFFER = 1 << 18
BUSY = 1.0  # s: a client that has sent within it is active; one that was behind all that time sends without end
TOKEN_TIME = 10.0  # s within which a token must come; unmodified clients wait 2 s before they send anything
GUESS_TIME = 1.0  # s for which an address is refused after a wrong token
LOG_LINES, LOG_TIME = 20, 10.0  # warnings per LOG_TIME [s]; many clients must not fill a disk

logger = logging.getLogger(__name__)


def _is_loopback(address: str) -> bool:
    return ipaddress.ip_address(address).is_loopback


class _Client:
    """One connection: the socket, its channel, received frames, and data that could not be sent yet.

    Attributes:
        frames: Received frames that are not on the wire yet; each extended or not.
        unsent: Bytes for the client.
        blocked: Its socket accepts no more bytes at present.
        came: When it connected [s].
        spoke: When it last sent something [s].
        behind_since: Since when it has sent more at every turn than was read [s].
        was_open: Its channel has been on the bus.
        ended: The connection is closed; its received frames still go to the bus.
        dropped: The connection is closed, and its frames are discarded.
        told: A warning about its other bit rate was logged.
    """

    def __init__(self, connection: socket.socket, address: tuple[str, int], channel: Channel, now: float) -> None:
        self.socket = connection
        self.host = address[0]
        self.name = f"{address[0]}:{address[1]}"
        self.channel = channel
        self.frames: deque[tuple[Frame, bool]] = deque()
        self.unsent = bytearray()
        self.blocked = False
        self.came = self.spoke = self.behind_since = now
        self.was_open = False
        self.ended = False
        self.dropped = False
        self.told = False

    def fileno(self) -> int:
        return self.socket.fileno()

    def has_left(self) -> bool:
        """Whether the client has closed the connection, and everything it sent has been read."""
        try:
            return not self.ended and not self.socket.recv(1, socket.MSG_PEEK)
        except (BlockingIOError, InterruptedError):
            return False
        except OSError:
            return True

    def end(self) -> None:
        """Close the connection; received frames still go to the bus."""
        self.ended, self.blocked = True, False
        self.channel.is_open = False
        self.unsent.clear()
        self.socket.close()


class Hub:
    """The listening socket and its clients.

    A client sees the frames of all others and of the nodes, never its own. No client can end the hub or starve the
    others: an unknown command is answered with BELL, a client that has left is forgotten, one that does not read is
    dropped.

    Args:
        port: TCP port, 0 for a free one.
        host: Address to listen on; anything but loopback lets the network in and needs a token.
        bit_rate: Bit rate of the bus [bit/s]; the channel of a client that sets another one stays closed.
        token: The token that a client must present first (command K), 8 to 48 letters, digits, - and _; None: no token.

    Raises:
        OSError: If the address is not available.
        ValueError: For an address other than loopback without a token, and for an invalid token.
    """

    def __init__(
        self, port: int = 0, host: str = LOOPBACK, bit_rate: float = BIT_RATE, *, token: str | None = None
    ) -> None:
        if token is not None:
            check_token(token)
        elif not _is_loopback(socket.gethostbyname(host)):
            raise ValueError(f"{host} is not a loopback address: it is open to the network, which needs a token")
        self._bit_rate = bit_rate
        self._token = token
        self._clients: list[_Client] = []
        self._penalties: dict[str, float] = {}  # address -> until when it is refused [s]
        self._log_since, self._log_count = -LOG_TIME, 0
        self._listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            if os.name == "posix":  # elsewhere it would let two hubs share a port
                self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._listener.bind((host, port))
            self.host, self.port = self._listener.getsockname()[:2]
            if self._too_high(self._listener):
                raise OSError(errno.EMFILE, "this program has too many files open")
            self._listener.listen(MAX_CLIENTS)
        except BaseException:
            self._listener.close()
            raise
        self._listener.setblocking(False)

    @property
    def is_public(self) -> bool:
        """Whether other computers reach it."""
        return not _is_loopback(self.host)

    @property
    def channel(self) -> str:
        """The channel for python-can's slcan interface."""
        everywhere = self.host == "0.0.0.0"
        return f"socket://{LOOPBACK if everywhere else self.host}:{self.port}"

    def wait(self, timeout: float, wire: Wire) -> Iterator[Incoming]:
        """Wait up to `timeout` [s] for clients and return their frames, one of each client that has some.

        Args:
            timeout: Longest wait [s].
            wire: The wire of the frames; a client with MAX_WAITING frames waiting there has to wait, too.
        """
        readable: list[Any] = [self._listener]
        blocked = []
        for client in self._clients:
            if client.blocked:
                blocked.append(client)
            if not client.frames:
                if not client.ended:
                    readable.append(client)
            elif wire.waiting(client) < MAX_WAITING:
                timeout = 0.0
        try:
            # select.select, since selectors round the time-out of epoll up to whole milliseconds.
            ready, sendable, _ = select.select(readable, blocked, [], timeout)
        except (OSError, ValueError):  # a connection broke between two turns
            self._end_broken()
            return
        now = time.monotonic()
        for client in sendable:
            self._send(client)
        for one in reversed(ready):  # the listener last: clients that leave make room for new ones
            if one is self._listener:
                self._accept(now)
            elif not one.ended:
                self._read(one, now)
        if self._token is not None:
            self._drop_mute_strangers(now)
        for client in self._clients[:]:
            if client.frames and wire.waiting(client) < MAX_WAITING:
                frame, extended = client.frames.popleft()
                yield Incoming(frame, client, extended)
        self._forget_ended(wire)

    def deliver(self, ended: Transmission) -> None:
        """Queue a frame of the bus for every client but its sender; `flush` sends it."""
        lines: dict[bool, bytes] = {}
        for client in self._clients:
            if client is ended.sender or not client.channel.is_open:
                continue
            stamped = client.channel.time_stamps
            if stamped not in lines:
                lines[stamped] = client.channel.format(ended.frame, ended.extended, ended.end)
            self._append(client, lines[stamped])

    def flush(self) -> None:
        """Send waiting data, without waiting for a client."""
        for client in self._clients:
            if client.unsent and not client.blocked:
                self._send(client)

    def close(self) -> None:
        """Close all connections and the port."""
        self.flush()
        for client in self._clients:
            client.end()
        self._clients.clear()
        self._listener.close()

    # --- who comes and goes ---------------------------------------------------------------------------------------
    def _accept(self, now: float) -> None:
        try:
            connection, address = self._listener.accept()
        except OSError as error:  # has already left, or no file number left: a client gives up its own
            if error.errno in (errno.EMFILE, errno.ENFILE):
                self._make_room(now)
            return
        if self._too_high(connection):
            self._warn("client %s:%d was turned away: this program has too many files open", *address)
            connection.close()
            return
        if self._penalties.get(address[0], 0.0) > now:
            connection.close()
            return
        connection.setblocking(False)
        try:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, KERNEL_BUFFER)
        except OSError:  # some systems report here that the client has left
            connection.close()
            return
        client = _Client(connection, address, Channel(self._bit_rate, self._token), now)
        logger.info("client %s connected", client.name)
        if self._token is None:
            self._admit(client, now)
            return
        strangers = [other for other in self._clients if other.channel.locked and not other.ended]
        if len(strangers) >= MAX_STRANGERS:  # in the order of their arrival
            self._drop(strangers[0], "it has not shown the token, and others have come")
        self._clients.append(client)
        self._append(client, TOKEN_WANTED)

    def _admit(self, client: _Client, now: float) -> None:
        """Give a client a place on the bus, if need be that of another client."""
        taken = sum(not (other is client or other.channel.locked or other.dropped) for other in self._clients)
        if taken >= MAX_CLIENTS and not self._make_room(now, client):
            self._warn(
                "client %s was turned away: %d clients are on the bus, and all of them are busy", client.name,
                MAX_CLIENTS,
            )  # fmt: skip
            self._drop(client)
        elif client not in self._clients:
            self._clients.append(client)

    def _make_room(self, now: float, newcomer: _Client | None = None) -> bool:
        """Drop the client that needs its place least; False if all are active.

        In this order: a client that has left while its frames still wait, one that never opened its channel, the one
        silent for longest, one that sends more than the bus can carry. A working master keeps its place: it sends
        several times a second and waits for answers.
        """
        others = [c for c in self._clients if not (c is newcomer or c.channel.locked or c.dropped)]
        for client in others:
            if client.frames and client.has_left():  # its end is noticed otherwise only after its frames
                client.end()
        gone = [c for c in others if c.ended]
        unopened = [c for c in others if not c.was_open]
        silent = sorted((c for c in others if now - c.spoke > BUSY), key=lambda c: c.spoke)
        flooding = sorted((c for c in others if now - c.behind_since > BUSY), key=lambda c: c.behind_since)
        for found, why in (
            (gone, ""),
            (unopened, "a newcomer needs its place, and it has not opened its channel"),
            (silent, "a newcomer needs its place, and it has been silent for longest"),
            (flooding, "a newcomer needs its place, and it sends more than the bus takes"),
        ):
            if found:
                self._drop(found[0], why)
                return True
        return False

    def _refuse(self, client: _Client, now: float) -> None:
        """Drop a client that presented a wrong token, and refuse its address for a while."""
        self._warn("client %s was dropped: its token is wrong; its address waits %g s", client.name, GUESS_TIME)
        self._penalties = {host: until for host, until in self._penalties.items() if until > now}
        self._penalties[client.host] = now + GUESS_TIME
        for other in self._clients:  # of several tokens tried at once only the first one counts
            if other.host == client.host and other.channel.locked:
                self._drop(other)

    def _drop_mute_strangers(self, now: float) -> None:
        for client in self._clients:
            if client.channel.locked and not client.ended and now - client.came > TOKEN_TIME:
                self._drop(client, f"it has not shown the token within {TOKEN_TIME:g} s")

    def _drop(self, client: _Client, why: str = "") -> None:
        """End a client and discard all its frames."""
        if why:
            self._warn("client %s was dropped: %s", client.name, why)
        client.frames.clear()
        client.dropped = True
        client.end()

    def _forget_ended(self, wire: Wire) -> None:
        """Forget clients that have gone, once their frames are on the bus, and dropped ones at once."""
        for client in [c for c in self._clients if c.ended]:
            if client.dropped or not (client.frames or wire.waiting(client)):
                self._clients.remove(client)
                wire.forget(client)
                logger.info("client %s disconnected", client.name)

    @staticmethod
    def _too_high(one: socket.socket) -> bool:
        """Whether a socket's file number is too high for select()."""
        return os.name == "posix" and one.fileno() >= FILE_NUMBERS

    def _end_broken(self) -> None:
        for client in self._clients:
            if client.fileno() < 0:
                client.end()

    def _warn(self, text: str, *values: object) -> None:
        """Log a warning, but only the first ones within LOG_TIME."""
        now = time.monotonic()
        if now - self._log_since > LOG_TIME:
            if self._log_count > LOG_LINES:
                logger.warning("%d more lines about clients were left out", self._log_count - LOG_LINES)
            self._log_since, self._log_count = now, 0
        self._log_count += 1
        if self._log_count <= LOG_LINES:
            logger.warning(text, *values)

    # --- what comes and goes --------------------------------------------------------------------------------------
    def _read(self, client: _Client, now: float) -> None:
        try:
            data = client.socket.recv(CHUNK)
            self._acknowledge_at_once(client)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:
            data = b""
        if not data:
            client.end()
            return
        client.spoke = now
        if len(data) < CHUNK:
            client.behind_since = now
        channel, was_locked = client.channel, client.channel.locked
        frames, answer = channel.feed(data)
        if channel.wrong_token:
            self._refuse(client, now)
            return
        if was_locked and not channel.locked:
            self._admit(client, now)
            if client.ended:
                return
        client.was_open = client.was_open or channel.is_open
        client.frames.extend(frames)
        self._append(client, answer)
        if channel.refused and not client.told:
            client.told = True
            self._warn(
                "client %s asked for %g kbit/s and stays off the bus, which has %g kbit/s; give both the same",
                client.name, channel.bit_rate / 1e3, self._bit_rate / 1e3,
            )  # fmt: skip

    @staticmethod
    def _acknowledge_at_once(client: _Client) -> None:
        """Keep the kernel from delaying its acknowledgement.

        pyserial leaves Nagle's algorithm on: of two frames sent in a row the second waits for the acknowledgement of
        the first, which the kernel would hold back for 40 ms unless something is sent anyway.
        """
        if hasattr(socket, "TCP_QUICKACK"):
            client.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)

    def _append(self, client: _Client, data: bytes) -> None:
        """Queue bytes for a client; a client that leaves too many of them unread is dropped."""
        if len(client.unsent) + len(data) > MAX_UNSENT:
            self._drop(client, f"it does not read, and {len(client.unsent) / 1e3:.0f} kB wait for it")
        else:
            client.unsent += data

    def _send(self, client: _Client) -> None:
        try:
            sent = client.socket.send(client.unsent)
        except (BlockingIOError, InterruptedError):
            client.blocked = True
            return
        except OSError as error:
            if error.errno not in (errno.EPIPE, errno.ECONNRESET, errno.ECONNABORTED):
                self._warn("client %s: %s", client.name, error)
            client.end()
            return
        del client.unsent[:sent]
        client.blocked = bool(client.unsent)
