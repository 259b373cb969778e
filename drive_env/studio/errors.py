"""Errors that end jobs of the studio."""

from __future__ import annotations


class JobStoppedError(KeyboardInterrupt):
    """Raised in a job that was stopped from a page; as after Ctrl-C, the job restores its changes before it ends."""


class JobEndedError(RuntimeError):
    """A job was stopped; raised in the caller that waits for its result."""
