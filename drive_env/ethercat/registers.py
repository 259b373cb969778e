"""The registers of a slave controller as rows (ETG.1000.4, clause 6; ET1100 data sheet, section II).

A master may write the bits of `mask`; the effects of a write are in the modules that the rows belong to:
`sii_interface.py`, `sync_manager.py`, `distributed_clock.py`, `state_machine.py`. The rows of one FMMU or sync manager
apply to all of them.
"""

from __future__ import annotations

from typing import NamedTuple

REGISTERS_END = 0x1000  # the memory for process data and mailboxes begins here
RAM_KIB = 8
RAM_END = REGISTERS_END + RAM_KIB * 1024
NUM_FMMUS = NUM_SYNC_MANAGERS = 8

TYPE = 0x11  # ET1100
PORTS = 0x0F  # 0 and 1 are MII, 2 and 3 do not exist
FEATURES = 0x00CC  # FMMUs bitwise, distributed clocks of 64 bits, frames with FCS errors counted, enhanced SYNC

STATION_ADDRESS, ALIAS = 0x0010, 0x0012
RESET = 0x0040
DL_CONTROL, DL_STATUS = 0x0100, 0x0110
AL_CONTROL, AL_STATUS, AL_STATUS_CODE = 0x0120, 0x0130, 0x0134
PDI_CONTROL, PDI_CONFIGURATION = 0x0140, 0x0150
ECAT_EVENT_MASK, AL_EVENT_MASK, ECAT_EVENT, AL_EVENT = 0x0200, 0x0204, 0x0210, 0x0220
RX_ERRORS, FORWARDED_ERRORS, UNIT_ERRORS, LOST_LINKS = 0x0300, 0x0308, 0x030C, 0x0310
WATCHDOG_DIVIDER, PDI_WATCHDOG, SM_WATCHDOG = 0x0400, 0x0410, 0x0420
WATCHDOG_STATUS, WATCHDOG_COUNTER = 0x0440, 0x0442
SII_ACCESS, SII_CONTROL, SII_ADDRESS, SII_DATA = 0x0500, 0x0502, 0x0504, 0x0508
FMMUS, FMMU_SIZE = 0x0600, 16
SYNC_MANAGERS, SYNC_MANAGER_SIZE = 0x0800, 8
RECEIVE_TIMES, SYSTEM_TIME, RECEIVE_TIME_UNIT = 0x0900, 0x0910, 0x0918
TIME_OFFSET, TIME_DELAY, TIME_DIFFERENCE = 0x0920, 0x0928, 0x092C
SPEED_START, SPEED_DIFFERENCE, FILTER_DEPTHS = 0x0930, 0x0932, 0x0934
SYNC_CONTROL, SYNC_ACTIVATION, SYNC_PULSE, SYNC_STATUS = 0x0980, 0x0981, 0x0982, 0x0984
SYNC0_START, SYNC1_NEXT, SYNC0_CYCLE, SYNC1_DELAY = 0x0990, 0x0998, 0x09A0, 0x09A4
USER_RAM = 0x0F80


class Register(NamedTuple):
    """A register: address, length [bytes], value after reset, bits that a master may write."""

    address: int
    size: int
    reset: int
    mask: int
    name: str


REGISTERS = (
    Register(0x0000, 1, TYPE, 0, "Type"),
    Register(0x0001, 1, 0x00, 0, "Revision"),
    Register(0x0002, 2, 0x0002, 0, "Build"),
    Register(0x0004, 1, NUM_FMMUS, 0, "FMMUs supported"),
    Register(0x0005, 1, NUM_SYNC_MANAGERS, 0, "Sync managers supported"),
    Register(0x0006, 1, RAM_KIB, 0, "RAM size"),
    Register(0x0007, 1, PORTS, 0, "Port descriptor"),
    Register(0x0008, 2, FEATURES, 0, "ESC features"),
    Register(STATION_ADDRESS, 2, 0, 0xFFFF, "Configured station address"),
    Register(ALIAS, 2, 0, 0, "Configured station alias"),
    Register(RESET, 1, 0, 0xFF, "ESC reset"),
    Register(DL_CONTROL, 4, 0x0007C001, 0x0107FFFB, "DL control"),
    Register(DL_STATUS, 2, 0, 0, "DL status"),
    Register(AL_CONTROL, 2, 1, 0x003F, "AL control"),
    Register(AL_STATUS, 2, 1, 0, "AL status"),
    Register(AL_STATUS_CODE, 2, 0, 0, "AL status code"),
    Register(PDI_CONTROL, 2, 0, 0, "PDI control, ESC configuration"),
    Register(PDI_CONFIGURATION, 4, 0, 0, "PDI configuration"),
    Register(ECAT_EVENT_MASK, 2, 0, 0xFFFF, "ECAT event mask"),
    Register(AL_EVENT_MASK, 4, 0x00FFFF0F, 0, "AL event mask"),
    Register(ECAT_EVENT, 2, 0, 0, "ECAT event request"),
    Register(AL_EVENT, 4, 0, 0, "AL event request"),
    Register(RX_ERRORS, 8, 0, 0, "RX error counters"),
    Register(FORWARDED_ERRORS, 4, 0, 0, "Forwarded RX error counters"),
    Register(UNIT_ERRORS, 1, 0, 0, "Processing unit error counter"),
    Register(LOST_LINKS, 4, 0, 0, "Lost link counters"),
    Register(WATCHDOG_DIVIDER, 2, 0x09C2, 0xFFFF, "Watchdog divider"),
    Register(PDI_WATCHDOG, 2, 0x03E8, 0xFFFF, "Watchdog time PDI"),
    Register(SM_WATCHDOG, 2, 0x03E8, 0xFFFF, "Watchdog time process data"),
    Register(WATCHDOG_STATUS, 2, 1, 0, "Watchdog status process data"),
    Register(WATCHDOG_COUNTER, 2, 0, 0, "Watchdog counters process data, PDI"),
    Register(SII_ACCESS, 2, 0, 0x0003, "SII EEPROM configuration, PDI access"),
    Register(SII_CONTROL, 2, 0x00C0, 0x0701, "SII EEPROM control and status"),
    Register(SII_ADDRESS, 4, 0, 0xFFFFFFFF, "SII EEPROM address"),
    Register(SII_DATA, 8, 0, 0xFFFF, "SII EEPROM data"),
    *(Register(FMMUS + k * FMMU_SIZE, 13, 0, 0x01_03_07_FFFF_07_07_FFFF_FFFFFFFF, "FMMU") for k in range(NUM_FMMUS)),
    *(
        Register(SYNC_MANAGERS + k * SYNC_MANAGER_SIZE, 8, 0, 0x00_C3_00_7F_FFFF_FFFF, "Sync manager")
        for k in range(NUM_SYNC_MANAGERS)
    ),
    Register(RECEIVE_TIMES, 16, 0, 0xFFFFFFFF, "Receive times of ports 0 to 3"),
    Register(SYSTEM_TIME, 8, 0, 0xFFFFFFFF, "System time"),
    Register(RECEIVE_TIME_UNIT, 8, 0, 0, "Receive time of the processing unit"),
    Register(TIME_OFFSET, 8, 0, 0xFFFFFFFF_FFFFFFFF, "System time offset"),
    Register(TIME_DELAY, 4, 0, 0xFFFFFFFF, "System time delay"),
    Register(TIME_DIFFERENCE, 4, 0, 0, "System time difference"),
    Register(SPEED_START, 2, 0x1000, 0x7FFF, "Speed counter start"),
    Register(SPEED_DIFFERENCE, 2, 0, 0, "Speed counter difference"),
    Register(FILTER_DEPTHS, 2, 0x0C04, 0x0F0F, "Filter depths of time difference, speed counter"),
    Register(SYNC_CONTROL, 1, 0, 0, "Cyclic unit control"),
    Register(SYNC_ACTIVATION, 1, 0, 0x07, "Activation of the cyclic unit"),
    Register(SYNC_PULSE, 2, 0, 0, "Pulse length of SYNC signals"),
    Register(SYNC_STATUS, 1, 0, 0, "Activation status"),
    Register(SYNC0_START, 8, 0, 0xFFFFFFFF_FFFFFFFF, "Start of cyclic operation, next SYNC0"),
    Register(SYNC1_NEXT, 8, 0, 0, "Next SYNC1"),
    Register(SYNC0_CYCLE, 4, 0, 0xFFFFFFFF, "SYNC0 cycle time"),
    Register(SYNC1_DELAY, 4, 0, 0xFFFFFFFF, "SYNC1 cycle time: from SYNC0 to SYNC1"),
    Register(USER_RAM, 128, 0, (1 << 1024) - 1, "User RAM"),
)
# A write of any value to one of these sets all counters of the group to 0.
COUNTERS = ((RX_ERRORS, FORWARDED_ERRORS + 4), (UNIT_ERRORS, UNIT_ERRORS + 1), (LOST_LINKS, LOST_LINKS + 4),
            (WATCHDOG_COUNTER, WATCHDOG_COUNTER + 2))  # fmt: skip


def reset_values() -> bytearray:
    """Return all registers after a reset, followed by memory of zeros."""
    memory = bytearray(RAM_END)
    for row in REGISTERS:
        memory[row.address : row.address + row.size] = row.reset.to_bytes(row.size, "little")
    return memory


def write_masks() -> bytes:
    """Return, for each byte of the registers, the bits that a master may write."""
    masks = bytearray(REGISTERS_END)
    for row in REGISTERS:
        masks[row.address : row.address + row.size] = row.mask.to_bytes(row.size, "little")
    return bytes(masks)
