"""Runs the experiments of an identification in order: each needs the results of earlier ones."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from drive_env import cia402
from drive_env.devices.gains import bandwidth_gains
from drive_env.dictionary.roles import Role
from drive_env.drives.currents import ampere_per_count
from drive_env.drives.interface import CYCLE
from drive_env.drives.observed import ObservedDrives
from drive_env.drives.raw_gains import write_gains
from drive_env.safety.envelope import swinging_allowed
from mechanics.arrays import Floats, Integers, Mask
from tuning.estimate import Estimate, refused
from tuning.identify.encoder_check import PULSED, EncoderCheck, check_encoders
from tuning.identify.identified_axis import NAMES, Identification, Progress
from tuning.identify.inertia import identify_mechanics
from tuning.identify.standstill import standstill_resistances
from tuning.identify.winding import Winding, identify_winding, pulse, to_torque_mode
from tuning.identify.wiring import Settings, changes, finding, findings, needed, write_wiring
from tuning.identify.working_state import (
    ALIGNED_BY_HALLS,
    BY_ENCODER,
    BY_HALLS,
    GUESS,
    MODES,
    Working,
    cautious_bandwidth,
    cautious_gains,
    check_identifiable,
    enable,
    go_back,
    read_role,
    still_enabled,
    switch_off,
    working_state,
)
from tuning.lateness import is_distorted, late_first, told_lateness
from tuning.oscillation_watch import OscillationError, OscillationWatch, shaken, watch_of
from tuning.response.dead_time import dead_time_resistance
from tuning.response.frequency_response import Signal, measure
from tuning.stop_causes import stop_causes
from tuning.target import Target, timed

if TYPE_CHECKING:
    from tuning.response.plant_fit import PlantFit


HOLD, STEADY = 160, 80  # cycles at rest before anything moves, and the last of them that are averaged
FREQUENCY_CURRENT_HZ, FREQUENCY_VELOCITY_HZ = 800.0, 25.0  # bandwidths of the loops in which the response is measured
# Greatest bandwidth of that current loop over its rate: it leaves a phase margin of 45 degrees, or of 30 if the
# inductance is a quarter less than expected.
FASTEST_CURRENT = 1.0 / 12.0
LEAST_ROOM = 1.2  # rad
HIGHEST = 400.0  # Hz, of the response
WORST_MISFIT = 2.0  # greatest error of the linear model, over that explained by noise
UNITS = {
    "resistance": "ohm", "inductance": "H", "pole_pairs": "1", "encoder_direction": "1", "inertia": "kg*m^2",
    "coulomb": "A", "viscous": "A*s/rad", "offset": "A", "anti_resonance": "Hz", "resonance": "Hz",
    "loop_delay": "s", "velocity_filter": "Hz",
}  # fmt: skip
MECHANICS, RESPONSE = NAMES[NAMES.index("inertia") :], NAMES[NAMES.index("anti_resonance") :]
SAYS_NOTHING = "so the check of pole pairs and encoder says nothing, and torque is not commanded"
OSCILLATED = "the axis oscillated"  # first words of the reason if an axis oscillated


class Experiments:
    """One identification of some axes at the same time; `quick_identification` overrides the steps that need torque.

    Attributes:
        target, where, progress: As in `tuning.identify.identification.identify`.
        found: Present results of each axis, by the names of `NAMES`.
    """

    modes: tuple[str, ...] = MODES
    thorough = True  # include experiments that only narrow an interval
    corrects = False  # wiring settings also of drives that are already commissioned

    def __init__(self, target: Target, where: Mask, progress: Progress) -> None:
        check_identifiable(target.device, self.modes)
        self.target, self.where, self.progress = target, where, progress
        self._drives = target.drives
        self._at_rest: list[Estimate] = []  # resistances at rest, if they are measured
        self._under_way: tuple[str, tuple[str, ...]] = ("", NAMES)
        self.found: list[dict[str, Estimate]] = [
            {name: refused(UNITS[name], "not asked for") for name in NAMES} for _ in range(target.num_axes)
        ]
        self._wiring: list[Settings] = [{} for _ in range(target.num_axes)]
        self._fits: list[PlantFit | None] = [None] * target.num_axes

    def run(self) -> list[Identification]:
        """Run all experiments and return the results."""
        with timed(self.target) as (target, clock):
            noise = target.device.stage["adc_noise"].high
            self._drives = target.drives
            watch = OscillationWatch(self.where, np.full(target.num_axes, target.current), noise)
            watched = ObservedDrives(target.drives, watch)
            with working_state(replace(target, drives=watched), self.where) as working:
                watch.limit = working.current
                with suppress(OscillationError):
                    good = self.check(working)
                    if good.any():
                        self.turn(replace(working, where=good))
                self.calm(working)
        self.progress("done", 1.0)
        every = zip(self.found, self.where, self._wiring, self._fits, strict=True)
        return [Identification(found, clock.seconds if chosen else 0.0, wiring=wiring, fit=fit)
                for found, chosen, wiring, fit in every]  # fmt: skip

    def begin(self, what: str, share: float, names: tuple[str, ...]) -> None:
        """Report the present experiment and the share done; this experiment and later ones give the values `names`."""
        self.progress(what, share)
        self._under_way = what, names

    def calm(self, working: Working) -> Working:
        """Return the drives without the axes that oscillated, whose missing values are refused for that reason."""
        watch = watch_of(working.target.drives)
        swung = working.where & (np.zeros_like(working.where) if watch is None else watch.swung)
        what, names = self._under_way
        for k in np.flatnonzero(swung):
            assert watch is not None, "it saw them"
            for name in names:
                before = self.found[k][name]
                if not before.is_known and not before.reason.startswith(OSCILLATED):
                    self.found[k][name] = refused(UNITS[name], (
                        f"{OSCILLATED} at about {watch.frequency[k]:.0f} Hz ({what}) and was switched off within 50 "
                        "ms: check whether this is the right motor, and whether current and inertia fit its data sheet"
                    ))  # fmt: skip
        return replace(working, where=working.where & ~swung)

    def check(self, working: Working) -> Mask:
        """Check the encoders and return the axes that may get torque."""
        self.begin("pole pairs and encoder", 0.0, NAMES)
        checks = self._corrected(working, check_encoders(working))
        good = working.where.copy()
        for k in np.flatnonzero(working.where):
            check = checks[k]
            self.found[k] |= {"pole_pairs": check.pole_pairs, "encoder_direction": check.direction}
            reason = self._wrong(working, int(k), check)
            if reason and is_distorted(self._drives):
                # Late SYNCs turned the field too far: the wiring or motor that the check blames may be correct.
                reason = f"{told_lateness(self._drives)}; {SAYS_NOTHING}"
                self.found[k] |= {name: refused("1", reason) for name in ("pole_pairs", "encoder_direction")}
                self._wiring[k] = {}
            if reason:
                good[k] = False
                self.refuse(int(k), NAMES, reason)
        if good.any() and (self.thorough or _in_real_time(working)):
            self._at_rest = standstill_resistances(replace(working, where=good))
        return good

    def _corrected(self, working: Working, checks: list[EncoderCheck]) -> list[EncoderCheck]:
        """Set the drives up for the measured wiring where allowed, and check again; the settings are restored later."""
        has = {key: working.target.drives.read(key) for key in findings(working.target.device)}
        again = np.zeros(len(checks), bool)
        for k in map(int, np.flatnonzero(working.where)):
            own = {key: int(values[k]) for key, values in has.items()}
            self._wiring[k] = needed(working.target.device, own, checks[k].direction.value, checks[k].halls)
            again[k] = bool(changes(self._wiring[k])) and (self.corrects or working.fresh[k])
        again &= not is_distorted(self._drives)
        # An encoder aligned by halls when it was first enabled keeps this alignment until it is switched off.
        again &= ~_aligned_by_halls(working)
        if not again.any():
            return checks
        values = [changes(wiring) if chosen else {} for wiring, chosen in zip(self._wiring, again, strict=True)]
        working.target, working.origin = write_wiring(working.target, working.origin, values)
        second = check_encoders(replace(working, where=again))
        for k in map(int, np.flatnonzero(again)):
            if not second[k].is_good:
                self._wiring[k] = {}  # the setting did not have the expected effect
        return [new if chosen else old for old, new, chosen in zip(checks, second, again, strict=True)]

    def _wrong(self, working: Working, k: int, check: EncoderCheck) -> str:
        """Return why an axis must not get torque; "" if it may."""
        target = working.target
        aligned = bool(_aligned_by_halls(working)[k])
        by_halls = aligned or target.drives.read(Role.COMMUTATION)[k] == BY_HALLS
        remedy = (
            "; ".join(finding(working.target.device, self._wiring[k]))
            or "the drive ignores its settings of encoder and hall direction"
        )
        if aligned:
            remedy += ", then switch the drive off and on, since the halls set the encoder's angle at start-up"
        if not check.is_good:
            return (
                f"the encoder counts in the wrong direction, and torque would make the motor run away: {remedy} (or "
                "swap two motor phases), then identify again"
            )
        if by_halls and (check.halls.reversed or check.halls.inverted):
            return (
                f"the hall signals do not match the angle of the field, and torque would lock the motor: {remedy}, "
                "then identify again"
            )
        configured = int(target.drives.read(Role.POLE_PAIRS)[k])
        if check.pole_pairs.is_known and round(check.pole_pairs.value) != configured:
            return (
                f"the motor has {check.pole_pairs.value:.0f} pole pairs and the drive is set to {configured}: with a "
                "wrong commutation angle torque cannot be commanded; write the right number of pole pairs (or of "
                "encoder counts per turn), then identify again"
            )
        if not check.is_whole(configured):
            return (
                f"{check.pole_pairs.reason}; with a wrong commutation angle torque cannot be commanded: correct it, "
                "then identify again"
            )
        if "did not follow" in check.direction.reason or "switched off" in check.direction.reason:
            return check.direction.reason
        if target.motor.kind != "dc" and not check.direction.is_known:
            return f"{check.direction.reason}; without this check torque could make the motor run away"
        return ""

    def turn(self, working: Working) -> None:
        """Run the experiments that need torque."""
        working, holding = self.pulse_currents(working)
        self.begin("inertia and friction", 0.3, MECHANICS)
        mechanics, inertia = identify_mechanics(working, holding)
        for k in np.flatnonzero(working.where):
            self.found[k] |= mechanics[k]._asdict()
        working = self.calm(working)
        self.begin("resonance, delay, filter", 0.7, RESPONSE)
        self.respond(working, inertia)
        self.finish(self.calm(working))

    def finish(self, working: Working) -> None:
        """Bring the axes that are still enabled back to their origin, and switch them off."""
        drives = working.target.drives
        on = working.where & still_enabled(drives.read(cia402.STATUSWORD))
        if on.any():
            go_back(replace(working, where=on), "csv", to=0.0)
            switch_off(drives, on)

    def pulse_currents(self, working: Working) -> tuple[Working, Floats]:
        """Identify the windings; return the axes that did not oscillate, in csv, and their holding currents [A]."""
        target, drives = working.target, working.target.drives
        self.begin("current pulses", 0.15, NAMES)
        enable(working, "csp")
        go_back(working, "csp")
        holding = self.hold(working)
        electrical = drives.read(Role.ELECTRICAL_ANGLE) * (2.0 * np.pi / 65536.0)
        to_torque_mode(working, holding)
        with swinging_allowed(drives), shaken(drives, PULSED * working.current):
            pulses = pulse(working, holding)
        working = self.calm(working)
        gains = cautious_gains(target, GUESS * target.motor.inertia)
        write_gains(drives, gains, working.where)
        go_back(working, "csv")
        sign = 1.0 - 2.0 * read_role(target, Role.SHAFT_DIRECTION)
        windings = identify_winding(
            working, pulses, np.asarray(electrical, np.float64), float(target.motor.n_p) * float(sign[0])
        )
        self.take_windings(working, windings)
        return working, holding

    def hold(self, working: Working) -> Floats:
        """Return the currents that hold the axes at rest in csp [A]."""
        drives = working.target.drives
        trace = drives.record([cia402.TORQUE_ACTUAL], HOLD * CYCLE)
        alive = still_enabled(drives.read(cia402.STATUSWORD))
        causes = [] if alive.all() else stop_causes(drives)
        for k in np.flatnonzero(working.where & ~alive):
            self.refuse(int(k), NAMES[4:], f"the drive switched off while it held the axis: {causes[k]}")
        return np.asarray(trace[cia402.TORQUE_ACTUAL][-STEADY:].mean(axis=0) * ampere_per_count(drives))

    def take_windings(self, working: Working, windings: list[Winding]) -> None:
        """Store the estimates of resistance and inductance."""
        for k in np.flatnonzero(working.where):
            both = [windings[k].resistance, *self._at_rest[k : k + 1]]
            # In real time the pulses give no resistance; then the reason of the other method is the useful one.
            resistance = min(
                (one for one in both if one.is_known), key=lambda one: one.high - one.low,
                default=both[-1] if _in_real_time(working) else both[0],
            )  # fmt: skip
            self.found[k] |= {"resistance": resistance, "inductance": windings[k].inductance}

    def respond(self, working: Working, inertia: Floats) -> None:
        """Measure the velocity loop's response with suitable gains, and store its estimates."""
        target, drives = working.target, working.target.drives
        # Still enabled: a loaded axis would fall between the experiments otherwise.
        go_back(working, "csv")
        able = working.where & still_enabled(drives.read(cia402.STATUSWORD))
        down, up = working.room()
        causes = [] if able.all() else stop_causes(drives)
        for k in np.flatnonzero(working.where):
            if not able[k]:
                self.refuse(int(k), RESPONSE, f"the drive switched off: {causes[k]}")
            elif max(up[k], -down[k]) < LEAST_ROOM:
                able[k] = False
                self.refuse(int(k), RESPONSE, (
                    f"travel too short for a frequency response: {LEAST_ROOM:g} rad are needed, and there are "
                    f"{max(up[k], -down[k]):.2g}"
                ))  # fmt: skip
        if not able.any():
            return
        write_gains(drives, self.response_gains(working, inertia), able)
        here = replace(target, low=np.minimum(down, 0.0), high=np.maximum(up, 1e-3))
        with swinging_allowed(drives):
            response = measure(
                here, "velocity", where=able, signal=Signal(high=HIGHEST), confirmed=True, softened=True,
                progress=lambda share: self.progress("resonance, delay, filter", 0.7 + 0.29 * share),
                after_motion=lambda: self.finish(self.calm(working)),
            )  # fmt: skip
        for k in np.flatnonzero(able):
            fit = response.fits[k]
            if fit is None:
                self.refuse(int(k), RESPONSE, "; ".join(response.notes[k]) or "the response was not measured")
                continue
            self.found[k] |= {name: fit.estimates[name] for name in RESPONSE}
            self._fits[k] = fit
            if fit.misfit > WORST_MISFIT:
                for name in RESPONSE:
                    self.found[k][name] = refused(UNITS[name], (
                        f"the response does not fit a model with one spring: the error is {fit.misfit:.1f} times the "
                        "noise (backlash, or several resonances)"
                    ))  # fmt: skip

    def response_gains(self, working: Working, inertia: Floats) -> Integers:
        """Return raw gains for measuring a response, (num_axes, count), for total inertias [kg*m^2]."""
        target, motor = working.target, working.target.motor
        rows = []
        for k in range(target.num_axes):
            found = self.found[k]
            R, L = found["resistance"], found["inductance"]
            known = motor._replace(R_s=R.value if R.is_known else motor.R_s, L_q=L.value if L.is_known else motor.L_q)
            rows.append(
                bandwidth_gains(
                    target.device,
                    known,
                    float(inertia[k]),
                    current_hz=current_bandwidth(target, k),
                    velocity_hz=cautious_bandwidth(motor, float(inertia[k]), FREQUENCY_VELOCITY_HZ),
                    position_hz=5.0,
                    supply=float(target.supply[k]),
                )
            )
        return np.array(rows, np.int64)

    def refuse(self, k: int, names: tuple[str, ...], reason: str) -> None:
        """Refuse values that are still missing, with a reason, late SYNCs first."""
        reason = late_first(self._drives, reason)
        for name in names:
            if not self.found[k][name].is_known and self.found[k][name].reason in ("", "not asked for"):
                self.found[k][name] = refused(UNITS[name], reason)


def current_bandwidth(target: Target, k: int) -> float:
    """Return the bandwidth of the current loop [Hz] in which the response of an axis is measured.

    To a current near zero, dead time looks like a resistance, at mains voltage many times the winding's; to a large
    current it does not. A current loop slower than this resistance over the inductance responds differently to each
    amplitude and direction of the excitation, as backlash does.
    """
    device, motor = target.device, target.motor
    lost = dead_time_resistance(device, motor, float(target.supply[k]), np.zeros(1))
    fastest = FASTEST_CURRENT * device.current_rate
    return float(np.clip(lost / (2.0 * np.pi * motor.L_q), FREQUENCY_CURRENT_HZ, fastest))


def _aligned_by_halls(working: Working) -> Mask:
    """Return which drives commutate by an encoder that was aligned by halls."""
    drives = working.target.drives
    by_encoder = drives.read(Role.COMMUTATION) == BY_ENCODER
    return np.asarray(by_encoder & (read_role(working.target, Role.ENCODER_INITIALISATION) == ALIGNED_BY_HALLS))


def _in_real_time(working: Working) -> bool:
    return not working.target.drives.time_waits
