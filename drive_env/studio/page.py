"""The definition of a studio page: its address, its title, and the function that builds it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fastapi import FastAPI

    from drive_env.studio.session import Session
    from drive_env.studio.visitor import Visitor


@dataclass(frozen=True)
class StudioPage:
    """A page.

    Attributes:
        path: Its address, e.g. "/scope".
        title: Its name in the navigation.
        icon: Name of a Material icon.
        order: Its place in the navigation, from the top; our pages have 10 to 60.
        build: Builds its content, for one visitor, in the present element of NiceGUI.
        emulated_only: Whether it needs emulated machines; it is omitted for drives on a bus.
        attach: Adds its own routes to the web application, such as websockets; called once.
    """

    path: str
    title: str
    icon: str
    order: int
    build: Callable[[Session, Visitor], None]
    emulated_only: bool = False
    attach: Callable[[FastAPI, Session], None] | None = None
