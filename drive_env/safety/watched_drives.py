"""What the envelope asks of the drives that it watches over, and what their cycles ask of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

from drive_env.cia402 import Key
from mechanics.arrays import Integers, Mask

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.dictionary.entries import Entry
    from drive_env.fieldbus.description import Description
    from drive_env.fieldbus.link import Link, ObjectClient


class CycleWatch(Protocol):
    """Who is asked before rows are played, and looks at what comes back in every cycle."""

    @property
    def epoch(self) -> int:
        """What samples are asked for in: it grows with every controlword."""

    def watched(self) -> list[Entry]:
        """Return the objects to sample at every SYNC, the most important first; the same while the limits stay."""

    def sampled(self, chosen: Sequence[Entry]) -> None:
        """Take note of what comes with every SYNC."""

    def observe(
        self, rows: Mapping[Key, Integers], epoch: int, where: Mask | None = None, coming: int | None = None
    ) -> None:
        """Look at samples, each object of shape (rows, num_axes)."""

    def before_play(self, played: Mapping[Entry, Integers]) -> None:
        """Raise SafetyError for rows that would pass a limit."""

    def after_play(self, played: Mapping[Entry, Integers]) -> None:
        """Take note of what was played."""

    def after_failed_play(self, played: Mapping[Entry, Integers]) -> None:
        """Take note that the drives may have taken any of the rows."""


class WatchedDrives(Protocol):
    """Drives on a link, past the envelope: what is read and written here is neither checked nor watched."""

    @property
    def description(self) -> Description:
        """What is known of the device."""

    @property
    def device(self) -> Device | None:
        """What the drives are; None where only their EDS is known."""

    @property
    def nodes(self) -> tuple[int, ...]:
        """The nodes' addresses."""

    @property
    def num_axes(self) -> int:
        """Number of axes."""

    @property
    def time_waits(self) -> bool:
        """Whether no time passes between two calls (lockstep)."""

    @property
    def is_dry(self) -> bool:
        """Whether this is a dry run: frames are printed, and no node answers."""

    @property
    def link(self) -> Link:
        """The bus."""

    def sdo(self, node: int) -> ObjectClient:
        """Return the client for the objects of a node, by its position in `nodes`."""

    def read_entry(self, entry: Entry, axes: Sequence[int] | None = None) -> Any:
        """Read an object of every axis, or of some, as the program sees it."""

    def read_axis(self, entry: Entry, axis: int) -> Any:
        """Read an object of one axis, as the program sees it."""

    def read_raw(self, entry: Entry, axis: int) -> Any:
        """Read an object of one axis as the drive has it, also where that is lent."""

    def write_raw(self, entry: Entry, axis: int, value: int) -> None:
        """Write an object of one axis, past what is lent to it."""

    def start(self) -> None:
        """Take the nodes to where they exchange process data, once."""

    def must_start(self) -> None:
        """Take note that a node is not operational any more: the next command starts it."""

    def forget(self, nodes: Sequence[int]) -> None:
        """Forget what nodes, by position, were configured to: they have restarted."""

    def pass_cycle(self) -> None:
        """Let one cycle pass."""

    def sampled_entries(self) -> tuple[Entry, ...]:
        """Return the objects that come with every SYNC."""

    def prepare_watch(self, watch: CycleWatch) -> None:
        """Have mapped what is watched."""

    def poll(self, watch: CycleWatch) -> bool | None:
        """Look at the drives by a SYNC of one's own: True if all answered, None where nothing is mapped."""
