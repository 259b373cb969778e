"""A page for every device: its data, gains, roles, emergencies and all objects of its dictionary."""

from __future__ import annotations

from tables import table, unit

from drive_env.devices import AXIS, Device, device_names, find_device
from drive_env.dictionary.entries import Entry
from drive_env.firmware import motor_kinds

FOLDER = "reference/devices"
SECTIONS = (
    ("Communication objects (1000h to 1FFFh)", 0x1000, 0x1FFF, "CiA 301"),
    ("Objects of the manufacturer (2000h to 5FFFh)", 0x2000, 0x5FFF, "the manufacturer"),
    ("Objects of the drive profile (6000h to 9FFFh)", 0x6000, 0x9FFF, "CiA 402"),
)
INDEX = """# Devices

The drives that are emulated, and that the commands know on a bus. Each page is made from the device's folder: its EDS
and the tables beside it.

{table}
Any other CiA 402 drive is addressed [by its EDS](../../how-to/drive-env.md#a-drive-that-drive-env-does-not-know). A
variant (`my_variant.toml`) or a whole device of your own (the folder `my_drive/`) is data as well, and its path stands
wherever a device's name does: `drive-env serve my_variant.toml`, `--device my_drive/`. The files are in
[file formats](../file-formats.md#device).
"""


def pages() -> dict[str, str]:
    """Return the index and a page for each device."""
    devices = [find_device(name) for name in device_names()]
    rows = [(f"[`{one.name}`]({one.name}.md)", one.title, one.num_axes, len(one.new_dictionary())) for one in devices]
    index = INDEX.format(table=table(("name", "device", "axes", "objects"), rows))
    return {f"{FOLDER}/index.md": index, **{f"{FOLDER}/{one.name}.md": page(one) for one in devices}}


def page(device: Device) -> str:
    """Return the page of a device."""
    parts = [f"# {device.name}\n", f"{device.title}.\n"]
    if device.variant_of:
        parts.append(
            f"A variant of [`{device.variant_of}`]({device.variant_of}.md): what differs is in its `device.toml`, and "
            "all of it is below.\n"
        )
    if device.about:
        parts.append(f"{device.about}\n")
    parts += [facts(device), gains(device), roles(device), emergencies(device), objects(device)]
    return "\n".join(parts)


def facts(device: Device) -> str:
    """Return the device's figures."""
    is_stepper = "stepper" in motor_kinds(device.firmware_name)
    peak = "peak of a phase" if is_stepper else "peak i_q"
    fast, slow = ("windings", "steps and choppers") if is_stepper else ("current loop", "velocity and position loop")
    rows = [
        ("axes", device.num_axes, ""),
        (fast, f"{device.current_rate:g}", "Hz"),
        (slow, f"{device.velocity_rate:g}", "Hz"),
        ("supervision, modes and profiles", f"{device.supervision_rate:g}", "Hz"),
        ("communication cycle", f"{1e3 / device.communication_rate:g}", "ms"),
        ("supply voltage", f"{device.undervoltage:g} to {device.overvoltage:g}", "V"),
        (f"current that it carries continuously, {peak}", f"{device.nominal_current:g}", "A"),
        (f"overcurrent, {peak}", f"{device.overcurrent:g}", "A"),
        ("temperature: warning, error", f"{device.warning_temperature:g}, {device.error_temperature:g}", "°C"),
        ("longest wait for an SDO answer", f"{device.master.timeout:g}", "s"),
    ]
    stage = [
        (f"`stage.{name}`", one.default, f"{one.low:g} to {one.high:g}", unit(one.unit), one.source)
        for name, one in device.stage.items()
    ]
    return (
        "## Figures\n\n"
        + table(("", "value", "unit"), rows)
        + "\nThe power stage and its measurement have imperfections, each of which can be set for each machine "
        "(`drives.machine.set`). *Range* is what `randomise=True` draws from. Sources: M is the maker's manual, C a "
        "value usual for drives of this class, D our own decision where the manual is silent.\n\n"
        + table(("parameter", "default", "range", "unit", "source"), stage)
    )


def gains(device: Device) -> str:
    """Return the gains that tuners set."""
    rows = [
        (f"`{one.name}`", one.title, key(*one.key), one.loop, one.part, f"0 to {one.highest}")
        for one in device.gains.rows
    ]
    head = ("name", "gain", "object", "loop", "part", "integers")
    return "## Gains\n\nWhat tuners and agents set, and `drive-tune` prints.\n\n" + table(head, rows)


def roles(device: Device) -> str:
    """Return which object plays which part."""
    dictionary = device.new_dictionary()
    first = next(iter(device.roles))
    rows = [
        (f"`Role.{role.name}`", role.value, key(*place), dictionary.find(place).name)
        for role, place in device.roles.items()
    ]
    return (
        "## Roles\n\nObjects that programs ask for by the part that they play, whatever a drive's index is: "
        f"`drives.read(Role.{first.name})`.\n\n" + table(("role", "part", "object", "name"), rows)
    )


def emergencies(device: Device) -> str:
    """Return the emergency messages."""
    rows = [
        (f"{one.code:04X}h", " ".join(map(_byte, one.extra)), name.replace("_", " "))
        for name, one in sorted(device.emergencies.items(), key=lambda item: (item[1].code, item[1].extra))
    ]
    return (
        "## Emergencies\n\nCode, the five additional bytes (hexadecimal), and what it means. What causes each of them "
        "on purpose is in [Faults](../../faults.md).\n\n" + table(("code", "bytes", "meaning"), rows)
    )


def _byte(byte: int) -> str:
    return "axis" if byte == AXIS else f"{byte:02X}"


def objects(device: Device) -> str:
    """Return every object of the dictionary, by section."""
    parts = [
        "## Objects\n",
        "*Limits* are left out where an integer takes every value of its type. Access: `ro` read only, `rw` read and "
        "write, `wo` write only, `const` constant. *PDO*: it can be mapped.\n",
    ]
    entries = list(device.new_dictionary())
    by_place = {place: role for role, place in device.roles.items()}
    for title, first, last, whose in SECTIONS:
        rows = [
            (
                key(entry.index, entry.sub),
                entry.name,
                kind(entry),
                entry.access,
                unit(entry.unit),
                limits(entry),
                default(entry),
                "yes" if entry.pdo_mappable else "",
                notes(device, entry, by_place),
            )
            for entry in entries
            if first <= entry.index <= last
        ]
        head = ("object", "name", "type", "access", "unit", "limits", "default", "PDO", "notes")
        if rows:
            parts.append(f"### {title}\n\n{len(rows)} objects of {whose}.\n\n{table(head, rows)}")
    return "\n".join(parts)


def key(index: int, sub: int) -> str:
    """Return an object as messages write it."""
    return f"{index:04X}h:{sub:02X}"


def kind(entry: Entry) -> str:
    """Return the type, e.g. i32."""
    return "text" if entry.bits is None else f"{'i' if entry.signed else 'u'}{entry.bits}"


def limits(entry: Entry) -> str:
    """Return the limits where they are narrower than the type's."""
    if entry.bits is None or entry.low is None or entry.high is None:
        return ""
    whole = (-(2 ** (entry.bits - 1)), 2 ** (entry.bits - 1) - 1) if entry.signed else (0, 2**entry.bits - 1)
    return "" if (entry.low, entry.high) == whole else f"{entry.low} to {entry.high}"


def default(entry: Entry) -> str:
    """Return the default; identifiers and mappings of the communication objects as hexadecimal numbers."""
    if isinstance(entry.default, str):
        return entry.default
    if entry.index < 0x2000 and entry.default > 255:
        return f"{entry.default:X}h"
    return str(entry.default)


def notes(device: Device, entry: Entry, by_place: dict[tuple[int, int], object]) -> str:
    """Return the notes on an object: its role, allowed values and the like."""
    place = (entry.index, entry.sub)
    found = []
    if place in by_place:
        found.append(f"`{by_place[place]}`")
    if place in device.allowed_values:
        found.append("takes " + ranges(device.allowed_values[place]))
    if place in device.write_states:
        found.append(f"written in {device.write_states[place].replace('_', ' ').lower()} only")
    if why := device.without_effect.get((device.locate(entry.index)[1], entry.sub)):
        found.append(f"kept and shown, without effect: {why}")
    if place in device.unsupported:
        reason = device.unsupported[place]
        found.append(f"always refused: {reason}" if reason else "refused where the service behind it is not there")
    return "; ".join(found)


def ranges(values: tuple[int, ...]) -> str:
    """Return integers with runs shortened: 0 to 240, 254, 255."""
    found: list[list[int]] = []
    for value in values:
        if found and value == found[-1][-1] + 1:
            found[-1].append(value)
        else:
            found.append([value])
    return ", ".join(
        f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(str(value) for value in run) for run in found
    )
