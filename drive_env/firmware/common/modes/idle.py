"""No mode (6060h = 0): a running motor is stopped and held at standstill."""

from __future__ import annotations

from drive_env.firmware.common import profiles
from mechanics.kernels.compiled import stage


@stage
def generate(drive, lane, rate, dt):
    """Brake with `rate` [rad/s^2] and hold the velocity at zero."""
    drive.loop_level[lane] = 1
    x, v = profiles.stop(drive.position_demand[lane], drive.velocity_demand[lane], rate, dt)
    drive.position_demand[lane] = x
    drive.velocity_demand[lane] = v
    drive.target_reached[lane] = 0
