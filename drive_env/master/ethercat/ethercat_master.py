"""The interface of a master under the link over EtherCAT: slaves, states, objects over CoE, exchange of images.

There are two: `soem_master.py` has SOEM do it, for network interfaces; `frame_master.py` does it by itself, for
whatever carries frames as bytes: UDP, or a segment of the same process.

Slaves are named by their position in the line, from 0.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol

from drive_env.ethercat.application import AlState, AlStatusCode
from drive_env.fieldbus.link import ReceivedEmergency

STATE, ERROR = 0x0F, 0x10  # of AL status
READS = 5  # of a register, before its slave is taken to be silent: a frame may be lost


class SlaveStatus(NamedTuple):
    """AL status and AL status code of a slave; state 0: it does not answer at its address."""

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
    """Bytes of a slave's images: outputs, which it takes, and inputs, which it gives."""

    outputs: int
    inputs: int


class Sync0(NamedTuple):
    """Cycle of SYNC0 [s]; whether time passes by frames alone, so that its first pulse is that of the next cycle.

    With `sync1`, SYNC1 comes at the same times.
    """

    cycle: float
    is_lockstep: bool
    sync1: bool = False


class EtherCatMaster(Protocol):
    """A master of a segment.

    Attributes:
        alive: Called again and again while an answer is waited for.
        clock: What `map` sets the distributed clocks to; None: nothing.
        system_time: The reference's time that the last exchange has brought [ns]; None: it has brought none.
    """

    alive: Callable[[], None]
    clock: Sync0 | None
    system_time: int | None

    def begin(self) -> int:
        """Find the slaves, give them addresses, take them to Pre-Op; whatever they did before ends. Returns how many.

        Raises:
            BusError: If there is no slave, or one does not come to Pre-Op.
        """

    def recover(self, position: int) -> bool:
        """Take a slave from wherever it is to Pre-Op; return whether it had restarted, and had no address.

        Raises:
            BusError: If it does not come.
        """

    def identity(self, position: int) -> SlaveIdentity:
        """Return the identity in a slave's EEPROM."""

    def status(self, position: int) -> SlaveStatus:
        """Return a slave's state, asked now."""

    def map(self, sizes: Mapping[int, ImageSizes]) -> None:
        """Give the images of slaves their places, and take the slaves from Pre-Op to Safe-Op.

        Raises:
            BusError: If one refuses, with its AL status code.
        """

    def operate(self, positions: Sequence[int], exchange: Callable[[], None] | None, timeout: float) -> None:
        """Take slaves to Op; `exchange` sends images meanwhile, as some want them before.

        Raises:
            BusError: If one refuses, or does not come within `timeout` [s].
        """

    def leave_op(self, position: int) -> None:
        """Take a slave to Pre-Op.

        Raises:
            BusError: If it does not come.
        """

    def exchange(self, outputs: Sequence[bytes], timeout: float) -> list[bytes | None]:
        """Send the images of the slaves that are mapped and return theirs, in the order of `map`.

        Returns:
            None of a slave that is not in Op; of all if the frame does not come back, or one has not had its part.
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
        """Return a slave's register; None where it does not answer."""

    def write_register(self, position: int, address: int, data: bytes) -> None:
        """Write a slave's register.

        Raises:
            NoAnswerError: If it does not take it.
        """

    def take_emergencies(self) -> list[ReceivedEmergency]:
        """Return and forget the emergencies that came; nodes are positions."""

    def close(self) -> None:
        """Take all slaves to Init, as far as they answer, and let go of the bus."""
