"""The client of an slcan adapter over TCP, such as `drive-env serve`.

python-can's client reads byte by byte with one or two system calls each: 475 us of processor time for a cycle with two
TPDOs; this one takes a quarter of it. It is a python-can bus, too.
"""

from __future__ import annotations

import select
import socket
import time
from collections import deque
from contextlib import suppress

import can

from drive_env.bus.slcan import TOKEN_WANTED, check_token
from drive_env.fieldbus.errors import OpenError

CONNECT_TIMEOUT = 3.0  # [s]
_CHUNK = 65536  # bytes


class SlcanSocket(can.BusABC):  # type: ignore[misc]  # python-can is not typed here
    """A python-can bus over `socket://HOST:PORT`.

    Args:
        channel: The address.
        bitrate: Bit rate to set [bit/s]; by default the adapter's.
        token: The token that a hub open to the network requires; ignored by a hub that requires none.

    Raises:
        OpenError: For an invalid address, bit rate or token, the wrong token, or no hub at the address; in receiving,
            if the hub requires a token and none was given.
    """

    def __init__(self, channel: str, bitrate: int | None = None, token: str | None = None) -> None:
        if bitrate is not None and bitrate not in _BIT_RATES:
            raise OpenError(f"bit rate {bitrate} bit/s is not one of slcan's: {', '.join(map(str, _BIT_RATES))}")
        self._socket = _connect(channel)
        if token is not None:
            _present(token, self._socket, channel)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)
        self._frames: deque[can.Message] = deque()
        self._rest = b""
        self._closed = False
        super().__init__(channel)
        self.channel_info = f"slcan over {channel}"
        if bitrate is not None:
            self._write(b"C\r" + _BIT_RATES[bitrate])
        self._write(b"O\r")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame.

        Raises:
            can.CanOperationError: If the other end is gone or accepts nothing within `timeout` [s].
        """
        kind = ("R" if msg.is_extended_id else "r") if msg.is_remote_frame else ("T" if msg.is_extended_id else "t")
        can_id = f"{msg.arbitration_id:08X}" if msg.is_extended_id else f"{msg.arbitration_id:03X}"
        data = "" if msg.is_remote_frame else bytes(msg.data).hex().upper()
        self._write(f"{kind}{can_id}{msg.dlc}{data}\r".encode(), timeout)

    def shutdown(self) -> None:
        """Close the connection."""
        super().shutdown()
        if not self._closed:
            self._closed = True
            self._socket.close()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._frames:
            self._read(timeout)
        return (self._frames.popleft() if self._frames else None), False

    def _read(self, timeout: float | None) -> None:
        """Read the received bytes, waiting up to `timeout` [s] for some."""
        try:
            if timeout == 0.0 or select.select([self._socket], [], [], timeout)[0]:
                data = self._socket.recv(_CHUNK)
            else:
                return
        except BlockingIOError:
            return
        except (OSError, ValueError) as error:
            raise can.CanOperationError(f"the adapter at {self.channel_info} is gone: {error}") from error
        if not data:
            raise can.CanOperationError(f"{self.channel_info}: the other end closed the connection")
        *lines, self._rest = (self._rest + data).split(b"\r")
        now = time.time()
        for line in lines:
            if line + b"\r" == TOKEN_WANTED:
                raise OpenError(
                    f"{self.channel_info} asks for a token; set DRIVE_ENV_TOKEN to the one that `drive-env serve` "
                    "printed (in Python: token=...)"
                )
            message = _parse(line.strip(b"\a"), now)
            if message is not None:
                self._frames.append(message)

    def _write(self, data: bytes, timeout: float | None = None) -> None:
        try:
            while True:
                with suppress(BlockingIOError):
                    data = data[self._socket.send(data) :]
                if not data:
                    return
                if not select.select([], [self._socket], [], timeout)[1]:
                    raise can.CanOperationError(f"{self.channel_info}: the other end takes nothing")
        except (OSError, ValueError) as error:  # ValueError: another thread has closed it
            raise can.CanOperationError(f"{self.channel_info} is gone: {error}") from error


_BIT_RATES = {
    10_000: b"S0\r", 20_000: b"S1\r", 50_000: b"S2\r", 100_000: b"S3\r", 125_000: b"S4\r", 250_000: b"S5\r",
    500_000: b"S6\r", 750_000: b"S7\r", 1_000_000: b"S8\r",
}  # fmt: skip


def _connect(channel: str) -> socket.socket:
    host, _, port = channel.removeprefix("socket://").rpartition(":")
    if not host or not port.isdigit():
        raise OpenError(
            f"{channel!r} is not an address; write it as socket://127.0.0.1:PORT, as `drive-env serve` prints it"
        )
    try:
        return socket.create_connection((host, int(port)), CONNECT_TIMEOUT)
    except (OSError, OverflowError) as error:
        raise OpenError(
            f"no hub answers at {channel}: {error}; start `drive-env serve`, or correct --channel"
        ) from error


def _present(token: str, connection: socket.socket, channel: str) -> None:
    """Send the token first and wait for the answer; the connection is closed if it is not accepted."""
    try:
        check_token(token)
        connection.sendall(b"K" + token.encode() + b"\r")
        answer = b""
        while answer in (b"", TOKEN_WANTED[:1], TOKEN_WANTED):  # else "yes", or a hub without token
            data = connection.recv(_CHUNK)
            if not data:
                raise ConnectionResetError
            answer += data
    except ValueError as error:
        connection.close()
        raise OpenError(f"{error}; take the one that `drive-env serve` printed") from None
    except TimeoutError:
        connection.close()
        raise OpenError(
            f"{channel} does not answer to the token within {CONNECT_TIMEOUT:g} s; if it is not the hub of `drive-env "
            "serve`, unset DRIVE_ENV_TOKEN"
        ) from None
    except OSError:
        connection.close()
        raise OpenError(
            f"{channel} refuses the token; take the one that `drive-env serve` printed, and wait a second after a "
            "wrong one"
        ) from None


def _parse(line: bytes, now: float) -> can.Message | None:
    """Return the frame of a line; None for other lines, such as answers to commands."""
    if line[:1] not in (b"t", b"T", b"r", b"R"):
        return None
    extended, remote = line[:1] in (b"T", b"R"), line[:1] in (b"r", b"R")
    digits = 8 if extended else 3
    try:
        length = int(line[1 + digits : 2 + digits], 16)
        data = b"" if remote else bytes.fromhex(line[2 + digits : 2 + digits + 2 * length].decode())
        can_id = int(line[1 : 1 + digits], 16)
    except ValueError:
        return None
    return can.Message(
        timestamp=now,
        arbitration_id=can_id,
        is_extended_id=extended,
        is_remote_frame=remote,
        dlc=length,
        data=None if remote else data,
    )
