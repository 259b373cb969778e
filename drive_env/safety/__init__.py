"""Protection of the motor on a bus: limits, the envelope that monitors them, and the drive's own watchdogs."""
