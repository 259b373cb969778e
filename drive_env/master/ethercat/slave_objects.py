"""The objects of a slave, by its mailbox; values of objects in the output image are put there, too."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection
from typing import TypeVar

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.fieldbus.errors import BusError, NoAnswerError, refused
from drive_env.master.ethercat.ethercat_master import EtherCatMaster
from drive_env.master.ethercat.image_data import EtherCatProcessData
from drive_env.master.ethercat.mailbox_client import SdoAbortError

T = TypeVar("T")


class SlaveObjects:
    """Reads and writes objects of a slave, as bytes.

    Args:
        master: Of the segment.
        node: The slave's number among the nodes.
        position: Its position in the line.
        data: Its process data.
        controlwords: Index and sub-index of its axes' controlwords.
        operate: Takes the slaves to Op, the only state in which motors run.
        wake: Takes it to a state in which it answers.
        lockstep: Time passes only with frames.
    """

    def __init__(
        self,
        master: EtherCatMaster,
        node: int,
        position: int,
        data: EtherCatProcessData,
        controlwords: Collection[Key],
        operate: Callable[[], None],
        wake: Callable[[], None],
        lockstep: bool,
    ) -> None:
        self._master, self._node, self._position = master, node, position
        self._data, self._lockstep = data, lockstep
        self._controlwords, self._operate, self._wake = controlwords, operate, wake

    def read(self, index: int, sub: int, label: str, timeout: float) -> bytes:
        """Return the bytes of an object."""
        return self._named(
            lambda: self._master.upload(self._position, index, sub, timeout), f"the read of {label}", timeout
        )

    def write(self, index: int, sub: int, data: bytes, label: str, timeout: float) -> None:
        """Write the bytes of an object, once.

        The output image is changed first: a frame sent in between must not bring the old value back.
        """
        if (index, sub) in self._controlwords and cia402.may_enable(int.from_bytes(data, "little")):
            self._operate()
        before = self._data.put(self._node, (index, sub), data)
        try:
            self._named(
                lambda: self._master.download(self._position, index, sub, data, timeout),
                f"the write of {label}",
                timeout,
            )
        except ObjectAccessError:
            if before is not None:
                self._data.put(self._node, (index, sub), before)
            raise

    def put_back(self, index: int, sub: int, data: bytes, label: str, timeout: float) -> None:
        """Write an object's previous value; a silent slave is woken."""
        try:
            self.write(index, sub, data, label, timeout)
        except NoAnswerError:
            self._wake()
            self.write(index, sub, data, label, timeout)

    def ask(self, index: int, sub: int, timeout: float) -> bytes | None:
        """Return the bytes of a short object, None if they do not come within `timeout` [s]."""
        with contextlib.suppress(BusError, ObjectAccessError):
            return self._master.upload(self._position, index, sub, timeout)
        return None

    def command(self, index: int, sub: int, data: bytes) -> None:
        """Send a short write without waiting: in the output image, exchanged at once, or by the mailbox."""
        if self._data.put(self._node, (index, sub), data) is None or self._lockstep:
            self._master.post(self._position, index, sub, data)
        else:
            self._data.exchange(is_cycle=False)

    def _named(self, call: Callable[[], T], what: str, timeout: float) -> T:
        """Make a transfer; its errors name the object."""
        where = f"position {self._position}"
        try:
            return call()
        except SdoAbortError as error:
            raise refused(where, what, error.abort_code) from None
        except NoAnswerError:
            raise NoAnswerError(
                f"{where} did not answer {what} within {timeout:g} s; check its power and its cable"
            ) from None
        except BusError as error:
            raise BusError(f"{where}, {what}: {error}") from None
