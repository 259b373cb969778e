"""Commissioning as one path of steps, from the motor's data to the certificate; stopped, it leaves nothing behind."""
