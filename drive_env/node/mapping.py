"""PDO mapping: the meaning of an entry of 1600h...17FFh and 1A00h...1BFFh, and the procedure for changing it.

The procedure is the manual's (sections 3.1.18 and 3.1.20): switch the PDO off (bit 31 of its COB-ID), set the number of
entries to 0, write entries, set their number, switch the PDO on. Other writes are refused with the codes that CiA 301
has for mapping: 06010000h, 06020000h, 06090011h, 06040041h, 06040042h.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from drive_env.dictionary.aborts import CANNOT_BE_MAPPED, PDO_LENGTH_EXCEEDED, UNSUPPORTED_ACCESS, ObjectAccessError
from drive_env.dictionary.access import fits_pdo
from drive_env.dictionary.entries import Entry

MAX_BITS = 64
DUMMIES = range(0x0002, 0x0008)  # CiA 301: data types of 8 bits and more, each as an object that a PDO can map
# Characters of `struct` by width [bits], unsigned and signed: PDOs carry whole bytes.
LAYOUT = {8: ("B", "b"), 16: ("H", "h"), 32: ("I", "i"), 64: ("Q", "q")}


def parse(raw: int) -> tuple[int, int, int]:
    """Return index, sub-index and length [bits] of a mapping entry."""
    return raw >> 16, raw >> 8 & 0xFF, raw & 0xFF


def is_gap(raw: int) -> bool:
    """Return whether a mapping entry is a gap: bits of a process image that belong to no object (ETG.1000.6)."""
    return 0 < raw <= 0xFF


def check_gaps(entry: Entry, raws: Sequence[int]) -> None:
    """Check the gaps among these entries, written to sub-index 0; objects have whole bytes.

    Raises:
        ObjectAccessError: 06040041h if an object, or the mapping's end, does not lie on a byte boundary; 06040042h for
            a gap that is longer than any object.
    """
    bits = 0
    for sub, raw in enumerate(raws, 1):
        if not is_gap(raw) and bits % 8:
            raise ObjectAccessError(
                CANNOT_BE_MAPPED, f"{entry.label}: entry {sub} would begin within a byte; fill gaps up to whole bytes"
            )
        if is_gap(raw) and raw > MAX_BITS:
            raise ObjectAccessError(
                PDO_LENGTH_EXCEEDED,
                f"{entry.label}: entry {sub} is a gap of {raw} bits; one gap has {MAX_BITS} at most",
            )
        bits += raw & 0xFF
    if bits % 8:
        raise ObjectAccessError(
            CANNOT_BE_MAPPED, f"{entry.label}: {len(raws)} entries make {bits} bits; fill gaps up to whole bytes"
        )


def check_may_change(entry: Entry, is_on: bool, count: int) -> None:
    """Raise 06010000h for a change of a mapping while its PDO is on, or of an entry while the mapping is in use."""
    if is_on:
        raise ObjectAccessError(
            UNSUPPORTED_ACCESS, f"{entry.label} is in use; set bit 31 of the PDO's COB-ID before changing its mapping"
        )
    if entry.sub != 0 and count != 0:
        raise ObjectAccessError(
            UNSUPPORTED_ACCESS, f"{entry.label} is one of {count} in use; set sub-index 0 to 0 before"
        )


def check_mappable(entry: Entry, raw: int, transmit: bool, find: Callable[[int, int], Entry]) -> Entry:
    """Return the object that a mapping entry names.

    Raises:
        ObjectAccessError: 06020000h if there is no such object, 06090011h if it has no such sub-index, 06040041h if a
            PDO of this direction cannot carry it.
    """
    index, sub, bits = parse(raw)
    try:
        mapped = find(index, sub)
    except ObjectAccessError as error:
        raise ObjectAccessError(
            error.abort_code, f"{entry.label} cannot map {index:04X}h:{sub:02X}: {error}"
        ) from error
    if index in DUMMIES and not transmit and mapped.bits == bits and bits in LAYOUT:
        return mapped  # dummy: bytes of a frame that are skipped; only those exist that the EDS allows
    if not fits_pdo(mapped, transmit) or mapped.bits not in LAYOUT:
        other = "TPDOs" if fits_pdo(mapped, True) else "RPDOs" if fits_pdo(mapped, False) else ""
        ways = f"{other} alone carry it" if other and mapped.bits in LAYOUT else "no PDO carries it"
        raise ObjectAccessError(CANNOT_BE_MAPPED, f"{entry.label} cannot map {mapped.label}, {mapped.access}: {ways}")
    if mapped.bits != bits:
        raise ObjectAccessError(
            CANNOT_BE_MAPPED, f"{entry.label}: {mapped.label} has {mapped.bits} bits, not {bits}; write the object's"
        )
    return mapped


def check_mapping(entry: Entry, raws: Sequence[int], transmit: bool, find: Callable[[int, int], Entry]) -> None:
    """Raise 06020000h, 06040041h or 06040042h unless these entries, written to sub-index 0, form a valid PDO."""
    bits = sum(check_mappable(entry, raw, transmit, find).bits or 0 for raw in raws)
    if bits > MAX_BITS:
        raise ObjectAccessError(
            PDO_LENGTH_EXCEEDED, f"{entry.label}: {len(raws)} entries make {bits} bits; a PDO carries {MAX_BITS}"
        )
