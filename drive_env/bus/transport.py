"""Transports: they carry frames between a world and its masters."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from typing import NamedTuple, Protocol

from drive_env.bus.wire import Transmission, Wire
from drive_env.canopen.frames import Frame


class Incoming(NamedTuple):
    """A frame from a master: the frame, its sender, and whether its identifier has 29 bits."""

    frame: Frame
    sender: Hashable
    extended: bool


class Transport(Protocol):
    """A hub, or a python-can interface."""

    def wait(self, timeout: float, wire: Wire) -> Iterable[Incoming]:
        """Return a few frames received for the wire, after at most `timeout` [s]."""

    def deliver(self, ended: Transmission) -> None:
        """Queue a frame of the bus for all masters but its sender."""

    def flush(self) -> None:
        """Send the queued frames."""

    def close(self) -> None:
        """Close it."""
