"""Optimisers of gains."""
