"""Protocol of a fieldbus: objects of its nodes, process data, cycles, states, and a watch over the master.

`BusDrives`, the safety envelope and the tools use a link and know no fieldbus. CAN is one (`can/can_link.py`); another
one is a class with these methods and a constructor like `CanDrives`.

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
    """A drive cannot watch its master; the message gives the reason and the remedy."""


class ReceivedEmergency(NamedTuple):
    """An emergency message of a node, given by its address."""

    node: int
    code: int
    error_register: int
    extra: tuple[int, ...]


class Wording(NamedTuple):
    """Names of things on a link, for messages.

    Attributes:
        operational: The state in which nodes exchange process data.
        check_samples: What to check if a started node sends no samples.
        sign_of_life: The master's messages that the nodes watch for, in the plural.
    """

    operational: str
    check_samples: str
    sign_of_life: str


class Timing(NamedTuple):
    """Punctuality of the SYNCs of a run: their number, those more than a cycle late, the worst lateness [s]."""

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
            NoAnswerError: If it does not answer within `timeout` [s]; the drive may or may not have applied the value.
        """

    def put_back(self, index: int, sub: int, data: bytes, label: str, timeout: float) -> None:
        """Write an object's previous value; a silent node is woken and gets more time to answer.

        Raises:
            ObjectAccessError, NoAnswerError: As `write` does.
        """

    def ask(self, index: int, sub: int, timeout: float) -> bytes | None:
        """Return the bytes of a short object; None after `timeout` [s], which include the wait for one's turn."""

    def command(self, index: int, sub: int, data: bytes) -> None:
        """Send a short write without waiting, neither for its answer nor for the transfer under way.

        Raises:
            BusError: If the bus does not accept it.
        """


class Outputs(Protocol):
    """Rows of process data for the drives, ready to be sent."""

    def send(self, row: int) -> None:
        """Send a row: the drives apply it when the next cycle begins, once.

        A later write to one of its objects must stay in force, so a link that repeats its last image must follow such
        writes.
        """


class Samples(Protocol):
    """Process data from the drives in a run of cycles; row k belongs to its k-th cycle."""

    def complete(self) -> int:
        """Return how many rows are complete."""

    def decode(self, first: int, last: int) -> dict[Key, Integers]:
        """Return rows `first` to `last` (excluded), each object of shape (rows, num_axes).

        Raises:
            BusError: If the received data do not fit the mapping.
        """

    def missing(self, rows: int, timeout: float) -> NoAnswerError:
        """Return the error for samples of `rows` cycles that did not come within `timeout` [s]."""

    def close(self) -> None:
        """Stop collecting."""


class ProcessData(Protocol):
    """The objects that the nodes exchange in every cycle.

    Attributes:
        mapping: Number of the mapping, which grows with every change.
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
            wanted: Objects to sample.
            welcome: Objects to sample if there is room.
            played: Objects that are sent to the drives meanwhile.

        Raises:
            ObjectAccessError: 06040042h if not even the wanted ones fit.
        """

    def is_mapped(self, played: tuple[Entry, ...], sampled: tuple[Entry, ...]) -> bool:
        """Return whether cycles already carry exactly the played entries (if any) and at least the sampled ones."""

    def map(self, played: tuple[Entry, ...], sampled: tuple[Entry, ...]) -> None:
        """Have cycles carry entries of every axis; the mapping to the drives stays if nothing is played.

        Raises:
            ObjectAccessError: If they do not fit or a drive refuses them.
        """

    def sampled_entries(self) -> tuple[Entry, ...]:
        """Return the objects that come with every cycle."""

    def outputs(self, played: Mapping[Entry, Integers]) -> Outputs | None:
        """Return rows to send, of integers of shape (cycles, num_axes) for all mapped objects; None without any."""

    def samples(self) -> Samples | None:
        """Begin to collect the objects mapped from the drives; None if nothing is mapped, or in a dry run."""

    def forget(self, nodes: Sequence[int]) -> None:
        """Forget the configuration of nodes that have restarted: nothing counts as mapped."""

    def before(self, node: int, key: Key) -> int | None:
        """Return the value that `restore` gives an object of a node; None for one that was not changed."""

    def restore(self, node: int) -> None:
        """Restore a node's configuration.

        Raises:
            BusError: If not all of it could be restored.
        """


class MasterWatch(Protocol):
    """The nodes' watch over this process: they notice its death, and stop their drives by themselves."""

    @property
    def detection_time(self) -> float:
        """The silence after which every node has noticed [s]; infinite while no watchdog is set."""

    def begin(self, silence: float) -> None:
        """Have every node act when its master falls silent for `silence` [s], or less, and begin to send signs of life.

        Raises:
            NoWatchdogError: If a drive cannot, or watches another master that is alive.
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
        """Stop the signs of life, since the watchdogs are given up or not wanted."""

    def is_set(self, node: int) -> bool:
        """Return whether a node's watchdog was set and not yet restored."""

    def is_in_force(self, node: int) -> bool:
        """Ask a node whether it still watches over this master, and return its answer.

        Raises:
            BusError: If the node does not answer.
        """

    def holds(self, key: Key) -> bool:
        """Return whether the watchdogs in force depend on an object; the program must not change it then."""

    def before(self, node: int, key: Key) -> int | None:
        """Return the value that `restore` gives an object of a node; None for one that was not changed."""

    def restore(self, node: int) -> None:
        """Restore a node's watchdog. The caller has proved that its axes are off.

        Raises:
            BusError: If the node did not accept all of it.
        """

    def forget(self, node: int) -> None:
        """Forget the watchdog's previous settings: the node was reset."""

    def take_rival(self) -> str:
        """Return, once, the other program that hides this one's death from the nodes; "" if none does."""


class OtherMastersHeard(Protocol):
    """Detects another master of the nodes."""

    def check(self) -> None:
        """Raise BusError, with the frame that was heard, if there is one."""


class Link(Protocol):
    """A fieldbus with the nodes of some drives.

    The drives' pace decides whether time passes by the clock or only with cycles (lockstep): the link begins a cycle
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
        """Names of things on this link, for messages."""

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
        """Make a node answer object requests even if it was stopped, say by its master's death."""

    def welcome(self, node: int) -> None:
        """Note that a node is there and of the expected kind; read the data that the link needs of it."""

    def start(self, nodes: Sequence[int] | None = None) -> None:
        """Make nodes operational, so that they exchange process data; None: all of them."""

    def reset(self, nodes: Sequence[int]) -> None:
        """Restart nodes as after power-on, and wait until they are back.

        Raises:
            NoAnswerError: If one does not come back.
        """

    def take_emergencies(self) -> list[ReceivedEmergency]:
        """Return and forget the received emergencies, in their order."""

    def time_passes(self) -> bool | None:
        """Return whether time passes in the nodes while no cycle is sent; in lockstep it must not.

        Returns:
            None if the nodes cannot show it.

        Raises:
            BusError: If a node does not answer.
        """

    def other_masters(self) -> OtherMastersHeard:
        """Begin to listen for other masters."""

    # --- cycles -----------------------------------------------------------------------------------------------------
    def hand_out(self, words: Sequence[tuple[int, Key, bytes]]) -> None:
        """Have controlwords of several axes act in one cycle, as far as the bus can: axes may share a load.

        Afterwards each one is also written by a separate transfer.

        Args:
            words: For each axis its node, the object there and the bytes to write.
        """

    def sync(self) -> None:
        """Begin a cycle: the drives apply the rows sent since the previous one, and sample.

        Raises:
            BusError: If the bus does not accept it.
        """

    def receive(self, timeout: float = 0.0) -> bool:
        """Wait up to `timeout` [s] for a message, and handle it; return whether one came.

        Raises:
            BusError: If the bus is gone.
        """

    def wait(self, done: Callable[[], bool], timeout: float) -> bool:
        """Receive until `done()` is true or `timeout` [s] has passed; return done()."""

    def drain(self) -> None:
        """Process the received frames, without waiting."""

    def close(self) -> None:
        """Close the bus."""
