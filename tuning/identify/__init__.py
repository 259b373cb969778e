"""Identification of motor and machine from the drives' own signals."""
