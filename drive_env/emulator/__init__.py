"""Emulated drives: their records, groups, machines, parameters and recording."""
