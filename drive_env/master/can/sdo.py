"""The SDO client of one node: python-canopen's transfers on our port, each with a time-out.

Differences from python-canopen's client: the waiting thread also receives; answers to an earlier transfer are ignored;
a transfer ends when its node boots, since the node has forgotten it; an abort names its object; long values go in
blocks (block_transfer.py) until the node's server refuses one.
"""

from __future__ import annotations

import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import canopen
from canopen.sdo import SdoAbortedError, SdoCommunicationError
from canopen.sdo.client import ReadableStream
from canopen.sdo.client import SdoClient as CanopenClient

from drive_env.canopen.frames import NMT, SDO_REQUEST, SDO_RESPONSE
from drive_env.dictionary.aborts import UNKNOWN_COMMAND, UNSUPPORTED_ACCESS, ObjectAccessError
from drive_env.fieldbus.errors import BusError, NoAnswerError, refused
from drive_env.master.can import block_transfer
from drive_env.master.can.block_transfer import BLOCK_FROM, NoBlockTransferError
from drive_env.master.can.port import Port

_ABORT = 0x80
_INITIATE = (0x40, 0x60)  # upload and download responses that name their object, upper three bits
_TIMED_OUT, _GENERAL = 0x05040000, 0x08000000
_NO_BLOCKS = (UNKNOWN_COMMAND, UNSUPPORTED_ACCESS)  # answers of servers without block transfers
BUSY_TIME = 0.5  # s during which a controller's buffer may be full of segments
PRE_OPERATIONAL = 0x80  # NMT command (CiA 301, 7.2.8.3.1)
TWICE = 2  # transfers that must be answered twice to prove two nodes: a single frame may be repeated
RECENT = 8  # transfers whose second answer may still come
PATIENT = 4.0  # times the usual wait, for writes that restore a value


class SdoClient(CanopenClient):  # type: ignore[misc]  # python-canopen is not typed
    """Reads and writes objects of a node.

    Args:
        port: The bus.
        node: Node-ID.
        alive: Called while an answer is waited for.

    Attributes:
        is_new: Whether two nodes may have this node-ID: transfers are refused once that is detected.
        answered_twice: Number of transfers that got a second answer.
    """

    def __init__(self, port: Port, node: int, alive: Callable[[], None] = lambda: None) -> None:
        super().__init__(SDO_REQUEST + node, SDO_RESPONSE + node, canopen.ObjectDictionary())
        self._port = port
        self._node = node
        self._alive = alive
        self._answers: list[bytes] = []
        self._may_be_stopped = False  # by missed heartbeats; it has not answered since
        self._has_booted: bool  # since the transfer under way began
        self._has_blocks = True  # until the server refuses a block transfer
        self._in_block = False  # every frame belongs to the block transfer under way
        self._object: tuple[int, int]  # of the transfer under way
        self._timeout: float  # its time-out for an answer [s]
        self._recent: deque[tuple[int, int]] = deque(maxlen=RECENT)  # objects of answered transfers
        self._has_retried = False  # then a late answer is not a second one
        self.is_new = False
        self.answered_twice = 0
        self._turn = threading.RLock()  # one transfer at a time: the supervisor's thread looks at the drive, too
        port.subscribe(SDO_RESPONSE + node, self._answers.append)

    def read(self, index: int, sub: int, label: str, timeout: float) -> bytes:
        """Return the bytes of an object; a lost frame is asked for once more.

        Raises:
            ObjectAccessError: With the abort code, if the drive refuses.
            NoAnswerError: If it does not answer within twice `timeout` [s].
        """
        try:
            return self._transfer(index, sub, None, f"the read of {label}", timeout)
        except NoAnswerError:
            return self._transfer(index, sub, None, f"the read of {label}", timeout)

    def write(self, index: int, sub: int, data: bytes, label: str, timeout: float) -> None:
        """Write the bytes of an object, once: a repeated write may mean something else.

        Raises:
            ObjectAccessError: With the abort code, if the drive refuses.
            NoAnswerError: If it does not answer within `timeout` [s]; the drive may or may not have applied the value.
        """
        self._transfer(index, sub, data, f"the write of {label}", timeout)

    def put_back(self, index: int, sub: int, data: bytes, label: str, timeout: float) -> None:
        """Write an object's previous value; without an answer once more, with a longer wait.

        A node that has missed its master's heartbeats may be stopped and then answers no SDO: it is set to
        pre-operational first.

        Raises:
            ObjectAccessError: With the abort code, if the drive refuses.
            NoAnswerError: If it does not answer.
        """
        try:
            self.write(index, sub, data, label, timeout)
        except NoAnswerError:
            self._port.send(NMT, bytes((PRE_OPERATIONAL, self._node)))
            self.write(index, sub, data, label, PATIENT * timeout)

    def ask(self, index: int, sub: int, timeout: float) -> bytes | None:
        """Return the bytes of a short object; None after `timeout` [s], which include the wait for one's turn."""
        deadline = time.monotonic() + timeout
        if not self._turn.acquire(timeout=timeout):
            return None
        try:
            return self._transfer(index, sub, None, "a look", max(deadline - time.monotonic(), 1e-3))
        except (BusError, ObjectAccessError):
            return None
        finally:
            self._turn.release()

    def command(self, index: int, sub: int, data: bytes) -> None:
        """Send a short write without waiting, neither for its answer nor for the transfer under way.

        Raises:
            BusError: If the bus does not accept the frame.
        """
        if self._in_block:  # a server that expects segments would take the request for one
            self.abort(_GENERAL)
        self.send_request(struct.pack("<BHB", 0x23 | (4 - len(data)) << 2, index, sub) + data.ljust(4, b"\0"))

    def forget(self) -> None:
        """End the transfer under way: the node has booted and forgotten it."""
        self._has_booted = True

    def may_be_stopped(self) -> None:
        """Note that the node missed this master's heartbeats: if that stops it, it answers no SDO."""
        self._may_be_stopped = True

    def check_alone(self) -> None:
        """Raise BusError if two nodes have answered under this node-ID."""
        self._port.drain()
        self._count_seconds(self._answers)
        if self.answered_twice >= TWICE:
            raise BusError(several_answer(2, self._node))

    def _count_seconds(self, answers: list[bytes]) -> None:
        """Count answers to transfers that were already answered; empties `answers`."""
        while answers:
            answer = answers.pop(0)
            if len(answer) == 8 and (answer[0] == _ABORT or answer[0] & 0xE0 in _INITIATE):
                named = struct.unpack_from("<HB", answer, 1)
                if named in self._recent:
                    self._recent.remove(named)
                    self.answered_twice += 1

    def _transfer(self, index: int, sub: int, data: bytes | None, what: str, timeout: float) -> bytes:
        with self._turn:
            return self._transfer_alone(index, sub, data, what, timeout)

    def _transfer_alone(self, index: int, sub: int, data: bytes | None, what: str, timeout: float) -> bytes:
        self._object = (index, sub)
        self._timeout = timeout
        where = f"node {self._node}"
        if self.is_new:
            self.check_alone()
        self._port.drain()
        self._count_seconds(self._answers)
        self._has_booted = False
        try:
            found = b""
            if data is None:
                found = self._read(index, sub)
            else:
                self._write(index, sub, data)
            self._take_for_answered()
            return found
        except SdoAbortedError as error:
            self._take_for_answered()
            raise refused(where, what, int(error.code)) from None
        except SdoCommunicationError as error:
            self._has_retried = True
            if "No SDO response" not in str(error):
                raise BusError(f"{where} answered {what} wrongly: {error}; is another master on the bus?") from None
            if self._has_booted:
                raise NoAnswerError(
                    f"{where} has restarted during {what}; check its power, and for another master that resets it"
                ) from None
            if self._may_be_stopped:
                raise NoAnswerError(
                    f"{where} did not answer {what} within {timeout:g} s: it missed this program's heartbeats (8130h) "
                    "and is stopped; run fewer programs beside this one, or have it wait longer: Limits(silence=...)"
                ) from None
            raise NoAnswerError(
                f"{where} did not answer {what} within {timeout:g} s; check power, bit rate and node-ID "
                "(`drive-env scan`), and that the node is not stopped; a slow object takes a longer --timeout "
                "(in Python timeouts={index: seconds})"
            ) from None

    def _take_for_answered(self) -> None:
        """Note that a transfer was answered, unless the previous one's answer may still be late."""
        if not self._has_retried:
            self._recent.append(self._object)
        self._has_retried = self._may_be_stopped = False

    def _read(self, index: int, sub: int) -> bytes:
        """Read short values in segments, and values that the server reports as long in blocks."""
        with ReadableStream(self, index, sub) as stream:
            if stream.exp_data is not None or (stream.size or 0) < BLOCK_FROM or not self._has_blocks:
                return bytes(stream.read())
        self.abort(_GENERAL)  # ends the transfer in segments
        try:
            initiated = self._begin_block(block_transfer.upload_request(index, sub), block_transfer.is_upload)
        except NoBlockTransferError:
            return self._read(index, sub)
        with self._all_frames():
            return block_transfer.read(self, initiated)

    def _write(self, index: int, sub: int, data: bytes) -> None:
        if len(data) >= BLOCK_FROM and self._has_blocks:
            request = block_transfer.download_request(index, sub, len(data))
            try:
                initiated = self._begin_block(request, block_transfer.is_download)
            except NoBlockTransferError:
                pass
            else:
                with self._all_frames():
                    block_transfer.write(self, initiated, data)
                return
        self.download(index, sub, data)

    def _begin_block(self, request: bytes, is_begun: Callable[[bytes], bool]) -> bytes:
        """Return the answer to a request that begins a block transfer.

        Raises:
            NoBlockTransferError: If the server has no block transfer; it is not asked again.
        """
        try:
            with self._all_frames():
                answer = self.request_response(request)
        except SdoAbortedError as error:
            if error.code not in _NO_BLOCKS:
                raise
        except SdoCommunicationError:
            if self._has_booted:
                raise
        else:
            if is_begun(answer):
                return answer
            self.abort(UNKNOWN_COMMAND)
        self._has_blocks = False
        raise NoBlockTransferError

    @contextmanager
    def _all_frames(self) -> Iterator[None]:
        """Assign every frame of the server to this transfer: segments name no object."""
        self._in_block = True
        try:
            yield
        finally:
            self._in_block = False

    # --- what python-canopen's transfers call -----------------------------------------------------------------------
    def send_request(self, request: bytes) -> None:
        """Send a request."""
        self._port.send(self.rx_cobid, bytes(request))

    def send_patiently(self, request: bytes) -> None:
        """Send a frame, repeatedly for a while: a controller's buffer may be full of earlier frames."""
        end = time.monotonic() + BUSY_TIME
        while True:
            try:
                self.send_request(request)
                return
            except BusError:
                if time.monotonic() > end:
                    raise
                time.sleep(0.001)

    def request_response(self, request: bytes) -> bytes:
        """Send a request and return the answer to it."""
        self.send_request(request)
        try:
            return self.read_response()
        except SdoCommunicationError:
            self.abort(_TIMED_OUT)
            raise

    def read_response(self) -> bytes:
        """Return the next answer of this transfer."""
        deadline = time.monotonic() + self._timeout
        while True:
            while self._answers:
                answer = self._answers.pop(0)
                if self._is_ours(answer):
                    if answer[0] == _ABORT:
                        raise SdoAbortedError(struct.unpack_from("<L", answer, 4)[0])
                    return answer
                self._count_seconds([answer])
            if self._has_booted:
                raise SdoCommunicationError("No SDO response received")
            left = deadline - time.monotonic()
            if left <= 0.0 and not self._port.receive(done=self._answered):
                raise SdoCommunicationError("No SDO response received")
            if left > 0.0:
                self._port.receive(min(left, 0.05), self._answered)
            self._alive()

    def _answered(self) -> bool:
        return bool(self._answers) or self._has_booted

    def abort(self, abort_code: int = 0x08000000) -> None:
        """Abort the transfer."""
        self.send_request(struct.pack("<BHBL", _ABORT, *self._object, abort_code))

    def _is_ours(self, answer: bytes) -> bool:
        if len(answer) != 8:
            return False
        if self._in_block:
            return True
        index, sub = struct.unpack_from("<HB", answer, 1)
        if answer[0] == _ABORT:
            return (index, sub) in (self._object, (0, 0))  # some servers abort without naming the object
        return answer[0] & 0xE0 not in _INITIATE or (index, sub) == self._object


def several_answer(count: int, node: int) -> str:
    """Return the text of a message that several nodes have one node-ID."""
    return (
        f"{'two' if count == 2 else count} nodes answer as {node}: switch all but one of them off, and give it another "
        "node-ID, with `drive-env lss` or by its own object; if another master has read the same just then, try again"
    )
