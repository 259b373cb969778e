"""The steps of a commissioning in order: what the user checks, what is measured and written, and the functions.

A step that fails raises an error with the reason in one line; the path then undoes its writes.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drive_env.cia402 import Key
from drive_env.devices.commissioning import BANDWIDTHS, ROTORS
from drive_env.devices.gains import bandwidth_gains, cascade_columns, has_linear_model
from drive_env.dictionary.roles import Role
from drive_env.drives.raw_gains import read_gains
from drive_env.loops.dynamics import Dynamics, find_dynamics
from drive_env.loops.margins import Margins
from drive_env.safety.envelope import swinging_allowed
from tuning.auto.loop_margins import asked_margins
from tuning.auto.settings import ignore_unwired_switches, motor_parameters, told_unwired
from tuning.commissioning.axis_limits import LIMITS, check_limits_of_motor, check_place_of_axes, limits_of, write_limits
from tuning.commissioning.bench import CommissioningBench
from tuning.commissioning.first_experiments import FirstExperiments
from tuning.commissioning.homing import HOMING_OBJECTS, home_axes, unfit_for_homing
from tuning.estimate import Estimate, interval
from tuning.identify.identification import identify
from tuning.identify.identified_axis import TITLES
from tuning.identify.wiring import changes, corrected, findings
from tuning.snapshot import STORE, can_store, store, write_parameters
from tuning.target import Target

if TYPE_CHECKING:
    from mechanics.arrays import Mask
    from tuning.auto.stages import AxisResult, Result
    from tuning.identify.identified_axis import Identification
    from tuning.stepper.result import StepperAxis, StepperResult

Say = Callable[[str, float], None]  # name of the present action, and the share of the step that is done, 0...1
OPEN_LOOP = "the motor is driven in open loop: there is nothing of it to identify"
# Identified resistance and inductance as a share of the data sheet's: beyond these limits it is another motor.
LEAST_SHARE, MOST_SHARE = 0.5, 2.0
STIFF = "stiff"  # the limit: loops below the margins of these dynamics are not accepted


@dataclass(frozen=True)
class CommissioningStep:
    """A step.

    Attributes:
        name: Name in options and files.
        title: Name for users.
        look: What the user should check before it.
        measured: What is measured.
        writes: Returns the objects of a target that the step writes for good.
        run: Runs the step; returns its results as lines.
        moves: Whether the motor turns.
        unfit: Returns why the target cannot do the step; "" if it can.
    """

    name: str
    title: str
    look: str
    measured: str
    writes: Callable[[Target], list[Key]]
    run: Callable[[CommissioningBench, Say], list[str]]
    moves: bool = True
    unfit: Callable[[Target], str] = lambda target: ""


# --- functions of the steps -------------------------------------------------------------------------------------------
def write_motor(bench: CommissioningBench, say: Say) -> list[str]:
    """Write the data of motor and encoder, and gains and profile computed from them."""
    target, wanted = bench.target, motor_parameters(bench.target)
    wiring = {key: value for key, value in wanted.items() if key in findings(target.device)}
    before = {key: target.drives.read(key) for key in wanted}
    with bench.counting_anew():
        bench.wire([wiring] * target.num_axes if wiring else [])
        write_parameters(target.drives, wanted)
    changed = sum(int(np.any(before[key] != target.drives.read(key))) for key in wanted)
    lines = [f"{changed} of {len(wanted)} objects changed for {target.motor.name}, and read back"]
    if ignore_unwired_switches(target, np.ones(target.num_axes, bool)).any():
        lines.append(told_unwired(target))
    return lines


def wire_encoder(bench: CommissioningBench, say: Say) -> list[str]:
    """Check the wiring, correct the settings of encoder and halls, and check again."""
    found, good = _checked_wiring(bench, say)
    wanted = [changes(one.wiring) for one in found]
    lines = [text for one in found for text in corrected(bench.target.device, one.wiring)]
    if any(wanted):
        with bench.counting_anew():
            bench.wire(wanted)
        found, good = _checked_wiring(bench, say)
    for k in map(int, np.flatnonzero(~good)):
        raise RuntimeError(f"{_axis(bench, k)}{found[k].estimates['resistance'].reason}")
    for k, one in enumerate(found):
        pairs, direction = one.estimates["pole_pairs"], one.estimates["encoder_direction"]
        told = f"{pairs.value:.0f} pole pairs, and " if pairs.is_known else ""
        sense = "with" if direction.value > 0.0 else "against"
        lines.append(f"{_axis(bench, k)}{told}the encoder counts {sense} the field")
    return lines


def _checked_wiring(bench: CommissioningBench, say: Say) -> tuple[list[Identification], Mask]:
    check = FirstExperiments(bench.here(), say, pulses=False)
    with swinging_allowed(bench.target.drives):
        return check.run(), check.good


def tune_current_loop(bench: CommissioningBench, say: Say) -> list[str]:
    """Identify the winding, and set P and I of the current loop accordingly."""
    target = bench.here()
    with swinging_allowed(target.drives):
        found = FirstExperiments(target, say, pulses=True).run()
    known, columns = target.device.gains, cascade_columns(target.device)[:2]
    gains, lines = read_gains(target.drives), []
    for k, one in enumerate(found):
        R, L = one.estimates["resistance"], one.estimates["inductance"]
        if not R.is_known and not L.is_known:
            raise RuntimeError(f"{_axis(bench, k)}{R.reason}")
        lines += [
            f"{_axis(bench, k)}{_beside(TITLES[name], estimate, sheet)}"
            for name, estimate, sheet in (
                ("resistance", R, target.motor.R_s), ("inductance", L, target.motor.L_q),
            )
        ]  # fmt: skip
        motor = target.motor._replace(
            R_s=R.value if R.is_known else target.motor.R_s, L_q=L.value if L.is_known else target.motor.L_q
        )
        wanted = bandwidth_gains(
            target.device, motor, ROTORS * motor.inertia, supply=float(target.supply[k]), **BANDWIDTHS
        )
        for column in columns:
            if gains[k, column] != wanted[column]:
                lines.append(f"{_axis(bench, k)}{known.rows[column].title} is {wanted[column]}, and was "
                             f"{gains[k, column]}")  # fmt: skip
            gains[k, column] = wanted[column]
    for column in columns:
        target.drives.write(known.keys[column], gains[:, column])
    return lines


def set_limits(bench: CommissioningBench, say: Say) -> list[str]:
    """Write the given limits, except positions relative to home, and check that they fit the motor."""
    lines = write_limits(bench.target, bench.plan.limits, places=False)
    return [*lines, *check_limits_of_motor(bench.target)]


def find_home(bench: CommissioningBench, say: Say) -> list[str]:
    """Home the axes, and write the limits that are positions relative to home."""
    lines = home_axes(bench)
    lines += write_limits(bench.target, bench.plan.limits, places=True)
    check_place_of_axes(bench.target)
    return lines


def identify_axes(bench: CommissioningBench, say: Say) -> list[str]:
    """Identify all parameters of the axes."""
    lines = []
    with swinging_allowed(bench.target.drives):
        every = identify(bench.here(), progress=say)
    for k, one in enumerate(every):
        if not any(estimate.is_known for estimate in one.estimates.values()):
            raise RuntimeError(f"{_axis(bench, k)}{one.estimates['inertia'].reason}")
        for name, estimate in one.estimates.items():
            value = _value(estimate) if estimate.is_known else f"not identified: {estimate.reason}"
            lines.append(f"{_axis(bench, k)}{TITLES[name]} {value}")
    return lines


def tune_axes(bench: CommissioningBench, say: Say) -> list[str]:
    """Tune by auto, or an open-loop stepper by its commissioning; nothing is stored yet."""
    from tuning.auto.one_button import auto
    from tuning.search.trial_bench import leave_oscillations_to_trials
    from tuning.stepper.commissioning import commission

    target, plan = bench.here(), bench.plan
    with tempfile.TemporaryDirectory() as folder:  # discarded: the file of the whole path restores the drives
        before = Path(folder) / "before.toml"
        result: Result | StepperResult
        if has_linear_model(target.device):
            result = auto(target, before, dynamics=plan.dynamics, keep=False, progress=say, files=nullcontext)
        else:
            leave_oscillations_to_trials(target.drives)
            result = commission(target, before, keep=False, progress=say)
    bench.result, lines = result, []
    each: Sequence[AxisResult | StepperAxis] = result.axes
    for k, axis in enumerate(each):
        if not axis.accepted:
            raise RuntimeError(f"{_axis(bench, k)}rejected: {axis.reason}")
        lines.append(f"{_axis(bench, k)}{axis.verdict}; before {_gains(axis.before)}, now {_gains(axis.after)}")
        lines += [f"{_axis(bench, k)}reservation: {one}" for one in axis.reservations]
    return lines


def verify_loops(bench: CommissioningBench, say: Say) -> list[str]:
    """Measure the velocity loop again with the gains in the drive, and compare its margins with the dynamics."""
    from tuning.response.frequency_response import measure

    target = bench.here()
    asked, stiff = find_dynamics(bench.plan.dynamics), find_dynamics(STIFF)
    measured = measure(target, "velocity", progress=lambda share: say("measuring the velocity loop", share))
    lines = []
    for k in range(target.num_axes):
        if measured.fits[k] is not None:
            loops = measured.loops(measured.gains[k], k).margins()
        elif math.isfinite((velocity := measured.margins(k)).ms):
            loops = {"velocity": velocity}
        else:
            raise RuntimeError(f"{_axis(bench, k)}not measured: {'; '.join(measured.notes[k])}")
        for loop, one in loops.items():
            told = f"{_axis(bench, k)}{loop} loop {_figures(one)}"
            if short := _shortfall(one, stiff):
                raise RuntimeError(f"{told}: below {STIFF} dynamics ({short}); tune it, or ask for softer dynamics")
            short = _shortfall(one, asked)
            lines.append(f"{told}{f': less than {asked.name} dynamics ask for ({short})' if short else ''}")
    return lines


def store_parameters(bench: CommissioningBench, say: Say) -> list[str]:
    """Have the drives store their parameters if the user wants it and they can."""
    if not bench.plan.store:
        return ["kept until the drives are switched off; they were not to store it"]
    if not can_store(bench.target):
        what = "has no 1010h" if bench.target.bus else "is emulated, and keeps nothing over a power cycle"
        return [f"the drive {what}: its parameters stay until it is switched off"]
    store(bench.target.drives)
    bench.is_stored = True
    return ["stored in the drive (1010h:01)"]


def certify(bench: CommissioningBench, say: Say) -> list[str]:
    """Write the certificate of the tuning, with the information whether it was stored."""
    from tuning.auto.certify import certificate
    from tuning.auto.stages import Result
    from tuning.certificate.certificate_files import certificate_files
    from tuning.stepper.result import CERTIFICATE, certificate_file

    target, result = bench.target, bench.result
    if result is None or not bench.is_kept:
        raise RuntimeError("only gains that were tuned, and are kept, have a certificate")
    if isinstance(result, Result):
        stored = result._replace(kept=bench.is_stored)
        with certificate_files(certificate(target, stored, bench.plan.seed), bench.folder, target.inputs):
            return [f"written to {bench.folder}: certificate.json, report.html"]
    with certificate_file(replace(result, kept=bench.is_stored), bench.folder):
        return [f"written to {bench.folder}: {CERTIFICATE}"]


# --- words ------------------------------------------------------------------------------------------------------------
def _axis(bench: CommissioningBench, k: int) -> str:
    return f"axis {bench.target.axis_numbers[k]}: " if bench.target.num_axes > 1 else ""


def _value(estimate: Estimate) -> str:
    unit = "" if estimate.unit == "1" else f" {estimate.unit}"
    return f"{estimate.value:.4g}{unit} ({interval(estimate.low, estimate.high)})"


def _beside(title: str, estimate: Estimate, sheet: float) -> str:
    """Format an estimate beside the data sheet's value; RuntimeError if they differ too much for the same motor."""
    if not estimate.is_known:
        return f"{title} not identified, so the data sheet's {sheet:.4g} {estimate.unit} counts: {estimate.reason}"
    told = f"{title} {_value(estimate)}; data sheet {sheet:.4g} {estimate.unit}"
    if not LEAST_SHARE <= estimate.value / sheet <= MOST_SHARE:
        raise RuntimeError(f"{told}: this is another motor, or its winding or a cable is damaged")
    return told


def _gains(gains: Mapping[str, int] | Sequence[int]) -> str:
    return ", ".join(map(str, gains.values() if isinstance(gains, Mapping) else gains))


def _figures(found: Margins) -> str:
    parts = ((found.phase_deg, ".0f", "°"), (found.gain_db, ".0f", " dB"), (found.ms, ".2f", ""))
    texts = [f"{value:{form}}{unit}" if math.isfinite(value) else "?" for value, form, unit in parts]
    return f"{texts[0]}, {texts[1]}, Ms {texts[2]}"


def _shortfall(found: Margins, asked: Dynamics) -> str:
    """List the measured margins that fall short of the dynamics by more than the measurement error, as text."""
    every = [one for one in asked_margins(asked) if one.missed(getattr(found, one.field), one.error)]
    return ", ".join(f"{one.name} {one.limit:g} {one.unit}".rstrip() for one in every)


# --- the table --------------------------------------------------------------------------------------------------------
def _in_open_loop(target: Target) -> str:
    return "" if has_linear_model(target.device) else OPEN_LOOP


def _of_linked(target: Target) -> str:
    why = "the axes pull at one thing, and one loop alone says nothing; the tuning has measured them together"
    return why if target.linked else _in_open_loop(target)


def _motor_objects(target: Target) -> list[Key]:
    switches = target.device.roles.get(Role.LIMIT_SWITCHES)
    return [*motor_parameters(target), *([] if switches is None else [switches])]


def _current_gains(target: Target) -> list[Key]:
    return [target.device.gains.keys[k] for k in cascade_columns(target.device)[:2]]


def _limit_objects(target: Target) -> list[Key]:
    there = limits_of(target)
    return [(e.index, e.sub) for name, entries in there.items() if not LIMITS[name].is_place for e in entries]


STEPS = {
    step.name: step
    for step in (
        CommissioningStep(
            "motor", "Motor",
            "is it this motor, with this encoder, and this supply? Its own data sheet is a TOML file (--motor FILE)",
            "nothing", _motor_objects, write_motor, moves=False,
        ),
        CommissioningStep(
            "wiring", "Wiring and commutation",
            "nothing touches the shaft. It turns by a part of a turn, there and back; one that jumps or locks has a "
            "wrong order of phases",
            "the field is turned slowly in open loop: pole pairs, direction of the encoder, levels and order of halls",
            lambda target: list(findings(target.device)), wire_encoder, unfit=_in_open_loop,
        ),
        CommissioningStep(
            "current", "Current loop", "the shaft may twitch",
            "resistance and inductance by current pulses, held against the data sheet",
            _current_gains, tune_current_loop, unfit=_in_open_loop,
        ),
        CommissioningStep(
            "limits", "Limits", "what may current, speed and quick stop be? What is not given stays as it is",
            "nothing", _limit_objects, set_limits, moves=False,
        ),
        CommissioningStep(
            "homing", "Homing", "are the switches that the method needs there, within the travel?",
            "the way to home; afterwards the axis goes back to where it stood",
            lambda target: list(HOMING_OBJECTS), find_home, unfit=unfit_for_homing,
        ),
        CommissioningStep(
            "identify", "Identification", "the way is clear: up to rated current and 0.7 of the rated speed",
            "inertia, friction, weight, resonance, delay and filter, each with its 95 % interval",
            lambda target: [], identify_axes, unfit=_in_open_loop,
        ),
        CommissioningStep(
            "tune", "Tuning", "the way is clear: moves, reversals, and a shake for the frequency response",
            "gains are designed for the dynamics, tried, and corrected by what is measured",
            lambda target: list(target.device.gains.keys), tune_axes,
        ),
        CommissioningStep(
            "verify", "Verification", "the way is clear: a shake of two seconds",
            "margins of the loops with the gains that the drive has now, held against the dynamics",
            lambda target: [], verify_loops, unfit=_of_linked,
        ),
        CommissioningStep(
            "store", "Store", "is the axis as it should be? From here on nothing is taken back",
            "nothing", lambda target: [STORE], store_parameters, moves=False,
        ),
        CommissioningStep(
            "certificate", "Certificate", "its verdict, with reservations and their reasons",
            "nothing", lambda target: [], certify, moves=False,
        ),
    )
}  # fmt: skip
