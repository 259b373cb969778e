"""The process images of the TGZ manual's tables."""

from __future__ import annotations

import struct


def rows(text):
    return [line.split() for line in text.split("\n") if line]


STRUCTURES = """
1701 int32 607A uint32 60FF uint32 60FE:1 uint16 6040 int16 6071 uint16 23C6 int16 -
1701 int32 687A uint32 68FF uint32 - uint16 6840 int16 6871 uint16 24C6 int16 -
1702 int32 - uint32 60FF uint32 60FE:1 uint16 6040 int16 6071 uint16 23C6 int16 -
1702 int32 - uint32 68FF uint32 - uint16 6840 int16 6871 uint16 24C6 int16 -
1703 int32 - uint32 - uint32 60FE:1 uint16 6040 int16 6071 uint16 23C6 int16 -
1703 int32 - uint32 - uint32 - uint16 6840 int16 6871 uint16 24C6 int16 -
1721 int64 23C7 uint32 23C8 int16 6071 uint16 23C6 int64 24C7 uint32 24C8 int16 6871 uint16 24C6
1721 uint32 - uint32 - uint32 -
1B01 int32 6064 int32 606C uint32 60FD uint16 6041 int16 6077 uint16 4002:1 uint16 4003:1
1B01 int32 6864 int32 686C int32 333E uint16 6841 int16 6877 uint16 4002:2 uint16 4003:2
1B21 int64 33C0 int64 34C0 uint32 333E uint32 3325 uint32 3425 uint16 4002:1 uint16 4002:2
1B21 int16 6077 int16 6877 uint32 @ uint32 @
"""
SIZES = {0x1701: 40, 0x1702: 40, 0x1703: 40, 0x1B01: 40, 0x1721: 44, 0x1B21: 44}


def structure(number):
    """Return object ("-" for a reserved field), first byte and length of each field, without gaps."""
    found, start = [], 0
    for row in rows(STRUCTURES):
        if int(row[0], 16) == number:
            for kind, name in zip(row[1::2], row[2::2], strict=True):
                size = int(kind.removeprefix("u").removeprefix("int")) // 8
                found.append((name, start, size))
                start += size
    return found, start


def select(rig, number):
    """Choose an image by the manual's sequence: number of images 0, the image, 1."""
    assignment = 0x1C12 if number < 0x1A00 else 0x1C13
    steps = ((0, b"\0"), (1, struct.pack("<H", number)), (0, b"\1"))
    return [rig.download(assignment, sub, content) for sub, content in steps]
