"""Faults of a bus: those of its wire and its nodes, and those of the machines behind them."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from drive_env.bus.faults import Faults
from drive_env.bus.world import World
from drive_env.canopen.frames import NMT, Frame
from drive_env.canopen.node import Node
from drive_env.drives.arguments import whole_cycles
from drive_env.drives.interface import CYCLE
from drive_env.emulator.emulated_drives import EmulatedDrives
from drive_env.emulator.machine_faults import axes_that_fulfil
from drive_env.faults.schedule import NEVER, Condition, Order, cycles_of
from drive_env.faults.table import FaultRow, checked_parameters, find_fault
from mechanics.arrays import Mask

logger = logging.getLogger(__name__)

# Faults of the wire itself, by its own names.
DISTURBANCES: dict[str, Callable[[Mapping[str, float]], Faults]] = {
    "bus_loss": lambda given: Faults(drop=given["share"]),
    "bus_delay": lambda given: Faults(delay=given["share"], delay_max=given["longest"]),
    "bus_doubling": lambda given: Faults(duplicate=given["share"]),
    "bus_reorder": lambda given: Faults(reorder=given["share"]),
    "bus_bit_errors": lambda given: Faults(corrupt=given["share"]),
}
OF_ONE_NODE = ("bus_off", "second_master", "node_reset", "store_interrupted")
MOST_BABBLE = 16  # waiting frames of a babbler, which never stops and need not queue more
BABBLE = bytes(8)


class BusFault(NamedTuple):
    """A fault that is scheduled or active: its number, its order, its node, and whether it is active."""

    number: int
    order: Order
    node: int | None
    is_active: bool


@dataclass(eq=False)
class _BusFault:
    """A fault and its state: cycles at which it begins and ends, None while waiting for its condition.

    `inner` is the number that the machine gave to a fault of the machine.
    """

    number: int
    order: Order
    row: FaultRow
    given: Mapping[str, float]
    condition: Condition
    node: int | None
    delay: int
    length: int
    begins: int | None = None
    ends: int | None = None
    disturbance: Faults | None = None
    inner: int | None = None


class BusFaults:
    """All faults of a world, which any thread may add; they act at the beginning of a communication cycle.

    Args:
        world: The world.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self._lock = threading.RLock()
        self._faults: list[_BusFault] = []
        self._ended: list[_BusFault] = []  # cancelled, to be ended by the world's own thread
        self._next_number = 0
        world.before_cycle.append(self._act)

    def add(self, order: Order) -> int:
        """Schedule a fault of the bus, or of a node and its machine; return its number.

        Args:
            order: The fault; it needs `node` if it is of one node and there are several, and may have an `axis` of that
                node.

        Raises:
            ValueError: For an unknown fault, parameter, node or axis, an invalid time or condition, or a fault that is
                impossible for this machine.
        """
        row = find_fault(order.name)
        given = checked_parameters(row, order.parameters)
        condition = Condition.parse(order.when)
        delay, length = cycles_of(order, row, partial(whole_cycles, cycle=CYCLE))
        is_of_wire = row.group == "bus" and row.name not in OF_ONE_NODE
        node = order.node if is_of_wire and order.node is None else self._node_of(order)
        is_of_machine = not is_of_wire and row.name not in OF_ONE_NODE
        self._check_axis(order, is_of_machine, node)
        with self._lock:
            if is_of_machine:
                assert node is not None
                # Checked here, so that the machine can refuse it; the world's own thread passes it to the machine.
                self._drives_of(node).faults.check(replace(order, axis=None))
            self._next_number += 1
            fault = _BusFault(self._next_number, order, row, given, condition, node, delay, length)
            self._faults.append(fault)
            if order.when == "" or self._is_of_machine(row):
                fault.begins = self._world.cycles + (0 if self._is_of_machine(row) else delay)
            return fault.number

    def listing(self) -> list[BusFault]:
        """Return the faults that are scheduled or active."""
        with self._lock:
            return [BusFault(fault.number, fault.order, fault.node, self._is_active(fault)) for fault in self._faults]

    def clear(self, number: int | None = None) -> None:
        """End or cancel a fault; None: all of them. ValueError for an unknown number."""
        with self._lock:
            known = [fault.number for fault in self._faults]
            if number is not None and number not in known:
                raise ValueError(f"there is no fault {number}; there are {', '.join(map(str, known)) or 'none'}")
            chosen = [fault for fault in self._faults if number in (None, fault.number)]
            self._faults = [fault for fault in self._faults if fault not in chosen]
            self._ended += chosen

    # --- inside ---------------------------------------------------------------------------------------------------
    @staticmethod
    def _is_of_machine(row: FaultRow) -> bool:
        return row.group not in ("bus", "node")

    def _node_of(self, order: Order) -> int:
        nodes = self._world.nodes
        known = ", ".join(map(str, nodes))
        if order.node is None and len(nodes) > 1:
            raise ValueError(
                f"fault {order.name} is a fault of one node; give it: node={next(iter(nodes))}, of {known}"
            )
        node = next(iter(nodes)) if order.node is None else order.node
        if node not in nodes:
            raise ValueError(f"fault {order.name}: there is no node {node} on the bus; there are {known}")
        return node

    def _emulated(self, node: int) -> Node:
        found = self._world.nodes[node]
        assert isinstance(found, Node), "faults are of emulated nodes"
        return found

    def _drives_of(self, node: int) -> EmulatedDrives:
        return self._emulated(node).drives

    def _is_active(self, fault: _BusFault) -> bool:
        if fault.inner is not None and fault.node is not None:
            found = [one for one in self._drives_of(fault.node).faults.listing() if one.number == fault.inner]
            return bool(found) and bool(found[0].active.any())
        return fault.ends is not None

    def _act(self) -> None:
        """Begin, continue and end faults that are due; the world calls it at the beginning of a communication cycle."""
        if not self._faults and not self._ended:
            return
        now = self._world.cycles
        with self._lock:
            for fault in self._ended:
                self._end(fault)
            self._ended.clear()
            for fault in list(self._faults):
                if fault.begins is None and self._holds(fault):
                    fault.begins = now + fault.delay
                if fault.ends is None and fault.begins is not None and fault.begins <= now:
                    fault.ends = now + fault.length if fault.length < NEVER else NEVER
                    try:
                        self._begin(fault)
                    except ValueError as error:  # the load cannot be stepped with this fault; the bus goes on
                        logger.warning("fault %d is called off: %s", fault.number, error)
                        self._faults.remove(fault)
                        continue
                if fault.ends is not None and self._is_over(fault, now):
                    self._end(fault)
                    self._faults.remove(fault)
                elif fault.ends is not None:
                    self._go_on(fault, now)

    def _holds(self, fault: _BusFault) -> bool:
        """Return whether an axis of the fault's node, or of any node without one, fulfils its condition."""
        if fault.node is None:
            return any(bool(axes_that_fulfil(fault.condition, drives.inside).any()) for drives in self._world.drives)
        node = self._emulated(fault.node)
        met = axes_that_fulfil(fault.condition, node.drives.inside)
        return bool(met[self._axes_of(fault.node)].any())

    def _is_over(self, fault: _BusFault, now: int) -> bool:
        if fault.row.once:
            return True
        if fault.inner is not None and fault.node is not None:
            return not any(one.number == fault.inner for one in self._drives_of(fault.node).faults.listing())
        return fault.ends is not None and fault.ends <= now

    def _begin(self, fault: _BusFault) -> None:
        world, name, node = self._world, fault.row.name, fault.node
        if name in DISTURBANCES:
            fault.disturbance = DISTURBANCES[name](fault.given)
            world.wire.injected.append(fault.disturbance)
        if node is None or name == "babbling_node":
            return
        if name == "bus_off":
            # Without a duration the controller recovers as soon as it can.
            held = 0.0 if fault.order.duration is None else fault.order.duration
            world.take_off_bus(node, world.time + held)
            if fault.order.duration is None:
                fault.ends = world.cycles + 1
        elif name == "node_reset":
            world.nodes[node].power_on(world.time)
        elif name == "store_interrupted":
            self._emulated(node).saves_lose_power = True
        elif self._is_of_machine(fault.row):
            fault.inner = self._give_to_machine(fault, node)

    def _give_to_machine(self, fault: _BusFault, number: int) -> int:
        """Pass a fault to a node's machines, for one axis or by default for all concerned; return its number there.

        By default faults of sensors, motor and supply concern the node's own axes, those of the load all axes of its
        machines.
        """
        node, order = self._emulated(number), fault.order
        drives = node.drives
        chosen = self._axes_of(number)
        if order.axis is not None:
            chosen &= np.arange(len(chosen)) == node.first_axis + order.axis
        machines: Mask = np.logical_or.reduce(chosen.reshape(-1, drives.load.num_axes), axis=1)
        of_axis = order.axis is not None or fault.row.group in ("sensor", "motor", "supply")
        return drives.faults.add(replace(order, axis=None), machines, chosen if of_axis else None)

    def _axes_of(self, number: int) -> Mask:
        """Return which of the drives' axes belong to a node, shape (num_axes,), excluding axes without a motor."""
        node = self._emulated(number)
        axes = np.arange(node.drives.num_axes) - node.first_axis
        of_node: Mask = (axes >= 0) & (axes < node.drives.device.num_axes)
        return of_node

    def _check_axis(self, order: Order, is_of_machine: bool, node: int | None) -> None:
        """Raise ValueError for an axis that the node lacks, or for a fault that does not concern an axis."""
        if order.axis is None:
            return
        if not is_of_machine or node is None:
            raise ValueError(f"fault {order.name} is a fault of a bus or a node, not of an axis; leave axis out")
        count = int(self._axes_of(node).sum())
        if not 0 <= order.axis < count:
            raise ValueError(f"fault {order.name}: axis={order.axis} must be 0 to {count - 1} of node {node}")

    def _go_on(self, fault: _BusFault, now: int) -> None:
        wire, name, given = self._world.wire, fault.row.name, fault.given
        assert fault.begins is not None
        sender = (name, fault.number)
        if name == "babbling_node":
            # whole frames, by the rate since it began
            passed = now - fault.begins
            due = int((passed + 1) * given["rate"] * CYCLE) - int(passed * given["rate"] * CYCLE)
            for _ in range(min(due, MOST_BABBLE - wire.waiting(sender))):
                wire.send(Frame(int(given["identifier"]), BABBLE), sender, self._world.time)
        elif name == "second_master" and (now - fault.begins) % max(round(given["period"] / CYCLE), 1) == 0:
            wire.send(Frame(NMT, bytes((int(given["command"]), fault.node or 0))), sender, self._world.time)

    def _end(self, fault: _BusFault) -> None:
        if fault.disturbance is not None:
            # compared by identity: two faults with equal parameters are two
            injected = self._world.wire.injected
            injected[:] = [one for one in injected if one is not fault.disturbance]
        if fault.node is None or fault.ends is None:
            return
        if fault.row.name == "bus_off" and fault.order.duration is not None:
            self._world.let_recover(fault.node)
        elif fault.row.name == "store_interrupted":
            self._emulated(fault.node).saves_lose_power = False
        elif fault.inner is not None:
            faults = self._drives_of(fault.node).faults
            if any(one.number == fault.inner for one in faults.listing()):
                faults.clear(fault.inner, np.ones(self._drives_of(fault.node).num_machines, bool))
