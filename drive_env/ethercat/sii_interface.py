"""The EEPROM interface of a slave controller, 0500h and on (ETG.1000.4, 6.5): for the master's access to the SII.

A command is written with or after its address, is busy for a while, and puts up to 8 bytes into 0508h. Words 0 to 7
configure the controller: it reads them at power-on and at the command reload, and uses them if their CRC is right.
"""

from __future__ import annotations

import struct

from drive_env.ethercat import registers

READ, WRITE, RELOAD = 1, 2, 4
COMMAND, COMMAND_SHIFT = 0x0700, 8
WRITE_ENABLE = 0x0001
EIGHT_BYTES, TWO_ADDRESS_BYTES = 0x0040, 0x0080
CHECKSUM_ERROR, COMMAND_ERROR, WRITE_ERROR, BUSY = 1 << 11, 1 << 13, 1 << 14, 1 << 15
PDI_OWNS = 0x01  # of 0500h
# s, of an I2C EEPROM: eight bytes at 150 kbit/s, and a word's write cycle.
READ_TIME, WRITE_TIME = 0.7e-3, 5e-3
CONFIGURATION = 16  # bytes with their CRC
ALIAS_WORD = 4


def checksum(content: bytes | bytearray) -> int:
    """Return the CRC of the first seven words: polynomial x^8 + x^2 + x + 1, start value FFh (ETG.2010)."""
    crc = 0xFF
    for byte in content[: CONFIGURATION - 2]:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x07 if crc & 0x80 else crc << 1) & 0xFF
    return crc


class SiiInterface:
    """The interface.

    Args:
        memory: The controller's memory.
        takes_time: Whether a command is busy as long as on a real EEPROM.

    Attributes:
        content: The EEPROM's content.
        is_changed: Whether the master has written to it since this was last reset.
    """

    def __init__(self, memory: bytearray, takes_time: bool) -> None:
        self._memory = memory
        self._takes_time = takes_time
        self.content = bytearray()
        self.is_changed = False
        self._busy_until = -1.0
        self._flags = 0

    def power_on(self, content: bytes) -> None:
        """Set the EEPROM's content, and load its configuration and alias."""
        self.content = bytearray(content)
        self._busy_until = -1.0
        self._flags = 0
        if self._load():
            self._memory[registers.ALIAS : registers.ALIAS + 2] = self._word(ALIAS_WORD)
        self.refresh(0.0)

    def refresh(self, now: float) -> None:
        """Update 0502h to the state at `now` [s]."""
        busy = BUSY if now < self._busy_until else 0
        struct.pack_into(
            "<H", self._memory, registers.SII_CONTROL, EIGHT_BYTES | TWO_ADDRESS_BYTES | self._flags | busy
        )

    def command(self, now: float) -> None:
        """Run the command written to 0502h, unless a command is busy or the device owns the EEPROM."""
        (control,) = struct.unpack_from("<H", self._memory, registers.SII_CONTROL)
        command = (control & COMMAND) >> COMMAND_SHIFT
        if now < self._busy_until or self._memory[registers.SII_ACCESS] & PDI_OWNS:
            self.refresh(now)
            return
        self._flags &= ~(COMMAND_ERROR | WRITE_ERROR)  # any new command acknowledges the errors of the last
        (address,) = struct.unpack_from("<I", self._memory, registers.SII_ADDRESS)
        time = READ_TIME
        if command == READ:
            part = bytes(self.content[2 * address : 2 * address + 8]).ljust(8, b"\xff")
            self._memory[registers.SII_DATA : registers.SII_DATA + 8] = part
        elif command == WRITE:
            time = WRITE_TIME
            self._write(address, control)
        elif command == RELOAD:
            self._load()
        elif command:
            self._flags |= COMMAND_ERROR
        if command and self._takes_time:
            self._busy_until = now + time
        self.refresh(now)

    def _write(self, address: int, control: int) -> None:
        if not control & WRITE_ENABLE:
            self._flags |= WRITE_ERROR
        elif 2 * address + 2 > len(self.content):
            self._flags |= COMMAND_ERROR  # the EEPROM does not acknowledge such an address
        else:
            data = self._memory[registers.SII_DATA : registers.SII_DATA + 2]
            self.content[2 * address : 2 * address + 2] = data
            self.is_changed = True

    def _load(self) -> bool:
        """Load the configuration; return whether its CRC is right."""
        if len(self.content) < CONFIGURATION or checksum(self.content) != self.content[CONFIGURATION - 2]:
            self._flags |= CHECKSUM_ERROR
            return False
        self._flags &= ~CHECKSUM_ERROR
        self._memory[registers.PDI_CONTROL : registers.PDI_CONTROL + 2] = self._word(0)
        self._memory[registers.PDI_CONFIGURATION : registers.PDI_CONFIGURATION + 2] = self._word(1)
        self._memory[registers.SYNC_PULSE : registers.SYNC_PULSE + 2] = self._word(2)
        self._memory[registers.PDI_CONFIGURATION + 2 : registers.PDI_CONFIGURATION + 4] = self._word(3)
        return True

    def _word(self, address: int) -> bytes:
        return bytes(self.content[2 * address : 2 * address + 2])
