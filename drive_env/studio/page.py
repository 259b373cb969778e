"""The pages of the studio: rows of this package, and those that others register in `drive_env.studio_pages`."""

from __future__ import annotations

import importlib.metadata
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fastapi import FastAPI

    from drive_env.studio.session import Session
    from drive_env.studio.visitor import Visitor

logger = logging.getLogger(__name__)

ENTRY_POINTS = "drive_env.studio_pages"


@dataclass(frozen=True)
class StudioPage:
    """A page.

    Attributes:
        path: Where it is: "/scope".
        title: Its name in the navigation.
        icon: The name of a Material icon.
        order: Its place in the navigation, from above; those of this package have 10, 20, 30.
        build: Makes its content, for one visitor, into the present element of NiceGUI.
        emulated_only: Whether it needs emulated machines; it is left out for drives on a bus.
        attach: Adds routes of its own to the web application, websockets for one; it is called once.
    """

    path: str
    title: str
    icon: str
    order: int
    build: Callable[[Session, Visitor], None]
    emulated_only: bool = False
    attach: Callable[[FastAPI, Session], None] | None = None


def studio_pages(*, emulated: bool) -> list[StudioPage]:
    """Return the pages in their order; one that cannot be loaded is left out, and logged."""
    from drive_env.studio.axes_page import page as axes
    from drive_env.studio.dictionary_page import page as dictionary
    from drive_env.studio.scope_page import page as scope

    found = [axes, scope, dictionary]
    for entry in importlib.metadata.entry_points(group=ENTRY_POINTS):
        try:
            found.append(entry.load())
        except ImportError as error:
            logger.warning("the page %s is left out: %s", entry.name, error)
    paths = [page.path for page in found]
    if twice := {path for path in paths if paths.count(path) > 1}:
        raise ValueError(f"two pages register {', '.join(sorted(twice))}; uninstall one of them, or rename its path")
    chosen = [page for page in found if emulated or not page.emulated_only]
    return sorted(chosen, key=lambda page: (page.order, page.title))
