"""Frames in files as Wireshark opens them (candump's lines, pcap in Linux SocketCAN framing), and on the screen."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

from drive_env.whole_file import naming

# Flags of an identifier, and of an error frame (linux/can.h, linux/can/error.h).
EXTENDED, REMOTE, ERROR, BUS_ERROR = 1 << 31, 1 << 30, 1 << 29, 0x80
BIT_RATE_SWITCH, ERROR_STATE, FD = 0x01, 0x02, 0x04  # of CAN FD
ERROR_DATA = bytes(8)  # the details of an error frame, which python-can does not pass on

# pcap (draft-ietf-opsawg-pcap): magic of microseconds, version 2.4, longest record, link type.
LINKTYPE_CAN_SOCKETCAN = 227
PCAP_HEADER = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65_535, LINKTYPE_CAN_SOCKETCAN)
RECORD = struct.Struct("<IIII")  # seconds, microseconds, length kept, length of the frame
FRAME = struct.Struct(">IBBBB")  # identifier with flags (always big-endian), length, FD flags, reserved


def candump_line(message: Any) -> bytes:
    """Return a line of `candump -L`: no R or T at its end, which Wireshark and older can-utils take for data."""
    channel = "can0" if message.channel is None else str(message.channel)
    channel = f"can{channel}" if channel.isdigit() else "".join(channel.split())  # blanks part the fields
    if message.is_error_frame:
        content = f"{ERROR | BUS_ERROR:08X}#{ERROR_DATA.hex()}"
    else:
        content = f"{message.arbitration_id:0{8 if message.is_extended_id else 3}X}#"
        if message.is_remote_frame:
            content += f"R{message.dlc or ''}"
        else:
            content += f"#{_fd_flags(message) & ~FD:X}" if message.is_fd else ""
            content += message.data.hex().upper()
    return f"({max(message.timestamp, 0.0):017.6f}) {channel} {content}\n".encode()


def _packet(message: Any) -> bytes:
    """Return a packet of link type 227, which has no field for a frame's source."""
    if message.is_error_frame:
        can_id, data, length = ERROR | BUS_ERROR, ERROR_DATA, len(ERROR_DATA)
    else:
        can_id = message.arbitration_id | message.is_extended_id * EXTENDED | message.is_remote_frame * REMOTE
        data = b"" if message.is_remote_frame else bytes(message.data)
        length = message.dlc if message.is_remote_frame else len(data)
    return FRAME.pack(can_id, length, _fd_flags(message), 0, 0) + data


def pcap_record(message: Any) -> bytes:
    """Return a record of a pcap file."""
    packet = _packet(message)
    seconds, microseconds = divmod(_microseconds(message), 1_000_000)
    return RECORD.pack(seconds, microseconds, len(packet), len(packet)) + packet


def pcapng_record(message: Any) -> bytes:
    """Return an enhanced packet block of a pcapng file."""
    packet = _packet(message)
    high, low = divmod(_microseconds(message), 1 << 32)
    content = struct.pack("<IIIII", 0, high, low, len(packet), len(packet)) + packet
    return _block(6, content + bytes(-len(packet) % 4))


def _block(kind: int, content: bytes) -> bytes:
    """Return a block of a pcapng file: its length stands before and after the content."""
    length = struct.pack("<I", len(content) + 12)
    return struct.pack("<I", kind) + length + content + length


def _microseconds(message: Any) -> int:
    since_1970: float = message.timestamp  # s
    return round(max(since_1970, 0.0) * 1e6)


def _fd_flags(message: Any) -> int:
    if not message.is_fd:
        return 0
    return FD | bool(message.bitrate_switch) * BIT_RATE_SWITCH | bool(message.error_state_indicator) * ERROR_STATE


# pcapng (draft-ietf-opsawg-pcapng): section (version 1.0, of unknown length), one interface, microseconds.
PCAPNG_HEADER = _block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)) + _block(
    1, struct.pack("<HHI", LINKTYPE_CAN_SOCKETCAN, 0, 65_535)
)
# Ending -> the beginning of a file, and the function that converts a frame.
FRAME_FILES = {
    ".log": (b"", candump_line),
    ".pcap": (PCAP_HEADER, pcap_record),
    ".pcapng": (PCAPNG_HEADER, pcapng_record),
}


class FrameFile:
    """A new file of frames, whose ending selects one of FRAME_FILES.

    Args:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        header, self._encode = FRAME_FILES[path.suffix.lower()]
        self._path = path
        self._file: Any = path.open("xb")
        with naming(path):
            self._file.write(header)

    def __enter__(self) -> FrameFile:
        return self

    def __exit__(self, *error: object) -> None:
        with naming(self._path):
            self._file.close()

    def __call__(self, message: Any) -> None:
        """Write a frame."""
        with naming(self._path):
            self._file.write(self._encode(message))


class FrameLines:
    """Frames on the screen as they come, a line each.

    Args:
        as_json: Whether a line is JSON.
    """

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json
        self._start: float | None = None

    def __enter__(self) -> FrameLines:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def __call__(self, message: Any) -> None:
        """Print a frame; its time [s] is from the first one on."""
        from drive_env.canopen.frames import service_name
        from drive_env.commands.options import print_json
        from drive_env.master.can.dry_run import show_frame

        if self._start is None:
            self._start = message.timestamp
        after, number = message.timestamp - self._start, message.arbitration_id
        service = "extended" if message.is_extended_id else service_name(number)
        service = "error frame" if message.is_error_frame else service
        if self._as_json:
            print_json({"t": round(after, 6), "id": number, "remote": message.is_remote_frame, "length": message.dlc,
                        "data": message.data.hex(), "service": service})  # fmt: skip
            return
        frame = show_frame(number, bytes(message.data), message.dlc if message.is_remote_frame else None)
        print(f"{after:12.6f}  {frame:<34}  {service}".rstrip(), flush=True)
