"""Runs auto, or the commissioning of a stepper, with all files in one folder: state before, certificate, report."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from drive_env.loops.dynamics import DEFAULT

if TYPE_CHECKING:
    from drive_env.loops.dynamics import Dynamics
    from tuning.auto.one_button import Method
    from tuning.auto.stages import Result
    from tuning.stepper.result import StepperResult
    from tuning.target import Target

BEFORE = "before.toml"

Progress = Callable[[str, float], None]


def auto_to_files(
    target: Target,
    folder: Path,
    progress: Progress,
    *,
    seed: int = 0,
    keep: bool = True,
    dynamics: str | Dynamics = DEFAULT,
    method: Method | None = None,
) -> Result:
    """Tune axes with closed loops and write before.toml, certificate.json and report.html into the folder.

    Args:
        target: The drives, as `tuning.auto.one_button.auto` takes them.
        folder: A new or empty folder.
        progress: Called with the name of the present step and the share of the run that is done, 0 to 1.
        seed: Seed of the emulated machine, recorded in the certificate.
        keep: Whether drives on a bus store the gains over a power cycle.
        dynamics: Requirements on the loops.
        method: How gains are found; None selects auto's own design.

    Raises:
        BusError, OSError: As `auto` does.
    """
    from tuning.auto.certify import certificate
    from tuning.auto.one_button import DESIGN, auto
    from tuning.certificate.certificate_files import certificate_files

    method = method or DESIGN
    return auto(
        target, folder / BEFORE, method=method, dynamics=dynamics, keep=keep, progress=progress,
        files=lambda result: certificate_files(certificate(target, result, seed, method.tuner), folder, target.inputs),
    )  # fmt: skip


def commission_to_files(target: Target, folder: Path, progress: Progress, *, keep: bool = True) -> StepperResult:
    """Commission open-loop steppers and write before.toml and stepper-certificate.json into the folder.

    Raises:
        ValueError: If the drive has no load detection (checked before anything is written); else as `commission`.
    """
    from tuning.search.trial_bench import leave_oscillations_to_trials
    from tuning.stepper.commissioning import check_stepper, commission
    from tuning.stepper.result import certificate_file

    check_stepper(target)
    leave_oscillations_to_trials(target.drives)
    return commission(
        target, folder / BEFORE, keep=keep, progress=progress, files=lambda result: certificate_file(result, folder)
    )
