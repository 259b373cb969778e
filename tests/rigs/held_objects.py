"""Drives that hold values of objects and do nothing by themselves: what the envelope's parts are tested against."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from drive_env.dictionary.aborts import NO_SUCH_OBJECT, VALUE_RANGE, ObjectAccessError
from drive_env.dictionary.entries import Entry
from drive_env.dictionary.roles import Role
from drive_env.fieldbus.errors import refused

CURRENT_LIMIT = (0x2003, 0)
UNITS = {0x606C: "pps", 0x6081: "pps", 0x6083: "pps^2", 0x6084: "pps^2", 0x6085: "pps^2", 0x609A: "pps^2"}


class HeldObjects:
    """Objects of some axes, by (index, sub-index): one number for all axes, or one for each.

    Args:
        values: Of the objects that the EDS lists.
        num_axes: How many.
        units: Of objects by index, beside `UNITS`.
        refused: Objects that the EDS lists and the drives have not.
        takes: Object to what a drive makes of a value; None for one that it refuses.
        own: What a program sees of (object, axis, value): its own where another is lent.
    """

    def __init__(self, values, num_axes=1, *, units=None, refused=(), takes=None, own=lambda key, axis, found: found):
        self.values = {
            key: np.broadcast_to(value, (num_axes,)).astype(np.int64).copy() for key, value in values.items()
        }
        self.num_axes, self.nodes, self.time_waits, self.is_dry = num_axes, tuple(range(1, num_axes + 1)), False, False
        self.refused, self.takes, self.own = set(refused), takes or {}, own
        self.device = None  # they are known by their EDS alone
        self.link = SimpleNamespace(process=SimpleNamespace(before=lambda node, key: None))
        self.log = []  # (object, axis, value) as they were written
        units = UNITS | (units or {})
        self.entries = {
            key: Entry(
                *key, f"object {key[0]:04X}h", 32, "rw", -(2**31), 2**31 - 1, 0, units.get(key[0], ""), True, True
            )
            for key in [*values, *refused]
        }
        self.description = SimpleNamespace(
            num_axes=1, cycle=0.001, has=self.entries.__contains__,
            hints=SimpleNamespace(turns_positions_round=(), unchecked_motion=()),
            role=lambda role: CURRENT_LIMIT if role is Role.CURRENT_LIMIT and CURRENT_LIMIT in self.entries else None,
            dictionary=SimpleNamespace(
                find=lambda key: self.entries[key], has=self.entries.__contains__, roles={}
            ),
        )  # fmt: skip

    def _check(self, entry, what):
        if (entry.index, entry.sub) in self.refused:
            raise refused("node 1", what, NO_SUCH_OBJECT)

    def read_entry(self, entry):
        self._check(entry, "the read")
        return self.values[entry.index, entry.sub].copy()

    def read_raw(self, entry, axis):
        self._check(entry, "the read")
        return int(self.values[entry.index, entry.sub][axis])

    def read_axis(self, entry, axis):
        return self.own((entry.index, entry.sub), axis, self.read_raw(entry, axis))

    def write_raw(self, entry, axis, value):
        key = (entry.index, entry.sub)
        taken = self.takes[key](value) if key in self.takes else value
        if taken is None:
            raise ObjectAccessError(VALUE_RANGE, f"{entry.label} = {value} is refused")
        self.log.append((key, axis, value))
        self.values[key][axis] = taken
