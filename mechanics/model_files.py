"""Which files an MJCF takes in, found without MuJoCo: all must lie in its folder, and be files."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from pathlib import Path

from mechanics.reading.untrusted import MOST_RECORDING, UntrustedFileError, read_bytes

MOST_FILES = 1000  # of a model
MOST_FOLDERS = 20  # that it names
_TAKES_XML = ("include", "model")  # elements whose file is MJCF again
_FILES = ("file", "filename", *(f"file{side}" for side in ("right", "left", "up", "down", "front", "back")))
_FOLDERS = ("meshdir", "texturedir", "assetdir")
# As lenient as the reader of MuJoCo (tinyxml2), and once through the text whatever is in it.
_TAG = re.compile(
    r"""<!--.*?(?:-->|\Z)|<!\[CDATA\[.*?(?:\]\]>|\Z)|<\?.*?(?:\?>|\Z)"""
    r"""|<(?P<name>[^\s<>/"'=]*+)(?P<rest>(?:[^"'>]++|"[^"]*+(?:"|\Z)|'[^']*+(?:'|\Z))*+)""",
    re.DOTALL,
)
_ATTRIBUTE = re.compile(r"""(?<![\w:.-])([\w:.-]++)\s*+=\s*+(?:"([^"]*+)"|'([^']*+)')""")
_ENTITY = re.compile(r"&(?:#(\d{1,7})|#x([0-9A-Fa-f]{1,6})|(quot|amp|apos|lt|gt));")
_ENTITIES = {"quot": '"', "amp": "&", "apos": "'", "lt": "<", "gt": ">"}


def hash_of_model(mjcf: Path) -> str:
    """Return a hash of all files that a model takes in, itself among them; errors as `files_of_model`."""
    digest = hashlib.sha256()
    for path in files_of_model(mjcf):
        content = read_bytes(path, MOST_RECORDING)
        digest.update(f"{path} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def files_of_model(mjcf: Path) -> list[Path]:
    """Return all files that a model takes in, itself first.

    Raises:
        ValueError: If one is not in the model's folder, is not a regular file, or is too large; if there are too many,
            or one that asks for a plug-in.
        OSError: If the model itself cannot be read.
    """
    root = mjcf.parent.resolve()
    seen: dict[Path, None] = {}
    waiting = [mjcf]
    folders: dict[str, None] = {"": None}
    named: dict[tuple[Path, str], bool] = {}  # whether it is MJCF again
    while waiting:
        path = waiting.pop()
        if path in seen:
            continue
        seen[path] = None
        for element, attribute, value in _attributes(read_bytes(path).decode("utf-8", "replace")):
            if attribute in _FOLDERS:
                folders[value] = None
            elif attribute in _FILES:
                named[path.parent, value] = element in _TAKES_XML or named.get((path.parent, value), False)
            if element == "plugin":
                raise UntrustedFileError(f"{path} asks for a plug-in of MuJoCo, and loads have none; take it out")
        if len(named) > MOST_FILES or len(folders) > MOST_FOLDERS:
            raise UntrustedFileError(f"{mjcf} takes in more than {MOST_FILES} files or {MOST_FOLDERS} folders")
        waiting += [
            found
            for (folder, name), is_xml in named.items()
            if is_xml
            for found in _found(root, mjcf, {folder, mjcf.parent}, {"": None}, name)
            if found not in seen
        ]
    for (folder, name), is_xml in named.items():
        if not is_xml:
            seen |= dict.fromkeys(_found(root, mjcf, {folder, mjcf.parent}, folders, name))
    return list(seen)


def joints_without_travel(mjcf: Path) -> set[str]:
    """Return the joints whose range in the file itself has no width, which MuJoCo takes as none given: it would turn.

    Of an MJCF a joint's `range`, of a URDF the `limit` of a revolute or prismatic joint.
    """
    found: set[str] = set()
    joint: dict[str, str] = {}
    ends: dict[str, str] = {}
    for element, attribute, value in _attributes(read_bytes(mjcf).decode("utf-8", "replace")):
        if not attribute and element == "joint":
            joint, ends = {}, {}
        if element == "joint":
            joint[attribute] = value
            if len(set(joint.get("range", "0 1").split())) == 1 and "name" in joint:
                found.add(joint["name"])
        elif element == "limit" and joint.get("type") in ("revolute", "prismatic"):
            ends[attribute] = value
            if {"lower", "upper"} <= set(ends) and ends["lower"] == ends["upper"]:
                found.add(joint.get("name", ""))
    return found


def _attributes(text: str) -> Iterator[tuple[str, str, str]]:
    """Give element, attribute and value, in the order of a text; MuJoCo looks for `include` without regard to case."""
    for tag in _TAG.finditer(text):
        if tag["name"] is None:
            continue
        if tag["name"].startswith("!"):
            raise UntrustedFileError("a model has a document type (<!...>), which no MJCF needs; take it out")
        yield tag["name"].lower(), "", ""
        for name, double, single in _ATTRIBUTE.findall(tag["rest"]):
            yield tag["name"].lower(), name.lower(), _ENTITY.sub(_character, double or single)


def _character(found: re.Match[str]) -> str:
    decimal, hexadecimal, name = found.groups()
    if name:
        return _ENTITIES[name]
    code = int(decimal) if decimal else int(hexadecimal, 16)
    return chr(code) if code < 0x110000 else ""


def _found(root: Path, mjcf: Path, bases: set[Path], folders: dict[str, None], name: str) -> list[Path]:
    """Return every file that MuJoCo could mean by a name; it is in the model's folder, whichever it takes."""
    plain = name.replace("\\", "/")
    places = {
        base / folder.replace("\\", "/") / one
        for base in bases
        for folder in folders
        for one in (plain, plain.rpartition("/")[2])  # strippath
    }
    found = []
    for place in sorted(places):
        try:
            if "\0" in name or not place.exists() or place.is_dir():
                continue
        except OSError:  # a name that no file can have
            continue
        if not place.resolve().is_relative_to(root):
            raise UntrustedFileError(
                f"{mjcf} takes in {name!r}, which is {place.resolve()}, outside the model's folder {root}: files from "
                "elsewhere are not read; copy it into that folder, or move the model to a folder that holds both"
            )
        found.append(place)
    # A URDF names what is only seen, too, which MuJoCo leaves out; what it lacks it tells.
    if not found and mjcf.suffix != ".urdf":
        raise UntrustedFileError(f"{mjcf} takes in {name!r}, and there is no such file in {root}")
    return found
