"""The mapping of a slave: read as found, changed in Pre-Op in the prescribed order, restored."""

from __future__ import annotations

import struct
from functools import partial

from drive_env.cia402 import Key
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.dictionary.roles import Role
from drive_env.fieldbus.description import Description
from drive_env.fieldbus.link import ObjectClient
from drive_env.fieldbus.tidying import Tidying
from drive_env.master.ethercat.image_layout import FIRST_PDO, ImageLayout, ImagePlanner


class SlaveImages:
    """The assignments and mappings of one slave.

    Args:
        sdo: Its objects.
        description: Its device.
    """

    def __init__(self, sdo: ObjectClient, description: Description) -> None:
        self._sdo = sdo
        self._timeout = description.answer_timeout
        self._cycle_key = description.role(Role.SET_CYCLE)
        values = {} if description.device is None else description.device.allowed_values
        self._cycles = values.get(self._cycle_key, ()) if self._cycle_key else ()  # us
        self._cycle_before: int | None = None  # us
        # Direction -> (assigned objects, mapping object -> its entries), as they were found.
        self._before: dict[int, tuple[list[int], dict[int, list[int]]]] = {}

    def found(self, direction: int, planner: ImagePlanner) -> ImageLayout:
        """Return the slave's present image; an empty one if it has entries without a name."""
        assigned = self._read_list(direction, 2)
        mapped = [raw for pdo in assigned for raw in self._read_list(pdo, 4)]
        layout = planner.parsed(direction, assigned, mapped) if assigned else None
        return planner.free(assigned[0] if assigned else FIRST_PDO[direction], ()) if layout is None else layout

    def change(self, direction: int, layout: ImageLayout) -> None:
        """Write an image to the slave: no assignment, no entries, entries, their number, the assignment."""
        assigned = self._read_list(direction, 2)
        mapped = None if layout.mapped is None else self._read_list(layout.pdo, 4)
        wanted = [layout.pdo, *layout.more]
        if assigned == wanted and (layout.mapped is None or mapped == list(layout.mapped)):
            return
        kept = {} if mapped is None else {layout.pdo: mapped}
        self._before.setdefault(direction, (assigned, kept))
        self._write(direction, 0, 1, 0)
        if layout.mapped is not None and mapped != list(layout.mapped):
            self._write_list(layout.pdo, layout.mapped, 4)
        self._write_list(direction, wanted, 2)

    def set_cycle(self, cycle: float) -> None:
        """Write the cycle of process data [s] to the slave, if it has an object for it that accepts this cycle."""
        wanted = round(1e6 * cycle)
        if self._cycle_key is None or wanted not in self._cycles:
            return
        before = self._read(*self._cycle_key)
        if before != wanted:
            self._write(*self._cycle_key, 4, wanted)
            self._cycle_before = before

    def before(self, key: Key) -> int | None:
        """Return the value that an object had before it was changed here; None if it was not changed."""
        if key == self._cycle_key:
            return self._cycle_before
        lists = {one: values for _, mappings in self._before.values() for one, values in mappings.items()}
        lists |= {direction: assigned for direction, (assigned, _) in self._before.items()}
        values = lists.get(key[0])
        return None if values is None else dict(enumerate((len(values), *values))).get(key[1])

    def restore(self) -> None:
        """Restore assignments, mappings and cycle; BusError if not all of it could be restored."""
        before, self._before = self._before, {}
        tidying = Tidying()
        if self._cycle_key is not None and self._cycle_before is not None:
            tidying.step(partial(self._write, *self._cycle_key, 4, self._cycle_before))
            self._cycle_before = None
        for direction, (assigned, mappings) in before.items():
            tidying.step(partial(self._write, direction, 0, 1, 0))
            for pdo, mapped in mappings.items():
                tidying.step(partial(self._write_list, pdo, mapped, 4))
            tidying.step(partial(self._write_list, direction, assigned, 2))
        tidying.end()

    def forget(self) -> None:
        """Forget the images found: the slave has restarted."""
        self._before.clear()
        self._cycle_before = None

    # --- inside -----------------------------------------------------------------------------------------------------
    def _read(self, index: int, sub: int) -> int:
        return int.from_bytes(self._sdo.read(index, sub, f"{index:04X}h:{sub:02X}", self._timeout), "little")

    def _read_list(self, index: int, size: int) -> list[int]:
        """Return the entries of an object; empty if the slave lacks it."""
        try:
            count = self._read(index, 0)
        except ObjectAccessError:
            return []
        return [self._read(index, sub) & ((1 << 8 * size) - 1) for sub in range(1, count + 1)]

    def _write(self, index: int, sub: int, size: int, value: int) -> None:
        data = struct.pack("<Q", value)[:size]
        self._sdo.write(index, sub, data, f"{value:X}h to {index:04X}h:{sub:02X}", self._timeout)

    def _write_list(self, index: int, values: list[int] | tuple[int, ...], size: int) -> None:
        self._write(index, 0, 1, 0)
        for sub, value in enumerate(values, 1):
            self._write(index, sub, size, value)
        self._write(index, 0, 1, len(values))
