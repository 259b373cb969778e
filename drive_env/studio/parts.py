"""Parts of pages that other packages add: cards on the page Tune, curves on the page Runs."""

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
        order: Its place among the parts, from above.
        build: Makes it into the present element; the page that takes parts defines the arguments.
    """

    page: str
    order: int
    build: Callable[[Any], None]


def studio_parts(page: str) -> list[StudioPart]:
    """Return the parts of a page in their order; one that cannot be loaded is left out, and logged."""
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
