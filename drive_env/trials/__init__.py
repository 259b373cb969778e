"""Moves and trials, and what they are worth: environments and tuning stand on these."""
