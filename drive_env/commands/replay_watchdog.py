"""The watchdog for a crash of `drive-env frames replay`: heartbeat consumers of the drives, set while it runs."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

from drive_env import cia402
from drive_env.canopen.frames import NMT, SDO_REQUEST
from drive_env.cia402 import Key
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.fieldbus.errors import BusError
from drive_env.fieldbus.tidying import Tidying
from drive_env.master.can.error_control import STAYS, Heartbeats
from drive_env.master.can.port import Port
from drive_env.master.can.sdo import SdoClient

SILENCE = 0.5  # s after which a drive acts
PERIOD = SILENCE / 3.0  # two heartbeats may be lost
MOST_CONSUMERS = 8  # entries of 1016h that are checked
MAX_AXES = 8
CONSUMERS, GUARD_TIME, LIFE_FACTOR, ERROR_BEHAVIOUR = 0x1016, 0x100C, 0x100D, (0x1029, 1)
QUICK_STOP, NO_ACTION = 3, 0  # of 6007h
RAMPS, COASTS = 2, 0  # of 605Ah, the quick stop's option
# NMT commands; resets delete the settings of 1016h.
START, RESETS = 0x01, (0x81, 0x82)


class ReplayWatchdog:
    """Heartbeats of this process, and the heartbeat consumers of the addressed nodes.

    Args:
        port: The bus.
        frames: Frames to send (python-can messages).
        timeout: Longest wait for an answer [s].
    """

    def __init__(self, port: Port, frames: Iterable[Any], timeout: float) -> None:
        self._port = port
        self._timeout = timeout
        self._heartbeats: Heartbeats | None = None
        self._before: dict[int, dict[Key, bytes]] = {}  # node -> previous values of its objects
        self._own, self._left = nodes_watched_by(frames)
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def arm(self, nodes: Sequence[int]) -> list[str]:
        """Make nodes watch this process; return texts about those that cannot."""
        without = []
        self._heartbeats = Heartbeats(self._port, nodes)
        self._heartbeats.choose()
        self._thread = threading.Thread(target=self._beat, name="heartbeats of replay", daemon=True)
        self._thread.start()  # before a drive begins to expect them
        for node in nodes:
            if node in self._own:
                continue  # the recorded master's own, whose heartbeats are among the frames
            why = self._left.get(node) or self._left.get(0) or self._arm_node(node)
            if why:
                without.append(
                    f"node {node} would run on if this program were killed: {why}; keep the emergency stop at hand"
                )
        return without

    def give_up(self, nodes: Iterable[int]) -> list[str]:
        """Restore the settings of nodes whose motors are proved off; the others stop by themselves.

        Returns:
            Texts about settings that could not be restored.
        """
        problems: list[str] = []
        for node in nodes:
            objects, tidying = SdoClient(self._port, node), Tidying()
            for key, data in reversed(self._before.pop(node, {}).items()):
                tidying.step(partial(self._put_back, node, objects, key, data))
            try:
                tidying.end()
            except (BusError, ObjectAccessError) as error:
                problems.append(f"node {node} still watches over this program: {error}")
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
        return problems

    def _put_back(self, node: int, objects: SdoClient, key: Key, data: bytes) -> None:
        label = f"{key[0]:04X}h:{key[1]:02X}"
        objects.put_back(*key, data, label, self._timeout)
        if (found := objects.read(*key, label, self._timeout)[: len(data)]) != data:
            raise BusError(f"node {node}: {label} should have {data.hex()} again, and has {found.hex()}")

    def _beat(self) -> None:
        assert self._heartbeats is not None
        while not self._ended.wait(PERIOD):
            try:
                self._heartbeats.send()
            except BusError:
                return  # the drives notice

    def _arm_node(self, node: int) -> str:
        """Set a node's consumer and its reaction; return why it failed, or ""."""
        objects = SdoClient(self._port, node)
        try:
            # A drive may watch its master only in NMT operational, like the TMCM-1636.
            self._port.send(NMT, bytes((START, node)))
            consumer = self._free_consumer(objects)
            if consumer is None:
                return "it has no heartbeat consumer (1016h) that is free"
            assert self._heartbeats is not None
            self._heartbeats.send()
            watch = self._heartbeats.node_id << 16 | round(1e3 * SILENCE)
            self._change(node, objects, consumer, watch.to_bytes(4, "little"))
            if self._read(objects, ERROR_BEHAVIOUR) == bytes((STAYS,)):
                self._change(node, objects, ERROR_BEHAVIOUR, b"\0")
            for axis in range(MAX_AXES):
                option = (cia402.ABORT_CONNECTION_OPTION + cia402.AXIS_OFFSET * axis, 0)
                if self._read(objects, option) == NO_ACTION.to_bytes(2, "little"):
                    self._change(node, objects, option, QUICK_STOP.to_bytes(2, "little"))
                option = (cia402.QUICK_STOP_OPTION + cia402.AXIS_OFFSET * axis, 0)
                if self._read(objects, option) == COASTS.to_bytes(2, "little"):
                    self._change(node, objects, option, RAMPS.to_bytes(2, "little"))
        except (BusError, ObjectAccessError) as error:
            return str(error)
        return ""

    def _free_consumer(self, objects: SdoClient) -> Key | None:
        for sub in range(1, MOST_CONSUMERS + 1):
            found = self._read(objects, (CONSUMERS, sub))
            if found is None:
                return None
            if int.from_bytes(found[:2], "little") == 0 or found[2] & 0x7F == 0:
                return CONSUMERS, sub
        return None

    def _read(self, objects: SdoClient, key: Key) -> bytes | None:
        """Return an object's bytes, None if the node lacks it."""
        try:
            return objects.read(*key, f"{key[0]:04X}h:{key[1]:02X}", self._timeout)
        except ObjectAccessError:
            return None

    def _change(self, node: int, objects: SdoClient, key: Key, data: bytes) -> None:
        label = f"{key[0]:04X}h:{key[1]:02X}"
        before = objects.read(*key, label, self._timeout)[: len(data)]
        # Stored first: a lost answer does not show whether the write succeeded.
        self._before.setdefault(node, {})[key] = before
        objects.write(*key, data, label, self._timeout)
        if (found := objects.read(*key, label, self._timeout)[: len(data)]) != data:
            raise BusError(f"node {node} took {data.hex()} for {label} and has {found.hex()}")


def nodes_watched_by(frames: Iterable[Any]) -> tuple[set[int], dict[int, str]]:
    """Return the nodes whose watchdog the frames set, and those left without one, with the reason (0: all)."""
    own: set[int] = set()
    left: dict[int, str] = {}
    for frame in frames:
        can_id, data = frame.arbitration_id, bytes(frame.data)
        if can_id == NMT and len(data) == 2:
            if data[0] in RESETS:
                left[data[1]] = "the frames reset it, after which it watches no master"
            elif data[0] != START:
                left.setdefault(data[1], "the frames take it out of NMT operational, where it may watch no master")
            elif "operational" in left.get(data[1], ""):
                del left[data[1]]
            continue
        is_download = SDO_REQUEST < can_id < SDO_REQUEST + 0x80 and len(data) == 8 and data[0] & 0xE0 == 0x20
        if is_download and int.from_bytes(data[1:3], "little") in (CONSUMERS, GUARD_TIME, LIFE_FACTOR):
            own.add(can_id - SDO_REQUEST)
    return own, left
