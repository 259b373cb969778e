"""The CAN bus of emulated nodes: a modelled wire, one time, and the transports by which a master connects."""
