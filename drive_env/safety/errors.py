"""What the envelope raises, and what it logs and goes on after."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator

from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.fieldbus.errors import BusError

logger = logging.getLogger(__name__)


class SafetyError(RuntimeError):
    """The envelope refused a command, or stopped the drives; the message names value, limit and remedy."""


@contextlib.contextmanager
def logged() -> Iterator[None]:
    """Log what fails while stopping, and go on: the other axes must be stopped, too."""
    try:
        yield
    except (BusError, ObjectAccessError) as error:
        logger.error("%s", error)
