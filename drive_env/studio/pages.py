"""The pages of the studio: those of this package, and those registered in `drive_env.studio_pages`."""

from __future__ import annotations

import importlib.metadata
import logging

from drive_env.studio.axes_page import page as axes
from drive_env.studio.dictionary_page import page as dictionary
from drive_env.studio.machine_page import page as machine
from drive_env.studio.page import StudioPage
from drive_env.studio.runs_page import page as runs
from drive_env.studio.scope_page import page as scope

logger = logging.getLogger(__name__)

ENTRY_POINTS = "drive_env.studio_pages"
OWN = (axes, scope, dictionary, machine, runs)


def studio_pages(*, emulated: bool) -> list[StudioPage]:
    """Return the pages in order, without those that cannot be loaded (logged); ValueError for a path used twice."""
    found = list(OWN)
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
