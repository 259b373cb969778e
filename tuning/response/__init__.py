"""Frequency responses, the plant fitted to them, and their margins."""
