"""The state of every axis for display: mode, motion, faults, switches, temperatures."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite
from typing import TYPE_CHECKING, Any

from drive_env import cia402
from drive_env.cia402 import Key, State
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.dictionary.entries import Entry
from drive_env.dictionary.quantities import SHOWN, UNITS, Scale, find_unit, scales_of
from drive_env.dictionary.roles import Role
from drive_env.drives.emergency import EmergencyMessage
from drive_env.drives.fault_texts import FaultText, fault_text
from drive_env.drives.interface import Drives
from drive_env.drives.limit_at_rest import SAYS, LimitAtRest
from drive_env.studio.recorder import ScopeRecorder

if TYPE_CHECKING:
    from drive_env.fieldbus.description import Description

SLOW = 0.5  # s between two readings of slowly changing values
QUICK = 0.08  # s between two evaluations of sampled values
SAMPLED = (
    cia402.STATUSWORD, cia402.POSITION_ACTUAL, cia402.VELOCITY_ACTUAL, cia402.VL_VELOCITY_ACTUAL, cia402.TORQUE_ACTUAL
)  # fmt: skip
INPUTS = ("negative limit switch", "positive limit switch", "home switch")  # bits 0 to 2 of 60FDh
MODE_NAMES = {
    "pp": "profile position", "vl": "velocity", "pv": "profile velocity", "tq": "profile torque", "hm": "homing",
    "ip": "interpolated position", "csp": "cyclic synchronous position", "csv": "cyclic synchronous velocity",
    "cst": "cyclic synchronous torque",
}  # fmt: skip
NO_FAULT = ("fault_reset", "error_reset")


@dataclass(frozen=True)
class ShownQuantity:
    """An object's value for display: label, number, unit; the number is None if it is unknown."""

    label: str
    value: float | None
    unit: str

    def __str__(self) -> str:
        if self.value is None:
            return "—"
        digits = f"{self.value:.6g}" if abs(self.value) < 1e6 else f"{self.value:.0f}"
        return f"{digits} {self.unit}".rstrip()


@dataclass(frozen=True)
class AxisFault:
    """An active emergency: its code, its text, and its time (time of day [s])."""

    code: int
    text: FaultText
    at: float


@dataclass(frozen=True)
class AxisState:
    """The known state of an axis.

    Attributes:
        axis: Number of the axis, from 0.
        name: Name for display.
        status: Statusword 6041h.
        state: State in the statusword; None if it is invalid, or not read yet.
        mode: Abbreviation of the mode of operation; "" without one.
        modes: Modes that the drive has.
        motion: Actual position, velocity, current.
        faults: Emergencies since the last reset.
        inputs: Switches by name, and whether they are active.
        slow: Temperatures, DC link and similar values.
        is_at_limit: Whether its current is at the limit although it does not turn.
        current_share: Current over its limit; None if the drive has no limit object.
        is_silent: Whether its node sends no process data: it left operational, or is not reachable.
    """

    axis: int
    name: str
    status: int = 0
    state: State | None = None
    mode: str = ""
    modes: tuple[str, ...] = ()
    motion: tuple[ShownQuantity, ...] = ()
    faults: tuple[AxisFault, ...] = ()
    inputs: dict[str, bool] = field(default_factory=dict)
    slow: tuple[ShownQuantity, ...] = ()
    is_at_limit: bool = False
    current_share: float | None = None
    is_silent: bool = False

    @property
    def is_enabled(self) -> bool:
        """Whether it is in "operation enabled"."""
        return self.state is State.OPERATION_ENABLED

    @property
    def is_live(self) -> bool:
        """Whether its power stage may be on."""
        return bool(cia402.is_live(self.status))

    @property
    def is_in_fault(self) -> bool:
        """Whether it is in fault or in its fault reaction."""
        return self.state in (State.FAULT, State.FAULT_REACTION_ACTIVE)

    def has_bit(self, pattern: tuple[int, int]) -> bool:
        """Return whether its statusword matches a pattern."""
        return bool(cia402.matches(self.status, pattern))


class AxisStates:
    """The known states of the axes; refreshed by the drives' thread, read by any thread.

    Args:
        drives: The drives.
        description: Description of the device.
        units: Displayed unit of each dimension; they may change.

    Attributes:
        axes: The states; replaced as a whole.
        scales: Scales of each axis' units.
        sampled: Objects to sample in each cycle, the most important first.
    """

    def __init__(self, drives: Drives, description: Description, units: Mapping[str, str] = SHOWN) -> None:
        self._known = description
        self._units = units
        self.scales: list[Scale] = scales_of(drives, description.dictionary)
        doubled = cia402.VL_VELOCITY_ACTUAL if description.has(cia402.VELOCITY_ACTUAL) else None
        self.sampled: tuple[Key, ...] = tuple(
            (index, 0) for index in SAMPLED if description.has((index, 0)) and index != doubled
        )
        self._slow_at = self._quick_at = -1e9
        self._slow_entries = [entry for entry in description.dictionary if _is_slow(entry, description)]
        self._unreadable: set[Key] = set()
        self._limit_key = description.role(Role.CURRENT_LIMIT)
        self._limit: Any = None  # current limit, shape (num_axes,); None if the drive has no such object
        self._pushing = LimitAtRest(drives)
        modes = self._modes(drives)
        self.axes: tuple[AxisState, ...] = tuple(
            AxisState(axis, axis_label(drives, description, axis), modes=modes) for axis in range(drives.num_axes)
        )

    def refresh(self, drives: Drives, recorder: ScopeRecorder) -> list[str]:
        """Process the newest samples, and read other values that are due; return the messages to show."""
        now = time.monotonic()
        if now - self._slow_at > SLOW:
            self._slow_at = now
            self._read_slow(drives)
        if now - self._quick_at > QUICK:
            self._quick_at = now
            return self._read_quick(drives, recorder)
        return []

    def hear(self, message: EmergencyMessage) -> tuple[str, str]:
        """Store an emergency; return its severity and its text."""
        text = fault_text(message.name)
        axis = self.axes[message.axis]
        if message.code == 0 or message.name in NO_FAULT:
            self._replace(message.axis, faults=())
            return "info", f"{axis.name}: no error any more"
        fault = AxisFault(message.code, text, time.time())
        others = tuple(one for one in axis.faults if one.code != message.code)
        self._replace(message.axis, faults=(*others, fault))
        return "error", f"{axis.name}: {message.code:04X}h {text.name}. {text.cause} {text.remedy}"

    def forget_faults(self, axis: int) -> None:
        """Remove the faults of an axis, which were reset."""
        self._replace(axis, faults=())

    def lose(self, silent: Sequence[int]) -> None:
        """Mark all states as unknown, since the drives did not answer; `silent` are the nodes that caused it."""
        for axis in self.axes:
            is_silent = axis.axis // self._known.num_axes in silent
            self._replace(axis.axis, status=0, state=None, is_silent=is_silent)

    # --- private methods ------------------------------------------------------------------------------------------
    def _replace(self, axis: int, **changes: Any) -> None:
        self.axes = tuple(replace(one, **changes) if one.axis == axis else one for one in self.axes)

    def _modes(self, drives: Drives) -> tuple[str, ...]:
        """Return the modes that the drive supports by 6502h; all if it lacks the object."""
        every = tuple(cia402.MODES)
        try:
            bits = int(drives.read((cia402.SUPPORTED_MODES, 0))[0])
        except ObjectAccessError:
            return every
        return tuple(name for name in every if bits >> (cia402.MODES[name] - 1) & 1) or every

    def _read_quick(self, drives: Drives, recorder: ScopeRecorder) -> list[str]:
        newest = recorder.newest()
        missing = [key for key in self.sampled if key not in newest]
        newest |= {key: drives.read(key) for key in missing}
        for axis in range(drives.num_axes):
            status = int(newest[cia402.STATUSWORD, 0][axis])
            quantities = tuple(self._quantity(key, int(newest[key][axis]), axis) for key in self.sampled[1:])
            state = cia402.state_of(status)
            self._replace(axis, status=status, state=state, motion=quantities, is_silent=False)
        return self._note_limits(newest)

    def _note_limits(self, newest: Mapping[Key, Any]) -> list[str]:
        """Detect axes at their current limit that do not turn; return messages about new ones."""
        current, speed = newest.get((cia402.TORQUE_ACTUAL, 0)), newest.get((cia402.VELOCITY_ACTUAL, 0))
        if self._limit is None or current is None or speed is None:
            return []
        status = newest[cia402.STATUSWORD, 0]
        pushing = self._pushing.look(time.monotonic(), status, current, speed, self._limit)
        shares = self._pushing.share(current, self._limit)
        told = []
        for axis in self.axes:
            share = float(shares[axis.axis])
            is_at_limit = bool(pushing[axis.axis])
            if is_at_limit and not axis.is_at_limit:
                told.append(f"{axis.name}: {SAYS}")
            self._replace(axis.axis, is_at_limit=is_at_limit, current_share=share if isfinite(share) else None)
        return told

    def _read_slow(self, drives: Drives) -> None:
        shown = self._try(drives, (cia402.MODE_DISPLAY, 0))
        inputs = self._try(drives, (cia402.DIGITAL_INPUTS, 0))
        self._limit = None if self._limit_key is None else self._try(drives, self._limit_key)
        slow = {(e.index, e.sub): self._try(drives, (e.index, e.sub)) for e in self._slow_entries}
        names = {number: name for name, number in cia402.MODES.items()}
        for axis in range(drives.num_axes):
            switches = {} if inputs is None else {name: bool(inputs[axis] >> k & 1) for k, name in enumerate(INPUTS)}
            values = tuple(
                self._quantity(key, int(found[axis]), axis) for key, found in slow.items() if found is not None
            )
            mode = "" if shown is None else names.get(int(shown[axis]), "")
            values += _of_machine(drives, axis)
            self._replace(axis, mode=mode, inputs=switches, slow=values)

    def _try(self, drives: Drives, key: Key) -> Any:
        """Read an object of every axis; None if the drive does not have it."""
        if key in self._unreadable:
            return None
        try:
            return drives.read(key)
        except ObjectAccessError:
            self._unreadable.add(key)
            return None

    def _quantity(self, key: Key, raw: int, axis: int) -> ShownQuantity:
        return quantity_of(self._known.dictionary.find(key), raw, self.scales[axis], self._units)


def quantity_of(entry: Entry, raw: int, scale: Scale, units: Mapping[str, str]) -> ShownQuantity:
    """Convert an integer of an object to the displayed unit of its dimension."""
    unit = find_unit(entry.unit, scale)
    if unit is None:
        return ShownQuantity(entry.name, float(raw), entry.unit)
    shown = units[unit.dimension]
    return ShownQuantity(entry.name, raw * unit.factor / UNITS[shown].factor, shown)


def axis_label(drives: Drives, description: Description, axis: int) -> str:
    """Return the axis' name for display: node and axis on a bus, otherwise the axis' number."""
    if drives.bus is None:
        return f"axis {axis}"
    node, part = divmod(axis, description.num_axes)
    return f"node {drives.bus.nodes[node]}" + (f" axis {part}" if description.num_axes > 1 else "")


def _of_machine(drives: Drives, axis: int) -> tuple[ShownQuantity, ...]:
    """Return an emulated machine's temperatures and supply; () for a real one."""
    if drives.machine is None:
        return ()
    from drive_env.emulator.emulated_drives import emulated_of

    winding, stage = emulated_of(drives).machine.temperatures
    return (
        ShownQuantity("Winding temperature (emulated)", round(float(winding[axis]), 1), "°C"),
        ShownQuantity("Stage temperature (emulated)", round(float(stage[axis]), 1), "°C"),
        ShownQuantity("Supply (emulated)", round(float(drives.machine.supply[axis]), 2), "V"),
    )


def _is_slow(entry: Entry, known: Description) -> bool:
    """Return whether an object is a temperature or a supply: DC link, or analog inputs that the device names."""
    if entry.bits is None or entry.access == "wo":
        return False
    analog = known.dictionary.roles.get(Role.ANALOG_INPUTS)
    if analog is not None and entry.index == analog[0]:
        return entry.sub > 0
    if entry.index == cia402.DC_LINK_VOLTAGE:
        return True
    return "temperature" in entry.name.lower() and entry.access in ("ro", "const", "rwr")
