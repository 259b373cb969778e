"""Frames of captures: .pcap and .pcapng of Wireshark, tcpdump and ours, with link type 227 (CAN SocketCAN).

Sources: draft-ietf-opsawg-pcap, draft-ietf-opsawg-pcapng, tcpdump.org's LINKTYPE_CAN_SOCKETCAN.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any

from drive_env.commands.frame_files import ERROR, EXTENDED, FD, FRAME, LINKTYPE_CAN_SOCKETCAN, REMOTE
from drive_env.commands.text_logs import LogError

# Byte order and unit of time [s] by the first four bytes of a .pcap.
PCAP_KINDS = {
    b"\xd4\xc3\xb2\xa1": ("<", 1e-6),
    b"\xa1\xb2\xc3\xd4": (">", 1e-6),
    b"\x4d\x3c\xb2\xa1": ("<", 1e-9),
    b"\xa1\xb2\x3c\x4d": (">", 1e-9),
}
# Byte order by the four bytes that follow the length of a section of a .pcapng.
SECTION_ORDERS = {b"\x4d\x3c\x2b\x1a": "<", b"\x1a\x2b\x3c\x4d": ">"}
SECTION, INTERFACE, SIMPLE_PACKET, PACKET = 0x0A0D0D0A, 1, 3, 6
TIME_RESOLUTION = 9  # option of an interface: a power of ten, or of two with the highest bit
LONGEST = 1 << 20  # bytes of a block or record: a frame has 80


def frames_of_capture(ending: str, content: Any) -> Iterator[Any]:
    """Yield the frames (`can.Message`, times in s) of a capture.

    Args:
        ending: .pcap or .pcapng.
        content: Its bytes, open for reading.

    Raises:
        LogError: For a file that is not a capture, is cut off, or whose frames are not of a CAN bus or have no time.
    """
    for time, link, packet in (_pcap if ending == ".pcap" else _pcapng)(content):
        if link != LINKTYPE_CAN_SOCKETCAN:
            raise LogError(f"its link type is {link}, not 227 (CAN SocketCAN); capture on one CAN interface, as can0")
        yield _frame(time, packet)


def _frame(time: float, packet: bytes) -> Any:
    import can

    if len(packet) < FRAME.size:
        raise LogError(f"a frame of {len(packet)} bytes is cut off")
    number, length, flags, _, _ = FRAME.unpack(packet[: FRAME.size])
    is_extended, is_remote = bool(number & EXTENDED), bool(number & REMOTE)
    data = b"" if is_remote else packet[FRAME.size : FRAME.size + length]
    return can.Message(
        time, number & (0x1FFF_FFFF if is_extended else 0x7FF), is_extended, is_remote, bool(number & ERROR),
        dlc=length, data=data, is_fd=bool(flags & FD) or length > 8,
    )  # fmt: skip


def _pcap(content: Any) -> Iterator[tuple[float, int, bytes]]:
    """Yield time [s], link type and bytes of each record."""
    head = _exactly(content, 24)
    if head[:4] not in PCAP_KINDS:
        raise LogError("it does not begin as a .pcap does; is its ending right?")
    order, unit = PCAP_KINDS[head[:4]]
    (link,) = struct.unpack(order + "I", head[20:])
    while (record := content.read(16)) != b"":
        seconds, parts, kept, _ = struct.unpack(order + "IIII", _whole(record, 16))
        yield seconds + parts * unit, link & 0xFFFF, _exactly(content, _checked(kept))


def _pcapng(content: Any) -> Iterator[tuple[float, int, bytes]]:
    """Yield time [s], link type and bytes of each packet."""
    order = ""
    interfaces: list[tuple[int, float]] = []  # link type and unit of times [s] of each
    while (head := content.read(8)) != b"":
        if _whole(head, 8)[:4] == struct.pack("<I", SECTION):  # the same in both byte orders
            order, interfaces = SECTION_ORDERS.get(begin := _exactly(content, 4), ""), []
            content.seek(-len(begin), 1)
        if not order:
            raise LogError("it does not begin as a .pcapng does; is its ending right?")
        kind, length = struct.unpack(order + "II", head)
        body = _exactly(content, max(_checked(length) - 8, 4))[:-4]  # the length is repeated at the end
        if kind == INTERFACE:
            interfaces.append((struct.unpack(order + "H", body[:2])[0], _time_unit(order, body[8:])))
        elif kind == SIMPLE_PACKET:
            raise LogError("it has packets without a time; record with time stamps")
        elif kind == PACKET:
            number, high, low, kept, _ = struct.unpack(order + "IIIII", _whole(body[:20], 20))
            if number >= len(interfaces):
                raise LogError(f"a packet is of interface {number}, which it does not describe")
            link, unit = interfaces[number]
            yield ((high << 32) | low) * unit, link, body[20 : 20 + kept]


def _time_unit(order: str, options: bytes) -> float:
    """Return the unit of an interface's times [s]: from its options, by default microseconds."""
    while len(options) >= 4:
        code, length = struct.unpack(order + "HH", options[:4])
        if code == TIME_RESOLUTION and length == 1:
            power = options[4]
            return 2.0 ** -(power & 0x7F) if power & 0x80 else 10.0**-power
        options = options[4 + length + -length % 4 :]
    return 1e-6


def _checked(length: int) -> int:
    if length > LONGEST:
        raise LogError(f"a block of {length} bytes is longer than {LONGEST}; is the file complete?")
    return length


def _exactly(content: Any, size: int) -> bytes:
    return _whole(content.read(size), size)


def _whole(found: bytes, size: int) -> bytes:
    if len(found) < size:
        raise LogError("it ends within a block, and may be cut off")
    return found
