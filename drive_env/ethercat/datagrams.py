"""Frames of EtherCAT and the datagrams in them (ETG.1000.4, clause 5).

An Ethernet frame of EtherType 88A4h, or the payload of a UDP datagram, holds two bytes of header (11 bits of length, 4
of type) and consecutive datagrams: command, index, address, length, interrupt, data, working counter.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from enum import IntEnum
from typing import NamedTuple

ETHERTYPE = bytes.fromhex("88A4")
VLAN = bytes.fromhex("8100")
PORT = 0x88A4  # of UDP
ETHERNET = 14  # bytes of destination, source and EtherType
SHORTEST_FRAME = 60  # bytes without FCS
HEADER, DATAGRAM, COUNTER = 2, 10, 2  # bytes of the EtherCAT header, of a datagram's, of the working counter
MORE = 0x8000
DATAGRAMS = 1  # type of a frame
BROADCAST = b"\xff" * 6
MASTER = bytes.fromhex("010101010101")  # source that masters usually write


class DatagramCommand(IntEnum):
    """Commands of a datagram: auto-increment, configured address, broadcast, logical; read, write, both."""

    NOP = 0
    APRD = 1
    APWR = 2
    APRW = 3
    FPRD = 4
    FPWR = 5
    FPRW = 6
    BRD = 7
    BWR = 8
    BRW = 9
    LRD = 10
    LWR = 11
    LRW = 12
    ARMW = 13
    FRMW = 14


class DatagramPlace(NamedTuple):
    """Place of a datagram in a frame: command, first byte of its header, length of its data [bytes]."""

    command: int
    at: int
    length: int


class Datagram(NamedTuple):
    """A datagram by itself.

    `address` has 32 bits: the low 16 are the station's address, the high 16 the address in its memory. `number` is its
    index, by which a master recognises it.
    """

    command: int
    address: int
    data: bytes
    counter: int = 0
    number: int = 0
    interrupt: int = 0


def at_station(command: int, station: int, offset: int, data: bytes) -> Datagram:
    """Return a datagram for a station's memory; with auto-increment addresses the first station is 0, the next -1."""
    return Datagram(command, (station & 0xFFFF) | offset << 16, data)


def build(datagrams: Sequence[Datagram]) -> bytes:
    """Return header and datagrams, as UDP carries them."""
    parts = []
    for k, one in enumerate(datagrams):
        length = len(one.data) | (MORE if k < len(datagrams) - 1 else 0)
        parts.append(struct.pack("<BBIHH", one.command, one.number, one.address, length, one.interrupt))
        parts += [one.data, struct.pack("<H", one.counter)]
    body = b"".join(parts)
    return struct.pack("<H", len(body) | DATAGRAMS << 12) + body


def build_frame(datagrams: Sequence[Datagram]) -> bytes:
    """Return an Ethernet frame without FCS."""
    return (BROADCAST + MASTER + ETHERTYPE + build(datagrams)).ljust(SHORTEST_FRAME, b"\0")


def begin(frame: bytes | bytearray) -> int | None:
    """Return the position of the EtherCAT header in an Ethernet frame; None for a frame of another protocol."""
    if frame[12:14] == ETHERTYPE:
        return ETHERNET
    if frame[12:14] == VLAN and frame[16:18] == ETHERTYPE:
        return ETHERNET + 4
    return None


def find(frame: bytes | bytearray, start: int) -> list[DatagramPlace] | None:
    """Return the datagrams of a frame whose header begins at `start`; None if the frame is incomplete.

    It is complete if its datagrams fill exactly the length in its header, and only the last of them is marked as the
    last.
    """
    size = len(frame)
    if size < start + HEADER:
        return None
    header = frame[start] | frame[start + 1] << 8
    at = start + HEADER
    end = at + (header & 0x7FF)
    if header >> 12 != DATAGRAMS or end > size:
        return None
    places = []
    while at + DATAGRAM + COUNTER <= end:
        field = frame[at + 6] | frame[at + 7] << 8
        length = field & 0x7FF
        places.append(DatagramPlace(frame[at], at, length))
        at += DATAGRAM + length + COUNTER
        if not field & MORE:
            return places if at == end else None
    return None


def read(frame: bytes | bytearray, start: int) -> list[Datagram]:
    """Return the datagrams of a frame; empty if the frame is incomplete."""
    found = []
    for _, at, length in find(frame, start) or ():
        command, number, address, _, interrupt = struct.unpack_from("<BBIHH", frame, at)
        data = bytes(frame[at + DATAGRAM : at + DATAGRAM + length])
        (counter,) = struct.unpack_from("<H", frame, at + DATAGRAM + length)
        found.append(Datagram(command, address, data, counter, number, interrupt))
    return found


def lines(datagrams: Iterable[Datagram]) -> list[str]:
    """Return datagrams as one line each: command, addresses, data and working counter, all hexadecimal."""
    return [
        f"{DatagramCommand(one.command).name} {one.address & 0xFFFF:04X} {one.address >> 16:04X}  "
        f"{one.data.hex(' ').upper()}  wkc {one.counter}"
        for one in datagrams
    ]
