"""Frames of an untrusted log, read in a process with limits.

A .blf and a .gz are compressed, and a .db may have any content: their unpacked size is unknown.
"""

from __future__ import annotations

import gzip
import io
import marshal
from collections.abc import Generator
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

from mechanics.reading.limited_child import call_limited
from mechanics.reading.untrusted import MOST_RECORDING, check_size

MEMORY = 4_000_000_000  # bytes for the frames that are sent, some 10^7
LONGEST_REASON = 200  # letters of python-can's message about a broken place, which may repeat a line
TIME = 900.0  # s of the processor; MOST_RECORDING takes a tenth of it


class RecordedFrame(NamedTuple):
    """A frame with an 11-bit identifier: time stamp [s], identifier, data, length requested by a remote frame."""

    timestamp: float
    arbitration_id: int
    data: bytes
    dlc: int
    is_remote_frame: bool


def read_frames(file: Path, *, everything: bool) -> tuple[list[RecordedFrame], int]:
    """Return the frames of a master in a log, or all of them, in their order, and how many of CAN FD were left out.

    Raises:
        ValueError: If it cannot be read, ends within a line, or exceeds a limit.
        OSError: If the file does not exist.
    """
    check_size(file, MOST_RECORDING)
    packed = call_limited(f"the log {file}", _frames_as_bytes, file, everything, memory=MEMORY, time=TIME)
    rows, left_out = marshal.loads(packed)
    return [RecordedFrame(*row) for row in rows], left_out


def ending_of(file: Path) -> str:
    """Return the ending for a log's format: for a compressed log, the one before `.gz`."""
    return Path(file.stem if file.suffix.lower() == ".gz" else file.name).suffix.lower()


def _frames_as_bytes(file: Path, everything: bool) -> bytes:
    from drive_env.commands.text_logs import LogError

    rows, left_out, count = [], 0, 0
    try:
        with closing(_frames(file)) as frames:
            for count, frame in enumerate(frames, 1):  # noqa: B007
                if _is_taken(frame, everything):
                    if frame.is_fd:
                        left_out += 1
                        continue
                    if not frame.is_remote_frame and len(frame.data) != frame.dlc:
                        raise LogError(f"a frame of {frame.dlc} bytes has {len(frame.data)}")
                    rows.append(_row(frame))
    except MemoryError:
        raise
    except LogError as error:
        raise ValueError(f"{file}: {error} (near frame {count + 1})") from None
    except gzip.BadGzipFile as error:
        raise ValueError(f"{file} cannot be read as .gz: {error}") from None
    except OSError as error:
        raise ValueError(f"{file} cannot be read: {error.strerror}") from None
    except Exception as error:  # each format's reader raises any exception for a broken place
        why = str(error).partition(";")[0]
        why = why if len(why) <= LONGEST_REASON else f"{why[:LONGEST_REASON]}..."
        raise ValueError(
            f"{file} cannot be read as {ending_of(file)}: {why}, near frame {count + 1}; is it complete?"
        ) from error
    return marshal.dumps((rows, left_out))


def _frames(file: Path) -> Generator[Any, None, None]:
    import can

    from drive_env.commands.captures import frames_of_capture
    from drive_env.commands.text_logs import LogError, frames_of_text, whole_lines

    ending, is_packed = ending_of(file), file.suffix.lower() == ".gz"
    if ending == ".db":
        if is_packed:
            raise LogError("a database cannot be read while it is packed; unpack it with gzip -d")
        yield from can.SqliteReader(file)
        return
    with gzip.open(file, "rb") if is_packed else file.open("rb") as content:
        if ending == ".blf":
            size = content.seek(0, io.SEEK_END)
            content.seek(0)
            reader = can.BLFReader(content)
            if size < reader.file_size:
                raise LogError(f"it has {size} of {reader.file_size} bytes, and was cut off")
            yield from reader
        elif ending in (".pcap", ".pcapng"):
            yield from frames_of_capture(ending, content)
        else:
            yield from frames_of_text(
                ending, whole_lines(io.TextIOWrapper(content, encoding="utf-8-sig", errors="replace"))
            )


def _row(frame: Any) -> tuple[float, int, bytes, int, bool]:
    data = bytes(frame.data)
    return float(frame.timestamp), int(frame.arbitration_id), data, int(frame.dlc), bool(frame.is_remote_frame)


def _is_taken(frame: Any, everything: bool) -> bool:
    return not (frame.is_extended_id or frame.is_error_frame) and (everything or _is_from_a_master(frame))


def _is_from_a_master(frame: Any) -> bool:
    """Return whether a master sends this identifier in the predefined connection set."""
    from drive_env.canopen.frames import ERROR_CONTROL, NMT, RPDO, SDO_REQUEST, SYNC
    from drive_env.master.can.error_control import MASTERS

    can_id = frame.arbitration_id
    if frame.is_remote_frame or can_id in (NMT, SYNC) or can_id - ERROR_CONTROL in MASTERS:
        return True
    return any(base < can_id < base + 0x80 for base in (*RPDO, SDO_REQUEST))
