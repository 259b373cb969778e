"""Errors of a bus."""

from __future__ import annotations

from collections.abc import Sequence

from drive_env.dictionary.aborts import ObjectAccessError

# CiA 301, table 22 of version 4.2, and the remedies.
_ABORTS = {
    0x05030000: ("the toggle bit did not alternate", "try again; frames may be lost"),
    0x05040000: ("the drive waited too long for the next frame", "try again; frames may be lost"),
    0x05040001: ("the drive does not know this SDO command", "the transfer type is not supported"),
    0x05040002: ("the drive takes no such block size", "the transfer type is not supported"),
    0x05040003: ("the drive missed a segment of a block", "try again; frames may be lost"),
    0x05040004: ("the checksum of a block transfer is wrong", "try again; frames may be lost or changed"),
    0x05040005: ("it is more than the drive has memory for", "write less"),
    0x06010000: ("unsupported access", "check whether the drive's state allows it (an active PDO is not remapped)"),
    0x06010001: ("it can only be written", "write it, or read the object that shows it"),
    0x06010002: ("it can only be read", "check the index"),
    0x06020000: ("the drive has no such object", "compare the EDS with the drive's firmware"),
    0x06040041: ("it cannot be mapped to a PDO", "choose another object"),
    0x06040042: ("more than a PDO holds", "record or play fewer objects"),
    0x06040043: ("general incompatibility of parameters", "see the drive's manual"),
    0x06060000: ("a hardware error", "see the drive's manual"),
    0x06070010: ("the length does not match the data type", "compare the EDS with the drive's firmware"),
    0x06070012: ("too long for the data type", "compare the EDS with the drive's firmware"),
    0x06070013: ("too short for the data type", "compare the EDS with the drive's firmware"),
    0x06090011: ("there is no such sub-index", "compare the EDS with the drive's firmware"),
    0x06090030: ("the value is out of range", "choose a value that the drive's manual lists"),
    0x06090031: ("the value is too high", "choose a lower one"),
    0x06090032: ("the value is too low", "choose a higher one"),
    0x08000000: ("a general error", "see the drive's manual"),
    0x06010003: ("sub-index 0 is in use", "write 0 to sub-index 0 first"),
    0x08000020: ("the data cannot be stored", "see the drive's manual"),
    0x08000021: ("local control", "see the drive's manual"),
    0x08000022: ("the drive's present state does not allow it", "read the statusword 6041h and the mode 6061h"),
}


class BusError(Exception):
    """A failure of the bus or of an answer over it; the message says what to try."""


class OpenError(BusError):
    """The bus cannot be opened: interface or channel are wrong, or absent."""


class NoAnswerError(BusError, TimeoutError):
    """A node did not answer in time; `silent` are those that sent no process data, by position, as far as known."""

    def __init__(self, told: str = "", silent: Sequence[int] = ()) -> None:
        super().__init__(told)
        self.silent = tuple(silent)


class RefusedError(ObjectAccessError):
    """The drive answered with an SDO abort; a plain ObjectAccessError is raised before anything is sent."""


def refused(where: str, what: str, code: int) -> RefusedError:
    """Return the error for an SDO abort.

    Args:
        where: Node and axis, e.g. "node 1".
        what: The access, e.g. "the write of 3 to 6060h:00 Modes of operation".
        code: The drive's abort code.
    """
    meaning, remedy = _ABORTS.get(code, ("an abort code that CiA 301 does not list", "see the drive's manual"))
    return RefusedError(code, f"{where} refused {what}: {meaning}; {remedy}")
