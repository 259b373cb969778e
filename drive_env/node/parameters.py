"""Parameters that a node keeps without power (1010h, 1011h): sections of its dictionary, saved or at factory values."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from drive_env.devices import Device
from drive_env.dictionary.aborts import CANNOT_BE_STORED, HARDWARE_ERROR, ObjectAccessError
from drive_env.dictionary.access import check_limits
from drive_env.node.node_axes import NodeAxes
from drive_env.node.node_dictionary import NodeDictionary
from drive_env.node.node_objects import RESTORE, STORE, NodeObjects, signed_command
from drive_env.node.store import Section, Store


class Parameters:
    """Stored parameters of a node.

    Args:
        device: The device.
        objects: The node's own objects.
        axes: The node's axes.
        dictionary: All of its objects.
        store: The memory.
        node_id: Returns the node-ID, which the factory's COB-IDs contain.
        works: Called before values are stored, which takes time.

    Attributes:
        replaces: Section -> another section that is deleted when it is saved.
    """

    def __init__(
        self,
        device: Device,
        objects: NodeObjects,
        axes: NodeAxes,
        dictionary: NodeDictionary,
        store: Store,
        node_id: Callable[[], int],
        works: Callable[[], None],
    ) -> None:
        self._device = device
        self._objects = objects
        self._axes = axes
        self._dictionary = dictionary
        self._store = store
        self._node_id = node_id
        self._works = works
        self.replaces: dict[str, str] = {}

    def add_commands(self) -> None:
        """Make 1010h and 1011h store and restore the groups that the device has."""
        canopen = self._device.canopen
        for sub, names in canopen.store_groups.items():
            save, load = partial(self.save, names), partial(self.load, names)
            commands = self._objects.commands
            commands[STORE, sub] = signed_command(canopen.save_signature, CANNOT_BE_STORED, save)
            commands[RESTORE, sub] = signed_command(canopen.load_signature, CANNOT_BE_STORED, load)

    def save(self, names: tuple[str, ...]) -> None:
        """Save the present values of sections; factory values are not stored, so that COB-IDs follow the node-ID."""
        factory = self._objects.factory(self._node_id())
        changed: dict[str, Section] = {name: {} for name in names}
        for entry in self._dictionary.entries:
            name = self._dictionary.section(entry)
            key = (entry.index, entry.sub)
            if name in changed and key in factory:  # objects that only EtherCAT has are set by the master
                raw = self._dictionary.port(*key).read()
                assert isinstance(raw, int), "a parameter is a number"
                if name == "bus" or raw != factory[key]:
                    changed[name][key] = raw
        self._commit(changed)

    def load(self, names: tuple[str, ...]) -> None:
        """Restore sections to the factory's values, from the next reset on."""
        self._commit({name: {} for name in names})

    def prepare_restart(self) -> None:
        """Set the axes' values for the next restart."""
        values: list[dict[tuple[int, int], int]] = [{} for _ in self._axes]
        for entry in self._dictionary.entries:
            section = self._store.sections.get(self._dictionary.section(entry) or "")
            if section is not None and not self._objects.owns(entry) and isinstance(entry.default, int):
                axis, base = self._device.locate(entry.index)
                values[axis][base, entry.sub] = section.get((entry.index, entry.sub), entry.default)
        self._axes.store(values)

    def check(self, path: Path | None, other: Callable[[str, tuple[int, int], int], bool] = lambda *_: False) -> None:
        """Raise ValueError if a stored value fits no object.

        Args:
            path: The store's file.
            other: Checks a value that belongs to no object, by section, key and raw; returns whether it knows it.
        """
        for name, section in self._store.sections.items():
            for key, raw in section.items():
                try:
                    if not other(name, key, raw):
                        check_limits(self._objects.find(*key), raw)
                except ObjectAccessError as error:
                    raise ValueError(f"{path} does not fit {self._device.name}: {error}; delete it") from error

    def _commit(self, changed: dict[str, Section]) -> None:
        for name in [self.replaces[name] for name in changed if name in self.replaces]:
            if name in self._store.sections:
                changed[name] = {}  # the last stored section counts
        self._works()
        try:
            self._store.save(changed)
        except OSError as error:
            raise ObjectAccessError(HARDWARE_ERROR, f"the parameters cannot be stored: {error}") from error
        self.prepare_restart()
