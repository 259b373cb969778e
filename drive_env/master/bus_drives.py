"""Drives on a fieldbus behind the Drives interface, over any link: real drives, or served emulated ones.

`read` and `write` are always SDO transfers: a mapped object's last sample is a cycle old, and a value in process data
acts only at the next SYNC, so a program would see other integers than on `EmulatedDrives`. `record` samples and plays
in process data, which it maps as needed.
"""

from __future__ import annotations

import atexit
import contextlib
import logging
import signal
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.devices import devices_of, find_device
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.dictionary.access import check_readable, check_writable, checked_values
from drive_env.dictionary.entries import Entry, ObjectName, ObjectNames, Rows
from drive_env.dictionary.position_scale import position_scale
from drive_env.dictionary.quantities import Scale, follows_scale, integers, is_quantity, scales_of
from drive_env.dictionary.roles import Role
from drive_env.drives.arguments import checked_mask, object_names, whole_cycles
from drive_env.drives.emergency import EmergencyMessage
from drive_env.drives.enabled_check import EnabledCheck
from drive_env.drives.interface import CYCLE
from drive_env.drives.limits import Limits
from drive_env.drives.trace import Trace
from drive_env.fieldbus.description import Description
from drive_env.fieldbus.errors import BusError, NoAnswerError
from drive_env.fieldbus.link import Link, ObjectClient, Timing
from drive_env.held_signals import held_signals
from drive_env.master.cycle_runner import CycleRunner
from drive_env.master.pace import Pace
from drive_env.master.sampling import run_cycles
from drive_env.safety.envelope import Envelope, SafetyError
from drive_env.safety.objects import STORE
from drive_env.safety.watched_drives import CycleWatch
from mechanics.arrays import Integers, Mask

logger = logging.getLogger(__name__)


_DEVICE_TYPE = 0x1000
_IDENTITY = {(0x1018, 1): "vendor", (0x1018, 2): "product"}


class BusDrives:
    """Drives on a link, with the interface of `EmulatedDrives`: the same calls, the same integers.

    Axes are those of the first node, then those of the second, and so on. Nodes are started when process data or a
    watchdog need it; `close` restores process data and watchdogs.

    Args:
        link: The nodes, all of one device; closed by `close`, and if the constructor fails.
        description: Their device.
        pace: When communication cycles are due.
        safety: Limits; False: no limits, which is for emulators.

    Raises:
        BusError: If a node does not answer or is another device.
        ValueError: For limits that do not fit the number of axes.
    """

    machine = None  # of the Drives interface: only emulated drives have one
    observers = ()

    def __init__(self, link: Link, description: Description, pace: Pace, safety: Limits | bool = True) -> None:
        self._link = link
        self._description = description
        self._pace = pace
        self.device = description.device
        self.nodes = link.nodes
        self.num_axes = len(self.nodes) * description.num_axes
        self.axis_numbers = range(self.num_axes)
        self._cycle_runner = CycleRunner(
            description, self.num_axes, link, pace, self.start, self._catch_up, self.read_entry
        )
        self._check_enabled = EnabledCheck()
        self._started = False
        self._closed = False
        self.safety: Envelope | None = None
        try:
            limits = checked_limits(safety)
            link.hear(self._alive, self._on_restart)
            self._greet()
            if limits:
                self.safety = Envelope(limits, self)
        except BaseException:
            link.close()
            raise
        # Without `with`, an exception ends the interpreter through here; the drives must not go on alone.
        atexit.register(self.close)

    # --- the interface --------------------------------------------------------------------------------------------
    def read(self, name: ObjectName) -> Integers:
        """Return an object as the wire carries it, int64 of shape (num_axes,); a text as an array of str.

        An UNSIGNED64, which some drives have, comes as uint64.

        Raises:
            ObjectAccessError: If there is no such object or it cannot be read; NoAnswerError if a node is silent.
        """
        return self.read_of(name, range(self.num_axes))

    def read_of(self, name: ObjectName, axes: Sequence[int]) -> Integers:
        """Return an object of some axes, in their order, as `read` does of all."""
        self._enter()
        known = self._description.dictionary
        scale = position_scale(known.roles) if name is Role.POSITION_SCALE else None
        if scale is not None and len(scale.keys) > 1:  # no single object has it: several form it
            made = scale.increments([self.read_entry(known.find(key), axes).astype(float) for key in scale.keys])
            return np.asarray(np.rint(made), np.int64)
        values: Integers = self.read_entry(known.find(name), axes)
        return values

    def write(self, name: ObjectName, value: ArrayLike, where: Mask | None = None) -> None:
        """Write an object of the axes where the mask is true: one integer, one per axis, or a quantity, "500 rpm".

        Type, access and range are checked before anything is sent. What only a drive can check is checked axis by axis:
        axes before the one that refuses keep the new value.

        Raises:
            ObjectAccessError: With the SDO abort code, if the object, the value or the state does not allow it.
            SafetyError: If a limit does not allow it; NoAnswerError if a node is silent.
            ValueError: For a quantity of another kind than the object's.
        """
        self._enter()
        entry = self._description.dictionary.find(name)
        check_writable(entry)
        axes = checked_mask(where, self.num_axes)
        if isinstance(value, str) and not self._description.is_number(entry):
            for axis in np.flatnonzero(axes):
                self.write_axis(entry, int(axis), value)
            return
        if is_quantity(value):
            scales = self._scales() if follows_scale(entry.unit) else [None] * self.num_axes
            value = integers(str(value), entry, scales, axes)
        raw = checked_values(entry, value, self.num_axes)
        if self.safety is not None:
            self.safety.before_write(entry, raw, axes)
        if entry.index == STORE:
            self._restore_process_data()
        try:
            if entry.index == cia402.CONTROLWORD and np.count_nonzero(axes) > 1:
                words = [self._addressed(entry, axis, int(raw[axis])) for axis in np.flatnonzero(axes).tolist()]
                self._link.hand_out(words)
            for axis in np.flatnonzero(axes):
                self.write_axis(entry, int(axis), int(raw[axis]))
        except BaseException:
            if self.safety is not None:
                self.safety.after_failed_write(entry)
            raise
        if self.safety is not None:
            self.safety.after_write(entry, raw, axes)

    def advance(self, duration: float) -> None:
        """Let `duration` [s] pass, whole communication cycles, with a SYNC in each.

        With a longer time between SYNCs (`CanDrives(cycle=...)`) it is rounded up to a whole multiple of that. In real
        time the duration is kept: SYNCs for which this computer was too late are left out.

        Raises:
            SafetyError: If a limit is passed; the drives are in quick stop then.
        """
        self._enter()
        per_sync = self._description.cycles_per_sync
        cycles = -(-whole_cycles(duration, self._description.cycle / per_sync) // per_sync)
        if cycles == 0:
            return
        self._cycle_runner.pass_time(cycles, self.safety)

    def record(self, objects: ObjectNames, duration: float, play: Rows = None, period: float = CYCLE) -> Trace:
        """Let `duration` [s] pass while objects are recorded and played.

        In cycle k row k of `play` is sent, then SYNC, at which the drives apply it and sample row k of `objects`.
        Objects of the last call stay mapped: a call with the same ones costs no configuration, so a policy may record
        and play cycle by cycle.

        Args:
            objects: What to record: one object, or several; objects that the drive can map to process data.
            duration: Whole communication cycles [s].
            play: Object -> integers to write, shape (cycles,) or (cycles, num_axes); objects for process data.
            period: Time between samples [s], whole communication cycles.

        Raises:
            ObjectAccessError: For an object that cannot be mapped, for more than fit, or a value out of range.
            ValueError: For times that are not whole cycles, or rows of a wrong shape.
            SafetyError: If a limit is passed; the drives are in quick stop then.
            NoAnswerError: If samples do not come.
        """
        self._enter()
        cycles, every = self._cycles(duration), self._cycles(period)
        if every < 1:
            raise ValueError(f"period must be at least {self._description.cycle:g} s, not {period:g} s")
        given = play or {}
        self._check_enabled(self, self._description.dictionary, given, cycles)
        call = self._cycle_runner.call(object_names(objects), tuple(given))
        played = self._cycle_runner.rows(call, tuple(given.values()), cycles)
        found = self._cycle_runner.record(call, played, cycles, self.safety)
        rows = -(-cycles // every)
        values = {}
        for entry in call.sampled:
            key = (entry.index, entry.sub)
            values[key] = np.tile(self.read_entry(entry), (rows, 1)) if self.is_dry else found[key][::every]
        times = np.arange(rows, dtype=np.float64) * (every * self._description.cycle)
        return Trace(times, values, self._description.dictionary, self._scales)

    def can_record(self, objects: Sequence[ObjectName]) -> bool:
        """Return whether objects can be recorded together; maps nothing."""
        self._enter()
        return self._cycle_runner.can_record(objects)

    def emergencies(self) -> list[EmergencyMessage]:
        """Return and forget the emergency messages since the last call, axis by axis in the order of each axis.

        If a node with several axes does not report which one sent an emergency, it is attributed to the first axis; an
        emergency that stops the whole module, sent once, is returned for each of its axes.
        """
        self._enter()
        if self._pace.time_waits:
            self._catch_up()
        messages = []
        for node, code, register, extra in self._link.take_emergencies():
            name, axis = self._description.emergency(code, extra)
            first = self.nodes.index(node) * self._description.num_axes
            about = self._description.axes_of_emergency(name, axis)
            messages += [EmergencyMessage(first + k, code, register, extra, name) for k in about]
        return sorted(messages, key=lambda message: message.axis)

    def reset_node(self, where: Mask | None = None) -> None:
        """Restart the drives' nodes: values return to the stored ones, the automaton starts anew.

        Raises:
            NoAnswerError: If a node does not boot; ValueError if only some axes of a node are chosen.
        """
        self._enter()
        axes = checked_mask(where, self.num_axes).reshape(len(self.nodes), self._description.num_axes)
        if np.any(axes.any(axis=1) != axes.all(axis=1)):
            raise ValueError("a node is reset with all its axes; choose all axes of a node or none")
        chosen = [k for k in range(len(self.nodes)) if axes[k].any()]
        if not chosen:
            return
        if self.safety is not None:
            self.safety.before_reset(chosen)
        if not self.is_dry:
            self._link.reset(chosen)
        self.forget(chosen)
        if self.safety is not None:
            self.safety.after_reset(chosen)

    def start_node(self, where: Mask | None = None) -> None:
        """Start the nodes of some axes that have left operational, as after missed heartbeats; no motor runs by it.

        What their axes were commanded before is taken back first: no axis is more than switched off when its node
        takes process data again. Other nodes are left as they are.

        Raises:
            SafetyError: If an axis of these nodes is live, or one could not be proved off before; none is started.
            NoAnswerError: If a node does not answer although it was woken.
        """
        self._enter()
        if self.safety is not None:
            self.safety.before_start()
        per_node = self._description.num_axes
        chosen = sorted({int(axis) // per_node for axis in np.flatnonzero(checked_mask(where, self.num_axes))})
        axes = [axis for k in chosen for axis in range(k * per_node, (k + 1) * per_node)]
        status, word = (self._description.dictionary.find(key) for key in (cia402.STATUSWORD, cia402.CONTROLWORD))
        for k in chosen:
            self._wake(k)
        for axis in axes:
            if cia402.is_live(found := self.read_raw(status, axis)):
                raise SafetyError(
                    f"axis {axis} is live (6041h = {found:04X}h), and its node is not started under it; quick-stop or "
                    "disable it first"
                )
        for axis in axes:
            self.write_raw(word, axis, cia402.DISABLE_VOLTAGE)
        self._link.start(chosen)

    def close(self) -> None:
        """Stop axes that still run, restore process data and watchdogs, and close the bus, which ends its use."""
        if self._closed:
            return
        if self.safety is not None:
            self.safety.close()  # if interrupted here, close can be called again, as it is at the interpreter's end
        with held_signals() as noted:  # between two of its PDOs' changes a drive has neither our mapping nor its own
            self._closed = True
            atexit.unregister(self.close)
            try:
                for k, node in enumerate(self.nodes):
                    if self.safety is not None and self.safety.has_lost(k):
                        continue  # it is left to its watchdog and must receive nothing more
                    with _logged(f"the PDOs of node {node} stay as they are"):
                        self._link.process.restore(k)
            finally:
                self._link.close()
        if noted:
            signal.raise_signal(noted[0])

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if error is not None and self.safety is not None and not self._closed:
            self.safety.stop(f"{kind.__name__ if kind else 'an exception'} in the program")
        self.close()

    @property
    def bus(self) -> BusDrives:
        """Itself: the drives of a bus."""
        return self

    @property
    def timing(self) -> Timing:
        """Punctuality of the SYNCs of the last `advance` or `record`."""
        return self._pace.timing

    @property
    def total_timing(self) -> Timing:
        """Punctuality of all SYNCs since the drives were opened."""
        return self._pace.total

    # --- what the envelope and the tools use ----------------------------------------------------------------------
    @property
    def description(self) -> Description:
        """The description of the device."""
        return self._description

    @property
    def link(self) -> Link:
        """The bus."""
        return self._link

    @property
    def time_waits(self) -> bool:
        """Whether no time passes between two calls (lockstep)."""
        return self._pace.time_waits

    def sdo(self, node: int) -> ObjectClient:
        """Return the client for the objects of a node, by its position in `nodes`."""
        return self._link.sdo(node)

    def write_raw(self, entry: Entry, axis: int, value: int | str) -> None:
        """Write an object of one axis, even if the envelope has overridden it."""
        node, index, sub, label = self._place_of(entry, axis)
        data = self._description.encode(entry, value)
        self._link.sdo(node).write(index, sub, data, f"{value} to {label}", self._description.patience(entry))

    def read_raw(self, entry: Entry, axis: int) -> Any:
        """Read an object of one axis as the drive has it, even if the envelope has overridden it."""
        node, index, sub, label = self._place_of(entry, axis)
        data = self._link.sdo(node).read(index, sub, label, self._description.patience(entry))
        return self._description.decode(entry, data)

    def forget(self, nodes: Sequence[int]) -> None:
        """Forget the configuration of nodes (by position) that have restarted."""
        self._link.process.forget(nodes)
        self._started = False

    def must_start(self) -> None:
        """Note that a node is not operational any more: the next command starts it."""
        self._started = False

    def prepare_watch(self, watch: CycleWatch) -> None:
        """Have the objects mapped that an envelope watches."""
        self._cycle_runner.prepare(watch)

    def sampled_entries(self) -> tuple[Entry, ...]:
        """Return the objects that are sampled with every SYNC."""
        return self._cycle_runner.mapped()

    def poll(self, watch: CycleWatch) -> bool | None:
        """Send a SYNC and observe its samples; return as `CycleRunner.poll`."""
        return self._cycle_runner.poll(watch)

    @property
    def is_dry(self) -> bool:
        """Whether this is a dry run: frames are printed, and no drive is connected."""
        return self._link.is_dry

    def start(self) -> None:
        """Make the nodes operational, so that they exchange process data; once."""
        if not self._started:
            self._link.start()
            self._started = True

    def read_entry(self, entry: Entry, axes: Sequence[int] | None = None) -> Any:
        """Read an object of every axis, or of some, past the envelope."""
        entry = self._description.shown_by(entry)
        check_readable(entry)
        values = [self.read_axis(entry, axis) for axis in (range(self.num_axes) if axes is None else axes)]
        if not self._description.is_number(entry):
            return np.array(values)
        return np.array(values, np.int64 if entry.high is None or entry.high < 2**63 else np.uint64)

    def read_axis(self, entry: Entry, axis: int) -> Any:
        """Read an object of one axis; of one that was changed for as long as the bus is used, its own value."""
        found = self.read_raw(entry, axis)
        if (own := self._before_mapping(entry, axis)) is not None:
            return own
        return found if self.safety is None or not isinstance(found, int) else self.safety.own(entry, axis, found)

    def write_axis(self, entry: Entry, axis: int, value: int | str) -> None:
        """Write an object of one axis, past the envelope; of one that it has overridden, store the value."""
        if self._before_mapping(entry, axis) is not None:
            self._restore_process_data()
        if isinstance(value, str) or self.safety is None or not self.safety.write_lent(entry, axis, value):
            self.write_raw(entry, axis, value)

    def pass_cycle(self) -> None:
        """Let one cycle pass, past the envelope."""
        run_cycles(self._link, self._pace, 1, None, None, self._description.answer_timeout)
        self._pace.end(self._link.receive)
        if self._pace.time_waits:
            self._catch_up()

    # --- inside ---------------------------------------------------------------------------------------------------
    def _before_mapping(self, entry: Entry, axis: int) -> int | None:
        """Return an object's own value while process data are mapped over it, else None."""
        node, index, sub, _ = self._place_of(entry, axis)
        return self._link.process.before(node, (index, sub))

    def _restore_process_data(self) -> None:
        """Restore the nodes' own process data, which are stored or written next; the next cycle maps what it needs."""
        nodes = range(len(self.nodes))
        for k in nodes:
            self._link.process.restore(k)
        self.forget(nodes)

    def _scales(self) -> list[Scale]:
        """Read the scale of every axis' units, as far as the drive reports it."""
        return scales_of(self, self._description.dictionary)

    def _place_of(self, entry: Entry, axis: int) -> tuple[int, int, int, str]:
        """Return an axis' node (by position), and index, sub-index and label of an object there."""
        node, part = divmod(axis, self._description.num_axes)
        return node, *self._description.key(entry, part), self._description.label(entry, part)

    def _addressed(self, entry: Entry, axis: int, value: int) -> tuple[int, Key, bytes]:
        """Return an axis' node (by position), an object's key there, and its value as bytes."""
        node, index, sub, _ = self._place_of(entry, axis)
        return node, (index, sub), self._description.encode(entry, value)

    def _greet(self) -> None:
        """Check that every node answers and is the device that it was opened as."""
        known = self._description.dictionary
        for k, node in enumerate(self.nodes):
            axis = k * self._description.num_axes
            kind = self._wake(k)
            for key, what in _IDENTITY.items():
                if not self._description.has(key):
                    continue
                entry = known.find(key)
                found = self.read_axis(entry, axis)
                if entry.default and found != entry.default:
                    raise BusError(
                        f"node {node} is not a {self._description.name}: its {what} ({entry.label}) is {found:X}h, and "
                        f"the EDS says {entry.default:X}h; {self._who_it_is(kind, axis)}"
                    )
            self._check_variant(node, kind)
            self._link.welcome(k)

    def _who_it_is(self, kind: int, axis: int) -> str:
        """Return the advice for a message: as which device, or with which EDS, to open this node."""
        vendor, product = (self.read_axis(self._description.dictionary.find(key), axis) for key in list(_IDENTITY)[:2])
        if not (others := devices_of(kind, vendor, product)):
            return "give its own EDS (eds=..., --eds)"
        return f"it is a {' or '.join(others)}: name it so (device={others[0]!r}, --device {others[0]})"

    def _check_variant(self, node: int, kind: int) -> None:
        """Raise BusError for a node that is another variant of the device, which may count in other units."""
        name, known = self._description.name, self._description.dictionary
        if self.device is None or kind == known.find(_DEVICE_TYPE).default:
            return
        vendor, product = (int(known.find((0x1018, sub)).default) for sub in (1, 2))
        other = next(iter(devices_of(kind, vendor, product)), None)
        if other is not None and find_device(other).new_dictionary().find(_DEVICE_TYPE).default == kind:
            raise BusError(
                f"node {node} is a {other}, not a {name}: its device type (1000h:00) is {kind:08X}h; name it so "
                f"(device={other!r}, --device {other})"
            )

    def _wake(self, k: int) -> int:
        """Return a node's 1000h; a node that is stopped, say since its master died, is woken first."""
        entry, axis = self._description.dictionary.find(_DEVICE_TYPE), k * self._description.num_axes
        try:
            return int(self.read_axis(entry, axis))
        except NoAnswerError:
            self._link.wake(k)
            kind = int(self.read_axis(entry, axis))
            logger.warning("node %d was stopped (a master that died?) and is pre-operational now", self.nodes[k])
            return kind

    def _enter(self) -> None:
        if self._closed:
            raise BusError("these drives are closed; open them again")
        if self.safety is not None:
            self.safety.enter()

    def _on_restart(self, node: int) -> None:
        if self.safety is not None:
            self.safety.restarted(node)

    def _alive(self) -> None:
        if self.safety is not None:
            self.safety.alive()

    def _catch_up(self) -> None:
        """Wait until an emulator in lockstep has simulated every SYNC: it answers in order."""
        self.read_axis(self._description.dictionary.find(_DEVICE_TYPE), 0)

    def _cycles(self, duration: float) -> int:
        return whole_cycles(duration, self._description.cycle)


def checked_limits(safety: Limits | bool) -> Limits | None:
    """Return the limits in force; None if `safety` is False. TypeError for a value of another type."""
    if not isinstance(safety, bool | Limits):  # say, None must not silently mean "no envelope"
        raise TypeError(f"safety = {safety!r} must be Limits, True for those of the drives, or False for an emulator")
    return (Limits() if safety is True else safety) or None


@contextlib.contextmanager
def _logged(consequence: str) -> Any:
    """Log a failure to tidy up, and continue: the other steps must be tried, too."""
    try:
        yield
    except (BusError, ObjectAccessError) as error:
        logger.error("%s: %s", error, consequence)
