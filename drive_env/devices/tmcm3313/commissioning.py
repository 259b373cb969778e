"""Commissioning of a TMCM-3313 for a motor, from the motor's data alone; a preset that is written goes before it.

The loop stays open: 606Ah = 0 and 2020h = 1 (or 2, 3), written once the axis is enabled, close it with these values.
"""

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
BOW = 0.05  # s in which an S-shaped ramp (6086h = 1) has its acceleration
WINDOW = 4  # full steps: what further away has lost steps
# Of the closed loop and the PID in microsteps, whatever the motor: table 2 of the manual.
LOOP = {
    "Maximum correction tolerance": 255,
    "Correction position P": 65536,
    "Closed loop beta": 255,
    "Current scaler minimum": 50,
    "Current scaler maximum": 255,
    "Correction velocity P": 3000,
    "Correction velocity I": 20,
    "Correction velocity I clipping": 2000,
    "Correction velocity DV clock": 0,
    "Upscale delay": 1000,
    "Downscale delay": 10000,
    "Field weakening": 255,
}


def corner_speed(motor: Motor, current: float, supply: float) -> float:
    """Return the electrical speed [rad/s] at which a current [A] across the flux takes the whole supply [V].

    (R i + psi w)^2 + (L i w)^2 = u^2; the flux is that at the current. 0 where the resistance takes it all.
    """
    psi = motor.psi_m / math.sqrt(1.0 + motor.saturation * current**2)
    a = psi**2 + (motor.L_q * current) ** 2
    b = motor.R_s * current * psi
    c = (motor.R_s * current) ** 2 - supply**2
    return max((math.sqrt(max(b * b - a * c, 0.0)) - b) / a, 0.0)


def preset(device: Device, motor: Motor) -> dict[str, int]:
    """Return object name -> raw value, in the order of writing."""
    full_steps = 4 * motor.n_p
    scale = full_steps * 2**MICROSTEPS
    # The last of the settings that make a step of the current which is not above the rated one.
    share = min(motor.rated_current / device.current_full_scale, 1.0)
    step = max(math.floor(STEPS * share), 1)
    run = step * (FULL + 1) // STEPS - 1
    corner = corner_speed(motor, device.current_full_scale * step / STEPS, device.supply_of(motor))
    weakening = round(corner / (2.0 * math.pi) * 4 * 2**MICROSTEPS)  # microsteps/s
    ramp = round(RAMP * scale)
    return {
        "Microstep resolution": MICROSTEPS,
        "Full step resolution": full_steps,
        "Maximum current": run,
        "Standby current": round(STANDBY * run),
        "Setting delay": 20,
        **chopper_settings(motor, device.current_full_scale * step / STEPS, device.supply_of(motor)),
        "Position encoder resolution.Encoder increments": motor.encoder_counts,
        "Profile velocity": round(REVOLUTIONS * scale),
        "Profile acceleration": ramp,
        "Profile deceleration": ramp,
        "Quick stop deceleration": round(STOP * scale),
        **{f"Profile jerk.Profile jerk {k}": round(ramp / BOW) for k in range(1, 5)},
        "Homing acceleration": ramp,
        "Following error window": WINDOW * 2**MICROSTEPS,
        "Position window": 2**MICROSTEPS // 4,
        "Position window time": 2,
        **LOOP,
        "Correction velocity DV clipping": round(REVOLUTIONS * scale),
        "Field weakening minimum velocity": weakening,
        "Field weakening maximum velocity": weakening,
    }
