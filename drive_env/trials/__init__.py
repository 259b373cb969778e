"""Moves, trials and their scores, used by environments and tuning."""
