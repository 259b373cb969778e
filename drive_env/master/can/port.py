"""The master's port to a bus: sends frames, receives frames, and gives their data to the thread that waits for them.

There is no receiving thread: the thread that waits receives, so no frame passes a queue between threads. The bus
(the kernel, the socket) keeps what arrives in the meantime. Two threads may wait at a time, the program's and the
supervisor's (drive_env/safety/supervisor.py): one receives for both.
"""

from __future__ import annotations

import os
import re
import select
import threading
import time
from collections.abc import Callable
from typing import Any

import can

from drive_env.fieldbus.errors import BusError, OpenError
from drive_env.master.can.slcan_socket import SlcanSocket

Handler = Callable[[bytes], None]

INTERFACE_VARIABLE, CHANNEL_VARIABLE = "DRIVE_ENV_INTERFACE", "DRIVE_ENV_CHANNEL"
# Not in the channel, which messages, snapshots and certificates contain, and not an option of a command, which every
# user of the computer can read.
TOKEN_VARIABLE = "DRIVE_ENV_TOKEN"
MOST_FRAMES = 10_000
SEND_TIMEOUT = 0.5  # [s]
_LINE_TIME = 0.002  # for the rest of a frame that has begun to arrive (slcan: a line of text) [s]
_ORPHANED = 0.05  # s after which another thread takes over from the receiving thread if that does nothing
_TURN = 0.0003  # interval at which a thread checks for frames that another one has received for it [s]
_ADDRESS = re.compile(r"[\w.-]+:\d+")  # HOST:PORT


def open_bus(interface: str | None = None, channel: str | None = None, **options: Any) -> can.BusABC:
    """Open a python-can bus.

    Args:
        interface: The name in python-can; from DRIVE_ENV_INTERFACE if not given, slcan for a channel `socket://...`.
        channel: The channel; from DRIVE_ENV_CHANNEL if not given.
        options: Further options of the interface, e.g. `bitrate`; `token` for a hub that asks for one (`drive-env serve
            --token`), from DRIVE_ENV_TOKEN if not given.

    Raises:
        OpenError: If it cannot be opened, with what to try.
    """
    channel = channel or os.environ.get(CHANNEL_VARIABLE)
    interface = interface or os.environ.get(INTERFACE_VARIABLE)
    if not channel:
        raise OpenError(
            "no CAN channel is given; give interface and channel (--interface socketcan --channel can0, or --channel "
            f"socket://127.0.0.1:PORT of `drive-env serve`), or set {INTERFACE_VARIABLE} and {CHANNEL_VARIABLE}"
        )
    if interface in ("ethercat", "ethercat-udp"):
        raise OpenError(
            f"interface {interface!r} carries no CAN frames, which this is for; frames of EtherCAT are written by "
            "`drive-env serve --pcap FILE`, or on a cable by Wireshark"
        )
    token = options.pop("token", None)
    over_tcp = channel.startswith("socket://")
    if interface in (None, "slcan") and over_tcp and not options.keys() - {"bitrate"}:
        return SlcanSocket(channel, options.get("bitrate"), token or os.environ.get(TOKEN_VARIABLE) or None)
    if token is not None:
        raise OpenError(
            "a token is for the hub of `drive-env serve`: channel socket://HOST:PORT, interface slcan or none, and no "
            "other option but bitrate"
        )
    if interface is None:
        if not over_tcp:
            served = f"; a hub of `drive-env serve` is socket://{channel}" if _ADDRESS.fullmatch(channel) else ""
            raise OpenError(
                f"channel {channel!r} needs an interface: give one that python-can knows (socketcan, pcan, kvaser, "
                f"slcan, ...), or set {INTERFACE_VARIABLE}{served}"
            )
        interface = "slcan"
    if over_tcp:
        options.setdefault("sleep_after_open", 0.0)  # two seconds by default, for adapters that boot
    try:
        return can.Bus(interface=interface, channel=channel, **options)
    except (can.CanError, OSError, ValueError, ImportError, TypeError) as error:
        raise OpenError(
            f"cannot open interface {interface!r}, channel {channel!r}: {error}; check that the adapter is plugged "
            "in and up, or that `drive-env serve` runs at this address"
        ) from error


class Port:
    """Sends and receives on a bus.

    Args:
        bus: An open python-can bus.
        owned: Shut the bus down in `close`.
    """

    def __init__(self, bus: can.BusABC, owned: bool = True) -> None:
        self._bus = bus
        self._owned = owned
        self._handlers: dict[int, Handler] = {}
        self._sending = threading.Lock()  # the supervisor's thread sends, too
        self._receiving = threading.Lock()
        self._is_receiving = False
        self._file = _file_number(bus)

    def subscribe(self, can_id: int, handler: Handler | None) -> None:
        """Call the handler with the data of every frame with this identifier; None ends that."""
        if handler is None:
            self._handlers.pop(can_id, None)
        else:
            self._handlers[can_id] = handler

    def send(self, can_id: int, data: bytes = b"", *, remote: bool = False, length: int = 0) -> None:
        """Send a frame.

        Raises:
            BusError: If the bus does not accept it within half a second.
        """
        message = can.Message(
            arbitration_id=can_id,
            data=None if remote else data,
            is_remote_frame=remote,
            dlc=length if remote else len(data),
            is_extended_id=False,
        )
        try:
            with self._sending:
                self._bus.send(message, SEND_TIMEOUT)
        except (can.CanError, OSError) as error:
            raise BusError(
                f"the bus did not take frame {can_id:03X}h: {error}; check that another node acknowledges (power, "
                "bit rate, termination), and that the adapter or the emulator is still there"
            ) from error

    def receive(self, timeout: float = 0.0, done: Callable[[], bool] | None = None) -> bool:
        """Wait up to `timeout` [s] for a frame and hand it to its handler; False if none came.

        While another thread receives, `done` returns whether that thread has received the awaited frame.

        Raises:
            BusError: If the bus is gone.
        """
        if not self._take_turn(timeout, done):
            return done is not None and done()
        self._is_receiving = True
        try:
            if done is not None and done():
                return True
            message = self._next(timeout)
            if message is None:
                return False
            if not (message.is_extended_id or message.is_error_frame or message.is_remote_frame):
                handler = self._handlers.get(message.arbitration_id)
                if handler is not None:
                    handler(bytes(message.data))
        except (can.CanError, OSError, ValueError) as error:
            raise BusError(f"the bus is gone: {error}; open it again") from error
        finally:
            self._is_receiving = False
            self._receiving.release()
        return True

    def drain(self) -> None:
        """Process the received frames without waiting; ends even if frames arrive faster than they are processed."""
        for _ in range(MOST_FRAMES):
            if not self.receive():
                return

    def wait(self, done: Callable[[], bool], timeout: float) -> bool:
        """Receive until `done()` is true or `timeout` [s] has passed; return done()."""
        deadline = time.monotonic() + timeout
        while not done():
            left = deadline - time.monotonic()
            if left <= 0.0:
                self.drain()
                return done()
            self.receive(left, done)
        return True

    def close(self) -> None:
        """Close the bus if it is ours."""
        if self._owned:
            self._bus.shutdown()

    def _take_turn(self, timeout: float, done: Callable[[], bool] | None) -> bool:
        """Become the receiving thread within `timeout` [s]; False if another thread keeps the turn, or if `done()`."""
        if self._receiving.acquire(blocking=False):
            return True
        begun = time.monotonic()
        deadline, idle_since = begun + timeout, begun
        while not self._receiving.acquire(timeout=_TURN):
            if self._is_receiving:
                idle_since = time.monotonic()
            elif time.monotonic() - idle_since > _ORPHANED and self._receiving.locked():
                # Ctrl-C hit the other thread between taking its turn and its first instruction: no thread would
                # receive.
                self._receiving.release()
            if (done is not None and done()) or time.monotonic() >= deadline:
                return False
        return True

    def _next(self, timeout: float) -> can.Message | None:
        if self._file is None:
            return self._bus.recv(timeout)
        # python-can's slcan sleeps in steps of a millisecond; waiting on the file ends at once.
        if not select.select([self._file], [], [], timeout)[0]:
            return None
        return self._bus.recv(_LINE_TIME)


def _file_number(bus: can.BusABC) -> int | None:
    try:
        number = bus.fileno()
        select.select([number], [], [], 0.0)
    except (NotImplementedError, AttributeError, OSError, ValueError, TypeError):
        return None  # the virtual bus, adapters behind a vendor's library; serial ports on Windows
    return number if number >= 0 else None
