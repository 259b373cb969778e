"""The parts of a node of any fieldbus."""
