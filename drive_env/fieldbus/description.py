"""Description of a device for the master: its dictionary, data types, axes, time-outs and emergencies.

A known device has its own; any other CiA 402 drive is described by its EDS and CiA's defaults.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from canopen.objectdictionary import ODVariable, datatypes

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.devices import AxisOffset, Device, MasterHints, find_device
from drive_env.dictionary.aborts import WRONG_TYPE, ObjectAccessError
from drive_env.dictionary.drive_eds import axes_of, read_types
from drive_env.dictionary.entries import Entry, ObjectDictionary, ObjectName, written_objects
from drive_env.dictionary.roles import VL_FACTORS, Role

CYCLE = 0.001  # default communication cycle [s]

# CiA 402-2: the profile objects of the next axis are 800h higher; if a device shifts more objects, its data say so.
CIA_402_OFFSETS = (AxisOffset(cia402.PROFILE_AREAS.start, cia402.SINGLE_DEVICE_TYPE, cia402.AXIS_OFFSET),)

# Upper bytes of emergency codes of the node itself (CiA 301, table 26): software, and communication.
NODE_CODES = (range(0x60, 0x70), range(0x80, 0x83))

# Communication emergencies of CiA 301 (table 26 of version 4.2), for codes without a row in the device's own table.
EMERGENCY_NAMES = {
    0x0000: "error_reset",
    0x8110: "can_overrun",
    0x8120: "can_error_passive",
    0x8130: "heartbeat_lost",
    0x8140: "bus_off_recovered",
    0x8210: "pdo_too_short",
    0x8220: "pdo_too_long",
    0x6320: "pdo_data_refused",
}


# For a drive known only by its EDS. CiA 301: 0 to 240 wait for the next SYNC, and every device with synchronous RPDOs
# accepts 1. CiA 402: maximum current 6073h, in the thousandths of 6077h. Saving and restoring erase flash, for which
# users of python-canopen report up to seconds.
MODE, MODE_DISPLAY = (cia402.MODE, 0), (cia402.MODE_DISPLAY, 0)
LONGEST_TIMEOUT = 3600.0  # s: no drive takes so long, and an operating system refuses a wait of 1e300 s
CIA_402 = MasterHints(rpdo_type=1, timeout=0.5, timeouts={0x1010: 10.0, 0x1011: 10.0})
CIA_402_ROLES = {Role.CURRENT_LIMIT: (cia402.MAX_CURRENT, 0)}


@dataclass
class Description:
    """A kind of device on the bus.

    Attributes:
        name: Name of the device, or of its EDS.
        dictionary: Its entries, those of axis 0 if it has several axes.
        num_axes: Axes of one node.
        device: The known device; None if only the EDS is known.
        hints: Further facts that a master needs.
        timeouts: The user's time-outs of single objects [s].
        timeout: The user's time-out of all others [s]; None: the device's.
        cycle: Time between two SYNCs [s].
        cycles_per_sync: Communication cycles of the drives in it.
    """

    name: str
    dictionary: ObjectDictionary
    num_axes: int
    device: Device | None
    hints: MasterHints
    timeout: float | None = None
    timeouts: dict[Key, float] = field(default_factory=dict)
    cycle: float = CYCLE
    cycles_per_sync: int = 1
    _types: dict[Key, ODVariable] = field(default_factory=dict)

    @property
    def answer_timeout(self) -> float:
        """Longest time to an answer, unless the object is known to be slow [s]."""
        return self.hints.timeout if self.timeout is None else self.timeout

    def key(self, entry: Entry, axis: int) -> Key:
        """Return index and sub-index of an entry for an axis of the node."""
        offsets = CIA_402_OFFSETS if self.device is None else self.device.axis_offsets
        for offset in offsets:
            if offset.first <= entry.index <= offset.last:
                return entry.index + axis * offset.step, entry.sub
        return entry.index, entry.sub

    def of_further_axes(self) -> dict[Key, tuple[Entry, int]]:
        """Return the listed objects of further axes: key -> entry of the first axis, and the axis."""
        found: dict[Key, tuple[Entry, int]] = {}
        for entry in self.dictionary:
            for axis in range(1, self.num_axes):
                key = self.key(entry, axis)
                if key != (entry.index, entry.sub) and self.has(key) and (entry.index, entry.sub) not in found:
                    found.setdefault(key, (entry, axis))
        return found

    def shown_by(self, entry: Entry) -> Entry:
        """Return the readable entry of another one: 6061h for a 6060h that is write-only (CiA 402)."""
        if entry.access == "wo" and (entry.index, entry.sub) == MODE and self.has(MODE_DISPLAY):
            return self.dictionary.find(MODE_DISPLAY)
        return entry

    def label(self, entry: Entry, axis: int) -> str:
        """Return the name of an axis' object in messages."""
        index, sub = self.key(entry, axis)
        return f"{index:04X}h:{sub:02X} {entry.name}"

    def patience(self, entry: Entry) -> float:
        """Return the longest time to an answer about this object [s]."""
        own, usual = self.timeouts.get((entry.index, entry.sub)), self.answer_timeout
        return own if own is not None else max(usual, self.hints.timeouts.get(entry.index, usual))

    def encode(self, entry: Entry, value: int | str) -> bytes:
        """Return the bytes of a value."""
        if isinstance(value, str):
            return value.encode("utf-8")
        return int(value).to_bytes(self.size(entry), "little", signed=value < 0)

    def decode(self, entry: Entry, data: bytes) -> Any:
        """Return the integer, float or text of an object's bytes.

        Surplus bytes of an answer are ignored; too few raise ObjectAccessError.
        """
        kind = self._types[entry.index, entry.sub].data_type
        if kind in datatypes.INTEGER_TYPES or kind == datatypes.BOOLEAN:
            size = self.size(entry)
            if len(data) < size:
                raise ObjectAccessError(
                    WRONG_TYPE, f"{entry.label} has {size} bytes by the EDS, and {len(data)} came: {data.hex(' ')}"
                )
            return int.from_bytes(data[:size], "little", signed=entry.signed)
        if kind in datatypes.FLOAT_TYPES:
            return self._types[entry.index, entry.sub].decode_raw(data)
        if kind == datatypes.VISIBLE_STRING:
            return data.decode("utf-8", "replace").rstrip("\0")
        return data.hex(" ")

    def is_number(self, entry: Entry) -> bool:
        """Return whether an object is an integer."""
        kind = self._types[entry.index, entry.sub].data_type
        return kind in datatypes.INTEGER_TYPES or kind == datatypes.BOOLEAN

    def size(self, entry: Entry) -> int:
        """Return the number of bytes of an integer object."""
        return max(1, len(self._types[entry.index, entry.sub]) // 8)

    def axes_of_emergency(self, name: str, axis: int) -> Sequence[int]:
        """Return the axes of its node that an emergency concerns: the one that it names, or all that it stopped."""
        if self.device is None or not self.device.is_of_module(name):
            return (axis,)
        code = self.device.emergencies[name].code
        return (axis,) if any(code >> 8 in group for group in NODE_CODES) else range(self.num_axes)

    def emergency(self, code: int, extra: tuple[int, ...]) -> tuple[str, int]:
        """Return the name of an emergency and the axis of its node that sent it.

        The name is that in the device's table or in CiA 301's, otherwise the code; the axis is 0 if the emergency does
        not name it.
        """
        rows = {} if self.device is None else self.device.emergencies
        for name, row in rows.items():
            axis = row.axis_told(extra, self.num_axes) if row.code == code else None
            if axis is not None:
                return name, axis
        same_code = [name for name, row in rows.items() if row.code == code]
        if len(same_code) == 1:
            return same_code[0], 0
        return _cia_301_name(code), 0

    def emergency_names(self, code: int, number: int | None = None) -> list[str]:
        """Return the possible names of an error code, as in 603Fh and 1003h.

        Args:
            code: The emergency's code.
            number: The device's own number of the error, which some devices have in 1003h; None if unknown.
        """
        has_number = number is not None and self.device is not None and self.device.canopen.quirks.history_tells_number
        rows = {} if self.device is None else self.device.emergencies
        found = [
            name for name, row in rows.items() if row.code == code and (not has_number or row.extra[0] & 0x3F == number)
        ]
        return found or [_cia_301_name(code)]

    def role(self, role: Role) -> Key | None:
        """Return the object with a role, None if this drive lacks it."""
        return self.dictionary.roles.get(role)

    def has(self, name: ObjectName) -> bool:
        """Return whether the dictionary has an object."""
        return self.dictionary.has(name)


def _cia_301_name(code: int) -> str:
    """Return the name of a code in CiA 301, or the code itself."""
    return EMERGENCY_NAMES.get(code, f"emergency_{code:04X}h")


def describe(device: str | None, eds: str | Path | None, on_ethercat: bool = False) -> Description:
    """Return the description of a known device by name, or of any other by its EDS.

    Args:
        device: The name.
        eds: The EDS instead of it.
        on_ethercat: Whether objects are writable that the EDS of a known device, made for CAN, lists as read-only.

    Raises:
        ValueError: For an unknown name, or a file that is not an EDS of a drive.
    """
    if eds is None:
        if device is None:
            raise ValueError("give the name of a device, or the EDS of the drive")
        known = find_device(device)
        dictionary = known.new_dictionary()
        if on_ethercat and known.ethercat is not None:
            dictionary = dictionary.including(written_objects(known.eds, known.ethercat.writable).values())
        return Description(
            known.name, dictionary, known.num_axes, known, known.master, cycle=known.cycle, _types=read_types(known.eds)
        )
    path = Path(eds)
    if not path.is_file():
        raise ValueError(f"there is no EDS at {path}; give the path of the drive's .eds file")
    try:
        dictionary, types = ObjectDictionary(path, roles=CIA_402_ROLES), read_types(path)
    except Exception as error:  # the reader raises any exception for a broken line
        raise ValueError(f"{path} cannot be read as an EDS: {error}; see whether CiA 306 allows that line") from error
    axes = axes_of(path, types)
    dictionary.roles |= {role: key for role, key in VL_FACTORS.items() if dictionary.has(key)}
    return Description(path.stem, dictionary, axes, None, CIA_402, _types=types)


def check_timeout(timeout: float) -> float:
    """Return a time-out [s]; ValueError unless it is above 0 s and finite."""
    if not 0.0 < timeout <= LONGEST_TIMEOUT:
        raise ValueError(f"a time-out of {timeout:g} s is impossible; give one above 0 s, e.g. 0.5, up to an hour")
    return timeout
