"""A stepper's load reading in spread cycle: nearly linear in the voltage that a falling phase feeds back.

Against its current i, at speed w, with the load angle d (electrical):

    u = L i n_p w + n_p psi w (cos d - sin d) - R i

The counts per volt are not published; moves at two speeds give them, since L and psi are known from the data sheet.
"""

from __future__ import annotations

import math

import numpy as np

from drive_env.devices import Device
from drive_env.dictionary.roles import Role
from drive_env.motors import Motor
from mechanics.arrays import Floats

THRESHOLD = ("load detection", "threshold")  # loop and part of the gain
LOWER, WIDTH, LEAST, DOWN, UP = (("CoolStep", part) for part in ("lower", "width", "least", "down", "up"))
STALL_ANGLE = math.radians(60.0)  # load angle at which the reading should be 0
SLOW = 0.7  # of the working speed: second speed, at which the reading is compared
FULL_READING = 1023.0
LIFT = 16  # steps by which the threshold is raised if the reading is 0


def lacks_load_detection(device: Device) -> str:
    """List the parts that a device lacks for adjustable load detection as text; "" if it lacks none."""
    if device.gains.column(*THRESHOLD) is None:
        return "its gains.toml has no threshold of a load detection"
    missing = [role.value for role in (Role.LOAD_VALUE, Role.STALL_SPEED) if role not in device.roles]
    return f"it has no {' and no '.join(missing)}" if missing else ""


def has_coolstep(device: Device) -> bool:
    """Return whether a device can adapt its current to the load."""
    parts = (LOWER, WIDTH, LEAST, DOWN, UP)
    return Role.COOLSTEP_SPEED in device.roles and all(device.gains.column(*part) is not None for part in parts)


def flux(motor: Motor, run: Floats) -> Floats:
    """Return the back-EMF constant at amplitudes of the run current [A], [V s/rad]."""
    return np.asarray(motor.torque_constant / np.sqrt(1.0 + motor.saturation * run**2))


def volts(motor: Motor, run: Floats, speed: float, angle: Floats) -> Floats:
    """Return the voltage that a falling phase feeds back [V], without that of the resistance, equal at all speeds."""
    return np.asarray(speed * (motor.L_q * run * motor.n_p + flux(motor, run) * falls(angle)))


def falls(angle: Floats | float) -> Floats:
    """Return the share of the reading that remains at a load angle [rad]: 1 without load, 0 at 45 degrees, -1 at 90."""
    return np.asarray(np.cos(angle) - np.sin(angle))


def angle_of(left: Floats) -> Floats:
    """Return the load angle [rad] at which `falls` has a value; nan if it never does."""
    share = np.asarray(left, float) / math.sqrt(2.0)
    inside = np.abs(share) <= 1.0
    return np.where(inside, np.arccos(np.where(inside, share, 0.0)) - 0.25 * math.pi, np.nan)
