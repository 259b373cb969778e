"""Errors that end jobs of the studio."""

from __future__ import annotations


class JobStoppedError(KeyboardInterrupt):
    """Raised in a job that was stopped from a page; as after Ctrl-C, the job puts its changes back on its way out."""


class JobEndedError(RuntimeError):
    """A job was stopped; raised where its result is waited for."""
