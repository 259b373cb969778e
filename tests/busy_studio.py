"""A studio with one more page, which computes as long as its address says: what a reader of a big file would do.

Run as a program it is `drive-env`, for `StudioProcess`.
"""

from __future__ import annotations

import time

from drive_env.programs import drive_env
from drive_env.studio import pages
from drive_env.studio.page import StudioPage


def attach(web, session):
    @web.get("/busy/{seconds}")
    async def compute(seconds: float) -> str:
        print("a page begins to compute")
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            sum(range(1000))
        print("a page has computed")
        return "done"


if __name__ == "__main__":
    page = StudioPage("/busy", "Busy", "hourglass_top", 90, lambda session, visitor: None, attach=attach)
    pages.OWN = (*pages.OWN, page)
    drive_env()
