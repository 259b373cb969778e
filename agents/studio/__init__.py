"""The agents' parts of the studio: the trained tuner on the page Tune, learning curves on the page Runs."""
