"""The mailbox of a slave: header, counter, repetition and errors (ETG.1000.4, 5.6; ETG.1000.6, 5.1).

A message has six bytes of header: length, address, channel and priority, protocol and counter. The counter runs from 1
to 7; a message with the same counter as the previous one is a repetition, and not executed again. A device without a
protocol answers it by an error message of the mailbox.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from enum import IntEnum

from drive_env.ethercat.controller import SlaveController
from drive_env.ethercat.foe import FileServer

HEADER = 6
RECEIVE, SEND = 0, 1  # sync managers
CHANNEL, PROTOCOL, COUNTER_SHIFT, COUNTER = 0x3F, 0x0F, 4, 0x07
MOST_WAITING = 16  # answers; further requests are accepted only after some are read


class MailboxProtocol(IntEnum):
    """Protocols of the mailbox (ETG.1000.4, table 29)."""

    ERROR = 0
    AOE = 1
    EOE = 2
    COE = 3
    FOE = 4
    SOE = 5
    VOE = 15


class MailboxError(IntEnum):
    """Details of an error message (ETG.1000.4, table 30)."""

    SYNTAX = 1
    UNSUPPORTED_PROTOCOL = 2
    INVALID_CHANNEL = 3
    SERVICE_NOT_SUPPORTED = 4
    INVALID_HEADER = 5
    TOO_SHORT = 6
    NO_MEMORY = 7
    INVALID_SIZE = 8


class Mailbox:
    """The mailbox behind sync managers 0 and 1.

    Args:
        controller: Has the sync managers.
        coe: Answers a CoE message; raises ValueError for an invalid one.
    """

    def __init__(self, controller: SlaveController, coe: Callable[[bytes, float], list[bytes]]) -> None:
        self._controller = controller
        self._coe = coe
        self.files = FileServer()
        self.open(is_bootstrap=False)

    def open(self, *, is_bootstrap: bool) -> None:
        """Start empty: forget received and waiting messages."""
        self._is_bootstrap = is_bootstrap
        self._waiting: deque[tuple[int, bytes, int]] = deque()  # protocol, message, address
        self._came = 0  # counter of the last message
        self._sent = 0  # counter of the last answer
        self._current = self._read = b""  # the last answer put, and the last one read by the master
        self._delayed = b""  # an answer that a repetition has displaced
        self._repeat = False
        self.files.close()

    def send(self, protocol: MailboxProtocol, message: bytes, address: int = 0) -> None:
        """Queue a message for the master."""
        self._waiting.append((protocol, message, address))

    def work(self, now: float) -> bool:
        """Run everything due: repeat an answer, handle a message, put the next answer into the mailbox.

        Returns:
            Whether a message was handled.
        """
        controller, has_taken = self._controller, False
        receive, send = controller.managers[RECEIVE], controller.managers[SEND]
        if send.was_read:
            send.was_read = False
            self._read = self._current
        if send.repeat_request != self._repeat:
            self._repeat = send.repeat_request
            if self._read:
                self._delayed = self._current if send.is_full else b""
                self._current = self._read
                send.put(self._current)
            controller.acknowledge_repeat(SEND)
        if receive.written is not None and len(self._waiting) < MOST_WAITING:
            data = receive.take()
            if data is not None:
                self._take(data, now)
                has_taken = True
        if send.end and not send.is_full and (self._delayed or self._waiting):
            self._current, self._delayed = self._delayed or self._next(), b""
            send.put(self._current)
        return has_taken

    # --- inside -----------------------------------------------------------------------------------------------------
    def _next(self) -> bytes:
        protocol, message, address = self._waiting.popleft()
        self._sent = self._sent % COUNTER + 1
        kind = protocol | self._sent << COUNTER_SHIFT
        return struct.pack("<HHBB", len(message), address, 0, kind) + message

    def _take(self, data: bytes, now: float) -> None:
        length, address, channel, kind = struct.unpack_from("<HHBB", data)
        counter = kind >> COUNTER_SHIFT & COUNTER
        if counter and counter == self._came:
            return
        self._came = counter
        error = self._dispatch(data, length, channel, kind & PROTOCOL, now, address)
        if error is not None:
            self.send(MailboxProtocol.ERROR, struct.pack("<HH", 1, error), address)

    def _dispatch(
        self, data: bytes, length: int, channel: int, protocol: int, now: float, address: int
    ) -> MailboxError | None:
        """Answer a message; return its error, or None."""
        if length > len(data) - HEADER:
            return MailboxError.INVALID_SIZE
        if channel & CHANNEL:
            return MailboxError.INVALID_CHANNEL
        message = data[HEADER : HEADER + length]
        if protocol == MailboxProtocol.COE and not self._is_bootstrap:
            if length < 2:
                return MailboxError.TOO_SHORT
            try:
                answers = self._coe(message, now)
            except ValueError:
                return MailboxError.SERVICE_NOT_SUPPORTED
            for answer in answers:
                self.send(MailboxProtocol.COE, answer, address)
            return None
        if protocol == MailboxProtocol.FOE:
            if length < self.files.HEADER:
                return MailboxError.TOO_SHORT
            room = self._controller.managers[SEND].setting.length - HEADER
            full = self._controller.managers[RECEIVE].setting.length - HEADER
            response = self.files.request(message, full, room, is_bootstrap=self._is_bootstrap)
            if response is not None:
                self.send(MailboxProtocol.FOE, response, address)
            return None
        return MailboxError.UNSUPPORTED_PROTOCOL
