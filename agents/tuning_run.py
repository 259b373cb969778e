"""A whole run of a trained tuner on a drive: look, tune, show, prove, keep; or roll back, and say why."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.tuner import TrialShown, tune_target

if TYPE_CHECKING:
    from tuning.certificate import Certificate
    from tuning.target import Target

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

FREE_WINDOW = 100  # turns of following error that trip while the drive is shaken: the error means nothing there
FOLLOWING_WINDOW, POSITION, POSITION_SCALER = 0x6065, 0x6064, 0x2058


class Run(NamedTuple):
    """What became of a target: its certificate, the gains it has, raw (num_axes, 5), and whether they outlive power."""

    certificate: Certificate
    gains: Integers
    trials: tuple[TrialShown, ...]
    kept: bool


def run(
    target: Target,
    policy: Any,
    file: Path,
    *,
    name: str,
    keep: bool = True,
    show: Callable[[TrialShown], None] = lambda trial: None,
    say: Callable[[str], None] = lambda what: None,
) -> Run:
    """Tune a target; what raises leaves the drives with what they had, at rest and disabled.

    Args:
        target: The drives.
        policy: A policy for GainTuning.
        file: Where the state before is left, for `drive-tune restore`.
        name: Of the agent, for the certificate.
        keep: Whether drives on a bus keep the gains over a power cycle.
        show: Called after every trial.
        say: Called with what is under way.

    Raises:
        PolicyError: If the policy gives no number; SafetyError, BusError, RuntimeError or TimeoutError for the drives.
    """
    from agents.guard import stopping
    from drive_env.gains import write_gains
    from tuning.auto_checks import wrong_wiring
    from tuning.brief import identify_briefly
    from tuning.proving import shaken_on_purpose
    from tuning.snapshot import Transaction
    from tuning.target import timed

    everywhere = np.ones(target.num_axes, bool)
    with Transaction(target, file) as transaction, timed(target) as (watched, clock):
        before = _gains(target)
        origin = target.drives.read(POSITION)
        with stopping(watched.drives), shaken_on_purpose(watched.drives):
            say("checking the wiring and identifying")
            identified = identify_briefly(watched, everywhere)
            for one in identified:
                if why := wrong_wiring(watched, one):
                    raise RuntimeError(why)
            say("trials")
            tuned = tune_target(from_here(watched, origin), policy, show=show)
            say("a move for the record, with the gains before and the new ones")
            shown = _show(watched, identified, before, tuned.gains, origin)
            say("the frequency response")
            response, why = _response(from_here(watched, origin), tuned.gains)
        write_gains(target.drives, before)
        transaction.roll_back()  # everything but the gains is as it was
        write_gains(target.drives, tuned.gains)
        kept = keep and transaction.store()
        transaction.commit()
    seconds, aborts = clock.seconds, np.sum([trial.aborted for trial in tuned.trials], axis=0)
    made = _certificate(target, name, identified, before, tuned.gains, shown, response, why, seconds, aborts)
    return Run(made, tuned.gains, tuned.trials, kept)


def _gains(target: Target) -> Integers:
    from tuning.trial_bench import read_gains

    return read_gains(target)


def _show(
    target: Target, identified: Any, before: Integers, after: Integers, origin: Integers
) -> tuple[tuple[bool, Any], ...]:
    """Return recorded moves, each with whether it was made with the new gains.

    Axes whose gains before are none to move with are left out of the first one.
    """
    from drive_env.gains import Gains
    from tuning.auto_checks import unsafe_gains
    from tuning.linear_model import Plant
    from tuning.proving import ProvingGround

    here = from_here(target, origin)
    plants = [
        Plant.from_identification(target.device, target.motor, float(volts), one)
        for volts, one in zip(target.supply, identified, strict=True)
    ]
    unsafe = [
        unsafe_gains(target.device, plant, Gains(*map(int, gains))) for plant, gains in zip(plants, before, strict=True)
    ]
    ground = ProvingGround(target, plants, (here.low, here.high), after, after)
    safe, everywhere = np.array([not why for why in unsafe]), np.ones(target.num_axes, bool)
    first = ((False, ground.show(before, safe)),) if safe.any() else ()
    return (*first, (True, ground.show(after, everywhere)))


def from_here(target: Target, origin: Integers) -> Target:
    """Return the target with its travel counted from where the axes stand now: trials have moved them."""
    from drive_env.positioning import wrapped

    gone = wrapped(target.drives.read(POSITION) - origin) / target.increments()
    return replace(target, low=np.minimum(target.low - gone, 0.0), high=np.maximum(target.high - gone, 0.0))


def _response(target: Target, gains: Integers) -> tuple[Any, str]:
    """Return the velocity loop's response with the gains, or None and why there is none."""
    from drive_env import motion
    from drive_env.gains import write_gains
    from drive_env.master.errors import BusError
    from drive_env.safety import SafetyError
    from tuning.frequency_response import measure

    drives = target.drives
    motion.disable(drives)
    write_gains(drives, gains)
    drives.write(FOLLOWING_WINDOW, FREE_WINDOW * drives.read(POSITION_SCALER))
    try:
        return measure(target, "velocity"), ""
    except (ValueError, RuntimeError, TimeoutError) as error:
        if isinstance(error, BusError | SafetyError):
            raise
        return None, f"no frequency response: {error}"
    finally:
        motion.disable(drives)


def _move(shown: Any, axis: int, tuned: bool) -> Any:
    """Return the move of an axis for the certificate, in its own direction: every other one goes back."""
    from tuning.certificate import StepResponse

    way = np.sign(shown.demand[-1, axis]) or 1.0
    demand, actual, current = (way * rows[:, axis] for rows in (shown.demand, shown.actual, shown.current))
    figures = {"largest following error [rad]": float(np.abs(demand - actual).max())}
    return StepResponse("move", tuned, "rad", shown.t, demand, actual, current, figures)


def _certificate(
    target: Target,
    name: str,
    identified: Any,
    before: Integers,
    after: Integers,
    shown: Any,
    response: Any,
    why: str,
    seconds: float,
    aborts: NDArray[Any],
) -> Certificate:
    from tuning import certificate as c
    from tuning.provenance import versions

    axes = []
    for axis, one in enumerate(identified):
        supply = float(target.supply[axis])
        moves = tuple(_move(one, axis, tuned) for tuned, one in shown if one.where[axis])
        loops: tuple[c.FrequencyResponse, ...] = ()
        if response is not None:
            loop = c.frequency_response(
                "velocity loop", response.f, response.open_loop[:, axis], response.margins(axis), tuned=True,
                coherence=response.coherence[:, axis], source="multisine, 1 kHz samples",
            )  # fmt: skip
            loops = (loop,)
        axes.append(
            c.AxisCertificate(
                axis=axis,
                accepted=True,
                reason="the best of all trials, as the agent judges them",
                identified=c.identified(one),
                before=tuple(map(int, before[axis])),
                after=tuple(map(int, after[axis])),
                before_si=c.si_gains(target.device, supply, before[axis]),
                after_si=c.si_gains(target.device, supply, after[axis]),
                steps=moves,
                frequency_responses=loops,
                notes=(why,) if why else (),
                hardware_seconds=seconds,
                aborts=int(aborts[axis // target.axes_per_machine]),
            )
        )
    return c.Certificate(
        tuner=f"agent {name}",
        device=target.device.name,
        motor=target.motor.name,
        machine=target.machine or "unnamed",
        supply=float(target.supply[0]),
        seed=0,
        envelope=c.envelope(target),
        axes=tuple(axes),
        versions=versions(),
    )
