"""The calls between an EtherCAT slave controller and the device behind it.

The controller (`controller.py`) owns everything that ETG.1000.4 and ETG.1000.6 put in front of the application:
registers, EEPROM interface, FMMUs, sync managers, the mailbox header with its counter and its repetitions, FoE in
Bootstrap, the AL state machine with the checks of sync managers 0 to 3, watchdogs and clocks. The application owns the
object dictionary: CoE messages without their mailbox header, the process image as bytes, the SII's content, and its own
reasons to refuse a state.

The order of calls, all in one thread, each with the time `now` [s] of the emulated world:

    power_on                              once, and again after each power cycle; the state is Init
    request_state(old, new, ...)          for each change upwards, and for Op to Safe-Op, after the controller's own
                                          checks; what it returns but NO_ERROR refuses
    state_changed(new, code)              after each change, those that an error or the watchdog forces among them
    coe(message)                          a CoE message from the master, in Pre-Op and above; returns what answers it
    pending_coe()                         asked in each cycle: answers that took time, emergencies
    before_cycle / after_cycle            around each communication cycle of the drives
    outputs(data)                         the whole output image, in Op alone, when the master has written it
    inputs()                              the whole input image, in Safe-Op and Op, after each cycle
    watchdog_expired                      outputs stayed away in Op: the drive stops by its fault reaction; then follows
                                          state_changed(SAFE_OP, SM_WATCHDOG)
    sync0, sync1                          a pulse of the distributed clocks
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol


class AlState(IntEnum):
    """States of the EtherCAT state machine, as in AL control and AL status (ETG.1000.6, 6.4.1)."""

    INIT = 1
    PRE_OP = 2
    BOOTSTRAP = 3
    SAFE_OP = 4
    OP = 8


class AlStatusCode(IntEnum):
    """AL status codes (0134h; ETG.1000.6, table 11; ETG.1020): the reason why a state was refused or left."""

    NO_ERROR = 0x0000
    UNSPECIFIED = 0x0001
    INVALID_CHANGE = 0x0011
    UNKNOWN_STATE = 0x0012
    NO_BOOTSTRAP = 0x0013
    NO_FIRMWARE = 0x0014
    BOOTSTRAP_MAILBOX = 0x0015
    MAILBOX = 0x0016
    SYNC_MANAGER = 0x0017
    NO_INPUTS = 0x0018
    NO_OUTPUTS = 0x0019
    SYNCHRONISATION = 0x001A
    SM_WATCHDOG = 0x001B
    SYNC_MANAGER_TYPES = 0x001C
    OUTPUT_CONFIGURATION = 0x001D
    INPUT_CONFIGURATION = 0x001E
    WATCHDOG_CONFIGURATION = 0x001F
    NEEDS_INIT = 0x0021
    NEEDS_PRE_OP = 0x0022
    NEEDS_SAFE_OP = 0x0023
    INPUT_MAPPING = 0x0024
    OUTPUT_MAPPING = 0x0025
    INCONSISTENT_SETTINGS = 0x0026
    NO_FREE_RUN = 0x0027
    NO_SYNCHRONISATION = 0x0028
    FATAL_SYNC = 0x002C
    NO_SYNC = 0x002D
    DC_SYNC_CONFIGURATION = 0x0030
    DC_LATCH_CONFIGURATION = 0x0031
    PLL = 0x0032
    DC_CYCLE_TIME = 0x0035
    EEPROM_NO_ACCESS = 0x0050
    EEPROM_ERROR = 0x0051


@dataclass(frozen=True, slots=True)
class SyncManagerSetting:
    """A sync manager (0800h + 8 n) as the master has set it: bytes of memory from `start` on, control, activation."""

    start: int
    length: int
    control: int
    is_enabled: bool

    @property
    def is_mailbox(self) -> bool:
        """Whether it is a mailbox (one buffer with handshake); otherwise it has three buffers."""
        return self.control & 0x03 == 0x02

    @property
    def is_written_by_master(self) -> bool:
        """Whether the master writes and the device reads."""
        return self.control & 0x0C == 0x04

    @property
    def has_watchdog(self) -> bool:
        """Whether the process-data watchdog monitors it."""
        return bool(self.control & 0x40)


@dataclass(frozen=True, slots=True)
class ClockSetting:
    """Distributed clocks as the master has set them: is SYNC0 on, its cycle [s] (0: one shot); SYNC1 likewise."""

    has_sync0: bool
    sync0_cycle: float
    has_sync1: bool = False
    sync1_cycle: float = 0.0


@dataclass(frozen=True, slots=True)
class MailboxPlace:
    """Where a mailbox lies in the controller's memory: address and length [bytes]."""

    start: int
    length: int


@dataclass(frozen=True, slots=True)
class SlaveLayout:
    """Addresses of a device's sync managers; its SII gives the same to the master (words 0014h to 001Bh, category 41).

    `receive` is the mailbox that the master writes (sync manager 0), `send` the one that it reads (1). A device without
    `bootstrap_receive` has no Bootstrap. `outputs` and `inputs` are the addresses of sync managers 2 and 3.
    """

    receive: MailboxPlace
    send: MailboxPlace
    outputs: int
    inputs: int
    bootstrap_receive: MailboxPlace | None = None
    bootstrap_send: MailboxPlace | None = None


class Application(Protocol):
    """The device behind a slave controller; the module's docstring has the order of calls.

    Attributes:
        layout: Addresses of its sync managers.
    """

    layout: SlaveLayout

    @property
    def identification(self) -> int:
        """Number that answers an identification request (AL control bit 5); 0 if the device has no such number."""

    @property
    def output_size(self) -> int:
        """Bytes that the master writes by sync manager 2 with the present mapping; 0: none."""

    @property
    def input_size(self) -> int:
        """Bytes that the master reads by sync manager 3 with the present mapping; 0: none."""

    def read_sii(self) -> bytes:
        """Return the EEPROM's content (ETG.2010), a multiple of 128 bytes including words 0000h to 0007h."""

    def write_sii(self, content: bytes) -> None:
        """Store the EEPROM's whole content after the master has written to it; its length is that of `read_sii`."""

    def power_on(self, now: float) -> None:
        """Boot: stored values, no process data, Init."""

    def request_state(
        self, old: AlState, new: AlState, sync_managers: Sequence[SyncManagerSetting], clock: ClockSetting, now: float
    ) -> AlStatusCode:
        """Return NO_ERROR to allow the change of state, otherwise the reason against it.

        The controller has already checked address, length, direction and activation of sync managers 0 to 3.
        """

    def state_changed(self, new: AlState, code: AlStatusCode, now: float) -> None:
        """Note the new state, and the code of the error that forced it; leaving Op stops the drive."""

    def coe(self, message: bytes, now: float) -> list[bytes]:
        """Return the CoE messages that answer one, each with its CoE header and without a mailbox header.

        Raises:
            ValueError: For a message that is too short or of an unknown service; the controller answers by a mailbox
                error.
        """

    def pending_coe(self, now: float) -> list[bytes]:
        """Return and forget the CoE messages that do not answer a present request: emergencies, delayed answers."""

    def before_cycle(self, now: float) -> None:
        """Run everything due before the drives advance by one communication cycle."""

    def after_cycle(self, now: float) -> None:
        """Run everything due after it."""

    def outputs(self, data: bytes, now: float) -> None:
        """Receive the output image, `output_size` bytes, which takes effect with the next cycle."""

    def inputs(self, now: float) -> bytes:
        """Return the input image, `input_size` bytes."""

    def watchdog_expired(self, now: float) -> None:
        """Note that no outputs came in time: the drive stops by its fault reaction."""

    def sync0(self, now: float) -> None:
        """Handle a pulse of SYNC0."""

    def sync1(self, now: float) -> None:
        """Handle a pulse of SYNC1."""
