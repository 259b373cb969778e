"""A node's errors on any fieldbus: error register (1001h), history (1003h), emergencies, reactions.

An emergency is an event here: code, error register and additional bytes. The fieldbus decides how and when to send it,
and how the node's state changes.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import Protocol

from drive_env.cia402 import State
from drive_env.devices import Device, EmergencyCode
from drive_env.firmware.common.protection import CUT, STOP
from drive_env.node.axis import Axis, QueuedEmergency
from drive_env.node.error_history import CONDITIONS, OPTIONAL_CONDITIONS, ErrorCondition, ErrorHistory
from drive_env.node.node_objects import ERROR_HISTORY, ERROR_REGISTER, NodeObjects

FAULT_RESET = 0  # row of the firmware's causes
NETWORK_LOST = ("communication_error", "heartbeat_lost")  # conditions that may take axes into fault


class EmergencySink(Protocol):
    """Receives a node's emergencies.

    Attributes:
        told: Error register of the last message that was queued; 0 before the first.
    """

    told: int

    def push(self, emergency: EmergencyCode, error_register: int) -> None:
        """Queue a message."""

    def clear(self) -> None:
        """Drop waiting emergencies."""


class NodeErrors:
    """Errors of a node and its axes.

    Args:
        device: The node's device.
        axes: Its axes.
        depth: Number of errors in the history.
        sink: Receives the emergencies.
        flush: Sends the emergencies that may be sent at a time [s].
        react: Changes the fieldbus' state after a fault of an axis.

    Attributes:
        conditions: Lasting conditions of communication, by their `key`.
        history: 1003h.
    """

    def __init__(
        self,
        device: Device,
        axes: Sequence[Axis],
        depth: int,
        sink: EmergencySink,
        flush: Callable[[float], None],
        react: Callable[[], None],
    ) -> None:
        self._device = device
        self._axes = list(axes)
        self._queues = [(axis, axis.take_emergencies) for axis in axes]
        self._sink = sink
        self._flush = flush
        self._react = react
        self._told_last = 0  # axis of the last emergency
        self._last_of: dict[Hashable, int] = {}  # last axis with a condition, for 1001h
        self._module_told: dict[int, float] = {}  # row of a cause of the whole module -> when it was reported
        self.conditions: dict[Hashable, ErrorCondition] = {}
        quirks = device.canopen.quirks
        self.history = ErrorHistory(depth, reads_0=quirks.empty_history_reads_0)
        self._told_bits = ~quirks.unused_register_bits

    def add_objects(self, objects: NodeObjects) -> None:
        """Connect 1001h and, if the device has it, 1003h."""
        objects.readers[ERROR_REGISTER, 0] = self.register
        subs = objects.subs(ERROR_HISTORY)
        if subs:
            for sub in (0, *subs):
                objects.readers[ERROR_HISTORY, sub] = partial(self.history.read, sub)
            objects.commands[ERROR_HISTORY, 0] = self.history.write

    def restart(self) -> None:
        """Forget waiting emergencies and all conditions; the history stays."""
        self._sink.clear()
        self.conditions.clear()

    def register(self, without: Axis | None = None) -> int:
        """Return 1001h: the errors of the axes, except `without`, and of the node's communication."""
        register = 0
        for number, axis in enumerate(self._axes):
            if axis is not without:
                register |= self._of_axis(number, axis.error_register)
        for key, condition in self.conditions.items():
            register |= self._of_axis(self._last_of[key], condition.error_register & self._told_bits)
        return register

    def _of_axis(self, number: int, register: int) -> int:
        """Return an axis' share of 1001h; some devices mark there that it is not the first axis."""
        bit = self._device.canopen.quirks.further_axis_bit
        return register | bit if number and register else register

    def condition(self, name: str, now: float, key: Hashable = None) -> None:
        """Report a condition of the bus at `now` [s], unless it was already reported for this `key` (its source).

        CiA 301: 1003h has the errors of the emergencies.
        """
        condition = CONDITIONS.get(name) or OPTIONAL_CONDITIONS[name]
        key = name if key is None else key
        if self.conditions.get(key) is condition:
            return
        told, axes = name, [0]
        if self._is_of_axes(name):
            firmware = self._device.firmware
            told, axes = firmware.causes[firmware.communication_lost].name, self._concerned()
        if condition.lasts:
            self.conditions[key] = condition
            self._last_of[key] = axes[-1]
        for axis in axes:
            emergency = self._device.emergencies[told].of_axis(axis)
            self._told_last = axis
            self._sink.push(emergency, self.register() | condition.error_register & self._told_bits)
            self.history.add(emergency.code, axis, self._number_of(emergency))
        self._flush(now)

    def condition_if_known(self, name: str, now: float) -> None:
        """Report a condition that a device's emergency table may lack, since the standard leaves it optional."""
        if name in self._device.emergencies:
            self.condition(name, now)

    def collect(self, now: float) -> None:
        """Queue the axes' emergencies since the last call; call it after each cycle of the drives."""
        for axis, take in self._queues:
            for emergency in take():
                self._tell_of(axis, emergency, now)
        if self._sink.told and not self.register():
            # CiA 301: a master that received an error gets 0000h when no error is left, however it ended.
            reset = self._device.emergencies[self._device.firmware.causes[FAULT_RESET].name]
            self._sink.push(reset.of_axis(self._told_last), 0)

    def _tell_of(self, axis: Axis, queued: QueuedEmergency, now: float) -> None:
        """Send an axis' emergency, with the error register at that time, and react to a fault."""
        cause = self._device.firmware.causes[queued.row]
        if queued.row == FAULT_RESET:
            self.conditions.clear()
        self._told_last = self._axes.index(axis)
        register = self._of_axis(self._told_last, queued.error_register) | self.register(without=axis)
        emergency = self._device.emergencies[cause.name].of_axis(self._told_last)
        if not self._is_told_of_module(queued.row, now):
            self._sink.push(emergency, register)
            self.history.add(emergency.code, self._told_last, self._number_of(emergency))
        if cause.reaction in (CUT, STOP) and queued.row != FAULT_RESET:
            self._flush(now)
            self._react()

    def _is_of_axes(self, name: str) -> bool:
        """Return whether a lost network is an error of each axis: the device's table has no row of the node for it."""
        return name in NETWORK_LOST and name not in self._device.emergencies

    def _concerned(self) -> list[int]:
        """Return the axes in error after a lost network: those in operation, or just tripped by it; otherwise all."""
        firmware = self._device.firmware
        register = firmware.causes[firmware.communication_lost].error_register
        concerned = [
            number
            for number, axis in enumerate(self._axes)
            if axis.state == State.OPERATION_ENABLED
            or (axis.state in (State.FAULT, State.FAULT_REACTION_ACTIVE) and axis.error_register & register)
        ]
        return concerned or list(range(len(self._axes)))

    def _number_of(self, emergency: EmergencyCode) -> int:
        """Return the device's own number of an error, as 1003h has it."""
        return emergency.extra[0] if self._device.canopen.quirks.history_tells_number else 0

    def _is_told_of_module(self, row: int, now: float) -> bool:
        """Return whether another axis has reported the same event of the module in this cycle, and note it if not.

        An event of the whole module is one event for all of its axes, and CiA 301 demands one message per event.
        """
        if not self._device.is_of_module(self._device.firmware.causes[row].name):
            return False
        told = self._module_told.get(row) == now
        self._module_told[row] = now
        return told
