"""What protects the motor on a bus: limits, the envelope that watches them, and what the drive does by itself."""
