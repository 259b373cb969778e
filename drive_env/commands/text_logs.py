"""Logs of frames as text: formats that python-can lacks, and those whose beginning or end it misreads."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator
from itertools import chain
from typing import Any

Lines = Iterator[str]

# can-utils, lib.c: sprint_long_canframe; candump.c: -ta, -tA, -td and -tz, -x.
CANDUMP = re.compile(
    r"(?:\((?P<time>[^)]*)\)\s+)?\S+\s+(?:[RT]X [-B] [-E]\s+)?(?P<id>[0-9A-F]{3}|[0-9A-F]{8})\s+"
    r"\[(?P<length>\d+)\](?P<data>(?:\s+remote request|(?: +[0-9A-F]{2}(?![0-9A-F]))*))(?P<rest>.*)"
)
# BUSMASTER, LogObjectCAN.cpp: time of day in 0.1 ms; s and x are standard and extended, sr and xr remote frames.
BUSMASTER = re.compile(
    r"(?P<time>\d+:\d+:\d+:\d{4}) [RT]x \d+ (?P<id>\S+) (?P<kind>sr?|xr?) (?P<length>\d+)(?P<data>( [0-9A-F]+)*)", re.I
)
SAVVYCAN = "Time Stamp,ID,Extended,Dir,Bus,LEN"  # SavvyCAN, framefileio.cpp: times in us
ASC_HEADER = re.compile(r"\s*(date\s|base\s|//)", re.I)  # lines before the first event
HALF_A_DAY, DAY = 43_200.0, 86_400.0  # s


class LogError(ValueError):
    """A log that cannot be read, with the remedy."""


def whole_lines(file: Any) -> Lines:
    """Yield the lines of a text, and raise LogError for an incomplete last one.

    A truncated frame would be read as another frame.
    """
    for line in file:
        if not line.endswith("\n"):
            raise LogError("its last line has no end, and may be cut off; take it out, or end it with a line feed")
        yield line


def frames_of_text(ending: str, lines: Lines) -> Iterator[Any]:
    """Return the frames (`can.Message`, times in s) of a log in the format given by its ending and its first line.

    Raises:
        LogError: While reading, for a line that is not a frame, or has no absolute time.
    """
    import can

    first = next(filter(str.strip, lines), None)
    if first is None:
        return iter(())
    lines = chain([first], lines)
    for format_ending, begins, read in FOREIGN:
        if ending == format_ending and begins(first):
            return read(lines)
    readers: dict[str, Any] = {
        ".log": can.CanutilsLogReader, ".asc": can.ASCReader, ".csv": can.CSVReader
    }  # fmt: skip
    lines = _with_events_line(lines) if ending == ".asc" else lines
    return iter(readers[ending](line for line in lines))  # the generator closes its file, which a chain could not


def _with_events_line(lines: Lines) -> Lines:
    """Yield the lines of an .asc with the header that python-can needs: no blanks, and one line of internal events.

    It treats the first line after date and base as that line, and drops it.
    """
    for line in lines:
        if re.match(r"\s*base\s.*\srelative", line, re.I):
            raise LogError("its times are relative to the line before; save it with absolute ones")
        if ASC_HEADER.match(line):
            yield line
        elif line.strip():
            yield from ("no internal events logged\n", line)
            break
    yield from lines


def _candump(lines: Lines) -> Iterator[Any]:
    import can

    before = -1.0
    for line in filter(str.strip, lines):
        found = CANDUMP.match(line.strip())
        if found is None:
            raise LogError(f"{line.strip()!r} is no line of candump")
        if not re.fullmatch(r"\d+\.\d+", found["time"] or ""):
            raise LogError("candump's screen has no time stamps in seconds; record with candump -L, or with -ta")
        time = float(found["time"])
        if time < before:
            raise LogError("its time stamps go back, as those of candump -td do; record with candump -L, or with -ta")
        before, remote = time, "remote" in found["data"]
        frame = can.Message(
            time, int(found["id"], 16), len(found["id"]) > 3, remote, "ERRORFRAME" in found["rest"],
            dlc=int(found["length"]), is_fd=len(found["length"]) > 1,
        )  # fmt: skip
        yield _with_data(frame, [] if remote else found["data"].split(), 16)


def _busmaster(lines: Lines) -> Iterator[Any]:
    import can

    base, before, days = 16, 0.0, 0.0
    for line in filter(str.strip, lines):
        if line.startswith("***"):
            base = 10 if line.startswith("***DEC***") else base
            if line.startswith("***RELATIVE MODE***"):
                raise LogError("its times are relative to the line before; log in system or absolute mode")
            continue
        found = BUSMASTER.fullmatch(line.strip())
        if found is None:
            raise LogError(f"{line.strip()!r} is no line of BUSMASTER")
        hours, minutes, seconds, ticks = map(int, found["time"].split(":"))
        time = 3600.0 * hours + 60.0 * minutes + seconds + 1e-4 * ticks
        days += DAY if time < before - HALF_A_DAY else 0.0
        before, kind = time, found["kind"].lower()
        frame = can.Message(
            days + time, int(found["id"], base), "x" in kind, "r" in kind, dlc=int(found["length"])
        )  # fmt: skip
        yield _with_data(frame, [] if "r" in kind else found["data"].split(), base)


def _savvycan(lines: Lines) -> Iterator[Any]:
    import can

    next(lines)
    for line in filter(str.strip, lines):
        time, can_id, extended, _, _, length, *data = (cell.strip() for cell in line.split(","))
        frame = can.Message(
            1e-6 * int(time), int(can_id, 16), extended.lower() in ("true", "1"), dlc=int(length), is_fd=int(length) > 8
        )
        yield _with_data(frame, [byte for byte in data if byte], 16)


def _trc(lines: Lines) -> Iterator[Any]:
    """Yield the frames of a .trc; lines that python-can drops with a warning are refused."""
    import can

    def refuse(record: logging.LogRecord) -> bool:
        if record.levelno >= logging.WARNING:
            raise LogError(f"{next(iter(record.args or ('',)))!r} is no line of a .trc")
        return True

    reader = logging.getLogger("can.io.trc")
    reader.addFilter(refuse)
    try:
        yield from can.TRCReader(line for line in lines)
    finally:
        reader.removeFilter(refuse)


def _with_data(frame: Any, data: list[str], base: int) -> Any:
    frame.data = bytearray(int(byte, base) for byte in data)
    return frame


# Ending, beginning of the first non-blank line, reader. candump -L has the frame in one word, with a '#'.
FOREIGN: tuple[tuple[str, Callable[[str], Any], Callable[[Lines], Iterator[Any]]], ...] = (
    (".log", lambda first: first.startswith("***BUSMASTER"), _busmaster),
    (".log", lambda first: CANDUMP.match(first.strip()), _candump),
    (".csv", lambda first: first.startswith(SAVVYCAN), _savvycan),
    (".trc", bool, _trc),
)
