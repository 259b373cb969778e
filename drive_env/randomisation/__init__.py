"""Machines that are drawn: distributions of their parameters, supply, temperatures, bus and faults."""
