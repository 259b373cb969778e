"""Random machines: distributions of their parameters, supply, temperatures, bus and faults."""
