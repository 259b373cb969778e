"""Protocols: what the envelope needs of the drives that it watches, and what their cycles need of the envelope."""

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
    """The envelope as seen by cycles: asked before rows are played, and given the samples of every cycle."""

    @property
    def epoch(self) -> int:
        """Return the epoch in which samples are requested: it grows with every controlword."""

    def watched(self) -> list[Entry]:
        """Return the objects to sample at every SYNC, most important first; the same list until the limits change."""

    def sampled(self, chosen: Sequence[Entry]) -> None:
        """Note the objects that come with every SYNC."""

    def observe(
        self, rows: Mapping[Key, Integers], epoch: int, where: Mask | None = None, coming: int | None = None
    ) -> None:
        """Check samples, each object of shape (rows, num_axes)."""

    def before_play(self, played: Mapping[Entry, Integers]) -> None:
        """Raise SafetyError for rows that would pass a limit."""

    def after_play(self, played: Mapping[Entry, Integers]) -> None:
        """Update what depends on rows that were played."""

    def after_failed_play(self, played: Mapping[Entry, Integers]) -> None:
        """Note that the drives may have executed any of the rows."""


class WatchedDrives(Protocol):
    """Drives on a link, below the envelope: reads and writes here are neither checked nor watched."""

    @property
    def description(self) -> Description:
        """The device's description."""

    @property
    def device(self) -> Device | None:
        """The device; None if only its EDS is known."""

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
        """Read an object of one axis as the drive has it, even if that value is lent."""

    def write_raw(self, entry: Entry, axis: int, value: int) -> None:
        """Write an object of one axis, even if the envelope has overridden it."""

    def start(self) -> None:
        """Make the nodes operational, so that they exchange process data; once."""

    def must_start(self) -> None:
        """Note that a node is not operational any more: the next command starts it."""

    def forget(self, nodes: Sequence[int]) -> None:
        """Forget the configuration of nodes, by position: they have restarted."""

    def pass_cycle(self) -> None:
        """Let one cycle pass."""

    def sampled_entries(self) -> tuple[Entry, ...]:
        """Return the objects that come with every SYNC."""

    def prepare_watch(self, watch: CycleWatch) -> None:
        """Have the watched objects mapped to PDOs."""

    def poll(self, watch: CycleWatch) -> bool | None:
        """Send a SYNC and observe its samples. False if a node sent none, None if cycles are under way."""
