"""What jobs of the studio end with."""

from __future__ import annotations


class JobStoppedError(KeyboardInterrupt):
    """Raised in a job that was stopped from a page; as after Ctrl-C, what it changed is put back on its way out."""


class JobEndedError(RuntimeError):
    """A job was stopped; raised where its result is waited for."""
