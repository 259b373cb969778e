"""The master's side of a fieldbus: drives over a link (CAN or EtherCAT). It knows EDS files, not the slave's code."""
