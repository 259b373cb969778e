"""Make the EDS of the TGZ-D from the rows of `tgz.csv`: `python -m research.servo_amplifiers.make_eds`.

A row is an entry of the first axis; those with a step get another, so much higher, for the second axis. Where a default
has two values, the second one is that axis'.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path

from drive_env import cia402

HERE = Path(__file__).parent
EDS = HERE.parents[1] / "drive_env" / "devices" / "tgz_d" / "tgz_d.eds"
# Data types of CiA 301, table 44.
TYPES = {"I8": 0x02, "I16": 0x03, "I32": 0x04, "U8": 0x05, "U16": 0x06, "U32": 0x07, "I64": 0x15}
# AccessType, by CiA 306, of what can be written and goes in a PDO: by whether received or sent ones carry it.
PROCESS_DATA = {"in": "rww", "out": "rwr"}
MANDATORY = (0x1000, 0x1001, 0x1018)
MAKERS = range(0x2000, cia402.PROFILE_AREAS.start)
VARIABLE, ARRAY, RECORD = "0x7", "0x8", "0x9"
ARRAYS = ("1003", "1010", "1011", "1016", "1029", "1C12", "1C13", "4002", "4003", "607D", "60E3")
HEAD = """[FileInfo]
FileName=tgz_d.eds
FileVersion=1
FileRevision=0
EDSVersion=4.0
Description=TGZ-D, servo amplifier of two axes
CreationTime=12:00AM
CreationDate=01-01-2026
CreatedBy=drive-env
ModificationTime=12:00AM
ModificationDate=01-01-2026
ModifiedBy=drive-env

[DeviceInfo]
VendorName=TG Drives
VendorNumber=0
ProductName=TGZ-D
ProductNumber=0x54475A44
RevisionNumber=0x00010000
OrderCode=TGZ-D
BaudRate_10=0
BaudRate_20=1
BaudRate_50=1
BaudRate_125=1
BaudRate_250=1
BaudRate_500=1
BaudRate_800=1
BaudRate_1000=1
SimpleBootUpMaster=0
SimpleBootUpSlave=1
Granularity=8
DynamicChannelsSupported=0
GroupMessaging=0
NrOfRXPDO=4
NrOfTXPDO=4
LSS_Supported=0

[Comments]
Lines=4
Line1=Objects of the TGZ-D and TGZ-S: names, access, mapping and defaults of their manual, types by CiA 301 and 402
Line2=where it tells none. Decisions stand in device.toml, the lines of the manual in research/servo_amplifiers.
Line3=Objects whose names begin with Extension are the emulator's. Registers of 23C0h to 23FFh, 25C0h to 25FFh and
Line4=33C0h to 33FFh have our numbers: the manual tells none.

[DummyUsage]
Dummy0001=0
Dummy0002=0
Dummy0003=0
Dummy0004=0
Dummy0005=0
Dummy0006=0
Dummy0007=0
"""

Row = dict[str, str]


def rows() -> Iterator[tuple[int, int, Row]]:
    """Return index, sub-index and row of every entry, those of the second axis with their own index."""
    with (HERE / "tgz.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            index, sub = int(row["index"].rstrip("h"), 16), int(row["sub"])
            first, *further = row["default"].split() or [""]
            yield index, sub, {**row, "default": first}
            if row["axes"] != "node":
                default = further[0] if further else first
                name = row["name"] if sub else f"{row['name']} axis 1"
                yield index + int(row["axes"].strip("+h"), 16), sub, {**row, "default": default, "name": name}


def number(text: str) -> str:
    """Return a number as an EDS has it: `7Fh` is 0x7F, `NODE+80h` depends on the node-ID."""
    if text.startswith("NODE+"):
        return f"$NODEID+{number(text.removeprefix('NODE+'))}"
    return f"0x{text[:-1]}" if text.endswith("h") else text


def entry(row: Row, section: str) -> str:
    """Return the section of an entry."""
    access = PROCESS_DATA.get(row["pdo"], "rw") if row["access"] == "rw" else row["access"]
    lines = [f"[{section}]", f"ParameterName={row['name']}", f"ObjectType={VARIABLE}"]
    lines += [f"DataType=0x{TYPES[row['type']]:04X}", f"AccessType={access}"]
    lines += [f"{key}={number(row[name])}" for key, name in (("LowLimit", "low"), ("HighLimit", "high")) if row[name]]
    lines += [f"DefaultValue={number(row['default'])}"] if row["default"] else []
    lines += [f"PDOMapping={int(row['pdo'] != 'no')}"]
    if row["unit"]:
        lines.append(f"Unit={row['unit']}")
    return "\n".join(lines) + "\n"


def eds() -> str:
    """Return the whole file."""
    objects: dict[int, dict[int, Row]] = {}
    for index, sub, row in rows():
        objects.setdefault(index, {})[sub] = row
    out = io.StringIO()
    out.write(HEAD)
    makers = [index for index in sorted(objects) if index in MAKERS]
    others = [index for index in sorted(objects) if index not in MAKERS and index not in MANDATORY]
    for name, members in (("Mandatory", list(MANDATORY)), ("Optional", others), ("Manufacturer", makers)):
        out.write(f"\n[{name}Objects]\nSupportedObjects={len(members)}\n")
        out.writelines(f"{k}=0x{index:04X}\n" for k, index in enumerate(members, 1))
    for index, subs in sorted(objects.items()):
        if len(subs) == 1 and 0 in subs:
            out.write("\n" + entry(subs[0], f"{index:04X}"))
            continue
        kind = ARRAY if f"{cia402.of_first_axis(index):04X}" in ARRAYS else RECORD
        out.write(f"\n[{index:04X}]\nParameterName={subs[0]['name']}\nObjectType={kind}\nSubNumber=0x{len(subs):X}\n")
        for sub, row in sorted(subs.items()):
            out.write("\n" + entry(row, f"{index:04X}sub{sub:X}"))
    return out.getvalue()


if __name__ == "__main__":
    EDS.write_text(eds(), encoding="utf-8")
