"""The interface of a master under the link over EtherCAT: slaves, states, objects over CoE, exchange of images.

There are two: `soem_master.py` uses SOEM, for network interfaces; `frame_master.py` is our own, for anything that
carries frames as bytes: UDP, or a segment of the same process.

Slaves are named by their position in the line, from 0.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol

from drive_env.ethercat.application import AlState, AlStatusCode
from drive_env.fieldbus.link import ReceivedEmergency

STATE, ERROR = 0x0F, 0x10  # of AL status
READS = 5  # of a register, before its slave counts as silent: a frame may be lost


class SlaveStatus(NamedTuple):
    """AL status and AL status code of a slave; state 0 if it does not answer at its address."""

    state: int
    has_error: bool
    code: int

    @property
    def is_op(self) -> bool:
        """Whether it is in Op, without an error."""
        return self.state == AlState.OP and not self.has_error

    @property
    def is_late(self) -> bool:
        """Whether its watchdog has taken it out of Op: no images came in time."""
        return self.has_error and self.code == AlStatusCode.SM_WATCHDOG


class SlaveIdentity(NamedTuple):
    """A slave's identity in its EEPROM: vendor, product code, revision, serial number."""

    vendor: int
    product: int
    revision: int
    serial: int


class ImageSizes(NamedTuple):
    """Bytes of a slave's images: outputs, which it receives, and inputs, which it sends."""

    outputs: int
    inputs: int


class Sync0(NamedTuple):
    """Cycle of SYNC0 [s]; whether time passes only with frames, so that the first pulse is that of the next cycle.

    With `sync1`, SYNC1 comes at the same times.
    """

    cycle: float
    is_lockstep: bool
    sync1: bool = False


class EtherCatMaster(Protocol):
    """A master of a segment.

    Attributes:
        alive: Called again and again while an answer is waited for.
        clock: Settings of the distributed clocks for `map`; None: not used.
        system_time: The reference's time from the last exchange [ns]; None if it brought none.
    """

    alive: Callable[[], None]
    clock: Sync0 | None
    system_time: int | None

    def begin(self) -> int:
        """Find the slaves, give them addresses, and take them to Pre-Op, from any state. Returns their number.

        Raises:
            BusError: If there is no slave, or one does not reach Pre-Op.
        """

    def recover(self, position: int) -> bool:
        """Take a slave from any state to Pre-Op; return whether it had restarted, and so lost its address.

        Raises:
            BusError: If it does not reach Pre-Op.
        """

    def identity(self, position: int) -> SlaveIdentity:
        """Return the identity in a slave's EEPROM."""

    def status(self, position: int) -> SlaveStatus:
        """Read a slave's present state."""

    def map(self, sizes: Mapping[int, ImageSizes]) -> None:
        """Assign addresses to the images of slaves, and take the slaves from Pre-Op to Safe-Op.

        Raises:
            BusError: If one refuses, with its AL status code.
        """

    def operate(self, positions: Sequence[int], exchange: Callable[[], None] | None, timeout: float) -> None:
        """Take slaves to Op; `exchange` sends images meanwhile, since some slaves need them before.

        Raises:
            BusError: If one refuses, or does not reach Op within `timeout` [s].
        """

    def leave_op(self, position: int) -> None:
        """Take a slave to Pre-Op.

        Raises:
            BusError: If it does not reach Pre-Op.
        """

    def exchange(self, outputs: Sequence[bytes], timeout: float) -> list[bytes | None]:
        """Send the images of the mapped slaves and return their answers, in the order of `map`.

        Returns:
            None for a slave that is not in Op; None for all if the frame is lost or a slave has not handled its part.
        """

    def upload(self, position: int, index: int, sub: int, timeout: float) -> bytes:
        """Return the bytes of an object.

        Raises:
            ObjectAccessError: With the abort code; NoAnswerError if no answer comes within `timeout` [s].
        """

    def download(self, position: int, index: int, sub: int, data: bytes, timeout: float) -> None:
        """Write the bytes of an object, as `upload` reads them."""

    def post(self, position: int, index: int, sub: int, data: bytes) -> None:
        """Send a short write, without waiting for an answer or for a transfer that is under way."""

    def register(self, position: int, address: int, size: int) -> bytes | None:
        """Return a slave's register; None if it does not answer."""

    def write_register(self, position: int, address: int, data: bytes) -> None:
        """Write a slave's register.

        Raises:
            NoAnswerError: If it does not accept it.
        """

    def take_emergencies(self) -> list[ReceivedEmergency]:
        """Return and forget the received emergencies; their nodes are positions."""

    def close(self) -> None:
        """Take all slaves to Init, as far as they answer, and close the bus."""
