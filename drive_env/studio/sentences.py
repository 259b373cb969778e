"""Formats errors as one plain sentence with the remedy, for users of a web page."""

from __future__ import annotations

import logging

logger = logging.getLogger(__name__)

# Remedies in Python, and their equivalents on a page.
_REMEDIES = (
    ("; see emergencies(), then reset_fault()", "; see the faults on the page Axes, then reset them"),
    ("; see emergencies()", "; see the faults on the page Axes"),
    ('; motion.enable(drives, mode="pp") first', "; enable it first"),
    ("Limits(stall=...)", "the limit"),
)


def sentence(error: BaseException) -> str:
    """Return an error as a sentence; errors of this program are logged with their traceback."""
    from drive_env.dictionary.aborts import ObjectAccessError
    from drive_env.fieldbus.errors import BusError
    from drive_env.safety.errors import SafetyError
    from drive_env.studio.errors import JobEndedError

    text = str(error)
    if isinstance(error, OSError) and not isinstance(error, BusError | TimeoutError) and error.strerror:
        text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    expected = (
        ObjectAccessError,
        BusError,
        SafetyError,
        TimeoutError,
        ValueError,
        OSError,
        KeyboardInterrupt,
        JobEndedError,
    )
    if isinstance(error, MemoryError):
        text = "there is not enough memory; ask for less at a time"
    elif not (isinstance(error, expected) or type(error) is RuntimeError) or not text:
        logger.error("a mistake of this program", exc_info=error)
        text = f"a mistake of this program: {type(error).__name__} {text}".rstrip() + "; please report it"
    for theirs, ours in _REMEDIES:
        text = text.replace(theirs, ours)
    return text
