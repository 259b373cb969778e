"""Untrusted files: readers with limits, a process with limits, and suggestions for unknown names."""
