"""Warnings about machines that their motors cannot move, or only badly, with the figures."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from drive_env.devices import Device
from drive_env.motors import Motor
from mechanics.packed import PackedLoad
from mechanics.shaft import shaft_load, way

# Auto-tuning fails easily beyond 15 to 30 times the rotor's inertia (Yaskawa's manuals).
MAX_INERTIA_RATIO = 30.0


class MisfitWarning(UserWarning):
    """A machine demands more of its motor than it can give."""


def warn_of_misfits(loads: Sequence[PackedLoad], motor: Motor, device: Device) -> None:
    """Warn once for the worst machine of each kind of misfit.

    Args:
        loads: The packed loads of all machines.
        motor: Their motor.
        device: Their drives, which may have too little current for the motor's torque.
    """
    turning = way(loads[0]).joints
    found = [shaft_load(load, turning) for load in loads]
    gravity = np.concatenate([row.gravity for row in found])
    friction = np.concatenate([row.friction for row in found])
    ratio = np.concatenate([row.inertia / load.armature for row, load in zip(found, loads, strict=True)])
    name = loads[0].load.name
    torque = gravity + friction
    machine, axis = np.unravel_index(int(torque.argmax()), torque.shape)
    given = device.torque_of(motor)
    if torque[machine, axis] > given:
        limit = f"the motor is rated at {given:g} N*m"
        if given < motor.rated_torque:
            limit = (
                f"{device.name} has {device.current_full_scale:g} A of the {motor.rated_current:.3g} A for the motor's "
                f"{motor.rated_torque:g} N*m, which leaves {given:.3g} N*m"
            )
        warnings.warn(
            f"motor {motor.name!r} cannot move axis {axis} of machine {machine}, load {name!r}, for long: it takes "
            f"{torque[machine, axis]:.3g} N*m at the shaft ({gravity[machine, axis]:.3g} against gravity, "
            f"{friction[machine, axis]:.3g} to break away), and {limit} "
            f"({np.count_nonzero(np.any(torque > given, axis=1))} of {len(torque)} machines); take a "
            "stronger motor, a higher gear or a lighter load",
            MisfitWarning,
            stacklevel=3,
        )
    machine, axis = np.unravel_index(int(ratio.argmax()), ratio.shape)
    if ratio[machine, axis] > MAX_INERTIA_RATIO:
        warnings.warn(
            f"load {name!r} has {ratio[machine, axis]:.0f} times the inertia of the rotor of motor {motor.name!r} at "
            f"axis {axis} of machine {machine} ({np.count_nonzero(np.any(ratio > MAX_INERTIA_RATIO, axis=1))} of "
            f"{len(ratio)} machines above {MAX_INERTIA_RATIO:.0f}); it will be slow and hard to tune: take a larger "
            "motor, a higher gear or a lighter load",
            MisfitWarning,
            stacklevel=3,
        )
