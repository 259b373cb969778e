"""The objects of CANopen's communication, 1005h to 1FFFh, and the checks of their writes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from drive_env.canopen import frames
from drive_env.devices import Device
from drive_env.devices.services import NodeQuirks, NodeServices
from drive_env.dictionary.aborts import INCOMPATIBLE_PARAMETER, VALUE_RANGE, WRONG_STATE, ObjectAccessError
from drive_env.dictionary.entries import Entry
from drive_env.node import mapping
from drive_env.node.node_objects import NodeObjects

COMMUNICATION = range(0x1000, 0x2000)
SYNC_ID = 0x1005
SYNC_PERIOD = 0x1006
SYNC_WINDOW = 0x1007
GUARD_TIME = 0x100C
LIFE_TIME_FACTOR = 0x100D
TIME_ID = 0x1012
TIME_STAMP = 0x1013
EMERGENCY_ID = 0x1014
EMERGENCY_INHIBIT = 0x1015
CONSUMER_HEARTBEAT = 0x1016
PRODUCER_HEARTBEAT = 0x1017
SYNC_OVERFLOW = 0x1019
STORE_EDS = 0x1021
ERROR_BEHAVIOUR = 0x1029
RPDO = range(0x1400, 0x1600)
RPDO_MAPPING = range(0x1600, 0x1800)
TPDO = range(0x1800, 0x1A00)
TPDO_MAPPING = range(0x1A00, 0x1C00)
PDO = range(0x1400, 0x1C00)
TO_MAPPING = 0x200  # offset of a PDO's mapping from its communication parameter
CYCLE_US = 1000  # a node acts by itself once per communication cycle


class ModuleObjects(NodeObjects):
    """Values of the module's objects: those of a node, with the rules of CANopen."""

    @property
    def services(self) -> NodeServices:
        """Optional services of the device."""
        return self._device.canopen.services

    @property
    def quirks(self) -> NodeQuirks:
        """Deviations of the device from the standard."""
        return self._device.canopen.quirks

    def _rule(self, entry: Entry) -> Callable[[int], None] | None:
        rule = _rule(entry.index)
        return None if rule is None else partial(rule, self, entry)

    def _fixed(self, entry: Entry) -> int:
        """Return the bits that are set in every written value: bit 30 of a PDO's COB-ID, if the factory's has it."""
        if not is_pdo_id(entry) or (entry.index in RPDO and self.quirks.rpdo_bit_30 == "store"):
            return 0
        return self.factory_value(entry) & frames.NO_REMOTE


# --- rules ------------------------------------------------------------------------------------------------------------
Rule = Callable[[ModuleObjects, Entry, int], None]


def is_pdo_id(entry: Entry) -> bool:
    """Return whether an object is the COB-ID of a PDO."""
    return entry.sub == 1 and (entry.index in RPDO or entry.index in TPDO)


def _check_bits(entry: Entry, raw: int, allowed: int) -> None:
    if raw & ~allowed:
        raise ObjectAccessError(
            VALUE_RANGE, f"{entry.label} cannot be {raw:08X}h: bits {raw & ~allowed:08X}h are not supported"
        )


def _check_identifier(objects: ModuleObjects, entry: Entry, raw: int, *, changes_while_on: bool = False) -> None:
    """Check a write of an object whose bit 31 switches a service off (CiA 301: 1014h, 1400h, 1800h)."""
    # First the impossible values: a master that set bit 31 and tried again would be refused only then.
    if raw & frames.INVALID == 0 and frames.is_restricted(raw & frames.IDENTIFIER):
        raise ObjectAccessError(
            VALUE_RANGE, f"{entry.label} cannot be {raw & frames.IDENTIFIER:03X}h, which CiA 301 reserves"
        )
    before = objects.value(entry.index, entry.sub)
    if not changes_while_on and (before | raw) & frames.INVALID == 0 and (before ^ raw) & frames.IDENTIFIER:
        raise ObjectAccessError(
            WRONG_STATE, f"{entry.label} is in use with {before & frames.IDENTIFIER:03X}h; set its bit 31 before"
        )


def _check_sync_id(objects: ModuleObjects, entry: Entry, raw: int) -> None:
    # Bit 30 makes the device produce SYNC with the period of 1006h, if it can. Bit 31 has no meaning in CiA 301; it is
    # accepted if the factory's value has it.
    produce = frames.PRODUCE if objects.services.sync_producer else 0
    _check_bits(entry, raw, frames.IDENTIFIER | produce | objects.factory_value(entry) & frames.INVALID)
    _check_unrestricted(entry, raw)
    _check_off(objects, entry, raw, frames.PRODUCE)


def _check_sync_period(objects: ModuleObjects, entry: Entry, raw: int) -> None:
    if objects.services.sync_producer and raw % CYCLE_US:
        raise ObjectAccessError(
            VALUE_RANGE, f"{entry.label} cannot be {raw} us; SYNC is produced every whole number of {CYCLE_US} us"
        )


def _check_sync_overflow(objects: ModuleObjects, entry: Entry, raw: int) -> None:
    if raw == 1 or raw > 240:
        raise ObjectAccessError(VALUE_RANGE, f"{entry.label} cannot be {raw}; it is 0, or 2 to 240")
    if objects.value(SYNC_PERIOD) != 0:
        raise ObjectAccessError(WRONG_STATE, f"{entry.label} cannot change while 1006h is not 0")


def _check_time_id(objects: ModuleObjects, entry: Entry, raw: int) -> None:
    produce = frames.PRODUCE if objects.services.time_producer else 0
    _check_bits(entry, raw, frames.CONSUME_TIME | produce | frames.IDENTIFIER)
    _check_unrestricted(entry, raw)
    _check_off(objects, entry, raw, frames.CONSUME_TIME | frames.PRODUCE)


def _check_unrestricted(entry: Entry, raw: int) -> None:
    if frames.is_restricted(raw & frames.IDENTIFIER):
        raise ObjectAccessError(
            VALUE_RANGE, f"{entry.label} cannot be {raw & frames.IDENTIFIER:03X}h, which CiA 301 reserves"
        )


def _check_off(objects: ModuleObjects, entry: Entry, raw: int, bits: int) -> None:
    """Raise 08000022h for another identifier while the service is on and stays on."""
    before = objects.value(entry.index, entry.sub)
    if before & bits and raw & bits and (before ^ raw) & frames.IDENTIFIER:
        named = " and ".join(str(bit) for bit in (30, 31) if bits >> bit & 1)
        raise ObjectAccessError(
            WRONG_STATE, f"{entry.label} is in use with {before & frames.IDENTIFIER:03X}h; clear bit {named} before"
        )


def _check_emergency_id(objects: ModuleObjects, entry: Entry, raw: int) -> None:
    _check_bits(entry, raw, frames.INVALID | frames.IDENTIFIER)
    _check_identifier(objects, entry, raw)


def _check_consumer(objects: ModuleObjects, entry: Entry, raw: int) -> None:
    if entry.sub == 0 or raw & 0xFFFF == 0:
        return
    for sub in objects.subs(entry.index):
        other = objects.value(entry.index, sub)
        if sub != entry.sub and other & 0xFFFF and (other ^ raw) >> 16 & 0xFF == 0:
            raise ObjectAccessError(
                INCOMPATIBLE_PARAMETER, f"{entry.label}: node {raw >> 16 & 0xFF} is watched by sub-index {sub} already"
            )


def _check_pdo(objects: ModuleObjects, entry: Entry, raw: int) -> None:
    if entry.sub == 1:
        # Bit 30 reads 1; writing 0 is accepted, since many masters do.
        _check_bits(entry, raw, frames.INVALID | frames.NO_REMOTE | frames.IDENTIFIER)
        refuses = entry.index in RPDO and objects.quirks.rpdo_bit_30 == "refuse"
        if refuses and (raw ^ objects.factory_value(entry)) & frames.NO_REMOTE:
            raise ObjectAccessError(VALUE_RANGE, f"{entry.label} cannot be {raw:08X}h: bit 30 cannot change")
        _check_identifier(objects, entry, raw, changes_while_on=objects.quirks.pdo_changes_while_on)
    elif (
        entry.sub == 3
        and not objects.quirks.pdo_changes_while_on
        and objects.value(entry.index, 1) & frames.INVALID == 0
    ):
        # CiA 301: the inhibit time shall not be changed while the PDO exists.
        raise ObjectAccessError(WRONG_STATE, f"{entry.label} is in use; set bit 31 of the PDO's COB-ID before")


def _check_mapping(objects: ModuleObjects, entry: Entry, raw: int) -> None:
    is_on = objects.value(entry.index - TO_MAPPING, 1) & frames.INVALID == 0
    mapping.check_may_change(entry, is_on, objects.value(entry.index, 0))
    transmit = entry.index in TPDO_MAPPING
    if entry.sub == 0:
        raws = [objects.value(entry.index, sub) for sub in range(1, raw + 1)]
        mapping.check_mapping(entry, raws, transmit, objects.find)
    elif raw != 0:  # else an empty entry, as in the factory's mapping
        mapping.check_mappable(entry, raw, transmit, objects.find)


_RULES: tuple[tuple[range, Rule], ...] = (
    (range(SYNC_ID, SYNC_ID + 1), _check_sync_id),
    (range(SYNC_PERIOD, SYNC_PERIOD + 1), _check_sync_period),
    (range(SYNC_OVERFLOW, SYNC_OVERFLOW + 1), _check_sync_overflow),
    (range(TIME_ID, TIME_ID + 1), _check_time_id),
    (range(EMERGENCY_ID, EMERGENCY_ID + 1), _check_emergency_id),
    (range(CONSUMER_HEARTBEAT, CONSUMER_HEARTBEAT + 1), _check_consumer),
    (RPDO, _check_pdo),
    (TPDO, _check_pdo),
    (RPDO_MAPPING, _check_mapping),
    (TPDO_MAPPING, _check_mapping),
)


def _rule(index: int) -> Rule | None:
    return next((rule for indices, rule in _RULES if index in indices), None)


# --- bit rates -------------------------------------------------------------------------------------------
def known_bit_rate(device: Device, bit_rate: int) -> int:
    """Return a bit rate [bit/s] in the units of 2704h [kbit/s]; ValueError if the device does not have it.

    A device without such an object has every bit rate.
    """
    key = device.canopen.objects.get("bit_rate")
    known = None if key is None else device.allowed_values.get(key)
    if known is not None and bit_rate not in [1000 * rate for rate in known]:
        rates = ", ".join(str(1000 * rate) for rate in known)
        raise ValueError(f"{device.name} has no bit rate of {bit_rate} bit/s; it has {rates}")
    return bit_rate // 1000
