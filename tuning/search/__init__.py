"""Search of gains by optimisers."""
