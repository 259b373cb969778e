"""Rules: compute gains from an identified axis."""
