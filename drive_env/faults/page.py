"""Writes docs/faults.md from the table of faults: `python -m drive_env.faults.page docs/faults.md`."""

from __future__ import annotations

import sys
from pathlib import Path

from drive_env.default_device import DEFAULT_DEVICE
from drive_env.devices import device_names, find_device
from drive_env.faults.table import FAULTS, GROUPS, FaultRow

HEADINGS = {
    "sensor": "Sensors", "motor": "Motor and stage", "supply": "Supply", "load": "Load", "bus": "Bus", "node": "Node",
}  # fmt: skip
INTRODUCTION = """# Faults

What can be made to fail on emulated drives, what the drive and its master make of it, and the way back. This page is
written from `drive_env/faults/table.toml` by `python -m drive_env.faults.page docs/faults.md`.

In process, on machines:

```python
from drive_env import EmulatedDrives

drives = EmulatedDrives(load="inertia", num_machines=4)
number = drives.machine.fault("encoder_stuck", at=0.5, duration=0.1, where=[True, True, False, False])  # two of them
drives.machine.fault("payload_jump", when="speed > 40", factor=2.0)  # rad/s of the rotor
drives.machine.fault("demagnetised", when="enabled", at=0.02, share=0.4)  # 20 ms after operation enabled
drives.machine.faults()  # those to come and those that are there
drives.machine.clear_fault(number)
```

On a bus that is served, also of its wire and nodes:

```bash
drive-env serve tmcm1636 --control 29637 --fault "supply_dip at=2 duration=0.1 voltage=6"
drive-env fault bus_loss share=0.2 --duration 1
drive-env fault encoder_stuck --node 1 --when "speed > 40"
drive-env fault --status
drive-env fault --clear all
```

In environments, drawn anew for each episode, off unless a set of distributions has it:

```toml
include = "two_mass"

[faults]
probability = 0.2                      # of an episode
names = ["sensor", "jam"]              # faults or groups of this page; those of bus and node but node_reset need a bus
at = [0.1, 0.8]                        # s from the episode's begin
duration = [0.02, 0.2]                 # s; without it to the episode's end
ranges."jam.torque" = [2.0, 20.0]      # other parameters have their defaults
```

A fault begins and ends at communication cycles of 1 ms. It lies on top of the machine as it was built: when it ends, or
`machine.reset` puts the machine to rest, nothing of it is left but what cannot come back, as counts that an encoder
missed. The same seed gives the same run. A fault of a load or an encoder is of the whole machine unless `axis` names
one of its axes.

*Detected within* is the longest time from the fault to the drive's emergency in the test named, an axis at 458 rpm with
a following error window (6065h) of 0.46 revolutions; on a bus, with a master's heartbeat watched for 100 ms (1016h).
*Not by the drive* is no omission: the manual has nothing that would see it.
"""


def page() -> str:
    """Return the text of the page."""
    parts = [INTRODUCTION]
    for group in GROUPS:
        rows = [row for row in FAULTS.values() if row.group == group]
        parts.append(f"## {HEADINGS[group]}\n")
        parts.append("| fault | the drive says | detected within |\n| --- | --- | --- |")
        parts.append("\n".join(_line(row) for row in rows) + "\n")
        parts += [_section(row) for row in rows]
    return "\n".join(parts)


def _line(row: FaultRow) -> str:
    if row.emergency is None or row.detection is None:
        return f"| [{row.name}](#{row.name}) | nothing | not by the drive |"
    rows = find_device(DEFAULT_DEVICE).emergencies  # the table gives this device's reactions
    name = next(name for name, one in rows.items() if one.code == row.emergency)
    said = f"{row.emergency:04X}h, {name.replace('_', ' ')}"
    return f"| [{row.name}](#{row.name}) | {said} | {row.detection * 1e3:g} ms |"


def _section(row: FaultRow) -> str:
    lines = [f"### {row.name}\n", f"{row.physics}\n"]
    if row.parameters:
        lines.append("| parameter | meaning | default | range | unit |\n| --- | --- | --- | --- | --- |")
        for name, one in row.parameters.items():
            lines.append(f"| `{name}` | {one.meaning} | {one.default:g} | {one.low:g} to {one.high:g} | {one.unit} |")
        lines.append("")
    if row.once:
        lines.append("A moment: it takes no duration.\n")
    lines.append(f"- **Drive:** {row.drive}")
    lines += [_elsewhere(row, firmware) for firmware in row.on if row.on[firmware]]
    lines += [f"- **Master:** {row.master}", f"- **Way back:** {row.way_back}"]
    lines.append(f"- **Test:** `{row.test}`\n")
    return "\n".join(lines)


def _elsewhere(row: FaultRow, firmware: str) -> str:
    """Return the line about the reaction of drives with another firmware."""
    other = row.on_firmware(firmware)
    assert other is not None
    names = ", ".join(f"`{name}`" for name in device_names() if find_device(name).firmware_name == firmware)
    return f"- **{names}:** {other.drive}" + ("" if other.steps == row.steps else f" Way back: {other.way_back}")


def main() -> None:
    """Write the page to the file named on the command line, or print it."""
    if len(sys.argv) > 1:
        Path(sys.argv[1]).write_text(page(), encoding="utf-8")
    else:
        print(page(), end="")


if __name__ == "__main__":
    main()
