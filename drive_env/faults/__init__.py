"""Faults as a feature: a table of what can fail, schedules, and what each does to machines, bus and nodes."""
