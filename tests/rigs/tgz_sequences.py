"""The TGZ's two ways of a master, as its maker's page has them: what is written in Pre-Op, and how an image enables.

The native image (1721h, 1B21h) and the image of CiA 402's objects (1701h, 1B01h): D-Mode 3, then 0, number, 1 to 1C12h
and 1C13h, each with the size that the page prints.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

AXES, FRAMES = 2, 400
ERROR_FREE, ENABLED, HAS_STATE = 1 << 4, 0x27, 0x6F
WORDS = (0x80, 0x06, 0x07, 0x0F)  # fault reset, shutdown, switch on, enable operation


def start_up(outputs, inputs, *more):
    """Return rows of index, sub-index and data."""
    return [
        (0x2303, 0, struct.pack("<I", 3)), (0x2403, 0, struct.pack("<I", 3)), *more,
        (0x1C12, 0, b"\0"), (0x1C12, 1, struct.pack("<H", outputs)), (0x1C12, 0, b"\1"),
        (0x1C13, 0, b"\0"), (0x1C13, 1, struct.pack("<H", inputs)), (0x1C13, 0, b"\1"),
    ]  # fmt: skip


class Native:
    """64 bits of position, bit 0 of control clears errors, bit 1 enables; no CiA 402."""

    rows = start_up(0x1721, 0x1B21)
    size, turn = 44, 2**32

    def positions(self, data):
        return list(struct.unpack_from("<2q", data))

    def is_on(self, data, axis):
        return bool(struct.unpack_from("<I", data, 20 + 4 * axis)[0] & 1)

    def has_error(self, data, axis):
        return not struct.unpack_from("<I", data, 20 + 4 * axis)[0] & ERROR_FREE

    def pack(self, targets, step):
        control = 1 if step == 0 else 2 if step is not None else 0
        return b"".join(struct.pack("<qIhH", target, control, 0, 0) for target in targets) + bytes(12)


class Cia402:
    """Controlwords and 607Ah, in csp."""

    rows = start_up(0x1701, 0x1B01, (0x6060, 0, b"\x08"), (0x6860, 0, b"\x08"))
    size, turn = 40, 2**20

    def positions(self, data):
        return [struct.unpack_from("<i", data, 20 * axis)[0] for axis in range(AXES)]

    def is_on(self, data, axis):
        return struct.unpack_from("<H", data, 20 * axis + 12)[0] & HAS_STATE == ENABLED

    def has_error(self, data, axis):
        return bool(struct.unpack_from("<H", data, 20 * axis + 12)[0] & 0x08)

    def pack(self, targets, step):
        word = 0 if step is None else WORDS[step]
        return b"".join(struct.pack("<iIIHhHh", target, 0, 0, word, 0, 0, 0) for target in targets)


SEQUENCES = {"native": Native(), "cia402": Cia402()}


class Seen(NamedTuple):
    """What a move showed: how far each axis went [turns], whether it was on in the move and after it, and errors."""

    moved: list[float]
    was_on: list[bool]
    is_on: list[bool]
    errors: list[bool]


def move(sequence, exchange, turns=0.25, patience=400):
    """Enable both axes by an image, move them, and take their power; `exchange` takes outputs and gives inputs."""
    data = exchange(bytes(sequence.size))
    start = sequence.positions(data)
    for step in range(len(WORDS)):
        for _ in range(30):
            data = exchange(sequence.pack(sequence.positions(data), step))
    for _ in range(patience):
        if all(sequence.is_on(data, axis) for axis in range(AXES)):
            break
        data = exchange(sequence.pack(sequence.positions(data), len(WORDS) - 1))
    was_on = [sequence.is_on(data, axis) for axis in range(AXES)]
    for k in range(FRAMES + 300):
        share = min(k / FRAMES, 1.0) * turns * sequence.turn
        data = exchange(sequence.pack([one + round(share) for one in start], len(WORDS) - 1))
    moved = [(now - one) / sequence.turn for now, one in zip(sequence.positions(data), start, strict=True)]
    for _ in range(200):
        data = exchange(sequence.pack(sequence.positions(data), None))
    shown = range(AXES)
    return Seen(
        moved,
        was_on,
        [sequence.is_on(data, axis) for axis in shown],
        [sequence.has_error(data, axis) for axis in shown],
    )
