"""`drive-env faults`: of each axis in fault what is wrong, why, and what to do."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from drive_env import cia402
from drive_env.commands.options import (
    REFUSED,
    AxesOptions,
    Eds,
    Json,
    axes_of_nodes,
    axis_name,
    axis_place,
    errors_as_exit_codes,
    fail,
    grouped,
    print_result,
)

if TYPE_CHECKING:
    from drive_env.drives.reported_faults import FaultReport

RESET = "the cause removed, a fault is reset by drive-env set 6040 0 and drive-env set 6040 128"


@grouped
def faults(*, bus: AxesOptions, eds: Eds = None, json: Json = False) -> None:
    """Show of each axis whether it is in fault: what is wrong, why, and what to do. Nothing is written.

    The cause is what an emergency, 603Fh or 1003h tells; of a known drive that has neither, those that 1001h and its
    status flags leave. Exit code 1 if an axis is in fault.
    """
    with errors_as_exit_codes():
        from drive_env.drives.reported_faults import read_faults

        with bus.connect(eds, safety=False) as drives:
            chosen = axes_of_nodes(drives, bus.axis)
            reports = [report for report in read_faults(drives, drives.description) if report.axis in chosen]
            lines = [line for report in reports for line in _lines(axis_name(drives, report.axis), report)]
            print_result([axis_place(drives, report.axis) | _row(report) for report in reports], lines, json)
        wrong = sum(report.is_fault for report in reports)
        if wrong:
            fail(f"{wrong} of {len(reports)} axes in fault; {RESET}", REFUSED)


def _state(report: FaultReport) -> str:
    state = cia402.state_of(report.status)
    return "unknown state" if state is None else state.name.lower().replace("_", " ")


def _row(report: FaultReport) -> dict[str, Any]:
    return {
        "fault": report.is_fault,
        "statusword": report.status,
        "state": _state(report),
        "error register": report.register,
        "source": report.source,
        "causes": [cause._asdict() for cause in report.causes],
    }


def _lines(name: str, report: FaultReport) -> list[str]:
    """Return the lines about an axis: its state, and for each possible cause why and what to do."""
    state = f"{_state(report)} ({report.status:04X}h)"
    if not report.is_fault:
        register = f"; error register 1001h = {report.register:02X}h" if report.register else ""
        return [f"{name}  no fault, {state}{register}"]
    if not report.causes:
        return [f"{name}  {state}: the drive reports no cause, which may be over; its manual says what its lamps show"]
    lines = [f"{name}  {state}, by {report.source}:"]
    if len(report.causes) > 1:
        lines[0] = f"{name}  {state}, by {report.source} one of {len(report.causes)} causes:"
    for cause in report.causes:
        lines += [f"  {cause.name}", f"    why: {cause.cause}", f"    do: {cause.remedy}"]
    return lines
