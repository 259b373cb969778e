"""A drive on EtherCAT: the device behind the slave controller (`application.py` has the calls and their order).

Dictionary, axes, errors, stored parameters and the process image are those of any node (`node/`). This module adds
EtherCAT's part: what acts in which AL state, and when outputs take effect.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from drive_env.cia402 import State
from drive_env.dictionary.aborts import WRONG_STATE, ObjectAccessError
from drive_env.dictionary.entries import Entry, ObjectDictionary
from drive_env.dictionary.roles import Role
from drive_env.emulator.emulated_drives import EmulatedDrives
from drive_env.ethercat.application import (
    AlState,
    AlStatusCode,
    ClockSetting,
    MailboxPlace,
    SlaveLayout,
    SyncManagerSetting,
)
from drive_env.ethercat.coe import CoeService, MailboxEmergencies, split
from drive_env.ethercat.coe_information import SdoInformation
from drive_env.ethercat.coe_sdo import CoeSdoServer
from drive_env.ethercat.ethercat_objects import entries_on_ethercat
from drive_env.ethercat.object_descriptions import describe
from drive_env.ethercat.sii_content import configuration, sii_content
from drive_env.ethercat.synchronisation import Synchronisation
from drive_env.node.axis import ObjectPort
from drive_env.node.node_axes import NodeAxes
from drive_env.node.node_dictionary import NodeDictionary
from drive_env.node.node_errors import NodeErrors
from drive_env.node.node_objects import ERROR_HISTORY, NodeObjects
from drive_env.node.parameters import Parameters
from drive_env.node.process_image import ImageObjects
from drive_env.node.store import PowerLostError, Store

ENABLE_OPERATION = 0x0F  # bits of the controlword that command operation enabled
OUTPUTS_CONDITION = "outputs"
NODE_ID = 1  # of the factory's values; on EtherCAT no COB-ID depends on it


class CoeObjects(NodeObjects):
    """The node's own objects, those of the process image and of its synchronisation among them."""

    image: ImageObjects
    synchronisation: Synchronisation

    def port(self, entry: Entry) -> ObjectPort:
        """Return the port of one of these objects."""
        if self.synchronisation.owns(entry):
            return self.synchronisation.port(entry)
        return self.image.port(entry) if self.image.owns(entry) else super().port(entry)


class CoeNode:
    """The device of a slave, connected to emulated axes.

    Args:
        drives: The emulated drives.
        first_axis: Number of the device's first axis among the drives'.
        spare: Drives of the node's last axes if `drives` have too few.
        store: File of its non-volatile memory; None: memory that lasts as long as the node.
        serial: Serial number in its EEPROM, and in 1018h:04 if the device has it.

    Raises:
        ValueError: For a device without EtherCAT, or axes that the drives do not have.

    Attributes:
        layout: Addresses of its sync managers.
        drives: The emulated drives.
        dictionary: All objects by index and sub-index.
        state: AL state.
    """

    def __init__(
        self,
        drives: EmulatedDrives,
        first_axis: int = 0,
        *,
        spare: EmulatedDrives | None = None,
        store: Path | None = None,
        serial: int = 0,
    ) -> None:
        device = drives.device
        behaviour = device.ethercat
        if behaviour is None:
            raise ValueError(f"{device.name} has no EtherCAT; its data (device.toml) have no table [ethercat]")
        self.drives = drives
        self._all_drives = [drives] if spare is None else [drives, spare]
        self.state = AlState.INIT
        self.layout = SlaveLayout(
            MailboxPlace(*behaviour.receive), MailboxPlace(*behaviour.send), behaviour.outputs, behaviour.inputs,
            *(None if place is None else MailboxPlace(*place)
              for place in (behaviour.bootstrap_receive, behaviour.bootstrap_send)),
        )  # fmt: skip
        self._device = device
        self._axes = NodeAxes(drives, first_axis, spare)
        of_eds = drives.inside.objects.entries
        entries = entries_on_ethercat(device, of_eds)
        self._objects = CoeObjects(device, of_eds.only(behaviour.has), lambda index: None)
        self._image = ImageObjects(device, entries, self._is_pre_op)
        self._synchronisation = Synchronisation(device, self._is_pre_op)
        self._objects.image, self._objects.synchronisation = self._image, self._synchronisation
        self.dictionary = NodeDictionary(device, entries, self._objects, self._axes)
        self._image.connect(self.dictionary.port)
        self._emergencies = MailboxEmergencies(device.num_axes)
        depth = len(self._objects.subs(ERROR_HISTORY))
        self._errors = NodeErrors(device, self._axes, depth, self._emergencies, lambda now: None, lambda: None)
        self._errors.add_objects(self._objects)
        self._store = Store(store, device.name)
        self._parameters = Parameters(
            device, self._objects, self._axes, self.dictionary, self._store, lambda: NODE_ID, lambda: None
        )
        self._parameters.add_commands()
        self._parameters.check(store)
        self._parameters.prepare_restart()
        self._by_index = _by_index(entries)
        self._sdo = CoeSdoServer(self._port, self._entries_of, self._image, behaviour.send.length)
        self._information = SdoInformation(describe(device), behaviour.send.length)
        self._sii, self._serial = sii_content(device, serial), serial
        self._waiting: bytes | None = None  # outputs that take effect with the next pulse
        self._number = device.canopen.objects.get("node_id")  # object with the node's number
        # Objects of measured times: register of the device, and when the last event was [s].
        self._times: dict[Role, tuple[ObjectPort, float]] = {}

    @property
    def identification(self) -> int:
        """Number of the node, if the device keeps it in a register; else 0."""
        return self._objects.value(*self._number) if self._number else 0

    # --- process data -------------------------------------------------------------------------------------------------
    @property
    def output_size(self) -> int:
        """Bytes of sync manager 2 with the present mapping."""
        return self._image.output_size

    @property
    def input_size(self) -> int:
        """Bytes of sync manager 3 with the present mapping."""
        return self._image.input_size

    def outputs(self, data: bytes, now: float) -> None:
        """Apply outputs at once or, with SYNC0 or SYNC1, at its next pulse."""
        self._synchronisation.outputs_came(now)
        self._measure(Role.PACKET_TIME, now)
        if self._synchronisation.has_sync0:
            self._waiting = data
        else:
            self._apply(data, now)

    def inputs(self, now: float) -> bytes:
        """Return the present input image."""
        return self._image.read_inputs()

    def sync0(self, now: float) -> None:
        """Handle a pulse of SYNC0, unless SYNC1 is used."""
        if not self._synchronisation.has_sync1:
            self._pulse(now)

    def sync1(self, now: float) -> None:
        """Handle a pulse of SYNC1, if it is used."""
        if self._synchronisation.has_sync1:
            self._pulse(now)

    def _pulse(self, now: float) -> None:
        """Apply the outputs received since the last pulse."""
        self._measure(Role.SYNC_TIME, now)
        data, self._waiting = self._waiting, None
        if self.state is AlState.OP:
            self._synchronisation.pulse()
            if data is not None:
                self._apply(data, now)

    def _apply(self, data: bytes, now: float) -> None:
        if self._image.write_outputs(data):
            self._errors.conditions.pop(OUTPUTS_CONDITION, None)
        else:
            self._errors.condition("pdo_not_accepted", now, OUTPUTS_CONDITION)

    # --- states -------------------------------------------------------------------------------------------------------
    def power_on(self, now: float) -> None:
        """Boot: stored values, the factory's image, no waiting emergencies."""
        self.state = AlState.INIT
        self._waiting = None
        self._synchronisation.restart()
        self._axes.restart()
        self._objects.restore(NODE_ID, self._store.sections.get("communication", {}))
        if self._number is not None:
            self._objects.set("node_id", self._stored_number())
        if "serial_number" in self._device.canopen.objects:
            self._objects.set("serial_number", self._serial)
        self._times.clear()
        self._image.restart()
        self._errors.restart()
        self._sdo.close()

    def request_state(
        self, old: AlState, new: AlState, sync_managers: Sequence[SyncManagerSetting], clock: ClockSetting, now: float
    ) -> AlStatusCode:
        """Refuse clocks that the device cannot synchronise to."""
        if new is AlState.SAFE_OP and old is AlState.PRE_OP:
            self._take_cycle()
            self._times.clear()
            self._measure(Role.SYNC_TIME, now)  # 0, until pulses come
            self._times.clear()
            return self._synchronisation.begin(clock)
        return AlStatusCode.NO_ERROR

    def state_changed(self, new: AlState, code: AlStatusCode, now: float) -> None:
        """Note the new state; leaving Op, for whatever reason, stops the motors by their fault reaction."""
        old, self.state = self.state, new
        if old is AlState.OP and new is not AlState.OP:
            self._waiting = None
            self._stop_axes(now)
        if new is AlState.PRE_OP:
            self._synchronisation.leave()
        if new in (AlState.INIT, AlState.BOOTSTRAP):
            self._sdo.close()
            self._emergencies.clear()

    def watchdog_expired(self, now: float) -> None:
        """Note that no outputs came in time: the axes stop by their fault reaction."""
        self._waiting = None
        self._stop_axes(now)

    def _stop_axes(self, now: float) -> None:
        """Take enabled axes into their fault reaction, and report it."""
        if self._axes.trip():
            self._errors.condition("communication_error", now)

    def before_cycle(self, now: float) -> None:
        """Switch motors off before a cycle outside Op, however enabled (manual of the TMCM-3313, section 2.2)."""
        if self.state is not AlState.OP and any(axis.state == State.OPERATION_ENABLED for axis in self._axes):
            self._stop_axes(now)

    def after_cycle(self, now: float) -> None:
        """Queue the emergencies of the axes."""
        self._errors.collect(now)

    # --- mailbox ------------------------------------------------------------------------------------------------------
    def coe(self, message: bytes, now: float) -> list[bytes]:
        """Return the answers to a CoE message; ValueError for a message that is not answered."""
        service, content = split(message)
        if service == CoeService.SDO_REQUEST:
            try:
                return self._sdo.request(content)
            except PowerLostError:
                self.power_on(now)
                return []
        if service == CoeService.INFORMATION:
            return self._information.request(content)
        raise ValueError(f"service {service} of CoE is not one of this device")

    def pending_coe(self, now: float) -> list[bytes]:
        """Return and forget the waiting emergencies."""
        return self._emergencies.take()

    def _is_pre_op(self) -> bool:
        return self.state is AlState.PRE_OP

    def _entries_of(self, index: int) -> Sequence[Entry]:
        entries = self._by_index.get(index)
        return entries if entries is not None else [self.dictionary.entries.find((index, 0))]

    def _port(self, index: int, sub: int) -> ObjectPort:
        """Return the port by which SDOs access an object."""
        port = self.dictionary.port(index, sub)
        if port.event != "controlword":
            return port
        return port._replace(check=lambda raw: self._check_controlword(port, raw))

    def _check_controlword(self, port: ObjectPort, raw: int) -> None:
        port.check(raw)
        if self.state is not AlState.OP and raw & ENABLE_OPERATION == ENABLE_OPERATION:
            raise ObjectAccessError(
                WRONG_STATE, f"{port.entry.label} cannot enable operation in {self.state.name}; motors run in Op alone"
            )

    # --- EEPROM -------------------------------------------------------------------------------------------------------
    def read_sii(self) -> bytes:
        """Return the EEPROM's content, with the alias in it if the device uses that as its number."""
        if self._number is None:
            return self._sii
        words = configuration(self._stored_number())
        return words + self._sii[len(words) :]

    def _stored_number(self) -> int:
        assert self._number is not None, "asked for of a device that has one alone"
        factory = self._objects.factory(NODE_ID)[self._number]
        return int(self._store.sections.get("bus", {}).get(self._number, factory))

    def _measure(self, role: Role, now: float) -> None:
        """Write the time since the last event [us], if the device has a register for it."""
        key = self._device.roles.get(role)
        if key is None:
            return
        port, before = self._times.get(role, (self.dictionary.port(*key), now))
        port.write(round(1e6 * (now - before)))
        self._times[role] = (port, now)

    def _take_cycle(self) -> None:
        """Set the drives' cycle to that in the device's register, if it has one."""
        key = self._device.roles.get(Role.SET_CYCLE)
        if key is not None:
            for drives in self._all_drives:
                drives.set_cycle(1e-6 * int(self.dictionary.port(*key).read()))

    def write_sii(self, content: bytes) -> None:
        """Store the EEPROM that the master has written."""
        self._sii = content


def _by_index(entries: ObjectDictionary) -> dict[int, list[Entry]]:
    found: dict[int, list[Entry]] = {}
    for entry in entries:
        found.setdefault(entry.index, []).append(entry)
    return {index: sorted(rows, key=lambda one: one.sub) for index, rows in found.items()}
