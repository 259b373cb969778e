"""A CANopen node on a virtual bus in real time."""

from __future__ import annotations

import threading
import time

import can

from drive_env.canopen.frames import Frame
from drive_env.canopen.node import Node

NODE = 5
PATIENCE = 30.0  # s; what comes, comes in milliseconds, but a busy computer may stand still for seconds


def until(condition):
    """Wait until a condition holds.

    python-canopen's own waits begin to listen when they are called: what came a moment before, they miss.
    """
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.002)


class BootUps:
    """Counts a node's boot-up messages, from its making on."""

    def __init__(self, network):
        self.count = 0
        network.subscribe(0x700 + NODE, self._heard)

    def _heard(self, can_id, data, timestamp):
        self.count += data[0] == 0

    def wait(self):
        until(lambda: self.count)


class Pump:
    """A node on a virtual bus in real time: frames as they come, a communication cycle every millisecond."""

    def __init__(self, drives, interface, channel):
        self.drives = drives
        self.bus = can.Bus(interface=interface, channel=channel)
        self.node = Node(NODE, drives, send=self._send)
        self.lock = threading.Lock()
        self.now = 0.0
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _send(self, frame):
        self.bus.send(can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False))

    def _run(self):
        begun = time.monotonic()
        cycles = 0
        while not self._ends.is_set():
            message = self.bus.recv(timeout=0.0005)
            with self.lock:
                if message is not None and not message.is_extended_id:
                    data = b"" if message.is_remote_frame else bytes(message.data)
                    self.node.receive(
                        Frame(message.arbitration_id, data, message.is_remote_frame, message.dlc), self.now
                    )
                while self.now < time.monotonic() - begun:
                    self.node.before_cycle(self.now)
                    self.drives.advance(0.001)
                    cycles += 1
                    self.now = cycles * 0.001
                    self.node.after_cycle(self.now)

    def power_on(self):
        with self.lock:
            self.node.power_on(self.now)

    def close(self):
        self._ends.set()
        self._thread.join()
        self.bus.shutdown()
