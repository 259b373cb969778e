"""Identifies the axes, and prepares their design: models, calm gains, and whether the gains before are safe."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from drive_env.devices.gains import bandwidth_gains, rule_gains
from drive_env.dictionary.roles import Role
from drive_env.fieldbus.errors import BusError
from drive_env.loops.linear_model import OPEN_LOOPS, Plant
from drive_env.loops.margins import margins
from drive_env.safety.envelope import SafetyError, swinging_allowed
from mechanics.arrays import Integers, Mask
from tuning.auto.stages import Basis, IdentifiedAxes
from tuning.identify.identified_axis import TITLES
from tuning.identify.working_state import cautious_bandwidth
from tuning.target import Target

if TYPE_CHECKING:
    from drive_env.devices import Device
    from tuning.auto.bench import AutoBench
    from tuning.identify.identified_axis import Identification

Identify = Callable[[Target, Mask], "list[Identification]"]  # identifies the axes where the mask is true

# The calm gains: bandwidth of the current loop; shares of `cautious_gains`' velocity loop, and of the calm one's.
CALM_CURRENT_HZ, ROTOR_SHARE, POSITION_SHARE = 800.0, 0.6, 0.4
SAFE_GAIN_DB, SAFE_PHASE = 6.0, 25.0  # least margins by the model with which axes are moved
LOOKED_AT = 400  # number of frequencies of the model


def identify(bench: AutoBench, experiments: Identify) -> IdentifiedAxes:
    """Check the wiring and identify; take axes that cannot be tuned out of the run."""
    target, going = bench.target, bench.going
    every: list[Identification] = []
    try:
        if going.any():
            with bench.spending(going), swinging_allowed(target.drives):
                every = experiments(target, going)
    except (SafetyError, RuntimeError, TimeoutError) as error:
        if isinstance(error, BusError):
            raise
        bench.stop(going, f"identification was stopped: {error}")
    found: list[Identification | None] = [None] * target.num_axes
    plants: list[Plant | None] = [None] * target.num_axes
    for k in map(int, np.flatnonzero(going) if every else ()):
        found[k] = every[k]
        plants[k], why = identified_plant(target, k, every[k])
        bench.journals[k].stop(why)
        unknown: dict[str, list[str]] = {}
        for name, estimate in every[k].estimates.items():
            if estimate.reason and name != "inertia":
                unknown.setdefault(estimate.reason, []).append(TITLES[name])
        for reason, titles in unknown.items():
            bench.journals[k].note(f"{', '.join(titles)} not identified: {reason}")
    return IdentifiedAxes(tuple(found), tuple(plants))


def prepare(bench: AutoBench, identified: IdentifiedAxes) -> Basis:
    """Compute the reference gains and calm gains, and check by the model whether the gains before are safe."""
    target = bench.target
    reference = np.ones_like(bench.before)
    calm, unsafe = reference.copy(), np.full(target.num_axes, "not checked", object)
    for axis in map(int, np.flatnonzero(bench.going)):
        (plant, found), before = identified.known(axis), bench.before[axis]
        inertia = found.together if math.isfinite(found.together) else plant.inertia
        reference[axis] = rule_gains(target.device, target.motor, inertia, supply=plant.supply)[0]
        unsafe[axis] = unsafe_gains(target.device, plant, before)
        calm[axis] = calm_gains(target, plant)
    return Basis(identified, bench.before, reference, calm, unsafe)


def calm_gains(target: Target, plant: Plant) -> Integers:
    """Return gains that are stable also with the rotor alone: within backlash and above a resonance it has no load."""
    velocity_hz = cautious_bandwidth(target.motor, plant.inertia) * ROTOR_SHARE
    return bandwidth_gains(
        target.device, target.motor, plant.inertia, current_hz=CALM_CURRENT_HZ, velocity_hz=velocity_hz,
        position_hz=POSITION_SHARE * velocity_hz, supply=plant.supply,
    )  # fmt: skip


def unsafe_gains(device: Device, plant: Plant, gains: Sequence[int]) -> str:
    """Return why an axis must not be moved with gains; "" if it may."""
    if device.gains.opens(gains, *OPEN_LOOPS):
        return "a P gain is 0, so that a loop is open"
    rates = {"current": device.current_rate}
    for name, open_loop in OPEN_LOOPS.items():
        f = np.geomspace(1.0, 0.49 * rates.get(name, device.velocity_rate), LOOKED_AT)
        found = margins(f, open_loop(device, plant, gains, f))
        # A loop whose gain is below 1 at all frequencies has no phase margin (nan), and passes.
        if found.gain_db < SAFE_GAIN_DB or found.phase_deg < SAFE_PHASE:
            return (
                f"they are too near to instability: by the model, the {name} loop has {found.gain_db:.0f} dB of gain "
                f"margin and {found.phase_deg:.0f} degrees of phase margin; {SAFE_GAIN_DB:g} dB and {SAFE_PHASE:g} "
                "degrees are needed"
            )
    return ""


def identified_plant(target: Target, axis: int, identified: Identification) -> tuple[Plant | None, str]:
    """Build the model of an axis; None, and why, if its wiring is wrong or too little was identified."""
    if wrong := wrong_wiring(target, identified):
        return None, wrong
    try:
        return Plant.from_identification(target.device, target.motor, float(target.supply[axis]), identified), ""
    except ValueError as error:
        return None, str(error)


def wrong_wiring(target: Target, identified: Identification) -> str:
    """Describe the error of the wiring; "" if it is correct."""
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
