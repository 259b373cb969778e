"""Commissioning as one path of steps, from the motor's data to the certificate; if stopped, it restores the drives."""
