"""The whole object dictionary of a node: the module's objects and those of each axis, by the index of the bus."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from drive_env import cia402
from drive_env.devices import Device
from drive_env.dictionary.entries import Entry, ObjectDictionary
from drive_env.node.axis import Axis, ObjectPort

WRITTEN = ("rw", "rwr", "rww")  # CiA 306: objects that are written and read back


class OwnObjects(Protocol):
    """Objects that a node has once for all axes: those of communication.

    Attributes:
        commands: Objects whose write is a command, by index and sub-index.
    """

    commands: dict[tuple[int, int], Callable[[int], None]]

    def owns(self, entry: Entry) -> bool:
        """Return whether an object is one of the node's own."""

    def port(self, entry: Entry) -> ObjectPort:
        """Return the port of one of the node's own objects."""


class NodeDictionary:
    """Ports of all objects.

    Args:
        device: The device.
        entries: Its dictionary from the EDS.
        module: Objects of the module.
        axes: The axes, in order.
    """

    def __init__(self, device: Device, entries: ObjectDictionary, module: OwnObjects, axes: Sequence[Axis]) -> None:
        self.entries = entries
        self._device = device
        self._module = module
        self._axes = axes
        self._ports: dict[tuple[int, int], ObjectPort] = {}
        parameters = {field.name for field in device.firmware.layout.parameters}
        self._states = {key for key, binding in device.bindings.items() if binding.field not in parameters}

    def port(self, index: int, sub: int) -> ObjectPort:
        """Return the port of an object.

        Raises:
            ObjectAccessError: 06020000h if there is no such object, 06090011h if it has no such sub-index.
        """
        port = self._ports.get((index, sub))
        if port is None:
            port = self._ports[index, sub] = self._make(self.entries.find((index, sub)))
        return port

    def section(self, entry: Entry) -> str | None:
        """Return the section of the store that a parameter belongs to; None for an object that is not a parameter.

        An object that a receive PDO can carry is a command or a set-point: a drive that restored an old one after
        power-on would act on it. An object that the firmware itself sets (a counter, an armed latch) is no parameter
        either.
        """
        roles = self._device.canopen.objects
        if (entry.index, entry.sub) in (roles.get("bit_rate"), roles.get("node_id")):
            return "bus"
        key = (entry.index, entry.sub)
        is_command = key in self._module.commands or key in self._device.unsupported
        stores_mapped = self._device.canopen.quirks.stores_mapped
        if stores_mapped and self._commands(key):
            return None
        if entry.pdo_mappable and not stores_mapped:
            return None
        if entry.access not in WRITTEN or entry.bits is None or is_command:
            return None
        if 0x1000 <= entry.index <= 0x1FFF:
            return "communication"
        if self._device.is_shared(entry.index):
            return "module"
        axis, base = self._device.locate(entry.index)
        if (base, entry.sub) in self._states:
            return None
        return "profile" if base in cia402.PROFILE_AREAS else f"motor {axis}"

    def _commands(self, key: tuple[int, int]) -> bool:
        """Return whether a write of an object is a command."""
        axis_0 = self._device.locate(key[0])[1]
        if (axis_0, key[1]) == cia402.OUTPUTS_MASK:
            return False
        return axis_0 in cia402.COMMANDED or axis_0 in self._device.master.commands

    def _make(self, entry: Entry) -> ObjectPort:
        if self._module.owns(entry):
            return self._module.port(entry)
        axis, base = self._device.locate(entry.index)
        if base == entry.index:
            return self._axes[axis].port(entry)
        return self._axes[axis].port(self.entries.find((base, entry.sub)))._replace(entry=entry)
