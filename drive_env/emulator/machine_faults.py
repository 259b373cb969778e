"""Faults of emulated machines: they begin and end by their schedule, and change the machines' parameters meanwhile."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from drive_env import cia402
from drive_env.emulator.parameters import change_encoder
from drive_env.faults.effects import (
    ENCODER_DIRECTION,
    ENCODER_GAIN,
    ENCODER_NOISE,
    MOMENTS,
    OF_LINK,
    Change,
    Quantity,
    changes_of,
    of_drives,
)
from drive_env.faults.schedule import ENABLED, NEVER, NO_CONDITION, Condition, Order, cycles_of
from drive_env.faults.table import FaultRow, checked_parameters, find_fault
from drive_env.firmware.record import get_lanes, set_lanes
from mechanics.arrays import Floats, Integers, Mask

if TYPE_CHECKING:
    from drive_env.emulator.inside import Inside


_CHANGING = ("axes", "state", "begins", "ends")  # of a fault, in addition to its order
ABSENT, WAITING, DUE, ON, OVER = range(5)  # in a machine: not concerned, waits for the condition, for the time, ...
TWO_PI = 2.0 * math.pi
SEED_STEP = 2_654_435_761  # golden ratio of 2^32: neighbouring seeds give different noise


class InjectedFault(NamedTuple):
    """A fault that is scheduled or active.

    number: Result of `machine.fault`.
    order: The arguments of `machine.fault`.
    parameters: All numbers of the fault.
    waiting, active: Machines in which it waits or acts, shape (num_machines,).
    """

    number: int
    order: Order
    parameters: Mapping[str, float]
    waiting: Mask
    active: Mask


@dataclass(eq=False)
class _MachineFault:
    """A fault with its state in each machine.

    `delay` and `length` are its times in cycles; `axes` the axes concerned, (num_axes,). For each machine, shape
    (num_machines,): `state`, and the cycles at which it begins and ends.
    """

    number: int
    order: Order
    row: FaultRow
    given: Mapping[str, float]
    condition: Condition
    changes: tuple[Change, ...]
    delay: int
    length: int
    axes: Mask
    state: Integers
    begins: Integers
    ends: Integers

    def changes_some(self, quantity: Quantity) -> bool:
        """Return whether it is active on any machine, and changes a quantity."""
        return bool(np.any(self.state == ON)) and any(change.quantity == quantity for change in self.changes)

    def is_over(self) -> bool:
        return not bool(np.any((self.state != ABSENT) & (self.state != OVER)))


def axes_that_fulfil(condition: Condition, inside: Inside) -> Mask:
    """Return which axes fulfil a condition now, shape (num_axes,)."""
    records, count = inside.records, inside.num_axes
    if condition.quantity == NO_CONDITION:
        return np.ones(count, bool)
    if condition.quantity == ENABLED:
        words = get_lanes(records, "statusword", count).astype(np.int64)
        return np.asarray(cia402.matches(words, cia402.OPERATION_ENABLED))
    value = get_lanes(records, "theta_m" if condition.quantity == "position" else "omega_m", count).astype(float)
    value = np.abs(value) if condition.quantity == "speed" else value
    return np.asarray(value > condition.limit if condition.above else value < condition.limit)


class MachineFaults:
    """All faults of a set of emulated machines. Without faults nothing is checked.

    Faults change quantities temporarily: `base` keeps a quantity's value without faults, and several faults of one
    quantity act in the order in which they were added.
    """

    def __init__(self, inside: Inside) -> None:
        self._inside = inside
        self._axes_per_machine = inside.load.num_axes
        self._faults: list[_MachineFault] = []
        self._next_number = 0
        self._base: dict[Quantity, Floats] = {}
        self._held: dict[Quantity, Mask] = {}
        self._jam = np.zeros(inside.num_axes)

    # --- giving, listing, taking back -----------------------------------------------------------------------------
    def add(self, order: Order, machines: Mask, of_node: Mask | None = None) -> int:
        """Schedule a fault and return its number; `Machines.fault` explains an order and its errors.

        Args:
            order: The fault.
            machines: Machines that get it, shape (num_machines,).
            of_node: Axes of the order that get it, shape (num_axes,); all of them by default.
        """
        inside, axis = self._inside, order.axis
        row, changes = self.check(order)
        given = checked_parameters(row, order.parameters)
        if row.name == "open_phase" and given["phase"] >= len(changes):
            phase = f"{given['phase']:g}"
            raise ValueError(f"fault open_phase: phase={phase} must be 0 to {len(changes) - 1} of this motor")
        if row.name == "stage_short" and given["phase"] >= len(changes) - 1:
            raise ValueError(
                f"fault stage_short: phase={given['phase']:g} must be -1 to {len(changes) - 2} of a "
                f"{inside.device.name}; -1 is a short across the DC link"
            )
        axes = np.repeat(machines, self._axes_per_machine)
        if axis is not None:
            axes &= np.arange(inside.num_axes) % self._axes_per_machine == axis
        if of_node is not None:
            axes &= of_node
        fault = self._made(self._next_number + 1, order, axes)
        self._rehearse(changes, given, axes)
        self._next_number += 1
        fault.begins[:] = inside.cycle + fault.delay
        fault.state[:] = np.where(machines, DUE if fault.condition.quantity == NO_CONDITION else WAITING, ABSENT)
        self._faults.append(fault)
        return self._next_number

    def check(self, order: Order) -> tuple[FaultRow, tuple[Change, ...]]:
        """Return the row of a fault and its changes.

        Raises:
            ValueError: For a fault that is impossible for these machines, or an invalid order.
        """
        name, axis = order.name, order.axis
        row = find_fault(name)
        if row.group == "bus" or name == "store_interrupted":
            raise ValueError(
                f"fault {name} is of a bus and its nodes, which machines in process do not have; give it to a bus that "
                f"is served: drive-env serve --fault {name!r}"
            )
        if axis is not None and not 0 <= axis < self._axes_per_machine:
            raise ValueError(f"fault {name}: axis={axis} must be 0 to {self._axes_per_machine - 1} of a machine")
        return row, () if name in MOMENTS else self._changes(name)

    def listing(self) -> list[InjectedFault]:
        """Return the faults that are scheduled or active."""
        return [
            InjectedFault(
                fault.number, fault.order, dict(fault.given), (fault.state == WAITING) | (fault.state == DUE),
                fault.state == ON,
            )
            for fault in self._faults
        ]  # fmt: skip

    def clear(self, number: int | None, machines: Mask) -> None:
        """End a fault, or all, on some machines; ValueError for an unknown number."""
        known = [fault.number for fault in self._faults]
        if number is not None and number not in known:
            raise ValueError(f"there is no fault {number}; there are {', '.join(map(str, known)) or 'none'}")
        for fault in list(self._faults):
            if number is None or fault.number == number:
                self._end(fault, machines & (fault.state == ON))
                fault.state[machines & (fault.state != ABSENT)] = OVER
        self._forget()

    @property
    def some(self) -> bool:
        """Whether any fault is scheduled or active."""
        return bool(self._faults)

    # --- states ---------------------------------------------------------------------------------------------------
    def save_state(self) -> dict[str, Any]:
        """Return the active and scheduled faults, and the quantities that they act on, as plain data."""
        return {
            "next": self._next_number,
            "jam": self._jam.copy(),
            "base": {quantity: values.copy() for quantity, values in self._base.items()},
            "held": {quantity: mask.copy() for quantity, mask in self._held.items()},
            "faults": [
                (fault.number, fault.order, *(getattr(fault, name).copy() for name in _CHANGING))
                for fault in self._faults
            ],
        }

    def restore_state(self, state: Mapping[str, Any]) -> None:
        """Restore the faults of a state; machines and records must already be those of the state."""
        self._next_number, self._jam = state["next"], state["jam"].copy()
        self._base = {quantity: values.copy() for quantity, values in state["base"].items()}
        self._held = {quantity: mask.copy() for quantity, mask in state["held"].items()}
        self._faults = [self._made(number, order, *arrays) for number, order, *arrays in state["faults"]]

    # --- time -----------------------------------------------------------------------------------------------------
    def act(self, now: int) -> int:
        """Begin and end the faults due at cycle `now`; return the cycle of the next call."""
        following = NEVER
        for fault in list(self._faults):
            waiting = fault.state == WAITING
            if waiting.any():
                met = waiting & self._holds(fault)
                fault.state[met] = DUE
                fault.begins[met] = now + fault.delay
            due = (fault.state == DUE) & (fault.begins <= now)
            if due.any():
                self._begin(fault, due, now)
            over = (fault.state == ON) & (fault.ends <= now)
            if over.any():
                self._end(fault, over)
            if np.any(fault.state == WAITING):
                following = now + 1
            for state, times in ((DUE, fault.begins), (ON, fault.ends)):
                those = times[fault.state == state]
                following = min(following, int(those.min()) if those.size else NEVER)
        self._forget()
        return max(following, now + 1)

    def change_cycle(self, longer: float) -> None:
        """Keep the times of all faults when cycles become longer by a factor."""
        now = self._inside.cycle
        for fault in self._faults:
            fault.delay, fault.length = cycles_of(fault.order, fault.row, self._inside.cycles)
            for times in (fault.begins, fault.ends):
                there = times < NEVER
                times[there] = now + np.ceil((times[there] - now) / longer - 1e-9)

    @contextmanager
    def suspended(self) -> Iterator[None]:
        """Remove all changes while the machines' parameters are changed, and apply them again afterwards."""
        active = [(fault, fault.state == ON) for fault in self._faults if np.any(fault.state == ON)]
        for fault, machines in active:
            fault.state[machines] = OVER
        for fault, _ in active:
            self._refresh(fault)
        try:
            yield
        finally:
            for fault, machines in active:
                fault.state[machines] = ON
            for fault, _ in active:
                self._refresh(fault)

    # --- inside ---------------------------------------------------------------------------------------------------
    def _made(self, number: int, order: Order, axes: Mask, *changing: Integers) -> _MachineFault:
        """Return the fault of an order on some axes; `changing`: state, begin, end per machine, default: not begun."""
        row, changes = self.check(order)
        delay, length = cycles_of(order, row, self._inside.cycles)
        given, condition = checked_parameters(row, order.parameters), Condition.parse(order.when)
        nothing = np.zeros(self._inside.num_machines, np.int64)
        state, begins, ends = (array.copy() for array in changing or (nothing, nothing, nothing + NEVER))
        return _MachineFault(
            number, order, row, given, condition, changes, delay, length, axes.copy(), state, begins, ends
        )

    def _changes(self, name: str) -> tuple[Change, ...]:
        load = self._inside.load
        names = tuple(parameter.name for parameter in load.parameters)
        changes = changes_of(name, names, str(load.name), self._axes_per_machine, bool(load.switches))
        device = self._inside.device
        return of_drives(name, changes, device.firmware.layout.dtype.names or (), device.name)

    def _rehearse(self, changes: tuple[Change, ...], given: Mapping[str, float], axes: Mask) -> None:
        """Refuse now, not in the middle of a run, a change of the load that cannot be stepped."""
        for change in changes:
            if change.quantity.kind == "load":
                sound = self._get(change.quantity)
                self._set(change.quantity, change.value(sound, given, self._inside.motor.rated_torque), axes)
                self._set(change.quantity, sound, axes)

    def _begin(self, fault: _MachineFault, machines: Mask, now: int) -> None:
        axes = fault.axes & np.repeat(machines, self._axes_per_machine)
        if fault.row.name in MOMENTS:
            fault.state[machines] = OVER
            if fault.row.name == "node_reset":
                self._inside.objects.restart(axes)
            else:
                self._jump(fault.given["angle"], axes)
            return
        fault.state[machines] = ON
        fault.ends[machines] = now + fault.length if fault.length < NEVER else NEVER
        if any(change.quantity == ENCODER_NOISE for change in fault.changes):
            seeds = np.mod(self._inside.noise_seeds * SEED_STEP + fault.number, 2.0**32 - 1.0) + 1.0
            set_lanes(self._inside.records, "encoder_random", np.floor(seeds), axes)
        self._refresh(fault)

    def _end(self, fault: _MachineFault, machines: Mask) -> None:
        if not machines.any():
            return
        fault.state[machines] = OVER
        self._refresh(fault)
        if fault.row.name == "broken_coupling":
            for group in self._inside.groups:
                group.load.mend("stiffness", machines[group.machines])

    def _forget(self) -> None:
        self._faults = [fault for fault in self._faults if not fault.is_over()]

    def _holds(self, fault: _MachineFault) -> Mask:
        """Return which machines fulfil a fault's condition, on any of its axes."""
        return self._machines(axes_that_fulfil(fault.condition, self._inside) & fault.axes)

    def _machines(self, axes: Mask) -> Mask:
        """Return the machines with at least one of the axes."""
        found: Mask = np.logical_or.reduce(axes.reshape(-1, self._axes_per_machine), axis=1)
        return found

    def _refresh(self, fault: _MachineFault) -> None:
        """Set the quantities that a fault changes to their values under all active faults."""
        for quantity in {change.quantity for change in fault.changes}:
            while not self._refresh_quantity(quantity):
                # Several faults together have made a load that cannot be stepped; the latest is removed.
                latest = [one for one in self._faults if one.changes_some(quantity)][-1]
                latest.state[latest.state == ON] = OVER
                warnings.warn(
                    f"fault {latest.number} ({latest.row.name}) is called off: together with the others it makes a "
                    "load that cannot be stepped; give it other numbers",
                    RuntimeWarning,
                    stacklevel=2,
                )

    def _refresh_quantity(self, quantity: Quantity) -> bool:
        """Apply a quantity's faults; return whether the result is possible for the machines."""
        axes = self._inside.num_axes
        held = self._held.setdefault(quantity, np.zeros(axes, bool))
        present = self._get(quantity)
        base = self._base.setdefault(quantity, present.copy())
        base[~held] = present[~held]
        wanted, some = base.copy(), np.zeros(axes, bool)
        for one in self._faults:
            if not one.changes_some(quantity):
                continue
            mask = one.axes & np.repeat(one.state == ON, self._axes_per_machine)
            if quantity.name in OF_LINK:
                links = self._inside.links
                mask = np.isin(links, links[mask])
            for change in one.changes:
                if change.quantity == quantity:
                    changed = change.value(wanted, one.given, self._inside.motor.rated_torque)
                    wanted = np.where(mask, changed, wanted)
                    some |= mask
        touched = held | some
        if np.any(wanted[touched] != present[touched]):
            try:
                self._set(quantity, wanted, touched)
            except ValueError:
                if not some.any():
                    raise
                return False
        self._held[quantity] = some
        return True

    def _get(self, quantity: Quantity) -> Floats:
        inside = self._inside
        if quantity.kind == "jam":
            return self._jam.copy()
        if quantity.kind == "load":
            values = np.concatenate([group.load.get(quantity.name) for group in inside.groups])
            return np.repeat(values, self._axes_per_machine)
        return get_lanes(inside.records, quantity.name, inside.num_axes, quantity.part).astype(float)

    def _set(self, quantity: Quantity, values: Floats, axes: Mask) -> None:
        inside = self._inside
        if quantity.kind == "jam":
            self._jam = np.where(axes, values, self._jam)
            for group in inside.groups:
                group.load.jam(self._jam[group.axes].reshape(-1, self._axes_per_machine))
        elif quantity.kind == "load":
            machines = self._machines(axes)
            per_machine = values[:: self._axes_per_machine]
            for group in inside.groups:
                group.load.set(quantity.name, per_machine[group.machines], machines[group.machines])
            inside.refresh_inertia()
        elif quantity in (ENCODER_GAIN, ENCODER_DIRECTION):
            change_encoder(inside.records, quantity.name, values, axes)
        else:
            set_lanes(inside.records, quantity.name, values, axes, quantity.part)

    def _jump(self, angle: float, axes: Mask) -> None:
        """Shift the encoder counts by an angle [rad], as if that many edges came within one sample."""
        records, count = self._inside.records, self._inside.num_axes
        forwards = 1.0 - 2.0 * get_lanes(records, "encoder_true_direction", count).astype(float)
        counts = np.rint(angle * forwards * get_lanes(records, "encoder_counts", count).astype(float) / TWO_PI)
        for name in ("count", "count_zero"):
            set_lanes(records, name, get_lanes(records, name, count).astype(float) - counts, axes)
