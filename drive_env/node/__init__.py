"""What the node of every fieldbus has."""
