"""Length of a classical CAN frame on the wire, in bits, with the stuff bits that its content needs.

ISO 11898-1: from start of frame to the end of the CRC every five equal bits are followed by a bit of the other
polarity; the CRC delimiter, the acknowledge slot and its delimiter, end of frame (7) and the intermission (3) are not
stuffed.
"""

from __future__ import annotations

from functools import lru_cache

from drive_env.canopen.frames import Frame

CRC_POLYNOMIAL = 0x4599  # x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1
CRC_DELIMITER_AND_ACKNOWLEDGE = 3
END_OF_FRAME = 7
INTERMISSION = 3
# An error seen by every receiver at once: flag and delimiter.
ERROR_FRAME = 6 + 8


@lru_cache(maxsize=4096)  # frames repeat: SYNC, requests, unchanged targets
def frame_bits(frame: Frame, extended: bool = False) -> int:
    """Return the bits that a frame takes on the bus, stuff bits and intermission included.

    A frame with eight bytes takes 111 to 135 bits: a bus of 1 Mbit/s carries 7,400 to 9,000 of them per second.
    """
    return stuffed_bits(frame, extended) + CRC_DELIMITER_AND_ACKNOWLEDGE + END_OF_FRAME + INTERMISSION


@lru_cache(maxsize=4096)
def broken_frame_bits(frame: Frame, extended: bool = False) -> int:
    """Return the bits of a frame that fails the receivers' CRC check: up to the CRC, then the error frame."""
    return stuffed_bits(frame, extended) + CRC_DELIMITER_AND_ACKNOWLEDGE + ERROR_FRAME + INTERMISSION


def stuffed_bits(frame: Frame, extended: bool = False) -> int:
    """Return the bits from start of frame to the end of the CRC, stuff bits included."""
    length = (frame.dlc or 0) if frame.rtr else len(frame.data)
    if extended:
        base, extension = frame.can_id >> 18, frame.can_id & 0x3FFFF
        # Substitute remote request and identifier extension are recessive.
        header = base << 27 | 0b11 << 25 | extension << 7 | frame.rtr << 6 | length
        header_bits = 38
    else:
        header = frame.can_id << 7 | frame.rtr << 6 | length
        header_bits = 18
    content = header << 8 * len(frame.data) | int.from_bytes(frame.data, "big")
    num_bits = header_bits + 8 * len(frame.data)
    # Leading zeros do not change the CRC, and so neither does the start of frame.
    content = content << 15 | crc15(content.to_bytes(-(-num_bits // 8), "big"))
    num_bits += 15
    # Start of frame is one dominant bit; then single bits until whole bytes remain.
    stuffing, state = 0, _state(0, 1)
    whole = num_bits // 8
    for k in range(num_bits % 8):
        state, added = _after_bit(state, content >> (num_bits - 1 - k) & 1)
        stuffing += added
    for byte in (content & ((1 << 8 * whole) - 1)).to_bytes(whole, "big"):
        state, added = _STUFFING[state][byte]
        stuffing += added
    return 1 + num_bits + stuffing


def crc15(data: bytes) -> int:
    """Return the CRC-15 of CAN over whole bytes."""
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0x7FFF) ^ _CRC[(crc >> 7) ^ byte]
    return crc


def _state(bit: int, run: int) -> int:
    """Return the number of the state "the last `run` bits were `bit`", run 1 to 4."""
    return 4 * bit + run - 1


def _after_bit(state: int, bit: int) -> tuple[int, int]:
    """Return the state after one more bit, and the number of stuff bits (0 or 1) that follow it."""
    last, run = divmod(state, 4)
    run = run + 2 if bit == last else 1
    return (_state(1 - bit, 1), 1) if run == 5 else (_state(bit, run), 0)


def _after_byte(state: int, byte: int) -> tuple[int, int]:
    stuffing = 0
    for k in range(7, -1, -1):
        state, added = _after_bit(state, byte >> k & 1)
        stuffing += added
    return state, stuffing


def _crc_of_byte(byte: int) -> int:
    crc = byte << 7
    for _ in range(8):
        crc = crc << 1 ^ (CRC_POLYNOMIAL if crc & 0x4000 else 0)
        crc &= 0x7FFF
    return crc


_STUFFING = [[_after_byte(state, byte) for byte in range(256)] for state in range(8)]
_CRC = [_crc_of_byte(byte) for byte in range(256)]
