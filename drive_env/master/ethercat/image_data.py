"""Process data over EtherCAT: one image per direction and slave, all of them in every frame.

An image persists from frame to frame: an object that is not played keeps its last value, and an SDO write to an object
of an image changes the image, too. The mapping can be changed only in Pre-Op, where no motor runs, so never while an
axis is enabled.

In lockstep time passes only with a frame of process data. Objects that no image can carry, or that would change the
mapping while an axis is enabled, are then read by SDO before each frame, since their values are those of the frame's
inputs.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.aborts import CANNOT_BE_MAPPED, WRONG_STATE, ObjectAccessError
from drive_env.dictionary.access import fits_pdo
from drive_env.dictionary.entries import Entry
from drive_env.fieldbus.description import Description
from drive_env.fieldbus.errors import NoAnswerError
from drive_env.fieldbus.link import ObjectClient
from drive_env.master.ethercat.clocks import FramePhase
from drive_env.master.ethercat.ethercat_master import EtherCatMaster, ImageSizes
from drive_env.master.ethercat.image_layout import INPUTS, OUTPUTS, ImageLayout, ImagePlanner
from drive_env.master.ethercat.slave_images import SlaveImages
from drive_env.master.packing import Member, unpack_rows
from mechanics.arrays import Integers

FRAME = 0.02  # s for a frame to return in real time
LONGEST_STATE = 5.0  # s


class ImageSamples:
    """Input images of a run of cycles."""

    def __init__(self, data: EtherCatProcessData, layout: ImageLayout, description: Description) -> None:
        self._data = data
        self._layout = layout
        self._description = description
        self.rows: list[list[bytes]] = []  # per cycle, the image of each slave
        data.takers.append(self.rows)

    def complete(self) -> int:
        """Return how many rows are complete."""
        return len(self.rows)

    def decode(self, first: int, last: int) -> dict[Key, Integers]:
        """Return rows `first` to `last` (excluded), each object of shape (rows, num_axes)."""
        values: dict[Key, Integers] = {}
        per_node, nodes = self._description.num_axes, len(self._data.images)
        for k in range(nodes):
            joined = b"".join(row[k] for row in self.rows[first:last])
            data = np.frombuffer(joined, np.uint8).reshape(last - first, self._layout.size)
            unpack_rows(values, data, self._layout.members, k * per_node, nodes * per_node)
        return values

    def missing(self, rows: int, timeout: float) -> NoAnswerError:
        """Return the error for samples of `rows` cycles that did not come within `timeout` [s]."""
        return NoAnswerError(
            f"{len(self.rows)} input images came in {rows} cycles, and no more within {timeout:g} s; check cable and "
            "power, and whether every drive is in Op",
            self._data.out_of_op(),
        )

    def close(self) -> None:
        """Stop collecting."""
        self._data.takers = [taker for taker in self._data.takers if taker is not self.rows]


class ImageRows:
    """Rows to play, ready to be put into the output images."""

    def __init__(self, data: EtherCatProcessData, layout: ImageLayout, played: Mapping[Entry, Integers]) -> None:
        self._data = data
        per_node = data.num_axes // len(data.images)
        self._parts: list[list[tuple[int, int, NDArray[np.uint8]]]] = [[] for _ in data.images]
        for k, parts in enumerate(self._parts):
            for member in layout.members:
                if member.entry in played:
                    column = np.ascontiguousarray(played[member.entry][:, k * per_node + member.axis], "<i8")
                    raw = column.view(np.uint8).reshape(-1, 8)[:, : member.size]
                    parts.append((member.start, member.start + member.size, raw))

    def send(self, row: int) -> None:
        """Put a row into the images, which are sent with the next cycle."""
        with self._data.turn:
            for image, parts in zip(self._data.images, self._parts, strict=True):
                for start, end, raw in parts:
                    image[start:end] = raw[row].tobytes()


class EtherCatProcessData:
    """The present mapping, and the exchange of images.

    Args:
        master: The segment's master.
        nodes: Positions of the slaves.
        description: Their device.
        lockstep: Time passes only with frames.

    Attributes:
        mapping: Number of the mapping, which grows with every change.
        turn: Held while images are written or exchanged.
        images: Output image of each slave.
        takers: The collectors of input images: rows of the images of all slaves.
        exchanged_at: When images last returned [s].
        owed: Rows of a run of cycles that have not returned.
        is_silent: Nothing may be sent any more, so that the drives stop by themselves.
        phase: Notes the reference's time with each exchange; None without distributed clocks.
    """

    def __init__(self, master: EtherCatMaster, nodes: Sequence[int], description: Description, lockstep: bool) -> None:
        self.mapping = 0
        self.turn = threading.RLock()
        self.images = [bytearray() for _ in nodes]
        self.takers: list[list[list[bytes]]] = []
        self.exchanged_at = 0.0
        self.owed = 0
        self.is_silent = False
        self.phase: FramePhase | None = None
        self.num_axes = len(nodes) * description.num_axes
        self._master = master
        self._nodes = tuple(nodes)
        self._description = description
        self._lockstep = lockstep
        self._planner = ImagePlanner(description)
        self._layouts: dict[int, ImageLayout] = {}
        self._places: dict[Key, tuple[int, int]] = {}
        self._beside: tuple[Entry, ...] = ()  # objects read by SDO before each frame, in lockstep
        self._ready: set[int] = set()  # slaves with the present mapping, by their number here
        self._modes: dict[tuple[int, Key], bytes] = {}  # last written modes, for drives whose 6060h cannot be read
        self._clients: list[ObjectClient] = []
        self._slaves: list[SlaveImages] = []

    def connect(self, clients: Sequence[ObjectClient]) -> None:
        """Store the clients of the slaves' objects."""
        self._clients = list(clients)
        self._slaves = [SlaveImages(client, self._description) for client in clients]

    # --- what is chosen ---------------------------------------------------------------------------------------------
    def check_sampled(self, entries: Sequence[Entry]) -> None:
        """Raise ObjectAccessError 06040041h for an object that cannot come with every cycle."""
        entries = [entry for entry in entries if not self._lockstep or entry.bits is None]
        self._check(entries, INPUTS, "recorded")

    def check_played(self, entries: Sequence[Entry]) -> None:
        """Raise ObjectAccessError 06040041h for an object that cannot be sent with every cycle."""
        self._check(entries, OUTPUTS, "played")
        self._planner.plan(OUTPUTS, entries, self._layout(OUTPUTS))

    def choose(
        self, wanted: Sequence[Entry], welcome: Sequence[Entry], played: Sequence[Entry] = ()
    ) -> tuple[Entry, ...]:
        """Return the wanted entries, and those of `welcome` that are in the same image.

        Raises:
            ObjectAccessError: 06040042h if not even the wanted ones fit.
        """
        fitting = self._fitting(wanted) if self._lockstep else wanted
        image = self._planner.plan(INPUTS, fitting, self._layout(INPUTS)).entries
        return (*wanted, *(entry for entry in welcome if entry in image and entry not in wanted))

    def is_mapped(self, played: tuple[Entry, ...], sampled: tuple[Entry, ...]) -> bool:
        """Return whether the exchanged images already carry these entries."""
        if self.missing or not self._carries(OUTPUTS, played):
            return False
        # an object that is no longer recorded is no longer read before each frame
        return set(sampled) - set(self._layouts[INPUTS].entries) == set(self._beside)

    def map(self, played: tuple[Entry, ...], sampled: tuple[Entry, ...]) -> None:
        """Have images carry entries of every axis in addition to their present ones, as far as there is room.

        Raises:
            ObjectAccessError: 06040042h if they do not fit; 08000022h while an axis is enabled: the mapping can be
                changed only in Pre-Op, where no motor runs.
        """
        fitting = self._fitting(sampled) if self._lockstep else sampled
        if self._lockstep and self._is_any_enabled() and self._carries(OUTPUTS, played):
            fitting = tuple(entry for entry in fitting if entry in self._layouts[INPUTS].entries)
        wanted = {
            direction: self._planner.plan(direction, entries, self._layout(direction))
            for direction, entries in ((OUTPUTS, played), (INPUTS, fitting))
        }
        self._beside = tuple(entry for entry in sampled if entry not in fitting)
        self.mapping += 1
        if wanted == self._layouts and not self.missing:
            return
        self._check_none_is_enabled((*played, *sampled))
        with self.turn:
            self.leave()
            self._layouts = wanted
            self.prepare()
        self.operate()

    def sampled_entries(self) -> tuple[Entry, ...]:
        """Return the objects that come with every cycle; empty before the images are ready."""
        return (*self._layouts[INPUTS].entries, *self._beside) if self._ready else ()

    def outputs(self, played: Mapping[Entry, Integers]) -> ImageRows | None:
        """Return rows to send; None without mapped objects."""
        return ImageRows(self, self._layouts[OUTPUTS], played) if played else None

    def samples(self) -> ImageSamples | None:
        """Begin to collect input images; None before they are ready."""
        self.owed = 0
        return ImageSamples(self, self._sampled_layout(), self._description) if self._ready else None

    def forget(self, nodes: Sequence[int]) -> None:
        """Forget the images of nodes that have restarted."""
        self.mapping += 1
        with self.turn:
            self._ready -= set(nodes)
        self._modes = {row: data for row, data in self._modes.items() if row[0] not in nodes}
        for k in nodes:
            self._slaves[k].forget()

    def before(self, node: int, key: Key) -> int | None:
        """Return the value that an object of a node had before its image was changed; None for one that is its own."""
        return self._slaves[node].before(key)

    def restore(self, node: int) -> None:
        """Take a node out of Op and restore its mapping; BusError if not all of it could be restored."""
        with self.turn:
            self._ready.discard(node)
        self._master.leave_op(self._nodes[node])
        self._slaves[node].restore()

    # --- what the link asks -----------------------------------------------------------------------------------------
    @property
    def missing(self) -> list[int]:
        """Slaves without the present mapping, by their number."""
        return [k for k in range(len(self._nodes)) if k not in self._ready]

    def out_of_op(self) -> list[int]:
        """Return the slaves that are not in Op, or do not answer, by their number; asked now."""
        found = []
        for k, position in enumerate(self._nodes):
            with suppress(NoAnswerError):
                if self._master.status(position).is_op:
                    continue
            found.append(k)
        return found

    def prepare(self) -> None:
        """Set the images of the slaves in Pre-Op, filled with their objects' values, and take them to Safe-Op."""
        layouts = {direction: self._layout(direction) for direction in (OUTPUTS, INPUTS)}
        for k in self.missing:
            self._slaves[k].set_cycle(self._description.cycle)
            for direction, layout in layouts.items():
                self._slaves[k].change(direction, layout)
            self.images[k] = self._as_it_is(k, layouts[OUTPUTS])
        self._layouts = layouts
        self._places = layouts[OUTPUTS].places(self._description)
        sizes = ImageSizes(layouts[OUTPUTS].size, layouts[INPUTS].size)
        self._master.map(dict.fromkeys(self._nodes, sizes))
        self._ready = set(range(len(self._nodes)))

    def operate(self, positions: Sequence[int] | None = None) -> None:
        """Take slaves to Op, all of them for None."""
        exchange = None if self._lockstep else lambda: self.exchange(is_cycle=False)
        self._master.operate(
            self._nodes if positions is None else positions, exchange and (lambda: _nothing(exchange())), LONGEST_STATE
        )
        self.exchanged_at = time.monotonic()

    def leave(self) -> None:
        """Take the slaves to Pre-Op."""
        with self.turn:
            self._ready.clear()
            for position in self._nodes:
                self._master.leave_op(position)

    def put(self, node: int, key: Key, data: bytes) -> bytes | None:
        """Put an object's value into the output image; return its previous bytes, None if it is not there."""
        if cia402.of_first_axis(key[0]) == cia402.MODE:
            self._modes[node, key] = data
        if node not in self._ready or key not in self._places:
            return None
        start, size = self._places[key]
        with self.turn:
            before = bytes(self.images[node][start : start + size])
            self.images[node][start : start + size] = data[:size].ljust(size, b"\xff" if _is_below_0(data) else b"\0")
        return before

    def has(self, key: Key) -> bool:
        """Return whether the output image carries an object of a node."""
        return bool(self._ready) and key in self._places

    def exchange(self, is_cycle: bool, timeout: float = FRAME) -> bool:
        """Exchange images with all slaves; they count as samples only if it is a cycle.

        Returns:
            Whether the images of all of them returned.
        """
        with self.turn:
            if self.is_silent or self.missing:
                return False
            beside = self._read_beside() if is_cycle and self._beside else [b""] * len(self._nodes)
            found = self._master.exchange([bytes(image) for image in self.images], timeout)
            if self.phase is not None and self._master.system_time is not None:
                self.phase.take(self._master.system_time)
            if None in found:
                return False
            self.exchanged_at = time.monotonic()
            if is_cycle:
                row = [(image or b"") + more for image, more in zip(found, beside, strict=True)]
                for taker in self.takers:
                    taker.append(row)
            return True

    def settle(self, timeout: float) -> bool:
        """Exchange images for the cycles whose rows have not returned; return whether all have.

        The row of a lost frame is taken from the next one, so that there are as many rows as cycles.
        """
        with self.turn:
            while self.owed:
                if not self.exchange(is_cycle=True, timeout=timeout):
                    return False
                self.owed -= 1
            return True

    # --- inside -----------------------------------------------------------------------------------------------------
    def _fitting(self, wanted: Sequence[Entry]) -> tuple[Entry, ...]:
        """Return the wanted entries that fit into one image, the first ones first."""
        fitting: tuple[Entry, ...] = ()
        for entry in wanted:
            with suppress(ObjectAccessError):
                self._check([entry], INPUTS, "recorded")
                self._planner.plan(INPUTS, (*fitting, entry), self._layout(INPUTS))
                fitting = (*fitting, entry)
        return fitting

    def _sampled_layout(self) -> ImageLayout:
        """Return the place of each object in a row: the input image, then the objects read by SDO."""
        layout, members = self._layouts[INPUTS], []
        size = layout.size
        for entry in self._beside:
            for axis in range(self._description.num_axes):
                width = (entry.bits or 0) // 8
                members.append(Member(entry, axis, size, width))
                size += width
        return layout._replace(members=(*layout.members, *members), size=size)

    def _read_beside(self) -> list[bytes]:
        """Read the objects outside each slave's image by SDO, in the order of `_sampled_layout`."""
        known, rows = self._description, []
        for client in self._clients:
            parts = []
            for entry in self._beside:
                for axis in range(known.num_axes):
                    data = client.read(*known.key(entry, axis), known.label(entry, axis), known.answer_timeout)
                    parts.append(data[: (entry.bits or 0) // 8])
            rows.append(b"".join(parts))
        return rows

    def _layout(self, direction: int) -> ImageLayout:
        """Return the image that is mapped, or will be unless more is requested: the slave's own, completed."""
        if direction not in self._layouts:
            found = self._slaves[0].found(direction, self._planner)
            self._layouts[direction] = self._planner.completed(direction, found)
        return self._layouts[direction]

    def _carries(self, direction: int, entries: tuple[Entry, ...]) -> bool:
        return set(entries) <= set(self._layouts[direction].entries)

    def _check(self, entries: Sequence[Entry], direction: int, verb: str) -> None:
        ready_made = {*self._layout(direction).entries, *self._planner.carried(direction)}
        for entry in entries:
            if not fits_pdo(entry, direction == INPUTS) and entry not in ready_made:
                raise ObjectAccessError(CANNOT_BE_MAPPED, f"{entry.label} cannot be {verb}: it is no process data")

    def _check_none_is_enabled(self, entries: Sequence[Entry]) -> None:
        axis = self._enabled_axis()
        if axis is not None:
            names = ", ".join(entry.label for entry in entries if not self._is_in_an_image(entry))
            raise ObjectAccessError(
                WRONG_STATE,
                f"{names} is not in the process image, which cannot be changed while axis {axis} is enabled; record or "
                "play it once before enabling",
            )

    def _is_any_enabled(self) -> bool:
        return self._enabled_axis() is not None

    def _enabled_axis(self) -> int | None:
        """Return the first axis that is enabled; None if all axes are off or no slave has its images."""
        if not self._ready:
            return None
        status = self._description.dictionary.find((cia402.STATUSWORD, 0))
        for k, client in enumerate(self._clients):
            for axis in range(self._description.num_axes):
                label = self._description.label(status, axis)
                data = client.read(*self._description.key(status, axis), label, self._description.answer_timeout)
                if cia402.is_live(int.from_bytes(data, "little")):
                    return k * self._description.num_axes + axis
        return None

    def _is_in_an_image(self, entry: Entry) -> bool:
        return any(entry in layout.entries for layout in self._layouts.values())

    def _as_it_is(self, node: int, layout: ImageLayout) -> bytearray:
        """Return an output image with the slave's present values; for unreadable ones the last mode, otherwise 0."""
        image = bytearray(layout.size)
        for member in layout.members:
            key, timeout = self._description.key(member.entry, member.axis), self._description.answer_timeout
            if member.entry.access == "wo":
                data = self._modes.get((node, key), b"")
                image[member.start : member.start + member.size] = data[: member.size].ljust(member.size, b"\0")
            else:
                label = self._description.label(member.entry, member.axis)
                data = self._clients[node].read(*key, label, timeout)
                fill = b"\xff" if member.entry.signed and _is_below_0(data) else b"\0"
                image[member.start : member.start + member.size] = data[: member.size].ljust(member.size, fill)
        return image


def _is_below_0(data: bytes) -> bool:
    return bool(data) and bool(data[-1] & 0x80)


def _nothing(_: object) -> None:
    """Discard the value (no-op callback)."""
