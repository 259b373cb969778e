"""A studio with one more address, which tells what the emulator has inside, and with drives of a bus in lockstep.

In lockstep no busy computer distorts what is measured. The studio of the product has no such option: without the
supervisor of real time its stop would be late on a real drive. Run as a program it is `drive-env`, for `StudioProcess`.
"""

from __future__ import annotations

from functools import partialmethod

from rigs.truth import truth_of

from drive_env.commands.options import NodesOptions
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
    NodesOptions.connect = partialmethod(NodesOptions.connect, pace="lockstep")
    drive_env()
