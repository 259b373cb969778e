"""Frames of a log that anybody may have recorded, read by python-can in a process with limits.

A .blf is packed, and a .db holds whatever its writer put there: neither says how much comes of it.
"""

from __future__ import annotations

import marshal
import os
from pathlib import Path
from typing import Any, NamedTuple

from mechanics.limited_child import call_limited
from mechanics.untrusted import MOST_RECORDING, check_size

MEMORY = 4_000_000_000  # bytes for the frames that are sent, some 10^7
LONGEST_REASON = 200  # letters of what python-can says of a broken place: it may repeat a line
TIME = 900.0  # s of the processor; MOST_RECORDING takes a tenth of it


class RecordedFrame(NamedTuple):
    """A frame of 11 bits: its time stamp [s], identifier, data, and whether and for how many bytes it asks."""

    timestamp: float
    arbitration_id: int
    data: bytes
    dlc: int
    is_remote_frame: bool


def read_frames(file: Path, *, everything: bool) -> list[RecordedFrame]:
    """Return the frames of a master in a log, or all of them, in their order.

    Raises:
        ValueError: If it cannot be read, ends within a line, or exceeds a limit.
        OSError: If the file does not exist.
    """
    check_size(file, MOST_RECORDING)
    _check_end(file)
    rows = marshal.loads(call_limited(f"the log {file}", _frames_as_bytes, file, everything, memory=MEMORY, time=TIME))
    return [RecordedFrame(*row) for row in rows]


def _frames_as_bytes(file: Path, everything: bool) -> bytes:
    import can

    rows, count = [], 0
    try:
        with can.LogReader(str(file)) as reader:
            for count, frame in enumerate(reader, 1):  # noqa: B007
                if _is_taken(frame, everything):
                    rows.append(_row(frame))
    except MemoryError:
        raise
    except OSError as error:
        raise ValueError(f"{file} cannot be read: {error.strerror}") from None
    except Exception as error:  # each format's reader raises what the broken place leads to
        why = str(error).partition(";")[0]
        why = why if len(why) <= LONGEST_REASON else f"{why[:LONGEST_REASON]}..."
        raise ValueError(
            f"{file} cannot be read as {file.suffix}: {why}, near frame {count + 1}; is it complete?"
        ) from error
    return marshal.dumps(rows)


def _check_end(file: Path) -> None:
    """Raise ValueError for a candump that ends within a line: the rest of a frame that was cut is another frame."""
    if file.suffix.lower() != ".log" or file.stat().st_size == 0:
        return
    with file.open("rb") as content:
        content.seek(-1, os.SEEK_END)
        if content.read() not in b"\r\n":
            raise ValueError(
                f"{file}: its last line has no end, and may be cut off; take it out, or end it with a line feed"
            )


def _row(frame: Any) -> tuple[float, int, bytes, int, bool]:
    data = bytes(frame.data)
    return float(frame.timestamp), int(frame.arbitration_id), data, int(frame.dlc), bool(frame.is_remote_frame)


def _is_taken(frame: Any, everything: bool) -> bool:
    return not (frame.is_extended_id or frame.is_error_frame) and (everything or _is_from_a_master(frame))


def _is_from_a_master(frame: Any) -> bool:
    """Return whether the predefined connection set has a master send this identifier."""
    from drive_env.canopen.frames import ERROR_CONTROL, NMT, RPDO, SDO_REQUEST, SYNC
    from drive_env.master.can.error_control import MASTERS

    can_id = frame.arbitration_id
    if frame.is_remote_frame or can_id in (NMT, SYNC) or can_id - ERROR_CONTROL in MASTERS:
        return True
    return any(base < can_id < base + 0x80 for base in (*RPDO, SDO_REQUEST))
