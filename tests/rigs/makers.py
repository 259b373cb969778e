"""Device files in the manner of six makers beside those of tests/data/eds: a row of `MANNERS` each, three drives each.

Facts of layout alone: which objects, types, limits, process data and spellings their files have. No such drive exists.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from rigs.small_eds import FOLDER, entry

TYPES = {"i8": 2, "i16": 3, "i32": 4, "u8": 5, "u16": 6, "u32": 7, "text": 9}
# Index and sub-index, type, access, default, whether a PDO carries it, name.
TABLE = """
1000   u32  ro    0x00020192  0 Device type
1001   u8   ro    0           0 Error register
1005   u32  rw    0x80        0 COB-ID SYNC
1008   text const Drive       0 Device name
1010:0 u8   ro    3           0 Store parameters
1010:1 u32  rw    1           0 All parameters
1010:2 u32  rw    1           0 Communication parameters
1010:3 u32  rw    1           0 Application parameters
1011:0 u8   ro    3           0 Restore default parameters
1011:1 u32  rw    1           0 All parameters
1011:2 u32  rw    1           0 Communication parameters
1011:3 u32  rw    1           0 Application parameters
1014   u32  rw    $+0x80      0 COB-ID EMCY
1016:0 u8   ro    1           0 Consumer heartbeat time
1016:1 u32  rw    0           0 Consumer 1
1017   u16  rw    0           0 Producer heartbeat time
1018:0 u8   ro    4           0 Identity
1018:1 u32  ro    0xE0A       0 Vendor-ID
1018:2 u32  ro    0x21        0 Product code
1018:3 u32  ro    0x10000     0 Revision number
1018:4 u32  ro    0           0 Serial number
2010   u16  rw    7           0 Current controller bandwidth
6007   i16  rw    1           0 Abort connection option code
603F   u16  ro    0           1 Error code
6040   u16  rw    0           1 Controlword
6041   u16  ro    0           1 Statusword
605A   i16  rw    2           0 Quick stop option code
6060   i8   rw    0           1 Modes of operation
6061   i8   ro    0           1 Modes of operation display
6062   i32  ro    0           1 Position demand value
6064   i32  ro    0           1 Position actual value
6065   u32  rw    0xFFFFFFFF  0 Following error window
6067   u32  rw    100         0 Position window
6068   u16  rw    10          0 Position window time
606C   i32  ro    0           1 Velocity actual value
6071   i16  rw    0           1 Target torque
6072   u16  rw    1000        1 Max torque
6073   u16  rw    2000        0 Max current
6075   u32  rw    3000        0 Motor rated current
6077   i16  ro    0           1 Torque actual value
607A   i32  rw    0           1 Target position
607C   i32  rw    0           0 Home offset
607D:0 u8   ro    2           0 Software position limit
607D:1 i32  rw    -0x80000000 0 Min position limit
607D:2 i32  rw    0x7FFFFFFF  0 Max position limit
607F   u32  rw    0           0 Max profile velocity
6080   u32  rw    6000        0 Max motor speed
6081   u32  rw    1000        1 Profile velocity
6083   u32  rw    10000       1 Profile acceleration
6084   u32  rw    10000       1 Profile deceleration
6085   u32  rw    50000       0 Quick stop deceleration
608F:0 u8   ro    2           0 Position encoder resolution
608F:1 u32  rw    4096        0 Encoder increments
608F:2 u32  rw    1           0 Motor revolutions
6098   i8   rw    35          1 Homing method
6099:0 u8   ro    2           0 Homing speeds
6099:1 u32  rw    100         0 Speed for switch search
6099:2 u32  rw    10          0 Speed for zero search
609A   u32  rw    1000        0 Homing acceleration
60C2:0 u8   ro    2           0 Interpolation time period
60C2:1 u8   rw    1           0 Value
60C2:2 i8   rw    -3          0 Index
60F4   i32  ro    0           1 Following error actual value
60FD   u32  ro    0           1 Digital inputs
60FF   i32  rw    0           1 Target velocity
6502   u32  ro    0x3A5       0 Supported drive modes
"""
USUAL_RPDOS = ((0x6040,), (0x6040, 0x6060), (0x6040, 0x607A), (0x6040, 0x60FF))
USUAL_TPDOS = ((0x6041,), (0x6041, 0x6061), (0x6041, 0x6064), (0x6041, 0x606C))


@dataclass(frozen=True)
class Manner:
    """A maker's way of writing a drive's file.

    Attributes:
        changed: Object ("607F", "607D:1") -> values of its section that differ from the table's.
        without: Objects that its drives do not have.
        rpdos, tpdos: What each PDO maps.
        rpdo_type, tpdo_type: Their transmission types.
        fixed: Keys of PDO parameters that can only be read: "cob" (sub-index 1), "type", "map".
        room: Entries of a mapping.
        empty_mapping: It has mappings that have sub-index 0 alone.
        node_id: A sum with the node-ID, of a number.
        hexadecimal: Whether numbers are.
        end, encoding: Of the file.
        compact: Mappings are described once (CompactSubObj).
        stored: A DCF's values.
        parts: Differences of the maker's second and third drive.
    """

    changed: dict[str, dict[str, object]] = field(default_factory=dict)
    without: tuple[str, ...] = ()
    rpdos: tuple[tuple[int, ...], ...] = USUAL_RPDOS
    tpdos: tuple[tuple[int, ...], ...] = USUAL_TPDOS
    rpdo_type: int = 255
    tpdo_type: int = 255
    fixed: str = ""
    room: int = 8
    empty_mapping: bool = False
    node_id: str = "$NODEID+0x{:X}"
    hexadecimal: bool = False
    end: str = "\n"
    encoding: str = "utf-8"
    compact: bool = False
    stored: dict[str, int] = field(default_factory=dict)
    parts: tuple[dict[str, object], ...] = ({}, {})


RPM = {index: {"Unit": "rpm"} for index in ("606C", "60FF", "6081", "607F")}
MANNERS = {
    # Speeds with a lowest one, no default of their limit, umlauts of cp1252.
    "glarus": Manner(
        changed={**RPM, "607F": {"LowLimit": 1, "DefaultValue": None, "HighLimit": 50000, "Unit": "rpm"},
                 "6080": {"LowLimit": 1, "DefaultValue": None}, "6081": {"LowLimit": 1, "Unit": "rpm"},
                 "6065": {"LowLimit": 0, "HighLimit": 2147483647, "DefaultValue": 200000},
                 "2010": {"ParameterName": "Stromregler für Wicklung"}},
        end="\r\n", encoding="cp1252", hexadecimal=True,
        parts=({"607F": {"LowLimit": 1, "DefaultValue": 3000, "Unit": "rpm"}},
               {"607D:1": {"LowLimit": -1000000, "DefaultValue": 0},
                "607D:2": {"HighLimit": 1000000, "DefaultValue": 0}}),
    ),
    # A byte order mark; limits of speed, torque and current; hexadecimal with a suffix.
    "helvia": Manner(
        changed={"607F": {"LowLimit": 100, "HighLimit": 5000000, "DefaultValue": None},
                 "6072": {"HighLimit": 1500, "LowLimit": 1, "DefaultValue": None},
                 "6073": {"HighLimit": 1500, "DefaultValue": 1000}, "6067": {"LowLimit": 1, "HighLimit": 1000},
                 "608F:1": {"DefaultValue": 65536}},
        encoding="utf-8-sig", node_id="0x{:X}+$NODEID",
        parts=({"608F:1": {"DefaultValue": "80000h"}, "607D:1": {"LowLimit": -2147483647},
                "607D:2": {"HighLimit": 2147483646}}, {"6065": {"HighLimit": 500000}, "6075": {"HighLimit": 2000},
                                                      "without": ("6080", "6073")}),
    ),
    # Limits that contradict the standard's formats; mappings of sub-index 0 alone, others described once.
    "iberis": Manner(
        changed={"1016:1": {"HighLimit": 65535, "LowLimit": 0}, "1005": {"HighLimit": "0x7FF"},
                 "1014": {"HighLimit": "0x7FF", "LowLimit": 1}, "1400:1": {"HighLimit": "0x57F", "LowLimit": "0x181"},
                 "1800:1": {"HighLimit": "0x57F", "LowLimit": "0x181"}},
        room=4, empty_mapping=True, compact=True, hexadecimal=True,
        parts=({"608F:1": {"DefaultValue": 10000}}, {"compact": False, "end": "\r\n", "room": 2}),
    ),
    # Process data whose identifiers can only be read.
    "jura": Manner(
        rpdos=((0x6040,), (0x607A,), (0x60FF,)), tpdos=((0x6041, 0x6064), (0x606C, 0x6077)), fixed="cob",
        node_id="$NODEID + 0x{:X}",
        parts=({"rpdos": USUAL_RPDOS, "tpdo_type": 1, "fixed": "cob type map"},
               {"fixed": "cob type", "tpdo_type": 254, "rpdo_type": 254}),
    ),
    # A DCF: what the tool has written to one drive.
    "kymi": Manner(
        changed=RPM, hexadecimal=True, end="\r\n",
        stored={"6081": 700, "6083": 22000, "1017": 250, "2010": 12, "6065": 150000, "1801:2": 10, "1800:1": 0x181 + 7},
        parts=({"608F:1": {"DefaultValue": 2000}, "stored": {"608F:1": 8000, "6081": 333, "607F": 2000}},
               {"stored": {"1A01:0": 1, "6098": 37, "6041": 0x1637, "607A": 5, "6060": 3, "605A": 77}}),
    ),
    # Objects of other widths; no heartbeat consumer and no life guarding; few modes.
    "lotus": Manner(
        changed={"6077": {"DataType": "i32"}, "6071": {"DataType": "i32"}, "6060": {"DataType": "i16"},
                 "6061": {"DataType": "i16"}, "6068": {"DataType": "u32"}},
        without=("1016",), tpdos=((0x6041, 0x6064), (0x606C, 0x6077)),
        parts=({"6502": {"DefaultValue": 0x25}, "without": ("1016", "6071", "6072")},
               {"6502": {"DefaultValue": 0x21}, "without": ("1016", "60FF", "6072", "1010", "1011")}),
    ),
}  # fmt: skip


def files() -> dict[str, bytes]:
    """The content of every maker's file by its name: those of tests/data/eds, and those made here."""
    found = {path.stem: path.read_bytes() for path in sorted(FOLDER.rglob("*.eds"))}
    for name, manner in MANNERS.items():
        for k, part in enumerate(({}, *manner.parts)):
            own = {key: value for key, value in part.items() if key in Manner.__dataclass_fields__}
            changed = manner.changed | {key: value for key, value in part.items() if key not in own}
            made = Manner(**{**vars(manner), **own, "changed": changed, "parts": ()})
            found[f"{name}_{k + 1}"] = made_file(made, name.capitalize(), k + 1)
    return found | {"granit_fu1": _with_ramp_times(found["granit_fu3"])}


def _with_ramp_times(inverter: bytes) -> bytes:
    """Return an inverter's file with 6047h, and three times in ms, 604Fh to 6051h, in place of 6048h to 604Ah."""
    head, rest = inverter.decode().split("[6048]", 1)
    names = ("reference", "ramp function time", "slow down time", "quick stop time")
    more = entry("6045", "vl manipulated velocity", data_type="0x0003", access="ro", DefaultValue="0")
    more += entry("6047", "vl velocity min max", kind="0x9", data_type=None, access=None, SubNumber="5")
    more += entry("6047sub0", "Entries", data_type="0x0005", access="const", DefaultValue="4")
    more += "".join(entry(f"6047sub{sub}", f"Limit {sub}", DefaultValue="0") for sub in range(1, 5))
    more += "".join(entry(f"{0x604E + k:X}", f"vl {name}", DefaultValue="0") for k, name in enumerate(names))
    return f"{head}{more}[604B]{rest.split('[604B]', 1)[1]}".encode()


def made_file(manner: Manner, vendor: str, number: int) -> bytes:
    """Return the content of a drive's file."""
    sections = _sections(manner)
    for key, changes in manner.changed.items():
        if key[:4] not in manner.without:
            sections[_name(key)] |= changes
    for key, value in manner.stored.items():
        sections[_name(key)]["ParameterValue"] = value
    indices = sorted({name[:4] for name in sections})
    lines = ["[FileInfo]", f"FileName={vendor}{number}.eds", "[DeviceInfo]", f"VendorName={vendor} Antriebe"]
    lines += [f"ProductName={vendor} {number}", "[OptionalObjects]", f"SupportedObjects={len(indices)}"]
    lines += [f"{k}=0x{index}" for k, index in enumerate(indices, 1)]
    if manner.stored:
        lines += ["[DeviceComissioning]", "NodeID=7", "Baudrate=500"]
    for name, row in sections.items():
        lines += [
            f"[{name}]",
            *(f"{key}={_shown(manner, key, value)}" for key, value in row.items() if value is not None),
        ]
    return (manner.end.join(lines) + manner.end).encode(manner.encoding)


def _sections(manner: Manner) -> dict[str, dict[str, object]]:
    found: dict[str, dict[str, object]] = {}
    for line in TABLE.split("\n")[1:-1]:
        place, kind, access, default, mapped, name = line.split(None, 5)
        if place[:4] in manner.without:
            continue
        value = (
            default
            if kind == "text"
            else manner.node_id.format(int(default[2:], 0))
            if "$" in default
            else int(default, 0)
        )
        _add(found, place, name, kind, access, value, mapped)
    fixed = {part: "ro" if part in manner.fixed.split() else "rw" for part in ("cob", "type", "map")}
    bits = {key: 8 * {"i8": 1, "u8": 1, "i16": 2, "u16": 2}.get(kind, 4) for key, kind in _kinds(manner).items()}
    for first, pdos, identifier, kind in (
        (0x1400, manner.rpdos, 0x200, manner.rpdo_type), (0x1800, manner.tpdos, 0x180, manner.tpdo_type),
    ):  # fmt: skip
        for k, mapped in enumerate(pdos):
            cob_id = manner.node_id.format(identifier + 0x100 * k)
            _add(found, f"{first + k:04X}:0", "PDO parameter", "u8", "ro", 2)
            _add(found, f"{first + k:04X}:1", "COB-ID", "u32", fixed["cob"], cob_id)
            _add(found, f"{first + k:04X}:2", "Type", "u8", fixed["type"], kind)
            index = f"{first + 0x200 + k:04X}"
            raws = [one << 16 | bits[one] for one in mapped]
            if manner.compact:
                found[index] = {"ParameterName": "Mapping", "ObjectType": 8, "DataType": "u32", "PDOMapping": 0,
                                "AccessType": fixed["map"], "CompactSubObj": manner.room,
                                "DefaultValue": 0}  # fmt: skip
                found[f"{index}Value"] = {"NrOfEntries": len(raws)} | {str(sub): raw for sub, raw in enumerate(raws, 1)}
                _add(found, f"{index}:0", "Number of entries", "u8", fixed["map"], len(raws))
                continue
            _add(found, f"{index}:0", "Mapping", "u8", fixed["map"], len(raws))
            for sub in range(1, manner.room + 1):
                _add(found, f"{index}:{sub}", f"Entry {sub}", "u32", fixed["map"], (raws + [0] * manner.room)[sub - 1])
    for index in (0x1600 + len(manner.rpdos), 0x1A00 + len(manner.tpdos)) if manner.empty_mapping else ():
        _add(found, f"{index - 0x200:04X}:1", "COB-ID", "u32", "rw", 0x80000000)
        _add(found, f"{index - 0x200:04X}:2", "Type", "u8", "rw", 255)
        _add(found, f"{index:04X}:0", "Mapping", "u8", "rw", 0)
    return found


def _kinds(manner: Manner) -> dict[int, str]:
    """Types of what is mapped, as a maker who has another width maps it by the standard's, where it is 6077h."""
    kinds = {int(line[:4], 16): line.split()[1] for line in TABLE.split("\n")[1:-1] if ":" not in line.split()[0]}
    changed = {int(key, 16): str(row["DataType"]) for key, row in manner.changed.items() if "DataType" in row}
    return kinds | {index: kind for index, kind in changed.items() if index != 0x6077}


def _add(found: dict[str, dict[str, object]], place: str, name: str, kind: str, access: str, value: object,
         mapped: str = "0") -> None:  # fmt: skip
    index, _, sub = place.partition(":")
    if sub and index not in found:
        found[index] = {"ParameterName": name, "ObjectType": 9}
    found[_name(place)] = {"ParameterName": name, "ObjectType": 7, "DataType": kind, "AccessType": access,
                           "DefaultValue": value, "PDOMapping": mapped}  # fmt: skip


def _name(place: str) -> str:
    index, _, sub = place.partition(":")
    return f"{index}sub{int(sub):X}" if sub else index


def _shown(manner: Manner, key: str, value: object) -> str:
    if key == "DataType":
        return f"0x{TYPES[str(value)]:04X}"
    if (
        isinstance(value, int)
        and value >= 0
        and manner.hexadecimal
        and key not in ("SubNumber", "PDOMapping", "CompactSubObj")
    ):
        return f"0x{value:X}"
    return str(value)
