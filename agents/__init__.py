"""Trained tuners and controllers."""
