"""Comparison of tuners on the same machines."""
