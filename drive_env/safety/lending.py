"""Values lent to drives: tighter limits written to them while they are moved; they get their own back afterwards.

A limit that lives in this process alone dies with it. So a limit that is tighter here than in the drive is written to
the drive. The program goes on reading and writing its own value, which the drive gets back afterwards.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, NamedTuple

from drive_env.cia402 import Key
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.dictionary.entries import Entry
from drive_env.fieldbus.errors import BusError
from drive_env.fieldbus.tidying import Tidying

if TYPE_CHECKING:
    from drive_env.safety.watched_drives import WatchedDrives

logger = logging.getLogger(__name__)


class Loan(NamedTuple):
    """An object's own value, and the values lent in its place: several after an answer was lost."""

    own: int
    lent: frozenset[int]


class Lending:
    """Objects with a lent value.

    Args:
        drives: The drives.

    Attributes:
        left_alone: Axes that this program does not move: nothing is lent to them.
    """

    def __init__(self, drives: WatchedDrives) -> None:
        self.left_alone: frozenset[int] = frozenset()
        self._drives = drives
        self._loans: dict[tuple[Key, int], Loan] = {}

    def lend(self, key: Key, axis: int, value: int) -> bool:
        """Lend a value to an object of an axis. True if the drive, read back, has it or the axis is left alone."""
        if axis in self.left_alone:
            return True
        entry, loan = self._drives.description.dictionary.find(key), self._loans.get((key, axis))
        try:
            own = int(self._drives.read_raw(entry, axis)) if loan is None else loan.own
            # Noted before the write: if its answer is lost, the drive may have either value.
            self._loans[key, axis] = Loan(own, frozenset({value}) | (frozenset() if loan is None else loan.lent))
            self._drives.write_raw(entry, axis, value)
            found = int(self._drives.read_raw(entry, axis))
            # If the drive clips the value, say to its range, the clipped value counts as lent and is taken back.
            self._loans[key, axis] = Loan(own, frozenset({found}))
            if found == value:
                return True
            logger.warning(
                "axis %d does not accept %s = %d; this limit is monitored by this computer only",
                axis,
                entry.label,
                value,
            )
        except ObjectAccessError as error:
            logger.warning("axis %d: %s; this limit is monitored by this computer only", axis, error)
            if loan is None:
                self._loans.pop((key, axis), None)
            else:
                self._loans[key, axis] = loan
        return False

    def own(self, key: Key, axis: int, found: int) -> int:
        """Return the program's own value of an object; `found`, the value read, if none is lent."""
        loan = self._loans.get((key, axis))
        return loan.own if loan is not None and found in loan.lent else found

    def owned(self, key: Key, axis: int) -> int:
        """Return an object's own value, in whose place another one is lent; KeyError if none is lent."""
        return self._loans[key, axis].own

    def is_lent(self, key: Key, axis: int) -> bool:
        """Return whether an object has a lent value."""
        return (key, axis) in self._loans

    def settle(self, key: Key, axis: int, value: int) -> None:
        """Note the value that the program wants an object to have afterwards."""
        self._loans[key, axis] = self._loans[key, axis]._replace(own=value)

    def pass_on(self, key: Key, axis: int, value: int) -> None:
        """Write the program's value to an object in place of the lent one, as its own value from now on.

        Raises:
            ObjectAccessError: If the drive refuses it; BusError if it does not answer.
        """
        self._drives.write_raw(self._drives.description.dictionary.find(key), axis, value)
        self._loans[key, axis] = Loan(value, frozenset({value}))

    def give_back(self, axes: set[int]) -> None:
        """Restore the own values of axes.

        Raises:
            BusError: If not all of them could be restored.
        """
        tidying = Tidying()
        for (key, axis), loan in list(self._loans.items()):
            if axis in axes:
                entry = self._drives.description.dictionary.find(key)
                tidying.step(lambda entry=entry, axis=axis, loan=loan: self._return(entry, axis, loan))  # type: ignore[misc]
        tidying.end()

    def give_back_one(self, key: Key, axis: int) -> None:
        """Restore the own value of an object of an axis."""
        self._return(self._drives.description.dictionary.find(key), axis, self._loans[key, axis])

    def has_lent(self, axes: set[int]) -> bool:
        """Return whether any object of axes has a lent value."""
        return any(axis in axes for _, axis in self._loans)

    def forget(self, axes: set[int]) -> None:
        """Forget the own values of axes whose node was reset."""
        for key, axis in list(self._loans):
            if axis in axes:
                del self._loans[key, axis]

    def _return(self, entry: Entry, axis: int, loan: Loan) -> None:
        # If another program has changed the value meanwhile, its value stays.
        if int(self._drives.read_raw(entry, axis)) in loan.lent:
            self._drives.write_raw(entry, axis, loan.own)
            if (found := int(self._drives.read_raw(entry, axis))) != loan.own:
                raise BusError(f"axis {axis}: {entry.label} should have {loan.own} again, and has {found}")
        self._loans.pop(((entry.index, entry.sub), axis), None)
