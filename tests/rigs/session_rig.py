"""A session of the studio without its pages: drives, and a page that is there as long as a block runs."""

from __future__ import annotations

import threading
import time
from contextlib import contextmanager

from drive_env import EmulatedDrives
from drive_env.fieldbus.description import describe
from drive_env.studio.session import Session


@contextmanager
def opened(load, device="tmcm1636", motor="qbl4208", **options):
    drives = lambda: EmulatedDrives(device, load, motor, num_threads=1, **options)  # noqa: E731
    made = Session(drives, "a machine", describe(device, None))
    made.presence.beat("page")
    made.start()
    until(lambda: made.state != "opening", 120.0)
    assert made.state == "open", made.failure
    try:
        yield made
    finally:
        made.close()


def until(condition, patience=20.0):
    end = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


class Beats:
    """A page that is there as long as a block runs."""

    def __init__(self, session, page="page", held=0):
        self.session, self.page, self.held = session, page, held
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self):
        while not self._end.wait(0.1):
            self.session.presence.beat(self.page, self.held)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._end.set()
        self._thread.join()
