"""Checks of auto before the motor turns fast: the wiring, and whether the gains in the drive are safe."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from drive_env.dictionary.roles import Role
from drive_env.loops.linear_model import OPEN_LOOPS, Plant
from drive_env.loops.margins import margins

if TYPE_CHECKING:
    from collections.abc import Sequence

    from drive_env.devices import Device
    from tuning.identify.identified_axis import Identification
    from tuning.target import Target

SAFE_GAIN_DB, SAFE_PHASE = 6.0, 25.0  # margins by the model, from which on gains are moved with
LOOKED_AT = 400  # frequencies of the model


def unsafe_gains(device: Device, plant: Plant, gains: Sequence[int]) -> str:
    """Return why an axis must not be moved with gains, "" if it may."""
    if device.gains.opens(gains, *OPEN_LOOPS):
        return "a P gain is 0, so that a loop is open"
    rates = {"current": device.current_rate}
    for name, open_loop in OPEN_LOOPS.items():
        f = np.geomspace(1.0, 0.49 * rates.get(name, device.velocity_rate), LOOKED_AT)
        found = margins(f, open_loop(device, plant, gains, f))
        # A loop whose gain is below 1 everywhere has all the phase there is.
        if found.gain_db < SAFE_GAIN_DB or found.phase_deg < SAFE_PHASE:
            return (
                f"they are too near to instability: by the model, the {name} loop has {found.gain_db:.0f} dB of gain "
                f"margin and {found.phase_deg:.0f} degrees of phase margin; {SAFE_GAIN_DB:g} dB and {SAFE_PHASE:g} "
                "degrees are needed"
            )
    return ""


def identified_plant(target: Target, axis: int, identified: Identification) -> tuple[Plant | None, str]:
    """Return the model of an axis; None, and why, where its wiring is wrong or too little was identified."""
    if wrong := wrong_wiring(target, identified):
        return None, wrong
    try:
        return Plant.from_identification(target.device, target.motor, float(target.supply[axis]), identified), ""
    except ValueError as error:
        return None, str(error)


def wrong_wiring(target: Target, identified: Identification) -> str:
    """Name the fault of the wiring, "" if it is right."""
    direction, pairs = identified.estimates.get("encoder_direction"), identified.estimates.get("pole_pairs")
    if direction is not None and direction.value < 0.0:
        return identified.estimates["inertia"].reason
    if pairs is not None and pairs.is_known and round(pairs.value) != target.motor.n_p:
        index, _ = target.device.roles[Role.POLE_PAIRS]
        return (
            f"the motor has {pairs.value:.0f} pole pairs, and {target.motor.name} has {target.motor.n_p}: "
            f"this is another motor; give the right one with --motor, or correct {index:04X}h"
        )
    return ""
