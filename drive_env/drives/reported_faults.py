"""Faults reported by drives: by 603Fh, 1003h and emergencies, otherwise by 1001h and their status flags."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from drive_env import cia402
from drive_env.dictionary.aborts import NO_DATA, ObjectAccessError
from drive_env.dictionary.roles import Role
from drive_env.drives.fault_texts import FaultText, fault_text
from drive_env.firmware.common.protection import CUT, STOP

if TYPE_CHECKING:
    from drive_env.drives.emergency import EmergencyMessage
    from drive_env.drives.interface import Drives
    from drive_env.fieldbus.description import Description

ERROR_REGISTER, ERROR_HISTORY = 0x1001, 0x1003


class FaultReport(NamedTuple):
    """The fault of an axis, as far as its drive reports one.

    Attributes:
        axis: Its number.
        status: Statusword 6041h.
        register: Error register 1001h, of the whole node; None if the drive has none.
        source: The objects that name the causes; "" if there is no such object.
        causes: The possible causes: one, or several that the drive does not distinguish. () without a fault.
    """

    axis: int
    status: int
    register: int | None
    source: str
    causes: tuple[FaultText, ...]

    @property
    def is_fault(self) -> bool:
        """Whether the axis is in fault, or on its way there (fault reaction active)."""
        return bool(cia402.matches(self.status, cia402.FAULT_BIT))


def read_faults(drives: Drives, known: Description) -> list[FaultReport]:
    """Read every axis' report of its fault; nothing is written.

    Args:
        drives: The drives.
        known: Their device's description.
    """
    status = drives.read(cia402.STATUSWORD)
    register = drives.read(ERROR_REGISTER) if known.has(ERROR_REGISTER) else None
    heard = drives.emergencies()
    reports = []
    for axis in range(drives.num_axes):
        of_node = None if register is None else int(register[axis])
        report = FaultReport(axis, int(status[axis]), of_node, "", ())
        if report.is_fault:
            source, names = _named(drives, known, axis, of_node, heard)
            texts = {text[1:]: text for text in map(fault_text, names)}  # several names may share one cause
            report = report._replace(source=source, causes=tuple(texts.values()))
        reports.append(report)
    return reports


def _named(
    drives: Drives, known: Description, axis: int, register: int | None, heard: list[EmergencyMessage]
) -> tuple[str, list[str]]:
    """Return the names of an axis' fault causes, and the source with the most of them."""
    if told := [message.name for message in heard if message.axis == axis and message.code]:
        return "EMCY", told
    if known.has(cia402.ERROR_CODE) and (code := int(drives.read(cia402.ERROR_CODE)[axis])):
        return f"603Fh = {code:04X}h", known.emergency_names(code)
    if known.has((ERROR_HISTORY, 1)) and (entry := _newest(drives, known, axis)):
        return f"1003h = {entry:08X}h", known.emergency_names(entry & 0xFFFF, entry >> 24 & 0x3F)
    return _deduced(drives, known, axis, register)


def _newest(drives: Drives, known: Description, axis: int) -> int:
    """Return the newest entry of 1003h for an axis; 0 if 1003h has no entry of it.

    A known device has the axis in bits 16 to 23; for other drives these bits are maker-specific (CiA 301).
    """
    count = int(drives.read((ERROR_HISTORY, 0))[axis])
    for sub in range(1, count + 1):
        if not known.has((ERROR_HISTORY, sub)):
            break
        try:
            entry = int(drives.read((ERROR_HISTORY, sub))[axis])
        except ObjectAccessError as error:
            if error.abort_code != NO_DATA:
                raise
            break
        if known.device is None or entry >> 16 & 0xFF == axis % known.num_axes:
            return entry
    return 0


def _deduced(drives: Drives, known: Description, axis: int, register: int | None) -> tuple[str, list[str]]:
    """Return the causes of a known device that fit 1001h and its status flags; [] for an unknown device."""
    if known.device is None or register is None:
        return "", []
    flags_key = known.role(Role.MOTOR_FLAGS)
    flags = 0 if flags_key is None else int(drives.read(Role.MOTOR_FLAGS)[axis])
    unused = known.device.canopen.quirks.unused_register_bits
    possible = [
        cause
        for cause in known.device.firmware.causes
        if cause.reaction in (CUT, STOP)
        and cause.error_register & ~unused & ~register == 0
        and (flags_key is None or cause.status_flag & ~flags == 0)
    ]
    flagged = [cause for cause in possible if flags_key is not None and cause.status_flag]
    source = f"1001h = {register:02X}h" + ("" if flags_key is None else f", {flags_key[0]:04X}h = {flags:X}h")
    return source, [cause.name for cause in flagged or possible]
