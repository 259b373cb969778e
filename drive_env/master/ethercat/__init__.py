"""The link over EtherCAT: process images, the mailbox, states, the watchdog of process data (ETG.1000)."""
