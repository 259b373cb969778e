"""What each of our CAN devices promises: its EDS, taken apart here by configparser, and rows of its manual.

The conformance tests (test_conformance_*.py) take their expectations from here, from CiA 301 and CiA 402, and never
from the readers of `drive_env`. A test asks for facts ("has it a life guard?"), not for the name of a device.
"""

from __future__ import annotations

import configparser
import re
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import pytest

import drive_env
from rigs.canopen_wire import Wire

NODE = 5
OFF, NO_REMOTE = 1 << 31, 1 << 30  # bits of a PDO's COB-ID
PROFILE = 0x800  # from an axis' objects of CiA 402 to the next one's
CONTROLWORD, STATUSWORD, MODE, MODE_DISPLAY = 0x6040, 0x6041, 0x6060, 0x6061
TARGET_VELOCITY, PROFILE_VELOCITY, VELOCITY = 0x60FF, 0x6081, 0x606C
PV = 3
# CiA 402: what moves a drive, and what a master sends in each cycle.
SET_POINTS = {CONTROLWORD, MODE, 0x6042, 0x6071, 0x607A, 0x60B0, 0x60B1, 0x60B2, 0x60C1, 0x60FE, TARGET_VELOCITY}
SAVE, LOAD = 0x6576_6173, 0x6461_6F6C
SWITCH_ON_DISABLED, READY, ENABLED, FAULT = 0x40, 0x21, 0x27, 0x08  # CiA 402-2: bits 0 to 3, 5 and 6 of 6041h

# CiA 306: data types, their width [bits] and sign.
INTEGERS = {2: (8, True), 3: (16, True), 4: (32, True), 5: (8, False), 6: (16, False), 7: (32, False),
            0x15: (64, True), 0x1B: (64, False)}  # fmt: skip


class Entry(NamedTuple):
    """An object as its EDS has it; `bits` is None of a text."""

    index: int
    sub: int
    name: str
    bits: int | None
    signed: bool
    access: str
    mappable: bool
    default: str
    low: int | None
    high: int | None

    @property
    def key(self) -> tuple[int, int]:
        return self.index, self.sub

    @property
    def size(self) -> int:
        """Bytes on the wire."""
        return (self.bits or 0) // 8

    @property
    def room(self) -> range:
        """What its bits hold."""
        half = 1 << (self.bits or 1) - 1
        return range(-half, half) if self.signed else range(2 * half)

    @property
    def mapping(self) -> int:
        """The object as an entry of a mapping (CiA 301, 1600h)."""
        return self.index << 16 | self.sub << 8 | (self.bits or 0)

    @property
    def is_written(self) -> bool:
        """Whether it can be written and read back (CiA 306: rwr and rww are that, too)."""
        return self.access in ("rw", "rwr", "rww")

    def travels(self, is_sent: bool) -> bool:
        """Return whether a PDO of a direction carries it (CiA 306: rww is process data that is written, rwr read)."""
        return self.mappable and self.access not in (("wo", "rww") if is_sent else ("ro", "const", "rwr"))

    @property
    def label(self) -> str:
        return f"{self.index:04X}h:{self.sub:02X}"


class Manual(NamedTuple):
    """What no EDS says.

    Attributes:
        name: The device's.
        areas: Where an axis has objects of its own: first, last, and from one axis to the next.
        pdo_set: From a PDO of an axis to that of the next; 0: one set for the node.
        error_behaviour: NMT state after an error by the value of 1029h.
        inhibit_unit: Of 1800h:03 [s].
        hot: Temperature [degC] of a stage that the drive ends in fault.
        hot_told: The emergencies of it: code, error register, additional bytes ("axis": the motor's number).
        further_axis: Bit of 1001h of axes other than the first.
        refused: 1001h while process data are not taken.
        empty_history: What 1003h:01 and on answer while there is no error.
        lost: Emergencies of a lost heartbeat: code, and additional bytes; one of each axis where they name it.
        stopped: The same of a node that is stopped (NMT) while an axis is enabled.
        before_mode: What must be written for a mode: index, step to the next axis, raw value by mode, bytes.
        groups: What each sub-index of 1010h stores, by the areas' names below.
        address: Objects of the node-ID, of the one in force, and of the command that stores the first.
        bus: Parameters outside 1000h to 1FFFh that 1010h:02 stores.
        shared: Objects of the profile that all axes have in common.
        refuses: Objects that are writable by the EDS and refuse every value with 08000020h, as the documents say.
        stores_mapped: A parameter that a PDO can carry is stored, too.
        commands: Objects by index that are no parameters: services, a latch that is armed (200Fh), a counter (210Bh).
        speed: Target velocity of a motor that turns.
    """

    name: str
    areas: tuple[tuple[int, int, int], ...]
    pdo_set: int
    error_behaviour: dict[int, str]
    inhibit_unit: float
    hot: float
    hot_told: tuple[tuple[int, int, tuple[object, ...]], ...]
    further_axis: int
    lost: tuple[int, tuple[object, ...]]
    stopped: tuple[int, tuple[object, ...]]
    speed: int
    before_mode: tuple[int, int, dict[int, int], int] | None = None
    groups: Mapping[int, tuple[str, ...]] = MappingProxyType({})
    address: tuple[tuple[int, int], tuple[int, int], tuple[int, int]] | None = None
    bus: frozenset[int] = frozenset()
    shared: frozenset[int] = frozenset()
    refuses: frozenset[int] = frozenset()
    commands: frozenset[int] = frozenset()
    stores_mapped: bool = False
    refused: int = 0x21
    empty_history: bytes | int = 0x0800_0024  # CiA 301: no data


STOPS = {0: "STOPPED", 1: "OPERATIONAL", 2: "STOPPED"}  # manual of the TMCM-1636, table 41
TRINAMIC_HOT = ((0x4310, 0x09, (2, "axis", 0, 0, 0)), (0x4310, 0x09, (1, "axis", 0, 0, 0)))  # tables 303 and 380
TRINAMIC_LOST = (0x8130, (0, 255, 0, 0, 0))  # table 303
TRINAMIC_STOPPED = (0x8100, (0, 255, 0, 0, 0))
PROFILE_AREA = (0x6000, 0x67FF, 0x800)
AREAS = {"communication": (0x1000, 0x1FFF), "profile": (0x6000, 0x9FFF)}

MANUALS = (
    Manual(
        "tmcm1636",
        areas=(),
        pdo_set=0,
        error_behaviour=STOPS,
        inhibit_unit=1e-3,  # section 3.1.19
        hot=160.0,
        hot_told=TRINAMIC_HOT,
        further_axis=0,
        lost=TRINAMIC_LOST,
        stopped=TRINAMIC_STOPPED,
        speed=200_000,
        groups={1: ("communication", "profile", "motor 0"), 2: ("communication",), 3: ("profile",), 4: ("motor 0",)},
        address=((0x2705, 0), (0x2708, 0), (0x2706, 0)),
        bus=frozenset((0x2704, 0x2705)),
        commands=frozenset((0x2703, 0x2706, 0x5FFF)),  # sections 4.1.26 to 4.1.30
    ),
    Manual(
        "tmcm6212",
        areas=((0x2000, 0x21FF, 0x200), PROFILE_AREA),  # section 2.5.1
        pdo_set=0x40,  # section 1.1: numbers 1 to 4, 65 to 68, 129 to 132, ...
        error_behaviour=STOPS,
        inhibit_unit=1e-3,
        hot=160.0,
        hot_told=TRINAMIC_HOT,
        further_axis=0,
        lost=TRINAMIC_LOST,
        stopped=TRINAMIC_STOPPED,
        speed=51_200,
        groups={  # as the maker's EDS names them
            1: ("communication", "profile", *(f"motor {k}" for k in range(6)), "module"),
            2: ("communication",),
            3: ("profile",),
            **{4 + k: (f"motor {k}",) for k in range(6)},
            10: ("module",),
        },
        address=((0x3005, 0), (0x3008, 0), (0x3006, 1)),  # sections 4.2.57 to 4.2.61
        bus=frozenset((0x3004, 0x3005)),
        commands=frozenset(
            (0x3000, 0x3006, *(index + 0x200 * axis for index in (0x200F, 0x210B) for axis in range(6)))
        ),
        refuses=frozenset((0x1023, 0x3000, 0x3001)),  # about.md of the device: [unsupported.reasons]
    ),
    Manual(
        "tgz_d",
        # Its registers lie 100h apart as 3325h and 3425h do, but for what the module has once.
        areas=(
            *((0x2100 + 0x200 * k, 0x210F + 0x200 * k, 0x100) for k in (0, 2, 3, 4)),
            *(
                (0x2300, 0x230C, 0x100),
                (0x230F, 0x23FF, 0x100),
                (0x3100, 0x31FF, 0x100),
                (0x3900, 0x390F, 0x100),
                (0x2B00, 0x2B02, 0x100),
                (0x2B04, 0x2B0F, 0x100),
            ),
            *((0x3301, 0x3328, 0x100), (0x332B, 0x333D, 0x100), (0x333F, 0x333F, 0x100), (0x3341, 0x33FF, 0x100)),
            PROFILE_AREA,
        ),
        pdo_set=0,
        error_behaviour={0: "PRE_OPERATIONAL", 1: "OPERATIONAL", 2: "STOPPED"},  # CiA 301
        inhibit_unit=1e-4,  # CiA 301
        hot=160.0,
        hot_told=((0x4210, 0x09, (11, "axis", 0, 0, 0)),),  # predefined error field, HEAT_SINK_TEMPERATURE
        further_axis=0x80,  # error register
        lost=(0x8100, (17, "axis", 0, 0, 0)),  # HOST_COMMUNICATION
        stopped=(0x8100, (17, "axis", 0, 0, 0)),
        speed=300_000,
        before_mode=(0x2303, 0x100, {1: 7, 3: 6, 4: 1, 6: 7, 7: 3, 8: 3, 9: 2, 10: 1}, 4),  # D-Mode
        groups={1: ("communication", "profile", "motor 0", "motor 1", "module")},
        bus=frozenset((0x200D,)),  # C-ID, the node-ID
        empty_history=b"\0\0\0\0",
        shared=frozenset((0x60FE, 0x68FE, 0x60FD, 0x68FD)),
        refuses=frozenset((0x1C12, 0x1C13, 0x1C32, 0x1C33)),  # CoE
        commands=frozenset(
            (
                0x4001,
                *(
                    index + step
                    for index in (
                        0x23C6,
                        0x23C7,
                        0x23C8,
                        0x23C9,
                        0x23CA,
                        *range(0x3100, 0x3105),
                        0x3109,
                        0x310A,
                        0x333C,
                        0x3904,
                        0x3905,
                        0x3908,
                        0x390A,
                    )
                    for step in (0, 0x100)
                ),
            )
        ),
        stores_mapped=True,  # every parameter is mappable by the table of objects
        refused=0x01,  # error register: bit 5 is not used
    ),
    Manual(
        "tmcm3313",
        areas=((0x2000, 0x21FF, 0x200), PROFILE_AREA),  # section 2.4.1
        pdo_set=0x40,
        error_behaviour=STOPS,
        inhibit_unit=1e-3,  # of the extension for CAN, whose EDS says ms
        hot=160.0,
        hot_told=TRINAMIC_HOT,
        further_axis=0,
        lost=TRINAMIC_LOST,
        stopped=TRINAMIC_STOPPED,
        speed=51_200,
        refuses=frozenset((0x1600, 0x1A00, 0x1C00, 0x1C12, 0x1C13)),  # CoE
    ),
)


class Facts:
    """Facts of one device."""

    def __init__(self, manual: Manual) -> None:
        self.manual = manual
        self.name = manual.name
        self.path = Path(drive_env.__file__).parent / "devices" / self.name / f"{self.name}.eds"

    def __repr__(self) -> str:
        return self.name

    @cached_property
    def eds(self) -> configparser.ConfigParser:
        """Its EDS; each section and each key stands once."""
        found = configparser.ConfigParser(interpolation=None, comment_prefixes=(";",))
        found.read_string(self.path.read_text(encoding="utf-8"))
        return found

    @cached_property
    def entries(self) -> dict[tuple[int, int], Entry]:
        found = {}
        for section in self.eds.sections():
            match = re.fullmatch(r"([0-9A-F]{4})(?:sub([0-9A-F]{1,2}))?", section)
            row = self.eds[section]
            if match is None or int(row.get("ObjectType", "7"), 0) != 7:
                continue
            index, sub = int(match[1], 16), int(match[2] or "0", 16)
            bits, signed = INTEGERS.get(int(row["DataType"], 0), (None, False))
            limits = [int(row[key], 0) if row.get(key) else None for key in ("LowLimit", "HighLimit")]
            found[index, sub] = Entry(
                index, sub, row["ParameterName"], bits, signed, row["AccessType"].lower(),
                row.get("PDOMapping", "0") == "1", row.get("DefaultValue", ""), *limits
            )  # fmt: skip
        return found

    def default(self, index: int, sub: int = 0, node: int = NODE) -> int:
        """Return what the EDS has, with the COB-IDs of a node."""
        text = self.entries[index, sub].default.upper()
        total = sum(node if part.strip() == "$NODEID" else int(part, 0) for part in text.split("+")) if text else 0
        bits, signed = self.entries[index, sub].bits or 0, self.entries[index, sub].signed
        return total - (1 << bits) if signed and total >> (bits - 1) == 1 else total

    def has(self, index: int, sub: int = 0) -> bool:
        return (index, sub) in self.entries

    def subs(self, index: int) -> list[int]:
        """Sub-indices of an object."""
        return sorted(sub for one, sub in self.entries if one == index)

    @cached_property
    def axes(self) -> range:
        return range(sum(self.has(STATUSWORD + PROFILE * axis) for axis in range(8)))

    @cached_property
    def rpdos(self) -> list[int]:
        """Indices of the communication parameters."""
        return sorted(index for index, sub in self.entries if 0x1400 <= index < 0x1600 and sub == 1)

    @cached_property
    def tpdos(self) -> list[int]:
        return sorted(index for index, sub in self.entries if 0x1800 <= index < 0x1A00 and sub == 1)

    def mapped(self, index: int) -> list[Entry]:
        """Return what a PDO carries by default; the index is that of its communication parameter."""
        raws = [self.default(index + 0x200, sub) for sub in range(1, self.default(index + 0x200) + 1)]
        entries = [self.entries[raw >> 16, raw >> 8 & 0xFF] for raw in raws]
        assert [entry.mapping for entry in entries] == raws, f"the EDS maps what it has: {index:04X}h"
        return entries

    def room(self, index: int) -> int:
        """Return how many objects a PDO takes."""
        return max(self.subs(index + 0x200))

    def writes_type(self, index: int) -> bool:
        """Return whether a PDO's transmission type can be written."""
        return self.entries[index, 2].access == "rw"

    def axis_of(self, index: int) -> int | None:
        """Return the axis that an object belongs to; None of the module's."""
        if len(self.axes) == 1:
            return 0 if index >= 0x2000 else None
        for first, last, step in self.manual.areas:
            axis, place = divmod(index - first, step)
            if axis in self.axes and place <= last - first:
                return axis
        return None

    def area_of(self, index: int) -> str:
        """Return the area of the store that a parameter belongs to."""
        if index in self.manual.bus:
            return "communication"
        for name, (first, last) in AREAS.items():
            if first <= index <= last:
                return name
        axis = self.axis_of(index)
        return "module" if axis is None else f"motor {axis}"

    def parameters(self) -> list[Entry]:
        """Return what 1010h:01 stores: what can be written, is no command, and is no set-point that a PDO brings."""
        out = {*self.manual.refuses, *self.manual.bus, *self.manual.commands, 0x1003, 0x1010, 0x1011}
        return [entry for entry in self.entries.values() if entry.is_written and entry.bits is not None
                and entry.index not in out and not (entry.mappable and self.commanded(entry.index))]  # fmt: skip

    def commanded(self, index: int) -> bool:
        """Return whether an object that a PDO can carry is a command or a set-point, and no parameter."""
        if not self.manual.stores_mapped:
            return True
        of_axis = index >= 0x6000 and 0x6000 + index % PROFILE in SET_POINTS
        return of_axis or index in self.manual.commands

    def text(self) -> Entry | None:
        """Return a readable text that takes segments, of more than seven letters; None if it has none."""
        return next((e for e in self.entries.values() if e.bits is None and e.access != "wo" and len(e.default) > 7),
                    None)  # fmt: skip

    def told_of(self, event: str, enabled: list[int]) -> list[str]:
        """Return the emergencies of a lost network ("lost", "stopped"), the register of 1001h open.

        Where it is an error of axes, it is one of those that were in operation.
        """
        code, extra = getattr(self.manual, event)
        axes = enabled if "axis" in extra else [0]
        return [frame_of(code, "..", extra, axis) for axis in axes]


def frame_of(code: int, register: str, extra: tuple[object, ...], axis: int) -> str:
    """Return an emergency of NODE as a transcript has it."""
    rest = " ".join(f"{axis if byte == 'axis' else byte:02X}" for byte in extra)
    return f"{0x80 + NODE:03X}  {code & 0xFF:02X} {code >> 8:02X} {register} {rest}"


DEVICES = [Facts(manual) for manual in MANUALS]
EACH_DEVICE = pytest.mark.parametrize("facts", DEVICES, ids=repr)
EACH_AXIS = pytest.mark.parametrize(
    ("facts", "axis"), [pytest.param(facts, axis, id=f"{facts}-{axis}") for facts in DEVICES for axis in facts.axes]
)
EACH_RPDO, EACH_TPDO = (
    pytest.mark.parametrize(
        ("facts", "pdo"),
        [  # each third is in each run: of every device, and of every place in an axis' set
            pytest.param(facts, pdo, id=f"{facts}-{pdo:04X}", marks=pytest.mark.every(3))
            for facts in DEVICES
            for pdo in getattr(facts, direction)
        ],
    )
    for direction in ("rpdos", "tpdos")
)


# --- a wire and what is done on it ------------------------------------------------------------------------------------
def fresh(drives, store=None) -> Wire:
    """Return node 5 of the drives, pre-operational, cool, its motors at rest."""
    drives.machine.reset()
    drives.machine.enable_input = True
    drives.machine.set_temperatures(25.0, 25.0)
    return Wire(drives, NODE, store)


def request(index: int, sub: int) -> str:
    """Return a multiplexor as a transcript has it."""
    return f"{index & 0xFF:02X} {index >> 8:02X} {sub:02X}"


def upload(wire: Wire, index: int, sub: int = 0) -> bytes | int:
    """Read an object as a client does, in segments where it must; return its data, or the abort code."""
    (answer,) = wire.receive(0x600 + NODE, f"40 {request(index, sub)} 00 00 00 00")
    assert answer.can_id == 0x580 + NODE and answer.data[1:4] == bytes.fromhex(request(index, sub))
    first = answer.data[0]
    if first == 0x80:
        return int.from_bytes(answer.data[4:], "little")
    if first & 0x02:  # expedited, with its size
        assert first & 0xE1 == 0x41, "an initiate upload response that tells its size"
        return answer.data[4 : 8 - (first >> 2 & 3)]
    assert first == 0x41
    data, toggle, is_last = b"", 0, False
    while not is_last:
        (segment,) = wire.receive(0x600 + NODE, f"{0x60 | toggle:02X} 00 00 00 00 00 00 00")
        assert segment.data[0] & 0xF0 == toggle, "an upload segment response with the toggle bit of its request"
        data += segment.data[1 : 8 - (segment.data[0] >> 1 & 7)]
        is_last, toggle = bool(segment.data[0] & 1), toggle ^ 0x10
    assert len(data) == int.from_bytes(answer.data[4:], "little"), "as long as it was announced"
    return data


def read(wire: Wire, facts: Facts, index: int, sub: int = 0) -> int:
    """Read a number over the wire."""
    data = upload(wire, index, sub)
    assert isinstance(data, bytes), f"{index:04X}h:{sub:02X} aborts with {data:08X}h"
    return int.from_bytes(data, "little", signed=facts.entries[index, sub].signed)


def write(wire: Wire, facts: Facts, index: int, raw: int, sub: int = 0) -> int:
    """Write a number of the object's length, in segments beyond four bytes; return 0 or the abort code."""
    entry = facts.entries[index, sub]
    if entry.size <= 4:
        return wire.download(index, sub, raw, entry.size)
    data = raw.to_bytes(entry.size, "little", signed=entry.signed)
    frames = [f"21 {request(index, sub)} {entry.size:02X} 00 00 00", "00 " + data[:7].hex(" "),
              f"{0x11 | (14 - entry.size) << 1:02X} " + data[7:].ljust(7, b"\0").hex(" ")]  # fmt: skip
    for frame in frames:
        (answer,) = wire.receive(0x600 + NODE, frame)
        if answer.data[0] == 0x80:
            return int.from_bytes(answer.data[4:], "little")
    return 0


def another(wire: Wire, facts: Facts, entry: Entry, before: int) -> int | None:
    """Write another value that an object takes; return it, None where there is none within reach."""
    for raw in (before + 1, before - 1, 1, 0, 3):
        if raw != before and raw in entry.room and write(wire, facts, entry.index, raw, entry.sub) == 0:
            return raw
    return None


def set_mode(wire: Wire, facts: Facts, axis: int, mode: int = PV) -> None:
    """Choose a mode of operation, with what the maker's manual wants beforehand."""
    gate = facts.manual.before_mode
    if gate is not None:
        index, step, values, size = gate
        assert wire.download(index + step * axis, 0, values[mode], size) == 0
    if wire.value(MODE + PROFILE * axis) != mode:
        assert wire.download(MODE + PROFILE * axis, 0, mode, 1) == 0


def enable(wire: Wire, facts: Facts, axes=None, mode: int = PV) -> None:
    """Take axes to operation enabled by SDO."""
    for axis in facts.axes if axes is None else axes:
        set_mode(wire, facts, axis, mode)
        for word in (6, 7, 15):
            assert wire.download(CONTROLWORD + PROFILE * axis, 0, word, 2) == 0
    wire.wait(1)
    for axis in facts.axes if axes is None else axes:
        assert state(wire, axis) == ENABLED
    wire.take()


def state(wire: Wire, axis: int) -> int:
    """Return the state of an axis as the statusword tells it (CiA 402-2, table of states)."""
    word = wire.value(STATUSWORD + PROFILE * axis)
    return word & 0x4F if word & 0x4F in (SWITCH_ON_DISABLED, FAULT) else word & 0x6F


def states(wire: Wire, facts: Facts) -> list[int]:
    return [state(wire, axis) for axis in facts.axes]


def others(facts: Facts, axis: int, its: object, rest: object) -> list[object]:
    """Return a list by axis."""
    return [its if one == axis else rest for one in facts.axes]


def heat(wire: Wire, facts: Facts, axis: int | None) -> None:
    """Let the stage of an axis be too hot, of none: let all be cool."""
    hot = np.array([axis == one for one in facts.axes])
    wire.drives.machine.set_temperatures(25.0, np.where(hot, facts.manual.hot, 25.0))


def configure(wire: Wire, index: int, sub: int, raw: int, size: int) -> None:
    assert wire.download(index, sub, raw, size) == 0, f"{index:04X}h:{sub:02X} = {raw:X}h"


def give(wire: Wire, index: int, can_id: int, kind: int | None = None, mapped=None) -> None:
    """Give a PDO an identifier, a type and objects, in the order of CiA 301: off, none, these, their number, on."""
    configure(wire, index, 1, can_id | OFF | NO_REMOTE, 4)
    if kind is not None:
        configure(wire, index, 2, kind, 1)
    if mapped is not None:
        configure(wire, index + 0x200, 0, 0, 1)
        for sub, raw in enumerate(mapped, 1):
            configure(wire, index + 0x200, sub, raw, 4)
        configure(wire, index + 0x200, 0, len(mapped), 1)
    configure(wire, index, 1, can_id | NO_REMOTE, 4)


def silence(wire: Wire, facts: Facts, but: tuple[int, ...] = ()) -> None:
    """Switch every PDO that is sent off."""
    for index in facts.tpdos:
        if index not in but and not wire.value(index, 1) & OFF:
            configure(wire, index, 1, wire.value(index, 1) | OFF, 4)
