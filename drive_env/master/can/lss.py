"""The master of the layer setting services: nodes get their node-ID and bit rate over the bus (CiA 305)."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from drive_env.canopen.lss import (
    BIT_RATES,
    CONFIGURATION,
    FASTSCAN_BEGINS,
    OK,
    REQUEST,
    RESPONSE,
    UNCONFIGURED,
    WAITING,
    LssIdentity,
    Service,
)
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.fieldbus.errors import BusError, NoAnswerError
from drive_env.master.can.port import Port
from drive_env.master.can.sdo import SdoClient

# s. Several slaves answer a step of a scan, one after the other: an answer this long after the first still belongs to
# that step, not to the next.
ECHO = 0.005
ANSWER_TIMEOUT = 0.3  # s, of an SDO request to a node that may not be there
MOST_NODES = 127
_STORE_ERRORS = {1: "it cannot store", 2: "its memory failed"}
_IDENTITY = 0x1018


class LssError(BusError):
    """A slave refuses, or the bus is not in the state that a service needs."""


class LssMaster:
    """Asks and configures the LSS slaves of a bus.

    Args:
        port: The bus.
        timeout: Longest wait for an answer [s]; a step of a scan without an answer takes all of it.
        is_dry: A dry run without slaves: frames are shown, and everything succeeds.
    """

    def __init__(self, port: Port, timeout: float = 0.1, *, is_dry: bool = False) -> None:
        self._port = port
        self._timeout = timeout
        self._is_dry = is_dry
        self._answers: list[bytes] = []
        port.subscribe(RESPONSE, self._answers.append)

    # --- which slave ----------------------------------------------------------------------------------------------
    def switch_all(self, *, configuration: bool) -> None:
        """Switch all slaves to configuration, or to waiting."""
        self._send(Service.SWITCH_GLOBAL, bytes((CONFIGURATION if configuration else WAITING,)))

    def select(self, identity: LssIdentity) -> None:
        """Switch the slave with an identity to configuration.

        Raises:
            LssError: If no slave with it answers.
        """
        for part, number in enumerate(identity[:3]):
            self._send(Service.SWITCH_VENDOR + part, number.to_bytes(4, "little"))
        if self._ask(Service.SWITCH_SERIAL, identity.serial.to_bytes(4, "little"), Service.SWITCHED) is None:
            raise LssError(
                f"no LSS slave has the identity {show(identity)}; look with `drive-env lss scan`, and at 1018h of a "
                "node that has a node-ID"
            )

    def scan(self) -> Iterator[LssIdentity]:
        """Find the slaves without a node-ID, one by one; each stays in configuration until `switch_all`."""
        for _ in range(MOST_NODES):
            found = self.fastscan()
            if found is None:
                return
            yield found

    def fastscan(self) -> LssIdentity | None:
        """Find one slave without a node-ID, bit by bit, and switch it to configuration; None if no slave answers.

        Raises:
            LssError: If a slave answers at first but not at the end.
        """
        if not self._step(0, FASTSCAN_BEGINS, 0, 0):
            return None
        numbers = []
        for part in range(4):
            number = 0
            for bit in reversed(range(32)):
                if not self._step(number, bit, part, part):
                    number |= 1 << bit
            if not self._step(number, 0, part, (part + 1) % 4):
                raise LssError(
                    "a slave stopped answering within a scan; slaves are slow, or frames are lost: take a longer "
                    "--timeout"
                )
            numbers.append(number)
        return LssIdentity(*numbers)

    def _step(self, number: int, bit: int, part: int, following: int) -> bool:
        data = number.to_bytes(4, "little") + bytes((bit, part, following))
        return self._ask(Service.FASTSCAN, data, Service.IDENTIFIED, echo=ECHO) is not None

    # --- what the slave in configuration is asked, and told ---------------------------------------------------------
    def identity(self) -> LssIdentity:
        """Return the identity of the slave in configuration.

        Raises:
            LssError: If no slave answers.
        """
        parts = [self._expect(Service.INQUIRE_VENDOR + part) for part in range(4)]
        return LssIdentity(*(int.from_bytes(answer[1:5], "little") for answer in parts))

    def node_id(self) -> int:
        """Return the node-ID of the slave in configuration; 255 if it has none.

        Raises:
            LssError: If no slave answers.
        """
        return self._expect(Service.INQUIRE_NODE_ID)[1]

    def configure_node_id(self, node_id: int) -> None:
        """Set the node-ID of the slave in configuration, in force after its next reset; 255 removes the node-ID.

        Raises:
            LssError: If the slave refuses, or none answers.
        """
        answer = self._expect(Service.CONFIGURE_NODE_ID, bytes((node_id,)))
        if answer[1] != OK:
            raise LssError(f"the node refuses the node-ID {node_id} (error {answer[1]}, {answer[2]}); choose 1 to 127")

    def configure_bit_rate(self, bit_rate: int) -> None:
        """Set the bit rate [bit/s] of the slave in configuration, in force after activation or the next power-on.

        Raises:
            ValueError: For a bit rate that CiA 305 does not have.
            LssError: If the slave refuses, or none answers.
        """
        row = row_of(bit_rate)
        answer = self._expect(Service.CONFIGURE_BIT_TIMING, bytes((0, row)))
        if answer[1] != OK:
            raise LssError(
                f"the node refuses {bit_rate} bit/s (error {answer[1]}, {answer[2]}); choose one that its manual lists"
            )

    def activate_bit_rate(self, delay: float) -> None:
        """Have all slaves in configuration wait `delay` [s] silently, change their bit rate, and wait once more."""
        self._send(Service.ACTIVATE_BIT_TIMING, round(1e3 * delay).to_bytes(2, "little"))

    def store(self, timeout: float) -> None:
        """Have the slave in configuration store its node-ID and bit rate.

        Raises:
            LssError: If the slave cannot store them, or none answers within `timeout` [s].
        """
        answer = self._expect(Service.STORE, timeout=timeout)
        if answer[1] != OK:
            why = _STORE_ERRORS.get(answer[1], f"error {answer[1]}, {answer[2]}")
            raise LssError(f"the node has not stored its node-ID and bit rate: {why}; they last until power-off")

    @contextmanager
    def configuring(self) -> Iterator[None]:
        """Set all slaves to waiting first, and at the end in any case.

        A slave without a node-ID then boots with the one that it was given.
        """
        self.switch_all(configuration=False)
        try:
            yield
        finally:
            self.switch_all(configuration=False)

    # --- frames -----------------------------------------------------------------------------------------------------
    def _send(self, service: int, data: bytes = b"") -> None:
        self._port.drain()
        self._answers.clear()
        self._port.send(REQUEST, bytes((service,)) + data.ljust(7, b"\0"))

    def _ask(
        self, service: int, data: bytes, answered: int, *, timeout: float | None = None, echo: float = 0.0
    ) -> bytes | None:
        """Return the answer to a request, None if none comes."""
        self._send(service, data)
        if self._is_dry:
            return bytes((answered,)) + bytes(7)

        def found() -> bytes | None:
            return next((one for one in self._answers if len(one) == 8 and one[0] == answered), None)

        self._port.wait(lambda: found() is not None, self._timeout if timeout is None else timeout)
        answer = found()
        if answer is not None and echo:
            self._port.wait(lambda: False, echo)
        return answer

    def _expect(self, service: int, data: bytes = b"", *, timeout: float | None = None) -> bytes:
        answer = self._ask(service, data, service, timeout=timeout)
        if answer is None:
            raise LssError(
                f"no LSS slave in configuration answered service {service:02X}h within "
                f"{self._timeout if timeout is None else timeout:g} s; check power and bit rate, or take a longer "
                "--timeout"
            )
        return answer


def identity_of(port: Port, node: int, timeout: float) -> LssIdentity:
    """Return the identity of a node that has a node-ID, by SDO.

    Raises:
        NoAnswerError: If it does not answer.
    """
    client = SdoClient(port, node)
    parts = []
    for sub in (1, 2, 3, 4):
        try:
            data = client.read(_IDENTITY, sub, f"{_IDENTITY:04X}h:{sub:02X}", timeout)
        except ObjectAccessError:
            data = b""  # an object that the device lacks counts as 0 in its LSS address
        parts.append(int.from_bytes(data[:4], "little"))
    return LssIdentity(*parts)


def is_taken(port: Port, node: int, timeout: float) -> bool:
    """Return whether a node answers under a node-ID."""
    try:
        SdoClient(port, node).read(0x1000, 0, "1000h:00", timeout)
    except NoAnswerError:
        return False
    except (ObjectAccessError, BusError):
        return True
    return True


def await_node(port: Port, identity: LssIdentity, node: int, before: int | None, timeout: float) -> None:
    """Wait until a booting node answers under its new node-ID or, if that is 255, no longer under its old one.

    Raises:
        LssError: If it does not within `timeout` [s].
    """
    end = time.monotonic() + timeout
    while True:
        if node == UNCONFIGURED:
            is_there = before is None or not is_taken(port, before, ANSWER_TIMEOUT)
        else:
            try:
                is_there = identity_of(port, node, ANSWER_TIMEOUT) == identity
            except NoAnswerError:
                is_there = False
        if is_there:
            return
        if time.monotonic() > end:
            raise LssError(
                f"the node {show(identity)} took the node-ID {node}, and after {timeout:g} s it still answers under "
                f"{before}; switch it off and on"
                if node == UNCONFIGURED
                else f"the node {show(identity)} took the node-ID {node}, and does not answer under it within "
                f"{timeout:g} s; switch it off and on, and look with `drive-env scan`"
            )


def row_of(bit_rate: int) -> int:
    """Return the row of a bit rate [bit/s] in CiA 305's table; ValueError if it is not there."""
    row = next((row for row, rate in BIT_RATES.items() if 1000 * rate == bit_rate), None)
    if row is None:
        known = ", ".join(str(1000 * rate) for rate in BIT_RATES.values())
        raise ValueError(f"{bit_rate} bit/s is no bit rate of LSS; there are {known}")
    return row


def show(identity: LssIdentity) -> str:
    """Return an identity in the form of the command line."""
    return ":".join(f"{number:X}" for number in identity)


def parse_identity(text: str) -> LssIdentity:
    """Parse an identity such as "286:664:10009:5"; ValueError for other text."""
    parts = text.replace("0x", "").split(":")
    try:
        numbers = [int(part, 16) for part in parts]
    except ValueError:
        numbers = []
    if len(numbers) != 4 or not all(0 <= number <= 0xFFFF_FFFF for number in numbers):
        raise ValueError(
            f"{text!r} is no identity; it is vendor, product, revision and serial number (1018h) in hexadecimal, as "
            "`drive-env lss scan` prints them: 286:664:10009:5"
        )
    return LssIdentity(*numbers)
