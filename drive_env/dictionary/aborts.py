"""The error of a refused access to the dictionary, with its SDO abort code of CiA 301."""

from __future__ import annotations

# Abort codes of CiA 301 (table 22 of version 4.2), one of EtherCAT.
TOGGLE_NOT_ALTERNATED = 0x05030000
PROTOCOL_TIMED_OUT = 0x05040000
UNKNOWN_COMMAND = 0x05040001
INVALID_BLOCK_SIZE = 0x05040002
INVALID_SEQUENCE_NUMBER = 0x05040003
CRC_ERROR = 0x05040004
OUT_OF_MEMORY = 0x05040005
UNSUPPORTED_ACCESS = 0x06010000
WRITE_ONLY = 0x06010001
READ_ONLY = 0x06010002
SUB_INDEX_ZERO_IN_USE = 0x06010003  # of ETG.1000.6, table 41
NO_SUCH_OBJECT = 0x06020000
CANNOT_BE_MAPPED = 0x06040041
PDO_LENGTH_EXCEEDED = 0x06040042
INCOMPATIBLE_PARAMETER = 0x06040043
HARDWARE_ERROR = 0x06060000
WRONG_TYPE = 0x06070010
TOO_LONG = 0x06070012
TOO_SHORT = 0x06070013
NO_SUCH_SUB_INDEX = 0x06090011
VALUE_RANGE = 0x06090030
VALUE_TOO_HIGH = 0x06090031
VALUE_TOO_LOW = 0x06090032
CANNOT_BE_STORED = 0x08000020
WRONG_STATE = 0x08000022
NO_DATA = 0x08000024


class ObjectAccessError(Exception):
    """An access that the dictionary refuses; on the bus it becomes an SDO abort.

    Attributes:
        abort_code: The SDO abort code of CiA 301.
    """

    def __init__(self, abort_code: int, message: str) -> None:
        super().__init__(f"{message} (abort code {abort_code >> 16:04X} {abort_code & 0xFFFF:04X}h)")
        self.abort_code = abort_code
