"""The files that an MJCF includes, found without MuJoCo: all must be regular files in its folder."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from pathlib import Path

from mechanics.reading.untrusted import MOST_RECORDING, UntrustedFileError, read_bytes

MOST_FILES = 1000  # of a model
MOST_FOLDERS = 20  # that it may name
_TAKES_XML = ("include", "model")  # elements whose file is MJCF, too
_FILES = ("file", "filename", *(f"file{side}" for side in ("right", "left", "up", "down", "front", "back")))
_FOLDERS = ("meshdir", "texturedir", "assetdir")
# As lenient as MuJoCo's reader (tinyxml2), and linear in the length of any text.
_TAG = re.compile(
    r"""<!--.*?(?:-->|\Z)|<!\[CDATA\[.*?(?:\]\]>|\Z)|<\?.*?(?:\?>|\Z)"""
    r"""|<(?P<name>[^\s<>/"'=]*+)(?P<rest>(?:[^"'>]++|"[^"]*+(?:"|\Z)|'[^']*+(?:'|\Z))*+)""",
    re.DOTALL,
)
_ATTRIBUTE = re.compile(r"""(?<![\w:.-])([\w:.-]++)\s*+=\s*+(?:"([^"]*+)"|'([^']*+)')""")
_ENTITY = re.compile(r"&(?:#(\d{1,7})|#x([0-9A-Fa-f]{1,6})|(quot|amp|apos|lt|gt));")
_ENTITIES = {"quot": '"', "amp": "&", "apos": "'", "lt": "<", "gt": ">"}


def hash_of_model(mjcf: Path) -> str:
    """Return a hash of a model's file and all files that it includes; errors as `files_of_model`."""
    digest = hashlib.sha256()
    for path in files_of_model(mjcf):
        content = read_bytes(path, MOST_RECORDING)
        digest.update(f"{path} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def files_of_model(mjcf: Path) -> list[Path]:
    """Return a model's file and all files that it includes.

    Raises:
        ValueError: If one is not in the model's folder, is not a regular file, or is too large; if there are too many,
            or one demands a plug-in.
        OSError: If the model itself cannot be read.
    """
    root = mjcf.parent.resolve()
    seen: dict[Path, None] = {}
    waiting = [mjcf]
    folders: dict[str, None] = {"": None}
    named: dict[tuple[Path, str], bool] = {}  # whether it is MJCF, too
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
    """Return the joints whose range in the file has no width: MuJoCo would ignore it and let them turn.

    In an MJCF it is a joint's `range`, in a URDF the `limit` of a revolute or prismatic joint.
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
    """Give element, attribute and value, in the order of a text; MuJoCo ignores the case of `include`."""
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
    """Return every file that MuJoCo could mean by a name; all are in the model's folder."""
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
        except OSError:  # an impossible file name
            continue
        if not place.resolve().is_relative_to(root):
            raise UntrustedFileError(
                f"{mjcf} takes in {name!r}, which is {place.resolve()}, outside the model's folder {root}: files from "
                "elsewhere are not read; copy it into that folder, or move the model to a folder that holds both"
            )
        found.append(place)
    # A URDF also names visual files, which MuJoCo leaves out; it reports missing ones.
    if not found and mjcf.suffix != ".urdf":
        raise UntrustedFileError(f"{mjcf} takes in {name!r}, and there is no such file in {root}")
    return found
