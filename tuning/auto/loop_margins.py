"""Measures the frequency response of the velocity loop with the new gains, and the margins of both outer loops."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from drive_env import cia402
from drive_env.dictionary.roles import Role
from drive_env.drives.observed import ObservedDrives
from drive_env.drives.raw_gains import write_gains
from drive_env.fieldbus.errors import BusError
from drive_env.loops.dynamics import OFF_NOMINAL, find_dynamics
from drive_env.safety.envelope import SafetyError
from drive_env.trials.oscillation import OSCILLATION
from mechanics.arrays import Integers, Mask
from tuning.auto.bench import BY_TRIAL
from tuning.auto.loop_model import LinkedAxis, LoopModel, loop_models, measured_response, one_plant
from tuning.auto.measured_margins import LOOPS, MeasuredAxis, at_least_by_model, why_unbounded
from tuning.identify.working_state import switch_off
from tuning.oscillation_watch import OscillationWatch
from tuning.response.measured_loop import merged

if TYPE_CHECKING:
    from drive_env.loops.dynamics import Dynamics
    from drive_env.loops.margins import Margins
    from tuning.auto.bench import AutoBench, Journal
    from tuning.auto.stages import Basis, RecordedGains
    from tuning.response.measured_loop import AtLeast, MeasuredLoop
    from tuning.target import Target

MEASURED = 0.08  # relative: error of a measured slack
# Errors of measured margins: at least one standard deviation of repeated measurements.
PHASE_ERROR, GAIN_ERROR, MS_ERROR, OVERSHOOT_ERROR = 2.0, 0.5, 1.05, 0.02
LEAST_LINES = 10  # of a frequency response, that are needed to judge it
LONGER = 2  # times the duration of the excitation, if too few lines are coherent
LEAST_WAY = 1e-3  # rad; an axis without travel is excited with the least amplitude, and its response is then incoherent
BOTH = (
    "margins are those of both ends together, computed from the part that fits the frequency responses of each end "
    "with the other one off"
)
NO_PART = "no part with one spring fits the frequency responses of both ends"
# Relative difference of the responses of an identification in both directions, above which it crosses the play of a
# gear: on ten gears 0.6 to 1.1, except one, on 80 other emulated axes less than 0.3, except two ball screws.
CROSSED_PLAY = 0.4
IN_PLAY = 0.6  # of the inertia from moves: a response with less is that of the rotor within the backlash of a gear
FREE_WINDOW = 100  # turns; the following error is meaningless during a frequency response, and must not trip it


def measure(bench: AutoBench, basis: Basis, recorded: RecordedGains, where: Mask) -> RecordedGains:
    """Measure the velocity loop's response of axes with their gains, and the slack of their loops to the dynamics.

    Gains with which an axis oscillates by itself meanwhile fail; where time waits it gets calm gains once its current
    swings more than its excitation can make it.
    """
    going = where & bench.going & (recorded.failed == "")
    if bench.target.linked:
        return _with_slack(bench, basis, recorded, going)
    late = going & ~bench.affordable(bench.response_time)
    recorded = _without_response(recorded, late, "the drive time of the run was used up")
    going = bench.whole_machines(going & ~late)
    if not going.any():
        return recorded
    try:
        response = _respond(bench, basis, recorded, going)
    except SafetyError as error:
        bench.stop(going, f"the envelope stopped the frequency response: {error}")
        return recorded
    except (ValueError, RuntimeError, TimeoutError) as error:
        if isinstance(error, BusError):
            raise
        return _without_response(recorded, going, str(error))
    bench.ground.begin_here(going)
    recorded = _without_oscillating(recorded, response, going)
    unseen, faults = recorded.unseen.copy(), bench.faults()
    for k in map(int, np.flatnonzero(going)):
        seen = _seen(response, k)
        unseen[k] = ""
        if k in faults:
            unseen[k] = f"the drive went into fault during the measurement ({faults[k]})"
        elif seen < LEAST_LINES:
            why = f"only {seen} frequencies are coherent, and {LEAST_LINES} are needed"
            unseen[k] = "; ".join([why, *response.notes[k]])
        else:
            unseen[k] = _in_play(bench.target, basis, response, k)
    if recorded.response is not None:
        # If nothing could be measured with these gains, the response with earlier gains is used for them, too.
        earlier = [measured_axis(bench, basis, recorded, k) is not None for k in range(len(going))]
        kept = going & (unseen != "") & np.array(earlier)
        unseen[kept] = ""
        response = recorded.response.replaced(response, going & ~kept)
    recorded = _with_slack(bench, basis, replace(recorded, response=response, unseen=unseen), going)
    bench.recover_faults(faults, "its frequency response was measured")
    return recorded


def _respond(bench: AutoBench, basis: Basis, recorded: RecordedGains, going: Mask) -> MeasuredLoop:
    """Excite axes with their gains and return their response; longer if it is unclear and drive time is left."""
    from tuning.response import frequency_response

    drives = bench.target.drives
    # Trials ended anywhere in the travel: count the remaining travel from there.
    low, high = bench.room()
    noise = bench.target.device.stage["adc_noise"].high
    watch = OscillationWatch(going, np.full(len(going), bench.target.current), noise, basis.calm)
    # In real time the windows of the watch would interrupt the excitation.
    watched = ObservedDrives(drives, watch) if drives.time_waits else drives
    here = replace(bench.target, drives=watched, low=low, high=np.maximum(high, LEAST_WAY))
    # In real time the envelope would stop an axis that gets no command while its response is evaluated.
    off = None if drives.time_waits else partial(switch_off, drives, going)
    write_gains(drives, recorded.gains, going)
    drives.write(cia402.FOLLOWING_WINDOW, FREE_WINDOW * drives.read(Role.POSITION_SCALE), where=going)
    try:
        with bench.spending(going):
            response = frequency_response.measure(here, "velocity", where=going, after_motion=off)
            if (longer := _unclear(bench, basis, recorded, response, going)).any():
                periods = LONGER * frequency_response.PERIODS
                again = frequency_response.measure(here, "velocity", where=longer, periods=periods, after_motion=off)
                response = merged([response, again])
    finally:
        bench.watch_following(going)
    return response


def _without_oscillating(recorded: RecordedGains, response: MeasuredLoop, where: Mask) -> RecordedGains:
    """Reject gains with which an axis oscillates by itself, as one that is stopped in a trial."""
    failed = recorded.failed.copy()
    for k in map(int, np.flatnonzero(where & (response.oscillation > 0.0))):
        failed[k] = f"its loop oscillates by itself at {response.oscillation[k]:.0f} Hz while the axis turns"
    return replace(recorded, failed=failed, swing=np.where(failed != recorded.failed, OSCILLATION, recorded.swing))


def _with_slack(bench: AutoBench, basis: Basis, recorded: RecordedGains, where: Mask) -> RecordedGains:
    """Add the slack of the axes' loops to the dynamics; nan if they were not measured."""
    slack = recorded.slack.copy()
    for k in map(int, np.flatnonzero(where)):
        one = measured_axis(bench, basis, recorded, k)
        slack[k] = np.nan if one is None else one.slack(bench.dynamics, recorded.gains[k][None])[0]
    return replace(recorded, slack=slack)


def measured_axis(bench: AutoBench, basis: Basis, recorded: RecordedGains, k: int) -> MeasuredAxis | LinkedAxis | None:
    """Return the measured loops of an axis; None if they were not measured.

    Linked axes are judged by the responses from their identification, each with the other axis off: gains that are good
    for both may oscillate with one alone.
    """
    target = bench.target
    if target.linked:
        whole = np.arange(target.num_axes) // target.axes_per_machine == k // target.axes_per_machine
        axes = np.flatnonzero(whole)
        fits = [None if (found := basis.identified.found[j]) is None else found.fit for j in axes]
        if not all(fit is not None and fit.is_good for fit in fits):
            return None
        models = loop_models(target, basis.identified, recorded, whole, bench.dynamics)
        return LinkedAxis(models[0][0], k - int(axes[0]), recorded.gains[axes]) if len(models) == 1 else None
    response = measured_response(target, recorded, k)
    return None if response is None else MeasuredAxis(response, k, basis.identified.known(k)[0])


def _unclear(bench: AutoBench, basis: Basis, recorded: RecordedGains, response: MeasuredLoop, going: Mask) -> Mask:
    """Return the axes with too few coherent lines and enough drive time for a longer measurement, (num_axes,)."""
    left = bench.affordable(LONGER * bench.response_time + bench.response_time)
    unclear = np.zeros(bench.target.num_axes, bool)
    for k in map(int, np.flatnonzero(going & left & (response.oscillation == 0.0))):
        unclear[k] = _seen(response, k) < LEAST_LINES
        if not unclear[k]:
            measured = MeasuredAxis(response, k, basis.identified.known(k)[0])
            unclear[k] = not math.isfinite(measured.margins(recorded.gains[k])["velocity"].phase_deg)
    return unclear


def _in_play(target: Target, basis: Basis, response: MeasuredLoop, k: int) -> str:
    """Return why a response is not that of the whole axis; "" if it may be."""
    fit, plant = response.fits[k], basis.identified.known(k)[0]
    alone = any(k in axes and len(axes) == 1 for axes in one_plant(target, basis.identified))
    if fit is None or fit.reason or not alone or fit.plant.inertia >= IN_PLAY * plant.inertia:
        return ""
    return (
        f"the response shows {100.0 * fit.plant.inertia / plant.inertia:.0f} % of the inertia that moves showed, and "
        f"{100.0 * IN_PLAY:.0f} % are needed: the excitation stays within the play of a gear"
    )


def _distortion(basis: Basis, k: int) -> float:
    """Return how far an axis' responses in both directions differ in its identification; 0 without a response."""
    found = basis.identified.found[k]
    return 0.0 if found is None or found.fit is None or found.fit.reason else found.fit.distortion


def _seen(response: MeasuredLoop, k: int) -> int:
    """Count the coherent lines of an axis; with a fitted model, neighbouring lines are combined."""
    return round(float(response.refined(k)[2].mean()) * len(response.f))


def _without_response(recorded: RecordedGains, where: Mask, why: str) -> RecordedGains:
    unseen = np.where(where, why, recorded.unseen)
    return replace(recorded, unseen=unseen, slack=np.where(where, np.nan, recorded.slack))


def judge(bench: AutoBench, basis: Basis, recorded: RecordedGains) -> RecordedGains:
    """Add measured margins, or their lower bounds, to the final gains, and judge them in the journals."""
    for model, axes in loop_models(bench.target, basis.identified, recorded, bench.going, bench.dynamics):
        for k in map(int, axes):
            measured = measured_axis(bench, basis, recorded, k)
            _tell_variants(bench, bench.journals[k], model, recorded.gains[axes], measured, recorded.gains[k])
    margins: dict[int, Mapping[str, Margins]] = {}
    at_least: dict[int, Mapping[str, AtLeast]] = {}
    verified = recorded.verified.copy()
    for k in map(int, np.flatnonzero(bench.going)):
        journal, response = bench.journals[k], recorded.response
        tell_overshoot(bench, journal, float(recorded.overshoot[k]))
        if recorded.shown is not None and recorded.shown.where[k] and recorded.shown.left[k] > 0.0:
            journal.reserve(f"its move ended {100.0 * recorded.shown.left[k]:.0f} % of the way from its target: dry "
                            "friction held the axis, which the gains overcome slowly")  # fmt: skip
        measured = measured_axis(bench, basis, recorded, k)
        if measured is None:
            why = recorded.unseen[k] or (NO_PART if bench.target.linked else "no response was measured")
            journal.reserve(f"margins not measured: {why}; the gains were verified {BY_TRIAL} instead")
            at_least[k], bounds = _by_model(bench, basis, k, recorded.gains[k], LOOPS)
            journal.reserve(bounds)
            continue
        margins[k] = found = measured.margins(recorded.gains[k])
        how = "by"
        if response is None:
            journal.note(BOTH)
        else:
            at_least[k] = _told_bounds(bench, basis, k, recorded.gains[k], response, found)
            for note in [note for note in response.notes[k] if note not in journal.notes]:
                journal.note(note)
            if not np.array_equal(recorded.gains[k], response.gains[k]):
                how = "by margins computed for these gains from"
        for text in short_of(bench.dynamics, found):
            journal.reserve(text)
        if (apart := _distortion(basis, k)) > CROSSED_PLAY:
            journal.reserve(
                f"its response depends on the direction of the excitation, by {100.0 * apart:.0f} % beyond noise, as "
                "with play that the excitation crosses: margins with the play closed by a load were not measured"
            )
        if (beyond := short_of(find_dynamics("stiff"), found)) and not recorded.kept[k]:
            journal.stop(f"its loops are too near to instability: {'; '.join(beyond)}")
        verified[k] = (
            f"{verified[k] or BY_TRIAL}; and {how} the measured frequency response of the velocity loop: "
            + ", ".join(f"{loop} loop Ms {one.ms:.1f}" for loop, one in found.items())
        )
    return replace(recorded, margins=margins, at_least=at_least, verified=verified)


def _tell_variants(
    bench: AutoBench,
    journal: Journal,
    model: LoopModel,
    gains: Integers,
    measured: MeasuredAxis | LinkedAxis | None,
    own: Integers,
) -> None:
    """Add a reservation if a variant of the machine keeps too little of the dynamics; reject the axis below "stiff"."""
    for dynamics, tell in ((bench.dynamics, journal.reserve), (find_dynamics("stiff"), journal.stop)):
        every = model.kept(dynamics, gains)
        if isinstance(measured, MeasuredAxis):
            # The model of coupled axes also covers a change of the velocity P of all of them.
            told = measured.kept(dynamics, own)
            every |= {name: min(kept, every.get(name, kept)) for name, kept in told.items()}
        name, kept = min(every.items(), key=lambda one: one[1])
        if kept < OFF_NOMINAL * (1.0 - MEASURED) and (measured is not None or dynamics is bench.dynamics):
            tell(
                f"with {name} it keeps {100.0 * kept:.0f} % of the margins of {dynamics.name} dynamics; "
                f"{100.0 * OFF_NOMINAL:.0f} % are asked for"
            )


def _told_bounds(
    bench: AutoBench, basis: Basis, k: int, gains: Integers, response: MeasuredLoop, found: Mapping[str, Margins]
) -> dict[str, AtLeast]:
    """Return lower bounds of an axis' margins, and report those that replace a margin that was not measured."""
    journal, least, blank = bench.journals[k], {loop: response.at_least(loop, gains, k) for loop in LOOPS}, []
    for loop, one in least.items():
        # Loops with a margin that was not measured, and that the response gives no bound for.
        if any(
            math.isnan(getattr(one, name)) and not math.isfinite(getattr(found[loop], name)) for name in one._fields
        ):
            blank.append(loop)
        else:
            tell_bounds(journal, bench.dynamics, loop, found[loop], one)
    if blank:
        more, bounds = _by_model(bench, basis, k, gains, blank)
        least |= more
        journal.reserve(
            f"not all margins of the {' and the '.join(blank)} loop were measured: too few frequencies are coherent, "
            f"and the response fits no model; {bounds}"
        )
    return least


def tell_overshoot(bench: AutoBench, journal: Journal, overshoot: float) -> None:
    """Add a reservation if a step in csp overshoots more than the dynamics allow; reject the axis beyond "stiff"."""
    told = f"a small step of the set-point in csp overshoots by {100.0 * overshoot:.0f} %"
    for dynamics, tell in ((bench.dynamics, journal.reserve), (find_dynamics("stiff"), journal.stop)):
        if overshoot > dynamics.overshoot + OVERSHOOT_ERROR:
            tell(f"{told}; {dynamics.name} dynamics allow {100.0 * dynamics.overshoot:.0f} %")


class AskedMargin(NamedTuple):
    """A margin that dynamics ask for: its name, field of `Margins`, limit, and measurement error.

    sign: 1 if the limit is the least allowed value, -1 if it is the greatest.
    """

    name: str
    field: str
    limit: float
    error: float
    unit: str
    digits: int
    sign: float = 1.0

    def missed(self, value: float, error: float = 0.0) -> bool:
        """Return whether a value is beyond the limit by more than an error; False for nan (not measured)."""
        return self.sign * (value - self.limit) < -error


def asked_margins(dynamics: Dynamics) -> tuple[AskedMargin, ...]:
    """Return the margins that dynamics ask for, equal for both outer loops."""
    return (
        AskedMargin("phase margin", "phase_deg", dynamics.phase_deg, PHASE_ERROR, "degrees", 0),
        AskedMargin("gain margin", "gain_db", dynamics.gain_db, GAIN_ERROR, "dB", 1),
        AskedMargin("sensitivity peak Ms", "ms", dynamics.ms, dynamics.ms * (MS_ERROR - 1.0), "", 1, -1.0),
    )


def short_of(dynamics: Dynamics, found: Mapping[str, Margins]) -> list[str]:
    """List the measured margins of loops that miss the dynamics by more than their error, as text."""
    texts = []
    for loop, one in found.items():
        for asked in asked_margins(dynamics):
            value = getattr(one, asked.field)
            if asked.missed(value, asked.error):
                told = f"{value:.{asked.digits}f} {asked.unit}".rstrip()
                texts.append(
                    f"the {loop} loop has a {asked.name} of {told}, and {dynamics.name} dynamics ask for "
                    f"{asked.limit:g}"
                )
    return texts


def _by_model(
    bench: AutoBench, basis: Basis, k: int, gains: Integers, loops: Sequence[str]
) -> tuple[dict[str, AtLeast], str]:
    """Return lower bounds of the loops' margins by the model of the identified axis, and a text about them."""
    plant, identified = basis.identified.plants[k], basis.identified.found[k]
    why = "the axis was not identified" if identified is None else why_unbounded(identified)
    if any(k in axes and len(axes) > 1 for axes in one_plant(bench.target, basis.identified)):
        why = "the model is of this axis alone, and axes of its machine share what it moves"
    if why or plant is None or identified is None:
        return {}, f"the identified model gives no bound of the margins: {why}"
    every = at_least_by_model(bench.target.device, plant, identified, gains)
    return {loop: every[loop] for loop in loops}, (
        "margins by the identified model, anywhere within its 95 % intervals: "
        + ", ".join(f"{loop} loop {_in_words(every[loop])}" for loop in loops)
        + "; this is a bound from the model, not a measurement"
    )


def _in_words(least: AtLeast) -> str:
    if math.isnan(least.phase_deg):
        return "no bound, since it may be unstable there"
    gain = f" and {least.gain_db:.1f} dB" if math.isfinite(least.gain_db) else ""
    return f"at least {least.phase_deg:.0f} degrees{gain}"


def tell_bounds(journal: Journal, dynamics: Dynamics, loop: str, found: Margins, least: AtLeast) -> None:
    """Add notes on the lower bounds of margins that were not measured; reservations if they are below the limit."""
    for asked in asked_margins(dynamics):
        bound = getattr(least, asked.field, math.nan)
        if not math.isfinite(getattr(found, asked.field)) and math.isfinite(bound):
            tell = journal.reserve if bound < asked.limit else journal.note
            tell(
                f"the {loop} loop's {asked.name} was not measured; it is at least {bound:.0f} {asked.unit} by the "
                "model fitted to the response, with its 95 % intervals"
            )
