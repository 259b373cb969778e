"""A studio on an emulated machine with one more address, which tells what the emulator has inside.

Run as a program it is `drive-env`, for `StudioProcess`.
"""

from __future__ import annotations

from rigs.truth import truth_of

from drive_env.programs import drive_env
from drive_env.studio import pages
from drive_env.studio.page import StudioPage


def attach(web, session):
    @web.get("/truth")
    def truth():
        return session.glimpse(lambda machine: truth_of(machine.drives), 10.0)


if __name__ == "__main__":
    page = StudioPage("/inside", "Inside", "visibility", 90, lambda session, visitor: None, attach=attach)
    pages.OWN = (*pages.OWN, page)
    drive_env()
