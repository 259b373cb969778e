"""Commissioning of a TMCM-6212 for a motor, from the motor's data alone; a preset that is written goes before it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from drive_env.devices.chopper_rule import chopper_settings

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.motors import Motor

FULL, STEPS = 255, 32  # of 2003h and 2004h: the largest, and how many steps the driver makes of them
STANDBY = 0.5  # of the run current: half the holding torque
MICROSTEPS = 8  # 2^8 of a full step
REVOLUTIONS = 2.0  # rev/s of moves, within the flat part of any row's torque
RAMP = 10.0  # rev/s^2
STOP = 100.0  # rev/s^2: csp and csv want a quick stop that stops 6,000 rpm within a second
WINDOW = 4  # full steps: what further away has lost steps


def preset(device: Device, motor: Motor) -> dict[str, int]:
    """Return object name -> raw value, in the order of writing."""
    full_steps = 4 * motor.n_p
    scale = full_steps * 2**MICROSTEPS
    # The last of the settings that make a step of the current which is not above the rated one.
    share = min(motor.rated_current / device.current_full_scale, 1.0)
    step = max(math.floor(STEPS * share), 1)
    run = step * (FULL + 1) // STEPS - 1
    return {
        "Microstep resolution": MICROSTEPS,
        "Full step resolution": full_steps,
        "Maximum current": run,
        "Standby current": round(STANDBY * run),
        "Setting delay": 20,
        **chopper_settings(motor, device.current_full_scale * step / STEPS, device.supply_of(motor)),
        "Position encoder resolution.Encoder increments": motor.encoder_counts,
        "Profile velocity": round(REVOLUTIONS * scale),
        "Profile acceleration": round(RAMP * scale),
        "Profile deceleration": round(RAMP * scale),
        "Quick stop deceleration": round(STOP * scale),
        "Homing acceleration": round(RAMP * scale),
        "Following error window": WINDOW * 2**MICROSTEPS,
        "Position window": 2**MICROSTEPS // 4,
        "Position window time": 2,
    }
