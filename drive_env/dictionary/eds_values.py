"""Parses values of an EDS in any spelling that makers use: numbers, data types and access."""

from __future__ import annotations

import math
import re

from canopen.objectdictionary import datatypes

NODE_ID = "$NODEID"
LONGEST = 100  # letters of a number or a sum
BOOLEANS = {"true": 1, "yes": 1, "false": 0, "no": 0}
OBJECT_TYPES = {"NULL": 0, "DOMAIN": 2, "DEFTYPE": 5, "DEFSTRUCT": 6, "VAR": 7, "VARIABLE": 7, "ARRAY": 8, "RECORD": 9}
TYPE_NAMES = {
    **{name: getattr(datatypes, name) for name in ("BOOLEAN", "REAL32", "REAL64", "VISIBLE_STRING", "OCTET_STRING",
                                                   "UNICODE_STRING", "DOMAIN", "TIME_OF_DAY", "TIME_DIFFERENCE")},
    **{f"{kind}{bits}": getattr(datatypes, f"{kind}{bits}")
       for kind in ("INTEGER", "UNSIGNED") for bits in (8, 16, 24, 32, 40, 48, 56, 64)},
    **{f"{short}{bits}": getattr(datatypes, f"{kind}{bits}")
       for short, kind in (("I", "INTEGER"), ("INT", "INTEGER"), ("U", "UNSIGNED"), ("UINT", "UNSIGNED"))
       for bits in (8, 16, 32, 64)},
    "BOOL": datatypes.BOOLEAN,
    "STRING": datatypes.VISIBLE_STRING,
}  # fmt: skip
ACCESS = {
    "rw": "rw", "rww": "rww", "rwr": "rwr", "ro": "ro", "wo": "wo", "const": "const",
    "r/w": "rw", "readwrite": "rw", "read/write": "rw", "r": "ro", "read": "ro", "readonly": "ro", "read only": "ro",
    "w": "wo", "write": "wo", "writeonly": "wo", "write only": "wo", "constant": "const",
}  # fmt: skip
LEGAL_ACCESS = ("rw", "rww", "rwr", "ro", "wo", "const")  # CiA 306
_HEX = re.compile(r"(?:0x([0-9a-f]+)|&h([0-9a-f]+)|([0-9a-f]+)h)$", re.IGNORECASE)
_TERM = re.compile(r"([+-])?([^+-]+)")


def number_of(text: str) -> int | None:
    """Parse an integer: 0x20, 20h, &H20, 32, 032 (32), 32.0, 2F (hexadecimal), true. None for other text."""
    text = text.strip().strip('"').replace(" ", "")
    sign, text = (-1, text[1:]) if text.startswith("-") else (1, text.removeprefix("+"))
    if not 0 < len(text) <= LONGEST:
        return None
    found = _HEX.match(text)
    if found is not None and not text.isdigit():
        return sign * int(next(group for group in found.groups() if group), 16)
    if text.isdigit() and text.isascii():
        return sign * int(text)
    if re.fullmatch(r"[0-9a-fA-F]+", text):
        return sign * int(text, 16)
    if text.lower() in BOOLEANS:
        return BOOLEANS[text.lower()]
    try:
        real = float(text)
    except ValueError:
        return None
    return sign * int(real) if real.is_integer() else None


def is_plain(text: str) -> bool:
    """Return whether a number is written as CiA 306 has it: decimal without leading zeros, or 0x and digits."""
    return re.fullmatch(r"[+-]?(0x[0-9a-fA-F]+|0|[1-9][0-9]*)", text.strip(), re.IGNORECASE) is not None


def float_of(text: str) -> float | None:
    """Parse a real number: 25.5, 25,5 (one comma and no point), 1e-3. None for other text."""
    text = text.strip().strip('"').replace(" ", "")
    if text.count(",") == 1 and "." not in text:
        text = text.replace(",", ".")
    try:
        value = float(text)
    except ValueError:
        number = number_of(text)
        return None if number is None else float(number)
    return value if math.isfinite(value) else None


def is_plain_float(text: str) -> bool:
    """Return whether a real number is written as in Python: an optional point and exponent."""
    return re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", text.strip()) is not None


class NodeIdSum:
    """A sum of node-IDs and a number, as in COB-IDs: `times` node-IDs plus the number."""

    def __init__(self, times: int, number: int) -> None:
        self.times = times
        self.number = number

    def text(self, node_id: int) -> str:
        """Return it in the format of CiA 306; a sum that CiA 306 does not allow becomes the number for this node."""
        if self.times == 1 and self.number >= 0:
            return f"{NODE_ID}+0x{self.number:X}"
        return f"0x{max(self.times * node_id + self.number, 0):X}"


def node_id_sum(text: str) -> NodeIdSum | None:
    """Parse a sum with the node-ID; None for a text without it, or an unreadable one."""
    plain = re.sub(r"\s", "", text).upper().strip("()")
    if "NODEID" not in plain or len(plain) > LONGEST or not re.fullmatch(r"[-+*$&0-9A-Z]+", plain):
        return None
    times = number = 0
    for sign, term in _TERM.findall(plain):
        factors = [factor for factor in term.split("*") if factor]
        ids = [factor for factor in factors if factor in ("$NODEID", "NODEID")]
        numbers = [number_of(factor) for factor in factors if factor not in ("$NODEID", "NODEID")]
        if len(ids) > 1 or any(one is None for one in numbers):
            return None
        product = -1 if sign == "-" else 1
        for one in numbers:
            product *= one or 0
        times, number = (times + product, number) if ids else (times, number + product)
    return NodeIdSum(times, number)
