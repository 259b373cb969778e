"""A module of six axes, made of a drive of one: the TMCM-1636's data with the structure of a multi-axis CANopen node.

manufacturer objects  2000h to 21FFh, 200h further for each axis; those of the module at 3000h and on, once
profile objects       6000h to 67FFh, 800h further
PDOs                  numbers 1 to 4, 65 to 68, 129 to 132, ...: those of further axes have no identifier at first
received PDOs         take effect as they come; their type cannot be written
emergencies           tell the axis in their second additional byte
"""

from __future__ import annotations

import configparser
import shutil

import numpy as np

from drive_env import EmulatedDrives
from drive_env.devices import FOLDER, find_device

AXES = 6
MODULE = 0x900  # from 2702h to 3002h: objects of the module
BASE = FOLDER / "tmcm1636"


def shifted(index, axis):
    """Return the index of an object for an axis."""
    if 0x2702 <= index < 0x2800:
        return index + MODULE
    if 0x2000 <= index < 0x2200:
        return index + 0x200 * axis
    if 0x6000 <= index < 0x6800:
        return index + 0x800 * axis
    return index + 0x40 * axis if 0x1400 <= index < 0x1C00 else index


def moved(key, axis=0):
    """Return "2703:1" for an axis."""
    index, _, sub = key.partition(":")
    return f"{shifted(int(index, 16), axis):04X}:{sub}"


def write_eds(path):
    """Write the dictionary: axis 0 as it is, the others with their offsets."""
    before = configparser.RawConfigParser(comment_prefixes=(";",))
    before.optionxform = str
    before.read_string((BASE / "tmcm1636.eds").read_text(encoding="utf-8"))
    after = configparser.RawConfigParser()
    after.optionxform = str
    for section in before.sections():
        if not all(letter in "0123456789ABCDEF" for letter in section[:4]):
            after[section] = dict(before[section])
            continue
        index, rest = int(section[:4], 16), section[4:]
        for axis in range(AXES):
            name = f"{shifted(index, axis):04X}{rest}"
            if name in after:
                continue
            row = dict(before[section])
            if index == 0x2702:
                row["HighLimit"] = "0xFFFFFFFF"
            if index == 0x2005:
                row["ParameterName"] = "Switch parameters"  # nobody knows it by its name
            if axis:
                row["ParameterName"] += f" axis {axis}"
            kind = index & 0xFE00
            if kind in (0x1400, 0x1800) and rest == "sub1" and axis:
                row["DefaultValue"] = "0xC0000000"
            if kind == 0x1400 and rest == "sub2":
                row["AccessType"] = "ro"
            if kind in (0x1600, 0x1A00) and rest and rest != "sub0" and int(row["DefaultValue"], 0):
                row["DefaultValue"] = f"0x{int(row['DefaultValue'], 0) + (axis * 0x800 << 16):08X}"
            after[name] = row
    for index, word in (("1010", "Save"), ("1011", "Restore")):
        after[index]["SubNumber"] = "0xB"
        after[f"{index}sub0"].update(DefaultValue="10", HighLimit="10", LowLimit="10")
        for sub in range(5, 11):
            after[f"{index}sub{sub:X}"] = dict(after[f"{index}sub4"]) | {"ParameterName": f"{word} group {sub}"}
    with path.open("w", encoding="utf-8") as file:
        after.write(file, space_around_delimiters=False)


def build(folder):
    """Write the module's folder and return it."""
    folder.mkdir(parents=True, exist_ok=True)
    write_eds(folder / "six.eds")
    text = (BASE / "device.toml").read_text(encoding="utf-8")
    for old, new in (
        ('eds = "tmcm1636.eds"', 'eds = "six.eds"'),
        (
            "axes = 1\n",
            f"axes = {AXES}\naxis_offsets = [{{ first = 0x2000, last = 0x21FF, step = 0x200 }}, "
            "{ first = 0x6000, last = 0x67FF, step = 0x800 }, "
            + ", ".join(
                f"{{ first = 0x{first:04X}, last = 0x{first + 0x3F:04X}, step = 0x40 }}"
                for first in (0x1400, 0x1600, 0x1800, 0x1A00)
            )
            + "]\n",
        ),
        ("bytes = [0, 0, 0, 0, 0]", 'bytes = [0, "axis", 0, 0, 0]'),
        *((f"bytes = [{k}, 0, 0, 0, 0]", f'bytes = [{k}, "axis", 0, 0, 0]') for k in range(1, 5)),
        (
            '4 = ["motor 0"]',
            "\n".join(f'{axis + 4} = ["motor {axis}"]' for axis in range(AXES)) + '\n10 = ["module"]',
        ),
        (
            '"profile", "motor 0"]',
            '"profile", ' + ", ".join(f'"motor {axis}"' for axis in range(AXES)) + ', "module"]',
        ),
    ):
        assert old in text, old
        text = text.replace(old, new)
    for index in range(0x2702, 0x270F):
        text = text.replace(f'"{index:04X}:', f'"{index + MODULE:04X}:').replace(
            f"\n{index:04X} = ", f"\n{index + MODULE:04X} = "
        )
    (folder / "device.toml").write_text(text, encoding="utf-8")
    rows = [
        f'"{moved(f"{row.index:04X}:{row.sub}")}" = {{ field = "{row.field}", unit = "{row.unit}", part = {row.part}, '
        f'event = "{row.event}" }}'
        for row in find_device("tmcm1636").bindings.values()
        if row.index != 0x2702  # 3002h has the inputs of the module, which belong to no axis
    ]
    (folder / "bindings.toml").write_text("\n".join(rows) + "\n", encoding="utf-8")
    roles = (BASE / "roles.toml").read_text(encoding="utf-8")
    for index in range(0x2702, 0x270F):
        roles = roles.replace(f'"{index:04X}:', f'"{index + MODULE:04X}:')
    (folder / "roles.toml").write_text(roles + 'digital_inputs = "3002:0"\n', encoding="utf-8")
    shutil.copy(BASE / "gains.toml", folder / "gains.toml")
    shutil.copytree(BASE / "presets", folder / "presets", dirs_exist_ok=True)
    return folder


def six_axes(folder):
    """Return the module, written into a folder, as a device."""
    return find_device(str(build(folder)))


AXES, WIRED = 6, (1, 3)


def partly_wired(**options):
    """Return the six axes of a TMCM-6212 of which two have a motor."""
    no_motor = np.array([float(axis not in WIRED) for axis in range(AXES)])
    parameters = {"motor.open_a": no_motor, "motor.open_b": no_motor}
    return EmulatedDrives("tmcm6212", "inertia", num_machines=AXES, num_threads=1, parameters=parameters, **options)
