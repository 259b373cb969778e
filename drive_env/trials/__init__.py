"""Moves and trials, and their scores: environments and tuning stand on these."""
