"""EtherCAT slaves of machines whose other drives are on CAN: two buses, one load, one time."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from drive_env.bus.lateness import Lateness
from drive_env.ethercat.ways import EtherCatWay, UdpSocket
from drive_env.ethercat.world import EtherCatWorld

if TYPE_CHECKING:
    from drive_env.bus.server import Server

LONGEST_WAIT = 0.05  # s until a request to stop is seen


class BesideCan:
    """Answers an EtherCAT master in a separate thread, while a CAN server lets time pass for both.

    Attributes:
        world: The slaves, `beside` the world that the server serves.
        way: Connects their master.
        answer_times: How long frames waited for their answer [s].
    """

    def __init__(self, server: Server, world: EtherCatWorld, way: EtherCatWay) -> None:
        self.world = world
        self.way = way
        self.answer_times = Lateness()
        self._server = server
        self._pass_on = world.receive_payload if isinstance(way, UdpSocket) else world.receive
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="EtherCAT beside CAN", daemon=True)

    def start(self) -> None:
        """Switch the slaves on and begin to answer their master; the CAN server is started after that."""
        self.world.power_on()
        self._thread.start()

    def close(self) -> None:
        """Stop, and close the connection."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        self.way.close()

    def __enter__(self) -> BesideCan:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- inside -----------------------------------------------------------------------------------------------------
    def _run(self) -> None:
        while not self._stop.is_set():
            self.way.serve(LONGEST_WAIT, self._receive, self.answer_times.add)

    def _receive(self, frame: bytes) -> bytes | None:
        with self._server.guard:
            if self._server.is_serving:
                self._server.catch_up()
            return self._pass_on(frame)
