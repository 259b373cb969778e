"""The link over EtherCAT: objects by the mailbox, process data in images, states Pre-Op to Op (ETG.1000)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import cached_property, partial

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.ethercat import registers
from drive_env.ethercat.application import AlState
from drive_env.fieldbus.description import Description
from drive_env.fieldbus.errors import BusError, NoAnswerError
from drive_env.fieldbus.link import ObjectClient, ReceivedEmergency, Wording
from drive_env.master.ethercat.clocks import FramePhase, check_clocks
from drive_env.master.ethercat.ethercat_master import EtherCatMaster, Sync0
from drive_env.master.ethercat.image_data import FRAME, EtherCatProcessData
from drive_env.master.ethercat.process_watchdog import FACTORY, ProcessWatchdog
from drive_env.master.ethercat.slave_objects import SlaveObjects
from drive_env.master.ethercat.state_names import state_name

TIME_LOOK = 0.012  # s during which a drive in lockstep must not move on
BOOT = 10.0  # s for a slave that is reset to come back
LOOK = 0.001  # s


class OtherEtherCatMasters:
    """Detects another master of the slaves: their states are not those that this one set."""

    def __init__(self, link: EtherCatLink) -> None:
        self._link = link

    def check(self) -> None:
        """Raise BusError if a slave is in another state than the one set by this program."""
        link = self._link
        given = AlState.PRE_OP if link.process.missing else AlState.OP
        for position, now in zip(link.nodes, link.states(), strict=True):
            if now != given:
                raise BusError(
                    f"position {position} is in {state_name(now)}, and this program took it to {state_name(given)}: "
                    "another master uses the segment, or the slave has left Op by itself; end the other master, or "
                    "see the slave's AL status code with `drive-env scan`"
                )


class EtherCatLink:
    """Slaves of one device on a segment.

    Args:
        master: The segment's master; closed by `close`, and if the constructor fails.
        nodes: Positions of the slaves.
        description: Their device.
        lockstep: Time passes only with frames of process data.
        sync0: Outputs take effect with SYNC0 of the distributed clocks, once in each of the description's cycles; for
            devices that use SYNC1, with SYNC1 at the same times.

    Raises:
        BusError: If there are no slaves, or fewer than named.
    """

    is_dry = False
    wording = Wording("Op", "check cable and power, and whether another master uses the segment", "process data")

    def __init__(
        self,
        master: EtherCatMaster,
        nodes: Sequence[int],
        description: Description,
        lockstep: bool,
        sync0: bool = False,
    ) -> None:
        self.nodes = tuple(nodes)
        self._master = master
        self._description = description
        self._lockstep = lockstep
        self._alive: Callable[[], None] = lambda: None
        self._restarted: Callable[[int], None] = lambda node: None
        self._frame = description.answer_timeout if lockstep else FRAME
        known = None if description.device is None else description.device.ethercat
        both = known is not None and known.uses_sync1
        master.clock = Sync0(description.cycle, lockstep, both) if sync0 else None
        try:
            count = master.begin()
            beyond = [position for position in self.nodes if position >= count]
            if beyond:
                raise BusError(
                    f"there is no position {beyond[0]}: {count} slave{'s answer' if count > 1 else ' answers'}; count "
                    "from 0, or look with `drive-env scan`"
                )
            if sync0:
                check_clocks(master, range(count))
        except BaseException:
            master.close()
            raise
        self.process = EtherCatProcessData(master, self.nodes, description, lockstep)
        master.alive = self._while_waiting
        self.process.phase = FramePhase(description.cycle) if sync0 else None
        words = _controlwords(description)
        self._clients: list[ObjectClient] = [
            SlaveObjects(master, k, position, self.process, words, self.start, partial(self.wake, k), lockstep)
            for k, position in enumerate(self.nodes)
        ]
        self.process.connect(self._clients)

    @cached_property
    def watch(self) -> ProcessWatchdog:
        """The slaves' watchdogs."""
        return ProcessWatchdog(self._master, self.nodes, self._clients, self.process, self._description)

    def hear(self, alive: Callable[[], None], restarted: Callable[[int], None]) -> None:
        """Set callbacks: `alive` while an answer is waited for, `restarted` for a node that booted unasked."""
        self._alive, self._restarted = alive, restarted

    # --- objects and states -----------------------------------------------------------------------------------------
    def sdo(self, node: int) -> ObjectClient:
        """Return the client for a node's objects."""
        return self._clients[node]

    def wake(self, node: int) -> None:
        """Take a node to a state in which its mailbox answers."""
        status = self._master.status(self.nodes[node])
        if status.state not in (AlState.PRE_OP, AlState.SAFE_OP, AlState.OP):
            self._recover(node)

    def welcome(self, node: int) -> None:
        """Do nothing: the link has read a node's data from its EEPROM."""

    def start(self, nodes: Sequence[int] | None = None) -> None:
        """Take nodes to Op, for None all of them; nodes that have lost their images get them anew.

        Raises:
            BusError: If one does not reach Op, or another one has lost its images; NoAnswerError if it does not answer.
        """
        chosen = range(len(self.nodes)) if nodes is None else nodes
        if others := [self.nodes[k] for k in self.process.missing if k not in chosen and nodes is not None]:
            raise BusError(f"position {others[0]} has no images either, which go out in one frame; start all positions")
        with self.process.turn:
            for k in chosen:
                position = self.nodes[k]
                status = self._master.status(position)
                if k in self.process.missing:
                    self._recover(k)
                elif status.state not in (AlState.SAFE_OP, AlState.OP):
                    self.process.forget([k])
                    self._recover(k)
            if self.process.missing:
                self.process.prepare()
        if waiting := tuple(self.nodes[k] for k in chosen if not self._master.status(self.nodes[k]).is_op):
            self.process.operate(waiting)

    def reset(self, nodes: Sequence[int]) -> None:
        """Restart nodes by the reset sequence of their controllers (0040h), and wait until they are back.

        Raises:
            NoAnswerError: If one does not come back; BusError if it does not restart.
        """
        for k in nodes:
            position = self.nodes[k]
            for letter in b"RES":
                self._master.write_register(position, registers.RESET, bytes((letter,)))
            if self._master.status(position).state not in (0, AlState.INIT):
                raise BusError(f"position {position} does not restart by its reset register; switch it off and on")
            self.process.forget([k])
            self._await_boot(k)

    def states(self) -> list[int]:
        """Read the present states of the nodes."""
        return [self._master.status(position).state for position in self.nodes]

    def take_emergencies(self) -> list[ReceivedEmergency]:
        """Return and forget the received emergencies, in their order."""
        return [one for one in self._master.take_emergencies() if one.node in self.nodes]

    def time_passes(self) -> bool | None:
        """Return whether the first slave's clock runs while no process data are exchanged; None without a clock."""
        before = self._master.register(self.nodes[0], registers.SYSTEM_TIME, 8)
        time.sleep(TIME_LOOK)
        after = self._master.register(self.nodes[0], registers.SYSTEM_TIME, 8)
        return None if before is None or after is None else before != after

    def other_masters(self) -> OtherEtherCatMasters:
        """Begin to look for other masters."""
        return OtherEtherCatMasters(self)

    # --- cycles -----------------------------------------------------------------------------------------------------
    def hand_out(self, words: Sequence[tuple[int, Key, bytes]]) -> None:
        """Put controlwords of several axes into the images, all of which go out in one frame.

        By separate transfers, some frames apart, one axis would turn before its twin is held. In lockstep such
        transfers take no time.
        """
        if any(cia402.may_enable(int.from_bytes(data, "little")) for _, _, data in words):
            self.start()
        with self.process.turn:
            before = [self.process.put(node, key, data) for node, key, data in words]
            if not self._lockstep and any(one is not None for one in before):
                self.process.exchange(is_cycle=False)

    def sync(self) -> None:
        """Exchange the images of a cycle, and before it those that did not come back."""
        self.process.owed += 1
        self.process.settle(self._frame)

    def receive(self, timeout: float = 0.0) -> bool:
        """Wait: images return only with the exchange."""
        if timeout > 0.0:
            time.sleep(timeout)
        return False

    def wait(self, done: Callable[[], bool], timeout: float) -> bool:
        """Exchange lost images of a cycle again, until `done()` is true or `timeout` [s] has passed; return done()."""
        deadline = time.monotonic() + timeout
        while not done():
            if time.monotonic() > deadline:
                return False
            if not self.process.settle(self._frame):
                time.sleep(LOOK)
        return True

    def drain(self) -> None:
        """Do nothing: answers come with the exchange."""

    def close(self) -> None:
        """Take all slaves to Init and close the segment."""
        self._master.close()

    # --- inside -----------------------------------------------------------------------------------------------------
    def _while_waiting(self) -> None:
        """Reset the stall timer of the program, and feed the watchdogs while it waits."""
        self._alive()
        if self._lockstep or time.monotonic() - self.process.exchanged_at <= FACTORY / 3.0:
            return
        # The thread that holds the images may be waiting for this mailbox; this one must not wait for the images.
        if self.process.turn.acquire(blocking=False):
            try:
                self.process.exchange(is_cycle=False)
            finally:
                self.process.turn.release()

    def _recover(self, node: int) -> None:
        """Take a node to Pre-Op; report one that has restarted by itself."""
        if self._master.recover(self.nodes[node]):
            self.process.forget([node])
            self._restarted(node)

    def _await_boot(self, node: int) -> None:
        deadline = time.monotonic() + BOOT
        while True:
            try:
                self._master.recover(self.nodes[node])
                return
            except NoAnswerError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(LOOK)


def _controlwords(description: Description) -> set[Key]:
    if not description.has((cia402.CONTROLWORD, 0)):
        return set()
    entry = description.dictionary.find((cia402.CONTROLWORD, 0))
    return {description.key(entry, axis) for axis in range(description.num_axes)}
