"""Parts of pages from other packages: cards on the page Tune, curves on the page Runs."""

from __future__ import annotations

import importlib.metadata
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

logger = logging.getLogger(__name__)

ENTRY_POINTS = "drive_env.studio_parts"


@dataclass(frozen=True)
class StudioPart:
    """A part of a page.

    Attributes:
        page: Path of the page.
        order: Its place among the parts, from the top.
        build: Builds it in the present element; the page that uses parts defines the arguments.
    """

    page: str
    order: int
    build: Callable[[Any], None]


def studio_parts(page: str) -> list[StudioPart]:
    """Return the parts of a page in order; a part that cannot be loaded is omitted, and logged."""
    found: list[StudioPart] = []
    for entry in importlib.metadata.entry_points(group=ENTRY_POINTS):
        try:
            part = entry.load()
        except ImportError as error:
            logger.warning("the part %s of a page is left out: %s", entry.name, error)
            continue
        if part.page == page:
            found.append(part)
    return sorted(found, key=lambda part: part.order)
