"""A transport over any python-can interface, including the in-process "virtual" one for tests."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import can

from drive_env.bus.transport import Incoming
from drive_env.bus.wire import Transmission, Wire
from drive_env.canopen.frames import Frame

MAX_FRAMES = 256  # handled at a turn, so that a flood does not stop time

logger = logging.getLogger(__name__)


class CanPort:
    """A python-can bus that the nodes share with others.

    Args:
        bus: An open bus; it is closed by `close`.
    """

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self.lost = 0  # frames that the interface did not accept

    def wait(self, timeout: float, wire: Wire) -> Iterator[Incoming]:
        """Return received frames, after at most `timeout` [s].

        Raises:
            can.CanError: If the interface fails.
        """
        for _ in range(MAX_FRAMES):
            message = self._bus.recv(timeout)
            if message is None:
                return
            timeout = 0.0
            if message.is_error_frame or message.is_fd:
                continue
            length = message.dlc if message.is_remote_frame else None
            data = b"" if message.is_remote_frame else bytes(message.data)
            frame = Frame(message.arbitration_id, data, message.is_remote_frame, length)
            yield Incoming(frame, self, message.is_extended_id)

    def deliver(self, ended: Transmission) -> None:
        """Send a frame of the nodes; a frame received from this bus is not sent again."""
        if ended.sender is self:
            return
        frame = ended.frame
        message = can.Message(
            arbitration_id=frame.can_id,
            is_extended_id=ended.extended,
            is_remote_frame=frame.rtr,
            dlc=frame.dlc,
            data=frame.data or None,
        )
        try:
            self._bus.send(message)
        except can.CanError as error:  # a full buffer, or no other node acknowledges
            self.lost += 1
            if self.lost == 1:
                logger.warning("the interface did not take frame %s: %s", frame, error)

    def flush(self) -> None:
        """Do nothing: frames are already sent."""

    def close(self) -> None:
        """Close the bus."""
        self._bus.shutdown()
