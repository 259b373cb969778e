"""Process data of several nodes in PDOs: objects of all axes to PDOs, rows of integers to frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from drive_env.cia402 import Key
from drive_env.dictionary.aborts import PDO_LENGTH_EXCEEDED, ObjectAccessError
from drive_env.dictionary.entries import Entry
from drive_env.fieldbus.description import Description
from drive_env.master.can.bus_time import BusTime
from drive_env.master.can.pdo import (
    INTO_DRIVE,
    OUT_OF_DRIVE,
    Direction,
    PdoConfiguration,
    RemotePdo,
    check_mappable,
    plan,
    too_many,
)
from drive_env.master.can.port import Port
from drive_env.master.can.samples import PdoSamples
from drive_env.master.packing import Bytes, pack_rows
from mechanics.arrays import Integers


class _Plan(NamedTuple):
    """The mapping for some objects: the entries of each PDO mapped for them, and each node's fixed PDOs."""

    groups: list[list[Entry]]
    standing: list[list[RemotePdo]]

    @property
    def all_groups(self) -> list[list[Entry]]:
        """The entries of each PDO of an axis."""
        return self.groups + [[member.entry for member in pdo.members] for pdo in self.standing[0]]


class RpdoRows:
    """Rows of frames that go into the drives.

    Args:
        port: The bus.
        rpdos: Identifier and rows of bytes of each RPDO.
    """

    def __init__(self, port: Port, rpdos: Sequence[tuple[int, Bytes]]) -> None:
        self._port = port
        self._frames = [(can_id, [row.tobytes() for row in rows]) for can_id, rows in rpdos]

    def send(self, row: int) -> None:
        """Send a row; the drives apply it at the next SYNC."""
        for can_id, rows in self._frames:
            self._port.send(can_id, rows[row])


class PdoProcessData:
    """The present mapping, and the conversion between its integers and its frames.

    Args:
        port: The bus.
        description: The nodes' device.
        configurations: The PDOs of each node.
        dry: A dry run: no drive is connected, and nothing is sampled.
        bus_time: Capacity of the bus in a cycle.

    Attributes:
        mapping: Number of the mapping, which grows with every change.
    """

    def __init__(
        self,
        port: Port,
        description: Description,
        configurations: Sequence[PdoConfiguration],
        dry: bool = False,
        bus_time: BusTime = BusTime(),  # noqa: B008
    ) -> None:
        self._bus_time = bus_time
        self._axes = len(configurations) * description.num_axes
        self._port = port
        self._description = description
        self._configurations = configurations
        self._dry = dry
        self._mapped: dict[str, tuple[tuple[Entry, ...], list[list[RemotePdo]]]] = {}
        self._plans: dict[tuple[str, tuple[Entry, ...]], _Plan | None] = {}
        self.mapping = 0

    def check_sampled(self, entries: Sequence[Entry]) -> None:
        """Raise ObjectAccessError 06040041h for an object that no TPDO can carry."""
        check_mappable(self._description, entries, OUT_OF_DRIVE)

    def check_played(self, entries: Sequence[Entry]) -> None:
        """Raise ObjectAccessError 06040041h for an object that no RPDO can carry."""
        check_mappable(self._description, entries, INTO_DRIVE)

    def choose(
        self, wanted: Sequence[Entry], welcome: Sequence[Entry], played: Sequence[Entry] = ()
    ) -> tuple[Entry, ...]:
        """Return the objects to sample: the wanted ones, then as many of the welcome ones, in their order, as fit.

        Args:
            wanted: Objects to sample.
            welcome: Objects to sample if PDOs and bus have room.
            played: Objects that are sent to the drives meanwhile.

        Raises:
            ObjectAccessError: 06040042h if not even the wanted ones fit.
        """
        besides = [entry for entry in welcome if entry not in wanted]
        into = self._groups(INTO_DRIVE, tuple(played)) or []
        while True:
            entries = (*wanted, *besides)
            out = self._groups(OUT_OF_DRIVE, entries)
            if out is not None and (not besides or self._bus_time.has_room_besides((*into, *out), self._axes)):
                return entries
            if not besides:
                raise too_many(self._description, wanted, OUT_OF_DRIVE)
            besides.pop()

    def is_mapped(self, played: tuple[Entry, ...], sampled: tuple[Entry, ...]) -> bool:
        """Return whether the PDOs carry exactly the played objects, and at least the sampled ones."""
        return (not played or played == self._entries(INTO_DRIVE)) and self._carries(sampled)

    def map(self, played: tuple[Entry, ...], sampled: tuple[Entry, ...]) -> None:
        """Map entries of every axis to PDOs that go with SYNC, unless they are already mapped.

        Raises:
            ObjectAccessError: If they do not fit, into PDOs or into a cycle of the bus, or a drive refuses them.
        """
        groups = [*(self._groups(INTO_DRIVE, played) or []), *(self._groups(OUT_OF_DRIVE, sampled) or [])]
        if (excess := self._bus_time.excess(groups, self._axes)) is not None:
            raise ObjectAccessError(PDO_LENGTH_EXCEEDED, excess)
        if played and played != self._entries(INTO_DRIVE):
            self._map(INTO_DRIVE, played)
        if not self._carries(sampled):
            self._map(OUT_OF_DRIVE, sampled)

    def sampled_entries(self) -> tuple[Entry, ...]:
        """Return the objects that the mapped TPDOs carry."""
        return self._entries(OUT_OF_DRIVE)

    def outputs(self, played: Mapping[Entry, Integers]) -> RpdoRows | None:
        """Return the mapped RPDOs' frames of integers of shape (cycles, num_axes); None if nothing is played."""
        if not played:
            return None
        return RpdoRows(
            self._port,
            [
                (pdo.can_id, pack_rows(pdo.members, played, k * self._description.num_axes))
                for k, pdos in enumerate(self._mapped[INTO_DRIVE.name][1])
                for pdo in pdos
            ],
        )

    def samples(self) -> PdoSamples | None:
        """Begin to collect the mapped TPDOs. None if nothing is mapped, or in a dry run."""
        of_nodes = self._mapped.get(OUT_OF_DRIVE.name, ((), []))[1]
        if self._dry or not any(of_nodes):
            return None
        return PdoSamples(self._port, of_nodes, self._description.num_axes)

    def forget(self, nodes: Sequence[int]) -> None:
        """Forget the configuration of nodes that have restarted: nothing counts as mapped."""
        for k in nodes:
            self._configurations[k].forget()
        self.mapping += 1
        self._mapped.clear()
        self._plans.clear()  # fixed PDOs may have changed with the reset

    def before(self, node: int, key: Key) -> int | None:
        """Return the value that an object of a node had before its PDOs were mapped; None for one that is its own."""
        return self._configurations[node].before(key)

    def restore(self, node: int) -> None:
        """Restore every PDO of a node.

        Raises:
            BusError: If not all of them could be restored.
        """
        self._configurations[node].restore()

    def _entries(self, direction: Direction) -> tuple[Entry, ...]:
        return self._mapped.get(direction.name, ((), []))[0]

    def _carries(self, sampled: tuple[Entry, ...]) -> bool:
        return set(sampled) <= set(self._entries(OUT_OF_DRIVE))

    def _map(self, direction: Direction, entries: tuple[Entry, ...]) -> None:
        made = self._plan(direction, entries)
        if made is None:
            raise too_many(self._description, entries, direction)
        self.mapping += 1
        self._mapped.pop(direction.name, None)
        pdos = [configuration.configure(made.groups, direction) for configuration in self._configurations]
        self._mapped[direction.name] = (entries, [a + b for a, b in zip(pdos, made.standing, strict=True)])

    def _groups(self, direction: Direction, entries: tuple[Entry, ...]) -> list[list[Entry]] | None:
        made = self._plan(direction, entries)
        return None if made is None else made.all_groups

    def _plan(self, direction: Direction, entries: tuple[Entry, ...]) -> _Plan | None:
        key = (direction.name, entries)
        if key not in self._plans:
            carried, standing = self._of_standing(direction, entries)
            rest = [entry for entry in entries if entry not in carried]
            groups = plan(self._description, rest, direction)
            self._plans[key] = None if groups is None else _Plan(groups, standing)
        return self._plans[key]

    def _of_standing(
        self, direction: Direction, entries: tuple[Entry, ...]
    ) -> tuple[set[Entry], list[list[RemotePdo]]]:
        """Return the entries that fixed PDOs carry for every axis, and these PDOs of each node.

        An RPDO is sent whole: it can be used only if every object in it is played, since others would bring an old
        command.
        """
        usable = [
            [
                pdo
                for pdo in configuration.standing(direction)
                if direction is OUT_OF_DRIVE or all(member.entry in entries for member in pdo.members)
            ]
            for configuration in self._configurations
        ]
        axes = range(self._description.num_axes)
        there = [{(member.entry, member.axis) for pdo in pdos for member in pdo.members} for pdos in usable]
        carried = {entry for entry in entries if all((entry, axis) in of_node for of_node in there for axis in axes)}
        chosen: list[list[RemotePdo]] = []
        for pdos in usable:
            chosen.append([])
            left = {(entry, axis) for entry in carried for axis in axes}
            for pdo in sorted(pdos, key=lambda one: -len(one.members)):
                members = tuple(member for member in pdo.members if (member.entry, member.axis) in left)
                if members:
                    left -= {(member.entry, member.axis) for member in members}
                    chosen[-1].append(pdo if direction is INTO_DRIVE else pdo._replace(members=members))
        return carried, chosen
