"""EtherCAT: the slave controller in software, its mailbox, its clocks, and the transports of frames to it."""
