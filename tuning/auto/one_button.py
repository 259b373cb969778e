"""Automatic tuning in five stages: identify, design, try, verify and correct, certify; or roll back with the reason.

Everything acts through the Drives interface, on all axes of a target at the same time, inside a transaction
(snapshot.py): the state before is saved to a file before anything is changed, and an axis that fails a check gets it
back. Gains are designed on digital twins, which takes no drive time, and corrected by measurements on the drives.
`auto` calls the stages in this order; stages.py defines the results that they pass on:

1. identify: identified.py, with the wiring and the motor's parameters (settings.py);
2. design: design.py, on twins (twin.py) and their linear models (loop_model.py);
3. try, 4. verify and correct: correction.py, in trials (proving.py), by moves (moves.py) and by measured loops
   (loop_margins.py, measured_margins.py);
5. certify: certify.py.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from drive_env.loops.dynamics import DEFAULT, INERTIA_RANGE, Dynamics, find_dynamics
from drive_env.trials.demand import COMPUTED, is_recorded
from tuning.auto.bench import AutoBench
from tuning.auto.correction import correct, try_gains
from tuning.auto.design import design_axes
from tuning.auto.identified import identify, prepare
from tuning.auto.loop_margins import judge
from tuning.auto.moves import record_previous_gains
from tuning.auto.settings import begin, commission, write
from tuning.auto.stages import Basis, RecordedGains, collect
from tuning.identify.quick_identification import identify_briefly
from tuning.identify.working_state import check_identifiable
from tuning.lateness import told_lateness
from tuning.outcome import Outcome
from tuning.rules.rules_by_name import check_rule, propose
from tuning.snapshot import Transaction, can_store
from tuning.target import timed

if TYPE_CHECKING:
    from tuning.auto.identified import Identify
    from tuning.auto.stages import Result
    from tuning.target import Target

Progress = Callable[[str, float], None]  # the present step, and the share of the run that is done, 0...1
Files = Callable[["Result"], AbstractContextManager[object]]
Find = Callable[[AutoBench, Basis, Progress], RecordedGains]  # finds gains for the axes in the run

BUDGET = 21.0  # s of drive time: two corrections of a slow axis


class Method(NamedTuple):
    """How a run finds gains.

    tuner: Name in the certificate.
    find: Finds gains and tries them on the proving ground that it sets in the bench; if it raises, everything is rolled
        back. None selects `on_twins`.
    budget: Greatest drive time per axis of a machine [s]; steps beyond it are skipped, with a note.
    improves: Whether gains measured to keep the dynamics are replaced by others that cost less on the digital twins.
    """

    tuner: str = "auto"
    find: Find | None = None
    budget: float = BUDGET
    improves: bool = True


DESIGN = Method()


def auto(
    target: Target,
    file: str | Path,
    *,
    method: Method = DESIGN,
    dynamics: str | Dynamics = DEFAULT,
    keep: bool = True,
    progress: Progress = lambda what, share: None,
    experiments: Identify = identify_briefly,
    files: Files = nullcontext,
) -> Result:
    """Tune the axes of a target; an axis that fails is rolled back, with the reason in the result.

    Args:
        target: The drives; they may have any gains, even 0, and are off afterwards.
        file: File for the state before.
        method: How gains are found; designed on digital twins by default.
        dynamics: Requirements on the loops.
        keep: Whether drives on a bus store the new gains over a power cycle.
        progress: Called with the present step, and the share that is done.
        experiments: The identification experiments.
        files: Writes the result files before the drives store the gains; if it raises, everything is rolled back. It
            must remove its files if the block in it fails.

    Raises:
        ValueError: For a drive that cannot be identified, before anything is written.
        BusError: If the drives can no longer be reached; the message has their state and how to undo.
        OSError: If a file cannot be written; the drives then have their state from before.
    """
    check_identifiable(target.device)
    with Transaction(target, file) as transaction, timed(target) as (watched, clock):
        bench = AutoBench(watched, clock, method.budget, find_dynamics(dynamics))
        progress("checking the drives", 0.0)
        begin(bench)
        progress("identifying", 0.05)
        identified = identify(bench, experiments)
        fresh = commission(bench, identified)
        if (loads := bench.dynamics.inertia_range) != INERTIA_RANGE:
            bench.note(bench.going, "gains were designed for a load inertia of "
                       f"{loads[0]:g} to {loads[1]:g} times that of the tuning")  # fmt: skip
        basis = prepare(bench, identified)
        tried = (
            (method.find or on_twins)(bench, basis, progress) if bench.going.any() else RecordedGains.only(bench.before)
        )
        recorded = correct(bench, basis, tried, target, progress, improves=method.improves)
        progress("comparing with the gains before", 0.94)
        recorded = judge(bench, basis, record_previous_gains(bench, basis, recorded))
        tell_of_lateness(bench)
        if not is_recorded(target.drives):
            bench.note(np.ones(target.num_axes, bool), COMPUTED)
        progress("writing", 0.96)
        accepted = write(bench, fresh, recorded.gains, transaction)
        kept = keep and bool(accepted.any()) and can_store(target)
        result = collect(bench, identified, recorded, transaction.path, kept)
        # Gains are only left in the drives if the files can be written, and the files stay only if the drives kept the
        # gains.
        with files(result):
            if kept:
                transaction.store(accepted)
        transaction.commit(accepted)
    progress("done", 1.0)
    return result


def on_twins(bench: AutoBench, basis: Basis, say: Progress) -> RecordedGains:
    """Design gains on digital twins, and try them on the drives."""
    designing = "designing gains on digital twins"
    gains, cost, _ = design_axes(bench, basis, bench.going, lambda share: say(designing, 0.3 + 0.35 * share))
    say("trying gains on the drives", 0.68)
    return try_gains(bench, basis, gains, cost)


def by_rule(name: str) -> Method:
    """Return the method that uses a rule's proposal for each identified axis.

    Raises:
        ValueError: For an unknown rule.
    """
    check_rule(name)

    def find(bench: AutoBench, basis: Basis, say: Progress) -> RecordedGains:
        target, gains = bench.target, basis.reference.copy()
        for k in map(int, np.flatnonzero(bench.going)):
            plant, _ = basis.identified.known(k)
            proposal = propose(name, target.device, target.motor, plant)
            gains[k] = proposal.gains
            for note in proposal.notes:
                bench.journals[k].note(f"{name}: {note}")
        say("trying gains on the drives", 0.68)
        return try_gains(bench, basis, gains, np.full(target.num_axes, np.nan))

    return Method(f"rule {name}", find, improves=False)


def tell_of_lateness(bench: AutoBench) -> None:
    """Add a reservation if SYNCs of a bus in real time were late."""
    if late := told_lateness(bench.target.drives):
        bench.reserve(np.ones(bench.target.num_axes, bool), late)


def tune(target: Target, rng: np.random.Generator, dynamics: str | Dynamics = DEFAULT) -> Outcome:
    """Tune a target; the tuner "auto" of `drive-tune rank`."""
    with tempfile.TemporaryDirectory() as folder:
        found = auto(target, Path(folder) / "before.toml", dynamics=dynamics, keep=False)
    return Outcome(
        np.array([axis.after for axis in found.axes], np.int64),
        found.drive_seconds,
        found.moves,
        found.aborts,
        found.violations,
        tuple(axis.reason or "; ".join([*axis.reservations, *axis.notes]) for axis in found.axes),
        found.accepted,
        np.array([axis.accepted and bool(axis.reservations) for axis in found.axes]),
    )
