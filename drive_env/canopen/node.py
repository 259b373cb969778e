"""One CANopen node: receives and sends frames for the axes of one device.

This module connects the services: which are active in which NMT state, what a reset restores, what an error causes.
Each service is a file of its own and knows nothing of the others. A node reads no clock: every call brings the time.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from drive_env.canopen import communication, frames, lss, nmt, time_of_day
from drive_env.canopen.communication import ModuleObjects, known_bit_rate
from drive_env.canopen.emergency import EPSILON, EmergencyProducer
from drive_env.canopen.error_control import HeartbeatConsumer, HeartbeatProducer, NodeGuarding, consumers
from drive_env.canopen.frames import Frame
from drive_env.canopen.leds import Leds, leds_of
from drive_env.canopen.lss import UNCONFIGURED, LssIdentity, LssSlave
from drive_env.canopen.nmt import Command, NmtState
from drive_env.canopen.pdo import ReceivePdo, TransmitPdo
from drive_env.canopen.sync import SyncProducer, SyncWindow
from drive_env.canopen.time_of_day import Clock, TimeProducer
from drive_env.dictionary.aborts import CANNOT_BE_STORED, VALUE_RANGE, ObjectAccessError
from drive_env.dictionary.entries import eds_text
from drive_env.emulator.emulated_drives import EmulatedDrives
from drive_env.firmware.common.protection import COMMUNICATION
from drive_env.node.node_axes import NodeAxes
from drive_env.node.node_dictionary import NodeDictionary
from drive_env.node.node_errors import NodeErrors
from drive_env.node.node_objects import ERROR_HISTORY, IDENTITY, signed_command
from drive_env.node.parameters import Parameters
from drive_env.node.sdo_server import SdoServer
from drive_env.node.store import PowerLostError, Section, Store

logger = logging.getLogger(__name__)

COMMUNICATION_ERROR, APPLICATION_ERROR = 1, 2  # sub-indices of 1029h
SEGMENT_BITS = 135  # of a frame of eight bytes with its stuff bits
# Section of the store with LSS's settings, and their keys; no object has index 0.
LSS_SECTION, LSS_NODE_ID, LSS_BIT_RATE = "lss", (0, 1), (0, 2)


class Node:
    """A CANopen slave with the axes of one emulated device.

    It is off until `power_on`.

    Args:
        node_id: Number on the bus, 1...127; a stored one replaces it. 255 for a device with LSS: it has none, and waits
            for one.
        drives: The emulated drives.
        first_axis: Number of the device's first axis among the drives'.
        send: Called with every frame that the node sends.
        store: File of its non-volatile memory; None: memory that lasts as long as the node.
        bit_rate: Bit rate of the bus [bit/s], and the node's own until it stores one. If it has stored another one, it
            neither sends nor receives, since its controller understands nothing. None: the factory's, and any stored
            one matches.
        takes_time: Whether its firmware handles only as many frames per cycle as the device's does, while further ones
            wait in its receive buffer, and whether booting (without sending or receiving) and SDO answers take the
            device's time.
        spare: Drives of the node's last axes if `drives` have too few.
        has_room: Returns whether the controller's buffer accepts another segment of a block upload.
        serial: Serial number, if the device's data name its object; by default the node-ID.

    Raises:
        ValueError: For an impossible node-ID, axes that the drives do not have, a bit rate that the device lacks, or a
            file of another kind.

    Attributes:
        node_id: Present number on the bus.
        state: NMT state.
        drives: The emulated drives.
        first_axis: Number of the device's first axis among them.
        dictionary: All objects by index and sub-index.
    """

    def __init__(
        self,
        node_id: int,
        drives: EmulatedDrives,
        first_axis: int = 0,
        *,
        send: Callable[[Frame], None],
        store: Path | None = None,
        bit_rate: int | None = None,
        takes_time: bool = False,
        spare: EmulatedDrives | None = None,
        has_room: Callable[[], bool] = lambda: True,
        serial: int | None = None,
    ) -> None:
        device = drives.device
        services = device.canopen.services
        if not (1 <= node_id <= 127 or (node_id == UNCONFIGURED and services.lss)):
            none = "" if services.lss else f"; {device.name} has no LSS, so it needs one"
            raise ValueError(
                f"node {node_id} is impossible: CANopen has nodes 1 to 127" + (none if node_id == UNCONFIGURED else "")
            )
        self._serial = node_id if serial is None else serial
        self._has_room = has_room
        self._pending_node_id: int | None = None  # configured by LSS since power-on
        self._pending_bit_rate: int | None = None  # kbit/s
        self._activated_bit_rate: int | None = None
        self._clock = Clock()
        self._bus_bit_rate = None if bit_rate is None else known_bit_rate(device, bit_rate)
        self.node_id = self._given_id = node_id
        self.state = NmtState.INITIALISING
        self.drives = drives
        self.first_axis = first_axis
        self._device = device
        self._objects = drives.inside.objects
        self._send = send
        self._now = 0.0
        self._is_online = False
        self._leaves_for_bootloader = False
        self._axes = NodeAxes(drives, first_axis, spare)
        entries = self._objects.entries
        self._module = ModuleObjects(device, entries, self._configure)
        self.dictionary = NodeDictionary(device, entries, self._module, self._axes)
        self._store = Store(store, device.name, self._commissioned())
        self._parameters = Parameters(
            device, self._module, self._axes, self.dictionary, self._store, lambda: self.node_id, self._works_on_store
        )
        self._parameters.replaces["bus"] = LSS_SECTION
        self._emergency = EmergencyProducer(self._transmit, device.num_axes)
        depth = len(self._module.subs(ERROR_HISTORY))
        react = partial(self._react, APPLICATION_ERROR)
        self._errors = NodeErrors(device, self._axes, depth, self._emergency, self._flush, react)
        self._add_services()
        self._parameters.check(store, self._is_of_lss)
        self._parameters.prepare_restart()
        self._restore_bus()
        self._module.restore(self._factory_id, {})

        self._make_services(sorted({entry.index for entry in entries}))
        self._handlers: dict[int, tuple[Callable[[bytes, float], None], ...]] = {}
        self._empty_buffers(takes_time)

    def _commissioned(self) -> dict[str, Section]:
        """Return the stored communication section of the drives as commissioned; {} if that is the factory's."""
        found: Section = {}
        for entry in self._objects.entries:
            if entry.index in communication.COMMUNICATION and entry.access in ("rw", "rwr", "rww") and entry.bits:
                raw = int(self._objects.read((entry.index, entry.sub))[self.first_axis])
                if raw != entry.default:
                    found[entry.index, entry.sub] = raw
        return {"communication": found} if found else {}

    def _empty_buffers(self, takes_time: bool) -> None:
        """Drop received frames and answers under way."""
        device = self._device
        self._frames_left = self._frames_per_cycle = device.canopen.frames_per_cycle if takes_time else math.inf
        self._takes_time = takes_time
        self._boot_time = device.canopen.boot_time if takes_time else 0.0
        self._boots_at: float | None = None  # end of the boot time; None unless it boots
        self._boot: Callable[[float], None] = self._reset_communication
        self._answers: deque[tuple[float, Frame]] = deque()  # of SDO and LSS, with their sending times [s]
        self._segment_at = math.inf  # when the next segment of a block upload may be sent [s]
        self._work = 0.0  # s that the present request takes
        self._received: deque[tuple[Frame, float]] = deque()  # with their times of reception [s]
        self._came = 0.0  # time of reception of the frame being handled [s]
        self._has_lost = False  # frames, since its receive buffer was last half empty

    def _make_services(self, indices: Sequence[int]) -> None:
        """Create SDO server, emergencies, error control and the PDOs of the dictionary's indices."""
        device = self._device
        services = device.canopen.services
        self._sdo = SdoServer(
            self.dictionary.port, device.canopen.sdo_timeout, services.block_size, services.longest_text
        )
        self._lss = LssSlave(self) if services.lss else None
        self._sync_producer = SyncProducer()
        self._window = SyncWindow()
        self._time_producer = TimeProducer(services.time_period)
        self._heartbeat = HeartbeatProducer()
        self._guarding = NodeGuarding()
        self._consumers: list[HeartbeatConsumer] = []
        port = self.dictionary.port
        self._rpdos = [ReceivePdo(i, self._module, port) for i in indices if i in communication.RPDO]
        units = device.canopen.inhibit_unit, device.canopen.event_unit
        self._tpdos = [TransmitPdo(i, self._module, port, *units) for i in indices if i in communication.TPDO]
        self._pdos = {pdo.index: pdo for pdo in (*self._rpdos, *self._tpdos)}

    # --- the interface --------------------------------------------------------------------------------------------
    @property
    def bit_rate(self) -> int:
        """Bit rate [kbit/s] of its controller."""
        return self._bit_rate

    def power_on(self, now: float) -> None:
        """Switch the device on, or off and on: stored values, boot-up, pre-operational."""
        self._now = now
        self._boots_at = None
        self._pending_node_id = self._pending_bit_rate = self._activated_bit_rate = None
        self._clock.power_on(now)
        self._reset_application(now)

    def receive(self, frame: Frame, now: float) -> None:
        """Receive a frame of the bus at time `now` [s]; no content raises an exception."""
        self._now = now
        if not self._is_online or not self._accepts(frame):
            return
        if self._frames_left > 0 and not self._received:
            self._frames_left -= 1
            self._came = now
            self._take(frame, now)
        elif len(self._received) < self._device.canopen.receive_buffer:
            self._received.append((frame, now))
        elif not self._has_lost:
            self._has_lost = True
            self.overrun(now, "receive")

    @property
    def sync_id(self) -> int:
        """Identifier of SYNC: 1005h, or that of CiA 301 for a drive without 1005h."""
        module = self._module
        has_it = module.has(communication.SYNC_ID)
        return module.value(communication.SYNC_ID) & frames.IDENTIFIER if has_it else frames.SYNC

    @property
    def next_answer(self) -> float:
        """Time of its next SDO answer, or segment of one [s]; inf if no answer is due."""
        return min(self._answers[0][0], self._segment_at) if self._answers else self._segment_at

    def answer(self, now: float) -> None:
        """Send the SDO answers that are due at `now` [s]."""
        self._now = now
        while self._answers and self._answers[0][0] <= now + EPSILON:
            self._transmit(self._answers.popleft()[1])
        if self._segment_at <= now + EPSILON:
            self._send_segments(now)

    def _send_segments(self, now: float) -> None:
        """Send segments of a block upload, filling the controller's buffer at most half."""
        while self._has_room():
            segment = self._sdo.next_segment(now)
            if segment is None:
                self._segment_at = math.inf
                return
            self._transmit(Frame(frames.SDO_RESPONSE + self.node_id, segment))
            if self._takes_time:
                break
        self._segment_at = now + self._segment_time

    @property
    def _segment_time(self) -> float:
        """Time between two segments [s], limited by its firmware and the bus."""
        if not self._takes_time:
            return 0.0
        return max(self._device.canopen.sdo_time, SEGMENT_BITS / (1e3 * (self._bit_rate or 1000)))

    def _accepts(self, frame: Frame) -> bool:
        """Return whether a frame passes the controller's filters."""
        if frame.rtr:
            return frame.can_id == frames.ERROR_CONTROL + self.node_id and self.node_id != UNCONFIGURED
        return frame.can_id in self._handlers

    def _take(self, frame: Frame, now: float) -> None:
        if frame.rtr:  # the device supports remote frames only for guarding
            if self._heartbeat.period == 0.0:
                self._transmit(Frame(frame.can_id, self._guarding.answer(self.state, now)))
                self._errors.conditions.pop("guarding", None)
            return
        for handler in self._handlers.get(frame.can_id, ()):
            handler(frame.data, now)

    def before_cycle(self, now: float) -> None:
        """Run everything due before the drives advance by a communication cycle that begins at `now` [s].

        So a lost master stops the drives already in this cycle.
        """
        self._now = now
        if self._boots_at is not None and now >= self._boots_at - EPSILON:
            self._boots_at = None
            self._is_online = True
            self._boot(now)
        if not self._is_online:
            return
        self._frames_left = self._frames_per_cycle
        while self._received and self._frames_left > 0:
            self._frames_left -= 1
            frame, self._came = self._received.popleft()
            self._take(frame, now)
        if len(self._received) < self._device.canopen.receive_buffer // 2:
            self._has_lost = False
        for consumer in self._consumers:
            if consumer.is_lost(now):
                self._lose("heartbeat", consumer.node_id, now)
        if self._guarding.is_lost(now):
            self._lose("guarding", 0, now)
        self._produce(now)

    def _produce(self, now: float) -> None:
        """Send SYNC and TIME when this node produces them and they are due; the node itself reacts to its SYNC, too."""
        if not nmt.SERVICES[self.state].sdo:  # active when SDO is; error control has its own times
            return
        if self._time_producer.is_due(now):
            raw = self._module.value(communication.TIME_ID)
            self._transmit(Frame(raw & frames.IDENTIFIER, time_of_day.encode(*self._clock.milliseconds(now))))
        data = self._sync_producer.take(now)
        if data is not None:
            self._transmit(Frame(self.sync_id, data))
            self._came = now
            self._on_sync(data, now)

    def after_cycle(self, now: float) -> None:
        """Run everything due after a cycle, which ended at `now` [s]: emergencies, PDOs, timers, heartbeat."""
        self._now = now
        if not self._is_online:
            return
        self._errors.collect(now)
        self._flush(now)
        if nmt.SERVICES[self.state].pdo:
            for pdo in self._event_tpdos:
                data = pdo.on_cycle(now)
                if data is not None and pdo.can_id is not None:
                    self._transmit(Frame(pdo.can_id, data))
        if self._heartbeat.is_due(now):
            self._transmit(Frame(frames.ERROR_CONTROL + self.node_id, bytes((self.state,))))
        abort = self._sdo.expire(now)
        if abort is not None:
            self._transmit(Frame(frames.SDO_RESPONSE + self.node_id, abort))

    @property
    def saves_lose_power(self) -> bool:
        """Whether the power fails and returns in the middle of each save (1010h, 2706h); can be set."""
        return self._store.loses_power

    @saves_lose_power.setter
    def saves_lose_power(self, value: bool) -> None:
        self._store.loses_power = value

    def leds(self, error_counter: int = 0) -> Leds:
        """Return the state of the node's LEDs; `error_counter` is that of its CAN controller."""
        boots = self.state is NmtState.INITIALISING
        is_lss = self.node_id == UNCONFIGURED or (self._lss is not None and self._lss.is_configuring)
        return leds_of(self.state, not self._is_online and not boots, self._errors.conditions, error_counter, is_lss)

    @property
    def clock(self) -> Clock:
        """The node's clock, which TIME sets."""
        return self._clock

    # --- conditions of the CAN controller -------------------------------------------------------------------------
    def bus_off(self, now: float) -> None:
        """Take the node off the bus, as a controller with too many errors does: the drive stops and is disabled."""
        self._now = now
        if not self._is_online:
            return
        self._is_online = False
        self._received.clear()
        self._clear_answers()
        self._axes.trip("bus_off_recovered")
        self._react(COMMUNICATION_ERROR)

    def bus_on(self, now: float) -> None:
        """Recover the controller from bus-off; the node reports it as soon as its NMT state allows."""
        self._now = now
        if self._is_online or self._boots_at is not None or self.state is NmtState.INITIALISING:
            return
        self._is_online = True
        self._errors.condition("bus_off_recovered", now)

    def overrun(self, now: float, buffer: str = "controller") -> None:
        """Report that frames were lost in a buffer: "controller", "transmit" or "receive"."""
        self._now = now
        self._errors.condition(f"{buffer}_overflow", now)

    def error_passive(self, now: float) -> None:
        """Report that its controller has become error passive."""
        self._now = now
        self._errors.condition("error_passive", now)

    # --- resets ---------------------------------------------------------------------------------------------------
    def _reset_application(self, now: float) -> None:
        """Restart the module: stored bit rate and node-ID, the axes' stored values, then communication."""
        self._restore_bus()
        self._take_bit_rate("stored")
        self._axes.restart()
        self._reset_communication(now)

    def _take_bit_rate(self, origin: str) -> None:
        """Join the bus if its bit rate is the node's, else stay off; `origin`: its source, for the warning."""
        self._is_online = self._bus_bit_rate in (None, self.bit_rate)
        if not self._is_online:
            logger.warning(
                "node %d has %d kbit/s %s and is off the bus, which has %d kbit/s; give the bus the node's bit "
                "rate, or the node another store",
                self.node_id, self.bit_rate, origin, self._bus_bit_rate,
            )  # fmt: skip

    def _restore_bus(self) -> None:
        """Activate the stored bit rate and node-ID; the given ones if none were stored."""
        objects, bus = self._device.canopen.objects, self._store.sections.get("bus")
        by_lss = self._store.sections.get(LSS_SECTION, {})  # stored later than "bus", since storing "bus" deletes it
        factory = self._module.factory(self._factory_id)
        active = {"bit_rate": self._bus_bit_rate or 0, "node_id": self._given_id}
        for role, given, lss_key in (
            ("bit_rate", self._bus_bit_rate, LSS_BIT_RATE),
            ("node_id", self._given_id, LSS_NODE_ID),
        ):
            key = objects.get(role)
            if key is None:  # a device that stores neither uses the given ones
                active[role] = by_lss.get(lss_key, active[role])
                continue
            raw = given if bus is None and given is not None else (bus or {}).get(key, factory[key])
            assert isinstance(raw, int), "bit rate and node-ID are numbers"
            active[role] = raw = by_lss.get(lss_key, raw)
            self._module.set(role, raw)
            if f"active_{role}" in objects:
                self._module.set(f"active_{role}", raw)
        self._bit_rate, self.node_id = active["bit_rate"], active["node_id"]
        if self._activated_bit_rate is not None:
            self._bit_rate = self._activated_bit_rate
        self._take_pending_node_id()

    @property
    def _factory_id(self) -> int:
        """Node-ID in the factory's COB-IDs; without a node-ID any value serves."""
        return 1 if self._given_id == UNCONFIGURED else self._given_id

    def _take_pending_node_id(self) -> bool:
        """Activate a node-ID that LSS has configured; return whether it differs from the present one."""
        before = self.node_id
        if self._pending_node_id is not None:
            self.node_id = self._pending_node_id
            if "active_node_id" in self._device.canopen.objects:
                self._module.set("active_node_id", self.node_id)
        return self.node_id != before

    def _reset_communication(self, now: float) -> None:
        """Restore the communication objects, send the boot-up message and become pre-operational.

        A node without a node-ID does not boot: it waits for LSS to give it one.
        """
        self.state = NmtState.INITIALISING
        if self._take_pending_node_id():
            # The master that monitored it does not know its new number.
            self._axes.trip()
        self._leaves_for_bootloader = False
        self._received.clear()
        self._close_sdo()
        self._errors.restart()
        self._guarding.reset()
        self._window.forget()
        self._sync_producer.restart()
        if self._lss is not None:
            self._lss.reset()
        if self.node_id == UNCONFIGURED:
            self._wait_for_node_id()
            return
        self._module.restore(self.node_id, self._store.sections.get("communication", {}))
        for pdo in self._pdos.values():
            pdo.configure()
        for index in (
            communication.EMERGENCY_ID,
            communication.CONSUMER_HEARTBEAT,
            communication.GUARD_TIME,
            communication.PRODUCER_HEARTBEAT,
            communication.SYNC_ID,
            communication.TIME_ID,
        ):
            self._configure(index)
        self._transmit(Frame(frames.ERROR_CONTROL + self.node_id, bytes((NmtState.INITIALISING,))))
        self._heartbeat.postpone(now)
        self.state = NmtState.PRE_OPERATIONAL

    def _wait_for_node_id(self) -> None:
        """Listen only to LSS, and send nothing."""
        self._heartbeat.configure(0.0)
        self._guarding.configure(0.0)
        self._sync_producer.configure(0.0, 0)
        self._time_producer.configure(False)
        self._consumers = []
        self._handlers = {lss.REQUEST: (self._on_lss,)}

    def _configure(self, index: int) -> None:
        """Make the service of a communication object read its written value."""
        module = self._module
        if index in (communication.EMERGENCY_ID, communication.EMERGENCY_INHIBIT):
            raw = module.value(communication.EMERGENCY_ID)
            can_id = None if raw & frames.INVALID else raw & frames.IDENTIFIER
            self._emergency.configure(can_id, module.value(communication.EMERGENCY_INHIBIT) * 1e-4)
        elif index == communication.CONSUMER_HEARTBEAT:
            self._consumers = consumers([module.value(index, sub) for sub in module.subs(index)])
        elif index == communication.PRODUCER_HEARTBEAT:
            self._heartbeat.configure(module.value(index) * 1e-3)
        elif index in (communication.GUARD_TIME, communication.LIFE_TIME_FACTOR):
            life = module.value(communication.GUARD_TIME) * 1e-3 * module.value(communication.LIFE_TIME_FACTOR)
            self._guarding.configure(life)
        elif index in (communication.SYNC_ID, communication.SYNC_PERIOD, communication.SYNC_OVERFLOW):
            produces = module.services.sync_producer and module.value(communication.SYNC_ID) & frames.PRODUCE
            period = module.value(communication.SYNC_PERIOD) * 1e-6 if produces else 0.0
            self._sync_producer.configure(period, module.value(communication.SYNC_OVERFLOW))
            self._window.configure(module.value(communication.SYNC_WINDOW) * 1e-6)
        elif index == communication.SYNC_WINDOW:
            self._window.configure(module.value(index) * 1e-6)
        elif index == communication.TIME_ID:
            produces = module.services.time_producer and module.value(index) & frames.PRODUCE
            self._time_producer.configure(bool(produces))
        elif index in communication.PDO:
            is_mapping = index in communication.RPDO_MAPPING or index in communication.TPDO_MAPPING
            self._pdos[index - communication.TO_MAPPING if is_mapping else index].configure()
        self._connect()

    def _connect(self) -> None:
        """Assign identifiers to services; several services may share one."""
        table: dict[int, list[Callable[[bytes, float], None]]] = {
            frames.NMT: [self._on_nmt],
            frames.SDO_REQUEST + self.node_id: [self._on_sdo],
        }
        if self._lss is not None:
            table[lss.REQUEST] = [self._on_lss]
        table.setdefault(self.sync_id, []).append(self._on_sync)
        time_id = self._module.value(communication.TIME_ID)
        if time_id & frames.CONSUME_TIME:
            table.setdefault(time_id & frames.IDENTIFIER, []).append(self._on_time)
        for consumer in self._consumers:
            handler = partial(self._on_heartbeat, consumer)
            table.setdefault(frames.ERROR_CONTROL + consumer.node_id, []).append(handler)
        for pdo in self._rpdos:
            if pdo.can_id is not None:
                table.setdefault(pdo.can_id, []).append(partial(self._on_rpdo, pdo))
        self._handlers = {can_id: tuple(handlers) for can_id, handlers in table.items()}
        self._sync_rpdos = [pdo for pdo in self._rpdos if pdo.can_id is not None and pdo.is_synchronous]
        on = [pdo for pdo in self._tpdos if pdo.can_id is not None]
        self._sync_tpdos = [pdo for pdo in on if pdo.is_synchronous]
        self._event_tpdos = [pdo for pdo in on if not pdo.is_synchronous]

    # --- services -------------------------------------------------------------------------------------------------
    def _on_nmt(self, data: bytes, now: float) -> None:
        command = nmt.parse_command(data, self.node_id)
        if command is Command.START:
            self._enter(NmtState.OPERATIONAL)
        elif command is Command.STOP:
            self._enter(NmtState.STOPPED, is_commanded=True)
        elif command is Command.ENTER_PRE_OPERATIONAL:
            self._enter(NmtState.PRE_OPERATIONAL)
            self._flush(now)
        elif command is Command.RESET_NODE:
            self._axes.restart()  # at once, however long it takes to boot: no firmware drives the motor
            self._restart(self._reset_application, now)
        elif command is Command.RESET_COMMUNICATION:
            self._restart(self._reset_communication, now)

    def _restart(self, boot: Callable[[float], None], now: float) -> None:
        """Boot, now or after its boot time."""
        if self._boot_time == 0.0:
            boot(now)
            return
        self.state = NmtState.INITIALISING
        self._is_online = False
        self._received.clear()
        self._clear_answers()
        self._boots_at, self._boot = now + self._boot_time, boot

    def _enter(self, state: NmtState, *, is_commanded: bool = False, told: str = COMMUNICATION) -> None:
        """Enter a state; `told` is the condition that leads there."""
        if state is self.state:
            return
        if self.state is NmtState.STOPPED:
            self._sync_producer.restart()
        self.state = state
        self._window.forget()
        for received in self._rpdos:
            received.forget()
        if state is NmtState.OPERATIONAL:
            for sent in self._tpdos:
                sent.start()
        elif state is NmtState.STOPPED:
            self._close_sdo()
            # The only link of the state machines (TMCM-1636 manual, section 2.2); stops by errors are reported already
            if self._axes.trip(told) and is_commanded:
                self._errors.condition(told, self._now)

    def _on_sdo(self, data: bytes, now: float) -> None:
        if not nmt.SERVICES[self.state].sdo:
            return
        self._work = self._device.canopen.sdo_time
        try:
            answer = self._sdo.request(data, now)
        except PowerLostError:
            self.power_on(now)
            return
        if answer is not None:
            frame = Frame(frames.SDO_RESPONSE + self.node_id, answer)
            if self._leaves_for_bootloader:
                self._transmit(frame)
            else:
                self._answer(frame, now)
        if self._sdo.block is not None:
            self._send_segments(now)
        if self._leaves_for_bootloader:
            # The boot loader has no CANopen, and no firmware drives the motor: until power-on.
            self._is_online = False
            self.state = NmtState.INITIALISING
            self._axes.restart()

    def _answer(self, frame: Frame, now: float) -> None:
        """Send an answer, now or after its processing time."""
        if not self._takes_time:
            self._transmit(frame)
            return
        begins = max(now, self._answers[-1][0]) if self._answers else now  # one request after the other
        self._answers.append((begins + self._work, frame))

    def _close_sdo(self) -> None:
        """Forget an open transfer, and its pending answers."""
        self._sdo.close()
        self._clear_answers()

    def _clear_answers(self) -> None:
        self._answers.clear()
        self._segment_at = math.inf

    def _on_lss(self, data: bytes, now: float) -> None:
        assert self._lss is not None, "called on nodes with LSS only"
        self._work = self._device.canopen.sdo_time
        try:
            answer = self._lss.request(data)
        except PowerLostError:
            self.power_on(now)
            return
        if answer is not None:
            self._answer(Frame(lss.RESPONSE, answer), now)

    def _on_time(self, data: bytes, now: float) -> None:
        time = time_of_day.decode(data)
        if time is not None and nmt.SERVICES[self.state].sdo:
            self._clock.set(*time, self._came)

    def _on_sync(self, data: bytes, now: float) -> None:
        # CiA 301: without or with a counter. A node without 1019h takes both.
        if len(data) > 1 or not nmt.SERVICES[self.state].pdo:
            return
        if self._module.has(communication.SYNC_OVERFLOW):
            counts = self._module.value(communication.SYNC_OVERFLOW) != 0
            if len(data) != counts:
                self._errors.condition_if_known("sync_length", now)
                return
            self._errors.conditions.pop("sync_length", None)
        self._window.open(self._came)
        for received in self._sync_rpdos:
            self._judge(received, received.latch(), now)
        if self._window.is_over(now):  # it was handled too late
            return
        counter = data[0] if data else None
        for sent in self._sync_tpdos:
            sample = sent.on_sync(counter)
            if sample is not None and sent.can_id is not None:
                self._transmit(Frame(sent.can_id, sample))

    def _on_rpdo(self, pdo: ReceivePdo, data: bytes, now: float) -> None:
        if not nmt.SERVICES[self.state].pdo:
            return
        if pdo.is_synchronous and self._window.is_over(self._came):
            self._errors.condition_if_known("sync_window_missed", now)
            return
        self._errors.conditions.pop("sync_window_missed", None)
        self._judge(pdo, pdo.receive(data), now)

    def _on_heartbeat(self, consumer: HeartbeatConsumer, data: bytes, now: float) -> None:
        if len(data) == 1:
            consumer.receive(now)
            self._errors.conditions.pop(("heartbeat", consumer.node_id), None)

    # --- errors ---------------------------------------------------------------------------------------------------
    def _judge(self, pdo: ReceivePdo, condition: str | None, now: float) -> None:
        """Report a PDO that could not be processed, once until a good one comes (CiA 301: once per error event)."""
        if condition is not None:
            self._errors.condition(condition, now, pdo.index)
        elif pdo.index in self._errors.conditions:
            del self._errors.conditions[pdo.index]

    def _lose(self, service: str, node_id: int, now: float) -> None:
        self._errors.condition("heartbeat_lost", now, "guarding" if service == "guarding" else (service, node_id))
        self._react(COMMUNICATION_ERROR, "heartbeat_lost")

    def _react(self, error_class: int, told: str = COMMUNICATION) -> None:
        """Change the NMT state according to 1029h after an error detected in operational."""
        if self.state is not NmtState.OPERATIONAL:
            return
        raw = self._module.value(communication.ERROR_BEHAVIOUR, error_class)
        target = self._device.canopen.error_behaviour.get(raw, "stay")
        if target != "stay":
            self._enter(NmtState[target], told=told)

    def _flush(self, now: float) -> None:
        if self._is_online and nmt.SERVICES[self.state].emergency:
            self._emergency.flush(now)

    def _transmit(self, frame: Frame) -> None:
        if self._is_online:
            self._send(frame)

    # --- store, restore, boot loader ------------------------------------------------------------------------------
    def _add_services(self) -> None:
        """Connect the services to the objects that show or command them."""
        module, canopen = self._module, self._device.canopen
        self._errors.add_objects(module)
        self._parameters.add_commands()
        for role, signature, code, action in (
            ("store_bus", canopen.save_signature, CANNOT_BE_STORED, partial(self._parameters.save, ("bus",))),
            ("bootloader", canopen.bootloader_signature, VALUE_RANGE, self._leave_for_bootloader),
        ):
            if role in canopen.objects:
                module.commands[canopen.objects[role]] = signed_command(signature, code, action)
        serial = canopen.objects.get("serial_number")
        if serial is not None:
            self._axes.engrave(serial, self._serial)
            module.readers[serial] = lambda: int(self._objects.read(serial)[self.first_axis])
        module.readers[communication.STORE_EDS, 0] = self._eds_text
        module.readers[communication.TIME_STAMP, 0] = lambda: self._clock.microseconds(self._now)
        module.commands[communication.TIME_STAMP, 0] = lambda raw: self._clock.set_microseconds(raw, self._came)

    def _eds_text(self) -> str:
        """Return the content of 1021h, each byte as a character: the EDS, uncompressed as 1022h says."""
        return eds_text(self._device.eds).encode().decode("latin-1")

    def _leave_for_bootloader(self) -> None:
        self._leaves_for_bootloader = True

    def _works_on_store(self) -> None:
        self._work = self._device.canopen.store_time

    def _is_of_lss(self, section: str, key: tuple[int, int], raw: int) -> bool:
        """Return whether a stored value is LSS's; ObjectAccessError for one that it cannot have stored."""
        if section != LSS_SECTION:
            return False
        self._check_lss(key, raw)
        return True

    def _check_lss(self, key: tuple[int, int], raw: int) -> None:
        services = self._device.canopen.services
        known = {LSS_NODE_ID: (*range(1, 128), UNCONFIGURED), LSS_BIT_RATE: services.lss_bit_rates}
        if not services.lss or raw not in known.get(key, ()):
            raise ObjectAccessError(VALUE_RANGE, f"LSS has stored nothing like {key[0]:04X}:{key[1]} = {raw}")

    # --- what LSS asks for (drive_env/canopen/lss.py) -----------------------------------------------------------------
    def identity(self) -> LssIdentity:
        """Return vendor, product, revision and serial number; 0 for those that the device lacks."""
        has = self._module.subs(IDENTITY)
        port = self.dictionary.port
        parts = [port(IDENTITY, sub).read() if sub in has else 0 for sub in (1, 2, 3, 4)]
        return LssIdentity(*(part if isinstance(part, int) else 0 for part in parts))

    def active_node_id(self) -> int:
        """Return the node-ID; 255 if the node has none."""
        return self.node_id

    def pending_node_id(self) -> int:
        """Return the node-ID after the next reset."""
        return self.node_id if self._pending_node_id is None else self._pending_node_id

    def configure_node_id(self, node_id: int) -> None:
        """Store the node-ID for the next reset."""
        self._pending_node_id = node_id

    def configure_bit_rate(self, bit_rate: int) -> bool:
        """Store a pending bit rate [kbit/s], if the device has it."""
        try:
            known_bit_rate(self._device, 1000 * bit_rate)
        except ValueError:
            return False
        if bit_rate not in self._device.canopen.services.lss_bit_rates:
            return False
        self._pending_bit_rate = bit_rate
        return True

    def activate_bit_rate(self, delay: float) -> None:
        """Stop the axes and fall silent; use the pending bit rate after `delay` [s], send again after twice that."""
        if self._pending_bit_rate is None:
            return
        self._axes.trip()  # no master can stop them on a bus whose nodes change their bit rate
        self._is_online = False
        self._received.clear()
        self._close_sdo()
        self._activated_bit_rate = self._pending_bit_rate
        if self._takes_time:  # in lockstep it takes no time
            self._boots_at, self._boot = self._now + 2.0 * delay, self._change_bit_rate
        else:
            self._change_bit_rate(self._now)

    def _change_bit_rate(self, now: float) -> None:
        assert self._activated_bit_rate is not None, "it was noted before"
        self._bit_rate = self._activated_bit_rate
        if "active_bit_rate" in self._device.canopen.objects:
            self._module.set("active_bit_rate", self._bit_rate)
        self._take_bit_rate("by LSS")

    def store(self) -> int:
        """Store the pending node-ID and bit rate; return an error code of `lss`, OK if all went well."""
        services = self._device.canopen.services
        if not services.lss_stores:
            return lss.STORE_UNSUPPORTED
        bit_rate = self._pending_bit_rate or self._bit_rate
        section = {LSS_NODE_ID: self.pending_node_id()}
        if bit_rate in services.lss_bit_rates:
            section[LSS_BIT_RATE] = bit_rate
        self._work = self._device.canopen.store_time
        try:
            self._store.save({LSS_SECTION: section})
        except OSError as error:
            logger.warning("node %d cannot store what LSS has configured: %s", self.node_id, error)
            return lss.STORE_FAILED
        return lss.OK

    def leave_configuration(self) -> None:
        """Boot, if the node had no node-ID and now has one."""
        if self.node_id == UNCONFIGURED and self.pending_node_id() != UNCONFIGURED:
            self._restart(self._reset_communication, self._now)
