"""`drive-tune commission`: from a factory-fresh drive to a certificate, step by step."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drive_env.commands.tables import print_lines
from tuning.commands.options import (
    REFUSED,
    DriveOptions,
    DynamicsOption,
    InertiaRangeOption,
    Json,
    ask,
    asked_dynamics,
    errors_as_exit_codes,
    open_target,
    print_json,
    progress_bar,
    takes,
    tell_before,
)

if TYPE_CHECKING:
    from tuning.commissioning.bench import CommissioningPlan
    from tuning.commissioning.path import CommissioningPath, StepState
    from tuning.commissioning.steps import CommissioningStep
    from tuning.target import Target

ANSWERS = {"y": "do it", "s": "leave it out", "b": "back to the step before", "q": "quit, and restore everything"}


@dataclass(frozen=True, kw_only=True)
class FreshDriveOptions(DriveOptions):
    """`DriveOptions`, but an emulated drive has its factory settings."""

    def machine(self) -> dict[str, Any]:
        """Return the options as arguments of `tuning.target.emulated`; raises as `open_target`."""
        return super().machine() | {"factory_fresh": True}


@takes
def commission(
    drive: FreshDriveOptions,
    dynamics: DynamicsOption = None,
    inertia_range: InertiaRangeOption = None,
    method: Annotated[
        int | None, typer.Option("--method", help="Homing method, kept in 6098h.", show_default="the drive's, 6098h")
    ] = None,
    limit: Annotated[
        list[str] | None,
        typer.Option(
            "--limit",
            help="A limit as NAME=VALUE: current, speed, quick-stop, following-error, and lowest and highest position "
            "from home, e.g. current='3 A'; may be repeated. What is not given stays.",
        ),
    ] = None,
    step: Annotated[
        list[str] | None, typer.Option("--step", help="Step to do; may be repeated.", show_default="all")
    ] = None,
    skip: Annotated[list[str] | None, typer.Option("--skip", help="Step to leave out; may be repeated.")] = None,
    store: Annotated[
        bool,
        typer.Option("--store/--no-store", help="Drives on a bus store all of it, so that it survives a power cycle."),
    ] = True,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the steps and the objects that each writes; drives are only read.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for the results, new or empty.", show_default="runs/<timestamp>-commission"),
    ] = None,
    json: Json = False,
) -> None:
    """Commission a drive step by step: motor, wiring, current loop, limits, homing, identify, tune, verify, store.

    Each step says what to look at, what is measured and what is written. On a terminal it waits for your word before
    each: do it, leave it out, go back, or quit. `--yes` does them all. An emulated drive is as it comes from the
    factory.

    The state before is in before.toml before the first step. Stopped before the parameters are stored, by an error, a
    step that fails, Ctrl-C or your word, it leaves the drive off and with its parameters from before. The last step
    writes certificate.json and report.html. Exit code 1 if a step failed, or you quit.
    """
    with errors_as_exit_codes():
        from drive_env.devices import find_device
        from drive_env.devices.gains import has_linear_model
        from tuning.commissioning.axis_limits import raw_limits
        from tuning.commissioning.bench import CommissioningPlan
        from tuning.commissioning.homing import check_method
        from tuning.commissioning.path import BEFORE, CommissioningPath
        from tuning.runs import provenance
        from tuning.target import check_measurable
        from tuning.way_back import way_back

        chosen = _chosen(step, skip)
        asked = asked_dynamics(dynamics, drive.device, inertia_range)
        if has_linear_model(device := find_device(drive.device)):
            check_measurable(device, ())
        plan = CommissioningPlan(asked, method, _limits(limit), store, drive.seed)
        _check_used(plan, chosen)
        folder = provenance.run_folder("commission") if out is None else out
        provenance.check_folder(folder)
        if dry_run:
            with drive.open_to_read() as target:
                check_method(target, method)
                raw_limits(target, plan.limits)
                _tell_plan(target, chosen, json)
            return
        file = folder / BEFORE if drive.bus else None
        drive.check()
        with way_back(file, "drive-tune"), open_target(drive) as target:
            check_method(target, method)
            raw_limits(target, plan.limits)  # checked before anything moves
            with CommissioningPath(target, plan, folder) as path:
                _walk(path, chosen, yes=drive.yes, quiet=json)
        if json:
            rows = {name: {"state": one.state, "lines": one.lines} for name, one in path.states.items()}
            print_json({"steps": rows, "kept": path.is_kept, "before": str(path.file)})
        elif path.is_kept:
            print(f"kept; drive-tune undo {path.file} restores the state before" if file else "done")
        else:
            print("the drive has its parameters from before, and is off")
            tell_before(file)
        if path.next is not None:
            raise typer.Exit(REFUSED)


def _chosen(step: Sequence[str] | None, skip: Sequence[str] | None) -> set[str]:
    """Return the names of the steps to run.

    Raises:
        ValueError: For an unknown step.
    """
    from tuning.commissioning.steps import STEPS

    for option, names in (("--step", step), ("--skip", skip)):
        if unknown := next((name for name in names or () if name not in STEPS), None):
            raise ValueError(f"{option} {unknown}: the steps are {', '.join(STEPS)}")
    return set(step or STEPS) - set(skip or ())


def _check_used(plan: CommissioningPlan, chosen: set[str]) -> None:
    """Raise ValueError for a limit or a homing method whose step is left out: it would not be written."""
    from tuning.commissioning.axis_limits import LIMITS

    written = {f"--limit {name}": "homing" if LIMITS[name].is_place else "limits" for name in plan.limits}
    written |= {} if plan.method is None else {"--method": "homing"}
    if unused := next((option for option, step in written.items() if step not in chosen), None):
        raise ValueError(
            f"{unused} is written by the step {written[unused]}, which is left out; do that step, or leave out {unused}"
        )


def _limits(given: Sequence[str] | None) -> dict[str, str]:
    """Parse the given limits by name; ValueError for a text that is not NAME=VALUE."""
    from tuning.commissioning.axis_limits import LIMITS

    found = {}
    for text in given or ():
        name, equals, value = text.partition("=")
        if not equals or name not in LIMITS:
            raise ValueError(f"--limit {text} must be NAME=VALUE, with one of {', '.join(LIMITS)}")
        found[name] = value
    return found


def _walk(path: CommissioningPath, chosen: set[str], *, yes: bool, quiet: bool) -> None:
    """Run the steps in order, until the last one, the user's word, or a failure without a terminal."""
    from tuning.commissioning.homing import has_no_method, no_method
    from tuning.commissioning.steps import STEPS

    asks, names = sys.stdin.isatty() and not yes and not quiet, list(STEPS)
    told: set[str] = set()
    while (name := path.next) is not None:
        for one in names[: names.index(name)]:
            if one not in told and not quiet and path.states[one].state == "skipped":
                _print_state(STEPS[one], path.states[one])
            told.add(one)
        if name not in chosen:
            path.skip(name)
            continue
        step = STEPS[name]
        if name == "homing" and not asks and has_no_method(path.bench):
            path.skip(name, no_method(path.bench.target))
            continue
        if not quiet:
            _print_step(names.index(name) + 1, step, path.bench.target)
        answer = _answer(path, name) if asks else "y"
        if answer == "q":
            return
        if answer == "s":
            path.skip(name)
        elif answer == "b":
            path.back_to(_before(path, name, chosen))
        else:
            if not asks and step.moves and path.bench.target.bus:
                ask(f"{step.title}: the motor turns. Is its way clear?", yes)
            state = _run(path, name, quiet)
            if state.state == "failed" and not asks:
                return


def _run(path: CommissioningPath, name: str, quiet: bool) -> StepState:
    from tuning.commissioning.steps import STEPS

    with progress_bar(STEPS[name].title) as show:
        state = path.run(name, lambda what, share: show(share))
    if not quiet:
        _print_state(STEPS[name], state)
    return state


def _answer(path: CommissioningPath, name: str) -> str:
    """Ask the user what to do with a step, and for a homing method if none is chosen."""
    words = ", ".join(f"{key}: {what}" for key, what in ANSWERS.items())
    while (answer := typer.prompt(f"  {words}", default="y").strip().lower()[:1]) not in ANSWERS:
        pass
    if name == "homing" and answer == "y":
        _ask_method(path)
    return str(answer)


def _ask_method(path: CommissioningPath) -> None:
    from tuning.commissioning.homing import has_no_method, offered_methods

    if has_no_method(path.bench):
        print_lines(f"  {number:>3}  {text}" for number, text in offered_methods(path.bench.target).items())
        path.bench.plan.method = typer.prompt("  No method is chosen (6098h is 0). Number of the list", type=int)


def _before(path: CommissioningPath, name: str, chosen: set[str]) -> str:
    """Return the chosen step before one, among those that the drive has; the step itself if it is the first."""
    from tuning.commissioning.steps import STEPS

    names = list(STEPS)
    earlier = [one for one in names[: names.index(name)] if one in chosen and not STEPS[one].unfit(path.bench.target)]
    return earlier[-1] if earlier else name


def _print_step(number: int, step: CommissioningStep, target: Target) -> None:
    from tuning.commissioning.steps import STEPS

    print_lines([
        f"{number}/{len(STEPS)} {step.title}{' (the motor turns)' if step.moves else ''}",
        f"  look at: {step.look}", f"  measured: {step.measured}", f"  written: {_objects(step, target)}",
    ])  # fmt: skip


def _objects(step: CommissioningStep, target: Target) -> str:
    return ", ".join(f"{index:04X}h:{sub:02X}" for index, sub in step.writes(target)) or "nothing that stays"


def _print_state(step: CommissioningStep, state: StepState) -> None:
    print_lines(
        [f"  {step.title} {state.state}: {line}" if k == 0 else f"  {line}" for k, line in enumerate(state.lines)]
    )


def _tell_plan(target: Target, chosen: set[str], json: bool) -> None:
    """Print the steps, and the objects that each would write, with their present values."""
    from tuning.commissioning.path import check_off
    from tuning.commissioning.steps import STEPS
    from tuning.identify.working_state import borrowed

    check_off(target)
    rows: list[dict[str, Any]] = []
    for name, step in STEPS.items():
        why = "" if name in chosen else "left out"
        why = step.unfit(target) or why
        keys = [] if why else step.writes(target)
        present = {f"{key[0]:04X}h:{key[1]:02X}": target.drives.read(key).tolist() for key in keys if key[0] >= 0x2000}
        row: dict[str, Any] = {"step": name, "moves": step.moves, "look at": step.look, "measured": step.measured}
        rows.append(row | {"left out": why, "writes": [f"{i:04X}h:{s:02X}" for i, s in keys], "now": present})
    if json:
        print_json(rows)
        return
    for number, (told, step) in enumerate(zip(rows, STEPS.values(), strict=True), 1):
        if told["left out"]:
            print_lines([f"{number}/{len(STEPS)} {step.title}: left out: {told['left out']}"])
            continue
        _print_step(number, step, target)
        if told["now"]:
            now = (f"{key} {', '.join(map(str, raw))}" for key, raw in told["now"].items())
            print_lines([f"  now: {', '.join(now)}"])
    find = target.device.new_dictionary().find
    lent = ", ".join(f"{entry.index:04X}h:{entry.sub:02X}" for entry in map(find, borrowed(target.device)))
    print_lines([f"Steps that move borrow besides, and give back: {lent}", "Nothing was written (dry run)."])
