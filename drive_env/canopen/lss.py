"""The slave of the layer setting services: node-ID and bit rate over the bus, without a node-ID (CiA 305).

A call takes a request and returns the response: eight bytes, or None. The slave waits until the master switches it to
configuration, all slaves at once or the one with an identity. Configured values are pending: a node-ID takes effect
with the next reset, a bit rate when all slaves activate it together.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import NamedTuple, Protocol

REQUEST, RESPONSE = 0x7E5, 0x7E4  # identifiers
UNCONFIGURED = 255  # the node-ID of a node without one
# kbit/s by index of CiA 305's table 0; 5 is reserved.
BIT_RATES = {0: 1000, 1: 800, 2: 500, 3: 250, 4: 125, 6: 50, 7: 20, 8: 10}


class Service(IntEnum):
    """Command specifiers."""

    SWITCH_GLOBAL = 0x04
    CONFIGURE_NODE_ID = 0x11
    CONFIGURE_BIT_TIMING = 0x13
    ACTIVATE_BIT_TIMING = 0x15
    STORE = 0x17
    SWITCH_VENDOR = 0x40
    SWITCH_PRODUCT = 0x41
    SWITCH_REVISION = 0x42
    SWITCH_SERIAL = 0x43
    SWITCHED = 0x44
    IDENTIFY_VENDOR = 0x46
    IDENTIFY_PRODUCT = 0x47
    IDENTIFY_REVISION_LOW = 0x48
    IDENTIFY_REVISION_HIGH = 0x49
    IDENTIFY_SERIAL_LOW = 0x4A
    IDENTIFY_SERIAL_HIGH = 0x4B
    IDENTIFY_UNCONFIGURED = 0x4C
    IDENTIFIED = 0x4F
    UNCONFIGURED_IDENTIFIED = 0x50
    FASTSCAN = 0x51
    INQUIRE_VENDOR = 0x5A
    INQUIRE_PRODUCT = 0x5B
    INQUIRE_REVISION = 0x5C
    INQUIRE_SERIAL = 0x5D
    INQUIRE_NODE_ID = 0x5E


WAITING, CONFIGURATION = 0, 1  # modes of the switch
OK, OUT_OF_RANGE, STORE_UNSUPPORTED, STORE_FAILED = 0, 1, 1, 2  # error codes of responses
FASTSCAN_BEGINS = 0x80  # "bit checked" that begins a scan


class LssIdentity(NamedTuple):
    """The LSS address: 1018h, with 0 for entries that a device lacks."""

    vendor: int
    product: int
    revision: int
    serial: int


class LssNode(Protocol):
    """The calls of the slave to its node."""

    def identity(self) -> LssIdentity:
        """Return the node's identity."""

    def active_node_id(self) -> int:
        """Return the present node-ID; 255 if the node has none."""

    def pending_node_id(self) -> int:
        """Return the node-ID after the next reset."""

    def configure_node_id(self, node_id: int) -> None:
        """Store a pending node-ID for the next reset."""

    def configure_bit_rate(self, bit_rate: int) -> bool:
        """Store a pending bit rate [kbit/s]; return whether the node has it."""

    def activate_bit_rate(self, delay: float) -> None:
        """Fall silent, switch to the bit rate after `delay` [s], and stay silent for `delay` again."""

    def store(self) -> int:
        """Store the pending settings; return OK, STORE_UNSUPPORTED or STORE_FAILED."""

    def leave_configuration(self) -> None:
        """Note that the slave waits again: a node that had no node-ID and now has one boots."""


class LssSlave:
    """The slave of one node.

    Args:
        node: The node.
    """

    def __init__(self, node: LssNode) -> None:
        self._node = node
        self._answers: dict[int, Callable[[bytes], bytes | None]] = {
            Service.CONFIGURE_NODE_ID: self._configure_node_id,
            Service.CONFIGURE_BIT_TIMING: self._configure_bit_timing,
            Service.ACTIVATE_BIT_TIMING: self._activate_bit_timing,
            Service.STORE: lambda data: _answer(Service.STORE, node.store()),
            Service.INQUIRE_NODE_ID: lambda data: _answer(Service.INQUIRE_NODE_ID, node.active_node_id()),
        }
        self.reset()

    def reset(self) -> None:
        """Switch to waiting, as after power-on."""
        self.is_configuring = False
        self._switch_stage = self._identify_stage = 0  # number of parts of the identity that matched so far
        self._scanned: int | None = None  # part of the identity that the scan has reached

    def request(self, data: bytes) -> bytes | None:
        """Return the response to a request; None if it is not a request of eight bytes."""
        if len(data) != 8:
            return None
        service = data[0]
        if service == Service.SWITCH_GLOBAL:
            self._switch(data[1])
            return None
        if Service.SWITCH_VENDOR <= service <= Service.SWITCH_SERIAL:
            return self._switch_selective(service - Service.SWITCH_VENDOR, _number(data))
        if Service.IDENTIFY_VENDOR <= service <= Service.IDENTIFY_SERIAL_HIGH:
            return self._identify(service - Service.IDENTIFY_VENDOR, _number(data))
        if service == Service.IDENTIFY_UNCONFIGURED:
            is_meant = self._is_unconfigured()
            return _answer(Service.UNCONFIGURED_IDENTIFIED) if is_meant else None
        if service == Service.FASTSCAN:
            return self._scan(_number(data), *data[5:8])
        if not self.is_configuring:
            return None
        if Service.INQUIRE_VENDOR <= service <= Service.INQUIRE_SERIAL:
            part = self._node.identity()[service - Service.INQUIRE_VENDOR]
            return bytes((service,)) + part.to_bytes(4, "little") + bytes(3)
        answer = self._answers.get(service)
        return None if answer is None else answer(data)

    # --- which slave is meant -------------------------------------------------------------------------------------
    def _switch(self, mode: int) -> None:
        self._switch_stage = 0
        if mode == CONFIGURATION:
            self.is_configuring = True
        elif mode == WAITING and self.is_configuring:
            self.is_configuring = False
            self._node.leave_configuration()

    def _switch_selective(self, part: int, number: int) -> bytes | None:
        """Compare a part of the identity; select the slave and answer if all four match in their order, else None."""
        if self.is_configuring:
            return None
        in_order = part in (0, self._switch_stage)
        self._switch_stage = part + 1 if in_order and number == self._node.identity()[part] else 0
        if self._switch_stage < 4:
            return None
        self._switch_stage = 0
        self.is_configuring = True
        return _answer(Service.SWITCHED)

    def _identify(self, part: int, number: int) -> bytes | None:
        """Compare vendor and product, and the ranges of revision and serial number; answer if all fit, else None."""
        identity = self._node.identity()
        fits = (
            number == identity.vendor,
            number == identity.product,
            number <= identity.revision,
            identity.revision <= number,
            number <= identity.serial,
            identity.serial <= number,
        )
        in_order = part in (0, self._identify_stage)
        self._identify_stage = part + 1 if in_order and fits[part] else 0
        if self._identify_stage < 6:
            return None
        self._identify_stage = 0
        return _answer(Service.IDENTIFIED)

    def _is_unconfigured(self) -> bool:
        return self._node.active_node_id() == UNCONFIGURED and self._node.pending_node_id() == UNCONFIGURED

    def _scan(self, number: int, bit: int, part: int, following: int) -> bytes | None:
        """Answer if the identity's bits down to `bit` equal those of the number, else None."""
        if self.is_configuring or not self._is_unconfigured():
            return None
        if bit == FASTSCAN_BEGINS:
            self._scanned = 0
            return _answer(Service.IDENTIFIED)
        if self._scanned is None or bit > 31 or part > 3 or following > 3 or part != self._scanned:
            return None
        if (number ^ self._node.identity()[part]) >> bit:
            return None
        if bit == 0:  # the whole part matches: go to the next one, after the last one to configuration
            self._scanned = following
            if following < part:
                self._scanned = None
                self.is_configuring = True
        return _answer(Service.IDENTIFIED)

    # --- what is configured ---------------------------------------------------------------------------------------
    def _configure_node_id(self, data: bytes) -> bytes:
        node_id = data[1]
        if not (1 <= node_id <= 127 or node_id == UNCONFIGURED):
            return _answer(Service.CONFIGURE_NODE_ID, OUT_OF_RANGE)
        self._node.configure_node_id(node_id)
        return _answer(Service.CONFIGURE_NODE_ID, OK)

    def _configure_bit_timing(self, data: bytes) -> bytes:
        bit_rate = BIT_RATES.get(data[2]) if data[1] == 0 else None
        is_taken = bit_rate is not None and self._node.configure_bit_rate(bit_rate)
        return _answer(Service.CONFIGURE_BIT_TIMING, OK if is_taken else OUT_OF_RANGE)

    def _activate_bit_timing(self, data: bytes) -> None:
        self._node.activate_bit_rate((data[1] | data[2] << 8) * 1e-3)


def _number(data: bytes) -> int:
    return int.from_bytes(data[1:5], "little")


def _answer(service: Service, code: int = 0) -> bytes:
    return bytes((service, code)) + bytes(6)
