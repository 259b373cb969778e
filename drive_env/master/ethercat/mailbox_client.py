"""The master's end of a slave's mailbox: CoE transfers, and emergencies that come between (ETG.1000.6, 5.6)."""

from __future__ import annotations

import contextlib
import struct
import threading
import time
from collections import deque
from collections.abc import Callable

from drive_env.dictionary.aborts import TOGGLE_NOT_ALTERNATED, ObjectAccessError
from drive_env.ethercat.coe import (
    ABORTED,
    EXPEDITED,
    HAS_SIZE,
    HEADER,
    INITIATE,
    LAST,
    LEAST,
    MAILBOX_HEADER,
    TOGGLE,
    CoeService,
    message,
    split,
)
from drive_env.ethercat.mailbox import COUNTER, COUNTER_SHIFT, PROTOCOL, MailboxProtocol
from drive_env.fieldbus.errors import BusError, NoAnswerError

UPLOAD, DOWNLOAD, UPLOAD_SEGMENT = 0x40, 0x21, 0x60  # first bytes of requests
LOOK = 0.0005  # s between two looks whether an answer is there


class SdoAbortError(ObjectAccessError):
    """The slave answered with an abort."""


class SlaveMailboxError(BusError):
    """The slave answered with an error of its mailbox."""


class MailboxClient:
    """The mailbox of one slave; one transfer at a time.

    Args:
        send: Writes a message of the mailbox's whole length; returns whether there was room, None if the frame was
            lost.
        fetch: Returns the slave's next message, b"" if there is no message, None if the frame was lost.
        repeat: Makes the slave send its last message again after a loss.
        lengths: Lengths of the mailboxes that the master writes and reads [bytes].
        alive: Called again and again while an answer is waited for.
    """

    def __init__(
        self,
        send: Callable[[bytes], bool | None],
        fetch: Callable[[], bytes | None],
        repeat: Callable[[], None],
        lengths: tuple[int, int],
        alive: Callable[[], None],
    ) -> None:
        self._send_message, self._fetch, self._repeat = send, fetch, repeat
        self._room = lengths[0] - MAILBOX_HEADER - HEADER
        self._length = lengths[0]
        self._alive = alive
        self._counter = self._came = 0
        self._turn = threading.RLock()
        self.emergencies: deque[tuple[int, int, tuple[int, ...]]] = deque()

    def upload(self, index: int, sub: int, timeout: float) -> bytes:
        """Return the bytes of an object.

        Raises:
            SdoAbortError: With the abort code; NoAnswerError if no answer comes within `timeout` [s].
        """
        with self._turn:
            deadline, key = time.monotonic() + timeout, struct.pack("<HB", index, sub)
            answer = self._ask(bytes((UPLOAD,)) + key + bytes(4), key, deadline)
            if answer[0] & EXPEDITED:
                return answer[4 : 8 - (answer[0] >> 2 & 3 if answer[0] & HAS_SIZE else 0)]
            size = int.from_bytes(answer[4:8], "little")
            data, toggle = answer[INITIATE : INITIATE + size], 0
            while len(data) < size:
                part = self._ask(bytes((UPLOAD_SEGMENT | toggle,)) + bytes(7), None, time.monotonic() + timeout)
                if part[0] & TOGGLE != toggle:
                    raise SdoAbortError(TOGGLE_NOT_ALTERNATED, "the toggle bit of a segment did not alternate")
                content = part[1:]
                data += content[: LEAST - (part[0] >> 1 & 7)] if len(content) <= LEAST else content
                toggle ^= TOGGLE
                if part[0] & LAST:
                    break
            return data

    def download(self, index: int, sub: int, data: bytes, timeout: float) -> None:
        """Write the bytes of an object, as `upload` reads them."""
        with self._turn:
            key = struct.pack("<HB", index, sub)
            deadline = time.monotonic() + timeout
            if 1 <= len(data) <= 4:
                first = DOWNLOAD | EXPEDITED | (4 - len(data)) << 2
                self._ask(bytes((first,)) + key + data.ljust(4, b"\0"), key, deadline)
                return
            part = data[: self._room - INITIATE]
            self._ask(bytes((DOWNLOAD,)) + key + struct.pack("<I", len(data)) + part, key, deadline)
            done, toggle = len(part), 0
            while done < len(data):
                part = data[done : done + self._room - 1]
                done += len(part)
                first = toggle | max(0, LEAST - len(part)) << 1 | (LAST if done >= len(data) else 0)
                self._ask(bytes((first,)) + part.ljust(LEAST, b"\0"), None, time.monotonic() + timeout)
                toggle ^= TOGGLE

    def post(self, index: int, sub: int, data: bytes) -> None:
        """Send a short write without waiting for its answer, unless a transfer is under way."""
        if not self._turn.acquire(blocking=False):
            return
        try:
            first = DOWNLOAD | EXPEDITED | (4 - len(data)) << 2
            self._send_message(self._request(bytes((first,)) + struct.pack("<HB", index, sub) + data.ljust(4, b"\0")))
        finally:
            self._turn.release()

    def look(self, timeout: float) -> None:
        """Handle waiting messages that are not answers, unless another thread has the turn for `timeout` [s]."""
        if not self._turn.acquire(timeout=max(timeout, 0.0)):
            return
        try:
            while True:
                with contextlib.suppress(SlaveMailboxError):  # the answer to a request that is no longer awaited
                    if self._take() is None:
                        return
        finally:
            self._turn.release()

    # --- inside -----------------------------------------------------------------------------------------------------
    def _ask(self, request: bytes, key: bytes | None, deadline: float) -> bytes:
        """Return the answer to a request, without its CoE header; `key`: the index and sub-index that it must have."""
        whole = self._request(request)
        is_sent = False
        while True:
            # Sent again after a lost frame, it has the same counter and is executed once. The slave may have received
            # it the first time, and accepts no more requests until its answers are read.
            is_sent = is_sent or bool(self._send_message(whole))
            answer = self._take()
            if answer is None:
                self._wait(deadline)
            elif answer and answer[0] == ABORTED and key in (None, answer[1:4]):
                code = int.from_bytes(answer[4:8], "little")
                raise SdoAbortError(code, f"abort {code:08X}h")
            elif answer and (answer[1:4] == key if key is not None else answer[0] >> 5 in (0, 1)):
                return answer

    def _request(self, request: bytes) -> bytes:
        """Return a message with the mailbox's full length and the next counter."""
        self._counter = self._counter % COUNTER + 1
        content = message(CoeService.SDO_REQUEST, request)
        head = struct.pack("<HHBB", len(content), 0, 0, MailboxProtocol.COE | self._counter << COUNTER_SHIFT)
        return (head + content).ljust(self._length, b"\0")

    def _wait(self, deadline: float) -> None:
        if time.monotonic() > deadline:
            raise NoAnswerError("no answer came in time")
        self._alive()
        time.sleep(LOOK)

    def _take(self) -> bytes | None:
        """Read a message; return it if it is an SDO, b"" for another kind, None if there is no message."""
        data = self._fetch()
        if data is None:
            self._repeat()
            return None
        if len(data) < MAILBOX_HEADER:
            return None
        length, _, _, kind = struct.unpack_from("<HHBB", data)
        content = data[MAILBOX_HEADER : MAILBOX_HEADER + length]
        counter = kind >> COUNTER_SHIFT & COUNTER
        if counter and counter == self._came:  # a repetition of the last one
            return b""
        self._came = counter
        if kind & PROTOCOL == MailboxProtocol.ERROR:
            raise SlaveMailboxError(f"a mailbox error of the slave, detail {int.from_bytes(content[2:4], 'little')}")
        if kind & PROTOCOL != MailboxProtocol.COE or len(content) < HEADER:
            return b""
        service, rest = split(content)
        if service == CoeService.EMERGENCY and len(rest) >= 3:
            self.emergencies.append((int.from_bytes(rest[:2], "little"), rest[2], tuple(rest[3:8])))
            return b""
        return rest if service in (CoeService.SDO_REQUEST, CoeService.SDO_RESPONSE) else b""
