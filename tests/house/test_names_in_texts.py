"""Files, folders, classes and names that texts have in backticks exist: pages, docstrings, comments, data files."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from sources import ROOT

PACKAGES = ("drive_env", "mechanics", "tuning", "agents", "research", "benchmarks", "examples")
SUFFIXES = (".py", ".md", ".toml", ".xml", ".eds", ".npz", ".yml", ".js", ".css", ".html")
# What belongs to others, is written by a run, or is left to the reader to make.
ELSEWHERE = {
    "report.html", "inputs/", "sweep/", "my_drive/", "k/", "my_variant.toml", "TorqueTracking-v1/ppo/0/",
    "your_master.py", "drive_env/messages.toml", "cleanrl/servo_drives.py", "cleanrl/ppo_continuous_action.py",
    "cleanrl/sac_continuous_action.py", "ppo_continuous_action.py", "sac_continuous_action.py", "SyncVectorEnv",
    "Disabled", "GymWrapper", "GymEnv", "CoolStep", "frameskip", "prange", "site_url", "repo_url", "edit_uri",
    "simple_test", "simple_ng", "eepromtool", "firm_update", "ec_sample", "basic_example", "find_adapters",
    "firmware_update", "minimal_example", "read_eeprom", "read_sdo_info", "write_foe", "ecat", "ecat_mailbox", "tshark",
    "setcap", "meshes", "null", "velocity_axis0.csv", "bias_0", "mjpython", "peak_usb", "kvaser_usb", "gs_usb",
    "dialout", "Sm", "Fixed", "Mandatory", "Exclude", "PdoConfig", "InitCmd", "Slots",
    "axis0.statusword", "Int32", "Int64", "fmi3GetFMUState", "fmi3SerializeFMUState", "libpython3.11.so", "fatal",
}  # fmt: skip
IN_BACKTICKS = re.compile(r"`([^`\s]+)`")
FILE_IN_PACKAGE = re.compile(rf"(?<![\w/.`-])(?:{'|'.join(PACKAGES)}|docs|tests)/[\w/-]+(?:{'|'.join(SUFFIXES)})\b")
PROGRAM_FILE = re.compile(r"(?<![\w/.<>*{}-])[\w/-]+\.py\b")
TEXT_IN_CODE = re.compile(r'"""(?s:.*?)"""|#[^\n]*')
STRING = re.compile(r'"((?:[^"\\\n]|\\.)*)"')
FENCED = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)
LET_GO = re.compile(r"^### (?:Removed|Changed: names)\n.*?(?=^##)", re.DOTALL | re.MULTILINE)


@cache
def files() -> list[str]:
    """Return the paths of the repository's files."""
    inside = [one for top in (*PACKAGES, "docs", "tests") for one in (ROOT / top).rglob("*")]
    paths = [one for one in (*ROOT.iterdir(), *inside) if one.is_file() and "__pycache__" not in one.parts]
    return sorted(path.relative_to(ROOT).as_posix() for path in paths)


@cache
def paths() -> frozenset[str]:
    """Return the paths of files and folders, and the ends of these, as texts shorten them."""
    whole = {parent.as_posix() for file in files() for parent in (Path(file), *Path(file).parents)}
    return frozenset("/".join(path.split("/")[k:]) for path in whole for k in range(path.count("/") + 1))


@cache
def names() -> tuple[frozenset[str], frozenset[str]]:
    """Return the words of code, and these with file stems and keys: strings without a space, words of TOML files."""
    words: set[str] = set()
    keys = {Path(file).stem for file in files()} | {Path(file).parent.name for file in files()}
    for file in files():
        if file.endswith((".py", ".toml")):
            code = TEXT_IN_CODE.sub(" ", (ROOT / file).read_text(encoding="utf-8"))
            found = re.findall(r"\w+", STRING.sub(" ", code))
            words.update(found if file.endswith(".py") else ())
            if not file.startswith("tests"):
                keys.update(found, *(re.findall(r"\w+", one) for one in STRING.findall(code) if " " not in one))
    return frozenset(words), frozenset(words | keys)


@cache
def is_stale(token: str) -> bool:
    """Return whether a token in backticks has the form of a file, folder, class or name that does not exist."""
    words, keys = names()
    if token in ELSEWHERE:
        return False
    in_package = "/" in token and token.split("/")[0] in PACKAGES and re.fullmatch(r"[\w./-]+", token)
    if in_package or re.fullmatch(r"[\w./-]+(?:/|\.py|\.js|\.css|\.html)", token):
        return token.removesuffix("/").removeprefix("../") not in paths()
    if re.fullmatch(r"[A-Z]\w*[a-z]\w*(\.\w+)*(\(.*\))?", token):
        return re.split(r"\W", token)[0] not in words
    return bool(re.fullmatch(r"[a-z_]\w*(\.\w+)*(\(\))?", token)) and not set(re.findall(r"\w+", token)) <= keys


def stale_names(text: str) -> Iterator[tuple[int, str]]:
    """Yield line and name of what a text names and the repository lacks."""
    found = [(one.start(), one[1]) for one in IN_BACKTICKS.finditer(text) if is_stale(one[1])]
    for pattern in (FILE_IN_PACKAGE, PROGRAM_FILE):
        matches = [one for one in pattern.finditer(text) if one[0] not in ELSEWHERE]
        found += [(one.start(), one[0]) for one in matches if one[0] not in paths()]
    yield from sorted({(text.count("\n", 0, place) + 1, name) for place, name in found})


def texts() -> Iterator[tuple[str, str]]:
    """Yield path and text of what is read: pages without fenced code, sources and data of product code."""
    for file in files():
        if file.startswith("tests") or not file.endswith((".md", ".py", ".toml")):
            continue
        text = (ROOT / file).read_text(encoding="utf-8")
        if file.endswith(".md"):
            text = FENCED.sub(lambda block: "\n" * block[0].count("\n"), text)
        if file == "CHANGELOG.md":
            text = LET_GO.sub("", "\n## ".join(text.split("\n## ")[:2]) + "\n## ")  # names that are gone stand there
        yield file, text


def test_what_a_text_names_exists():
    assert not [f"{file}:{line} {name}" for file, text in texts() for line, name in stale_names(text)]


@pytest.mark.parametrize(("text", "stale"), [
    ("what lies in `tools`, a file each", ["tools"]),
    ("`sii.py` and `brief.py`", ["brief.py", "sii.py"]),
    ("(drive_env/motors.py)", ["drive_env/motors.py"]),
    ("dropped (calming.py)", ["calming.py"]),
    ("`Exchange` gives `cycle.run` addresses", ["Exchange"]),
    ("`drive_env/nowhere/`", ["drive_env/nowhere/"]),
    ("`drive_env/trials/score.py`, `score.py`, `BusDrives.write`, `drive_env/bus/`, `Drives`", []),
])  # fmt: skip
def test_a_stale_name_is_found(text, stale):
    assert [name for _, name in stale_names(text)] == stale
