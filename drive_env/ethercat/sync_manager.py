"""A sync manager: memory that master and device exchange as a whole (ETG.1000.4, 6.7; ET1100, section I, 8).

With three buffers a read gets the newest completely written one, and no side waits. As a mailbox it has one buffer,
full or empty, and the other side waits. An access to the first byte opens the buffer, one to the last closes it; other
accesses are refused while it is not open.
"""

from __future__ import annotations

from drive_env.ethercat.application import SyncManagerSetting

OFF = SyncManagerSetting(0, 0, 0, False)
INTERRUPT_WRITE, INTERRUPT_READ, MAILBOX_FULL = 0x01, 0x02, 0x08
NOTHING_WRITTEN = 0x30  # which buffer was written last: no buffer


class SyncManager:
    """One sync manager.

    Attributes:
        setting: The master's settings.
        end: First address after its memory; 0 while it is off.
        is_locked: Whether the device has deactivated it, so that the master can neither read nor write its memory.
        repeat_request: The bit by which the master asks for the last mailbox message again.
        written: The buffer completely written by the master since the device last looked; None without one.
        was_read: Whether the master has read a whole buffer since the device last looked.
    """

    def __init__(self) -> None:
        self.setting = OFF
        self.repeat_request = self.is_locked = False
        self.reset()

    def reset(self) -> None:
        """Empty it, as after activation."""
        setting = self.setting
        self.end = setting.start + setting.length if setting.is_enabled else 0
        self.is_full = False
        self.written: bytes | None = None
        self.was_read = False
        self._work = bytearray(setting.length if setting.is_enabled else 0)
        self._newest: bytes | None = None
        self._reading: bytes | None = None
        self._is_writing = False
        self._buffer = 2
        self._interrupts = 0

    def configure(self, setting: SyncManagerSetting) -> bool:
        """Set new settings; return whether it was switched on or off, which empties it."""
        was = self.setting
        self.setting = setting
        if setting.is_enabled == was.is_enabled:
            return False
        self.reset()
        return True

    @property
    def status(self) -> int:
        """Status byte (0805h)."""
        if self.setting.is_mailbox:
            return self._interrupts | (MAILBOX_FULL if self.is_full else 0)
        return self._interrupts | (NOTHING_WRITTEN if self._newest is None else self._buffer << 4)

    # --- the master -------------------------------------------------------------------------------------------------
    def master_write(self, first: int, data: bytes | bytearray) -> bool:
        """Write bytes from offset `first` on; return whether it was allowed."""
        setting = self.setting
        if self.is_locked or not setting.is_written_by_master or (setting.is_mailbox and self.is_full):
            return False
        if first == 0:
            self._is_writing = True
        elif not self._is_writing:
            return False
        self._work[first : first + len(data)] = data
        if first + len(data) == setting.length:
            self._is_writing = False
            self.is_full = True
            self._publish(bytes(self._work))
            self.written = self._newest
            self._interrupts = INTERRUPT_WRITE
        return True

    def master_read(self, first: int, length: int) -> bytes | None:
        """Return bytes from offset `first` on; None if it is not allowed."""
        setting = self.setting
        if self.is_locked or setting.is_written_by_master or (setting.is_mailbox and not self.is_full):
            return None
        if first == 0:
            self._reading = self._newest
        if self._reading is None:
            return None
        data = self._reading[first : first + length]
        if first + length == setting.length:
            self._reading = None
            self.is_full = False
            self.was_read = True
            self._interrupts = INTERRUPT_READ
        return data

    # --- the device -------------------------------------------------------------------------------------------------
    def put(self, data: bytes) -> None:
        """Put `data`, padded with zeros, where the master reads; into a mailbox only if it is empty."""
        self._publish(data[: self.setting.length].ljust(self.setting.length, b"\0"))
        self.is_full = True
        self._interrupts = INTERRUPT_WRITE

    def take(self) -> bytes | None:
        """Return the bytes written by the master since the last call, None without; this empties a mailbox."""
        data, self.written = self.written, None
        if data is not None:
            self.is_full = False
            self._interrupts = INTERRUPT_READ
        return data

    def _publish(self, data: bytes) -> None:
        self._newest = data
        self._buffer = (self._buffer + 1) % 3
