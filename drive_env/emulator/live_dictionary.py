"""The live object dictionary of emulated drives: its values are the fields of their records.

Reading and writing check type, access, range and state exactly as the bus does; the error carries the SDO abort code.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drive_env import cia402
from drive_env.cia402 import Key, State
from drive_env.devices import Device
from drive_env.dictionary import units
from drive_env.dictionary.aborts import CANNOT_BE_STORED, WRONG_STATE, ObjectAccessError
from drive_env.dictionary.access import check_allowed, check_in_range, check_readable, check_writable, checked_values
from drive_env.dictionary.bindings import Binding
from drive_env.dictionary.codec import Code, code_of, decode, encode
from drive_env.dictionary.entries import Entry, ObjectDictionary, ObjectName
from drive_env.dictionary.position_scale import PositionScale, position_scale, set_point_ratio, velocity_ratio
from drive_env.dictionary.roles import Role
from drive_env.emulator.group import Channels, channels
from drive_env.emulator.prepared_record import (
    NOMINAL_FIELD,
    PEAK_FIELD,
    PROFILE_FIELD,
    RATIO_FIELD,
    SCALE_FIELD,
    SCALES,
    SET_POINT_FIELD,
    PreparedObject,
    PreparedRecord,
)
from drive_env.emulator.record_snapshot import RecordSnapshot
from drive_env.firmware import cycle
from drive_env.firmware.common.modes import MODES
from drive_env.firmware.record import get_lanes, set_lanes
from mechanics.arrays import Floats, Integers, Mask

_EVENTS = {"": -1, "controlword": cycle.CONTROLWORD, "mode": cycle.MODE, "set_point": cycle.SET_POINT,
           "whole_set_point": cycle.WHOLE_SET_POINT}  # fmt: skip
NOTHING = Channels(np.empty(0, np.int64), np.empty(0, np.int64))
MODE_OF_OPERATION, MODE_DISPLAY = (cia402.MODE, 0), (cia402.MODE_DISPLAY, 0)
ERROR_CODE = (cia402.ERROR_CODE, 0)
FAULT_FIELD = "fault"  # row of the cause that holds an axis in fault, plus 1


class LiveDictionary:
    """Objects of all axes.

    Args:
        device: The device.
        records: The axes' records.
        num_axes: Number of axes.
        preset: Object name -> raw value, written after the factory values; a restart restores both. The records have
            them from the first restart on.
    """

    def __init__(
        self, device: Device, records: NDArray[np.void], num_axes: int, preset: Mapping[ObjectName, int]
    ) -> None:
        self.device = device
        self.entries: ObjectDictionary = device.new_dictionary()
        found = {
            SCALE_FIELD: position_scale(device.roles),
            RATIO_FIELD: velocity_ratio(device.roles),
            SET_POINT_FIELD: set_point_ratio(device.roles),
        }
        # Fields of scales that are made of objects, if the device has them.
        self._scales: dict[str, PositionScale] = {name: scale for name, scale in found.items() if scale is not None}
        # Objects whose write changes the meaning of stored values.
        self.scale_keys = tuple(key for scale in self._scales.values() for key in scale.keys)
        self._single_scales = {
            field: device.roles[role]
            for field, role in (
                (PEAK_FIELD, Role.PEAK_CURRENT),
                (NOMINAL_FIELD, Role.NOMINAL_CURRENT),
                (PROFILE_FIELD, Role.PROFILE_BITS),
            )
            if role in device.roles
        }
        self.scale_keys += tuple(self._single_scales.values())
        # Further fields, besides that of positions, on which factors of this device's units depend.
        self.other_scales = tuple(name for name in (*self._scales, *self._single_scales) if name != SCALE_FIELD)
        self._position_keys = self._scales[SCALE_FIELD].keys if SCALE_FIELD in self._scales else ()
        self.codes = {key: code_of(self.entries.find(key), binding) for key, binding in device.bindings.items()}
        self._layout = device.firmware.layout
        self._parameters = frozenset(field.name for field in self._layout.parameters)
        self._records = records
        self.num_axes = num_axes
        self._scale_changes = 0
        self._snapshot: RecordSnapshot | None = None  # of the values that a restart restores
        self._values: dict[tuple[int, int], Integers | str] = {}
        # Condition reported by an axis' node when its network took it into fault, 0: nothing; for 603Fh.
        self.network_codes: Integers = np.zeros(self.num_axes, np.int64)
        self._stored = self._commission(preset)

    def read(self, name: ObjectName) -> Integers:
        """Return an object of every axis, int64 of shape (num_axes,); a text as an array of str."""
        if name is Role.POSITION_SCALE and len(self._position_keys) > 1:  # no single object has it: several form it
            return np.asarray(np.rint(self.context().position_scaler), np.int64)
        entry = self.entries.find(name)
        if entry.access == "wo" and (entry.index, entry.sub) == MODE_OF_OPERATION and self.entries.has(MODE_DISPLAY):
            entry = self.entries.find(MODE_DISPLAY)  # shows the mode (CiA 402)
        check_readable(entry)
        return self._read(entry)

    def write(self, name: ObjectName, value: ArrayLike, where: Mask) -> None:
        """Write an object of the axes where the mask is true; everything is checked before anything changes."""
        entry = self.entries.find(name)
        check_writable(entry)
        raw = checked_values(entry, value, self.num_axes)
        self._check(entry, raw, where)
        self._write(entry, raw, where)

    def impose(self, name: ObjectName, raw: ArrayLike) -> None:
        """Set a read-only object that the firmware does not compute, e.g. an input; the value's range is checked."""
        entry = self.entries.find(name)
        self._set_value(entry, checked_values(entry, raw, self.num_axes), np.ones(self.num_axes, bool))

    def engrave(self, name: ObjectName, raw: ArrayLike, where: Mask | None = None) -> None:
        """Set a read-only object permanently, e.g. a serial number, for the axes where the mask is true.

        Its range is checked.
        """
        entry = self.entries.find(name)
        values = checked_values(entry, raw, self.num_axes)
        axes = np.ones(self.num_axes, bool) if where is None else where
        self._set_value(entry, values, axes)
        key = (entry.index, entry.sub)
        self._stored[key] = np.where(axes, values, self._stored[key])

    def restart(self, axes: Mask) -> None:
        """Restore the stored values of the axes where the mask is true, and start their firmware anew."""
        before = self.context()
        if self._snapshot is None:
            self._snapshot = self._stored_snapshot()
        self._snapshot.restore(axes)
        for key, raw in self._stored.items():
            values = self._values.get(key)
            if isinstance(values, np.ndarray):
                np.copyto(values, raw, where=axes)
        self._count_scale_change(before)
        self.device.firmware.power_on(self._records, axes)

    def save_state(self) -> dict[str, Any]:
        """Return records, other values and stored values, as plain data."""
        return {
            "records": self._records.view(np.uint8).copy(),
            "values": {key: value.copy() for key, value in self._values.items() if isinstance(value, np.ndarray)},
            "stored": {key: raw.copy() for key, raw in self._stored.items()},
            "network_codes": self.network_codes.copy(),
        }

    def restore_state(self, state: Mapping[str, Any]) -> None:
        """Restore records and values of as many axes of the same device to a state of `save_state`."""
        before = self.context()
        self._records.view(np.uint8)[...] = state["records"]
        self._count_scale_change(before)
        self._values |= {key: value.copy() for key, value in state["values"].items()}
        self.network_codes = state["network_codes"].copy()
        if any(not np.array_equal(self._stored[key], raw) for key, raw in state["stored"].items()):
            self._stored = {key: raw.copy() for key, raw in state["stored"].items()}
            self._snapshot = None

    def _count_scale_change(self, before: units.Context) -> None:
        # The peak current of a drive that does not need it is nan, and stays unchanged.
        after = self.context()
        if not all(np.array_equal(one, other, equal_nan=True) for one, other in zip(before, after, strict=True)):
            self._scale_changes += 1

    @property
    def records(self) -> NDArray[np.void]:
        """The axes' records."""
        return self._records

    def unbound(self, entry: Entry) -> Integers | str:
        """Return the values of an object that is not a field of the record, one per axis, not copied; or its text."""
        if self._is_error_code(entry):
            return self._error_codes(np.asarray(get_lanes(self._records, FAULT_FIELD, self.num_axes), np.int64))
        return self._values[entry.index, entry.sub]

    def stored(self, axis: int) -> dict[tuple[int, int], int]:
        """Return the values that a restart restores on one axis."""
        return {key: int(raw[axis if len(raw) > 1 else 0]) for key, raw in self._stored.items()}

    def store(self, axis: int, values: Mapping[tuple[int, int], int]) -> None:
        """Set the values that a restart restores on one axis: those of existing objects, limited to their range."""
        for key, raw in values.items():
            if len(self._stored[key]) < self.num_axes:
                self._stored[key] = np.repeat(self._stored[key], self.num_axes)
            self._stored[key][axis] = raw
        self._snapshot = None

    def part(self, entry: Entry, read: Callable[[Key], Integers] | None = None) -> Integers:
        """Return an object that shows part of another, whose values `read` returns, axes last (default: present ones).

        An axis that the node lacks shows the dictionary's default.
        """
        part = self.device.parts[entry.index, entry.sub]
        read = read or (lambda key: self._read(self.entries.find(key)))
        number = np.arange(self.num_axes)
        within = number % self.device.num_axes
        source = number if part.axis is None else number - within + part.axis
        there = (source < self.num_axes) & ((part.axis or 0) < self.device.num_axes)
        values: Integers = np.stack([read(key) for key in part.of])
        which = within % len(part.of)
        shown = part.shown(values[which, ..., np.where(there, source, 0)]).T
        assert isinstance(entry.default, int), "parts are numbers"
        return np.asarray(np.where(there, shown, entry.default), np.int64)

    def write_checked(self, entry: Entry, raw: int, axis: int) -> None:
        """Write an already checked value to an object of one axis."""
        where = np.zeros(self.num_axes, bool)
        where[axis] = True
        self._write(entry, np.full(self.num_axes, raw, np.int64), where)

    @property
    def scale_changes(self) -> int:
        """Number of writes of the position scale, on any axis."""
        return self._scale_changes

    def prepared_record(self, sampled: Sequence[ObjectName], played: Sequence[ObjectName]) -> PreparedRecord | None:
        """Return the prepared form of a repeated call of `record`; None if an object cannot be prepared.

        The call was made before, so all checks except those of values have passed.
        """
        entries = [self.entries.find(name) for name in sampled]
        inputs = [self.entries.find(name) for name in played]
        for entry in entries + inputs:
            if not self._is_bound(entry):
                return None
        if any(allowed_values(self.device, entry) is not None for entry in inputs):
            return None
        outputs = list({(entry.index, entry.sub): entry for entry in entries}.values())
        rows, sources = [self._row(entry) for entry in outputs], [self._row(entry) for entry in inputs]
        if any(row.code.field in SCALES for row in sources):
            return None
        into = channels(
            self._layout,
            [(row.code.field, row.code.part) for row in sources],
            [_EVENTS[row.code.event] for row in sources],
        )
        out_of = channels(self._layout, [(row.code.field, row.code.part) for row in rows])
        return PreparedRecord((into, sources), (out_of, rows), self._scale_changes)

    def _row(self, entry: Entry) -> PreparedObject:
        key = (entry.index, entry.sub)
        code = self.codes[key]
        return PreparedObject(
            key, code, np.array(np.broadcast_to(code.factor(self.context()), (self.num_axes,)), float)
        )

    def recordable(self, entry: Entry) -> Code | None:
        """Return the conversion of an object whose value changes by itself; None for one that only writes change."""
        check_readable(entry)
        key = (entry.index, entry.sub)
        if key in self.device.parts:
            key = self.device.parts[key].of[0]
        if self._is_error_code(entry):
            return code_of(entry, Binding(*key, FAULT_FIELD))
        return self.codes.get(key)

    def recorded(self, entry: Entry, code: Code, values: Floats) -> Integers:
        """Return an object's integers of recorded SI values, by the conversion from `recordable`; axes last."""
        raw = self.to_od(code, values)
        if self._is_error_code(entry):
            return self._error_codes(raw)
        return self.part(entry, lambda _: raw) if (entry.index, entry.sub) in self.device.parts else raw

    def plan_play(self, play: Mapping[ObjectName, ArrayLike], cycles: int) -> tuple[Floats, Channels]:
        """Return SI values, shape (cycles, objects, num_axes), and the fields that they go to.

        Raises:
            ObjectAccessError: For an object that cannot be played, or an impossible value.
            ValueError: For rows of a wrong shape.
        """
        values = np.empty((cycles, len(play), self.num_axes))
        fields: list[tuple[str, int]] = []
        kinds: list[int] = []
        for k, (name, given) in enumerate(play.items()):
            entry = self.entries.find(name)
            check_writable(entry)
            if not self._is_bound(entry) or (entry.index, entry.sub) in self.scale_keys:
                raise ObjectAccessError(CANNOT_BE_STORED, f"{entry.label} cannot be played; write it before")
            raw = np.asarray(given)
            if raw.shape not in ((cycles,), (cycles, self.num_axes)):
                raise ValueError(
                    f"{entry.label}: play takes shape ({cycles},) or ({cycles}, {self.num_axes}), one row per cycle, "
                    f"not {raw.shape}"
                )
            check_in_range(entry, raw)
            self._check_value(entry, raw.astype(np.int64).reshape(-1))
            code = self.codes[entry.index, entry.sub]
            values[:, k] = self._from_od(code, raw if raw.ndim == 2 else raw[:, None])
            fields.append((code.field, code.part))
            kinds.append(_EVENTS[code.event])
        return values, channels(self._layout, fields, kinds) if fields else NOTHING

    # --- inside ---------------------------------------------------------------------------------------------------
    def _commission(self, preset: Mapping[ObjectName, int]) -> dict[tuple[int, int], Integers]:
        """Return the raw values that a restart restores, factory values and preset; one for all axes each."""
        numbers: list[Entry] = []
        for entry in self.entries:
            if isinstance(entry.default, str):
                self._values[entry.index, entry.sub] = entry.default
            else:
                numbers.append(entry)
        # Hundreds of objects in one array: one by one they would take most of the time of construction.
        factory = np.array([entry.default for entry in numbers], np.int64)
        stored: dict[tuple[int, int], Integers] = {
            (entry.index, entry.sub): factory[k : k + 1] for k, entry in enumerate(numbers)
        }
        for entry in numbers:
            for offset in self.device.axis_offsets:
                if offset.first <= entry.index <= offset.last:
                    stored[entry.index, entry.sub] = self._defaults(entry, offset.step)
        taken = allowed_values(self.device, self.entries.find(MODE_OF_OPERATION)) or ()
        modes = sum(
            1 << mode.supported_bit for mode in MODES if mode.supported_bit is not None and mode.number in taken
        )
        if self.entries.has(cia402.SUPPORTED_MODES):
            stored[cia402.SUPPORTED_MODES, 0] = np.array([modes], np.int64)
        for name, value in preset.items():
            entry = self.entries.find(name)
            raw = checked_values(entry, value, 1)
            self._check_value(entry, raw)
            stored[entry.index, entry.sub] = raw.copy()
            axis, base = self.device.locate(entry.index)
            if axis and (base, entry.sub) in stored:  # say, only of the second axis of each drive
                values_of_axes = np.resize(stored[base, entry.sub], self.num_axes)
                values_of_axes[axis :: self.device.num_axes] = raw
                stored[base, entry.sub] = values_of_axes
        unbound = [key for key in stored if key not in self.codes]
        values = np.zeros((len(unbound), self.num_axes), np.int64)
        for row, key in zip(values, unbound, strict=True):
            row[:] = stored[key]
        self._values |= zip(unbound, values, strict=True)
        return stored

    def _defaults(self, entry: Entry, step: int) -> Integers:
        """Return an axis object's factory value: one for all axes, or one per axis if those of a node differ."""
        keys = [(entry.index + k * step, entry.sub) for k in range(self.device.num_axes)]
        found = [self.entries.find(key).default if self.entries.has(key) else entry.default for key in keys]
        if len(set(found)) == 1:
            return np.array(found[:1], np.int64)
        return np.resize(np.array(found, np.int64), self.num_axes)

    def _stored_snapshot(self) -> RecordSnapshot:
        """Return the fields that a restart sets from stored values, converted by the stored scales.

        Fields computed by the firmware are left out; read-only parameters are included. Objects that only show a field
        are ignored.
        """
        length = max(map(len, self._stored.values()))
        context = self.context()
        made: dict[str, Any] = {
            name: scale.increments([self._stored[key].astype(float) for key in scale.keys])
            for name, scale in self._scales.items()
        }
        context = context._replace(**made)
        for name, key in self._single_scales.items():
            of_axes: dict[str, Any] = {name: self._from_od(self.codes[key], self._stored[key], context)}
            context = context._replace(**of_axes)
        known = [key for key in self._stored if key in self.codes and not self.device.bindings[key].shows]
        set_by = {key for key in known if self.entries.find(key).access not in ("ro", "const")}
        places = {(self.codes[key].field, self.codes[key].part) for key in set_by}
        bound = [
            key
            for key in known
            if key in set_by
            or (
                self.codes[key].field in self._parameters
                and (self.codes[key].field, self.codes[key].part) not in places
            )
        ]
        values = [self._from_od(self.codes[key], self._stored[key], context) for key in bound]
        fields = [(self.codes[key].field, self.codes[key].part) for key in bound]
        for name, scale in made.items():
            if (name, 0) not in fields:
                values.append(scale)
                fields.append((name, 0))
        return RecordSnapshot(
            self._layout, self._records, fields, np.array([np.broadcast_to(value, (length,)) for value in values])
        )

    def _is_bound(self, entry: Entry) -> bool:
        return (entry.index, entry.sub) in self.codes

    def context(self) -> units.Context:
        """Return the present values that units' factors depend on, one per axis."""
        of_axes: dict[str, Any] = {name: self._scale_field(name) for name in (SCALE_FIELD, *self.other_scales)}
        return units.Context(
            **of_axes, current_lsb=self.device.current_full_scale / 32768.0, rated_current=self.device.rated_current
        )

    def _scale_field(self, name: str) -> Floats:
        return get_lanes(self._records, name, self.num_axes).astype(float)

    def _read(self, entry: Entry) -> Integers:
        if self._is_bound(entry):
            code = self.codes[entry.index, entry.sub]
            return self.to_od(code, get_lanes(self._records, code.field, self.num_axes, code.part).astype(float))
        if (entry.index, entry.sub) in self.device.parts:
            return self.part(entry)
        if self._is_error_code(entry):
            return self._error_codes(np.asarray(get_lanes(self._records, FAULT_FIELD, self.num_axes), np.int64))
        stored = self._values[entry.index, entry.sub]
        return np.full(self.num_axes, stored) if isinstance(stored, str) else stored.copy()

    def _is_error_code(self, entry: Entry) -> bool:
        return (entry.index, entry.sub) == ERROR_CODE and not self._is_bound(entry)

    def _error_codes(self, faults: Integers) -> Integers:
        """Return 603Fh: the emergency code of an axis' fault, 0 without a fault; axes last."""
        codes = np.zeros(faults.shape, np.int64)
        for row in np.unique(faults[faults > 0]):
            emergency = self.device.emergencies[self.device.firmware.causes[int(row) - 1].name]
            of_axis = np.full(self.num_axes, emergency.code)
            if row == self.device.firmware.communication_lost + 1:
                of_axis = np.where(self.network_codes > 0, self.network_codes, of_axis)
            codes = np.where(faults == row, of_axis, codes)
        return codes

    def to_od(self, code: Code, value: Floats) -> Integers:
        """Convert SI values to integers on the bus; axes are the last dimension."""
        return encode(code, value, code.factor(self.context()))

    def _from_od(self, code: Code, raw: NDArray[Any], context: units.Context | None = None) -> Floats:
        return decode(code, raw, code.factor(self.context() if context is None else context))

    def _check(self, entry: Entry, raw: Integers, where: Mask) -> None:
        self._check_value(entry, raw[where])
        key = (entry.index, entry.sub)
        if key in self.device.write_states:
            states = get_lanes(self._records, "fsa", self.num_axes)[where]
            for state in np.unique(states):
                check_state(self.device, entry, int(state))
        if key == MODE_OF_OPERATION and self.device.refuses_same_mode:
            same = raw[where] == get_lanes(self._records, "mode", self.num_axes)[where]
            if np.any(same):
                refuse_same_mode(entry, int(raw[where][same][0]))

    def _check_value(self, entry: Entry, raw: Integers) -> None:
        check_supported(self.device, entry)
        allowed = allowed_values(self.device, entry)
        if allowed is not None:
            check_allowed(entry, raw, allowed)

    def _write(self, entry: Entry, raw: Integers, where: Mask) -> None:
        key = (entry.index, entry.sub)
        if key in self.scale_keys:
            self._rescale(entry, raw, where)
            return
        if key in self.device.parts:
            part = self.device.parts[key]
            whole = self.entries.find(part.of[0])
            self._write(whole, part.put(self._read(whole), raw), where)
            return
        if not self._is_bound(entry):
            self._set_value(entry, raw, where)
            return
        event = _EVENTS[self.codes[key].event]
        if event in (cycle.SET_POINT, cycle.WHOLE_SET_POINT):
            self._set_field(entry, raw, where)
            set_lanes(self._records, "set_point_fresh", np.ones(self.num_axes, np.int32), where)
            if self.codes[key].field == "target_position":
                is_whole = np.full(self.num_axes, event == cycle.WHOLE_SET_POINT, np.int32)
                set_lanes(self._records, "target_is_whole", is_whole, where)
        elif event >= 0:
            # Copies: for read-only arrays, or arrays with gaps, the kernel would be compiled once more.
            self.device.firmware.write_events(self._records, event, np.array(raw, np.int64), np.array(where, bool))
        else:
            self._set_field(entry, raw, where)

    def _rescale(self, entry: Entry, raw: Integers, where: Mask) -> None:
        """Change a scale: stored values in units that follow it keep their integers, and change in SI."""
        before = self.context()
        kept = [
            (other, self._read(other), self.codes[other.index, other.sub])
            for other in self.entries
            if self._is_bound(other)
            and other.access not in ("ro", "const")
            and self.codes[other.index, other.sub].follows_scale
        ]
        if self._is_bound(entry):
            self._set_field(entry, raw, where)
        else:
            self._set_value(entry, raw, where)
        for name, scale in self._scales.items():
            made = scale.increments([self._read(self.entries.find(key)).astype(float) for key in scale.keys])
            set_lanes(self._records, name, made, where)
        self._scale_changes += 1
        after = self.context()
        for other, value, code in kept:
            if np.any(code.factor(before) != code.factor(after)):
                self._set_field(other, value, where)

    def _set_field(self, entry: Entry, raw: Integers, where: Mask) -> None:
        code = self.codes[entry.index, entry.sub]
        if code.field in SCALES:
            self._scale_changes += 1
        set_lanes(self._records, code.field, self._from_od(code, raw), where, code.part)

    def _set_value(self, entry: Entry, raw: Integers, where: Mask) -> None:
        key = (entry.index, entry.sub)
        if key in self.device.kept_bits:
            raw = raw & self.device.kept_bits[key]
        before = self._values.get(key)
        if key in self.device.shared_values:
            node = np.arange(self.num_axes) // self.device.num_axes
            for first in np.flatnonzero(where):
                raw = np.where(node == node[first], raw[first], raw)
            where = np.isin(node, node[where])
        self._values[key] = raw.copy() if before is None else np.where(where, raw, before)


# --- what the device allows, for all axes and for the one axis of a node ---------------------------------------------
def check_supported(device: Device, entry: Entry) -> None:
    """Raise 08000020h, with the reason, for an object whose write needs a missing service."""
    reason = device.unsupported.get((entry.index, entry.sub))
    if reason is not None:
        without = f"{entry.label} has no service behind it in this emulator"
        raise ObjectAccessError(CANNOT_BE_STORED, f"{without}: {reason}" if reason else without)


def allowed_values(device: Device, entry: Entry) -> tuple[int, ...] | None:
    """Return the allowed values of an object that has only a few, None if its whole range is allowed."""
    if (entry.index, entry.sub) == MODE_OF_OPERATION:
        known = device.allowed_values.get(MODE_OF_OPERATION)
        return tuple(mode.number for mode in MODES if known is None or mode.number in known)
    return device.allowed_values.get((entry.index, entry.sub))


def check_state(device: Device, entry: Entry, state: int) -> None:
    """Raise 08000022h for an object that cannot be written while the drive is in this state."""
    needed = State[device.write_states[entry.index, entry.sub]]
    if state != needed:
        raise ObjectAccessError(
            WRONG_STATE,
            f"{entry.label} can only be written in {_state_name(needed)}; the drive is in {_state_name(State(state))}",
        )


def refuse_same_mode(entry: Entry, mode: int) -> NoReturn:
    """Raise 08000022h: the axis has this mode already."""
    raise ObjectAccessError(
        WRONG_STATE, f"{entry.label} is {mode} already, and this drive refuses the same mode twice; read 6061h first"
    )


def _state_name(state: State) -> str:
    return state.name.lower().replace("_", " ")
