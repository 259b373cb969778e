"""docs/messages.md from docs/messages.toml: `python docs/messages_page.py` writes it anew."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from drive_env.devices.variants import device_data

HERE = Path(__file__).parent
DEVICES = HERE.parent / "drive_env" / "devices"
INTRODUCTION = """# When it says …

Messages that programs, drives and certificates show, by topic, with cause and remedy. A value is written as `…`. Search
for some words of your message that are no values: with the browser's search on this page, or with the site's.

## Exit codes

| code | meaning |
| --- | --- |
| 0 | done |
| 1 | the drive, the bus or the safety envelope refused, a tuning was rejected, or you declined |
| 2 | a mistake in the command, a file, or the way to the bus: nothing was sent |
| 130 | interrupted by Ctrl-C; drives were stopped first |
| 141 | the reader of the output has closed it, as `head` does |

Every message is one line on standard error and names the value, the limit and what to do. A traceback is a mistake of
this program: please report it with the line above it.
"""
FAMILIES = """## Messages without a row

"""


def load() -> dict[str, Any]:
    """Return topics and families."""
    return tomllib.loads((HERE / "messages.toml").read_text(encoding="utf-8"))


def emergencies() -> dict[str, dict[str, Any]]:
    """Return the emergencies of each device by name. Variants have those of their device."""
    files = sorted(DEVICES.glob("*/device.toml"))
    tables = {file.parent.name: device_data(file.parent) for file in files}
    return {name: table["emergencies"] for name, table in tables.items() if "emergencies" in table}


def page() -> str:
    """Return the page."""
    data = load()
    parts = [INTRODUCTION]
    for topic in data["topic"]:
        parts.append(f"## {topic['title']}\n")
        if topic["text"]:
            parts.append(f"{topic['text']}\n")
        rows = topic["message"]
        if "emcy" in rows[0]:
            parts.append(_emergency_table(rows, emergencies()))
        else:
            parts += [_message(row) for row in rows]
    parts.append(FAMILIES + "\n".join(f"**{one['title']}.** {one['reason']}\n" for one in data["family"]))
    return "\n".join(parts)


def _message(row: dict[str, Any]) -> str:
    said = "\n>\n".join(f"> `` {text} ``" if "`" in text else f"> `{text}`" for text in row["says"])
    return f"{said}\n\n- *From:* {row['from']}\n- *Cause:* {row['cause']}\n- *Remedy:* {row['remedy']}\n"


def _emergency_table(rows: list[dict[str, str]], told: dict[str, dict[str, Any]]) -> str:
    lines = ["| code | what | drives | cause | remedy |", "| --- | --- | --- | --- | --- |"]
    for row in rows:
        if "same" in row:
            continue
        names = [row["emcy"], *(other["emcy"] for other in rows if other.get("same") == row["emcy"])]
        codes = {f"{table[name]['code']:04X}h": None for name in names for table in told.values() if name in table}
        called = ", ".join(name.replace("_", " ") for name in names)
        those = [device for device, table in told.items() if any(name in table for name in names)]
        drives = "all" if len(those) == len(told) else ", ".join(those)
        lines.append(f"| {', '.join(codes)} | {called} | {drives} | {row['cause']} | {row['remedy']} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    (HERE / "messages.md").write_text(page(), encoding="utf-8")
