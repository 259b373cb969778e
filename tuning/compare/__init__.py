"""Tuners on the same machines."""
