"""A device on EtherCAT: the table `ethercat` of its data. A device without it has no EtherCAT.

Vendor, product and revision are in its dictionary (1018h), its process data in 1C12h and 1C13h.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from mechanics.reading.near_names import did_you_mean

MEMORY = (0x1000, 0x3000)  # a controller's memory for sync managers: 8 KiB
LEAST_MAILBOX = 32  # bytes
PLACES = ("receive", "send", "bootstrap_receive", "bootstrap_send")


class Place(NamedTuple):
    """A mailbox: address and length [bytes]."""

    start: int
    length: int


class ClockMode(NamedTuple):
    """An operation mode of the clocks in a configurator: `Dc/OpMode` of ETG.2000; times in ns.

    Attributes:
        name: Its name.
        title: Its title for people.
        activation: Value of 0980h: 0 without clocks, 0300h with SYNC0, 0700h with SYNC1, too.
        cycle0: Cycle of SYNC0; 0: `factor0` times the master's cycle.
        factor0: That factor; 0: not given.
        shift0: Delay of SYNC0.
        cycle1: Cycle of SYNC1.
        factor1: Its ratio to SYNC0's cycle.
        shift1: Delay of SYNC1.
    """

    name: str
    title: str
    activation: int
    cycle0: int = 0
    factor0: int = 0
    shift0: int = 0
    cycle1: int = 0
    factor1: int = 0
    shift1: int = 0


class PdoRule(NamedTuple):
    """A configurator's rules for a mapping object: whether it must be assigned, and which others it excludes."""

    mandatory: bool = False
    exclude: tuple[int, ...] = ()


CLOCKS = (
    ClockMode("FreeRun", "Free run or synchronous with sync manager", 0x0000),
    ClockMode("DC", "Distributed clocks, SYNC0", 0x0300),
)
SYNC1_ON = 0x0400  # of a mode's activation
CONTROLS = (0x26, 0x22, 0x64, 0x20)  # of sync managers 0 to 3
# Features of a CoE server in ETG.2000. PdoConfig is for devices with writable mapping objects.
COE_ATTRIBUTES = ("SdoInfo", "PdoAssign", "PdoConfig", "PdoUpload", "CompleteAccess", "SegmentedSdo")
COE = ("SdoInfo", "PdoAssign", "CompleteAccess", "SegmentedSdo")


class EtherCatBehaviour(NamedTuple):
    """Properties of a device on EtherCAT.

    Attributes:
        receive: Mailbox that the master writes: sync manager 0.
        send: Mailbox that it reads: sync manager 1.
        bootstrap_receive: `receive` in Bootstrap; None: the device has no Bootstrap.
        bootstrap_send: `send` in Bootstrap; None likewise.
        outputs: Address of sync manager 2.
        inputs: Address of sync manager 3.
        only_on_can: Prefix of the names of objects that are absent on EtherCAT; "": all are present.
        described_as: Device whose EEPROM and description file it uses; "": its own.
        cycles: Cycles of SYNC0 that it accepts [s]; empty: any from the shortest on.
        can_indices: Ranges of indices, first and last, that are absent on EtherCAT, too.
        writable: Indices of objects that are read-only in the EDS, made for CAN, and writable on EtherCAT.
        shortest_cycle: Shortest cycle of SYNC0 [s].
        eeprom: Size of the EEPROM [bytes].
        order: Order code; "": the device's name.
        controls: Control bytes of sync managers 0 to 3.
        coe: Features of CoE in its ESI, except PdoConfig.
        has_foe: Whether its ESI and SII announce file transfer.
        clocks: Operation modes of its clocks.
        pdos: A configurator's rules for mapping objects; without a row, images that are not assigned together
            exclude each other.
    """

    receive: Place
    send: Place
    outputs: int
    inputs: int
    shortest_cycle: float
    eeprom: int
    bootstrap_receive: Place | None = None
    bootstrap_send: Place | None = None
    described_as: str = ""
    cycles: tuple[float, ...] = ()
    only_on_can: str = ""
    can_indices: tuple[tuple[int, int], ...] = ()
    writable: tuple[int, ...] = ()
    order: str = ""
    controls: tuple[int, ...] = CONTROLS
    coe: tuple[str, ...] = COE
    has_foe: bool = True
    clocks: tuple[ClockMode, ...] = CLOCKS
    pdos: Mapping[int, PdoRule] = MappingProxyType({})

    @property
    def uses_sync1(self) -> bool:
        """Whether outputs take effect with SYNC1 if the master switches it on."""
        return any(mode.activation & SYNC1_ON for mode in self.clocks)

    def has(self, index: int, name: str) -> bool:
        """Return whether an object is present on EtherCAT."""
        hidden = bool(self.only_on_can) and name.startswith(self.only_on_can)
        return not hidden and not any(first <= index <= last for first, last in self.can_indices)


def ethercat_of(data: Mapping[str, Any] | None) -> EtherCatBehaviour | None:
    """Return a device's table `ethercat`, None for None; ValueError for an invalid key or value."""
    if data is None:
        return None
    fields = EtherCatBehaviour._fields
    for key in data:
        if key not in fields:
            raise ValueError(f"ethercat has no {key!r}{did_you_mean(key, fields)}")
    missing = [field for field in fields if field not in data and field not in EtherCatBehaviour._field_defaults]
    if missing:
        raise ValueError(f"ethercat lacks {', '.join(missing)}")
    row: dict[str, Any] = {key: Place(*value) if key in PLACES else value for key, value in data.items()}
    row["cycles"] = tuple(data.get("cycles", ()))
    if ("bootstrap_receive" in data) != ("bootstrap_send" in data):
        raise ValueError("ethercat needs bootstrap_receive and bootstrap_send, or neither: the mailboxes in Bootstrap")
    row["can_indices"] = tuple((first, last) for first, last in data.get("can_indices", ()))
    for key in ("writable", "coe", "controls"):
        if key in data:
            row[key] = tuple(data[key])
    if "clocks" in data:
        row["clocks"] = tuple(ClockMode(**one) for one in data["clocks"])
    row["pdos"] = {
        int(index, 16): PdoRule(one.get("mandatory", False), tuple(one.get("exclude", ())))
        for index, one in data.get("pdos", {}).items()
    }
    found = EtherCatBehaviour(**row)
    for name in PLACES:
        place = getattr(found, name)
        if place is None:
            continue
        start, length = place
        if length < LEAST_MAILBOX or not MEMORY[0] <= start <= MEMORY[1] - length:
            raise ValueError(
                f"ethercat.{name} = {start:04X}h, {length} bytes: a mailbox has {LEAST_MAILBOX} bytes or more, between "
                f"{MEMORY[0]:04X}h and {MEMORY[1]:04X}h"
            )
    if (found.bootstrap_receive is None) != (found.bootstrap_send is None):
        raise ValueError("ethercat has one mailbox of Bootstrap; name bootstrap_receive and bootstrap_send, or neither")
    if found.eeprom % 128 or not found.eeprom:
        raise ValueError(f"ethercat.eeprom = {found.eeprom} bytes must be a multiple of 128")
    return found
