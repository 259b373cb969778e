"""Gains of the servo drives whose set is the chip's, by name."""

from __future__ import annotations

from typing import Any

from drive_env.devices.gains import Gains, bandwidth_gains


def chip_gains(*device_motor_inertia: Any, **wanted: float) -> Gains:
    """Return `bandwidth_gains` by name."""
    return Gains(*bandwidth_gains(*device_motor_inertia, **wanted).tolist())
