"""The motors that replayed frames may have enabled: the addressed nodes, whether they are live, and their stop.

The frames only show which nodes may have obeyed them: whether an axis is live is read from its statusword.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any, NamedTuple

from drive_env import cia402
from drive_env.canopen.frames import EMCY, ERROR_CONTROL, NMT, RPDO, SDO_REQUEST, SDO_RESPONSE, TPDO
from drive_env.devices import device_names, find_device
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.dictionary.roles import Role
from drive_env.fieldbus.errors import BusError, NoAnswerError
from drive_env.fieldbus.link import ObjectClient
from drive_env.master.can.network import MAX_NODE, PRE_OPERATIONAL
from drive_env.master.can.port import Port
from drive_env.master.can.sdo import SdoClient

ANSWER_TIMEOUT = 0.5  # s
MAX_AXES = 8  # of a node (CiA 301: eight profile areas)
RAMP = 10.0  # s, the longest quick stop, measured or expected
JUDGED_AFTER = 0.5  # s after which a ramp is judged by its deceleration
LOOK = 0.05  # s between two reads of a position
REST = 0.005  # revolutions in that time: 6 rpm
REST_INC = 32  # increments in that time, if the revolution is unknown
AT_REST_LOOKS = 2  # in a row
OFF_TIME = 2.0  # s that a drive may take to switch off

Axis = tuple[int, int]  # node-ID, number of the axis in it


class Stopped(NamedTuple):
    """An axis that was live when the frames ended.

    Attributes:
        node, axis: The axis.
        statusword: 6041h afterwards.
        cut: Why its voltage was switched off while it turned; "" if it came to rest by its quick stop.
    """

    node: int
    axis: int
    statusword: int
    cut: str

    def __str__(self) -> str:
        how = "stopped by its quick stop, at rest"
        if self.cut:
            how = f"its voltage was switched off while it turned: {self.cut}"
        return f"{name((self.node, self.axis))} was left enabled by the frames: {how}; off ({self.statusword:04X}h)"


class ReplayedMotors:
    """The drives that receive the replayed frames.

    Args:
        port: The bus.
        frames: Frames to send (python-can messages).
        timeout: Longest wait for an answer [s].
    """

    def __init__(self, port: Port, frames: Iterable[Any], timeout: float = ANSWER_TIMEOUT) -> None:
        self._port = port
        self._timeout = timeout
        self._nodes = nodes_spoken_to(frames)
        self._there: set[int] = set()  # nodes that were heard
        self._no_drives: set[int] = set()  # nodes that answer without a statusword

    def check_none_is_live(self) -> None:
        """Raise BusError for a node that another master has enabled."""
        status = self._statuswords(self._nodes)
        live = [f"{name(axis)} ({word:04X}h)" for axis, word in status.items() if cia402.is_live(word)]
        if live:
            raise BusError(
                f"{', '.join(live)} is enabled already, so another master controls it; no frame was sent. Stop that "
                f"master, or stop the axis: drive-env set 6040 2 --node {live[0].split()[1]}, then 0"
            )

    def listen(self) -> None:
        """Begin to note the nodes that are heard."""
        for node in self._nodes:
            for base in (EMCY, *TPDO, SDO_RESPONSE, ERROR_CONTROL):
                self._port.subscribe(base + node, partial(self._hear, node))

    def drives(self) -> list[int]:
        """Return the nodes that were heard and have a statusword."""
        return sorted(self._there - self._no_drives)

    def stop(self) -> tuple[list[Stopped], list[str]]:
        """Stop live axes: quick stop, off at rest, and a check of the statusword.

        Returns the axes that were live, and texts about those that could not be proved off.
        """
        stopped: list[Stopped] = []
        unproven: list[str] = []
        # Known nodes answer at once; no motor may run on while others are waited for.
        for nodes in (sorted(self._there), [node for node in self._nodes if node not in self._there]):
            known = bool(self._there.intersection(nodes))
            try:
                status = self._statuswords(nodes)
                silent = [node for node in nodes if known and (node, 0) not in status and node not in self._no_drives]
                if silent:  # stopped (NMT), where it answers no SDO, or its answer was lost
                    for node in silent:
                        self._port.send(NMT, bytes((PRE_OPERATIONAL, node)))
                    status |= self._statuswords(silent)
            except BusError as error:
                unproven += [f"{error}: the motors of node {_list(nodes)} may be running"] if known else []
                continue
            unproven += [
                f"node {node} does not answer any more: its motor may be running"
                for node in nodes
                if known and (node, 0) not in status and node not in self._no_drives
            ]
            live = [axis for axis, word in status.items() if cia402.is_live(word)]
            clients = {node: SdoClient(self._port, node) for node, _ in live}
            for outcome in stop_axes(self._port, clients, live, self._timeout):
                if isinstance(outcome, Stopped):
                    stopped.append(outcome)
                else:
                    unproven.append(outcome)
        return sorted(stopped), unproven

    # --- inside ---------------------------------------------------------------------------------------------------
    def _hear(self, node: int, data: bytes) -> None:
        self._there.add(node)

    def _statuswords(self, nodes: Iterable[int]) -> dict[Axis, int]:
        """Return 6041h of every axis of the nodes that answer, with all nodes asked in parallel."""
        found: dict[Axis, int] = {}
        asked = list(nodes)
        for part in range(MAX_AXES):
            if not asked:
                break
            answers = self._ask(asked, cia402.STATUSWORD + cia402.AXIS_OFFSET * part)
            self._there |= answers.keys()
            words = {node: word for node, word in answers.items() if word is not None}
            if part == 0:
                self._no_drives |= answers.keys() - words.keys()
            found |= {(node, part): word for node, word in words.items()}
            asked = list(words)
        return found

    def _ask(self, nodes: Iterable[int], index: int) -> dict[int, int | None]:
        """Read an object of nodes; return the answers, None for a node without that object."""
        answers: dict[int, int | None] = {}

        def take(node: int, data: bytes) -> None:
            if len(data) == 8 and struct.unpack_from("<HB", data, 1) == (index, 0):
                answers[node] = int.from_bytes(data[4:6], "little") if data[0] & 0xE0 == 0x40 else None

        asked = list(nodes)
        self._port.drain()
        for node in asked:
            self._port.subscribe(SDO_RESPONSE + node, partial(take, node))
            self._port.send(SDO_REQUEST + node, struct.pack("<BHB4x", 0x40, index, 0))
        self._port.wait(lambda: len(answers) == len(asked), self._timeout)
        return answers


def stop_axes(
    port: Port, clients: Mapping[int, ObjectClient], axes: Sequence[Axis], timeout: float
) -> list[Stopped | str]:
    """Quick-stop axes, all at once, and switch each off at rest; return how each ended, or why it is not off.

    Args:
        port: The bus.
        clients: The clients of their nodes.
        axes: Axes that may be live.
        timeout: Longest wait for an answer [s].
    """
    stops = [_Stop(port, clients[axis[0]], axis, timeout) for axis in axes]
    for stop in stops:  # all of them first
        stop.begin()
    for stop in stops:
        stop.read_scale()
    while True:
        for stop in stops:
            if stop.outcome is None:
                stop.look()
        if all(stop.outcome is not None for stop in stops):
            return [stop.outcome for stop in stops if stop.outcome is not None]
        time.sleep(LOOK)


class _Stop:
    """The stop of one axis; it continues after a lost answer."""

    def __init__(self, port: Port, sdo: ObjectClient, axis: Axis, timeout: float) -> None:
        self._port, self._sdo, self._axis, self._timeout = port, sdo, axis, timeout
        self._offset = cia402.AXIS_OFFSET * axis[1]
        self._rest = REST_INC
        self._start = self._last = time.monotonic()
        self._position: int | None = None
        self._first_speed: float | None = None  # [inc/s]
        self._speed = 0.0
        self._quiet = 0
        self._cut = ""
        self._off_since: float | None = None
        self._error = ""
        self.outcome: Stopped | str | None = None

    def begin(self) -> None:
        """Command the quick stop."""
        self._write(cia402.QUICK_STOP)
        self._start = time.monotonic()

    def read_scale(self) -> None:
        """Read the position scale, which defines the distance that counts as rest."""
        for index, sub in _scales():
            scale = self._read(index + (self._offset if index in cia402.PROFILE_AREAS else 0), sub)
            if scale:
                self._rest = max(REST_INC, round(REST * scale))
                break

    def look(self) -> None:
        """Read statusword and position, and take the next step of the stop."""
        now = time.monotonic()
        word = self._read(cia402.STATUSWORD + self._offset)
        if word is not None and not cia402.is_live(word):
            self.outcome = Stopped(*self._axis, word, self._cut)
            return
        if self._off_since is not None:
            if now - self._off_since > OFF_TIME + self._timeout:
                self.outcome = (
                    f"{name(self._axis)} is not off: "
                    + (self._error if word is None else f"its statusword stays {word:04X}h")
                    + "; its motor may be running: use the emergency stop"
                )
                return
            self._write(cia402.DISABLE_VOLTAGE)
            return
        if word is not None and cia402.matches(word, cia402.OPERATION_ENABLED):
            self._write(cia402.QUICK_STOP)  # the first may have been lost
        if self._is_at_rest(now) or self._is_to_be_cut(now):
            self._off_since = now
            self._write(cia402.DISABLE_VOLTAGE)

    def _is_at_rest(self, now: float) -> bool:
        position = self._read(cia402.POSITION_ACTUAL + self._offset)
        if position is None:
            return False
        if self._position is not None:
            way = abs((position - self._position + 2**31) % 2**32 - 2**31)
            self._quiet = self._quiet + 1 if way <= self._rest else 0
            self._speed = way / max(now - self._last, 1e-3)
            if self._first_speed is None:
                self._first_speed = self._speed
        self._position, self._last = position, now
        return self._quiet >= AT_REST_LOOKS

    def _is_to_be_cut(self, now: float) -> bool:
        """Return whether the ramp will not end in time: by the clock, or by its deceleration so far."""
        since = now - self._start
        if since > RAMP:
            self._cut = f"it was not at rest after {RAMP:g} s of its quick stop"
        elif since > JUDGED_AFTER and self._first_speed is not None and not self._quiet:
            lost = self._first_speed - self._speed
            if lost <= 0.0 or self._speed / lost * since > RAMP:
                self._cut = f"its quick stop did not slow it down within {since:.1f} s (see 605Ah, 6085h)"
        return bool(self._cut)

    def _read(self, index: int, sub: int = 0) -> int | None:
        with self._tried():
            return int.from_bytes(self._sdo.read(index, sub, f"{index:04X}h:{sub:02X}", self._timeout)[:4], "little")
        return None

    def _write(self, controlword: int) -> None:
        index = cia402.CONTROLWORD + self._offset
        data = controlword.to_bytes(2, "little")
        with self._tried():
            self._sdo.write(index, 0, data, f"{controlword} to {index:04X}h:00", self._timeout)

    @contextmanager
    def _tried(self) -> Iterator[None]:
        """Continue after an error; a silent node may be stopped (NMT) since it misses its master: wake it."""
        try:
            yield
        except (BusError, ObjectAccessError) as error:
            self._error = str(error)
            if isinstance(error, NoAnswerError):
                with suppress(BusError):
                    self._port.send(NMT, bytes((PRE_OPERATIONAL, self._axis[0])))


def nodes_spoken_to(frames: Iterable[Any]) -> tuple[int, ...]:
    """Return the nodes that may obey frames; for a PDO that may be any node, by its mapping."""
    nodes: set[int] = set()
    for frame in frames:
        can_id, data = frame.arbitration_id, bytes(frame.data)
        if (can_id == NMT and len(data) == 2 and data[1] == 0) or any(base < can_id < base + 0x80 for base in RPDO):
            return tuple(range(1, MAX_NODE + 1))
        if can_id == NMT and len(data) == 2:
            nodes.add(data[1])
        elif SDO_REQUEST < can_id < SDO_REQUEST + 0x80:
            nodes.add(can_id - SDO_REQUEST)
    return tuple(sorted(nodes & set(range(1, MAX_NODE + 1))))


def name(axis: Axis) -> str:
    """Return an axis' name for a line."""
    node, part = axis
    return f"node {node}" + (f" axis {part}" if part else "")


def _list(nodes: Iterable[int]) -> str:
    return ", ".join(map(str, nodes))


def _scales() -> list[tuple[int, int]]:
    """Return the objects that may hold the scale of positions: the standard's, and those of the known devices."""
    roles = [find_device(name).roles for name in device_names()]
    own = {each[Role.POSITION_SCALE] for each in roles if Role.POSITION_SCALE in each}
    return [(cia402.ENCODER_RESOLUTION, 1), *sorted(own)]
