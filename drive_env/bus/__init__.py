"""The CAN bus around emulated nodes: a modelled wire, one time, and the ways in which a master reaches it."""
