"""Commissioning of open-loop steppers: phase currents, load detection (StallGuard) and current by load (CoolStep)."""
