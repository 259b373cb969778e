"""Identification in half the time, for tuning: the same checks and the same response, and moves that are soon over.

Where `identify` moves an axis for five seconds to know inertia and friction within a few percent, two moves of a
quarter of a second must do here; the frequency response then says the inertia again, and better.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env import motion
from drive_env.envs.gain_trial import Trials
from drive_env.gains import write_gains
from tuning.experiments import MECHANICS, PULSED, RESPONSE, Experiments
from tuning.frequency_response import measure
from tuning.identification import NAMES, Estimate, Identification, Progress
from tuning.oscillation_watch import shaken
from tuning.target import Target
from tuning.winding import BRIEFLY, identify_winding, pulse, to_torque_mode
from tuning.working_state import GUESS, STATUS, Working, cautious_gains, enable, switch_off

if TYPE_CHECKING:
    from tuning.plant_fit import PlantFit

INERTIA_ERROR, FRICTION_ERROR = 0.15, 0.3  # relative: what two moves tell it to
# Half of an interval over its value, of what a fit gives and would refuse to state.
DOUBT = {"inertia": 0.2, "velocity_filter": 0.4, "anti_resonance": 0.1, "resonance": 0.1, "damping": 0.5}
ANOTHER = 2.5  # times the inertia that two moves tell: a response that says more is that of another axis
ELECTRICAL_ANGLE, SHAFT_DIRECTION = 0x2103, 0x2057


def identify_briefly(
    target: Target, where: NDArray[np.bool_] | None = None, progress: Progress | None = None
) -> list[Identification]:
    """Identify axes, all by default, in about four seconds; otherwise as `tuning.identification.identify`."""
    axes = np.ones(target.num_axes, bool) if where is None else where
    return _Brief(target, axes, progress or (lambda what, share: None)).run()


class _Brief(Experiments):
    """Those experiments, with another middle."""

    thorough = False

    def turn(self, working: Working) -> None:
        target, drives = working.target, working.target.drives
        self.begin("current pulses", 0.3, NAMES)
        enable(working, "csv")
        holding = self.hold(working)
        electrical = drives.read(ELECTRICAL_ANGLE) * (2.0 * math.pi / 65536.0)
        to_torque_mode(working, holding)
        with shaken(drives, PULSED * working.current):
            pulses = pulse(working, holding, BRIEFLY)
        working = self.calm(working)
        sign = 1.0 - 2.0 * float(drives.read(SHAFT_DIRECTION)[0])
        self.take_windings(working, identify_winding(working, pulses, electrical, target.motor.n_p * sign))
        self.begin("inertia and friction", 0.45, MECHANICS)
        write_gains(drives, cautious_gains(target, GUESS * target.motor.inertia), working.where)
        motion.select_mode(drives, "pp", working.where)
        down, up = working.room()
        # t_0 scales a figure that is not asked for here.
        trials = Trials(drives, target.motor, target.axes_per_machine, 1.0)
        found, _ = trials.identify(np.where(up >= -down, up, down), working.where)
        for k in map(int, np.flatnonzero(working.where)):
            self.found[k] |= {
                "inertia": _about(found.inertia[k], INERTIA_ERROR, "kg*m^2"),
                "coulomb": _about(found.coulomb[k], FRICTION_ERROR, "A"),
                "viscous": _about(found.viscous[k], FRICTION_ERROR, "A*s/rad"),
                "offset": _about(found.offset[k], FRICTION_ERROR, "A"),
            }
        working = self.calm(working)
        self.begin("resonance, delay, filter", 0.55, RESPONSE)
        switch_off(drives, working.where)
        self.respond(working, np.asarray(found.inertia, float))

    def respond(self, working: Working, inertia: NDArray[np.float64]) -> None:
        target, drives = working.target, working.target.drives
        fault = drives.read(STATUS) & motion.FAULT_BIT[0] == motion.FAULT_BIT[1]
        able = working.where & ~fault
        for k in map(int, np.flatnonzero(working.where & fault)):
            self.refuse(k, RESPONSE, "the drive is in fault; see its emergencies")
        if not able.any():
            return
        write_gains(drives, self.response_gains(working, inertia), able)
        down, up = working.room()
        here = replace(target, low=np.minimum(down, 0.0), high=np.maximum(up, 1e-3))
        response = measure(here, "velocity", where=able, softened=True)
        for k in map(int, np.flatnonzero(able)):
            fit = response.fits[k]
            if fit is None or fit.reason:
                why = "; ".join(response.notes[k]) or "the response was not measured"
                self.refuse(k, RESPONSE, why if fit is None else fit.reason)
                continue
            ratio = fit.plant.inertia / self.found[k]["inertia"].value
            if not 1.0 / ANOTHER < ratio < ANOTHER:
                # A fit of few lines may come to rest anywhere, and the two moves went well enough.
                self.refuse(k, RESPONSE, f"the response would be that of {ratio:.2g} times the inertia that was moved")
                continue
            self.found[k] |= _guessed(fit)


def _guessed(fit: PlantFit) -> dict[str, Estimate]:
    """Return what a fit says, with doubt in place of refusal: a twin is better off with a guess than with nothing."""
    found = dict(fit.estimates)
    values = {"inertia": fit.plant.inertia, "velocity_filter": fit.plant.velocity_filter}
    if fit.plant.is_elastic:
        values |= {name: getattr(fit.plant, name) for name in ("anti_resonance", "resonance", "damping")}
    for name, value in values.items():
        estimate = found[name]
        if not estimate.is_known:
            found[name] = _about(value, DOUBT[name], estimate.unit)
    return found


def _about(value: float, share: float, unit: str) -> Estimate:
    half = share * abs(float(value))
    return Estimate(float(value), float(value) - half, float(value) + half, unit)
