"""A fieldbus as drives need it: objects of its nodes, process data, cycles, states, and a watch over the master.

`BusDrives`, the safety envelope and the tools ask a link for these and know no fieldbus. CAN is one
(`can/can_link.py`); another one is a class with these methods and a constructor like `CanDrives`.

Nodes are counted from 0, in the order of `Link.nodes`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol

from drive_env.cia402 import Key
from drive_env.dictionary.entries import Entry
from drive_env.fieldbus.errors import BusError, NoAnswerError
from mechanics.arrays import Integers


class NoWatchdogError(BusError):
    """A drive cannot watch over its master; the message gives the reason and the remedy."""


class ReceivedEmergency(NamedTuple):
    """An emergency message of a node, which is named by its address."""

    node: int
    code: int
    error_register: int
    extra: tuple[int, ...]


class Wording(NamedTuple):
    """Names of things on a link, for messages.

    Attributes:
        operational: The state in which nodes exchange process data.
        check_samples: What to check where a node was started and sends none.
        sign_of_life: What the nodes hear of their master, in the plural.
    """

    operational: str
    check_samples: str
    sign_of_life: str


class Timing(NamedTuple):
    """How punctual the SYNCs of a run were: their number, those more than a cycle late, the worst lateness [s]."""

    cycles: int
    late: int
    worst: float


class ObjectReader(Protocol):
    """Reads objects of a node, as bytes."""

    def read(self, index: int, sub: int, label: str, timeout: float) -> bytes:
        """Return the bytes of an object.

        Raises:
            ObjectAccessError: With the abort code, if the drive refuses.
            NoAnswerError: If it does not answer; one try may take `timeout` [s].
        """


class ObjectClient(ObjectReader, Protocol):
    """Reads and writes objects of a node, as bytes; one transfer at a time."""

    def write(self, index: int, sub: int, data: bytes, label: str, timeout: float) -> None:
        """Write the bytes of an object, once: a repeated write may mean something else.

        Raises:
            ObjectAccessError: With the abort code, if the drive refuses.
            NoAnswerError: If it does not answer within `timeout` [s]; the drive may have taken the value or not.
        """

    def put_back(self, index: int, sub: int, data: bytes, label: str, timeout: float) -> None:
        """Write an object's value of before; a silent node is woken and gets more time to answer.

        Raises:
            ObjectAccessError, NoAnswerError: As `write` does.
        """

    def ask(self, index: int, sub: int, timeout: float) -> bytes | None:
        """Return the bytes of a short object if they come within `timeout` [s], the wait for one's turn included."""

    def command(self, index: int, sub: int, data: bytes) -> None:
        """Send a short write without waiting: neither for an answer nor for a transfer that is under way.

        Raises:
            BusError: If the bus does not take it.
        """


class Outputs(Protocol):
    """Rows of process data that go into the drives, ready to be sent."""

    def send(self, row: int) -> None:
        """Hand out a row: the drives take it when the next cycle begins, once.

        What is written to an object afterwards stays, so a link that repeats its last image must follow such writes.
        """


class Samples(Protocol):
    """Process data that come out of the drives in a run of cycles; row k belongs to its k-th cycle."""

    def complete(self) -> int:
        """Return how many rows are complete."""

    def decode(self, first: int, last: int) -> dict[Key, Integers]:
        """Return rows `first` to `last` (excluded), each object of shape (rows, num_axes).

        Raises:
            BusError: If what came is not what is mapped.
        """

    def missing(self, rows: int, timeout: float) -> NoAnswerError:
        """Return the error for samples that stay out, of so many cycles and after so long a wait [s]."""

    def close(self) -> None:
        """Take nothing more."""


class ProcessData(Protocol):
    """Which objects the nodes exchange in every cycle.

    Attributes:
        mapping: Its number: it grows with every change.
    """

    mapping: int

    def check_sampled(self, entries: Sequence[Entry]) -> None:
        """Raise ObjectAccessError 06040041h for an object that cannot come with every cycle."""

    def check_played(self, entries: Sequence[Entry]) -> None:
        """Raise ObjectAccessError 06040041h for an object that cannot be sent with every cycle."""

    def choose(
        self, wanted: Sequence[Entry], welcome: Sequence[Entry], played: Sequence[Entry] = ()
    ) -> tuple[Entry, ...]:
        """Return the objects to sample: the wanted ones, then as many of the welcome ones, in their order, as fit.

        Args:
            wanted: To be sampled.
            welcome: If there is room for it.
            played: What goes into the drives meanwhile.

        Raises:
            ObjectAccessError: 06040042h if not even what is wanted fits.
        """

    def is_mapped(self, played: tuple[Entry, ...], sampled: tuple[Entry, ...]) -> bool:
        """Return whether cycles carry these already: exactly the played ones, if any are, and at least the samples."""

    def map(self, played: tuple[Entry, ...], sampled: tuple[Entry, ...]) -> None:
        """Have cycles carry entries of every axis; the mapping into the drives stays if nothing is played.

        Raises:
            ObjectAccessError: If they do not fit or a drive refuses them.
        """

    def sampled_entries(self) -> tuple[Entry, ...]:
        """Return the objects that come with every cycle."""

    def outputs(self, played: Mapping[Entry, Integers]) -> Outputs | None:
        """Return rows to send, of integers of shape (cycles, num_axes) for all mapped objects; None without any."""

    def samples(self) -> Samples | None:
        """Begin to collect what is mapped out of the drives. None if nothing is mapped, or in a dry run."""

    def forget(self, nodes: Sequence[int]) -> None:
        """Forget the configuration of nodes that have restarted: nothing counts as mapped."""

    def restore(self, node: int) -> None:
        """Put a node's configuration back as it was found.

        Raises:
            BusError: If not all of it could be.
        """


class MasterWatch(Protocol):
    """How the nodes notice that this process is dead, and stop their drives by themselves."""

    @property
    def detection_time(self) -> float:
        """The silence after which every node has noticed [s]; infinite while they do not watch."""

    def begin(self, silence: float) -> None:
        """Have every node act when its master falls silent for `silence` [s], or less, and begin to be heard.

        Raises:
            NoWatchdogError: If a drive cannot, or watches over another master that lives.
            BusError: If a node does not answer.
        """

    def keep(self) -> None:
        """Send a sign of life if it is due. The supervisor's thread calls this every few milliseconds.

        Images that come back here are not samples of a run.
        """

    def cease(self) -> None:
        """Send a last heartbeat and stop, so that each node's watchdog expires and the drives stop by themselves.

        Called again after nodes were started that had missed this process.
        """

    def end(self) -> None:
        """Stop the signs of life, since the watchdogs are given up or were not wanted."""

    def is_set(self, node: int) -> bool:
        """Return whether a node's watchdog was set and not put back."""

    def is_in_force(self, node: int) -> bool:
        """Return whether a node, asked, still watches over this master.

        Raises:
            BusError: If it does not answer.
        """

    def holds(self, key: Key) -> bool:
        """Return whether the watchdogs in force depend on an object, so that the program must not change it."""

    def restore(self, node: int) -> None:
        """Put a node's watchdog back as it was found. The caller has proved that its axes are off.

        Raises:
            BusError: If the node did not take all of it.
        """

    def forget(self, node: int) -> None:
        """Forget the watchdog found: the node was reset."""

    def take_rival(self) -> str:
        """Return, once, which other program keeps the nodes from noticing this one's death; "" if none does."""


class OtherMastersHeard(Protocol):
    """Tells whether another master commands the nodes."""

    def check(self) -> None:
        """Raise BusError, with the frame that was heard, if one does."""


class Link(Protocol):
    """A fieldbus with the nodes of some drives.

    Time passes by the clock, or by cycles alone (lockstep), as the drives' pace says: the link sends a cycle
    whenever `sync` is called.
    """

    @property
    def nodes(self) -> tuple[int, ...]:
        """The nodes' addresses."""

    @property
    def is_dry(self) -> bool:
        """Whether this is a dry run: frames are printed, and no drive is connected."""

    @property
    def wording(self) -> Wording:
        """Names of things here, for messages."""

    @property
    def process(self) -> ProcessData:
        """The nodes' process data."""

    @property
    def watch(self) -> MasterWatch:
        """The nodes' watch over this master."""

    def hear(self, alive: Callable[[], None], restarted: Callable[[int], None]) -> None:
        """Set the callbacks.

        Args:
            alive: Called again and again while an answer is waited for.
            restarted: Called with a node that booted unasked.
        """

    # --- objects and states -----------------------------------------------------------------------------------------
    def sdo(self, node: int) -> ObjectClient:
        """Return the client for a node's objects."""

    def wake(self, node: int) -> None:
        """Have a node answer about its objects that may be stopped, as it is after a master died."""

    def welcome(self, node: int) -> None:
        """Note that a node is there and is of the expected kind; read what the link must know of it."""

    def start(self, nodes: Sequence[int] | None = None) -> None:
        """Take nodes to where they exchange process data; None takes all of them."""

    def reset(self, nodes: Sequence[int]) -> None:
        """Restart nodes as after power-on, and wait until they are back.

        Raises:
            NoAnswerError: If one does not come back.
        """

    def take_emergencies(self) -> list[ReceivedEmergency]:
        """Return and forget the emergencies that came, in their order."""

    def time_passes(self) -> bool | None:
        """Look whether time passes in the nodes while no cycle is sent, as it must not in lockstep.

        Returns:
            None where nothing tells it.

        Raises:
            BusError: If a node does not answer.
        """

    def other_masters(self) -> OtherMastersHeard:
        """Begin to listen for other masters."""

    # --- cycles -----------------------------------------------------------------------------------------------------
    def hand_out(self, words: Sequence[tuple[int, Key, bytes]]) -> None:
        """Have controlwords of several axes act in one cycle, as far as the bus can: axes may share a load.

        Each is written by a transfer of its own afterwards, which follow one another.

        Args:
            words: Of each axis its node, the object there and the bytes that it gets.
        """

    def sync(self) -> None:
        """Begin a cycle: the drives take the values handed out since the one before, and sample.

        Raises:
            BusError: If the bus does not take it.
        """

    def receive(self, timeout: float = 0.0) -> bool:
        """Wait up to `timeout` [s] for something to come, and take it; return whether something did.

        Raises:
            BusError: If the bus is gone.
        """

    def wait(self, done: Callable[[], bool], timeout: float) -> bool:
        """Receive until `done()` or until `timeout` [s] has passed; return done()."""

    def drain(self) -> None:
        """Process the received frames, without waiting."""

    def close(self) -> None:
        """Let go of the bus."""
