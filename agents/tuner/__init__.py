"""A trained tuner at work on drives."""
