"""Faults: a table of them, schedules, and their effects on machines, bus and nodes."""
