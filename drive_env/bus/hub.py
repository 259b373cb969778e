"""A hub on localhost: each TCP client is an slcan adapter on the same bus.

Every stock python-can client joins with `interface="slcan", channel="socket://127.0.0.1:PORT"`.
"""

from __future__ import annotations

import errno
import logging
import os
import select
import socket
from collections.abc import Callable, Hashable, Iterator
from typing import Any

from drive_env.bus.slcan import Channel
from drive_env.bus.transport import Incoming
from drive_env.bus.wire import BIT_RATE, Transmission

LOOPBACK = "127.0.0.1"
MAX_CLIENTS = 64  # select() takes no file number above 1,023 on most systems
CHUNK = 65_536  # bytes read from a client at a turn
MAX_UNSENT = 4 << 20  # bytes that may wait for a slow client; what comes beyond is lost, as in an adapter's buffer
MAX_WAITING = 512  # frames of a client that wait for the bus before it is read no further

logger = logging.getLogger(__name__)


class _Client:
    """One connection: the socket, its channel, and what could not be sent yet."""

    def __init__(self, connection: socket.socket, name: str, bit_rate: float) -> None:
        self.socket = connection
        self.name = name
        self.channel = Channel(bit_rate)
        self.unsent = bytearray()
        self.told = False  # that its bit rate is another one

    def fileno(self) -> int:
        return self.socket.fileno()


class Hub:
    """The listening socket and its clients.

    A client sees the frames of all others and of the nodes, never its own. Nothing that a client does ends the hub: a
    line that is no command is answered with BELL, a client that is gone is forgotten.

    Args:
        port: TCP port, 0 for a free one.
        host: Address to listen on; anything but loopback lets the network in.
        bit_rate: Of the bus [bit/s]; a client that sets another one stays closed.

    Raises:
        OSError: If the address cannot be had.
    """

    def __init__(self, port: int = 0, host: str = LOOPBACK, bit_rate: float = BIT_RATE) -> None:
        self._bit_rate = bit_rate
        self._clients: list[_Client] = []
        self._listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            if os.name == "posix":  # elsewhere it would let two hubs share a port
                self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._listener.bind((host, port))
            self._listener.listen(MAX_CLIENTS)
        except OSError:
            self._listener.close()
            raise
        self._listener.setblocking(False)
        self.host, self.port = self._listener.getsockname()[:2]
        self.lost = 0  # frames that slow clients did not get

    @property
    def channel(self) -> str:
        """What python-can's slcan interface takes as its channel."""
        everywhere = self.host == "0.0.0.0"
        return f"socket://{LOOPBACK if everywhere else self.host}:{self.port}"

    def wait(self, timeout: float, waiting: Callable[[Hashable], int]) -> Iterator[Incoming]:
        """Wait up to `timeout` [s] for clients and return their frames, in each client's order.

        Args:
            timeout: Longest wait [s].
            waiting: How many frames of a client the bus has not carried; above a limit it is not read.
        """
        # select.select, since selectors round the time-out of epoll up to whole milliseconds.
        readable = [client for client in self._clients if waiting(client) < MAX_WAITING]
        writable = [client for client in self._clients if client.unsent]
        watched: list[Any] = [*readable, self._listener]  # who goes makes room for who comes
        try:
            ready, sendable, _ = select.select(watched, writable, [], timeout)
        except OSError:  # a connection that broke between two turns
            self._forget_broken()
            return
        for client in sendable:
            self._send(client)
        for one in ready:
            if one is self._listener:
                self._accept()
            else:
                yield from self._read(one)

    def deliver(self, ended: Transmission) -> None:
        """Hand a frame of the bus to every client but its sender; it leaves with the next `flush`."""
        for client in self._clients:
            if client is ended.sender or not client.channel.is_open:
                continue
            if len(client.unsent) > MAX_UNSENT:
                client.channel.overrun = True
                self.lost += 1
            else:
                client.unsent += client.channel.format(ended.frame, ended.extended, ended.end)

    def flush(self) -> None:
        """Send what there is to send, without waiting for anybody."""
        for client in self._clients[:]:
            if client.unsent:
                self._send(client)

    def close(self) -> None:
        """Close all connections and the port."""
        self.flush()
        for client in self._clients:
            client.socket.close()
        self._clients.clear()
        self._listener.close()

    # --- inside ---------------------------------------------------------------------------------------------------
    def _accept(self) -> None:
        try:
            connection, address = self._listener.accept()
        except OSError:  # gone again already, or no file number left
            return
        name = f"{address[0]}:{address[1]}"
        if len(self._clients) >= MAX_CLIENTS:
            logger.warning("client %s was turned away: there are %d already", name, MAX_CLIENTS)
            connection.close()
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._clients.append(_Client(connection, name, self._bit_rate))
        logger.info("client %s has come", name)

    def _read(self, client: _Client) -> Iterator[Incoming]:
        try:
            data = client.socket.recv(CHUNK)
            self._acknowledge_at_once(client)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:
            data = b""
        if not data:
            self._forget(client)
            return
        frames, answer = client.channel.feed(data)
        client.unsent += answer
        if client.channel.refused and not client.told:
            client.told = True
            logger.warning(
                "client %s asked for %g kbit/s and stays off the bus, which has %g kbit/s; give both the same",
                client.name, client.channel.bit_rate / 1e3, self._bit_rate / 1e3,
            )  # fmt: skip
        for frame, extended in frames:
            yield Incoming(frame, client, extended)

    @staticmethod
    def _acknowledge_at_once(client: _Client) -> None:
        """Keep the kernel from delaying its acknowledgement.

        pyserial leaves Nagle's algorithm on: of two frames sent in a row the second waits for the acknowledgement of
        the first, which the kernel would hold back for 40 ms unless something is sent anyway.
        """
        if hasattr(socket, "TCP_QUICKACK"):
            client.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)

    def _send(self, client: _Client) -> None:
        try:
            sent = client.socket.send(client.unsent)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            if error.errno not in (errno.EPIPE, errno.ECONNRESET, errno.ECONNABORTED):
                logger.warning("client %s: %s", client.name, error)
            self._forget(client)
            return
        del client.unsent[:sent]

    def _forget(self, client: _Client) -> None:
        if client in self._clients:
            self._clients.remove(client)
            logger.info("client %s has gone", client.name)
        client.socket.close()

    def _forget_broken(self) -> None:
        for client in self._clients[:]:
            if client.fileno() < 0:
                self._forget(client)
