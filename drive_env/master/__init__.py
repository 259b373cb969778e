"""The master's side of the bus: what CanDrives is made of. It knows python-can and EDS files, not the slave."""
