"""A bare drive with a closed loop: the bare stepper drive with the firmware stepper_loop and a row for each object.

Its objects beside the stepper's are those of the TMCM-3313 manual, with its recipe (tables 2 and 3) for a 40000-count
encoder.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import numpy as np

from drive_env import EmulatedDrives, motion
from drive_env.firmware.record import set_lanes
from drive_env.motors import MOTORS
from rigs import stepper_rig
from rigs.stepper_rig import SMOOTH
from tuning.target import Target

U8, U16, U32, I16, I32 = 0x05, 0x06, 0x07, 0x03, 0x04
# Index, sub-index, name, type, access, factory value, field, unit.
ROWS = (
    (0x2020, 0, "Closed loop mode", U8, "rw", 0, "loop_mode", "raw"),
    (0x2021, 0, "Correction position P", U32, "rw", 0, "position_correction_p", "raw"),
    (0x2022, 0, "Correction tolerance", U8, "rw", 0, "correction_tolerance", "inc"),
    (0x2027, 0, "Closed loop beta", U16, "rw", 255, "load_angle_limit", "raw"),
    (0x2028, 0, "Closed loop offset", I32, "rw", 0, "loop_offset", "inc"),
    (0x2029, 0, "Current scaler minimum", U8, "rw", 255, "current_scale_min", "raw"),
    (0x202A, 0, "Current scaler maximum", U8, "rw", 255, "current_scale_max", "raw"),
    (0x202B, 0, "Correction velocity P", U32, "rw", 0, "correction_velocity_p", "raw"),
    (0x202C, 0, "Correction velocity I", U32, "rw", 0, "correction_velocity_i", "raw"),
    (0x202D, 0, "Correction velocity I clipping", U16, "rw", 0, "correction_sum_limit", "raw"),
    (0x202E, 0, "Correction velocity DV clock", U16, "rw", 0, "derivative_divider", "raw"),
    (0x202F, 0, "Correction velocity DV clipping", U32, "rw", 2**31 - 1, "correction_velocity_limit", "pps"),
    (0x2030, 0, "Upscale delay", U32, "rw", 0, "upscale_delay", "raw"),
    (0x2031, 0, "Downscale delay", U32, "rw", 0, "downscale_delay", "raw"),
    (0x2033, 0, "Actual scaling factor", U8, "ro", 0, "loop_scale", "raw"),
    (0x2034, 0, "Field weakening minimum velocity", U32, "rw", 0, "weakening_velocity", "pps"),
    (0x2035, 0, "Field weakening maximum velocity", U32, "rw", 0, "weakening_width", "pps"),
    (0x2036, 0, "Field weakening", U8, "rw", 0, "weakening_angle", "raw"),
    (0x2110, 0, "Bow scaling factor", U8, "rw", 1, "jerk_factor", "raw"),  # 2015h is the bare drive's wait
    (0x2120, 0, "Closed loop initialisation flag", U8, "ro", 0, "loop_initialised", "raw"),
    (0x6071, 0, "Target torque", I16, "rw", 0, "target_torque", "mA"),
    (0x6077, 0, "Torque actual value", I16, "ro", 0, "torque_current", "mA"),
    (0x6086, 0, "Motion profile type", U16, "rw", 0, "profile_type", "raw"),
    (0x60A4, 1, "Profile jerk.1", U32, "rw", 0, "jerk_1", "pps^3"),
    (0x60A4, 2, "Profile jerk.2", U32, "rw", 0, "jerk_2", "pps^3"),
    (0x60A4, 3, "Profile jerk.3", U32, "rw", 0, "jerk_3", "pps^3"),
    (0x60A4, 4, "Profile jerk.4", U32, "rw", 0, "jerk_4", "pps^3"),
    (0x60B2, 0, "Torque offset", I16, "rw", 0, "torque_offset", "mA"),
)
LIMITS = {U8: (0, 255), U16: (0, 65535), U32: (0, 2**32 - 1), I16: (-(2**15), 2**15 - 1), I32: (-(2**31), 2**31 - 1)}

# Table 2 of the manual: what makes closed loop work. The currents are the tests' own.
RECIPE = {0x606A: 0, 0x2027: 255, 0x2029: 50, 0x202A: 255, 0x2022: 255, 0x2030: 1000, 0x2031: 10_000, 0x202B: 3000,
          0x202C: 20, 0x202D: 2000, 0x202E: 0, 0x202F: 100_000, 0x2021: 65_536}  # fmt: skip
# Table 3: position PID.
PID_RECIPE = {0x606A: 0, 0x2022: 255, 0x202B: 8000, 0x202C: 500, 0x202D: 400, 0x202E: 2, 0x202F: 400_000,
              0x2021: 10_000}  # fmt: skip


def entry(name, kind, access, value):
    low, high = LIMITS[kind]
    return (
        f"ParameterName={name}\nObjectType=0x7\nDataType=0x{kind:04X}\nAccessType={access}\nDefaultValue={value}\n"
        f"LowLimit={low}\nHighLimit={high}\nPDOMapping=1\n"
    )


def device_folder():
    """Write the device's folder beside no other, and return its path."""
    folder = Path(tempfile.mkdtemp(prefix="bare-loop-")) / "bare_loop"
    shutil.copytree(stepper_rig.BARE, folder)
    device = folder / "device.toml"
    text = device.read_text(encoding="utf-8").replace('firmware = "stepper"', 'firmware = "stepper_loop"')
    text = text.replace('name = "bare_stepper"', 'name = "bare_loop"')
    device.write_text(text.replace("[0, 1, 3, 6, 8, 9] # no cst", "[0, 1, 3, 6, 8, 9, 10]"), encoding="utf-8")
    eds = (folder / "bare.eds").read_text(encoding="utf-8")
    head, manufacturer = eds.split("[ManufacturerObjects]")
    parts = {True: head, False: manufacturer}
    indices = sorted({row[0] for row in ROWS})
    for standard, first in ((True, "[OptionalObjects]"), (False, "")):
        mine = [index for index in indices if (index >= 0x6000) is standard]
        text = parts[standard]
        start = text.index("SupportedObjects=", text.index(first)) if first else text.index("SupportedObjects=")
        end = text.index("\n", start)
        count = int(text[start + 17 : end])
        stop = text.index("\n\n", end)
        listed = "".join(f"\n{count + k}=0x{index:04X}" for k, index in enumerate(mine, 1))
        parts[standard] = f"{text[:start]}SupportedObjects={count + len(mine)}{text[end:stop]}{listed}{text[stop:]}"
    objects = ""
    for index in indices:
        rows = [row for row in ROWS if row[0] == index]
        if rows[0][1] == 0:
            objects += f"\n[{index:04X}]\n" + entry(*rows[0][2:6])
            continue
        objects += f"\n[{index:04X}]\nParameterName={rows[0][2].split('.')[0]}\nObjectType=0x8\n"
        objects += f"SubNumber=0x{len(rows) + 1:X}\n\n[{index:04X}sub0]\n" + entry("Highest", U8, "ro", len(rows))
        for row in rows:
            objects += f"\n[{index:04X}sub{row[1]}]\n" + entry(row[2].split(".")[1], *row[3:6])
    text = parts[True] + "[ManufacturerObjects]" + parts[False]
    (folder / "bare.eds").write_text(text.rstrip("\n") + "\n" + objects, encoding="utf-8")
    with (folder / "bindings.toml").open("a", encoding="utf-8") as bindings:
        for index, sub, _, _, _, _, field, unit in ROWS:
            bindings.write(f'"{index:04X}:{sub}" = {{ field = "{field}", unit = "{unit}" }}\n')
    return str(folder)


BARE_LOOP = device_folder()


def build(motor="qsh4218_51", *, recipe=RECIPE, parameters=None, **options):
    """Return drives of a motor whose largest current is the rated one, with a recipe; not yet enabled."""
    options = {"num_threads": 1, "supply": MOTORS[motor].voltage, **options}
    given = SMOOTH | {"motor.viscous": MOTORS[motor].viscous} if parameters is None else parameters
    drives = EmulatedDrives(BARE_LOOP, "inertia", motor, parameters=given, **options)
    set_lanes(drives.inside.records, "full_scale_current", np.full(drives.num_axes, MOTORS[motor].rated_current))
    for index, value in (recipe or {}).items():
        drives.write(index, value)
    return drives


def close_loop(drives, mode=1, *, operation="pp"):
    """Enable, write 2020h, and wait until the loop is closed (manual, section 1.5)."""
    motion.enable(drives, mode=operation)
    drives.write(0x2020, mode)
    for _ in range(350):
        drives.advance(0.01)
        if np.all(drives.read(0x2120)[np.broadcast_to(mode, drives.num_axes) == 1] == 1):
            return
    raise AssertionError("the loop did not close")


NAME = "qsh4218_51"
MOTOR = MOTORS[NAME]


def target_of(drives):
    count, device = drives.num_axes, drives.device
    low, high = np.full(count, -60.0), np.full(count, 60.0)
    return Target(
        drives, device, MOTOR, np.full(count, MOTOR.voltage), low, high, MOTOR.rated_speed, MOTOR.rated_current
    )
