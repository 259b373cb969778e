"""Access to objects: the checks of type, access and range."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from drive_env.dictionary.aborts import (
    READ_ONLY,
    VALUE_RANGE,
    VALUE_TOO_HIGH,
    VALUE_TOO_LOW,
    WRITE_ONLY,
    WRONG_TYPE,
    ObjectAccessError,
)
from mechanics.arrays import Integers

if TYPE_CHECKING:
    from drive_env.dictionary.entries import Entry


def check_readable(entry: Entry) -> None:
    """Raise 06010001h for a write-only entry."""
    if entry.access == "wo":
        raise ObjectAccessError(WRITE_ONLY, f"{entry.label} can only be written")


def fits_pdo(entry: Entry, transmit: bool) -> bool:
    """Return whether a PDO of this direction can carry an entry, by PDOMapping and AccessType of its EDS (CiA 306).

    `rww` is written by a process image, so only RPDOs carry it; `rwr` is read by one, so only TPDOs carry it. A `const`
    needs to be read only once, so no PDO carries it.
    """
    return entry.pdo_mappable and entry.access in (("ro", "rw", "rwr") if transmit else ("wo", "rw", "rww"))


def check_writable(entry: Entry) -> None:
    """Raise 06010002h for a read-only entry."""
    if entry.access in ("ro", "const"):
        raise ObjectAccessError(READ_ONLY, f"{entry.label} can only be read")


def checked_values(entry: Entry, value: Any, num_axes: int) -> Integers:
    """Return values as the wire carries them, int64 of shape (num_axes,), after the checks of type and range.

    Args:
        entry: The entry to write.
        value: An integer or an array of them, one per axis.
        num_axes: Number of axes.

    Raises:
        ObjectAccessError: 06070010h for a value that is not an integer or does not fit the axes, 06090031h and
            06090032h for a value beyond the range.
    """
    raw = _as_array(value)
    if raw.dtype == object and all(isinstance(item, int) for item in raw.flat):
        _check_range(entry, raw)  # raises for an integer beyond 64 bits
    if entry.bits is None or raw.dtype.kind not in "iu":
        kind = "a text" if entry.bits is None else f"a {entry.bits}-bit integer"
        raise ObjectAccessError(WRONG_TYPE, f"{entry.label} is {kind}; got {value!r}, which is {_describe(raw)}")
    if raw.ndim > 1 or (raw.ndim == 1 and raw.shape[0] != num_axes):
        raise ObjectAccessError(
            WRONG_TYPE, f"{entry.label} takes one value or one for each of {num_axes} axes, not shape {raw.shape}"
        )
    _check_range(entry, raw)
    return np.broadcast_to(raw.astype(np.int64), (num_axes,))


def _as_array(value: Any) -> NDArray[Any]:
    """Return the value as an array; for rows of different lengths one without numbers."""
    try:
        return np.asarray(value)
    except ValueError:
        return np.array(None)


def check_in_range(entry: Entry, raw: NDArray[Any]) -> None:
    """Raise 06070010h, 06090031h or 06090032h unless every element is an integer within the entry's range."""
    if raw.dtype.kind not in "iu":
        raise ObjectAccessError(WRONG_TYPE, f"{entry.label} takes integers; got {_describe(raw)}")
    _check_range(entry, raw)


def check_allowed(entry: Entry, raw: Integers, allowed: tuple[int, ...]) -> None:
    """Raise 06090030h for a value that is not among the few that the object allows."""
    wrong = raw[~np.isin(raw, allowed)]
    if wrong.size:
        raise ObjectAccessError(VALUE_RANGE, f"{entry.label} cannot be {wrong[0]}; allowed are {_listed(allowed)}")


def _listed(values: tuple[int, ...]) -> str:
    """Return ascending values as text for a message: three or more consecutive ones as a range."""
    runs: list[list[int]] = []
    for value in values:
        if runs and value == runs[-1][-1] + 1:
            runs[-1].append(value)
        else:
            runs.append([value])
    texts = [[f"{run[0]} to {run[-1]}"] if len(run) > 2 else [str(value) for value in run] for run in runs]
    return ", ".join(text for run in texts for text in run)


def check_limits(entry: Entry, raw: int) -> None:
    """Raise 06090031h or 06090032h unless an integer is within the entry's range."""
    if entry.low is None or entry.high is None:
        return
    if raw > entry.high:
        raise ObjectAccessError(VALUE_TOO_HIGH, f"{entry.label} cannot be {raw}; its highest is {entry.high}")
    if raw < entry.low:
        raise ObjectAccessError(VALUE_TOO_LOW, f"{entry.label} cannot be {raw}; its lowest is {entry.low}")


def _check_range(entry: Entry, raw: NDArray[Any]) -> None:
    if raw.size:
        check_limits(entry, int(raw.max()))
        check_limits(entry, int(raw.min()))


def _describe(raw: NDArray[Any]) -> str:
    return {"f": "a float", "b": "a boolean", "U": "a text", "c": "complex", "O": "not an array of integers"}.get(
        raw.dtype.kind, str(raw.dtype)
    )
