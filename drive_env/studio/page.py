"""A page of the studio, as a row: its address, its title, and the function that makes it."""

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
        path: Where it is: "/scope".
        title: Its name in the navigation.
        icon: The name of a Material icon.
        order: Its place in the navigation, from above; ours have 10 to 60.
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
