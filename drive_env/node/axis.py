"""One axis of emulated drives as the node of a fieldbus sees it: its objects, one integer at a time, its emergencies.

`LiveDictionary` works on all axes at once; a node needs a few values of one axis a thousand times a second, so each
object's place in the record is determined once here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from drive_env.devices import HIGHEST
from drive_env.dictionary.aborts import CANNOT_BE_STORED, ObjectAccessError
from drive_env.dictionary.access import check_allowed, check_limits
from drive_env.dictionary.codec import Code, decode_one, encode_one
from drive_env.dictionary.entries import Entry
from drive_env.dictionary.units import Context
from drive_env.emulator.live_dictionary import (
    MODE_OF_OPERATION,
    LiveDictionary,
    allowed_values,
    check_state,
    check_supported,
    refuse_same_mode,
)
from drive_env.emulator.prepared_record import SCALE_FIELD
from drive_env.firmware import cycle
from drive_env.firmware.common.protection import COMMUNICATION
from drive_env.firmware.record import EMERGENCY_QUEUE, LANES


class ObjectPort(NamedTuple):
    """Access to one object: its entry, its value, the check of a new value, the write of a checked one.

    `event` names the event of a write, as in a binding. `write_text` writes a text or a domain, each byte as a
    character; None if the object has no writable text. `fit` limits data beyond the object's range if the device
    accepts them; None for other objects.
    """

    entry: Entry
    read: Callable[[], int | str]
    check: Callable[[int], None]
    write: Callable[[int], None]
    event: str = ""
    write_text: Callable[[str], None] | None = None
    fit: Callable[[int], int] | None = None


class QueuedEmergency(NamedTuple):
    """An emergency that an axis queued: row of the firmware's causes, and the error register at that time."""

    row: int
    error_register: int


class Axis:
    """One axis.

    Args:
        objects: The dictionary of all axes.
        number: The axis' number among them.
    """

    def __init__(self, objects: LiveDictionary, number: int) -> None:
        self._objects = objects
        self._device = objects.device
        self.number = number
        self._block, self._lane = divmod(number, LANES)
        self._records = objects.records[self._block : self._block + 1]
        memory = self._records.view(np.uint8).reshape(-1)
        # Reading one element of a memoryview takes a third of the time of an array's.
        self._reals = memoryview(memory.view(np.float64))  # type: ignore[arg-type]
        self._integers = memoryview(memory.view(np.int32))  # type: ignore[arg-type]
        self._word = np.zeros(LANES, np.int64)
        self._here = np.arange(LANES) == self._lane
        self._count = self._place("emergency_count")[1]
        self._queue = [self._place("emergency", k)[1] for k in range(EMERGENCY_QUEUE)]
        self._fsa = self._place("fsa")[1]
        self._fresh, self._whole = (self._place(name)[1] for name in ("set_point_fresh", "target_is_whole"))
        self._scaler = self._place(SCALE_FIELD)[1]
        self._other_scales = {name: self._place(name)[1] for name in objects.other_scales}
        self._error_register = self._place("error_register")[1]
        self._ports: dict[tuple[int, int], ObjectPort] = {}
        self._texts: dict[tuple[int, int], str] = {}  # written texts, until the firmware restarts
        # Compiled now, with no axis selected: later a master would wait for its answer, and notice the silence.
        firmware = self._device.firmware
        firmware.write_events(self._records, cycle.MODE, self._word, np.zeros(LANES, bool))
        firmware.trip(self._records, self._lane, 0, firmware.communication_lost)

    @property
    def state(self) -> int:
        """The automaton's state, a number of `fsa.State`."""
        return self._integers[self._fsa]

    @property
    def error_register(self) -> int:
        """The axis' share of 1001h."""
        return self._integers[self._error_register]

    def port(self, entry: Entry) -> ObjectPort:
        """Return the port of an object; indices are those of axis 0."""
        key = (entry.index, entry.sub)
        if key not in self._ports:
            self._ports[key] = self._make_port(entry)
        return self._ports[key]

    def take_emergencies(self) -> list[QueuedEmergency]:
        """Return and forget the emergencies since the last call, oldest first."""
        count = self._integers[self._count]
        if count == 0:
            return []
        words = [self._integers[place] for place in self._queue[:count]]
        self._integers[self._count] = 0
        return [QueuedEmergency((word & 0xFF) - 1, word >> 8) for word in words]

    def store(self, values: Mapping[tuple[int, int], int]) -> None:
        """Set the values that a restart restores; only those of existing objects, limited to their range."""
        self._objects.store(self.number, values)

    def forget_texts(self) -> None:
        """Restore the dictionary's texts, as a restart does."""
        self._texts.clear()

    def trip(self, told: str = COMMUNICATION) -> bool:
        """Take the axis from operation enabled into fault because its network is lost; return whether it was there.

        Args:
            told: The condition that its node reports; 603Fh then shows its code.
        """
        firmware = self._device.firmware
        tripped = bool(firmware.trip(self._records, self._lane, 1, firmware.communication_lost))
        if tripped:
            row = self._device.emergencies.get(told)
            self._objects.network_codes[self.number] = 0 if row is None else row.code
        return tripped

    # --- inside ---------------------------------------------------------------------------------------------------
    def _place(self, field: str, part: int = 0) -> tuple[Any, int]:
        """Return the array of a field, and its index there."""
        real, place = self._device.firmware.layout.place(field, part)
        return self._reals if real else self._integers, place + self._lane

    def _make_port(self, entry: Entry) -> ObjectPort:
        code = self._objects.codes.get((entry.index, entry.sub))
        check = self._checker(entry)
        if entry.bits is None:
            return self._text_port(entry, check)
        fit = self._fit(entry)
        if code is None:
            write = self._scale_writer(entry) or self._unbound_writer(entry)
            return ObjectPort(entry, self._unbound_reader(entry), check, write, fit=fit)
        return ObjectPort(entry, self._reader(code), check, self._writer(entry, code), code.event, fit=fit)

    def _fit(self, entry: Entry) -> Callable[[int], int] | None:
        """Return the function that limits process data to the object's range; None if the device has no such rule."""
        rule, highest = self._device.beyond_range.get((entry.index, entry.sub)), entry.high
        if rule is None or highest is None:
            return None
        return (lambda raw: min(raw, highest)) if rule == HIGHEST else (lambda raw: raw & highest)

    def _checker(self, entry: Entry) -> Callable[[int], None]:
        device, key = self._device, (entry.index, entry.sub)
        allowed = allowed_values(device, entry)
        known = None if allowed is None else frozenset(allowed)
        has_state = key in device.write_states
        keeps_mode = key == MODE_OF_OPERATION and device.refuses_same_mode
        mode, mode_place = self._place("mode")

        def check(raw: int) -> None:
            check_limits(entry, raw)
            check_supported(device, entry)
            if known is not None and raw not in known:
                check_allowed(entry, np.array([raw]), allowed or ())
            if has_state:
                check_state(device, entry, self.state)
            if keeps_mode and raw == mode[mode_place]:
                refuse_same_mode(entry, raw)

        return check

    def _text_port(self, entry: Entry, check: Callable[[int], None]) -> ObjectPort:
        key, texts, dictionary = (entry.index, entry.sub), self._texts, self._unbound_reader(entry)

        def read() -> int | str:
            return texts[key] if key in texts else dictionary()

        return ObjectPort(entry, read, check, self._unbound_writer(entry), "", lambda text: texts.update({key: text}))

    def _unbound_reader(self, entry: Entry) -> Callable[[], int | str]:
        objects, number = self._objects, self.number
        if (entry.index, entry.sub) in self._device.parts:
            return self._part_reader(entry)

        def read() -> int | str:
            values = objects.unbound(entry)
            return values if isinstance(values, str) else int(values[number])

        return read

    def _part_reader(self, entry: Entry) -> Callable[[], int | str]:
        """Return a reader of an object that shows a part of another one (`parts` of the device)."""
        part, within = self._device.parts[entry.index, entry.sub], self.number % self._device.num_axes
        source = self.number if part.axis is None else self.number - within + part.axis
        if source >= self._objects.num_axes or (part.axis or 0) >= self._device.num_axes:
            return lambda: entry.default  # for an axis that does not exist
        axis = self if source == self.number else Axis(self._objects, source)
        whole = axis.port(self._objects.entries.find(part.source(within)))
        return lambda: int(part.shown(whole.read()))

    def _unbound_writer(self, entry: Entry) -> Callable[[int], None]:
        objects, number = self._objects, self.number
        if (entry.index, entry.sub) in {*self._device.parts, *self._device.shared_values}:
            read = self._unbound_reader(entry)

            def write_if_new(raw: int) -> None:  # an image brings the same value in each cycle
                if raw != read():
                    objects.write_checked(entry, raw, number)

            return write_if_new

        def write(raw: int) -> None:
            values = objects.unbound(entry)
            if isinstance(values, str):
                raise ObjectAccessError(CANNOT_BE_STORED, f"{entry.label} is a text that cannot be written")
            values[number] = raw

        return write

    def _factor(self, code: Code) -> float:
        device = self._device
        others = {name: self._reals[place] for name, place in self._other_scales.items()}
        lsb = device.current_full_scale / 32768.0
        context = Context(self._reals[self._scaler], lsb, rated_current=device.rated_current, **others)
        return float(code.factor(context))

    def _factor_now(self, code: Code) -> Callable[[], float]:
        """Return a function that returns a code's present factor; the scales that it depends on seldom change."""
        if not code.follows_scale:
            fixed = self._factor(code)
            return lambda: fixed
        reals, places = self._reals, (self._scaler, *self._other_scales.values())
        known: Sequence[float] = ()
        factor = self._factor(code)

        def now() -> float:
            nonlocal known, factor
            scales = [reals[place] for place in places]
            if scales != known:
                known, factor = scales, self._factor(code)
            return factor

        return now

    def _reader(self, code: Code) -> Callable[[], int]:
        memory, place = self._place(code.field, code.part)
        low, high = code.low, code.high
        if memory is self._integers and code.unit == "raw":
            return lambda: min(max(memory[place], low), high)
        factor = self._factor_now(code)
        return lambda: encode_one(code, memory[place], factor())

    def _writer(self, entry: Entry, code: Code) -> Callable[[int], None]:
        memory, place = self._place(code.field, code.part)
        if (rescale := self._scale_writer(entry)) is not None:
            return rescale
        if code.event in ("controlword", "mode"):
            kind = cycle.CONTROLWORD if code.event == "controlword" else cycle.MODE
            return lambda raw: self._write_event(kind, raw)
        if memory is self._integers:
            assert code.unit == "raw", "whole numbers of the record are bound as they are"
            return lambda raw: memory.__setitem__(place, raw)
        factor = self._factor_now(code)
        fresh, is_whole = code.event in ("set_point", "whole_set_point"), int(code.event == "whole_set_point")
        is_target = fresh and code.field == "target_position"

        def write(raw: int) -> None:
            memory[place] = decode_one(code, raw, factor())
            if fresh:
                self._integers[self._fresh] = 1
            if is_target:
                self._integers[self._whole] = is_whole

        return write

    def _scale_writer(self, entry: Entry) -> Callable[[int], None] | None:
        """Return the writer of an object of the position scale, which many others depend on; None for other objects."""
        if (entry.index, entry.sub) not in self._objects.scale_keys:
            return None
        return lambda raw: self._objects.write_checked(entry, raw, self.number)

    def _write_event(self, kind: int, raw: int) -> None:
        self._word[self._lane] = raw
        self._device.firmware.write_events(self._records, kind, self._word, self._here)
