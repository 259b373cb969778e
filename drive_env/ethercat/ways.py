"""Transports of a master's frames to a segment: a raw socket on a network interface, or UDP on localhost."""

from __future__ import annotations

import os
import select
import socket
import struct
import sys
import time
from collections.abc import Callable
from typing import Protocol

from drive_env.ethercat import datagrams

LOOPBACK = "127.0.0.1"
LARGEST = 2048  # bytes of a frame
PACKET_OUTGOING = 4  # of AF_PACKET: one that this machine sent
TIMESTAMP = 35  # SO_TIMESTAMPNS of Linux


class EtherCatWay(Protocol):
    """A transport.

    Attributes:
        name: Its name for a user.
        answered: Frames that were answered.
        lost: Frames whose answer could not be sent.
    """

    name: str
    answered: int
    lost: int

    def serve(self, timeout: float, pass_on: Callable[[bytes], bytes | None], late: Callable[[float], None]) -> None:
        """Answer the frames that are waiting, or come within `timeout` [s].

        Args:
            timeout: Longest wait for the first [s].
            pass_on: Returns the answer to a frame, None if it is lost.
            late: Called with the time from each frame's arrival to its answer [s].
        """

    def close(self) -> None:
        """Close it."""


class RawSocket:
    """Frames of EtherType 88A4h on a network interface of Linux.

    Args:
        interface: Its name, e.g. veth1.

    Raises:
        OSError: If there is no interface of that name, or raw sockets are missing or not allowed, with the remedy.
    """

    def __init__(self, interface: str) -> None:
        self.name = interface
        self.answered = self.lost = 0
        if not hasattr(socket, "AF_PACKET"):
            raise OSError(f"{sys.platform} has no raw sockets for {interface}; use --interface ethercat-udp")
        protocol = int.from_bytes(datagrams.ETHERTYPE, "big")
        try:
            self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(protocol))
        except PermissionError:
            raise OSError(
                f"{interface} cannot be opened: it takes the right CAP_NET_RAW: run as root, or give it to Python "
                f"with: sudo setcap cap_net_raw+ep {os.path.realpath(sys.executable)}; without that right use "
                "--interface ethercat-udp on this machine"
            ) from None
        try:
            self._socket.bind((interface, protocol))
            self._socket.setsockopt(socket.SOL_SOCKET, TIMESTAMP, 1)
        except OSError as error:
            self._socket.close()
            there = ", ".join(name for _, name in socket.if_nameindex())
            raise OSError(f"{interface} cannot be opened: {error.strerror}; there are {there}") from None
        self._socket.setblocking(False)

    def serve(self, timeout: float, pass_on: Callable[[bytes], bytes | None], late: Callable[[float], None]) -> None:
        """Answer the frames that are waiting, or come within `timeout` [s]; as `EtherCatWay.serve`."""
        if not select.select((self._socket,), (), (), timeout)[0]:
            return
        try:
            frame, ancillary, _, address = self._socket.recvmsg(LARGEST, 64)
        except OSError:  # the interface is down; it may come up again
            time.sleep(min(timeout, 1e-3))
            return
        if address[2] == PACKET_OUTGOING:
            return
        answer = pass_on(frame)
        if answer is None:
            return
        try:
            self._socket.send(answer)
        except OSError:
            self.lost += 1
            return
        self.answered += 1
        for level, kind, data in ancillary:
            if level == socket.SOL_SOCKET and kind == TIMESTAMP:
                seconds, nanoseconds = struct.unpack("@ll", data)
                late(time.time() - seconds - nanoseconds * 1e-9)

    def close(self) -> None:
        """Close it."""
        self._socket.close()


class UdpSocket:
    """EtherCAT over UDP on localhost, of port 88A4h.

    Args:
        port: UDP port; 0 for a free one.

    Raises:
        OSError: If the port is taken.
    """

    def __init__(self, port: int = datagrams.PORT) -> None:
        self.answered = self.lost = 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((LOOPBACK, port))
        except OSError as error:
            self._socket.close()
            raise OSError(f"UDP port {LOOPBACK}:{port} cannot be opened: {error.strerror}; choose another") from None
        self._socket.setblocking(False)
        self.port = self._socket.getsockname()[1]
        self.name = f"{LOOPBACK}:{self.port}"

    def serve(self, timeout: float, pass_on: Callable[[bytes], bytes | None], late: Callable[[float], None]) -> None:
        """Answer the frames that are waiting, or come within `timeout` [s]; as `EtherCatWay.serve`."""
        if not select.select((self._socket,), (), (), timeout)[0]:
            return
        came = time.perf_counter()
        try:
            payload, address = self._socket.recvfrom(LARGEST)
            answer = pass_on(payload)
            if answer is None:
                return
            self._socket.sendto(answer, address)
        except OSError:  # the answer to a client that has left comes back as an error
            self.lost += 1
            return
        self.answered += 1
        late(time.perf_counter() - came)

    def close(self) -> None:
        """Close it."""
        self._socket.close()
