"""The master's side of a fieldbus: drives over a link, and CAN, which is one. It knows EDS files, not the slave."""
