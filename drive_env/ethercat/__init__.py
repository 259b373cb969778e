"""EtherCAT: the slave controller in software, its mailbox, its clocks, and the ways frames come to it."""
