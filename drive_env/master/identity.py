"""A node's identity, 1008h to 100Ah and 1018h: a file is not written to another drive.

A serial number is read even if the EDS lists none: later firmware of the same device has it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from drive_env.dictionary.aborts import ObjectAccessError

if TYPE_CHECKING:
    from drive_env.drives.interface import DescribedAxes


_TEXTS = ("device", "name", "hardware", "software")


class OtherDriveError(ValueError):
    """The file is of another drive."""


class Identity(NamedTuple):
    """A node's identity; None, or "", for an entry that it lacks.

    Attributes:
        device: Name of the device, or of the EDS.
        node: Node-ID.
        name, hardware, software: 1008h, 1009h, 100Ah.
        vendor, product, revision, serial: 1018h:01 to :04.
    """

    device: str
    node: int
    name: str = ""
    hardware: str = ""
    software: str = ""
    vendor: int | None = None
    product: int | None = None
    revision: int | None = None
    serial: int | None = None

    def to_toml(self) -> list[str]:
        """Return the lines of a TOML table; entries that the node lacks are left out."""
        rows = {name: value for name, value in self._asdict().items() if value not in (None, "")}
        return [f"{name} = {json.dumps(value, ensure_ascii=False)}" for name, value in rows.items()]


def read_identity(drives: DescribedAxes, node: int = 0) -> Identity:
    """Read a node's identity.

    Args:
        drives: Drives on a bus.
        node: Its position in `drives.nodes`.

    Raises:
        NoAnswerError: If it does not answer.
    """
    known = drives.description

    def read(index: int, sub: int) -> bytes | None:
        label = f"{index:04X}h:{sub:02X}"
        try:
            return drives.sdo(node).read(index, sub, label, known.answer_timeout)
        except ObjectAccessError:
            return None  # optional

    def text(index: int) -> str:
        said = (read(index, 0) or b"").decode("utf-8", "replace")
        return "".join(letter for letter in said if letter.isprintable()).strip()

    def number(sub: int) -> int | None:
        data = read(0x1018, sub)
        return None if data is None else int.from_bytes(data, "little")

    return Identity(
        known.name,
        drives.nodes[node],
        name=text(0x1008),
        hardware=text(0x1009),
        software=text(0x100A),
        vendor=number(1),
        product=number(2),
        revision=number(3),
        serial=number(4) or None,  # a drive without a serial number reports 0
    )


def load_identity(table: Mapping[str, Any]) -> Identity | None:
    """Return the identity of a TOML table; None if it lacks one or has an incomplete one."""
    kinds = {name: str if name in _TEXTS else int for name in Identity._fields}
    known: dict[str, Any] = {
        name: value for name, value in table.items() if name in kinds and type(value) is kinds[name]
    }
    return Identity(**known) if {"device", "node", "vendor", "product"} <= known.keys() else None


def check_same_drive(file: object, written: Identity | None, found: Identity, *, other_drive: bool = False) -> None:
    """Raise OtherDriveError unless a file was read from the connected drive.

    Drives are distinguished by serial number, or by node-ID if they have none. Another firmware revision may count in
    other units, and is refused, too.

    Args:
        file: The file, for the message.
        written: Identity of the drive that the file was read from; None if the file has none.
        found: Identity of the connected drive.
        other_drive: Let any drive pass.
    """
    if other_drive or written is None:
        return
    by_node = written.serial is None and found.serial is None  # only the node-ID distinguishes it from its neighbours
    pairs = [
        ("device", written.device, found.device),
        ("vendor", _hex(written.vendor), _hex(found.vendor)),
        ("product code", _hex(written.product), _hex(found.product)),
        ("revision", _hex(written.revision), _hex(found.revision)),
        ("serial number", written.serial or "none", found.serial or "none"),
        *([("node", written.node, found.node)] if by_node else []),
    ]
    differing = [f"{what} {one}, and here is {other}" for what, one, other in pairs if one != other]
    if differing:
        raise OtherDriveError(
            f"{file} is of another drive: it was read from {'; '.join(differing)}. Nothing was written; if it is meant "
            "for this drive all the same, say --other-drive"
        )


def _hex(number: int | None) -> str:
    return "none" if number is None else f"{number:X}h"
