"""Identification in half the time, for tuning: the same checks and the same response, but short moves.

`identify` moves an axis for five seconds to know inertia and friction within a few percent; here two moves of a quarter
of a second are enough, since the frequency response gives the inertia again, and better.

A tuner's twins need a value even if it is only assumed, and their variants differ by the uncertainty of these values:
`Identification.estimates` includes them. `Identification.told` has identified values only.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from drive_env import cia402, motion
from drive_env.dictionary.roles import Role
from drive_env.drives.raw_gains import write_gains
from drive_env.trials.gain_trial import Identified, Trials
from drive_env.trials.method import method_of
from drive_env.trials.positioning import longer_way
from mechanics.arrays import Floats, Mask
from tuning.estimate import Estimate, refused
from tuning.identify.encoder_check import PULSED
from tuning.identify.experiments import MECHANICS, RESPONSE, UNITS, WORST_MISFIT, Experiments
from tuning.identify.identified_axis import NAMES, Identification, Progress
from tuning.identify.winding import BRIEFLY, identify_winding, pulse, to_torque_mode
from tuning.identify.working_state import GUESS, Working, cautious_gains, enable, read_role, switch_off
from tuning.link_energy import trial_reach
from tuning.oscillation_watch import shaken
from tuning.response.frequency_response import measure
from tuning.stop_causes import stop_causes
from tuning.target import Target

if TYPE_CHECKING:
    from tuning.response.plant_fit import PlantFit

# Half width of an interval over its value, for twins only: of results of two moves, and of values that a fit refuses.
INERTIA_ERROR, FRICTION_ERROR = 0.15, 0.3
DOUBT = {"inertia": 0.2, "velocity_filter": 0.4, "anti_resonance": 0.1, "resonance": 0.1, "damping": 0.5}
LEAST_WAY = 1.0  # rad of room to either side that all axes of a machine need to measure their coupling
# Inertia by the response over that by the moves: a lower ratio means that it was measured within the backlash of a
# gear. On 20 drawn axes without backlash it is 0.93 to 1.04; on three with it 0.51, 1.05 and 1.34.
LOOSE = 0.75
# The same for one axis of several: in a fast excitation the other axes give way, in moves they are held: with mass
# matrix M the ratio is 1 - M12^2 / (M11 M22), for two links of a SCARA 0.64 and 0.74.
LOOSE_BESIDE_OTHERS = 0.5
ANOTHER = 2.5  # greatest ratio: a response with more inertia is that of another axis
# Of 46 axes of the suite, the friction error was below FRICTION_ERROR on 1 (viscous) and 13 (dry).
SHORT, LONGER = "two moves of a quarter of a second do not separate it from", "`drive-tune identify` measures longer"
NOT_TOLD = {
    "inertia": "two moves of a quarter of a second give it too roughly, and no frequency response was measured",
    "coulomb": f"{SHORT} viscous friction and drag; {LONGER}",
    "viscous": f"{SHORT} Coulomb friction; {LONGER}",
    "offset": f"{SHORT} friction; {LONGER}",
}
OF_ALL = (
    "in the frequency response the axis moved the mass shared by all axes of its machine, and two moves of a quarter "
    "of a second give its own part too roughly"
)
# Dead time and friction shorten the measured delay by up to 0.09 ms here, which no scatter shows.
NO_DELAY = (
    "so short a frequency response gives it to 0.1 ms only, which is no better than the period of the drive's velocity "
    "loop"
)


def identify_briefly(target: Target, where: Mask | None = None) -> list[Identification]:
    """Identify axes, all by default, in about 4 s for each axis of a machine.

    Otherwise as `identify`; axes of one machine move one after the other, or together if linked.

    Returns:
        One identification per axis. Its `told` has the identified values; its `estimates` have assumed values, for
        twins, instead of most refused ones.
    """
    axes = np.ones(target.num_axes, bool) if where is None else where
    return _Brief(target, axes, lambda what, share: None).run()


class _Brief(Experiments):
    """`Experiments` with shorter moves and assumed values."""

    thorough = False
    corrects = True  # a tuner must leave a drive that can turn

    def __init__(self, target: Target, where: Mask, progress: Progress) -> None:
        super().__init__(target, where, progress)
        # Measured estimates of each axis for which `found` has an assumed value.
        self._told: list[dict[str, Estimate]] = [{} for _ in range(target.num_axes)]
        self._pushed: list[tuple[float, ...]] = [() for _ in range(target.num_axes)]

    def run(self) -> list[Identification]:
        every = zip(super().run(), self._told, self._pushed, strict=True)
        return [
            replace(one, told={name: told.get(name, one.estimates[name]) for name in NAMES}, pushed=pushed)
            for one, told, pushed in every
        ]

    def turn(self, working: Working) -> None:
        target, drives = working.target, working.target.drives
        self.begin("current pulses", 0.3, NAMES)
        enable(working, "csv")
        holding = self.hold(working)
        electrical = drives.read(Role.ELECTRICAL_ANGLE) * (2.0 * math.pi / 65536.0)
        to_torque_mode(working, holding)
        with shaken(drives, PULSED * working.current):
            pulses = pulse(working, holding, BRIEFLY)
        working = self.calm(working)
        sign = 1.0 - 2.0 * float(read_role(target, Role.SHAFT_DIRECTION)[0])
        self.take_windings(
            working, identify_winding(working, pulses, np.asarray(electrical, np.float64), target.motor.n_p * sign)
        )
        self.begin("inertia and friction", 0.45, MECHANICS)
        write_gains(drives, cautious_gains(target, GUESS * target.motor.inertia), working.where)
        motion.select_mode(drives, "pp", working.where)
        down, up = working.room()
        # the settling time scale is not used here
        trials = Trials(drives, target.motor, target.axes_per_machine, 1.0)
        inertia = np.full(target.num_axes, GUESS * target.motor.inertia)
        reach = trial_reach(target, inertia, holding, longer_way(down, up))
        for moving in _turns(working):
            found, _ = trials.identify(reach, moving)
            self._take_moved(found, moving)
            inertia[moving] = found.inertia[moving]
        working = self.calm(working)
        working = self._move_together(working, trials, holding)
        self.begin("resonance, delay, filter", 0.55, RESPONSE)
        switch_off(drives, working.where)
        self.respond(working, inertia)

    def _move_together(self, working: Working, trials: Trials, holding: Floats) -> Working:
        """Find the inertia that axes of a machine move if all of them move; return the axes that did not oscillate."""
        target, lanes = working.target, working.target.axes_per_machine
        whole = np.repeat(working.where.reshape(-1, lanes).all(axis=1), lanes)
        if lanes == 1 or target.linked or not whole.any():  # linked axes have already moved together
            return working
        # Slow gains: no axis follows the motion that the others cause.
        write_gains(target.drives, method_of(target.device, target.motor).first(target.supply), whole)
        down, up = working.room()
        # First all axes in the same direction, then each opposite to the others, by the same angle: on axes at rest,
        # dry friction would hold part of what the others push.
        either = np.repeat(np.minimum(-down, up).reshape(-1, lanes).min(axis=1), lanes)
        able = whole & (either >= LEAST_WAY)
        far = np.where(able, either, longer_way(down, up))
        reach = trial_reach(target, GUESS * target.motor.inertia, holding, far).reshape(-1, lanes)
        ways = np.concatenate([np.ones((1, lanes)), 1.0 - 2.0 * np.eye(lanes)])
        moved = [
            trials.identify((signs * reach).reshape(-1), where)[0].inertia.reshape(-1, lanes)
            for signs, where in zip(ways, [whole, *[able] * lanes], strict=True)
            if where.any()
        ]
        for machine in map(int, np.flatnonzero(whole[::lanes])):
            told = len(ways) if able[machine * lanes] else 1
            rows = pushed_inertia(ways[:told], np.array([one[machine] for one in moved[:told]]))
            self._pushed[machine * lanes : (machine + 1) * lanes] = map(tuple, rows.tolist())
        return self.calm(working)

    def _take_moved(self, found: Identified, where: Mask) -> None:
        for k in map(int, np.flatnonzero(where)):
            self.found[k] |= {
                "inertia": _about(found.inertia[k], INERTIA_ERROR, "kg*m^2"),
                "coulomb": _about(found.coulomb[k], FRICTION_ERROR, "A"),
                "viscous": _about(found.viscous[k], FRICTION_ERROR, "A*s/rad"),
                "offset": _about(found.offset[k], FRICTION_ERROR, "A"),
            }
            self._told[k] = {name: refused(UNITS[name], reason) for name, reason in NOT_TOLD.items()}

    def respond(self, working: Working, inertia: Floats) -> None:
        target, drives = working.target, working.target.drives
        fault = cia402.matches(drives.read(cia402.STATUSWORD), cia402.FAULT_BIT)
        able = working.where & ~fault
        causes = stop_causes(drives) if fault.any() else []
        for k in map(int, np.flatnonzero(working.where & fault)):
            self._no_response(k, f"the drive is in fault: {causes[k]}")
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
                self._no_response(k, why if fit is None else fit.reason)
                continue
            ratio = fit.plant.inertia / self.found[k]["inertia"].value
            if not 1.0 / ANOTHER < ratio < ANOTHER:
                # A fit with few lines may converge anywhere; the two moves were good enough.
                self._no_response(
                    k, f"the frequency response would need {ratio:.2g} times the inertia found in the moves"
                )
                continue
            if ratio < (LOOSE if target.axes_per_machine == 1 else LOOSE_BESIDE_OTHERS) and not target.linked:
                # Within backlash the motor turns alone, and a weak excitation does not leave it.
                self._no_response(k, loose(ratio))
                continue
            moved = self.found[k]["inertia"]
            self.found[k] |= _guessed(fit)
            self._told[k] |= _told(fit, float(response.f[-1]))
            self._fits[k] = fit
            if target.linked:
                self.found[k]["inertia"] = moved
                self._told[k]["inertia"] = refused(UNITS["inertia"], OF_ALL)

    def _no_response(self, k: int, reason: str) -> None:
        self.refuse(k, RESPONSE, reason)
        self._told[k]["inertia"] = refused(UNITS["inertia"], (
            "two moves of a quarter of a second give it too roughly, and the frequency response does not give it: "
            f"{reason}"
        ))  # fmt: skip


def pushed_inertia(ways: Floats, inertia: Floats) -> Floats:
    """Return the mass matrix of axes at their rotors [kg*m^2], (axes, axes), from the inertias in moves of all axes.

    Args:
        ways: Direction of each axis in each move, 1 or -1, (moves, axes); in the first move all are equal.
        inertia: Torque of each axis over its own acceleration [kg*m^2], (moves, axes).

    Returns:
        A symmetric matrix; from a single move a diagonal one.
    """
    if len(ways) == 1:
        return np.diag(inertia[0])
    rows = [
        np.linalg.lstsq(ways * own[:, None], pushed, rcond=None)[0]
        for own, pushed in zip(ways.T, inertia.T, strict=True)
    ]
    return np.asarray(0.5 * (np.array(rows) + np.transpose(rows)))


def loose(ratio: float) -> str:
    """Return the message about a response that gives this ratio of its inertia to that found in moves."""
    return (
        f"the frequency response gives {ratio:.2f} times the inertia found in the moves: it was measured within the "
        "play of a gear, where the motor turns alone"
    )


def _turns(working: Working) -> list[Mask]:
    """Return which axes move at the same time: linked axes together, others of a machine one after the other."""
    lanes = working.target.axes_per_machine
    if working.target.linked:
        return [working.where]
    position = np.arange(working.target.num_axes) % lanes
    return [turn for k in range(lanes) if (turn := working.where & (position == k)).any()]


def _told(fit: PlantFit, highest: float) -> dict[str, Estimate]:
    """Return the estimates of a fit up to the highest frequency [Hz], with its refusals."""
    told = {name: fit.estimates[name] for name in ("inertia", *RESPONSE)}
    told["loop_delay"] = refused(UNITS["loop_delay"], NO_DELAY)
    if fit.plant.is_elastic and fit.plant.resonance > highest:
        # A resonance there cannot be told from the filter's lag.
        reason = f"a resonance above {highest:.0f} Hz, the highest frequency measured, cannot be separated from it"
        told["velocity_filter"] = refused(UNITS["velocity_filter"], reason)
    if fit.misfit > WORST_MISFIT:
        reason = f"the response does not fit a model with one spring: the error is {fit.misfit:.1f} times the noise"
        told |= {name: refused(UNITS[name], reason) for name in RESPONSE}
    return told


def _guessed(fit: PlantFit) -> dict[str, Estimate]:
    """Return the estimates of a fit with wide intervals instead of refusals: a twin needs a value."""
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
