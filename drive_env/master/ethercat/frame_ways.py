"""Carriers of a master's frames to a segment, each frame as the payload of Ethernet or UDP: UDP, raw socket, call."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import sys
import time
from collections.abc import Callable
from typing import Protocol

from drive_env.ethercat import datagrams
from drive_env.ethercat.ways import LARGEST, LOOPBACK
from drive_env.fieldbus.errors import OpenError


class FrameWay(Protocol):
    """A carrier: sends header and datagrams, and receives them when they return."""

    name: str

    def send(self, payload: bytes) -> None:
        """Send a frame; if it cannot be sent, it counts as lost."""

    def receive(self, timeout: float) -> bytes | None:
        """Return a frame that arrives within `timeout` [s], or None."""

    def close(self) -> None:
        """Close it."""


class CallWay:
    """A segment of the same process.

    Args:
        transfer: Returns an Ethernet frame as it returns from the segment, None if it is lost: `EtherCatWorld.receive`.
    """

    name = "this process"

    def __init__(self, transfer: Callable[[bytes], bytes | None]) -> None:
        self._transfer = transfer
        self._came: list[bytes] = []

    def send(self, payload: bytes) -> None:
        """Pass a frame through the slaves."""
        head = datagrams.BROADCAST + datagrams.MASTER + datagrams.ETHERTYPE
        done = self._transfer((head + payload).ljust(datagrams.SHORTEST_FRAME, b"\0"))
        if done is not None:
            self._came.append(done[datagrams.ETHERNET :])

    def receive(self, timeout: float) -> bytes | None:
        """Return a frame that has passed the slaves, or None."""
        return self._came.pop(0) if self._came else None

    def close(self) -> None:
        """Drop received frames."""
        self._came.clear()


class UdpWay:
    """EtherCAT over UDP on this computer.

    Args:
        port: The slaves' port: `drive-env serve --interface ethercat-udp`.
    """

    def __init__(self, port: int = datagrams.PORT) -> None:
        self.name = f"{LOOPBACK}:{port}"
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((LOOPBACK, port))
        self._socket.setblocking(False)

    def send(self, payload: bytes) -> None:
        """Send a datagram."""
        with contextlib.suppress(OSError):  # without a server at the address the frame counts as lost
            self._socket.send(payload)

    def receive(self, timeout: float) -> bytes | None:
        """Return a datagram that arrives within `timeout` [s], or None."""
        return _receive(self._socket, timeout)

    def close(self) -> None:
        """Close it."""
        self._socket.close()


class RawWay:
    """EtherCAT on a network interface of Linux, to inspect a segment.

    Args:
        interface: Its name, e.g. veth0.

    Raises:
        OpenError: If there is no such interface, or raw sockets are missing or not allowed.
    """

    def __init__(self, interface: str) -> None:
        self.name = interface
        if not hasattr(socket, "AF_PACKET"):
            raise OpenError(f"{sys.platform} has no raw sockets for {interface}; use --interface ethercat-udp")
        protocol = int.from_bytes(datagrams.ETHERTYPE, "big")
        try:
            self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(protocol))
            self._socket.bind((interface, protocol))
        except PermissionError:
            raise OpenError(
                f"{interface} cannot be opened: it takes the right CAP_NET_RAW: run as root, or give it to Python "
                f"with: sudo setcap cap_net_raw+ep {os.path.realpath(sys.executable)}"
            ) from None
        except OSError as error:
            self._socket.close()
            there = ", ".join(name for _, name in socket.if_nameindex())
            raise OpenError(f"{interface} cannot be opened: {error.strerror}; there are {there}") from None
        self._socket.setblocking(False)

    def send(self, payload: bytes) -> None:
        """Send a frame."""
        head = datagrams.BROADCAST + datagrams.MASTER + datagrams.ETHERTYPE
        with contextlib.suppress(OSError):  # the interface is down
            self._socket.send((head + payload).ljust(datagrams.SHORTEST_FRAME, b"\0"))

    def receive(self, timeout: float) -> bytes | None:
        """Return a frame that arrives within `timeout` [s], or None."""
        frame = _receive(self._socket, timeout)
        return None if frame is None else frame[datagrams.ETHERNET :]

    def close(self) -> None:
        """Close it."""
        self._socket.close()


def _receive(sock: socket.socket, timeout: float) -> bytes | None:
    if not select.select((sock,), (), (), timeout)[0]:
        return None
    try:
        return sock.recv(LARGEST)
    except OSError:  # no server at the address, or the interface is down
        time.sleep(min(timeout, 1e-3))
        return None
