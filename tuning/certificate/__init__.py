"""Certificates: results and changes of a tuning, with the proof."""
